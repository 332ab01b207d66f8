"""What the trace of decisions is told of messages on their way out over one link. Pure.

Where every step is recorded (`DecisionTrace.steps`), a message leaves three records on its way: queued, sent,
acknowledged. Elsewhere it leaves none, and what is out of the ordinary is told once in `AGAIN_S` of each stream, so
that the cost does not grow with the traffic. Why a message is held is told when the reason is another than before.
"""

from collections.abc import Sequence
from typing import Final

from sern_core.link.definitions import PeerDefinitions
from sern_core.link.end import End
from sern_core.stream.coding import Coding
from sern_core.stream.out_channel import OutChannel
from sern_core.stream.out_message import OutMessage
from sern_core.vocabulary.message import Message
from sern_core.vocabulary.trace import Field, HoldReason, TraceEvent
from sern_core.vocabulary.types import DropReason

AGAIN_S: Final = 1.0
"""What lasts is told again after so long: else what came after would have pushed it out of the log."""
MAX_TRACED: Final = 100
"""The most of one run of dropped messages that the trace of decisions has."""


class SendTrace:
    """One link's. Where it is hot the caller asks first whether there is anything to tell."""

    __slots__ = ("_end", "_texts", "_told", "holding")

    def __init__(self, end: End, texts: PeerDefinitions) -> None:
        self._end = end
        self._texts = texts
        self.holding: dict[int, dict[HoldReason, float]] = {}
        """What was told of a channel, by id, since something of it was sent last: why it waits, and when that was."""
        self._told: dict[int, dict[str, float]] = {}  # without steps: what was told of a channel, and when

    @property
    def steps(self) -> bool:
        return self._end.trace.steps

    def forget(self, channel: OutChannel) -> None:
        """The channel is closed."""
        self.holding.pop(channel.channel_id, None)
        self._told.pop(channel.channel_id, None)

    # --- on the way in --------------------------------------------------------------------------------------------

    def submitted(self, channel: OutChannel, message: Message, accepted: bool, *, thinned: bool, now: float) -> None:
        """A message was offered. `thinned`: the one that it took the place of was left out by the adaptation."""
        gate = channel.gate
        if gate is not None and gate.left_out and self.steps:
            reason = HoldReason.ADAPTATION if thinned else HoldReason.RATE_CAP
            self._record(channel, TraceEvent.RATE_CAPPED, gate.left_out, now, **held_back(channel, reason))
        if not accepted:
            if self.steps or self._again(channel, TraceEvent.REFUSED, now):
                waits = {"waiting": channel.kept, "waiting_bytes": channel.held_bytes}
                self._record(channel, TraceEvent.REFUSED, message.seq, now, size_bytes=len(message.body), **waits)
        elif gate is not None and gate.newest is not None:
            reason = HoldReason.ADAPTATION if gate.newest_thinned else HoldReason.RATE_CAP
            if self.steps or self._news(channel, reason, now):
                self._record(channel, TraceEvent.HELD, message.seq, now, **held_back(channel, reason))
        elif channel.queue and channel.queue[-1].seq == message.seq:
            if self.steps:
                self.queued(channel, message.seq, len(message.body), now)
            if not channel.ready:
                self.unready(channel, now)
        elif channel.wanted is False and (self.steps or self._again(channel, DropReason.UNWANTED, now)):
            self._record(channel, TraceEvent.DROPPED, message.seq, now, reason=DropReason.UNWANTED)

    def queued(self, channel: OutChannel, seq: int, size_bytes: int, now: float) -> None:
        self._record(channel, TraceEvent.QUEUED, seq, now, size_bytes=size_bytes)

    def unready(self, channel: OutChannel, now: float, *, again: bool = True) -> None:
        """Something may wait in a channel of which nothing may be sent yet. `again`: say it once more in time."""
        if not again and self.unready_reason(channel) in self.holding.get(channel.channel_id, ()):
            return
        out = channel.active[0] if channel.active else channel.queue[0] if channel.queue else None
        if out is not None:
            self.held(channel, out, self.unready_reason(channel), now)

    def unready_reason(self, channel: OutChannel) -> HoldReason:
        """Why nothing of it may be sent yet."""
        if not self._end.established:
            return HoldReason.LINK_DOWN
        return HoldReason.DEFINITION if self._texts.peer_asked(channel.channel_id) else HoldReason.ANNOUNCEMENT

    def replayed(self, channel: OutChannel, outs: Sequence[OutMessage], now: float) -> None:
        """Latched messages wait to be sent again."""
        for out in outs[-MAX_TRACED:]:
            self._record(channel, TraceEvent.REPLAYED, out.seq, now, size_bytes=out.size)

    # --- what it waits for ----------------------------------------------------------------------------------------

    def held(self, channel: OutChannel, out: OutMessage, reason: HoldReason, now: float, **fields: Field) -> None:
        """`out` would be the next of its channel, and is passed over."""
        if self._news(channel, reason, now):
            more = channel.unbegun - (not out.started)
            if more > 0:
                fields["behind"] = more
            self._record(channel, TraceEvent.HELD, out.seq, now, reason=reason, **fields)

    def encoding(self, channel: OutChannel, out: OutMessage, now: float) -> None:
        """Its body is not ready."""
        if out.coding is Coding.HELD:
            self.held(channel, out, HoldReason.ENCODER, now)
        elif self.steps:
            self._record(channel, TraceEvent.ENCODING, out.seq, now, size_bytes=out.size)

    # --- on the way out -------------------------------------------------------------------------------------------

    def left(self, channel: OutChannel, out: OutMessage, started: bool, now: float) -> None:
        """A fragment left, `started`: not the first. What was held is told of in any case."""
        if not out.has_unsent:
            held = self.holding.pop(channel.channel_id, None)
            if held or self.steps:
                self._record(channel, TraceEvent.SENT, out.seq, now, size_bytes=out.size)
        elif not started and self.steps:
            self._record(channel, TraceEvent.BEGUN, out.seq, now, size_bytes=out.size)

    def acked(self, channel: OutChannel, out: OutMessage, now: float) -> None:
        self._record(channel, TraceEvent.ACKED, out.seq, now)

    def confirmed(self, channel: OutChannel, now: float) -> None:
        """Everybody has everything up to the channel's watermark."""
        if self.steps:
            self._record(channel, TraceEvent.CONFIRMED, channel.watermark, now)

    def lost(self, channel: OutChannel, again: Sequence[OutMessage], now: float) -> None:
        """Fragments of these messages were lost, one each time that one is in it, and are sent again."""
        if not self.steps and again and not self._again(channel, TraceEvent.LOST, now):
            return
        counts: dict[int, int] = {}
        for out in again:
            counts[out.seq] = counts.get(out.seq, 0) + 1
        for seq, fragments in list(counts.items())[:MAX_TRACED]:
            self._record(channel, TraceEvent.LOST, seq, now, fragments=fragments)

    def dropped(self, channel: OutChannel, outs: Sequence[OutMessage], reason: DropReason, now: float) -> None:
        """Messages were given up."""
        if not self.steps and not self._again(channel, reason, now):
            return
        for out in outs[:MAX_TRACED]:
            self._record(channel, TraceEvent.DROPPED, out.seq, now, reason=reason)

    # --- how ------------------------------------------------------------------------------------------------------

    def _news(self, channel: OutChannel, reason: HoldReason, now: float) -> bool:
        """Whether the reason is new since something of the channel was sent last, or was told long ago."""
        told = self.holding.setdefault(channel.channel_id, {})
        told_s = told.get(reason)
        if told_s is not None and now - told_s < AGAIN_S:
            return False
        told[reason] = now
        return True

    def _again(self, channel: OutChannel, what: str, now: float) -> bool:
        """Whether something of this kind may be told of the channel again."""
        told = self._told.setdefault(channel.channel_id, {})
        told_s = told.get(what)
        if told_s is not None and now - told_s < AGAIN_S:
            return False
        told[what] = now
        return True

    def _record(self, channel: OutChannel, event: TraceEvent, seq: int, now: float, **fields: Field) -> None:
        end, stream = self._end, channel.stream.id
        if stream.origin == end.name:
            end.trace.record(now, stream.topic, event, seq, peer=end.peer, **fields)
        else:  # streams of one topic count by themselves
            end.trace.record(now, stream.topic, event, seq, peer=end.peer, origin=stream.origin, **fields)


def held_back(channel: OutChannel, reason: HoldReason) -> dict[str, Field]:
    """Why a cap or the adaptation leaves a message out, with the rate or the share that it lets in."""
    if reason is HoldReason.ADAPTATION:
        return {"reason": reason, "share": channel.share}
    return {"reason": reason, "rate_hz": channel.spec.max_rate_hz or 0.0}
