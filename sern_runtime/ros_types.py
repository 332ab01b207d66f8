"""The one place that knows ROS message types: names, definitions, hashes, and (de)serialising where it is needed.

Bodies pass through the daemon unread. What is needed of a type is its name, its definition text and its hash, so that
the far side can advertise it; only the simulated robot, the operator stand-in and the command lease build or read
messages. Two typestores serve that: ROS 1 Noetic and ROS 2 Jazzy, both with `tf2_msgs` and `map_msgs`.

`type_name` is always the three-part form `nav_msgs/msg/Odometry`. A definition is the concatenated text that bags and
connection headers carry: the type itself, then every type it uses below a line of 80 `=` and `MSG: package/Name`.
"""

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, lru_cache
from hashlib import md5
from typing import Any, Final, NamedTuple

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import BaseDesc, Basetype, Fielddefs, FieldDesc, NameDesc, Typesdict
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_idl, get_typestore
from rosbags.typesys.base import normalize_fieldname
from rosbags.typesys.store import Typestore

from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import ros_text

MAX_IDL_TEXT: Final = 2**16
MAX_IDL_CHARACTERS: Final = 3_000
MAX_IDL_ARRAYS: Final = 4
"""An IDL text above the first, or without comments, annotations and constants above the others, is refused: its parser
takes 5 µs a character and 1.5 ms a constant expression. .msg texts have the limits of `ros_text`."""
MAX_GENERATED_FIELDS: Final = 300
MAX_GENERATED_TYPES: Final = 8
"""Custom types, and fields in all of them, for which code is generated at once: 4 ms a type and 0.1 ms a field. Only
what is read value by value needs code (actions, simulated robots, big endian bodies): nothing else has the limit."""

_SEPARATOR: Final = ros_text.SEPARATOR
_IDL_MARK: Final = f"{_SEPARATOR}\nIDL: "
_IDL_UNREAD: Final = re.compile(
    r"""//[^\n]*|/\*.*?\*/|\#[^\n]*|@\w+(?:\s*\((?:"(?:\\.|[^"\\])*"|[^()"])*\))?"""
    r"""|\bconst\s(?:"(?:\\.|[^"\\])*"|[^;"])*;""",
    re.DOTALL,
)
_IDL_CONSTANTS: Final = re.compile(r"\bmodule\s+\w+_Constants\s*\{\s*\}\s*;")
_NAME: Final = re.compile(r"[A-Za-z]\w*/(?:(?:msg|srv|action)/)?[A-Za-z]\w*", re.ASCII)
_EXTRA: Final = {
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms\n",
    "map_msgs/msg/OccupancyGridUpdate": (
        "std_msgs/Header header\nint32 x\nint32 y\nuint32 width\nuint32 height\nint8[] data\n"
    ),
}
_ROS1_BUILTIN: Final = frozenset(
    {"bool", "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64"}
    | {"float32", "float64", "string", "time", "duration", "char", "byte"}
)
NO_FIELD: Final = "structure_needs_at_least_one_member"
"""What ROS 2 puts into a type without fields, because IDL has no empty structs; ROS 1 sends nothing for it."""
_NO_FIELDS: Final[Fielddefs] = [(NO_FIELD, (Nodetype.BASE, ("uint8", 0)))]
_ONE_BYTE: Final = frozenset({"byte", "char", "int8", "uint8"})
_BY_VALUE: Final = frozenset(
    {"sensor_msgs/msg/Range", "shape_msgs/msg/SolidPrimitive", "visualization_msgs/msg/Marker"}
)
"""Types that ROS 2 extended: what only one side has is zero on the way there and lost on the way back."""
_STOPPABLE: Final = frozenset({"geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"})


class TypeText(NamedTuple):
    """What a publisher must say of its type: the definition text and the hash (ROS 1 md5sum or RIHS01)."""

    definition: str
    type_hash: str


class ResolvedType(NamedTuple):
    """A type that can be read and written: the store that holds it, and what a publisher must say of it."""

    name: str
    encoding: Encoding
    store: Typestore
    text: TypeText


class Counterpart(NamedTuple):
    """The same type in the other encoding. `same_layout`: bodies differ only in how they are serialised, so they can
    be converted without reading them; otherwise field by field."""

    type: ResolvedType
    same_layout: bool


