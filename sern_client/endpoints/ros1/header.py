"""The TCPROS connection header (wiki.ros.org/ROS/Connection%20Header): both sides send one before any message.

      0      3 4        7
     +--------+----------+---------------------+-------------------
     | length | field    | name=value          | next field ...
     | u32 LE | length   |                     |
     +--------+----------+---------------------+-------------------

`length` counts everything after itself. A field's name ends at the first `=`; its value is any text.
"""

import struct
from collections.abc import Mapping
from typing import Final

from sern_core.vocabulary.errors import WireError

MAX_HEADER_BYTES: Final = 1_200_000
"""The longest accepted definition text (1 MiB) and the other fields; what a stranger may make us hold."""
MAX_FIELDS: Final = 64
SHOWN_CHARS: Final = 200
"""How much of a field is shown in a log, an error or a list: any text can be in it."""

BRIDGE_FIELD: Final = "sern_bridge"
"""This field stands in our headers, with the node's name as its value. What comes from such a publisher or server came
over a link already, and no SERN endpoint offers it to a link again. Other nodes ignore fields they do not know."""

_LENGTH: Final = struct.Struct("<I")


def encode_header(fields: Mapping[str, str]) -> bytes:
    """The header with its length in front."""
    parts: list[bytes] = []
    for name, value in fields.items():
        field = f"{name}={value}".encode()
        parts += (_LENGTH.pack(len(field)), field)
    body = b"".join(parts)
    return _LENGTH.pack(len(body)) + body


def decode_header(body: bytes) -> dict[str, str]:
    """The fields of a header without its length. Text that is no UTF-8 is read as far as it goes (old definitions have
    comments in other character sets). WireError for anything that is no header."""
    fields: dict[str, str] = {}
    at = 0
    while at < len(body):
        if at + 4 > len(body):
            raise WireError(f"connection header: {len(body) - at} bytes left over")
        (size,) = _LENGTH.unpack_from(body, at)
        at += 4
        if size > len(body) - at:
            raise WireError(f"connection header: a field of {size} bytes, {len(body) - at} are left")
        name, separator, value = body[at : at + size].partition(b"=")
        if not separator or not name:
            raise WireError("connection header: a field without a name")
        fields[name.decode("utf-8", "replace")] = value.decode("utf-8", "replace")
        at += size
        if len(fields) > MAX_FIELDS:
            raise WireError(f"connection header: more than {MAX_FIELDS} fields")
    return fields


def shown(fields: Mapping[str, str], name: str, default: str = "") -> str:
    """A field as it is shown: no more than its first `SHOWN_CHARS` characters."""
    return fields.get(name, default)[:SHOWN_CHARS]


def check_lengths(fields: Mapping[str, str], *names: str) -> None:
    """WireError where one of these fields is longer than any type or hash of ROS."""
    for name in names:
        if (length := len(fields.get(name, ""))) > SHOWN_CHARS:
            raise WireError(f"its {name} has {length} characters")
