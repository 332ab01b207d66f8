"""Frames of RFC 6455, as far as whoever stands between a viewer and the server must know them.

`Heard` reads what a viewer sends, byte for byte as it comes, and refuses what is no frame before anybody else sees it.
`Said` cuts what the server sends into whole frames, so that one of them can be left out.
"""

import json
import struct
from collections.abc import Iterator
from enum import StrEnum
from typing import Any, Final, NamedTuple

MAX_TEXT_BYTES: Final = 1 << 20
"""The longest thing that a viewer may say in JSON: a list of 20,000 subscriptions."""
MAX_BINARY_BYTES: Final = 16 << 20
"""The longest message that a viewer may publish, and the longest request of a call."""
MESSAGE_DATA: Final = 1
CALL: Final = 2
PLAYBACK: Final = 3
"""The first byte of what a viewer sends in binary frames."""
TEXT, BINARY = 1, 2
_MESSAGE: Final = struct.Struct("<BIQ")
_CONTINUATION, _CLOSE, _PING, _PONG = 0, 8, 9, 10
_DATA_OPCODES: Final = frozenset({_CONTINUATION, TEXT, BINARY})
_OPCODES: Final = _DATA_OPCODES | {_CLOSE, _PING, _PONG}
_MAX_CONTROL_BYTES: Final = 125
_OPS: Final = frozenset(
    {
        "subscribe", "unsubscribe", "advertise", "unadvertise", "getParameters", "setParameters",
        "subscribeParameterUpdates", "unsubscribeParameterUpdates", "subscribeConnectionGraph",
        "unsubscribeConnectionGraph", "fetchAsset",
    }
)  # fmt: skip
PROTOCOL_ERROR, NOT_TEXT, TOO_BIG, AGAIN_LATER = 1002, 1007, 1009, 1013
"""Codes with which a connection is closed (RFC 6455, 7.4.1)."""


class Fault(StrEnum):
    """What was wrong with something that a viewer sent. Closed: it is a metric label."""

    FRAME = "frame"  # no frame of RFC 6455
    SIZE = "size"  # larger than is taken
    CONTENT = "content"  # neither JSON nor binary as the protocol has it
    MESSAGE = "message"  # published, and of another layout than its type
    TYPE = "type"  # a topic of a type that is not known here
    TOPIC = "topic"  # a topic that may not be published, or not by this name
    SLOW = "slow"  # took nothing of what must not be left out


class FrameError(Exception):
    """A viewer sent what ends its connection. `code` is what it is told."""

    def __init__(self, fault: Fault, code: int, problem: str) -> None:
        super().__init__(problem)
        self.fault = fault
        self.code = code


class Spoken(NamedTuple):
    """A whole message in JSON, or the beginning of a binary one. `problem`: what is wrong with it; empty: nothing."""

    said: dict[str, Any]
    problem: str = ""


class Heard:
    """What a viewer sends: `feed` takes any pieces. FrameError ends it."""

    def __init__(self) -> None:
        self._header = bytearray()
        self._needed = 2
        self._left = 0  # of the payload of the frame under way
        self._done = 0
        self._mask = b""
        self._opcode = _CONTINUATION  # of this frame
        self._kind = _CONTINUATION  # of the message under way: text, binary, or none
        self._fin = True
        self._bytes = 0  # of the message so far
        self._text = bytearray()
        self._first: int | None = None  # byte of a binary message

    def feed(self, data: bytes) -> list[Spoken]:
        """The messages that are whole now."""
        found: list[Spoken] = []
        at = 0
        while True:
            if self._needed:
                taken = data[at : at + self._needed - len(self._header)]
                self._header += taken
                at += len(taken)
                if len(self._header) < self._needed:
                    return found
                self._read_header()
                continue
            piece = data[at : at + self._left]
            at += len(piece)
            self._take(piece)
            self._left -= len(piece)
            self._done += len(piece)
            if self._left:
                return found
            found += self._frame_ended()
            self._header.clear()
            self._needed = 2

    def _read_header(self) -> None:
        first, second = self._header[0], self._header[1]
        size = second & 0x7F
        extra = {126: 2, 127: 8}.get(size, 0)
        self._check_first(first, second, size)
        if len(self._header) < 2 + extra + 4:
            self._needed = 2 + extra + 4
            if len(self._header) < 2 + extra:
                return
        if extra:
            size = int.from_bytes(self._header[2 : 2 + extra], "big")
        if len(self._header) < self._needed:
            return
        self._needed = 0
        self._mask = bytes(self._header[-4:])
        self._left, self._done = size, 0
        if self._opcode in _DATA_OPCODES:
            self._bytes += size
            limit = MAX_TEXT_BYTES if self._kind == TEXT else MAX_BINARY_BYTES
            if self._bytes > limit:
                raise FrameError(Fault.SIZE, TOO_BIG, f"a message of {self._bytes} bytes; up to {limit} are taken")

    def _check_first(self, first: int, second: int, size: int) -> None:
        opcode, fin = first & 0x0F, bool(first & 0x80)
        if first & 0x70 or opcode not in _OPCODES or not second & 0x80:
            raise FrameError(Fault.FRAME, PROTOCOL_ERROR, f"no frame of a viewer begins with {first:02x} {second:02x}")
        if opcode not in _DATA_OPCODES and (not fin or size > _MAX_CONTROL_BYTES):
            raise FrameError(Fault.FRAME, PROTOCOL_ERROR, "a ping, pong or close that is too long, or in pieces")
        if len(self._header) > 2:
            return
        self._opcode = opcode
        if opcode not in _DATA_OPCODES:
            return
        if (opcode == _CONTINUATION) != (self._kind != _CONTINUATION):
            raise FrameError(Fault.FRAME, PROTOCOL_ERROR, "pieces of two messages mixed")
        self._fin = fin
        if opcode != _CONTINUATION:
            self._kind, self._bytes, self._first = opcode, 0, None
            self._text.clear()

    def _take(self, piece: bytes) -> None:
        if not piece or self._opcode not in _DATA_OPCODES:
            return
        if self._kind == TEXT:
            self._text += _unmasked(piece, self._mask, self._done)
        elif self._first is None:
            self._first = piece[0] ^ self._mask[self._done % 4]

    def _frame_ended(self) -> Iterator[Spoken]:
        if self._opcode not in _DATA_OPCODES or not self._fin:
            return
        kind, self._kind = self._kind, _CONTINUATION
        if kind == TEXT:
            text = bytes(self._text)
            self._text.clear()
            yield _spoken(text)
        elif self._first is not None and self._first not in (MESSAGE_DATA, CALL, PLAYBACK):
            yield Spoken({}, f"a binary message that begins with {self._first}")


