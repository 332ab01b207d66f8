"""Messages in JSON, as people and browsers write them, turned into bodies.

What is left out is zero. A field that the type does not have is an error, because it is a typing error of somebody who
wants a robot to move; so is a number that is none (NaN, null, one beyond its type). `seq` of a header is not read.
A time is `{"sec": 1, "nsec": 5}` or `{"sec": 1, "nanosec": 5}`.
"""

import base64
import binascii
import json
import struct
from typing import Any, Final

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import FieldDesc
from rosbags.serde import SerdeError

from sern_core.vocabulary.errors import BodyError
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_types
from sern_runtime.ros_types import ResolvedType

MAX_JSON_BYTES: Final = 2**18
MAX_MESSAGES: Final = 2_000
"""Messages inside a message, and texts in lists: 5 µs each."""
_TIMES: Final = frozenset({"builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration"})
_UNSERIALISABLE: Final = (SerdeError, AssertionError, IndexError, ValueError, TypeError, OverflowError, struct.error)


def body_of(kind: ResolvedType, text: bytes) -> bytes:
    """The body of a message of this type. BodyError, with one line, for what is none."""
    if len(text) > MAX_JSON_BYTES:
        raise BodyError(f"{len(text)} bytes of JSON; up to {MAX_JSON_BYTES} are read")
    try:
        value = json.loads(text, parse_constant=_no_number)
    except (ValueError, RecursionError):
        raise BodyError("this is no JSON") from None
    message = _Reader(kind).message(value, kind.name, "the message")
    try:
        if kind.encoding is Encoding.ROS1:
            return bytes(kind.store.serialize_ros1(message, kind.name))
        return bytes(kind.store.serialize_cdr(message, kind.name))
    except _UNSERIALISABLE as error:
        raise BodyError(f"it is no {kind.name}: {ros_types.one_line(error)}") from None


class _Reader:
    def __init__(self, kind: ResolvedType) -> None:
        self._store = kind.store
        self._left = MAX_MESSAGES

    def message(self, value: Any, type_name: str, where: str) -> Any:
        self._count()
        fields = self._store.fielddefs[type_name][1]
        if not isinstance(value, dict):
            raise BodyError(f"{where} is no mapping with the fields of {type_name}")
        if type_name == "std_msgs/msg/Header":
            value = {key: item for key, item in value.items() if key != "seq"}
        if type_name in _TIMES and "nsec" in value:
            value = {"nanosec" if key == "nsec" else key: item for key, item in value.items()}
        unknown = value.keys() - {name for name, _ in fields}
        if unknown:
            raise BodyError(f"{type_name} has no field {min(unknown)[:40]!r}")
        read = {
            ros_types.attribute(name): self._field(value[name], desc, name)
            if name in value
            else ros_types.zero(desc, self._store)
            for name, desc in fields
        }
        return self._store.types[type_name](**read)

    def _count(self) -> None:
        self._left -= 1
        if self._left < 0:
            raise BodyError(f"more than {MAX_MESSAGES} messages in one")

    def _field(self, value: Any, desc: FieldDesc, name: str) -> Any:
        if desc[0] == Nodetype.NAME:
            return self.message(value, str(desc[1]), name)
        if desc[0] == Nodetype.BASE:
            return _base(value, str(desc[1][0]), name)
        item, size = desc[1]
        is_array = desc[0] == Nodetype.ARRAY
        base = str(item[1][0]) if item[0] == Nodetype.BASE else None
        if base in ("uint8", "byte", "char") and isinstance(value, str):
            value = _decoded(value, name)
        if not isinstance(value, list | bytes):
            raise BodyError(f"{name} is no list")
        if size and (len(value) != size if is_array else len(value) > size):
            raise BodyError(f"{name} has {len(value)} elements, {size} are {'needed' if is_array else 'allowed'}")
        if base is None:
            return [self.message(each, str(item[1]), name) for each in value]
        if base == "string":
            for _ in value:
                self._count()
            return [_base(each, base, name) for each in value]
        return _numbers(value, base, name)


def _base(value: Any, base: str, name: str) -> Any:
    if base == "string":
        if not isinstance(value, str):
            raise BodyError(f"{name} is no text")
        return value
    if base == "bool":
        if not isinstance(value, bool | int) or value not in (0, 1):
            raise BodyError(f"{name} is neither true nor false")
        return bool(value)
    if base.startswith("float"):
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise BodyError(f"{name} is no number")
        return _numbers([value], base, name)[0].item()
    whole = int(value) if isinstance(value, float) and value.is_integer() else value
    if isinstance(whole, bool) or not isinstance(whole, int):
        raise BodyError(f"{name} is no whole number")
    return _numbers([whole], base, name)[0].item()


def _numbers(values: Any, base: str, name: str) -> Any:
    """An array of numbers; BodyError for what does not fit."""
    dtype = np.dtype("uint8" if base in ("byte", "char") else base)
    try:
        if isinstance(values, bytes):
            return np.frombuffer(values, dtype=np.uint8).copy()
        if dtype.kind == "f":
            if any(type(value) not in (int, float) for value in values):
                raise BodyError(f"{name} has what is no {base}")
            with np.errstate(over="ignore"):  # what becomes infinite is refused
                floats = np.array(values, dtype=np.float64).astype(dtype)
            if not np.isfinite(floats).all():
                raise BodyError(f"{name} has what does not fit into {base}")
            return floats
        wide = np.array(values, dtype=object if dtype.itemsize == 8 else np.int64)
        if any(type(value) is not int and not (base == "bool" and type(value) is bool) for value in values):
            raise BodyError(f"{name} has what is no {base}")
        if len(values) and not _fits(wide, dtype):
            raise BodyError(f"{name} has what does not fit into {base}")
        return wide.astype(dtype)
    except (ValueError, TypeError, OverflowError) as error:
        raise BodyError(f"{name} has what is no {base}: {ros_types.one_line(error)}") from None


def _fits(numbers: "np.ndarray[Any, Any]", dtype: "np.dtype[Any]") -> bool:
    if dtype.kind == "b":
        return bool(numbers.min() >= 0 and numbers.max() <= 1)
    bounds = np.iinfo(dtype)
    return bool(numbers.min() >= bounds.min and numbers.max() <= bounds.max)


def _no_number(text: str) -> float:
    raise ValueError(f"{text} is no number in JSON")


def _decoded(text: str, name: str) -> bytes:
    """Bytes that came as base64, as browsers write them."""
    try:
        return base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError):
        raise BodyError(f"{name} is neither a list of numbers nor base64") from None
