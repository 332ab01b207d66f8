"""The wire codec: round trips of every encoder, every limit from both sides. Golden bytes: `tests/test_vectors.py`."""

import math
import struct
import sys
import tracemalloc
import zlib
from collections.abc import Callable
from typing import Any

import msgpack
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from sern_core.vocabulary.errors import VersionError, WireError
from sern_core.wire import framing
from tests.exploring import cases
from tests.make_vectors import Frames

STEADY = settings(max_examples=cases(100))
U8, U16, U32, U64 = (st.integers(0, 2**bits - 1) for bits in (8, 16, 32, 64))
HEADER = framing.encode_header(framing.Kind.DATA, 7, 1, 0)


def frames(data: bytes) -> list[dict[str, Any]]:
    sink = Frames()
    framing.decode_frames(HEADER + data, sink)
    return sink.frames


def rejected(data: bytes) -> str:
    with pytest.raises(WireError) as caught:
        frames(data)
    return str(caught.value)


# --- sizes ------------------------------------------------------------------------------------------------------------


def test_sizes() -> None:
    assert (framing.HEADER_BYTES, framing.DATA_BYTES, framing.DATA_FIRST_BYTES) == (16, 18, 32)
    assert (framing.ACK.size, framing.WATERMARK.size, len(framing.PING_FRAME)) == (38, 7, 1)
    assert framing.DATA_FIRST.size == framing.DATA_FIXED.size + framing.FIRST_EXTRA.size


def test_the_greatest_fragment_fits_a_datagram() -> None:
    assert (
        framing.HEADER_BYTES + framing.ACK.size + framing.DATA_FIRST_BYTES + framing.MAX_FRAGMENT_BYTES
        <= framing.MAX_DATAGRAM_BYTES
    )


# --- header -----------------------------------------------------------------------------------------------------------


@STEADY
@given(st.sampled_from(framing.Kind), U8, U32, st.integers(-(2**70), 2**70))
def test_header_round_trip(kind: framing.Kind, tag: int, number: int, stamp_us: int) -> None:
    header = framing.decode_header(framing.encode_header(kind, tag, number, stamp_us))
    assert header == framing.Header(1, kind, tag, number, stamp_us % 2**64)


def test_every_first_byte_version_and_kind() -> None:
    for value in range(256):
        for at in (0, 1, 2):
            data = HEADER[:at] + bytes([value]) + HEADER[at + 1 :]
            try:
                header = framing.decode_header(data)
            except VersionError:
                assert at == 1 and value != 1
            except WireError:
                assert (at == 0 and value != framing.MAGIC) or (at == 2 and value not in set(framing.Kind))
            else:
                assert (header.version, header.tag) == (1, 7)


def test_a_newer_peer_can_be_heard() -> None:
    """The side that speaks 1 to 2 greets in version 1; the side that speaks 1 alone reads the offer."""
    hello = framing.encode_handshake(framing.Kind.HELLO, 1, 0, {"vmin": 1, "vmax": 2})
    framing.decode_header(hello)
    envelope = framing.decode_handshake(hello)
    assert framing.agree_version(envelope["vmin"], envelope["vmax"]) == 1


def test_versions_in_between() -> None:
    for version in range(7):
        data = framing.encode_header(framing.Kind.DATA, 1, 0, 0, version=version)
        if 2 <= version <= 4:
            assert framing.decode_header(data, (2, 4)).version == version
        else:
            with pytest.raises(VersionError, match=f"wire version {version} is unknown here; this side speaks 2 to 4"):
                framing.decode_header(data, (2, 4))
    assert (
        framing.decode_header(framing.encode_handshake(framing.Kind.HELLO, 1, 0, {})).version
        == framing.HANDSHAKE_VERSION
    )


def test_datagram_size_limit() -> None:
    framing.decode_header(HEADER + bytes(framing.MAX_DATAGRAM_BYTES - len(HEADER)))
    with pytest.raises(WireError, match="exceeds 65536"):
        framing.decode_header(HEADER + bytes(framing.MAX_DATAGRAM_BYTES - len(HEADER) + 1))


