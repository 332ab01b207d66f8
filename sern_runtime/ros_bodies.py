"""Bodies in one pass over their bytes: from ROS 1 to CDR and back, and with texts in them changed, at a bounded price.

A body is walked field by field as its type says. What has a fixed layout is copied whole, sequences of numbers and of
messages without padding too, so that a walk takes half a microsecond for each text and each group of fields, and none
for a point or a pixel. These steps are counted before they are done: a count in a body may claim four thousand million
messages that have no bytes, and a compressed body of a kilobyte may hold a million that have some. Above MAX_STEPS the
body is refused. No code is generated, so a type costs nothing before its first body and little then. The steps of a
type in another are among those of the other, so that a definition of a kilobyte could claim a million of them: they are
counted as they are made, and above MAX_PLAN_STEPS the type is refused.

    ROS 1     little endian, no padding, text without a terminator, Header begins with `seq`
    CDR       numbers aligned to their size, text with a terminator, a message without fields is one byte
"""

from collections.abc import Callable, Sequence
from functools import lru_cache
from struct import Struct, error
from typing import Final, NamedTuple

from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import FieldDesc, Typesdict

from sern_core.vocabulary.errors import BodyError, ConfigError
from sern_core.vocabulary.types import Encoding
from sern_runtime.ros_types import ResolvedType

MAX_STEPS: Final = 24_000
"""Texts and groups of fields in one body: about 8 ms. A path of 4800 poses, or as many transforms."""

MAX_PLAN_STEPS: Final = 5_000
"""Steps in all plans of the types that a type uses: some milliseconds. All types of a ROS distribution together have
less than 2000."""
PLANS: Final = 128
"""Plans that are kept for the next stream of their type."""

_HEADER: Final = "std_msgs/msg/Header"
_FILLER: Final = "structure_needs_at_least_one_member"
_SIZES: Final = {
    "bool": 1, "byte": 1, "char": 1, "int8": 1, "uint8": 1, "int16": 2, "uint16": 2, "int32": 4, "uint32": 4,
    "int64": 8, "uint64": 8, "float32": 4, "float64": 8,
}  # fmt: skip
_CDR_HEAD_BYTES: Final = 4
_CDR_SPARE_BYTES: Final = 3
_PADDING: Final = [bytes(count) for count in range(8)]
_U32: Final = {"<": Struct("<I"), ">": Struct(">I")}
_TOO_SHORT: Final = "it ends inside a field"

_GROUP, _TEXT, _NUMBERS, _MANY, _SEQ, _NOTHING = range(6)


class _Op(NamedTuple):
    """One step: a group of fields without padding between them, a text, a sequence of numbers, messages one after the
    other (`many` of them, -1: as many as the body says), `seq` of a ROS 1 Header, or a message without fields."""

    kind: int
    size: int = 0  # bytes of a group or a number
    align: int = 1
    frame: bool = False  # the text is a frame id
    only_cdr: bool = False  # the field does not exist in ROS 1: zero on the way there, left out on the way back
    bound: int = 0  # of a sequence in ROS 2
    name: str = ""  # of a sequence
    many: int = 0
    ops: "tuple[_Op, ...]" = ()
    steps: int = 1  # of one of the messages


class Plan(NamedTuple):
    """How the bodies of a type are walked. `has_frames`: there are frame ids in it."""

    type_name: str
    ops: tuple[_Op, ...]
    has_frames: bool


def plan_of(target: ResolvedType, *, ros1: ResolvedType | None = None, one_by_one: bool = False) -> Plan:
    """`plan` of a type that is resolved, made once for all streams of it. ConfigError, which is found out once, too."""
    found = _planned(target, ros1, one_by_one)
    if isinstance(found, str):
        raise ConfigError(found)
    return found


@lru_cache(maxsize=PLANS)
def _planned(target: ResolvedType, ros1: ResolvedType | None, one_by_one: bool) -> Plan | str:
    other = None if ros1 is None else ros1.store.fielddefs
    try:
        return plan(target.name, target.store.fielddefs, ros1=other, one_by_one=one_by_one)
    except ConfigError as error:
        return str(error)


def plan(type_name: str, fielddefs: Typesdict, *, ros1: Typesdict | None = None, one_by_one: bool = False) -> Plan:
    """The plan of a type whose fields, and those of the types it uses, are in `fielddefs` of either encoding.

    `ros1`: `fielddefs` is of CDR, and fields may be missing here. `one_by_one`: messages without padding between them
    are steps of their own, for whoever only counts. ConfigError for a field of a kind that does not exist in both, and
    for more than MAX_PLAN_STEPS.
    """
    planner = _Planner(fielddefs, ros1, one_by_one)
    ops = planner.ops_of(type_name)
    return Plan(type_name, ops, any(op.frame for ops in planner.known.values() for op in ops))