def canonical(type_name: str) -> str:
    """`nav_msgs/Odometry` or `nav_msgs/msg/Odometry` -> `nav_msgs/msg/Odometry`. ConfigError for anything else."""
    if not _NAME.fullmatch(type_name):
        raise ConfigError(f"{type_name!r} is not a message type; write it like nav_msgs/msg/Odometry")
    package, *kind, name = type_name.split("/")
    return f"{package}/{kind[0] if kind else 'msg'}/{name}"


def ros1_name(type_name: str) -> str:
    """`nav_msgs/msg/Odometry` -> `nav_msgs/Odometry`, the form ROS 1 uses on the wire and in bags."""
    package, _, name = canonical(type_name).split("/")
    return f"{package}/{name}"


@cache
def typestore(encoding: Encoding) -> Typestore:
    """The shared typestore of an encoding: ROS 1 Noetic or ROS 2 Jazzy. ConfigError for `raw`."""
    if encoding is Encoding.RAW:
        raise ConfigError("raw bodies have no ROS type; use encoding ros1 or cdr")
    store = get_typestore(Stores.ROS1_NOETIC if encoding is Encoding.ROS1 else Stores.ROS2_JAZZY)
    for name, text in _EXTRA.items():
        if name not in store.fielddefs:
            store.register(ros_text.parse(name, text))
    return store


def load() -> None:
    """Read both typestores now. They take 50 ms each, which no message of a peer may take from everyone else."""
    typestore(Encoding.ROS1)
    typestore(Encoding.CDR)


@lru_cache(maxsize=1024)
def describe(type_name: str, encoding: Encoding) -> TypeText | None:
    """Definition and hash of a type the typestore knows; None for one it does not."""
    store = typestore(encoding)
    name = canonical(type_name)
    if name not in store.fielddefs:
        return None
    if encoding is Encoding.ROS1:
        return TypeText(*store.generate_msgdef(name, ros_version=1))
    return TypeText(store.generate_msgdef(name, ros_version=2)[0], rihs01(store, name))


def topic_info(
    name: str, type_name: str, encoding: Encoding, *, latched: bool = False, reliable: bool | None = None
) -> TopicInfo:
    """A `TopicInfo` with definition and hash filled in. ConfigError for a type the typestore does not know."""
    text = describe(type_name, encoding)
    if text is None:
        raise ConfigError(f"{name}: type {type_name} is unknown here; its definition must come with the topic")
    return TopicInfo(
        TopicName(name), canonical(type_name), encoding, text.type_hash, text.definition, latched, reliable
    )


@lru_cache(maxsize=1024)
def hash_of(type_name: str, definition: str, encoding: Encoding) -> str:
    """The hash that belongs to a definition text: md5sum (ROS 1) or RIHS01.

    Only parses; nothing is registered. ConfigError when the text cannot be read as a definition of this type.
    """
    name = canonical(type_name)
    types = _parse(name, definition)
    with _documented(f"type {name}: its definition uses a type it does not define"):
        if encoding is Encoding.ROS1:
            return md5(ros1_md5_text(name, definition).encode(), usedforsecurity=False).hexdigest()
        # rosbag2 texts may leave out types that every ROS 2 install has.
        return rihs01_of({**typestore(Encoding.CDR).fielddefs, **types}, name)


def register(type_name: str, definition: str, encoding: Encoding) -> None:
    """Make a type usable with `serialise` and `deserialise`, from the definition text that came with its topic.

    ConfigError when the text cannot be parsed, or names a known type with other fields (both hashes are named).
    """
    name = canonical(type_name)
    store = typestore(encoding)
    types = {key: value for key, value in _parse(name, definition).items() if key not in store.fielddefs}
    if name not in types:
        known = describe(name, encoding)
        offered = hash_of(name, definition, encoding)
        if known is not None and known.type_hash != offered:
            raise ConfigError(f"type {name}: offered hash {offered} differs from the known {known.type_hash}")
        return
    _check_generated(name, types)
    with _documented(f"type {name}"):
        store.register(types)
    describe.cache_clear()