# --- frames -----------------------------------------------------------------------------------------------------------


@STEADY
@given(
    st.integers(0, framing.KNOWN_FLAGS).filter(lambda flags: not flags & framing.FLAG_DROP_MARKER),
    U16,
    st.integers(0, 2**64),
    st.binary(max_size=40),
    st.integers(0, 2**32 - 41),
    st.integers(-(2**63), 2**63 - 1),
    st.floats(0, framing.MAX_AGE_S),
    U8,
    st.sampled_from(framing.AGE_ERRORS_S),
)
def test_data_round_trip(
    flags: int,
    channel_id: int,
    seq: int,
    body: bytes,
    more: int,
    stamp_ns: int,
    age_s: float,
    codec: int,
    error_s: float,
) -> None:
    total = len(body) + more if body else 0
    head = framing.encode_data_first(flags, channel_id, seq, total, len(body), stamp_ns, age_s, codec, error_s)
    got: list[tuple[Any, ...]] = []

    class Sink(Frames):
        def on_data(self, *args: Any) -> None:
            got.append(args)

    framing.decode_frames(HEADER + head + body, Sink())
    assert len(got) == 1
    assert got[0][:7] == (flags, channel_id, seq % 2**32, 0, total, body, stamp_ns)
    assert got[0][8:] == (codec, error_s)
    assert age_s - framing.AGE_UNIT_S <= got[0][7] <= age_s + 1e-9 * (1 + age_s)


@pytest.mark.parametrize("sizes", [(3, 40), (framing.SMALL_BODY_BYTES,), (2 * framing.SMALL_BODY_BYTES, 1, 9000)])
def test_a_view_says_what_its_bytes_say(sizes: tuple[int, ...]) -> None:
    data = b"".join(
        framing.encode_data_first(0, 1, seq, size, size, 0, 0.0, 0) + bytes([seq]) * size
        for seq, size in enumerate(sizes)
    )
    told = Frames()
    framing.decode_frames(memoryview(HEADER + data), told)
    assert told.frames == frames(data)
    for cut in (1, sizes[-1], len(data) - 1):
        with pytest.raises(WireError):
            framing.decode_frames(memoryview(HEADER + data)[:-cut], Frames())


@STEADY
@given(U16, st.integers(0, 2**64), st.integers(1, 2**31), st.binary(min_size=1, max_size=40), st.integers(0, 2**30))
def test_later_fragment_round_trip(channel_id: int, seq: int, offset: int, body: bytes, more: int) -> None:
    total = offset + len(body) + more
    (frame,) = frames(framing.encode_data_next(0, channel_id, seq, offset, total, len(body)) + body)
    assert frame == {
        "type": "DATA",
        "flags": [],
        "channel": channel_id,
        "seq": seq % 2**32,
        "offset": offset,
        "total": total,
        "body": body.hex(),
    }


@STEADY
@given(U8, U32, U64, U64, st.integers(0, 2**70), st.integers(0, 2**70))
def test_ack_round_trip(lane: int, highest: int, sack: int, echo_us: int, received_us: int, cum_bytes: int) -> None:
    (frame,) = frames(framing.encode_ack(lane, highest, sack, echo_us, received_us, cum_bytes))
    assert list(frame.values()) == ["ACK", lane, highest, sack, echo_us, received_us % 2**64, cum_bytes % 2**64]


@STEADY
@given(U16, st.integers(0, 2**64))
def test_watermark_round_trip(channel_id: int, delivered: int) -> None:
    (frame,) = frames(framing.encode_watermark(channel_id, delivered))
    assert (frame["channel"], frame["delivered"]) == (channel_id, delivered % 2**32)


