"""Which action of ROS 1 and which of ROS 2 stand for each other, and bodies from one to the other.

`P/NAction` of ROS 1 is the messages `P/NGoal`, `P/NResult` and `P/NFeedback`, each in one that adds header and goal id
or status. `P/action/N` of ROS 2 is the same three parts, in services and a topic. Two actions of one name correspond
when their parts have the same fields (as `ros_types.counterpart` has it). Two that are called otherwise, or have other
fields, correspond when PAIRS says so.
"""

from collections.abc import Generator, Iterable, Mapping
from dataclasses import dataclass
from hashlib import sha256
from struct import Struct
from typing import Final, NamedTuple

from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import FieldDesc, Typesdict

from sern_client.action_conversion.bodies import UUID_BYTES
from sern_client.endpoints.conversion import Convert, body_converter
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_text, ros_types
from sern_runtime.ros_files import TypeFiles
from sern_runtime.ros_types import Counterpart, ResolvedType, TypeText

PARTS: Final = ("goal", "result", "feedback")
MAX_STEPS: Final = 2_000
"""Fields in a body whose fields change places: 1 ms."""

Fields = tuple[tuple[str, str], ...]
"""Fields that stand for each other, ROS 1's first."""


@dataclass(frozen=True, slots=True)
class Pair:
    """Two actions that mean the same and do not look alike.

    `ros1`: PACKAGE/NAME, without `Action`; `ros2`: PACKAGE/action/NAME. `definition`: the .action text of ROS 1, which
    no robot sends whole. A field that none of `goal`, `result` and `feedback` names is left out where it was, and zero
    where it comes to be.
    """

    ros1: str
    ros2: str
    definition: str
    goal: Fields = ()
    result: Fields = ()
    feedback: Fields = ()

    def fields(self, part: str) -> Fields:
        return {"goal": self.goal, "result": self.result, "feedback": self.feedback}[part]


PAIRS: Final = (
    Pair(
        "move_base_msgs/MoveBase",
        "nav2_msgs/action/NavigateToPose",
        "geometry_msgs/PoseStamped target_pose\n---\n---\ngeometry_msgs/PoseStamped base_position\n",
        goal=(("target_pose", "pose"),),
        feedback=(("base_position", "current_pose"),),
    ),
)
"""Add one for two actions that users have on the two sides. What is in ROS 2 alone may differ among distributions."""

_BELOW: Final = ros_text.SEPARATOR + "\nMSG: "
_AROUND: Final = {
    "goal": "std_msgs/Header header\nactionlib_msgs/GoalID goal_id\n",
    "result": "std_msgs/Header header\nactionlib_msgs/GoalStatus status\n",
    "feedback": "std_msgs/Header header\nactionlib_msgs/GoalStatus status\n",
}
"""What a message of ROS 1 has before its own part."""
_BEFORE: Final = {"goal": ("uint8[16] goal_id\n", UUID_BYTES), "feedback": ("uint8[16] goal_id\n", UUID_BYTES)}
_BEFORE_RESULT: Final = ("int8 status\n", 1)
"""What a body of ROS 2 has before its own part, and how many bytes that is."""
_SIZES: Final = {
    "bool": 1, "byte": 1, "char": 1, "int8": 1, "uint8": 1, "int16": 2, "uint16": 2, "int32": 4, "uint32": 4,
    "int64": 8, "uint64": 8, "float32": 4, "float64": 8, "string": 4,
}  # fmt: skip
_LENGTH: Final = Struct("<I")
_FILLER: Final = "structure_needs_at_least_one_member"


class Names(NamedTuple):
    """Two actions that stand for each other; `pair` None: by their name."""

    ros1: str
    ros2: str
    pair: Pair | None

    def __str__(self) -> str:
        return f"{self.ros1} of ROS 1 and {self.ros2}"


def names_of_ros1(action: str, pairs: Iterable[Pair] = PAIRS) -> Names:
    """The action of ROS 2 that stands for PACKAGE/NAME."""
    pair = next((pair for pair in pairs if pair.ros1 == action), None)
    package, _, name = action.partition("/")
    return Names(action, f"{package}/action/{name}" if pair is None else pair.ros2, pair)


def names_of_ros2(action: str, pairs: Iterable[Pair] = PAIRS) -> Names:
    """The action of ROS 1 that stands for PACKAGE/action/NAME."""
    pair = next((pair for pair in pairs if pair.ros2 == action), None)
    return Names(action.replace("/action/", "/", 1) if pair is None else pair.ros1, action, pair)


