"""The wire format of one hop: datagrams, the frames inside them, and the handshake and control envelopes.

A *datagram* is what a lane carries as one unit: one ZMQ message part on the ZMQ lane, one sealed UDP datagram on
the UDP lane. All integers are big endian.

    0                   1                   2                   3
    0 1 2 3 4 5 6 7 8 9 0 1 2 3 4 5 6 7 8 9 0 1 2 3 4 5 6 7 8 9 0 1
   +---------------+---------------+---------------+---------------+
   | magic 0x53    | version       | kind          | session tag   |
   +---------------+---------------+---------------+---------------+
   | packet number (0: unnumbered, never acknowledged)             |
   +---------------------------------------------------------------+
   | send stamp, microseconds of the sender's monotonic clock      |
   |                                                               |
   +---------------------------------------------------------------+
   | kind 16: frames until the end; other kinds: one msgpack map   |

Frames of a kind-16 datagram, each starting with its type:

   type 1 DATA (18 bytes, +14 when offset is 0, then `length` body bytes)
   +------+-------+------------+-------+----------+---------+--------+
   | type | flags | channel_id | seq   | offset   | total   | length |
   |  u8  |  u8   |  u16       |  u32  |  u32     |  u32    |  u16   |
   +------+-------+------------+-------+----------+---------+--------+
   | stamp_ns i64 | age u32 (100 us) | codec u8 | age error u8    |   only when offset is 0
   +--------------+------------------+----------+-----------------+
       the true age is at most `age` + AGE_ERRORS_S[age error]: 0 for none, n for 100 us * 2^((n-1)/8), 255 unknown

   type 2 ACK (38 bytes): lane u8, highest u32, sack u64, echo stamp u64, receive stamp u64, cumulative bytes u64
       bit i of sack: packet highest-1-i has arrived; the stamps belong to packet `highest`, in microseconds;
       at most 4 ACK frames a datagram
   type 3 WATERMARK (7 bytes): channel_id u16, delivered u32: every seq up to it is delivered, expired or refused
   type 4 PING (1 byte): asks for an acknowledgement

`seq` is the low 32 bits of a 64-bit count; the receiver widens it next to what it expects (RFC 1982 style).
Decoding accepts or raises WireError (VersionError for a version that is not spoken here), nothing else. Everything
that another program needs to know to speak it is in schemas/wire.md.
"""

import re
import struct
import zlib
from bisect import bisect_left
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Final, Protocol, cast

import msgpack

from sern_core.vocabulary.errors import VersionError, WireError

MAGIC: Final = 0x53
VERSION_MIN: Final = 1
VERSION_MAX: Final = 1
Versions = tuple[int, int]
"""The oldest and the newest wire version that a side speaks."""
VERSIONS: Final[Versions] = (VERSION_MIN, VERSION_MAX)
"""The wire versions this code speaks; peers agree on the highest common one at hello."""
HANDSHAKE_VERSION: Final = 1
"""Version byte of every handshake datagram, for ever: a peer must be able to read the HELLO that offers its version."""

HEADER: Final = struct.Struct("!BBBBIQ")
DATA_FIXED: Final = struct.Struct("!BBHIIIH")
DATA_FIRST: Final = struct.Struct("!BBHIIIHqIBB")
FIRST_EXTRA: Final = struct.Struct("!qIBB")
ACK: Final = struct.Struct("!BBIQQQQ")
WATERMARK: Final = struct.Struct("!BHI")
HEADER_BYTES: Final = HEADER.size
DATA_BYTES: Final = DATA_FIXED.size
DATA_FIRST_BYTES: Final = DATA_FIRST.size