def convert(plan: Plan, body: bytes, source: Encoding, target: Encoding) -> bytes:
    """A body in the other encoding; `seq` of Headers is 0 where it comes to be. BodyError when the bytes are no
    message of the type, are big endian, or have too many parts."""
    walk = _Walk(plan, body, source, target, None)
    if walk.order != "<":
        raise BodyError("big endian bodies are not converted by copying")
    return walk.run()


def rewrite(plan: Plan, body: bytes, encoding: Encoding, change: Callable[[str], str]) -> bytes:
    """The body with its frame ids changed; the same object when none is. BodyError as `convert`."""
    walk = _Walk(plan, body, encoding, encoding, change)
    out = walk.run()
    return out if walk.changed else body


def check_steps(plan: Plan, body: bytes, encoding: Encoding, at_most: int) -> None:
    """BodyError for a body that has more steps, or is none of the type."""
    _Walk(plan, body, encoding, encoding, None, at_most).run()


class _Planner:
    """Makes the steps of types."""

    def __init__(self, fielddefs: Typesdict, ros1: Typesdict | None, one_by_one: bool) -> None:
        self.known: dict[str, tuple[_Op, ...]] = {}
        self._fielddefs = fielddefs
        self._ros1 = ros1
        self._one_by_one = one_by_one
        self._left = MAX_PLAN_STEPS

    def ops_of(self, name: str) -> tuple[_Op, ...]:
        if name not in self.known:
            if name not in self._fielddefs:
                raise ConfigError(f"type {name} is unknown here")
            fields = self._fielddefs[name][1]
            there = None
            if self._ros1 is not None and name in self._ros1:
                there = {field.lower() for field, _ in self._ros1[name][1]}
            ops: list[_Op] = [_Op(_SEQ)] if name == _HEADER else []
            for field, desc in fields:
                if name == _HEADER and field == "seq":
                    continue
                own = self._field(name, field, desc)
                self._left -= len(own)
                if self._left < 0:
                    raise ConfigError(f"type {name} has too many parts in each other: over {MAX_PLAN_STEPS}")
                if there is not None and field.lower() not in there and field != _FILLER:
                    own = [op._replace(only_cdr=True) for op in own]
                for op in own:
                    _append(ops, op)
            if not fields or fields[0][0] == _FILLER:
                ops = [_Op(_NOTHING)]
            self.known[name] = tuple(ops)
        return self.known[name]

    def _field(self, owner: str, field: str, desc: FieldDesc) -> Sequence[_Op]:
        """What walks one field."""
        if desc[0] == Nodetype.NAME:
            return self.ops_of(str(desc[1]))
        if desc[0] == Nodetype.BASE:
            if desc[1][0] == "string":
                frame = field == "child_frame_id" or (field == "frame_id" and owner == _HEADER)
                return [_Op(_TEXT, frame=frame)]
            size = _size(owner, field, str(desc[1][0]))
            return [_Op(_GROUP, size, size)]
        item, count = desc[1]
        fixed = desc[0] == Nodetype.ARRAY
        bound = 0 if fixed else int(count)
        if item[0] == Nodetype.NAME:
            inner = self.ops_of(str(item[1]))
            block = inner[0] if len(inner) == 1 and inner[0].kind == _GROUP and not self._one_by_one else None
            if not fixed and block is not None and block.size % block.align == 0:
                return [_Op(_NUMBERS, block.size, block.align, bound=bound, name=field)]
        elif item[1][0] == "string":
            inner = (_Op(_TEXT),)
        else:
            size = _size(owner, field, str(item[1][0]))
            if not fixed:
                return [_Op(_NUMBERS, size, size, bound=bound, name=field)]
            return [_Op(_GROUP, size * int(count), size)] if count else []
        if fixed and not count:
            return []
        steps = 1 + sum(map(_steps, inner))
        return [_Op(_MANY, bound=bound, name=field, many=int(count) if fixed else -1, ops=inner, steps=steps)]


def _append(ops: list[_Op], op: _Op) -> None:
    before = ops[-1] if ops else None
    if (
        before is not None
        and before.kind == op.kind == _GROUP
        and before.only_cdr == op.only_cdr
        and op.align <= before.align
        and before.size % op.align == 0
    ):
        ops[-1] = before._replace(size=before.size + op.size)
    else:
        ops.append(op)


def _steps(op: _Op) -> int:
    return 1 + op.many * op.steps if op.kind == _MANY and op.many > 0 else 1


def _size(owner: str, field: str, base: str) -> int:
    size = _SIZES.get(base)
    if size is None:
        raise ConfigError(f"type {owner}: {field} is a {base}, which cannot be read")
    return size


