"""A datagram while it is filled, and what is remembered of it until its fate is known. Pure."""

from typing import Final, NamedTuple

from sern_core.stream.out_channel import OutChannel
from sern_core.stream.out_message import OutMessage
from sern_core.vocabulary.types import PriorityClass
from sern_core.wire import framing

MIN_SHARE_BYTES: Final = 64
"""A fragment smaller than this is not worth its header: the datagram ends instead."""
VIEW_BYTES: Final = 32 * 1024
"""A fragment from this size on is not cut from its message but looked at there: a copy less, which takes half the time
at 64 kB and gives messages of 1 MB 5 % more throughput. Up to 16 kB a view costs as much as the copy, or more."""


class SentData(NamedTuple):
    """A fragment that a packet carried."""

    channel: OutChannel
    out: OutMessage
    generation: int
    start: int
    end: int


class SentWatermark(NamedTuple):
    """A delivered watermark that a packet carried."""

    channel_id: int


class SentPing(NamedTuple):
    """A packet that only asked for an acknowledgement."""


class Datagram:
    """Frames behind a header that is not written yet, the items that they carry, and their size with the header."""

    __slots__ = ("asks", "frames", "items", "size")

    def __init__(self) -> None:
        self.frames: list[framing.Datagram] = []
        self.items: list[SentData | SentWatermark | SentPing] = []
        self.size = framing.HEADER_BYTES
        self.asks = False
        """It carries a question, and so nothing else that is acknowledged."""

    def watermark(self, channel_id: int, seq: int) -> None:
        self.frames.append(framing.encode_watermark(channel_id, seq))
        self.items.append(SentWatermark(channel_id))
        self.size += framing.WATERMARK.size

    def ping(self) -> None:
        self.frames.append(framing.PING_FRAME)
        self.items.append(SentPing())
        self.asks = True

    def fragment(self, channel: OutChannel, out: OutMessage, limit: int, now: float) -> int:
        """Append one fragment of `out`; the datagram has at most `limit` bytes then. Returns by how many it grew."""
        message = out.message
        start, end = channel.take(out, max(limit - self.size - framing.DATA_FIRST_BYTES, MIN_SHARE_BYTES), now)
        self.items.append(SentData(channel, out, out.generation, start, end))
        flags = framing.FLAG_DROP_MARKER if message.drop_marker else 0
        if message.replay:
            flags |= framing.FLAG_REPLAY
        if channel.spec.priority is PriorityClass.CONTROL:
            flags |= framing.FLAG_URGENT
        if start == 0:
            age_s = now - message.born_s
            error_s = message.error_s + framing.AGE_UNIT_S  # the age itself is cut to its unit
            head = framing.encode_data_first(
                flags, channel.channel_id, out.seq, out.size, end, message.stamp_ns, age_s, message.codec, error_s
            )
        else:
            head = framing.encode_data_next(flags, channel.channel_id, out.seq, start, out.size, end - start)
        self.frames.append(head)
        if end - start == out.size:
            self.frames.append(message.body)
        elif end - start < VIEW_BYTES:
            self.frames.append(message.body[start:end])
        else:
            self.frames.append(memoryview(message.body)[start:end])
        grown = len(head) + end - start
        self.size += grown
        return grown