MAX_FRAGMENT_BYTES: Final = 65_000
"""Largest fragment body; `length` is 16 bits and a ZMQ message on the WAN stays below 64 KiB."""
MAX_DATAGRAM_BYTES: Final = 65_536
SMALL_BODY_BYTES: Final = 4096
MAX_ENVELOPE_BYTES: Final = 4096
MAX_ENVELOPE_ITEMS: Final = 64
"""Arrays and maps of an envelope; without it one megabyte of empty maps costs 78 MB of memory."""
MAX_ENVELOPE_DEPTH: Final = 3
"""Maps and arrays inside each other: what the control messages use and one more."""
MAX_ATTACHMENT_BYTES: Final = 1 << 20
"""Unpacked size of a control message's attachment (a message definition or an object's value)."""
MAX_ACK_FRAMES: Final = 4
"""ACK frames of one datagram (one a lane); each costs the receiver a walk over what it has in flight."""
MAX_PACKET_NUMBER: Final = 0xFFFFFFFF
"""Packet numbers do not wrap: a session ends before they are used up, and the next one starts at 1."""
MAX_SEQ: Final = 2**62
"""Where a stream may begin to count; every message's seq is below it, so that a stream can be announced anew at any."""
AGE_UNIT_S: Final = 1e-4
MAX_AGE_S: Final = AGE_UNIT_S * 0xFFFFFFFF
AGE_ERRORS_S: Final = (0.0, *(AGE_UNIT_S * 2.0 ** (code / 8) for code in range(254)), float("inf"))
"""How much too young an age may be, by its code: every hop adds the uncertainty of its own clock offset."""

FLAG_DROP_MARKER: Final = 0x01  # the message was dropped upstream; the body is one byte, its DROP_CODES value
FLAG_REPLAY: Final = 0x02  # a transient_local sample for a late joiner
FLAG_URGENT: Final = 0x04  # class control: acknowledge at once
KNOWN_FLAGS: Final = FLAG_DROP_MARKER | FLAG_REPLAY | FLAG_URGENT


class Kind(IntEnum):
    HELLO = 1  # client to relay: who, which versions
    WELCOME = 2  # relay to client: the session exists
    REFUSE = 3  # relay to client: no, and why
    RESET = 4  # "I know no such session": the peer says hello again
    CLOSE = 5  # the session ends on purpose
    JOIN = 6  # client to relay: this connection, too, belongs to the session
    DATA = 16


_HANDSHAKE_KINDS: Final = frozenset({Kind.HELLO, Kind.WELCOME, Kind.REFUSE, Kind.RESET, Kind.CLOSE, Kind.JOIN})

FRAME_DATA: Final = 1
FRAME_ACK: Final = 2
FRAME_WATERMARK: Final = 3
FRAME_PING: Final = 4


@dataclass(frozen=True, slots=True)
class Header:
    version: int
    kind: int
    tag: int
    number: int
    stamp_us: int


Datagram = bytes | memoryview
"""A datagram as it arrives, or a part of one: where it is a view, whoever keeps any of it makes bytes of that."""


class FrameSink(Protocol):
    """What a decoder of kind-16 datagrams reports to, frame by frame, in order. True: no more frames for now."""

    def on_data(
        self,
        flags: int,
        channel_id: int,
        seq: int,
        offset: int,
        total: int,
        body: Datagram,
        stamp_ns: int,
        age_s: float,
        codec: int,
        error_s: float,
    ) -> bool | None: ...

    def on_ack(self, lane: int, highest: int, sack: int, echo_us: int, received_us: int, cum_bytes: int) -> None: ...

    def on_watermark(self, channel_id: int, delivered: int) -> bool | None: ...

    def on_ping(self) -> None: ...


def encode_header(kind: int, tag: int, number: int, stamp_us: int, *, version: int = VERSION_MAX) -> bytes:
    """The 16-byte datagram header. `stamp_us` is taken modulo 2^64; `version` is the one that was agreed."""
    return HEADER.pack(MAGIC, version, kind, tag, number, stamp_us & 0xFFFFFFFFFFFFFFFF)


