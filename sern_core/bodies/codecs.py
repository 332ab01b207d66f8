"""Codecs of message bodies: what the codec byte of DATA says, and how a body is encoded and decoded. Pure.

An encoded body begins with the size of the raw one, so that memory is known before anything is unpacked:

    +-------------------+------------------------------------------+
    | raw size      u32 | LZ4 block, or one Zstandard frame, ...   |
    +-------------------+------------------------------------------+

`decode` returns exactly that many bytes or raises `CodecError`, whatever it is given, and never holds more than the
caller allows. Both libraries release the interpreter lock; `encode` and `decode` may run in any thread.

Levels were chosen by measurement (`python -m benchmarks.codecs`): on LiDAR clouds Zstandard 1 makes 0.69 of a body at
530 MB/s, 3 makes 0.67 at 310 MB/s, 9 0.66 at 105 MB/s and 15 nothing more at 23 MB/s; LZ4 0.80 at 850 MB/s. What has
structure (grids, images of still scenes) gains more between 1 and 9.
"""

import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from struct import Struct
from typing import Any, Final, NamedTuple

import lz4.block
from mypy_extensions import mypyc_attr

from sern_core.bodies import lossy
from sern_core.vocabulary.codec_names import Codec, Compression, LossyParams
from sern_core.vocabulary.errors import CodecError
from sern_core.vocabulary.types import Encoding

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

SIZE: Final = Struct("!I")
"""The size of the raw body in bytes, in front of every encoded one."""
MIN_BYTES: Final = 64
"""Smaller bodies are sent as they are: what a codec could save is less than the header around them."""
MAX_GAIN: Final = 0.97
"""An encoded body larger than this share of the raw one is not worth the receiver's time; the raw one is sent."""
INLINE_BYTES: Final = 8192
"""Bodies up to this size are encoded and decoded on the spot (under 100 µs, less than handing them to a thread and
back takes a loaded event loop); larger ones beside the event loop."""
ZSTD_LEVEL: Final = 1
ZSTD_STRONG_LEVEL: Final = 9
MAX_LZ4_RATIO: Final = 255
"""An LZ4 block cannot unpack to more than this many bytes for each of its own."""
ZSTD_MAGIC: Final = b"\x28\xb5\x2f\xfd"
MIN_WINDOW_LOG: Final = 10
MAX_WINDOW_LOG: Final = 27


CODEC_OF: Final = {
    Compression.NONE: Codec.NONE,
    Compression.LZ4: Codec.LZ4,
    Compression.ZSTD: Codec.ZSTD,
    Compression.ZSTD_STRONG: Codec.ZSTD,
    Compression.VOXEL_DRACO: Codec.DRACO,
    Compression.JPEG: Codec.JPEG,
}
LOSSLESS: Final = (Compression.NONE, Compression.LZ4, Compression.ZSTD, Compression.ZSTD_STRONG)
LOSSY: Final = {Compression.VOXEL_DRACO: lossy.CLOUD_TYPE, Compression.JPEG: lossy.IMAGE_TYPE}
"""Modes that lose something, and the type of message (ROS 1 spelling) that each is for."""
KNOWN_CODECS: Final = frozenset(Codec)


class Encoded(NamedTuple):
    """A body as it goes on the wire, and what it took to make it."""

    codec: Codec
    body: bytes
    elapsed_s: float


@dataclass(frozen=True, slots=True)
class LossyTopic:
    """The lossy modes that a topic allows, and what they need to know of it."""

    modes: tuple[Compression, ...]
    encoding: Encoding
    params: LossyParams


def encode(mode: Compression, body: bytes, topic: LossyTopic | None = None) -> tuple[Codec, bytes]:
    """`body` encoded by `mode`; (Codec.NONE, body) where that does not make it at least 3 % smaller.

    CodecError for a lossy mode that `topic` does not allow, that is not installed, or that cannot take this body.
    """
    size = len(body)
    if size < MIN_BYTES or mode is Compression.NONE:
        return Codec.NONE, body
    if mode in LOSSY:
        if topic is None or mode not in topic.modes:
            raise CodecError(f"{mode} loses something, and the topic does not allow it")
        pack = lossy.encode_cloud if mode is Compression.VOXEL_DRACO else lossy.encode_image
        out_bytes, packed = pack(body, topic.encoding, topic.params)
        if SIZE.size + len(packed) > MAX_GAIN * size:
            return Codec.NONE, body
        return CODEC_OF[mode], SIZE.pack(out_bytes) + packed
    if mode is Compression.LZ4:
        packed = lz4.block.compress(body, store_size=False)
    else:
        packed = zstd.compress(body, ZSTD_STRONG_LEVEL if mode is Compression.ZSTD_STRONG else ZSTD_LEVEL)
    if SIZE.size + len(packed) > MAX_GAIN * size:
        return Codec.NONE, body
    return CODEC_OF[mode], SIZE.pack(size) + packed


