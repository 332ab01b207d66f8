"""Frames of ROS-TCP-Connector (Unity Technologies, 0.7.0), without a socket.

    | length | destination | length | body |        lengths u32, little-endian

A destination is the name of a topic or service, or `__` and a command, whose body is JSON. Neither a destination nor a
body: a sign of life. Unity writes its strings of ROS 2 with a NUL at the end.
"""

import json
import struct
from collections.abc import Iterator, Mapping
from enum import StrEnum
from typing import Any, Final, NamedTuple

from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.types import Encoding

VERSION: Final = "v0.7.0"
"""What the connector is told; it warns where it is another than its own."""
MAX_DESTINATION_BYTES: Final = 1024
MAX_COMMAND_BYTES: Final = 64 * 2**10
COMMAND: Final = "__"
_LENGTH: Final = struct.Struct("<I")


class Command(StrEnum):
    """What a scene may ask for."""

    SUBSCRIBE = "__subscribe"
    PUBLISH = "__publish"
    USE_SERVICE = "__ros_service"
    OFFER_SERVICE = "__unity_service"
    REQUEST = "__request"
    RESPONSE = "__response"
    TOPIC_LIST = "__topic_list"
    REMOVE_SUBSCRIBER = "__remove_subscriber"
    REMOVE_PUBLISHER = "__remove_publisher"
    REMOVE_USED_SERVICE = "__remove_ros_service"
    REMOVE_OFFERED_SERVICE = "__remove_unity_service"


class Frame(NamedTuple):
    destination: str
    body: bytes

    @property
    def alive(self) -> bool:
        """It says nothing but that the scene is there."""
        return not self.destination and not self.body


class Frames:
    """What has come of a connection. WireError: it cannot be gone on with."""

    def __init__(self, max_message_bytes: int) -> None:
        self._max_bytes = max_message_bytes
        self._data = bytearray()

    @property
    def nbytes(self) -> int:
        """What is held of a frame that is not whole."""
        return len(self._data)

    def feed(self, data: bytes) -> Iterator[Frame]:
        """The frames that are whole with what has come now."""
        self._data += data
        at = 0
        try:
            while (found := self._frame(at)) is not None:
                frame, at = found
                yield frame
        finally:
            del self._data[:at]

    def _frame(self, at: int) -> tuple[Frame, int] | None:
        """The next frame and where it ends; None: it is not whole yet. A length is looked at before what it is of has
        come: what nobody may send is not waited for."""
        name = self._part(at, "destination", MAX_DESTINATION_BYTES)
        if name is None:
            return None
        body = self._part(name[1], "message", self._max_bytes)
        if body is None:
            return None
        try:
            destination = bytes(self._data[name[0] : name[1]]).decode().rstrip("\0")
        except UnicodeDecodeError:
            raise WireError("a destination that is no UTF-8") from None
        return Frame(destination, bytes(self._data[body[0] : body[1]])), body[1]

    def _part(self, at: int, what: str, most_bytes: int) -> tuple[int, int] | None:
        begin = at + _LENGTH.size
        if len(self._data) < begin:
            return None
        nbytes = _LENGTH.unpack_from(self._data, at)[0]
        if nbytes > most_bytes:
            raise WireError(f"a {what} of {nbytes} bytes; {most_bytes} are the most")
        return None if len(self._data) < begin + nbytes else (begin, begin + nbytes)


def frame(destination: str, body: bytes) -> bytes:
    """A frame for a scene."""
    name = destination.encode()
    return b"".join((_LENGTH.pack(len(name)), name, _LENGTH.pack(len(body)), body))


ALIVE: Final = frame("", b"")


def command(name: str, **parameters: Any) -> bytes:
    """A command for a scene."""
    return frame(f"{COMMAND}{name}", json.dumps(parameters).encode())


def handshake(encoding: Encoding) -> bytes:
    """What a scene is told first: our version, and of which ROS bodies are."""
    protocol = "ROS2" if encoding is Encoding.CDR else "ROS1"
    return command("handshake", version=VERSION, metadata=json.dumps({"protocol": protocol}))


def parameters_of(body: bytes) -> Mapping[str, Any]:
    """The parameters of a scene's command. WireError: there are none that can be read."""
    if len(body) > MAX_COMMAND_BYTES:
        raise WireError(f"a command of {len(body)} bytes; {MAX_COMMAND_BYTES} are the most")
    try:
        said = json.loads(body.rstrip(b"\0") or b"{}")
    except (ValueError, RecursionError):
        raise WireError("a command that is no JSON") from None
    if not isinstance(said, dict):
        raise WireError("a command that is no JSON object")
    return said


def text_of(said: Mapping[str, Any], key: str) -> str:
    """A text among parameters. WireError: there is none."""
    value = said.get(key)
    if not isinstance(value, str) or not value:
        raise WireError(f"a command without the text {key!r}")
    return value


def number_of(said: Mapping[str, Any], key: str) -> int:
    """A whole number among parameters. WireError: there is none."""
    value = said.get(key)
    if not isinstance(value, int) or isinstance(value, bool):
        raise WireError(f"a command without the number {key!r}")
    return value