def decode_header(data: bytes, versions: Versions = VERSIONS) -> Header:
    """Split off and check the header of any datagram. Raises WireError, or VersionError for a version that is none of
    `versions`."""
    if len(data) < HEADER_BYTES:
        raise WireError(f"datagram of {len(data)} bytes is shorter than its {HEADER_BYTES}-byte header")
    if len(data) > MAX_DATAGRAM_BYTES:
        raise WireError(f"datagram of {len(data)} bytes exceeds {MAX_DATAGRAM_BYTES}")
    magic, version, kind, tag, number, stamp_us = HEADER.unpack_from(data)
    if magic != MAGIC:
        raise WireError(f"first byte 0x{magic:02x} is not a SERN datagram (0x{MAGIC:02x})")
    if kind in _HANDSHAKE_KINDS:
        if version != HANDSHAKE_VERSION:
            raise VersionError(f"handshake with version byte {version}; it is {HANDSHAKE_VERSION} in every version")
    elif not versions[0] <= version <= versions[1]:
        raise VersionError(f"wire version {version} is unknown here; this side speaks {versions[0]} to {versions[1]}")
    elif kind != Kind.DATA:
        raise WireError(f"unknown datagram kind {kind}")
    return Header(version, kind, tag, number, stamp_us)


def decode_frames(data: Datagram, sink: FrameSink, position: int = HEADER_BYTES) -> int:
    """Walk the frames of a kind-16 datagram whose header was checked, from `position` on.

    Returns where the next frame begins if the sink has had enough for now, else 0. Raises WireError at the first bad
    byte; the frames before it have been reported.
    """
    end = len(data)
    acks = 0
    unpack_data = DATA_FIXED.unpack_from
    while position < end:
        kind = data[position]
        if kind == FRAME_DATA:
            if position + DATA_BYTES > end:
                raise WireError("truncated DATA frame")
            _, flags, channel_id, seq, offset, total, length = unpack_data(data, position)
            position += DATA_BYTES
            stamp_ns, age, codec, error = 0, 0, 0, 0
            if offset == 0:
                if position + FIRST_EXTRA.size > end:
                    raise WireError("truncated DATA frame")
                stamp_ns, age, codec, error = FIRST_EXTRA.unpack_from(data, position)
                position += FIRST_EXTRA.size
            if flags & ~KNOWN_FLAGS:
                raise WireError(f"unknown DATA flags 0x{flags:02x}")
            if length == 0 and (offset or total):
                raise WireError("empty fragment")
            if length > MAX_FRAGMENT_BYTES:
                raise WireError(f"fragment of {length} bytes exceeds {MAX_FRAGMENT_BYTES}")
            if offset + length > total:
                raise WireError(f"fragment {offset}+{length} lies outside its message of {total} bytes")
            if position + length > end:
                raise WireError("truncated DATA body")
            if length < SMALL_BODY_BYTES and type(data) is memoryview:
                data = data.tobytes()  # small bodies, of which a datagram has many, are quicker cut from bytes
            body = data[position : position + length]
            if flags & FLAG_DROP_MARKER and total != 1:
                raise WireError("a tombstone carries exactly one byte")  # a drop marker, in the words of the vectors
            position += length
            if sink.on_data(
                flags, channel_id, seq, offset, total, body, stamp_ns, age * AGE_UNIT_S, codec, AGE_ERRORS_S[error]
            ):
                return position
        elif kind == FRAME_ACK:
            if position + ACK.size > end:
                raise WireError("truncated ACK frame")
            acks += 1
            if acks > MAX_ACK_FRAMES:
                raise WireError(f"more than {MAX_ACK_FRAMES} ACK frames in one datagram")
            _, lane, highest, sack, echo_us, received_us, cum_bytes = ACK.unpack_from(data, position)
            position += ACK.size
            sink.on_ack(lane, highest, sack, echo_us, received_us, cum_bytes)
        elif kind == FRAME_WATERMARK:
            if position + WATERMARK.size > end:
                raise WireError("truncated WATERMARK frame")
            _, channel_id, delivered = WATERMARK.unpack_from(data, position)
            position += WATERMARK.size
            if sink.on_watermark(channel_id, delivered):
                return position
        elif kind == FRAME_PING:
            position += 1
            sink.on_ping()
        else:
            raise WireError(f"unknown frame type {kind}")
    return 0


