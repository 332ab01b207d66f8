"""Reading and writing ROS message bodies field by field, without a type description.

ROS 1: little endian, packed, strings and arrays behind a uint32 length.

CDR (OMG DDSI-RTPS 10.5, XCDR version 1): a four-byte header says the byte order, after it every number is aligned to
its own size, counted from the end of that header; strings count and carry a final NUL.

    0     1     2     3     4
    +-----+-----+-----+-----+---------
    | 00  |order|  options  | fields    order 00: big endian, 01: little endian
    +-----+-----+-----+-----+---------
"""

import struct
from dataclasses import dataclass
from typing import Final

from sern_core.vocabulary.errors import BodyError
from sern_core.vocabulary.types import Encoding

MAX_TEXT_BYTES: Final = 4096
"""Longest string taken: frame ids and field names are short, and a length that is not one is found at once."""
_CDR_HEADER_BYTES: Final = 4
_CDR_LITTLE: Final = b"\x00\x01\x00\x00"
_CDR_PADDING_BYTES: Final = 7
"""Bytes a writer may leave behind the last field to fill up a word."""
_FORMATS: Final = {
    order: {code: struct.Struct(order + code) for code in ("B", "b", "I", "i", "f", "d", "3d", "4d", "7f")}
    for order in "<>"
}


@dataclass(frozen=True, slots=True)
class Header:
    """std_msgs/Header. `seq` exists in ROS 1 only and is 0 elsewhere."""

    sec: int = 0
    nanosec: int = 0
    frame_id: str = ""
    seq: int = 0

    @property
    def stamp_ns(self) -> int:
        return self.sec * 10**9 + self.nanosec


class BodyReader:
    """Takes fields off a body in their order. Every method raises BodyError when the bytes end too early."""

    __slots__ = ("_at", "_base", "_formats", "_view", "order", "ros1")

    def __init__(self, body: bytes, encoding: Encoding) -> None:
        self._view = memoryview(body)
        self.ros1 = encoding is Encoding.ROS1
        self.order = "<"
        self._at = self._base = 0
        if encoding is Encoding.RAW:
            raise BodyError("raw bodies are no ROS messages")
        if not self.ros1:
            if len(body) < _CDR_HEADER_BYTES or body[0] != 0 or body[1] > 1:
                raise BodyError(f"{bytes(body[:4]).hex() or 'nothing'} is not the head of a plain CDR body")
            self.order = "<" if body[1] else ">"
            self._at = self._base = _CDR_HEADER_BYTES
        self._formats = _FORMATS[self.order]

    def _skip(self, size: int, align: int) -> int:
        """Where the next `size` bytes begin; moves past them."""
        at = self._at
        if not self.ros1:
            at += -(at - self._base) % align
        if size > len(self._view) - at:
            raise BodyError(f"ends after {len(self._view)} bytes, inside a field of {size}")
        self._at = at + size
        return at

    def _number(self, code: str, size: int) -> int:
        value: int = self._formats[code].unpack_from(self._view, self._skip(size, size))[0]
        return value

    def u8(self) -> int:
        return self._number("B", 1)

    def u32(self) -> int:
        return self._number("I", 4)

    def i32(self) -> int:
        return self._number("i", 4)

    def f32(self) -> float:
        return float(self._formats["f"].unpack_from(self._view, self._skip(4, 4))[0])

    def f64s(self, count: int) -> tuple[float, ...]:
        """3 or 4 float64 in a row."""
        return self._formats[f"{count}d"].unpack_from(self._view, self._skip(8 * count, 8))

    def text(self) -> str:
        """A string; bytes that are not UTF-8 survive a round trip."""
        size = self.u32()
        if size > MAX_TEXT_BYTES:
            raise BodyError(f"a string of {size} bytes; up to {MAX_TEXT_BYTES} are read")
        at = self._skip(size, 1)
        raw = bytes(self._view[at : at + size])
        if not self.ros1:
            raw = raw.removesuffix(b"\0")
        return raw.decode("utf-8", errors="surrogateescape")

    def array(self, item_bytes: int) -> memoryview:
        """The bytes of a sequence of numbers of `item_bytes` each."""
        count = self.u32()
        if count == 0:
            return self._view[:0]  # an empty sequence is not aligned
        at = self._skip(count * item_bytes, item_bytes)
        return self._view[at : at + count * item_bytes]

    def time(self) -> tuple[int, int]:
        """Seconds (signed in ROS 2, unsigned in ROS 1) and nanoseconds."""
        return (self.u32() if self.ros1 else self.i32()), self.u32()

    def header(self) -> Header:
        seq = self.u32() if self.ros1 else 0
        sec, nanosec = self.time()
        return Header(sec, nanosec, self.text(), seq)

    def end(self) -> None:
        """BodyError when more is left than padding: these are the bytes of another type."""
        left = len(self._view) - self._at
        if left > (0 if self.ros1 else _CDR_PADDING_BYTES):
            raise BodyError(f"{left} bytes are left over behind the last field")


class BodyWriter:
    """Puts fields one after the other; little endian. BodyError for a number that its field cannot hold."""

    __slots__ = ("_parts", "_ros1", "_size")

    def __init__(self, encoding: Encoding) -> None:
        if encoding is Encoding.RAW:
            raise BodyError("raw bodies are no ROS messages")
        self._ros1 = encoding is Encoding.ROS1
        self._parts: list[bytes | memoryview] = [] if self._ros1 else [_CDR_LITTLE]
        self._size = 0  # behind the CDR header

    def _put(self, data: bytes | memoryview, align: int) -> None:
        if not self._ros1 and (padding := -self._size % align):
            self._parts.append(bytes(padding))
            self._size += padding
        self._parts.append(data)
        self._size += len(data)

    def _number(self, code: str, value: object, size: int) -> None:
        """`object`: as a float an integer would not stay one in compiled code."""
        try:
            self._put(_FORMATS["<"][code].pack(value), size)
        except (struct.error, OverflowError):
            raise BodyError(f"{value} does not fit its field") from None

    def u8(self, value: int) -> None:
        self._number("B", value, 1)

    def u32(self, value: int) -> None:
        self._number("I", value, 4)

    def i32(self, value: int) -> None:
        self._number("i", value, 4)

    def f32(self, value: float) -> None:
        self._number("f", value, 4)

    def f64s(self, values: tuple[float, ...]) -> None:
        """3 or 4 float64 in a row."""
        self._put(_FORMATS["<"][f"{len(values)}d"].pack(*values), 8)

    def text(self, value: str) -> None:
        raw = value.encode("utf-8", errors="surrogateescape")
        if not self._ros1:
            raw += b"\0"
        self.u32(len(raw))
        self._put(raw, 1)

    def array(self, data: bytes | memoryview, item_bytes: int) -> None:
        """A sequence of numbers of `item_bytes` each, little endian; `data` is bytes or a contiguous view of bytes."""
        self.u32(len(data) // item_bytes)
        if len(data):
            self._put(data, item_bytes)

    def time(self, sec: int, nanosec: int) -> None:
        if self._ros1:
            self.u32(sec)
        else:
            self.i32(sec)
        self.u32(nanosec)

    def header(self, header: Header) -> None:
        if self._ros1:
            self.u32(header.seq)
        self.time(header.sec, header.nanosec)
        self.text(header.frame_id)

    def body(self) -> bytes:
        return b"".join(self._parts)