@pytest.mark.parametrize(
    ("age_s", "units"),
    [
        (-1.0, 0),
        (0.0, 0),
        (0.00009, 0),
        (0.0001001, 1),
        (1.0, 10_000),
        (framing.MAX_AGE_S - 1e-3, 0xFFFFFFFF - 10),
        (framing.MAX_AGE_S, 0xFFFFFFFF),
        (1e300, 0xFFFFFFFF),
        (math.inf, 0xFFFFFFFF),
        (-math.inf, 0),
        (math.nan, 0),
    ],
)
def test_age_is_cut_to_its_field(age_s: float, units: int) -> None:
    (frame,) = frames(framing.encode_data_first(0, 1, 1, 0, 0, 0, age_s, 0))
    assert frame["age_100us"] == units


def test_age_error_is_never_understated() -> None:
    codes = []
    for exponent in range(-60, 30):
        for step in (1.0, 1.1, 1.7):
            error_s = step * 2.0**exponent
            (frame,) = frames(framing.encode_data_first(0, 1, 1, 0, 0, 0, 0.0, 0, error_s))
            assert framing.AGE_ERRORS_S[frame["age_error"]] >= error_s
            codes.append(frame["age_error"])
    assert codes == sorted(codes)
    assert len(framing.AGE_ERRORS_S) == 256 and list(framing.AGE_ERRORS_S) == sorted(set(framing.AGE_ERRORS_S))


def test_every_flag_byte() -> None:
    for flags in range(256):
        data = framing.encode_data_first(0, 1, 1, 1, 1, 0, 0.0, 0) + b"\x01"
        data = data[:1] + bytes([flags]) + data[2:]
        if flags & ~framing.KNOWN_FLAGS:
            assert rejected(data) == f"unknown DATA flags 0x{flags:02x}"
        else:
            assert len(frames(data)) == 1


def test_every_frame_type() -> None:
    for kind in range(256):
        data = bytes([kind]) + bytes(60)
        if kind not in (framing.FRAME_DATA, framing.FRAME_ACK, framing.FRAME_WATERMARK, framing.FRAME_PING):
            assert rejected(data) == f"unknown frame type {kind}"


@pytest.mark.parametrize(
    ("offset", "total", "length", "problem"),
    [
        (0, 0, 0, None),
        (0, 1, 1, None),
        (0, 2**32 - 1, 1, None),
        (2**32 - 2, 2**32 - 1, 1, None),
        (0, framing.MAX_FRAGMENT_BYTES, framing.MAX_FRAGMENT_BYTES, None),
        (0, 1, 0, "empty fragment"),
        (1, 1, 0, "empty fragment"),
        (1, 2, 0, "empty fragment"),
        (0, 0, 1, "fragment 0+1 lies outside its message of 0 bytes"),
        (1, 1, 1, "fragment 1+1 lies outside its message of 1 bytes"),
        (2**32 - 1, 2**32 - 1, 1, "fragment 4294967295+1 lies outside its message of 4294967295 bytes"),
        (
            0,
            framing.MAX_FRAGMENT_BYTES + 1,
            framing.MAX_FRAGMENT_BYTES + 1,
            f"fragment of {framing.MAX_FRAGMENT_BYTES + 1} bytes exceeds {framing.MAX_FRAGMENT_BYTES}",
        ),
    ],
)
def test_where_a_fragment_may_lie(offset: int, total: int, length: int, problem: str | None) -> None:
    head = (
        framing.encode_data_next(0, 1, 1, offset, total, length)
        if offset
        else framing.encode_data_first(0, 1, 1, total, length, 0, 0.0, 0)
    )
    if problem is None:
        assert len(frames(head + bytes(length))) == 1
    else:
        assert rejected(head + bytes(length)) == problem


def test_frames_before_a_bad_one_are_reported() -> None:
    sink = Frames()
    with pytest.raises(WireError):
        framing.decode_frames(HEADER + framing.PING_FRAME + framing.encode_watermark(1, 2) + b"\x09", sink)
    assert [frame["type"] for frame in sink.frames] == ["PING", "WATERMARK"]


def test_ack_frames_of_a_datagram() -> None:
    ack = framing.encode_ack(0, 1, 0, 0, 0, 0)
    assert len(frames(ack * framing.MAX_ACK_FRAMES)) == framing.MAX_ACK_FRAMES
    assert rejected(ack * (framing.MAX_ACK_FRAMES + 1)) == "more than 4 ACK frames in one datagram"