def encode_data_first(
    flags: int,
    channel_id: int,
    seq: int,
    total: int,
    length: int,
    stamp_ns: int,
    age_s: float,
    codec: int,
    error_s: float = 0.0,
) -> bytes:
    """Header of the fragment at offset 0 (32 bytes); the body follows it.

    The age is cut to 0 and MAX_AGE_S; its error is rounded up to the next of AGE_ERRORS_S.
    """
    age = 0xFFFFFFFF if age_s >= MAX_AGE_S else int(age_s / AGE_UNIT_S) if age_s > 0.0 else 0
    error = bisect_left(AGE_ERRORS_S, error_s) if error_s else 0
    return DATA_FIRST.pack(
        FRAME_DATA, flags, channel_id, seq & 0xFFFFFFFF, 0, total, length, stamp_ns, age, codec, error
    )


def encode_data_next(flags: int, channel_id: int, seq: int, offset: int, total: int, length: int) -> bytes:
    """Header of a fragment at `offset` > 0 (18 bytes); the body follows it."""
    return DATA_FIXED.pack(FRAME_DATA, flags, channel_id, seq & 0xFFFFFFFF, offset, total, length)


def encode_ack(lane: int, highest: int, sack: int, echo_us: int, received_us: int, cum_bytes: int) -> bytes:
    return ACK.pack(
        FRAME_ACK, lane, highest, sack, echo_us, received_us & 0xFFFFFFFFFFFFFFFF, cum_bytes & 0xFFFFFFFFFFFFFFFF
    )


def encode_watermark(channel_id: int, delivered: int) -> bytes:
    return WATERMARK.pack(FRAME_WATERMARK, channel_id, delivered & 0xFFFFFFFF)


PING_FRAME: Final = bytes([FRAME_PING])


def widen_seq(low: int, near: int) -> int:
    """The 64-bit count whose low 32 bits are `low` and which lies nearest to `near` (RFC 1982 arithmetic)."""
    wide = (near & ~0xFFFFFFFF) | low
    if wide < near - 0x80000000:
        return wide + 0x100000000
    if wide > near + 0x80000000 and wide >= 0x100000000:
        return wide - 0x100000000
    return wide


# --- envelopes: msgpack maps of the handshake and of control messages -------------------------------------------

Envelope = dict[str, Any]


def _pack(envelope: Envelope) -> bytes:
    return cast(bytes, msgpack.packb(envelope, use_bin_type=True))


def envelope_bytes(envelope: Envelope) -> int:
    """Size of an envelope on the wire, also of one that is too long for it."""
    return len(_pack(envelope))


def encode_envelope(envelope: Envelope) -> bytes:
    """A map of plain values. Raises WireError above MAX_ENVELOPE_BYTES."""
    packed = _pack(envelope)
    if len(packed) > MAX_ENVELOPE_BYTES:
        raise WireError(f"envelope of {len(packed)} bytes exceeds {MAX_ENVELOPE_BYTES}")
    return packed


class _Map:
    """A map as it is on the wire, in order and with whatever keys it repeats."""

    __slots__ = ("pairs",)

    def __init__(self, pairs: list[tuple[bytes, object]]) -> None:
        self.pairs = pairs


def decode_envelope(data: bytes) -> Envelope:
    """One msgpack map with string keys, bounded in size, depth of nesting and number of items."""
    if len(data) > MAX_ENVELOPE_BYTES:
        raise WireError(f"envelope of {len(data)} bytes exceeds {MAX_ENVELOPE_BYTES}")
    try:
        # `raw`: msgpack interns text keys, and interned text is never freed on Python 3.12: a peer's keys stay bytes
        # until they are known to be few and short-lived. Without bin and ext, every bytes object here is text.
        value = msgpack.unpackb(
            data,
            raw=True,
            strict_map_key=True,
            object_pairs_hook=_Map,
            max_array_len=MAX_ENVELOPE_ITEMS,
            max_map_len=MAX_ENVELOPE_ITEMS,
            max_bin_len=0,
            max_ext_len=0,
        )
    except (ValueError, RecursionError, msgpack.exceptions.UnpackException) as error:
        raise WireError("envelope is not one msgpack map within the limits") from error
    if not isinstance(value, _Map):
        raise WireError("envelope is not a map")
    return cast(Envelope, _plain(value, MAX_ENVELOPE_DEPTH))