@lru_cache(maxsize=512)
def resolve(type_name: str, definition: str, encoding: Encoding) -> ResolvedType:
    """A type as its definition text has it, or as it is known here when the text is empty.

    Two versions of a type do not get in each other's way: one that differs from the known type has a store of its own.
    ConfigError when there is no definition, or it cannot be read.
    """
    name = canonical(type_name)
    shared = typestore(encoding)
    if not definition:
        text = describe(name, encoding)
        if text is None:
            raise ConfigError(f"type {name} is unknown here, and its definition did not come with it")
        return ResolvedType(name, encoding, shared, text)
    text = TypeText(definition, hash_of(name, definition, encoding))
    types = _parse(name, definition)
    with _documented(f"type {name}: its definition uses a type it does not define"):
        return ResolvedType(name, encoding, _store_with(name, types, shared), text)


@lru_cache(maxsize=512)
def counterpart(type_name: str, definition: str, encoding: Encoding) -> Counterpart:
    """The type of the other encoding (ROS 1 for CDR, CDR for ROS 1) that stands for this one.

    A type that is known there is taken from there and must have the same fields; `_BY_VALUE` are the known exceptions.
    Any other is made up from the definition: fields of the same names (lower case in ROS 2, which allows no other)
    and without bounds in ROS 1, which has none. ConfigError when that does not work out.
    """
    source = resolve(type_name, definition, encoding)
    other = Encoding.CDR if encoding is Encoding.ROS1 else Encoding.ROS1
    shared = typestore(other)
    made: Typesdict = {}
    same_layout = True
    for name in used_by(source.name, source.store.fielddefs):
        fields = source.store.fielddefs[name]
        if name in shared.fielddefs:
            same_layout &= _same_layout(name, fields[1], shared.fielddefs[name][1], other)
        else:
            made[name] = (fields[0], _translated(name, fields[1], other))
    with _documented(f"type {source.name} cannot be converted to {other}"):
        store = _store_with(source.name, made, shared)
        definition, md5sum = store.generate_msgdef(source.name, ros_version=1 if other is Encoding.ROS1 else 2)
        type_hash = md5sum if other is Encoding.ROS1 else rihs01(store, source.name)
    return Counterpart(ResolvedType(source.name, other, store, TypeText(definition, type_hash)), same_layout)


class _OwnStore(Typestore):
    """A type that is known nowhere, and what it uses. Its code is generated when a message is first made or read:
    most are only named and hashed."""

    def __init__(self, name: str, made: Typesdict, shared: Typestore) -> None:
        super().__init__()
        known = {**shared.fielddefs, **made}
        other = {key for key in made if key not in shared.fielddefs or shared.fielddefs[key][1] != made[key][1]}
        # What is the same all through is taken from there: definitions often come with all that they use.
        made = {key: value for key, value in made.items() if not other.isdisjoint(used_by(key, known))}
        used = used_by(name, known)
        self.fielddefs = {used_name: known[used_name] for used_name in used}
        made = {used_name: known[used_name] for used_name in used if used_name in made}
        self.types = _Generated(
            name, made, {used_name: shared.types[used_name] for used_name in used if used_name not in made}
        )


class _Generated(dict[str, Any]):
    """Classes of messages by type; those of `made` come to be when one of them is asked for. ConfigError then."""

    def __init__(self, name: str, made: Typesdict, known: dict[str, Any]) -> None:
        super().__init__(known)
        self._name = name
        self._made = made

    def __missing__(self, key: str) -> Any:
        if key not in self._made:
            raise KeyError(key)
        _check_generated(self._name, self._made)
        scratch = Typestore()
        with _documented(f"type {self._name}"):
            scratch.register(self._made)
        self.update(scratch.types)
        return self[key]


def _check_generated(name: str, types: Typesdict) -> None:
    """ConfigError for types whose code would take long to generate."""
    fields = sum(len(fields) for _, fields in types.values())
    for count, limit, what in (
        (fields, MAX_GENERATED_FIELDS, "fields"),
        (len(types), MAX_GENERATED_TYPES, "types"),
    ):
        if count > limit:
            raise ConfigError(f"type {name} is not read here: {count} {what} in all, up to {limit} are read")


def _store_with(name: str, types: Typesdict, shared: Typestore) -> Typestore:
    """`shared` where it has these types or none of them is given, else a store of their own on top of it."""
    if all(key in shared.fielddefs and shared.fielddefs[key][1] == types[key][1] for key in types):
        return shared
    return _OwnStore(name, types, shared)


