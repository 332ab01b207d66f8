"""What leaves, message by message: channels queue, the scheduler chooses whose next fragment goes. Pure.

The next fragment is chosen only when the lane can take it (late binding), so that nothing waits where it can no longer
be overtaken. `DataPlane` asks, and puts what is chosen into datagrams.
"""

from collections.abc import Callable
from math import inf

from sern_core.bodies.codecs import LOSSY, Coder, LossyTopic
from sern_core.link.end import End
from sern_core.link.send_trace import SendTrace
from sern_core.path.period import Cadences
from sern_core.stream.coding import ChannelCodec, Coding
from sern_core.stream.encoding import Encoder
from sern_core.stream.out_channel import OutChannel
from sern_core.stream.out_message import OutMessage
from sern_core.stream.scheduler import Scheduler
from sern_core.vocabulary.codec_names import Compression
from sern_core.vocabulary.ledger import SendLedger
from sern_core.vocabulary.message import Message, StreamInfo
from sern_core.vocabulary.names import plain_type
from sern_core.vocabulary.params import SchedulerParams
from sern_core.vocabulary.types import CLASS_LABELS, DropReason, Ordering, PriorityClass


class Sender:
    """Queues and scheduler of one end. `delivered` is told when the peer's watermark of a channel has moved."""

    def __init__(
        self,
        end: End,
        scheduler: SchedulerParams,
        told: SendTrace,
        *,
        delivered: Callable[[OutChannel], None],
        now: float,
    ) -> None:
        self._end = end
        self.told = told
        """What the trace of decisions is told of messages on their way out."""
        self._delivered = delivered
        self.scheduler = Scheduler(scheduler, now=now)
        self.paper = scheduler.ordering is Ordering.PAPER
        """The paper's own order, which drops what is stale when it would be its turn."""
        self.channels: dict[int, OutChannel] = {}
        self.ledger = SendLedger()
        """Counters of what goes out, by topic."""
        self.cadences = Cadences()
        """When class 0 will want the link again."""
        self.encoder: Encoder | None = None
        """Encodes bodies on their way out; None: they go as they come."""
        self.lapsed = 0
        """Messages that sweeps have let go of so far, and what they looked at beside."""
        self.held_back_due_s = inf
        """When a message that a rate cap holds back may go, or earlier."""
        self._held_back: set[int] = set()  # channels with such a message

    # --- messages -------------------------------------------------------------------------------------------------

    def submit(self, channel: OutChannel, message: Message, *, now: float, forced: bool = False) -> bool:
        """Offer a message of an open channel. False: refused, the reliable queue is full.

        `forced` is for forwarding: rate cap and reliable bound were enforced at the origin.
        """
        end = self._end
        end.now = now
        nbytes = len(message.body)
        if nbytes > end.params.max_message_bytes:
            self.reject(channel, message, DropReason.TOO_LARGE, now=now)
            return True
        if channel.spec.priority is PriorityClass.CONTROL and not message.replay:
            self.cadences.arrived(channel.channel_id, now=now)
        backlog = channel.offered
        gate = channel.gate
        thinned = 0 if gate is None else gate.thinned
        accepted = channel.submit(message, now=now, forced=forced)
        if gate is not None and gate.newest is not None:
            self._held_back.add(channel.channel_id)
            self.held_back_due_s = min(self.held_back_due_s, gate.newest_due_s)
            end.dirty = True  # the owner looks at the deadline again
        trace = end.trace
        if trace.enabled and (
            trace.steps or not (accepted and channel.ready and channel.wanted and (gate is None or gate.newest is None))
        ):
            thins = gate is not None and gate.thinned > thinned
            self.told.submitted(channel, message, accepted, thinned=thins, now=now)
        if not backlog or channel.coalesced:
            self.refresh(channel, now)
        return accepted

    def release_held_back(self, now: float) -> None:
        """Messages that a rate cap held back, and that nothing newer has replaced, go on when their time comes."""
        due_s = inf
        for channel_id in list(self._held_back):
            channel = self.channels.get(channel_id)
            if channel is not None and channel.release(now):
                if self._end.trace.steps:
                    self.told.queued(channel, channel.queue[-1].seq, channel.queue[-1].size, now)
                self.refresh(channel, now)
            if channel is None or channel.newest is None:
                self._held_back.discard(channel_id)
            else:
                due_s = min(due_s, channel.newest_due_s)
        self.held_back_due_s = due_s

    def reject(self, channel: OutChannel, message: Message, reason: DropReason, *, now: float) -> None:
        """Drop a message on its way in; of a reliable stream a drop marker goes on in its place."""
        self._end.now = now
        channel.reject(message, reason)
        self.refresh(channel, now)

    def abandon(self, channel: OutChannel, seq: int, reason: DropReason, *, now: float) -> bool:
        """Give up message `seq` of a reliable stream, if nothing of it was sent; its receiver is told."""
        self._end.now = now
        abandoned = channel.abandon(seq, reason)
        self.refresh(channel, now)
        return abandoned

    def shed(self, channel: OutChannel, room_bytes: int, reason: DropReason, *, now: float) -> int:
        """Give up messages that wait and have not been begun until the channel's `kept_bytes` is less by `room_bytes`;
        returns by how much it is less, 0: there was none."""
        self._end.now = now
        freed_bytes = channel.shed(room_bytes, reason)
        self.refresh(channel, now)
        if channel.gaps and channel.watermark >= channel.gaps[0][0]:  # nothing of the stream is left before it
            self._delivered(channel)
        return freed_bytes

    def watermark(self, channel: OutChannel, seq: int, now: float) -> int:
        """The peer has everything of a reliable channel up to `seq`; returns how many messages are let go of."""
        before = channel.watermark
        done = channel.delivered_to(seq)
        if self._end.trace.enabled and channel.watermark > before:
            self.told.confirmed(channel, now)
        self.refresh(channel, now)
        self._delivered(channel)
        return done

    def lost(self, fragments: dict[OutChannel, list[tuple[OutMessage, int, int, int]]], now: float) -> None:
        """Fragments (message, generation, start, end) did not arrive: send again what is still wanted."""
        end = self._end
        for channel, some in fragments.items():
            again = channel.fragments_lost(some, now=now)
            if end.trace.enabled and self.channels.get(channel.channel_id) is channel:
                self.told.lost(channel, again, now)
            if self.channels.get(channel.channel_id) is channel:
                self.refresh(channel, now)

    def sweep(self, now: float) -> bool:
        """Expire what nobody will send, also while the link is down. True: that was all."""
        if now >= self.held_back_due_s:
            self.release_held_back(now)
        most = room = self._end.params.limits.lapsed_a_sweep
        for channel in list(self.channels.values()):
            watermark = channel.watermark
            room -= channel.sweep(now, up=self._end.established, room=room)
            if self._end.trace.enabled and not channel.ready:
                self.told.unready(channel, now, again=False)
            if channel.offered or channel.active:
                self.refresh(channel, now)
            if channel.watermark > watermark:
                self._delivered(channel)
        self.lapsed += most - room
        return room > 0

    # --- what goes next -------------------------------------------------------------------------------------------

    def refresh(self, channel: OutChannel, now: float) -> None:
        """Tell the scheduler what this channel would send next."""
        out = channel.head(now) if channel.ready and channel.wanted else None
        if out is None:
            if channel.offered:
                channel.offered = False
                self.scheduler.withdraw(channel.channel_id)
            return
        size_bytes = float(out.unsent_bytes)
        codec = channel.codec
        if codec is not None and out.coding is not Coding.DONE:
            if out.withheld:
                channel.offered = True
                self.scheduler.withdraw(channel.channel_id, encoding=True)
                return
            size_bytes *= codec.ratio
        spec = channel.spec
        since_s = out.message.born_s
        if channel.coalesced:
            # With message age each new sample would reset the priority, and the topic could starve: also one of which
            # nothing was sent yet, beside others of its rate.
            if channel.waits_since_s is None:
                channel.waits_since_s = since_s
            since_s = channel.waits_since_s
        channel.offered = True
        self._end.dirty = True
        self.scheduler.offer(
            channel.channel_id,
            priority=class_of(channel, out),
            weight=spec.weight,
            size_bytes=size_bytes,
            since_s=since_s,
            stale_after_s=spec.lifespan_s if self.paper else None,
            background=spec.background,
        )

    def pick(self, now: float, *, window_open: bool) -> int | None:
        """The scheduler's choice; under `ordering: paper` what it found stale is dropped first."""
        channel_id = self.scheduler.pick(now=now, window_open=window_open)
        if self.paper:
            for stale in self.scheduler.take_stale(now):
                channel = self.channels[stale]
                channel.drop_head(DropReason.STALE, now)
                self.refresh(channel, now)
        return channel_id

    @property
    def pending(self) -> bool:
        """Whether more could be sent if the window allowed it."""
        return self.scheduler.pends

    def queued(self) -> dict[str, tuple[int, int]]:
        """Messages and bytes that wait for the lane, by class label."""
        cells = {label: [0, 0] for label in CLASS_LABELS}
        for channel in self.channels.values():
            cell = cells[CLASS_LABELS[channel.spec.priority]]
            cell[0] += len(channel.queue) + len(channel.active)
            cell[1] += channel.queued_bytes + sum(out.unsent_bytes for out in channel.active)
        return {label: (messages, nbytes) for label, (messages, nbytes) in cells.items()}

    # --- encoding -------------------------------------------------------------------------------------------------

    def set_compression(self, channel: OutChannel, setting: Compression | None, *, now: float) -> None:
        """Use another mode from the next body on (None: auto). Nothing is lost or changes its place."""
        if channel.codec is not None:
            channel.codec.use(setting)
            self._end.now = now
            self.refresh(channel, now)

    def encode_with(self, coder: Coder, rate_bps: Callable[[], float | None]) -> None:
        """Encode the bodies of all channels that are opened from now on."""
        self.encoder = Encoder(coder, rate_bps=rate_bps, refresh=self._recoded)

    def new_codec(self, stream: StreamInfo) -> ChannelCodec | None:
        """How bodies of this stream are encoded; None: they are not."""
        if self.encoder is None:
            return None
        spec, info = stream.spec, stream.info
        modes = tuple(mode for mode in spec.lossy if LOSSY[mode] == plain_type(info.type_name))
        setting = spec.compression
        if setting in LOSSY and setting not in modes:
            setting = None  # of a rule for several types
        return ChannelCodec(setting, LossyTopic(modes, info.encoding, spec.lossy_params) if modes else None)

    def encoded(self, channel: OutChannel, out: OutMessage, now: float) -> bool:
        """Whether the body of what was chosen can go now. If not, it comes back when it is encoded."""
        assert self.encoder is not None and channel.codec is not None
        if self.encoder.ready(channel, out, channel.codec, now=now):
            return True
        if self._end.trace.enabled:
            self.told.encoding(channel, out, now)
        self.refresh(channel, now)
        return False

    def _recoded(self, channel: OutChannel, now: float) -> None:
        """A body is encoded, or may be now."""
        self._end.now = now
        if self.channels.get(channel.channel_id) is channel:
            self.refresh(channel, now)

    def validate(self, check: Callable[[bool, str], None]) -> None:
        """Internal consistency, for tests."""
        channels = self.channels.values()
        for channel in channels:
            channel.validate(check)
            waits = bool(channel.ready and channel.wanted and (channel.active or channel.queue))
            check(waits == channel.offered, f"{channel.stream.id.topic}: the scheduler does not know what waits")
        self.ledger.validate([(channel.counters, *channel.held()) for channel in channels], check)
        self.scheduler.validate()


def class_of(channel: OutChannel, out: OutMessage) -> PriorityClass:
    """A replay for a late joiner competes with deferrable traffic only, never with live state."""
    return PriorityClass.BULK if out.message.replay else channel.spec.priority