def ros1_action(type_name: str, part: str) -> str | None:
    """`P/msg/NActionGoal` -> `P/N`, for one of PARTS; None for the type of anything else."""
    package, _, name = type_name.partition("/msg/")
    end = f"Action{part.capitalize()}"
    return f"{package}/{name.removesuffix(end)}" if package and name.endswith(end) and name != end else None


def ros2_action(type_name: str, end: str) -> str | None:
    """`P/action/N_SendGoal` -> `P/action/N`, for that end; None for the type of anything else."""
    action = type_name.removesuffix(f"_{end}")
    return action if action != type_name and action.count("/") == 2 and "/action/" in action else None


# Definitions ----------------------------------------------------------------------------------------------------------


def ros1_text(action: str, part: str, type_name: str, definition: str) -> str:
    """The definition of one part, from that of the topic it is in. ConfigError where it is not there."""
    package, _, name = action.partition("/")
    return _section(type_name, definition, f"{package}/{name}{part.capitalize()}")


def ros2_text(action: str, part: str, type_name: str, definition: str) -> str:
    """The same from the definition of the service or topic of ROS 2 that it is in."""
    return _section(type_name, definition, f"{action}_{part.capitalize()}")


def ros2_texts(action: str, files: Iterable[TypeFiles]) -> dict[str, str] | None:
    """The definitions of all parts as the nearest of `files` has them; None where it is in none. ConfigError for files
    that cannot be read."""
    for each in files:
        found = {part: each.message(f"{action}_{part.capitalize()}") for part in PARTS}
        texts = {part: text for part, text in found.items() if text is not None}
        if len(texts) == len(PARTS):
            return texts
    return None


def _section(owner: str, definition: str, wanted: str) -> str:
    """A type in a definition, with all others that come with it."""
    sections = ros_text.sections(owner, definition)
    lines = sections.get(wanted)
    if lines is None or wanted == owner:
        raise ConfigError(f"the definition of {owner} does not have {wanted} in it")
    below = [
        f"{_BELOW}{name}\n" + "\n".join(text).rstrip("\n") + "\n"
        for name, text in sections.items()
        if name not in (owner, wanted)
    ]
    return "\n".join(lines).rstrip("\n") + "\n" + "".join(below)


def _complete(type_name: str, text: str) -> str:
    """A text with the definitions of the types that it uses, which are known in ROS 1."""
    below: dict[str, str] = {}
    for used in ros_types.uses(ros_text.parse(type_name, text)[type_name][1]):
        known = ros_types.describe(used, Encoding.ROS1)
        if known is None:
            raise ConfigError(f"type {type_name} uses {used}, which is not known here")
        first, *rest = known.definition.split(_BELOW)
        for section in (f"{ros_types.ros1_name(used)}\n{first}", *rest):
            below.setdefault(section.partition("\n")[0], section)
    return text + "".join(_BELOW + section for section in below.values())


# Bodies ---------------------------------------------------------------------------------------------------------------