def raw_size(codec: int, body: bytes) -> int:
    """How large the body says it is when decoded: a claim of the sender's. Raises CodecError if it says nothing."""
    if codec == Codec.NONE:
        return len(body)
    if len(body) < SIZE.size:
        raise CodecError(f"an encoded body of {len(body)} bytes has no size in front")
    return int(SIZE.unpack_from(body)[0])


def decode(codec: int, body: bytes, *, max_bytes: int) -> bytes:
    """The raw body. CodecError for one that is damaged, lies about its size, or is larger than `max_bytes`."""
    size = raw_size(codec, body)
    if size > max_bytes:
        raise CodecError(f"a body of {len(body)} bytes would unpack to {size}, above the limit of {max_bytes}")
    if codec == Codec.NONE:
        return body
    decoder = _DECODERS.get(codec)
    if decoder is None:
        raise CodecError(f"codec {codec} is unknown")
    raw = decoder(memoryview(body)[SIZE.size :], size)
    if len(raw) != size:
        raise CodecError(f"a body unpacks to {len(raw)} bytes, not to the {size} it claims")
    return raw


def _unpack_lz4(packed: memoryview, size: int) -> bytes:
    if size > MAX_LZ4_RATIO * len(packed):
        raise CodecError(f"{len(packed)} bytes of LZ4 cannot unpack to {size}")
    try:
        raw: bytes = lz4.block.decompress(packed, uncompressed_size=size)
    except (lz4.block.LZ4BlockError, ValueError, MemoryError) as error:
        raise CodecError(f"a damaged LZ4 block ({error})") from None
    return raw


def _unpack_zstd(packed: memoryview, size: int) -> bytes:
    """One frame that names its own size, needs no dictionary, and ends where the body ends."""
    if packed[:4].tobytes() != ZSTD_MAGIC:
        raise CodecError("no Zstandard frame")
    try:
        info: Any = zstd.get_frame_info(packed)  # its sizes may be None, whatever its types say
        if info.decompressed_size != size:
            raise CodecError(f"a Zstandard frame of {info.decompressed_size} bytes in a body that claims {size}")
        if info.dictionary_id:
            raise CodecError(f"a Zstandard frame asks for dictionary {info.dictionary_id}")
        window_log = min(max(size.bit_length(), MIN_WINDOW_LOG), MAX_WINDOW_LOG)
        unpacker = zstd.ZstdDecompressor(options={zstd.DecompressionParameter.window_log_max: window_log})
        raw = unpacker.decompress(packed, max_length=size + 1)  # the one more lets it see the end of the frame
    except (zstd.ZstdError, ValueError, MemoryError) as error:
        raise CodecError(f"a damaged Zstandard frame ({error})") from None
    if not unpacker.eof:
        raise CodecError("a truncated Zstandard frame")
    if unpacker.unused_data:
        raise CodecError("bytes follow a Zstandard frame")
    return raw


_DECODERS: Final[dict[int, Callable[[memoryview, int], bytes]]] = {
    Codec.LZ4: _unpack_lz4,
    Codec.ZSTD: _unpack_zstd,
    Codec.DRACO: lossy.decode_cloud,
    Codec.JPEG: lossy.decode_image,
}


# What is known of codecs, and what they did --------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class CodecProfile:
    """What a mode makes of a topic's messages: encoded by raw size, and how fast it encodes (0: not measured)."""

    ratio: float
    speed_bytes_per_s: float

    def expected_s(self, nbytes: float, rate_bytes_per_s: float) -> float:
        """Time to encode and to send a body of `nbytes`: s·k/C + s/v."""
        encode_s = nbytes / self.speed_bytes_per_s if self.speed_bytes_per_s > 0.0 else 0.0
        return nbytes * self.ratio / rate_bytes_per_s + encode_s