_PLAIN: Final = frozenset((bool, int, float, type(None)))


def _plain(value: object, depth: int) -> object:
    """Bytes become text, maps become dicts. Raises WireError for what an envelope may not hold."""
    if isinstance(value, bytes):
        try:
            return value.decode()
        except UnicodeDecodeError:
            raise WireError("text in an envelope is not UTF-8") from None
    if value is None or isinstance(value, (bool, int, float)):
        return value
    if depth == 0:
        raise WireError(f"envelope is nested deeper than {MAX_ENVELOPE_DEPTH}")
    if isinstance(value, _Map):
        try:  # nearly all of it is text and numbers, and this is where the time goes that an announcement takes
            result = {
                key.decode(): item.decode() if type(item) is bytes else item if type(item) in _PLAIN
                else _plain(item, depth - 1)
                for key, item in value.pairs
            }  # fmt: skip
        except UnicodeDecodeError:
            raise WireError("text in an envelope is not UTF-8") from None
        if len(result) != len(value.pairs):
            raise WireError("an envelope repeats a key")
        return result
    if isinstance(value, list):
        try:
            return [
                item.decode() if type(item) is bytes else item if type(item) in _PLAIN else _plain(item, depth - 1)
                for item in value
            ]
        except UnicodeDecodeError:
            raise WireError("text in an envelope is not UTF-8") from None
    raise WireError("an envelope holds an extension type")


def encode_control(envelope: Envelope, attachment: bytes = b"") -> bytes:
    """Body of a message on a system channel: u16 envelope length, envelope, zlib-packed attachment."""
    head = encode_envelope(envelope)
    if len(attachment) > MAX_ATTACHMENT_BYTES:
        raise WireError(f"attachment of {len(attachment)} bytes exceeds {MAX_ATTACHMENT_BYTES}")
    return struct.pack("!H", len(head)) + head + (zlib.compress(attachment, 9) if attachment else b"")


def decode_control(body: bytes, *, max_bytes: int = MAX_ATTACHMENT_BYTES) -> tuple[Envelope, bytes]:
    """Envelope and attachment. Raises WireError, also for an attachment that unpacks to more than `max_bytes`."""
    if len(body) < 2:
        raise WireError("truncated control message")
    (length,) = struct.unpack_from("!H", body)
    if len(body) < 2 + length:
        raise WireError("truncated control envelope")
    envelope = decode_envelope(body[2 : 2 + length])
    packed = body[2 + length :]
    if not packed:
        return envelope, b""
    unpacker = zlib.decompressobj()
    try:
        # One byte more than is allowed: the end of a stream that fills the limit exactly is read as well.
        attachment = unpacker.decompress(packed, max_bytes + 1)
    except zlib.error as error:
        raise WireError("bad zlib data in a control attachment") from error
    if len(attachment) > max_bytes:
        raise WireError(f"control attachment unpacks to more than {max_bytes} bytes")
    if not unpacker.eof:
        raise WireError("truncated control attachment")
    if unpacker.unused_data:
        raise WireError("bytes follow a control attachment")
    return envelope, attachment


def take_int(envelope: Envelope, key: str, *, low: int = 0, high: int = 2**63 - 1, default: int | None = None) -> int:
    value = envelope.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise WireError(f"envelope key {key!r} must be an integer from {low} to {high}")
    return value


def take_float(envelope: Envelope, key: str, *, low: float, high: float, default: float | None = None) -> float | None:
    """A finite number in [low, high], or None where None is sent or the key is absent without a default."""
    value = envelope.get(key, default)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
        raise WireError(f"envelope key {key!r} must be a number from {low} to {high}")
    return float(value)