class _Walk:
    """One pass over one body. In CDR positions count from behind its four bytes."""

    __slots__ = ("_at", "_change", "_left", "_out", "_plan", "_size", "_source_cdr", "_target_cdr", "_u32", "_view",
                 "changed", "order")  # fmt: skip

    def __init__(
        self,
        plan: Plan,
        body: bytes,
        source: Encoding,
        target: Encoding,
        change: Callable[[str], str] | None,
        steps: int = MAX_STEPS,
    ) -> None:
        self._plan = plan
        self._source_cdr = source is Encoding.CDR
        self._target_cdr = target is Encoding.CDR
        self._change = change
        self._left = steps - len(plan.ops)
        self._at = 0
        self._size = 0  # what is written
        self._out: list[bytes | memoryview] = []
        self._view = memoryview(body)
        self.order = "<"
        self.changed = False
        if self._source_cdr:
            if len(body) < _CDR_HEAD_BYTES or body[0] != 0 or body[1] > 1:
                raise self._problem("it has no CDR head")
            self.order = "<" if body[1] else ">"
            self._view = self._view[_CDR_HEAD_BYTES:]
        if self._target_cdr:
            self._out.append(body[:_CDR_HEAD_BYTES] if self._source_cdr else b"\0\1\0\0")
        self._u32 = _U32[self.order]

    def run(self) -> bytes:
        try:
            self._do(self._plan.ops)
        except error:
            raise self._problem(_TOO_SHORT) from None
        left = len(self._view) - self._at
        if left < 0 or left > (_CDR_SPARE_BYTES if self._source_cdr else 0):
            raise self._problem(f"{left} bytes are left over" if left > 0 else _TOO_SHORT)
        return b"".join(self._out)

    def _do(self, ops: tuple[_Op, ...]) -> None:
        for op in ops:
            kind = op.kind
            if op.only_cdr and self._source_cdr is not self._target_cdr:
                self._only_cdr(op)
            elif kind == _GROUP:
                self._copy(op.size, op.align)
            elif kind == _TEXT:
                self._text(op.frame)
            elif kind == _NUMBERS:
                count = self._count(op)
                if count:
                    self._copy(count * op.size, op.align)
            elif kind == _MANY:
                count = op.many if op.many > 0 else self._count(op)
                self._left -= count * op.steps
                if self._left < 0:
                    raise self._problem("it has too many parts")
                for _ in range(count):
                    self._do(op.ops)
            elif kind == _SEQ:
                if not self._source_cdr:
                    seq = self._view[self._at : self._at + 4]
                    self._at += 4
                else:
                    seq = _NO_SEQ
                if not self._target_cdr:
                    self._out.append(seq)
                    self._size += 4
            else:
                self._at += self._source_cdr
                if self._target_cdr:
                    self._out.append(b"\0")
                    self._size += 1

    def _copy(self, size: int, align: int) -> None:
        at = self._at
        if self._source_cdr:
            at += -at % align
        end = at + size
        if end > len(self._view):
            raise self._problem(_TOO_SHORT)
        if self._target_cdr:
            padding = -self._size % align
            if padding:
                self._out.append(_PADDING[padding])
                size += padding
        self._out.append(self._view[at:end])
        self._size += size
        self._at = end

    def _only_cdr(self, op: _Op) -> None:
        """A field that ROS 1 does not have."""
        if self._source_cdr:
            written = len(self._out), self._size
            self._do((op._replace(only_cdr=False),))
            del self._out[written[0] :]
            self._size = written[1]
            return
        zeros = op.size if op.kind == _GROUP else 0 if op.kind == _SEQ else 1 if op.kind == _NOTHING else 4
        if zeros:
            padding = -self._size % (op.align if op.kind == _GROUP else zeros)
            text = op.kind == _TEXT
            self._out.append(bytes(padding) + (b"\1\0\0\0\0" if text else bytes(zeros)))
            self._size += padding + zeros + text

    def _count(self, op: _Op) -> int:
        """A number of elements, which goes on as it is."""
        at = self._at
        if self._source_cdr:
            at += -at % 4
        count: int = self._u32.unpack_from(self._view, at)[0]
        self._copy(4, 4)
        if op.bound and count > op.bound and not self._source_cdr and self._target_cdr:
            raise self._problem(f"{op.name} has {count} elements, ROS 2 allows {op.bound}")
        return count

    def _text(self, frame: bool) -> None:
        at = self._at
        if self._source_cdr:
            at += -at % 4
        size: int = self._u32.unpack_from(self._view, at)[0]
        at += 4
        end = at + size
        self._at = end
        view = self._view
        if end > len(view):
            raise self._problem(_TOO_SHORT)
        if self._source_cdr:
            if not size or view[end - 1]:
                raise self._problem("a text has no end")
            end -= 1
        text: bytes | memoryview = view[at:end]
        if frame and self._change is not None:
            before = bytes(text).decode("utf-8", "surrogateescape")
            after = self._change(before)
            if after != before:
                text = after.encode("utf-8", "surrogateescape")
                self.changed = True
        size = len(text)
        out = self._out
        if self._target_cdr:
            padding = -self._size % 4
            if padding:
                out.append(_PADDING[padding])
            out.append(self._u32.pack(size + 1))
            out.append(text)
            out.append(b"\0")
            self._size += padding + 5 + size
        else:
            out.append(self._u32.pack(size))
            out.append(text)
            self._size += 4 + size

    def _problem(self, what: str) -> BodyError:
        return BodyError(what)


_NO_SEQ: Final = memoryview(bytes(4))