RAW_PROFILE: Final = CodecProfile(1.0, 0.0)
"""Stands for mode `none`."""
PROFILE_GAIN: Final = 0.3
"""Share of the newest measurement in a profile."""


def blend(old: CodecProfile | None, new: CodecProfile) -> CodecProfile:
    """A profile with one more measurement in it."""
    if old is None:
        return new
    keep = 1.0 - PROFILE_GAIN
    return CodecProfile(
        keep * old.ratio + PROFILE_GAIN * new.ratio,
        keep * old.speed_bytes_per_s + PROFILE_GAIN * new.speed_bytes_per_s,
    )


def quickest(
    profiles: dict[Compression, CodecProfile], modes: Iterable[Compression], nbytes: float, rate_bytes_per_s: float
) -> Compression:
    """The mode with the smallest expected time s·k/C + s/v; what was never measured is not chosen."""
    best, best_s = Compression.NONE, RAW_PROFILE.expected_s(nbytes, rate_bytes_per_s)
    for mode in modes:
        profile = profiles.get(mode)
        if profile is not None and profile.ratio <= MAX_GAIN:
            expected_s = profile.expected_s(nbytes, rate_bytes_per_s)
            if expected_s < best_s:
                best, best_s = mode, expected_s
    return best


@dataclass(slots=True)
class CodecCounters:
    """What was encoded or decoded in one mode, from start on."""

    messages: int = 0
    raw_bytes: int = 0
    encoded_bytes: int = 0
    elapsed_s: float = 0.0

    def add(self, raw_bytes: int, encoded_bytes: int, elapsed_s: float) -> None:
        self.messages += 1
        self.raw_bytes += raw_bytes
        self.encoded_bytes += encoded_bytes
        self.elapsed_s += elapsed_s


class Coder:
    """Encodes and decodes for one process, and counts it. `clock` is a stopwatch in seconds; the core has none.

    `offload` takes work for other threads: it must run `work.run(clock)` anywhere, then `work.done()` where the core
    lives. Without it everything is done on the spot.
    """

    def __init__(
        self,
        *,
        max_bytes: int,
        clock: Callable[[], float] = lambda: 0.0,
        offload: "Callable[[Work], None] | None" = None,
        inline_bytes: int = INLINE_BYTES,
    ) -> None:
        self.max_bytes = max_bytes
        self.clock = clock
        self.offload = offload
        self.inline_bytes = inline_bytes
        self.encoded: dict[Compression, CodecCounters] = {mode: CodecCounters() for mode in list(Compression)[1:]}
        self.decoded: dict[Codec, CodecCounters] = {codec: CodecCounters() for codec in list(Codec)[1:]}
        self.undecodable = 0
        self.unencodable = 0
        """Bodies that a mode could not take; they were sent as they were."""
        self.on_fault: Callable[[Exception], None] = lambda _error: None
        """Told of what a codec raised that it must not; in any thread."""

    def encode(self, mode: Compression, body: bytes, topic: LossyTopic | None = None) -> Encoded:
        """What cannot be encoded comes back as it was."""
        start_s = self.clock()
        try:
            codec, encoded = encode(mode, body, topic)
        except CodecError:
            self.unencodable += 1
            codec, encoded = Codec.NONE, body
        except Exception as error:  # noqa: BLE001  (a library's fault must not hold the link: it goes as it is)
            self.unencodable += 1
            self.on_fault(error)
            codec, encoded = Codec.NONE, body
        return Encoded(codec, encoded, self.clock() - start_s)

    def decode(self, codec: int, body: bytes) -> tuple[bytes, float]:
        """The raw body and the seconds it took. Raises CodecError."""
        start_s = self.clock()
        try:
            raw = decode(codec, body, max_bytes=self.max_bytes)
        except CodecError:
            raise
        except Exception as error:
            self.on_fault(error)
            raise CodecError(f"its decoder has failed ({type(error).__name__})") from error
        return raw, self.clock() - start_s


@mypyc_attr(allow_interpreted_subclasses=True)  # tests have works of their own
class Work(ABC):
    """Something that takes long: `run` in any thread, then `done` where the core lives, then the link is polled."""

    priority: int = 2
    """The class of the message: lower goes first."""

    @abstractmethod
    def run(self) -> None:
        """The long part; touches nothing of the core."""

    @abstractmethod
    def done(self, *, now: float) -> None:
        """Give the result to whoever asked."""
