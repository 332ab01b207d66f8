"""DDS types made at run time from message definitions, so that peers which compare types find the real ones."""

from collections import OrderedDict
from collections.abc import Callable
from types import new_class
from typing import Any, Final
from weakref import WeakValueDictionary

from cyclonedds.idl import IdlStruct
from cyclonedds.idl import types as idl
from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import Fielddefs, FieldDesc
from rosbags.typesys.store import Typestore

from sern_client.endpoints.dds.names import type_to_dds
from sern_core.vocabulary.errors import ConfigError
from sern_runtime.ros_types import ResolvedType

MAX_BOUND: Final = 0xFFFF
"""The longest bound that the binding allows; a longer one is as good as none, because bodies are not looked at."""

# The binding's own hints do not know that these can be indexed.
_STRING: Final[Any] = idl.bounded_str
_ARRAY: Final[Any] = idl.array
_SEQUENCE: Final[Any] = idl.sequence
_Key = tuple[int, str, bool]  # id of the store, type, with a request's header or not
_BASE: Final[dict[str, Any]] = {
    "bool": bool,
    "byte": idl.byte,
    "char": idl.uint8,
    "int8": idl.int8,
    "uint8": idl.uint8,
    "int16": idl.int16,
    "uint16": idl.uint16,
    "int32": idl.int32,
    "uint32": idl.uint32,
    "int64": idl.int64,
    "uint64": idl.uint64,
    "float32": idl.float32,
    "float64": idl.float64,
    "string": str,
}
REQUEST_HEADER: Final[Fielddefs] = [
    ("sern_client_guid", (Nodetype.BASE, ("uint64", 0))),
    ("sern_sequence_number", (Nodetype.BASE, ("int64", 0))),
]
"""What rmw_cyclonedds puts before the fields of a request or response."""


KEPT_TYPES: Final = 64
"""The types made last, which are kept when nobody uses them: 1 MB for the largest definition. The others go."""


class TypeMaker:
    """Makes the DDS types of one endpoint. While one is in use, its definition has no other."""

    def __init__(self) -> None:
        self._made: WeakValueDictionary[_Key, Any] = WeakValueDictionary()
        self._newest: OrderedDict[_Key, Any] = OrderedDict()

    def __len__(self) -> int:
        """How many there are, with the types in them."""
        return len(self._made)

    def make(self, resolved: ResolvedType, *, header: bool = False) -> Any:
        """The class of a ROS type; with `header`, of a request or response of rmw_cyclonedds.

        ConfigError for a type that DDS cannot have.
        """
        fields = resolved.store.fielddefs[resolved.name][1]
        made = self._struct(
            resolved.store, resolved.name, [*REQUEST_HEADER, *fields] if header else fields, header=header
        )
        key = id(resolved.store), resolved.name, header
        self._newest[key] = made
        self._newest.move_to_end(key)
        if len(self._newest) > KEPT_TYPES:
            self._newest.popitem(last=False)
        return made

    def _of(self, store: Typestore, name: str) -> Any:
        return self._struct(store, name, store.fielddefs[name][1], header=False)

    def _struct(self, store: Typestore, name: str, fields: Fielddefs, *, header: bool) -> Any:
        key = id(store), name, header
        made: Any = self._made.get(key)
        if made is None:
            hints = {field: self._field(store, name, desc) for field, desc in fields}
            fill: Callable[[dict[str, Any]], None] = lambda namespace: namespace.update(__annotations__=hints)  # noqa: E731
            kwds = {"typename": type_to_dds(name)}
            made = new_class(name.rpartition("/")[2] + "_", (IdlStruct,), kwds, fill)
            made._sern_store = store  # lasts as long as its types: a later one must not get its id
            self._made[key] = made
        return made

    def _field(self, store: Typestore, owner: str, desc: FieldDesc) -> Any:
        if desc[0] == Nodetype.NAME:
            return self._of(store, str(desc[1]))
        if desc[0] == Nodetype.BASE:
            base, bound = desc[1]
            if base not in _BASE:
                raise ConfigError(f"type {owner}: a field of type {base} cannot be sent over DDS here")
            if base == "string" and 0 < bound <= MAX_BOUND:
                return _STRING[bound]
            return _BASE[base]
        inner, size = desc[1]
        item = self._field(store, owner, inner)
        if desc[0] == Nodetype.ARRAY:
            return _ARRAY[item, size]
        return _SEQUENCE[item, size] if 0 < size <= MAX_BOUND else _SEQUENCE[item]
