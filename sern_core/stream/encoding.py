"""Encoding on the way out: in which mode, when, and where.

A body is encoded when its message is chosen for the link, not when it is queued: what is dropped before costs nothing.
Small ones on the spot; a larger one is withdrawn from the scheduler while other threads work on it (`EncodeRequest`),
and others go first meanwhile. From then on it counts as begun, like one whose first fragment has been sent: a newer
sample of its topic does not take its place, or a topic faster than its codec would never send anything. It still
expires. At most `MAX_RUNNING` are encoded at a time; who comes later waits without having begun.
"""

from collections.abc import Callable
from typing import Final

from sern_core.bodies.codecs import MIN_BYTES, CodecProfile, Coder, Encoded, Work, blend
from sern_core.stream.coding import ChannelCodec, Coding
from sern_core.stream.out_channel import OutChannel
from sern_core.stream.out_message import OutMessage
from sern_core.vocabulary.codec_names import Codec, Compression
from sern_core.vocabulary.message import Message
from sern_core.vocabulary.types import PriorityClass

PROBE_EVERY: Final = 50
"""One message in so many is encoded in every mode, to know what each makes of the topic."""
MAX_RUNNING: Final = 2
"""Bodies of one link that other threads encode at a time: what leaves next, and one behind it."""


class EncodeRequest(Work):
    """One body that another thread is to encode."""

    __slots__ = ("channel", "encoder", "message", "mode", "out", "priority", "result", "topic")

    def __init__(self, encoder: "Encoder", channel: OutChannel, out: OutMessage, mode: Compression) -> None:
        self.encoder = encoder
        self.channel = channel
        self.out = out
        self.message = out.message
        self.mode = mode
        self.topic = None if channel.codec is None else channel.codec.topic
        self.priority = int(channel.spec.priority)
        self.result: Encoded | None = None

    def run(self) -> None:
        self.result = self.encoder.coder.encode(self.mode, self.message.body, self.topic)

    def done(self, *, now: float) -> None:
        self.encoder.encoded(self, now=now)


class ProbeRequest(Work):
    """One body that is encoded in every mode, to measure."""

    __slots__ = ("body", "codec", "coder", "priority", "results")

    def __init__(self, coder: Coder, codec: ChannelCodec, body: bytes) -> None:
        self.coder = coder
        self.codec = codec
        self.body = body
        self.priority = int(PriorityClass.BULK) + 1
        self.results: dict[Compression, CodecProfile] = {}

    def run(self) -> None:
        size = len(self.body)
        for mode in self.codec.modes:
            encoded = self.coder.encode(mode, self.body, self.codec.topic)
            speed = size / encoded.elapsed_s if encoded.elapsed_s > 0.0 else 0.0
            self.results[mode] = CodecProfile(len(encoded.body) / size, speed)

    def done(self, *, now: float) -> None:
        codec = self.codec
        codec.probing = False
        codec.due_s = now
        for mode, profile in self.results.items():
            codec.profiles[mode] = blend(codec.profiles.get(mode), profile)


class Encoder:
    """The encoding of one link. `refresh` tells its scheduler that what a channel would send next has changed."""

    def __init__(
        self, coder: Coder, *, rate_bps: Callable[[], float | None], refresh: Callable[[OutChannel, float], None]
    ) -> None:
        self.coder = coder
        self.running = 0
        self._rate_bps = rate_bps
        self._refresh = refresh
        self._held: list[tuple[OutChannel, OutMessage]] = []

    def ready(self, channel: OutChannel, out: OutMessage, codec: ChannelCodec, *, now: float) -> bool:
        """The scheduler has chosen `out`, whose body nobody has looked at: may it go now? False: not yet."""
        message = out.message
        size = out.size
        if size < MIN_BYTES or message.drop_marker or message.codec:
            out.coding = Coding.DONE
            return True
        if codec.messages_to_probe <= 0 and not codec.probing:
            self._probe(codec, message.body)
        mode = codec.choose(size, self._rate_bps(), now)
        if mode is Compression.NONE:
            self._apply(channel, out, codec, None, mode)
            return True
        coder = self.coder
        if size <= coder.inline_bytes or coder.offload is None:
            self._apply(channel, out, codec, coder.encode(mode, message.body, codec.topic), mode)
            return True
        if self.running >= MAX_RUNNING:
            out.coding = Coding.HELD
            self._held.append((channel, out))
            return False
        out.coding = Coding.RUNNING
        self.running += 1
        if not out.started:
            channel.begin(out, now)
        coder.offload(EncodeRequest(self, channel, out, mode))
        return False

    def _probe(self, codec: ChannelCodec, body: bytes) -> None:
        codec.messages_to_probe = PROBE_EVERY
        codec.probing = True
        probe = ProbeRequest(self.coder, codec, body)
        if len(body) <= self.coder.inline_bytes or self.coder.offload is None:
            probe.run()
            probe.done(now=-float("inf"))
        else:
            self.coder.offload(probe)

    def _apply(
        self, channel: OutChannel, out: OutMessage, codec: ChannelCodec, encoded: Encoded | None, mode: Compression
    ) -> None:
        """The body is what it will be. None: as it was."""
        size = out.size
        codec.messages_to_probe -= 1
        out.coding = Coding.DONE
        if encoded is not None:
            self.coder.encoded[mode].add(size, len(encoded.body), encoded.elapsed_s)
            if encoded.codec is not Codec.NONE:
                old = out.message
                new = Message(
                    old.stream,
                    old.seq,
                    encoded.body,
                    old.stamp_ns,
                    old.born_s,
                    0,
                    old.replay,
                    old.error_s,
                    encoded.codec,
                )
                channel.recoded(out, new)
        codec.measured(size, out.size)

    def encoded(self, request: EncodeRequest, *, now: float) -> None:
        """Another thread is through with a body. If the message was dropped meanwhile, it stays dropped."""
        self.running -= 1
        channel, out = request.channel, request.out
        try:
            if out.coding is Coding.RUNNING and out.message is request.message and channel.codec is not None:
                self._apply(channel, out, channel.codec, request.result, request.mode)
        finally:  # whoever waits for a turn must not wait for ever
            self._refresh(channel, now)
            held, self._held = self._held, []
            for other, waiting in held:
                if waiting.coding is Coding.HELD:
                    waiting.coding = Coding.RAW
                    self._refresh(other, now)