# --- sequence numbers -------------------------------------------------------------------------------------------------

EDGES = sorted(
    {
        max(0, base + delta)
        for base in (0, 2**31, 2**32, 2**32 + 2**31, 2**33, 2**62, 2**63)
        for delta in (-2, -1, 0, 1, 2)
    }
)


@pytest.mark.parametrize("near", EDGES)
def test_widen_at_every_edge(near: int) -> None:
    for low in {edge % 2**32 for edge in EDGES} | {(near + d) % 2**32 for d in range(-3, 4)}:
        wide = framing.widen_seq(low, near)
        assert wide >= 0 and wide % 2**32 == low
        nearer = [c for k in (-1, 1) if (c := wide + k * 2**32) >= 0 and abs(c - near) < abs(wide - near)]
        assert not nearer


@STEADY
@given(st.integers(0, 2**63), st.integers(-(2**31) + 1, 2**31 - 1))
@example(0, 2**31 - 1)
@example(2**32, -1)
def test_widen_finds_every_number_in_reach(near: int, ahead: int) -> None:
    true = near + ahead
    if true >= 0:
        assert framing.widen_seq(true & 0xFFFFFFFF, near) == true


# --- versions ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ours", [(low, high) for low in range(1, 5) for high in range(low, 5)])
def test_agree_version_exhaustively(ours: tuple[int, int]) -> None:
    for low in range(6):
        for high in range(6):
            common = set(range(low, high + 1)) & set(range(ours[0], ours[1] + 1))
            if common:
                assert framing.agree_version(low, high, ours) == max(common)
            else:
                with pytest.raises(VersionError) as caught:
                    framing.agree_version(low, high, ours)
                assert str(caught.value) == (
                    f"the peer speaks wire versions {low} to {high}, this side {ours[0]} to {ours[1]}: update the older"
                )


# --- envelopes --------------------------------------------------------------------------------------------------------

TEXTS = st.text(max_size=12)
SCALARS = st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats(allow_nan=False) | TEXTS
ENVELOPES = st.dictionaries(
    TEXTS,
    SCALARS
    | st.lists(SCALARS | st.lists(SCALARS, max_size=3), max_size=6)
    | st.dictionaries(TEXTS, SCALARS | st.dictionaries(TEXTS, SCALARS, max_size=3), max_size=6),
    max_size=8,
)


@STEADY
@given(ENVELOPES)
def test_envelope_round_trip(envelope: dict[str, Any]) -> None:
    assert framing.decode_envelope(framing.encode_envelope(envelope)) == envelope
    assert framing.envelope_bytes(envelope) == len(framing.encode_envelope(envelope))


@STEADY
@given(ENVELOPES, st.binary(max_size=200))
def test_control_round_trip(envelope: dict[str, Any], attachment: bytes) -> None:
    assert framing.decode_control(framing.encode_control(envelope, attachment)) == (envelope, attachment)


@STEADY
@given(st.sampled_from([kind for kind in framing.Kind if kind is not framing.Kind.DATA]), U8, U64, ENVELOPES)
def test_handshake_round_trip(kind: framing.Kind, tag: int, stamp_us: int, envelope: dict[str, Any]) -> None:
    data = framing.encode_handshake(kind, tag, stamp_us, envelope)
    assert framing.decode_header(data) == framing.Header(framing.HANDSHAKE_VERSION, kind, tag, 0, stamp_us)
    assert framing.decode_handshake(data) == envelope


def test_envelope_size_from_both_sides() -> None:
    fits = {"a": "x" * (framing.MAX_ENVELOPE_BYTES - 6)}
    assert len(framing.encode_envelope(fits)) == framing.MAX_ENVELOPE_BYTES
    assert framing.decode_envelope(framing.encode_envelope(fits)) == fits
    with pytest.raises(WireError, match="envelope of 4097 bytes exceeds 4096"):
        framing.encode_envelope({"a": "x" * (framing.MAX_ENVELOPE_BYTES - 5)})


