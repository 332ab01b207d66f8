"""Service types: request and response, each a type like any other (`pkg/srv/Name_Request`, `pkg/srv/Name_Response`).

A definition is the .srv text: request, a line of `---`, response; then, as with messages, every type that one of them
uses below a line of 80 `=` and `MSG: package/Name`. Services that every installation has need none.
"""

from functools import lru_cache
from hashlib import md5
from typing import Final, NamedTuple

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_types
from sern_runtime.ros_types import Counterpart, ResolvedType, TypeText

_SEPARATOR: Final = "=" * 80 + "\n"
_KNOWN: Final = {
    "action_msgs/srv/CancelGoal": (
        "action_msgs/GoalInfo goal_info\n---\nint8 ERROR_NONE=0\nint8 ERROR_REJECTED=1\nint8 ERROR_UNKNOWN_GOAL_ID=2\n"
        "int8 ERROR_GOAL_TERMINATED=3\nint8 return_code\naction_msgs/GoalInfo[] goals_canceling\n"
    ),
    "std_srvs/srv/Empty": "---\n",
    "std_srvs/srv/SetBool": "bool data\n---\nbool success\nstring message\n",
    "std_srvs/srv/Trigger": "---\nbool success\nstring message\n",
    "example_interfaces/srv/AddTwoInts": "int64 a\nint64 b\n---\nint64 sum\n",
    "nav_msgs/srv/GetMap": "---\nnav_msgs/OccupancyGrid map\n",
    "nav_msgs/srv/GetPlan": (
        "geometry_msgs/PoseStamped start\ngeometry_msgs/PoseStamped goal\nfloat32 tolerance\n---\nnav_msgs/Path plan\n"
    ),
    "sensor_msgs/srv/SetCameraInfo": ("sensor_msgs/CameraInfo camera_info\n---\nbool success\nstring status_message\n"),
    "rcl_interfaces/srv/GetParameters": "string[] names\n---\nrcl_interfaces/ParameterValue[] values\n",
    "rcl_interfaces/srv/ListParameters": (
        "uint64 DEPTH_RECURSIVE=0\nstring[] prefixes\nuint64 depth\n---\nrcl_interfaces/ListParametersResult result\n"
    ),
    "rcl_interfaces/srv/SetParameters": (
        "rcl_interfaces/Parameter[] parameters\n---\nrcl_interfaces/SetParametersResult[] results\n"
    ),
}


class ResolvedService(NamedTuple):
    """A service whose bodies can be read and written, and what its server must say of it."""

    name: str
    encoding: Encoding
    request: ResolvedType
    response: ResolvedType
    text: TypeText


class ServiceCounterpart(NamedTuple):
    """The same service in the other encoding."""

    request: Counterpart
    response: Counterpart
    text: TypeText


@lru_cache(maxsize=512)
def resolve(type_name: str, definition: str, encoding: Encoding) -> ResolvedService:
    """A service as its definition has it, or as it is known here when the text is empty.

    ConfigError when it is not known or cannot be read.
    """
    name = _canonical(type_name)
    request, response = (
        ros_types.resolve(name + part, text, encoding) for part, text in _halves(name, definition, encoding)
    )
    return ResolvedService(name, encoding, request, response, _text(name, encoding, request, response))


@lru_cache(maxsize=512)
def counterpart(type_name: str, definition: str, encoding: Encoding) -> ServiceCounterpart:
    """The service of the other encoding that stands for this one; ConfigError as `ros_types.counterpart`."""
    name = _canonical(type_name)
    request, response = (
        ros_types.counterpart(name + part, text, encoding) for part, text in _halves(name, definition, encoding)
    )
    text = _text(name, request.type.encoding, request.type, response.type)
    return ServiceCounterpart(request, response, text)


def _canonical(type_name: str) -> str:
    package, *kind, name = type_name.split("/")
    return ros_types.canonical(f"{package}/{'action' if kind == ['action'] else 'srv'}/{name}")


def _halves(name: str, definition: str, encoding: Encoding) -> list[tuple[str, str]]:
    """Suffix and definition text of request and response, each with all types that the service brings."""
    text = definition
    if not text:
        if name not in _KNOWN:
            raise ConfigError(
                f"service type {name} is unknown here, and its definition did not come with it; add the directory of "
                "its .srv file to type_paths of the ROS 2 endpoint"
            )
        text = _KNOWN[name]
    own, *others = text.split(_SEPARATOR)
    lines = own.splitlines()
    if lines.count("---") != 1:
        raise ConfigError(f"service type {name}: its definition needs one line of --- between request and response")
    middle = lines.index("---")
    halves = ("_Request", lines[:middle]), ("_Response", lines[middle + 1 :])
    below = others if definition else _known_below(name, [line for _, half in halves for line in half], encoding)
    sections = "".join(_SEPARATOR + section for section in below)
    # A type without fields still has a text: an empty one would stand for an unknown definition.
    return [(part, ("\n".join(half) + "\n") + sections) for part, half in halves]


def _known_below(name: str, lines: list[str], encoding: Encoding) -> list[str]:
    """The types that a service known here uses, as sections of a definition text."""
    below: dict[str, str] = {}
    for line in lines:
        used = line.split(" ")[0].partition("[")[0]
        if "/" not in used:
            continue
        text = ros_types.describe(used, encoding)
        if text is None:
            raise ConfigError(f"service type {name} does not exist in {encoding}: it uses {used}")
        first, *rest = text.definition.split(_SEPARATOR)
        for section in (f"MSG: {ros_types.ros1_name(used)}\n{first}", *rest):
            below.setdefault(section.partition("\n")[0], section)
    return list(below.values())


def _text(name: str, encoding: Encoding, request: ResolvedType, response: ResolvedType) -> TypeText:
    sections: dict[str, str] = {}
    halves = []
    for part in (request, response):
        first, *rest = part.text.definition.split(_SEPARATOR)
        halves.append(first.strip("\n") + "\n" if first.strip("\n") else "")
        for section in rest:
            sections.setdefault(section.partition("\n")[0], section)
    definition = "---\n".join(halves) + "".join(_SEPARATOR + section for section in sections.values())
    if encoding is Encoding.CDR:
        return TypeText(definition, _rihs01(name, request, response))
    both = "".join(ros_types.ros1_md5_text(part.name, part.text.definition) for part in (request, response))
    return TypeText(definition, md5(both.encode(), usedforsecurity=False).hexdigest())


def _rihs01(name: str, request: ResolvedType, response: ResolvedType) -> str:
    """REP 2011: a service is hashed as a type with its request, its response and the event that introspection sends."""
    scratch = get_typestore(Stores.EMPTY)
    scratch.fielddefs.update(ros_types.typestore(Encoding.CDR).fielddefs)
    for part in (request, response):
        scratch.fielddefs.update(part.store.fielddefs)
    scratch.fielddefs[f"{name}_Event"] = (
        [],
        [
            ("info", (Nodetype.NAME, "service_msgs/msg/ServiceEventInfo")),
            ("request", (Nodetype.SEQUENCE, ((Nodetype.NAME, request.name), 1))),
            ("response", (Nodetype.SEQUENCE, ((Nodetype.NAME, response.name), 1))),
        ],
    )
    scratch.fielddefs[name] = (
        [],
        [
            ("request_message", (Nodetype.NAME, request.name)),
            ("response_message", (Nodetype.NAME, response.name)),
            ("event_message", (Nodetype.NAME, f"{name}_Event")),
        ],
    )
    return ros_types.rihs01(scratch, name)