def _unmasked(piece: bytes, mask: bytes, offset: int) -> bytes:
    turned = mask[offset % 4 :] + mask[: offset % 4]
    key = (turned * (len(piece) // 4 + 1))[: len(piece)]
    return (int.from_bytes(piece, "little") ^ int.from_bytes(key, "little")).to_bytes(len(piece), "little")


def _spoken(text: bytes) -> Spoken:
    try:
        said = json.loads(text.decode())
    except UnicodeDecodeError:
        raise FrameError(Fault.FRAME, NOT_TEXT, "a text that is no UTF-8") from None
    except (ValueError, RecursionError):
        return Spoken({}, "what is no JSON")
    if not isinstance(said, dict) or not isinstance(said.get("op"), str):
        return Spoken({}, "JSON without an op")
    if said["op"] not in _OPS:
        return Spoken({}, f"an op that is none, {said['op'][:40]!r}")
    return Spoken(said)


class Said:
    """What the server sends, cut into frames; their payloads are not masked."""

    def __init__(self) -> None:
        self._left = bytearray()  # the beginning of a frame

    def feed(self, data: bytes) -> list[bytes]:
        """The frames that are whole now, as they are on the wire."""
        if self._left:
            self._left += data
            data = bytes(self._left) if _ends(self._left) else b""
            if not data:
                return []
            self._left.clear()
        found: list[bytes] = []
        at, end = 0, len(data)
        while at < end and (size := _size_at(data, at)) is not None and size[0] + size[1] <= end - at:
            stop = at + size[0] + size[1]
            found.append(data[at:stop])
            at = stop
        self._left += data[at:]
        return found


def _ends(buffer: bytearray) -> bool:
    """Whether the first frame in it is whole."""
    size = _size_at(buffer, 0)
    return size is not None and len(buffer) >= size[0] + size[1]


def _size_at(data: bytes | bytearray, at: int) -> tuple[int, int] | None:
    """Bytes of header and payload of the frame that begins there; None: not all of the header has come."""
    left = len(data) - at
    if left < 2:
        return None
    size = data[at + 1] & 0x7F
    if size < 126:
        return 2, size
    extra = 2 if size == 126 else 8
    if left < 2 + extra:
        return None
    return 2 + extra, int.from_bytes(data[at + 2 : at + 2 + extra], "big")


def frame(opcode: int, payload: bytes) -> bytes:
    """A frame to a viewer."""
    return _head(opcode, len(payload)) + payload


def _head(opcode: int, size: int) -> bytes:
    if size < 126:
        return bytes((0x80 | opcode, size))
    if size < 1 << 16:
        return bytes((0x80 | opcode, 126)) + size.to_bytes(2, "big")
    return bytes((0x80 | opcode, 127)) + size.to_bytes(8, "big")


def close_frame(code: int, why: str) -> bytes:
    """The last frame, with the reason cut to what one may have."""
    return frame(_CLOSE, code.to_bytes(2, "big") + why.encode()[: _MAX_CONTROL_BYTES - 2])


def text_frame(said: dict[str, Any]) -> bytes:
    """Something in JSON."""
    return frame(TEXT, json.dumps(said, separators=(",", ":")).encode())


def message_head(subscription: int, stamp_ns: int, body_bytes: int) -> bytes:
    """The beginning of the frame with a topic's message, before its body."""
    return _head(BINARY, _MESSAGE.size + body_bytes) + _MESSAGE.pack(MESSAGE_DATA, subscription, stamp_ns)
