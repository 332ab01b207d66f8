"""Types as Foxglove wants them: `pkg/Name` and `ros1msg`, or `pkg/msg/Name` and `ros2msg` or `ros2idl`.

A definition is the same text in both worlds: the type itself, then each type it uses below a line of 80 `=` and
`MSG: package/Name`. What differs is the name of a ROS 1 type, the mark of IDL, and headings with three parts.
"""

import re
from typing import Final, NamedTuple

from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_services, ros_text, ros_types
from sern_runtime.ros_types import ResolvedType

_IDL: Final = f"{ros_text.SEPARATOR}\nIDL: "
_HEADING: Final = re.compile(r"^MSG: (\w+)/(?:msg|srv|action)/(\w+)[ \t\r]*$", re.MULTILINE)
SCHEMA_ENCODINGS: Final = {Encoding.ROS1: "ros1msg", Encoding.CDR: "ros2msg"}


class Described(NamedTuple):
    """What a viewer is told of a type. `text` empty: nobody knows its definition, so nobody can read its messages."""

    name: str
    schema_encoding: str
    text: bytes


def of_topic(info: TopicInfo) -> Described:
    """ConfigError for what no viewer can be told of: raw bodies, or a type without a proper name."""
    if info.encoding is Encoding.RAW:
        raise ConfigError(f"{info.name}: raw bodies cannot be shown; only ros1 and cdr can")
    definition = info.definition
    if not definition:
        known = ros_types.describe(info.type_name, info.encoding)
        definition = "" if known is None else known.definition
    return _described(info.type_name, info.encoding, definition)


def of_service(type_name: str, definition: str, encoding: Encoding) -> tuple[str, Described, Described]:
    """Name, request and response of a service type. ConfigError where it is not known."""
    if encoding is Encoding.RAW:
        raise ConfigError(f"{type_name}: raw requests cannot be made by viewers")
    found = ros_services.resolve(type_name, definition, encoding)
    name = ros_types.ros1_name(found.name) if encoding is Encoding.ROS1 else found.name
    return name, _half(found.request), _half(found.response)


def _half(part: ResolvedType) -> Described:
    return _described(part.name, part.encoding, part.text.definition)


def _described(type_name: str, encoding: Encoding, definition: str) -> Described:
    name = ros_types.ros1_name(type_name) if encoding is Encoding.ROS1 else ros_types.canonical(type_name)
    schema_encoding = "ros2idl" if definition.startswith(_IDL) else SCHEMA_ENCODINGS[encoding]
    return Described(name, schema_encoding, _HEADING.sub(r"MSG: \1/\2", definition).encode(errors="replace"))
