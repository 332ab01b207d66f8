"""Codecs: round trips, gain, and everything a decoder must refuse, within its memory."""

import random
import sys
import tracemalloc

import lz4.block
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sern_core.bodies import codecs
from sern_core.bodies.codecs import SIZE, CodecProfile, Coder, decode, encode, quickest
from sern_core.vocabulary.codec_names import Codec, Compression
from sern_core.vocabulary.errors import CodecError
from tests.exploring import cases

if sys.version_info >= (3, 14):
    from compression import zstd as zstandard
else:
    from backports import zstd as zstandard

STEADY = settings(max_examples=cases(100))
PACKING = [mode for mode in codecs.LOSSLESS if mode is not Compression.NONE]
CAP = 1 << 20
TEXT = b"a robot drives along the hall and reports where it is; " * 200


@pytest.mark.parametrize("mode", PACKING)
@pytest.mark.parametrize("body", [TEXT, b"\0" * 100_000, bytes(range(256)) * 300], ids=["text", "zeros", "ramp"])
def test_round_trip(mode: Compression, body: bytes) -> None:
    codec, packed = encode(mode, body)
    assert codec is codecs.CODEC_OF[mode]
    assert len(packed) < len(body)
    assert codecs.raw_size(codec, packed) == len(body)
    assert decode(codec, packed, max_bytes=len(body)) == body


@given(body=st.binary(max_size=4000) | st.binary(max_size=40).map(lambda part: part * 50))
@STEADY
def test_any_body_comes_back(body: bytes) -> None:
    for mode in codecs.LOSSLESS:
        codec, packed = encode(mode, body)
        assert len(packed) <= len(body)
        assert decode(codec, packed, max_bytes=len(body)) == body


@pytest.mark.parametrize("mode", codecs.LOSSLESS)
def test_no_gain_is_sent_as_it_is(mode: Compression) -> None:
    noise = random.Random(7).randbytes(50_000)
    assert encode(mode, noise) == (Codec.NONE, noise)
    tiny = b"\0" * (codecs.MIN_BYTES - 1)
    assert encode(mode, tiny) == (Codec.NONE, tiny)


def test_a_gain_of_less_than_three_percent_is_none() -> None:
    noise = random.Random(7).randbytes(50_000)
    slight, some = noise + b"\0" * 1000, noise + b"\0" * 3000
    assert encode(Compression.ZSTD, slight) == (Codec.NONE, slight)
    assert encode(Compression.ZSTD, some)[0] is Codec.ZSTD


def zstd_body(claimed: int, frame: bytes) -> bytes:
    return SIZE.pack(claimed) + frame