class Part:
    """Goal, result or feedback of an action in both worlds.

    `ros1` is the type in ROS 1. A body of ROS 2 is that of the service or topic: the part, and before it the UUID of
    the goal, or, of a result, its status. Bodies of ROS 1 are those of the part alone.
    """

    def __init__(self, names: Names, part: str, ros2: str, ros1: str | None) -> None:
        """`ros2`: its definition there; `ros1`: that of ROS 1, where it is known. ConfigError in one line where they do
        not correspond."""
        self._before_bytes = _BEFORE.get(part, _BEFORE_RESULT)[1]
        own, sent, text = _sent(names, part, ros2)
        there = ros_types.resolve(sent, text, Encoding.CDR)
        here = ros_types.counterpart(sent, text, Encoding.CDR)
        self._to_ros1 = body_converter(there, here)
        self._to_ros2 = body_converter(here.type, Counterpart(there, here.same_layout))
        # The part is in there, so it is known to the same store.
        inner = here.type._replace(name=own, text=TypeText(*here.type.store.generate_msgdef(own, ros_version=1)))
        package, name = names.ros1.split("/")
        own = f"{package}/msg/{name}{part.capitalize()}"
        self._inward: Convert | None = None
        self._outward: Convert | None = None
        if names.pair is not None:
            text = ros1 or _complete(own, names.pair.definition.split("---\n")[PARTS.index(part)] or "\n")
            self.ros1 = ros_types.resolve(own, text, Encoding.ROS1)
            fields = names.pair.fields(part)
            self._outward = _by_field(self.ros1, inner, fields)
            self._inward = _by_field(inner, self.ros1, tuple((theirs, ours) for ours, theirs in fields))
        elif ros1 is not None:
            self.ros1 = ros_types.resolve(own, ros1, Encoding.ROS1)
            self.check(self.ros1, inner)
        else:
            self.ros1 = inner
        self._name = f"{package}/msg/{name}Action{part.capitalize()}"
        self._part = part

    @staticmethod
    def check(ours: ResolvedType, theirs: ResolvedType) -> None:
        """ConfigError where two types of ROS 1 do not have the same fields."""
        odd = _differing(ours, theirs)
        if odd:
            raise ConfigError(f"{ours.name} and its like in the other ROS differ in {', '.join(odd[:5])}")

    @property
    def topic(self) -> tuple[str, TypeText]:
        """Name and definition of the message of ROS 1 that has it in it."""
        own = ros_types.ros1_name(self.ros1.name)
        before, *below = _complete(self._name, _AROUND[self._part]).split(_BELOW)
        known = {section.partition("\n")[0] for section in below}
        first, *rest = self.ros1.text.definition.split(_BELOW)
        rest = [section for section in rest if section.partition("\n")[0] not in known]
        text = f"{before}{own} {self._part}\n"
        text += "".join(_BELOW + section for section in (*below, f"{own}\n{first}", *rest))
        return self._name, TypeText(text, ros_types.hash_of(self._name, text, Encoding.ROS1))

    def to_ros2(self, before: bytes, body: bytes) -> bytes:
        """ConfigError for bytes that are no message of the type."""
        if self._outward is not None:
            body = self._outward(body)
        return self._to_ros2(before + body)

    def to_ros1(self, body: bytes) -> tuple[bytes, bytes]:
        """What is before it, and the body of ROS 1. Raises as `to_ros2`."""
        whole = self._to_ros1(body)
        before, own = whole[: self._before_bytes], whole[self._before_bytes :]
        return before, own if self._inward is None else self._inward(own)

    @property
    def zero(self) -> bytes:
        """The body of ROS 1 in which nothing is said."""
        return _zero((Nodetype.NAME, self.ros1.name), self.ros1.store.fielddefs)


class ActionTypes(NamedTuple):
    """The three parts of two actions that stand for each other."""

    names: Names
    goal: Part
    result: Part
    feedback: Part

    def no_result(self, status: int) -> bytes:
        """The answer of `get_result` with this status and nothing in it."""
        return self.result.to_ros2(bytes((status,)), self.result.zero)


def in_steps(names: Names, ros2: Mapping[str, str], ros1: Mapping[str, str]) -> Generator[None, None, ActionTypes]:
    """The types, from definitions by part: all in `ros2`, those that are known in `ros1`. They may be a peer's, and as
    large as it likes, so what is done with them is done in steps of some milliseconds. ConfigError in one line where
    the actions do not correspond."""
    parts = []
    for part in PARTS:
        _, sent, text = _sent(names, part, ros2[part])
        for read in (ros_types.resolve, ros_types.counterpart):
            read(sent, text, Encoding.CDR)  # both keep what they have found
            yield
        parts.append(Part(names, part, ros2[part], ros1.get(part)))
        yield
    return ActionTypes(names, *parts)


def action_types(names: Names, ros2: Mapping[str, str], ros1: Mapping[str, str]) -> ActionTypes:
    """The types, as `in_steps` makes them, at once."""
    steps = in_steps(names, ros2, ros1)
    while True:
        try:
            next(steps)
        except StopIteration as done:
            types: ActionTypes = done.value
            return types


def _sent(names: Names, part: str, ros2: str) -> tuple[str, str, str]:
    """What a part is called here as a type, and the name and definition of a body of ROS 2 that has it in it."""
    package, name = names.ros2.split("/action/")
    own = f"{package}/msg/{name}{part.capitalize()}"
    before, _ = _BEFORE.get(part, _BEFORE_RESULT)
    short = ros_types.ros1_name(own)
    return own, f"{own}Sent", f"{before}{short} {part}\n{_BELOW}{short}\n{ros2}"