def test_items_and_depth_from_both_sides() -> None:
    for fits in (
        {str(i): i for i in range(framing.MAX_ENVELOPE_ITEMS)},
        {"a": list(range(framing.MAX_ENVELOPE_ITEMS))},
        {"a": {"b": [1]}},
        {"a": [[None], {}]},
    ):
        assert framing.decode_envelope(msgpack.packb(fits)) == fits
    bad: dict[str, Any]
    for bad in (
        {str(i): i for i in range(framing.MAX_ENVELOPE_ITEMS + 1)},
        {"a": list(range(framing.MAX_ENVELOPE_ITEMS + 1))},
        {"a": {"b": [[]]}},
        {"a": [[[1]]]},
    ):
        with pytest.raises(WireError):
            framing.decode_envelope(msgpack.packb(bad))


def _peak_bytes(call: Callable[[], object]) -> int:
    tracemalloc.start()
    try:
        with pytest.raises(WireError):
            call()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_bombs_cost_little_memory() -> None:
    million = b"\xdd" + struct.pack("!I", 1_000_000) + b"\x80" * 1_000_000
    assert _peak_bytes(lambda: framing.decode_envelope(million)) < 50_000
    for data in (
        b"\x80" * 4096,
        b"\xdd\x00\x00\x0f\xf0" + b"\x80" * 4080,
        b"\x81\xa1a" * 1365,
        b"\xdf\x7f\xff\xff\xff" + b"\xa1a\x80" * 1363,
        b"\x81\xa1a\xc6\xff\xff\xff\xff",
        b"\x81\xa1a\xc9\xff\xff\xff\xff\x05",
    ):
        assert _peak_bytes(lambda data=data: framing.decode_envelope(data)) < 1_500_000  # type: ignore[misc]
    bomb = framing.encode_control({"t": "define"}) + zlib.compress(bytes(64 << 20), 9)
    assert _peak_bytes(lambda: framing.decode_control(bomb)) < 3 * framing.MAX_ATTACHMENT_BYTES


def test_keys_of_a_peer_are_not_kept() -> None:
    """msgpack interns text keys; CPython 3.12 keeps interned text for ever, and a peer could fill the memory."""
    data = msgpack.packb({"a key that a peer made up": 1})
    for key in framing.decode_envelope(data):
        assert sys.intern("a key that a peer " + "made up") is not key


def test_attachment_size_from_both_sides() -> None:
    for size in (0, 1, framing.MAX_ATTACHMENT_BYTES - 1, framing.MAX_ATTACHMENT_BYTES):
        assert framing.decode_control(framing.encode_control({"t": "x"}, bytes(size))) == ({"t": "x"}, bytes(size))
    with pytest.raises(WireError, match="attachment of 1048577 bytes exceeds 1048576"):
        framing.encode_control({}, bytes(framing.MAX_ATTACHMENT_BYTES + 1))
    packed = framing.encode_control({}) + zlib.compress(bytes(framing.MAX_ATTACHMENT_BYTES + 1))
    with pytest.raises(WireError, match="unpacks to more than 1048576 bytes"):
        framing.decode_control(packed)


def test_attachment_cut_anywhere() -> None:
    body = framing.encode_control({"t": "define", "dh": "0" * 32}, b"float64 x\n" * 20)
    head = 2 + int.from_bytes(body[:2])
    for length in range(len(body)):
        if length == head:
            assert framing.decode_control(body[:length])[1] == b""
        else:
            with pytest.raises(WireError, match="truncated"):
                framing.decode_control(body[:length])


# --- values -----------------------------------------------------------------------------------------------------------

