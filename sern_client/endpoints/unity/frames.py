"""Bytes of a scene cut into frames, and frames for it. No I/O.

    u32 length | destination | u32 length | body        little-endian, both ways

A destination is the name of a topic or service, or a command where it begins with `__`; an empty one is a keep-alive.
In ROS 2 mode the texts that come from Unity end with a NUL byte, which counts in their length. What goes to Unity has
none: it compares `__handshake` and names byte for byte.
"""

from collections.abc import Iterator
from enum import Enum, auto
from struct import Struct
from typing import Final, NamedTuple

from sern_core.vocabulary.errors import WireError

MAX_DESTINATION_BYTES: Final = 1024
"""Names of topics have 255 at most."""
MAX_COMMAND_BYTES: Final = 16 * 1024
MAX_LENGTH: Final = 2**31 - 1
"""Unity's lengths are signed: more would be less than nothing there."""
COMMAND_PREFIX: Final = "__"
KEEP_ALIVE: Final = bytes(8)

_LENGTH: Final = Struct("<I")


class Frame(NamedTuple):
    destination: str
    body: bytes


class TooLarge(NamedTuple):
    """A message above the limit, told when its length is known; its bytes are read over."""

    destination: str
    nbytes: int


class _Stage(Enum):
    DESTINATION_LENGTH = auto()
    DESTINATION = auto()
    BODY_LENGTH = auto()
    BODY = auto()
    SKIPPED = auto()


class FrameReader:
    """Takes the bytes of one connection in any pieces. It keeps what it has of one frame, and nothing for a length that
    was only announced."""

    def __init__(self, max_body_bytes: int) -> None:
        self._max_body_bytes = max_body_bytes
        self._buffer = bytearray()
        self._at = 0
        self._stage = _Stage.DESTINATION_LENGTH
        self._need = _LENGTH.size
        self._destination = ""

    @property
    def kept_bytes(self) -> int:
        """What waits for the rest of its frame."""
        return len(self._buffer) - self._at

    def feed(self, data: bytes) -> Iterator[Frame | TooLarge]:
        """The frames that are whole with these bytes; to be read to the end before more bytes are fed.

        WireError for bytes that are no frame: nothing after them can be read.
        """
        self._buffer += data
        while True:
            there = len(self._buffer) - self._at
            if self._stage is _Stage.SKIPPED:
                over = min(there, self._need)
                self._at += over
                self._need -= over
                if self._need:
                    break
                self._expect(_Stage.DESTINATION_LENGTH, _LENGTH.size)
                continue
            if there < self._need:
                break
            part = bytes(memoryview(self._buffer)[self._at : self._at + self._need])
            self._at += self._need
            found = self._take(part)
            if found is not None:
                yield found
        del self._buffer[: self._at]
        self._at = 0

    def _expect(self, stage: _Stage, need: int) -> None:
        self._stage = stage
        self._need = need

    def _take(self, part: bytes) -> Frame | TooLarge | None:
        if self._stage is _Stage.DESTINATION_LENGTH:
            (length,) = _LENGTH.unpack(part)
            if length > MAX_DESTINATION_BYTES:
                raise WireError(f"a destination of {length} bytes, {MAX_DESTINATION_BYTES} are the most")
            self._expect(_Stage.DESTINATION, length)
            return None
        if self._stage is _Stage.DESTINATION:
            try:
                self._destination = part.decode().rstrip("\0")
            except UnicodeDecodeError:
                raise WireError("a destination that is not UTF-8") from None
            self._expect(_Stage.BODY_LENGTH, _LENGTH.size)
            return None
        if self._stage is _Stage.BODY_LENGTH:
            (length,) = _LENGTH.unpack(part)
            return self._announced(length)
        self._expect(_Stage.DESTINATION_LENGTH, _LENGTH.size)
        return Frame(self._destination, part)

    def _announced(self, length: int) -> TooLarge | None:
        """The length of a body is known."""
        if self._destination.startswith(COMMAND_PREFIX) and length > MAX_COMMAND_BYTES:
            raise WireError(f"a command of {length} bytes, {MAX_COMMAND_BYTES} are the most")
        if length > MAX_LENGTH:
            raise WireError(f"a message of {length} bytes, which is less than none in Unity's numbers")
        if length > self._max_body_bytes:
            self._expect(_Stage.SKIPPED, length)
            return TooLarge(self._destination, length)
        self._expect(_Stage.BODY, length)
        return None


def frame(destination: str, body: bytes) -> tuple[bytes, bytes]:
    """A frame for Unity in two pieces, of which the second is the body itself."""
    name = destination.encode()
    return _LENGTH.pack(len(name)) + name + _LENGTH.pack(len(body)), body