@contextmanager
def _documented(problem: str) -> Iterator[None]:
    """Any exception inside becomes a ConfigError: what a peer's definition may make of code that was not written for
    it cannot be listed."""
    try:
        yield
    except ConfigError:
        raise
    except Exception as error:  # noqa: BLE001
        raise ConfigError(f"{problem}: {one_line(error)}") from None


def used_by(type_name: str, fielddefs: Typesdict) -> list[str]:
    """A type and every type it uses, each once, itself first."""
    found = {type_name: None}
    order = [type_name]
    for name in order:
        for used in uses(fielddefs[name][1]):
            if used not in found:
                found[used] = None
                order.append(used)
    return order


def uses(fields: Fielddefs) -> list[str]:
    """The types that fields have, each once."""
    found: dict[str, None] = {}
    for _, desc in fields:
        inner = desc[1][0] if desc[0] in {Nodetype.ARRAY, Nodetype.SEQUENCE} else desc
        if inner[0] == Nodetype.NAME:
            found[str(inner[1])] = None
    return list(found)


def _same_layout(name: str, mine: Fielddefs, theirs: Fielddefs, other: Encoding) -> bool:
    """Whether the fields of one type follow each other alike in both. ConfigError when it cannot be converted."""
    ours = [(key.lower(), _layout(desc)) for key, desc in mine if (name, key) != ("std_msgs/msg/Header", "seq")]
    known = [(key.lower(), _layout(desc)) for key, desc in theirs if (name, key) != ("std_msgs/msg/Header", "seq")]
    if ours == known:
        return True
    if name in _BY_VALUE:
        return False
    odd = sorted({key for key, _ in set(ours) ^ set(known)}) or [key for key, _ in ours]
    raise ConfigError(
        f"type {name} cannot be converted: its {other} version known here differs in {', '.join(odd[:5])}; "
        "both sides need the same fields"
    )


def _layout(desc: FieldDesc) -> tuple[object, ...]:
    """A field's type without what does not show in its bytes: bounds, and the sign of a byte."""
    if desc[0] == Nodetype.BASE:
        base = str(desc[1][0])
        return ("uint8" if base in _ONE_BYTE else base,)
    if desc[0] == Nodetype.NAME:
        return (str(desc[1]),)
    return (desc[0], _layout(desc[1][0]), desc[1][1] if desc[0] == Nodetype.ARRAY else 0)


def _translated(name: str, fields: Fielddefs, other: Encoding) -> Fielddefs:
    """The fields of a type that only one side has, as the other side would write them."""
    if other is Encoding.ROS1:
        odd = [key for key, desc in fields if "float128" in repr(desc)]
        if odd:
            raise ConfigError(f"type {name} cannot be converted to ros1: no float128 there ({odd[0]})")
        return [(key, _each_base(desc, lambda base: (base[0], 0), bounds=False)) for key, desc in fields]
    if len({key.lower() for key, _ in fields}) != len(fields):
        raise ConfigError(f"type {name} cannot be converted to cdr: two of its fields differ in case only")
    return [(key.lower(), desc) for key, desc in fields]


def _each_base(desc: FieldDesc, change: Callable[[Basetype], Basetype], *, bounds: bool = True) -> FieldDesc:
    """A field's type with its base type changed, and with or without the bound of a sequence."""
    if desc[0] == Nodetype.BASE:
        return (Nodetype.BASE, change(desc[1]))
    if desc[0] == Nodetype.NAME:
        return desc
    inner, size = desc[1]
    item: BaseDesc | NameDesc = inner if inner[0] == Nodetype.NAME else (Nodetype.BASE, change(inner[1]))
    if desc[0] == Nodetype.ARRAY:
        return (Nodetype.ARRAY, (item, size))
    return (Nodetype.SEQUENCE, (item, size if bounds else 0))


def rihs01(store: Typestore, type_name: str) -> str:
    """The RIHS01 hash (REP 2011). ROS 2 makes uint8 of a .msg's `char` before it hashes, the typestore does not."""
    return rihs01_of(store.fielddefs, type_name)