ANY: list[object] = [
    None,
    True,
    False,
    0,
    1,
    -1,
    5,
    2**63 - 1,
    2**63,
    2**64 - 1,
    -(2**63),
    0.0,
    0.5,
    1.0,
    -0.5,
    math.inf,
    -math.inf,
    math.nan,
    "",
    "a",
    "é\u4e2d",
    "x" * 513,
    "two\nlines",
    "\x1b[31m",
    "\u202e",
    "\ud800",
    b"bytes",
    [],
    ["a"],
    ["a", 1],
    ["a\x00"],
    [["a"]],
    {},
    {"a": "b"},
    {"a": 1},
    {1: "a"},
    {"a": "\n"},
]


def accepted(take: Callable[[dict[str, Any]], object]) -> list[object]:
    """Which of ANY pass; the others must raise WireError and name the key."""
    passed: list[object] = []
    texts: list[str] = []
    for value in ANY:
        try:
            result = take({"key": value})
        except WireError as error:
            texts.append(str(error))
        else:
            assert result == value
            passed.append(value)
    assert all("'key'" in text and text.isprintable() for text in texts)
    return passed


def test_take_int() -> None:
    assert accepted(lambda e: framing.take_int(e, "key")) == [0, 1, 5, 2**63 - 1]
    assert accepted(lambda e: framing.take_int(e, "key", high=2**64 - 1)) == [0, 1, 5, 2**63 - 1, 2**63, 2**64 - 1]
    assert accepted(lambda e: framing.take_int(e, "key", low=-1, high=1)) == [0, 1, -1]
    assert all(type(v) is int for v in accepted(lambda e: framing.take_int(e, "key")))
    assert framing.take_int({}, "key", default=3) == 3
    with pytest.raises(WireError, match=r"envelope key 'key' must be an integer from 2 to 4"):
        framing.take_int({}, "key", low=2, high=4)
    with pytest.raises(WireError):
        framing.take_int({"key": None}, "key", default=3)


def test_take_float() -> None:
    passed = accepted(lambda e: framing.take_float(e, "key", low=0.0, high=1.0))
    assert passed == [None, 0, 1, 0.0, 0.5, 1.0]
    assert all(
        isinstance(framing.take_float({"key": v}, "key", low=0.0, high=1.0), (float, type(None))) for v in passed
    )
    assert framing.take_float({}, "key", low=0.0, high=1.0) is None
    assert framing.take_float({}, "key", low=0.0, high=1.0, default=0.5) == 0.5
    with pytest.raises(WireError, match=r"envelope key 'key' must be a number from 0.0 to 1.0"):
        framing.take_float({"key": 2}, "key", low=0.0, high=1.0)


def test_take_str() -> None:
    assert accepted(lambda e: framing.take_str(e, "key")) == ["", "a", "é\u4e2d"]
    assert accepted(lambda e: framing.take_str(e, "key", max_length=1)) == ["", "a"]
    assert framing.take_str({}, "key", default="d") == "d"
    with pytest.raises(WireError, match="must be a printable string of at most 3 characters"):
        framing.take_str({}, "key", max_length=3)


def test_take_strings() -> None:
    assert accepted(lambda e: framing.take_strings(e, "key")) == [[], ["a"]]
    assert framing.take_strings({}, "key") == []
    with pytest.raises(WireError):
        framing.take_strings({"key": ["ab"]}, "key", max_length=1)
    given_list = ["a"]
    assert framing.take_strings({"key": given_list}, "key") is not given_list


def test_take_texts() -> None:
    assert accepted(lambda e: framing.take_texts(e, "key")) == [{}, {"a": "b"}]
    assert framing.take_texts({}, "key") == {}
    pairs = {"a": "b", "c": "dé"}
    assert framing.take_texts({"key": pairs}, "key", max_items=2, max_length=2, max_bytes=6) == pairs
    for limit in ({"max_items": 1}, {"max_length": 1}, {"max_bytes": 5}):
        with pytest.raises(WireError):
            framing.take_texts({"key": pairs}, "key", **limit)


def test_take_bool() -> None:
    passed = accepted(lambda e: framing.take_bool(e, "key"))
    assert [id(value) for value in passed] == [id(True), id(False)]
    assert framing.take_bool({}, "key") is False
    assert framing.take_bool({}, "key", default=True) is True