def _by_field(source: ResolvedType, target: ResolvedType, fields: Fields) -> Convert:
    """Bodies of one type of ROS 1 made of those of another, of which some fields stand for each other."""
    mine = dict(source.store.fielddefs[source.name][1])
    theirs = {key: desc for key, desc in target.store.fielddefs[target.name][1] if key != _FILLER}
    odd = [ours for ours, other in fields if ours not in mine or other not in theirs]
    here, there = source.store.fielddefs, target.store.fielddefs
    odd = odd or [ours for ours, other in fields if _shape(mine[ours], here) != _shape(theirs[other], there)]
    if odd:
        raise ConfigError(f"{source.name} cannot be made into {target.name}: {', '.join(odd)} is not what is expected")
    zeros = {other: _zero(desc, there) for other, desc in theirs.items()}
    taken = {other: ours for ours, other in fields}

    def convert(body: bytes) -> bytes:
        found = _fields(source, body)
        return b"".join(found[taken[other]] if other in taken else zeros[other] for other in theirs)

    return convert


def _fields(source: ResolvedType, body: bytes) -> dict[str, bytes]:
    """The bytes of each field. In ROS 1 they are the same wherever a field is. ConfigError for bytes that are no
    message of the type, and for one with more than MAX_STEPS parts."""
    fielddefs = source.store.fielddefs
    left = MAX_STEPS
    at = 0

    def walk(desc: FieldDesc) -> None:
        nonlocal at, left
        left -= 1
        if left < 0:
            raise ConfigError(f"type {source.name}: {len(body)} bytes have too many parts")
        if desc[0] == Nodetype.BASE:
            base = str(desc[1][0])
            at += _count(body, at) if base == "string" else 0
            at += _SIZES[base]
        elif desc[0] == Nodetype.NAME:
            for key, inner in fielddefs[str(desc[1])][1]:
                if key != _FILLER:
                    walk(inner)
        else:
            item, count = desc[1]
            if desc[0] == Nodetype.SEQUENCE:
                count = _count(body, at)
                at += 4
            if item[0] == Nodetype.BASE and item[1][0] != "string":
                at += int(count) * _SIZES[str(item[1][0])]
                return
            for _ in range(int(count)):
                walk(item)

    found = {}
    for key, desc in fielddefs[source.name][1]:
        begin = at
        if key != _FILLER:
            walk(desc)
        found[key] = body[begin:at]
    if at != len(body):
        raise ConfigError(f"type {source.name}: {len(body)} bytes are none")
    return found


def _count(body: bytes, at: int) -> int:
    """The number there; nothing where the body has ended, which is found out at its end."""
    return int(_LENGTH.unpack_from(body, at)[0]) if at + 4 <= len(body) else 0


def _differing(ours: ResolvedType, theirs: ResolvedType) -> list[str]:
    """The fields of a type that are not alike in another."""
    mine, other = (
        [(key.lower(), _shape(desc, each.store.fielddefs)) for key, desc in each.store.fielddefs[each.name][1]]
        for each in (ours, theirs)
    )
    if mine == other:
        return []
    return sorted({key for key, _ in mine} ^ {key for key, _ in other}) or [
        key for (key, shape), (_, like) in zip(mine, other, strict=True) if shape != like
    ] or [key for key, _ in mine]  # fmt: skip


def _shape(desc: FieldDesc, fielddefs: Typesdict) -> str:
    """What a field is made of, down to the numbers, without bounds and the sign of a byte; a digest of it for a type,
    which may have others in it many times."""
    known: dict[str, str] = {}

    def of(desc: FieldDesc) -> str:
        if desc[0] == Nodetype.BASE:
            base = str(desc[1][0])
            return "uint8" if _SIZES.get(base) == 1 and base != "bool" else base
        if desc[0] == Nodetype.NAME:
            name = str(desc[1])
            if name not in known:
                fields = ",".join(f"{key.lower()} {of(inner)}" for key, inner in fielddefs[name][1])
                known[name] = sha256(fields.encode()).hexdigest()
            return known[name]
        return f"{of(desc[1][0])}[{desc[1][1] if desc[0] == Nodetype.ARRAY else ''}]"

    return of(desc)


def _zero(desc: FieldDesc, fielddefs: Typesdict) -> bytes:
    """The bytes of ROS 1 in which everything is zero or empty."""
    own: dict[str, bytes] = {}

    def of(desc: FieldDesc) -> bytes:
        if desc[0] == Nodetype.BASE:
            return bytes(_SIZES[str(desc[1][0])])
        if desc[0] == Nodetype.NAME:
            used = str(desc[1])
            if used not in own:
                own[used] = b"".join(of(inner) for key, inner in fielddefs[used][1] if key != _FILLER)
            return own[used]
        item, count = desc[1]
        return of(item) * int(count) if desc[0] == Nodetype.ARRAY else bytes(4)

    return of(desc)