FRAME = zstandard.compress(TEXT)
BLOCK = lz4.block.compress(TEXT, store_size=False)
NO_SIZE = zstandard.ZstdCompressor()
NAMELESS = NO_SIZE.compress(TEXT) + NO_SIZE.flush()
SKIPPABLE = b"\x50\x2a\x4d\x18" + (4).to_bytes(4, "little") + b"skip"
BAD = {
    "no size": (Codec.ZSTD, b"\0\0\1"),
    "zstd empty": (Codec.ZSTD, zstd_body(len(TEXT), b"")),
    "zstd claims more": (Codec.ZSTD, zstd_body(len(TEXT) + 1, FRAME)),
    "zstd claims less": (Codec.ZSTD, zstd_body(len(TEXT) - 1, FRAME)),
    "zstd truncated": (Codec.ZSTD, zstd_body(len(TEXT), FRAME[:-3])),
    "zstd trailing": (Codec.ZSTD, zstd_body(len(TEXT), FRAME + b"x")),
    "zstd twice": (Codec.ZSTD, zstd_body(2 * len(TEXT), FRAME + FRAME)),
    "zstd without its size": (Codec.ZSTD, zstd_body(len(TEXT), NAMELESS)),
    "zstd skippable": (Codec.ZSTD, zstd_body(0, SKIPPABLE)),
    "zstd skippable first": (Codec.ZSTD, zstd_body(len(TEXT), SKIPPABLE + FRAME)),
    "zstd damaged": (Codec.ZSTD, zstd_body(len(TEXT), FRAME[:9] + b"\xff\xff\xff" + FRAME[12:])),
    "lz4 for zstd": (Codec.ZSTD, zstd_body(len(TEXT), BLOCK)),
    "zstd for lz4": (Codec.LZ4, SIZE.pack(len(TEXT)) + FRAME),
    "lz4 empty": (Codec.LZ4, SIZE.pack(len(TEXT))),
    "lz4 claims more": (Codec.LZ4, SIZE.pack(len(TEXT) + 1) + BLOCK),
    "lz4 claims less": (Codec.LZ4, SIZE.pack(len(TEXT) - 1) + BLOCK),
    "lz4 truncated": (Codec.LZ4, SIZE.pack(len(TEXT)) + BLOCK[:-1]),
    "lz4 trailing": (Codec.LZ4, SIZE.pack(len(TEXT)) + BLOCK + b"\0"),
    "lz4 beyond its ratio": (Codec.LZ4, SIZE.pack(1 << 19) + b"\x10a" * 8),
    "unknown codec": (99, SIZE.pack(4) + b"abcd"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_is_not_an_encoded_body_is_refused(name: str) -> None:
    codec, body = BAD[name]
    with pytest.raises(CodecError) as caught:
        decode(codec, body, max_bytes=CAP)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("mode", PACKING)
def test_the_limit_holds_to_the_byte(mode: Compression) -> None:
    codec, packed = encode(mode, TEXT)
    assert decode(codec, packed, max_bytes=len(TEXT)) == TEXT
    with pytest.raises(CodecError, match="above the limit"):
        decode(codec, packed, max_bytes=len(TEXT) - 1)
    with pytest.raises(CodecError, match="above the limit"):
        decode(Codec.NONE, TEXT, max_bytes=len(TEXT) - 1)


def test_bombs_are_refused_within_the_cap() -> None:
    """64 MB of zeros in a few kilobytes, honest about their size, and lying about it."""
    zeros = bytes(64 << 20)
    frame, block = zstandard.compress(zeros), lz4.block.compress(zeros, store_size=False)
    del zeros
    assert len(frame) < 10_000
    bombs = [
        (Codec.ZSTD, zstd_body(64 << 20, frame)),
        (Codec.ZSTD, zstd_body(CAP, frame)),
        (Codec.ZSTD, zstd_body(0, frame)),
        (Codec.LZ4, SIZE.pack(64 << 20) + block),
        (Codec.LZ4, SIZE.pack(CAP) + block),
        (Codec.LZ4, SIZE.pack(CAP) + block[:100]),
    ]
    tracemalloc.start()
    try:
        for codec, body in bombs:
            with pytest.raises(CodecError):
                decode(codec, body, max_bytes=CAP)
        assert tracemalloc.get_traced_memory()[1] < 2 * CAP
    finally:
        tracemalloc.stop()


def mutated() -> st.SearchStrategy[tuple[int, bytes]]:
    @st.composite
    def build(draw: st.DrawFn) -> tuple[int, bytes]:
        codec, good = draw(st.sampled_from([encode(mode, TEXT) for mode in PACKING]))
        data = bytearray(good)
        for _ in range(draw(st.integers(0, 4))):
            at = draw(st.integers(0, len(data) - 1))
            match draw(st.integers(0, 2)):
                case 0:
                    data[at] = draw(st.integers(0, 255))
                case 1 if len(data) > 20:
                    del data[at : at + draw(st.integers(1, 8))]
                case _:
                    data[at:at] = draw(st.binary(max_size=8))
        return draw(st.sampled_from([int(codec), int(codec), 0, 1, 2, 5])), bytes(data)

    return build()


@given(case=mutated() | st.tuples(st.integers(0, 255), st.binary(max_size=200)))
@settings(STEADY, max_examples=cases(600))
def test_any_bytes_decode_to_what_they_claim_or_raise_codec_error(case: tuple[int, bytes]) -> None:
    codec, body = case
    try:
        raw = decode(codec, body, max_bytes=CAP)
    except CodecError:
        return
    assert len(raw) == codecs.raw_size(codec, body) <= CAP


def test_the_quickest_mode_depends_on_the_link() -> None:
    profiles = {
        Compression.LZ4: CodecProfile(0.8, 800e6),
        Compression.ZSTD: CodecProfile(0.7, 500e6),
        Compression.ZSTD_STRONG: CodecProfile(0.66, 100e6),
    }
    chosen = [quickest(profiles, PACKING, 1e6, rate) for rate in (50e3, 10e6, 60e6, 10e9)]
    assert chosen == [Compression.ZSTD_STRONG, Compression.ZSTD, Compression.ZSTD, Compression.NONE]
    assert quickest({}, PACKING, 1e6, 50e3) is Compression.NONE, "what was never measured is not chosen"
    useless = {Compression.LZ4: CodecProfile(0.98, 1e12)}
    assert quickest(useless, PACKING, 1e6, 50e3) is Compression.NONE


def test_a_coder_measures_with_the_clock_it_is_given() -> None:
    ticks = iter(range(100))
    coder = Coder(max_bytes=CAP, clock=lambda: float(next(ticks)))
    encoded = coder.encode(Compression.LZ4, TEXT)
    assert encoded.codec is Codec.LZ4
    assert encoded.elapsed_s == 1.0
    assert coder.decode(encoded.codec, encoded.body) == (TEXT, 1.0)


@pytest.mark.interpreted
def test_a_fault_of_a_codec_is_told_and_costs_one_body(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever a library raises: what is to be encoded goes as it is, what is to be decoded is undecodable."""
    from sern_core.bodies import codecs

    def broken(*_: object, **__: object) -> tuple[Codec, bytes]:
        raise ZeroDivisionError("injected")

    told: list[Exception] = []
    coder = Coder(max_bytes=10_000)
    coder.on_fault = told.append
    body = b"a" * 1000
    packed = coder.encode(Compression.ZSTD, body)
    monkeypatch.setattr(codecs, "encode", broken)
    monkeypatch.setattr(codecs, "decode", broken)
    assert coder.encode(Compression.ZSTD, body)[:2] == (Codec.NONE, body) and coder.unencodable == 1
    with pytest.raises(CodecError, match="its decoder has failed"):
        coder.decode(packed.codec, packed.body)
    assert [type(error) for error in told] == [ZeroDivisionError, ZeroDivisionError]