def rihs01_of(fielddefs: Typesdict, type_name: str) -> str:
    """The RIHS01 hash as in `rihs01`, for types that are in no store."""
    scratch = get_typestore(Stores.EMPTY)
    for name in used_by(type_name, fielddefs):
        constants, fields = fielddefs[name]
        scratch.fielddefs[name] = (constants, [(key, _each_base(desc, _char_as_uint8)) for key, desc in fields])
    return scratch.hash_rihs01(type_name)


def _char_as_uint8(base: Basetype) -> Basetype:
    return ("uint8", 0) if base[0] == "char" else base


def serialise(message: object, type_name: str, encoding: Encoding) -> bytes:
    """Message object -> body."""
    store = typestore(encoding)
    if encoding is Encoding.ROS1:
        return bytes(store.serialize_ros1(message, type_name))
    return bytes(store.serialize_cdr(message, type_name))


def deserialise(body: bytes, type_name: str, encoding: Encoding) -> Any:
    """Body -> message object with the type's fields as attributes. ConfigError when the bytes do not fit the type."""
    store = typestore(encoding)
    if type_name not in store.fielddefs:
        raise ConfigError(f"type {type_name} is unknown here; register its definition first")
    try:
        if encoding is Encoding.ROS1:
            return store.deserialize_ros1(body, type_name)
        return store.deserialize_cdr(body, type_name)
    except (SerdeError, AssertionError, IndexError) as error:
        raise ConfigError(f"type {type_name}: {len(body)} bytes do not decode: {one_line(error)}") from None


def new(type_name: str, encoding: Encoding, /, **fields: Any) -> Any:
    """A message object of this type, zero in every field but those given by name. UsageError for an unknown field."""
    return new_in(typestore(encoding), type_name, **fields)


def new_in(store: Typestore, type_name: str, /, **fields: Any) -> Any:
    """Make a message as `new` does, of a type in any typestore."""
    definition = store.fielddefs[type_name][1]
    if fields and not fields.keys() <= {name for name, _ in definition}:
        raise UsageError(f"{type_name} has no field {sorted(fields.keys() - {name for name, _ in definition})}")
    values = {attribute(name): fields[name] if name in fields else zero(desc, store) for name, desc in definition}
    return store.types[type_name](**values)


def attribute(field: str) -> str:
    """What a field is called in message objects: a Python keyword gets an underscore."""
    return normalize_fieldname(field)


def time_of(stamp_ns: int, encoding: Encoding) -> Any:
    """A builtin_interfaces/Time (ROS 1 `time`)."""
    return new("builtin_interfaces/msg/Time", encoding, sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)


def header(stamp_ns: int, frame_id: str, encoding: Encoding, seq: int = 0) -> Any:
    """A std_msgs/Header; `seq` exists in ROS 1 only."""
    fields: dict[str, Any] = {"stamp": time_of(stamp_ns, encoding), "frame_id": frame_id}
    if encoding is Encoding.ROS1:
        fields["seq"] = seq
    return new("std_msgs/msg/Header", encoding, **fields)


def zero_message(type_name: str, encoding: Encoding) -> bytes | None:
    """The body that stops a robot: an all-zero Twist or TwistStamped. None for types where zero is no safe command."""
    name = canonical(type_name)
    if name not in _STOPPABLE or encoding is Encoding.RAW:
        return None
    return serialise(new(name, encoding), name, encoding)


def zero(desc: FieldDesc, store: Typestore) -> Any:
    """The zero of one field: number, string, message, numpy array of numbers, or list of strings or messages."""
    if desc[0] == Nodetype.BASE:
        base = str(desc[1][0])
        return "" if base == "string" else False if base == "bool" else 0.0 if base.startswith("float") else 0
    if desc[0] == Nodetype.NAME:
        return new_in(store, str(desc[1]))
    item, count = desc[1]
    length = int(count) if desc[0] == Nodetype.ARRAY else 0
    if item[0] == Nodetype.BASE and item[1][0] != "string":
        base = str(item[1][0])
        return np.zeros(length, dtype="uint8" if base in {"byte", "char"} else base)
    return [zero(item, store) for _ in range(length)]


def _parse(type_name: str, definition: str) -> Typesdict:
    """The types of a definition. ConfigError where it cannot be read, or not within the limits."""
    types = _parsed(type_name, definition)
    if isinstance(types, str):
        raise ConfigError(types)
    return types