_UNPRINTABLE: Final = re.compile(
    r"[\x00-\x1f\x7f-\xa0\xad\u0600-\u0605\u061c\u06dd\u070f\u0890\u0891\u08e2\u1680\u180e\u2000-\u200f\u2028-\u202f\u205f-\u206f"
    r"\u3000\ud800-\uf8ff\ufeff\ufff0-\ufffb\ufffe\uffff\U000110bd\U000110cd\U00013430-\U0001343f\U0001bca0-\U0001bca3"
    r"\U0001d173-\U0001d17a\U000e0000-\U000e00ff\U000f0000-\U0010ffff]"
)
"""Control and format characters, spaces other than the usual one, surrogates, private use. A list of our own:
`str.isprintable` knows other characters in every version of Python, and what a relay takes every receiver must."""


def _is_text(value: object, max_length: int) -> bool:
    """Text of a peer ends up in logs and on terminals: no control characters."""
    return isinstance(value, str) and len(value) <= max_length and _UNPRINTABLE.search(value) is None


def _are_texts(values: list[object], max_length: int) -> bool:
    """`_is_text` of each: they are searched as one, since a list of names is most of what tells who wants a stream."""
    if not all(type(text) is str for text in values):
        return False
    texts = cast(list[str], values)
    return max(map(len, texts), default=0) <= max_length and _UNPRINTABLE.search("".join(texts)) is None


def take_str(envelope: Envelope, key: str, *, max_length: int = 512, default: str | None = None) -> str:
    value = envelope.get(key, default)
    if not _is_text(value, max_length):
        raise WireError(f"envelope key {key!r} must be a printable string of at most {max_length} characters")
    return cast(str, value)


def take_strings(envelope: Envelope, key: str, *, max_length: int = 512) -> list[str]:
    value = envelope.get(key, [])
    if not isinstance(value, list) or not _are_texts(value, max_length):
        raise WireError(f"envelope key {key!r} must be a list of printable strings of at most {max_length} characters")
    return list(value)


def take_texts(
    envelope: Envelope, key: str, *, max_items: int = MAX_ENVELOPE_ITEMS, max_length: int = 512, max_bytes: int = 4096
) -> dict[str, str]:
    """A map of printable strings, at most `max_bytes` of UTF-8 in all; empty when the key is absent."""
    value = envelope.get(key, {})
    if not isinstance(value, dict) or not all(
        _is_text(name, max_length) and _is_text(text, max_length) for name, text in value.items()
    ):
        raise WireError(
            f"envelope key {key!r} must map strings to strings, printable, of at most {max_length} characters"
        )
    if (
        len(value) > max_items
        or sum(len(name.encode()) + len(text.encode()) for name, text in value.items()) > max_bytes
    ):
        raise WireError(f"envelope key {key!r} holds more than {max_items} items or {max_bytes} bytes")
    return dict(value)


def take_bool(envelope: Envelope, key: str, *, default: bool = False) -> bool:
    value = envelope.get(key, default)
    if not isinstance(value, bool):
        raise WireError(f"envelope key {key!r} must be true or false")
    return value


def encode_handshake(kind: Kind, tag: int, stamp_us: int, envelope: Envelope) -> bytes:
    return encode_header(kind, tag, 0, stamp_us, version=HANDSHAKE_VERSION) + encode_envelope(envelope)


def decode_handshake(data: bytes) -> Envelope:
    """The envelope of a handshake datagram whose header was checked."""
    return decode_envelope(data[HEADER_BYTES:])


def agree_version(low: int, high: int, versions: Versions = VERSIONS) -> int:
    """The highest wire version that both speak: the peer `low` to `high`, this side `versions`. Raises VersionError
    naming both ranges."""
    best = min(high, versions[1])
    if best < max(low, versions[0]):
        raise VersionError(
            f"the peer speaks wire versions {low} to {high}, this side {versions[0]} to {versions[1]}: update the older"
        )
    return best