@lru_cache(maxsize=64)
def _parsed(type_name: str, definition: str) -> Typesdict | str:
    """The types, or what is wrong: that, too, is found out once."""
    try:
        return _parse_anew(type_name, definition)
    except ConfigError as error:
        return str(error)


def _parse_anew(type_name: str, definition: str) -> Typesdict:
    if definition.startswith(_IDL_MARK):
        types = _parse_idl(type_name, definition)
    else:
        # A name alone in half of a service is of the package's messages.
        parsed = type_name.replace("/srv/", "/msg/")
        types = ros_text.parse(parsed, definition)
        types = {type_name if name == parsed else name: value for name, value in types.items()}
    types = {name: (constants, fields or _NO_FIELDS) for name, (constants, fields) in types.items()}
    ros_text.check_size(type_name, types)
    return types


def _parse_idl(type_name: str, definition: str) -> Typesdict:
    _text_within(type_name, len(definition), MAX_IDL_TEXT, "characters")
    bare = _IDL_CONSTANTS.sub("", _IDL_UNREAD.sub(" ", definition.replace("\r", "")))
    bare = re.sub(r"\s*\n\s*", "\n", bare)
    _text_within(type_name, len(bare), MAX_IDL_CHARACTERS, "characters of IDL")
    _text_within(type_name, bare.count("["), MAX_IDL_ARRAYS, "arrays in IDL")
    if "<<" in bare or type_name not in definition:
        raise ConfigError(f"type {type_name}: its definition cannot be parsed: this is not its IDL")
    types: Typesdict = {}
    with _documented(f"type {type_name}: its definition cannot be parsed"):
        for part in bare.split(f"{_SEPARATOR}\n")[1:]:
            types.update(get_types_from_idl(part.partition("\n")[2]))
    for _, fields in types.values():
        for key, desc in fields:
            if desc[0] == Nodetype.ARRAY:
                _text_within(type_name, int(desc[1][1]), ros_text.MAX_ARRAY, f"elements in {key}")
    if type_name not in types:
        raise ConfigError(
            f"type {type_name}: its definition cannot be parsed: it defines {', '.join(types) or 'nothing'}"
        )
    return types


def _text_within(type_name: str, value: int, limit: int, what: str) -> None:
    if value > limit:
        raise ConfigError(f"type {type_name}: its definition is too large: {value} {what}, up to {limit} are read")


def ros1_md5_text(type_name: str, definition: str) -> str:
    """What the ROS 1 md5sum of a type is taken of: constants as written, then fields, types by their own md5sum
    (wiki.ros.org/ROS/Technical%20Overview).

    Worked out from the text, not from the parsed types: a constant counts as it is spelt (`0x0F`, `1e-3`).
    """
    name = ros1_name(type_name)
    return _ros1_md5_text(name, ros_text.sections(name, definition), {})


def _ros1_md5_of(name: str, texts: dict[str, list[str]], sums: dict[str, str]) -> str:
    if name not in sums:
        sums[name] = md5(_ros1_md5_text(name, texts, sums).encode(), usedforsecurity=False).hexdigest()
    return sums[name]


def _ros1_md5_text(name: str, texts: dict[str, list[str]], sums: dict[str, str]) -> str:
    constants, fields = [], []
    for line in texts[name]:
        clean = line.partition("#")[0].strip()
        if not clean:
            continue
        base, _, rest = clean.partition(" ")
        if "=" in rest:
            # A string constant is the whole rest of its line, `#` included.
            source = line.strip().partition(" ")[2] if base == "string" else rest
            label, _, value = source.partition("=")
            constants.append(f"{base} {label.strip()}={value.strip()}")
            continue
        element = base.partition("[")[0]
        if element in _ROS1_BUILTIN:
            fields.append(f"{base} {rest.strip()}")
            continue
        if "/" not in element:
            element = "std_msgs/Header" if element == "Header" else f"{name.partition('/')[0]}/{element}"
        fields.append(f"{_ros1_md5_of(element, texts, sums)} {rest.strip()}")
    return "\n".join(constants + fields)


def one_line(error: BaseException) -> str:
    """The text of an error on one line of at most 160 characters; its class where it says nothing."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= 160 else text[:157] + "..."
