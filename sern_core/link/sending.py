"""The sending half of the data plane: messages queue, the scheduler chooses, datagrams are composed.

The next fragment is chosen only when the lane can take it (late binding), so that nothing waits where it can no longer
be overtaken. A datagram carries an acknowledgement if one is owed, watermarks, control messages, and fragments of one
class.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from math import inf
from typing import Any, Final, NamedTuple

from sern_core.bodies.codecs import LOSSY, Coder, LossyTopic
from sern_core.path.clocksync import ClockSync
from sern_core.path.lanes import COPY_DELAY_S, LANE_ZMQ, OVERHEAD_BYTES, PING_INTERVAL_S, PROBE_INTERVAL_S, Lane
from sern_core.path.period import Cadences
from sern_core.stream.coding import ChannelCodec, Coding
from sern_core.stream.encoding import Encoder
from sern_core.stream.in_stream import InStream, Reassembly
from sern_core.stream.out_channel import OutChannel
from sern_core.stream.out_message import OutMessage
from sern_core.stream.scheduler import Scheduler
from sern_core.vocabulary.codec_names import Compression
from sern_core.vocabulary.ledger import SendCounters, SendLedger
from sern_core.vocabulary.message import Message, StreamId, StreamInfo, TopicInfo, TopicSpec
from sern_core.vocabulary.names import plain_type
from sern_core.vocabulary.params import LinkParams, SchedulerParams
from sern_core.vocabulary.trace import DecisionTrace, TraceEvent
from sern_core.vocabulary.types import (
    ClientName,
    DropReason,
    Encoding,
    Ordering,
    PriorityClass,
    Reliability,
    TopicName,
)
from sern_core.wire import framing

CONTROL_CHANNEL: Final = 0
CONTROL_TOPIC: Final = TopicName("/_sern/control")
SWEEP_INTERVAL_S: Final = 0.25
RATE_INTERVAL_S: Final = 0.05
MIN_SHARE_BYTES: Final = 64
"""A fragment smaller than this is not worth its header: the datagram ends instead."""
CRUMB: Final = 32
"""A datagram with less than 1/32 of its size free is sent as it is."""
RIDE_BYTES: Final = 256
"""Most bytes of a control message that travel with each datagram of class 0. Where class 0 alone keeps the window shut,
what would open a better lane, or another stream, must come through all the same."""
MAX_WATERMARKS: Final = 64


class SentData(NamedTuple):
    """A fragment that a packet carried."""

    channel: OutChannel
    out: OutMessage
    generation: int
    start: int
    end: int


class SentWatermark(NamedTuple):
    """A delivered watermark that a packet carried."""

    channel: int


class SentPing(NamedTuple):
    """A packet that only asked for an acknowledgement."""


def microseconds(now: float) -> int:
    return int(now * 1e6)


class Sender(ABC):
    """Queues, scheduler, flight and reassembly of one end. `boot` is this process's random 63-bit number."""

    def __init__(
        self,
        *,
        name: ClientName,
        boot: int,
        peer: ClientName,
        link: LinkParams,
        scheduler: SchedulerParams,
        trace: DecisionTrace,
        now: float,
        lossless: bool,
    ) -> None:
        self.name = name
        self.boot = boot
        self.peer = peer
        self.params = link
        self.lane = Lane(LANE_ZMQ, link, lossless=lossless)
        """The lane that carries data now."""
        self.lanes = {LANE_ZMQ: self.lane}
        self.express: Lane | None = None
        """The lane that carries class control beside it, if there is one."""
        self.scheduler = Scheduler(scheduler, now=now)
        self._paper = scheduler.ordering is Ordering.PAPER
        self.trace = trace
        self.clock = ClockSync()
        self.ledger = SendLedger()
        """Counters of what goes out, by topic."""
        self.encoder: Encoder | None = None
        """Encodes bodies on their way out; None: they go as they come."""
        self.on_arrived: Callable[[OutChannel, OutMessage, float], None] | None = None
        """Called when the peer has a message whole: channel, message, now."""
        self.wire_bytes = 0
        """Bytes of numbered datagrams sent so far, second copies and headers included."""
        self.strays = 0  # fragments of streams that are unknown here
        self.on_stray: Callable[[], None] | None = None
        """Called for each message of a stream that is unknown here (drop reason `unknown_channel`)."""
        self.channels: dict[int, OutChannel] = {}
        self.incoming: dict[int, InStream] = {}
        """Streams of the session by the peer's channel number."""
        self._half_read = False  # a datagram, of which nothing may be acknowledged
        self.reassembly = Reassembly(max(64 * 2**20, 2 * link.max_message_bytes))
        self.established = False
        self.version = framing.VERSION_MAX
        self.tag = boot % 255  # so that a late datagram of an earlier process is not taken for one of ours
        self.dirty = False
        """Something may be sendable: the owner should poll `next_datagram`. Set by every call that changes anything."""
        self._unsaid = False  # answers or reports about the peer's streams wait to be told
        self._rx_lane = self.lane
        self._sweep_due_s = now + SWEEP_INTERVAL_S
        self.lapsed = 0
        """Messages that sweeps have let go of so far, and what they looked at beside."""
        self._rate_due_s = now
        self._up_since_s = now
        self.cadences = Cadences()
        """When class 0 will want the link again."""
        self._held_back: set[int] = set()  # channels with a message that a rate cap holds back
        self._held_back_due_s = inf  # when one of them may go, or earlier
        self._watermarks: dict[int, int] = {}  # channel -> delivered, not yet on the wire
        self._rx_stamp_us = 0
        self._rx_delay: tuple[float, float, float] | None = None
        """Delay of the datagram at hand, its uncertainty, and for how long the clocks had not shifted."""
        self._now = now
        self._control, self._control_in = self._control_streams()

    # --- what the control plane provides --------------------------------------------------------------------------

    @abstractmethod
    def _control_message(self, stream: InStream, message: Message) -> None: ...

    @abstractmethod
    def _in_drop(
        self, stream: InStream, reason: DropReason, nbytes: int, seqs: Sequence[int], reported: bool
    ) -> None: ...

    @abstractmethod
    def _control_sent(self, seq: int) -> None:
        """Control message `seq` is on the wire."""

    @abstractmethod
    def _say(self, now: float) -> None:
        """Queue control messages with answers and reports that are due."""

    @abstractmethod
    def _say_deadline(self) -> float:
        """When `_say` has something to say by time alone."""

    @abstractmethod
    def _watermark_moved(self, channel: OutChannel) -> None: ...

    @abstractmethod
    def _give_back(self, lane: Lane, items: list[Any], now: float) -> None:
        """What packets carried did not arrive: send again what is still wanted."""

    @abstractmethod
    def fault(self, error: Exception) -> None:
        """Something raised what nobody expects: tell the owner. What it was about is given up by the caller."""

    def _begin_control(self) -> None:
        """A fresh control stream in both directions, for a new session."""
        self._control_in.close()
        self._control, self._control_in = self._control_streams()

    def _control_streams(self) -> tuple[OutChannel, InStream]:
        spec = TopicSpec(
            priority=PriorityClass.CONTROL,
            reliability=Reliability.RELIABLE,
            lifespan_s=None,
            retention_s=float("inf"),
            max_queue_bytes=2**62,
        )
        info = TopicInfo(CONTROL_TOPIC, "", Encoding.RAW)
        stream = StreamInfo(StreamId(self.name, self.boot, CONTROL_TOPIC), info, spec)
        counters = SendCounters(CONTROL_TOPIC, PriorityClass.CONTROL)
        control = OutChannel(CONTROL_CHANNEL, stream, counters, lambda _channel, _outs, _reason: None, first=1)
        control.wanted = control.ready = True
        return control, InStream(stream, self.reassembly, self._control_message, self._in_drop, first=1)

    # --- messages out ---------------------------------------------------------------------------------------------

    def submit(self, channel: OutChannel, message: Message, *, now: float, forced: bool = False) -> bool:
        """Offer a message of an open channel. False: refused, the reliable queue is full.

        `forced` is for forwarding: rate cap and reliable bound were enforced at the origin.
        """
        self._now = now
        nbytes = len(message.body)
        if nbytes > self.params.max_message_bytes:
            self.reject(channel, message, DropReason.TOO_LARGE, now=now)
            return True
        if channel.spec.priority is PriorityClass.CONTROL and not message.replay:
            self.cadences.arrived(channel.slot, now=now)
        backlog = channel.offered
        thinned = channel.thinned
        accepted = channel.submit(message, now=now, forced=forced)
        if channel.newest is not None:
            self._held_back.add(channel.slot)
            self._held_back_due_s = min(self._held_back_due_s, channel.newest_due_s)
            self.dirty = True  # the owner looks at the deadline again
        if self.trace.enabled:
            topic = message.stream.topic
            if channel.left_out:
                why = _why_capped(channel, channel.thinned > thinned)
                self.trace.record(now, topic, TraceEvent.RATE_CAPPED, seq=channel.left_out, reason=why)
            if channel.newest is not None:
                why = _why_capped(channel, channel.newest_thinned)
                self.trace.record(now, topic, TraceEvent.HELD, seq=message.seq, reason=why, peer=self.peer)
            else:
                event = TraceEvent.QUEUED if accepted else TraceEvent.REFUSED
                self.trace.record(now, topic, event, seq=message.seq, peer=self.peer)
        channel.left_out = 0
        if not backlog or channel.coalesced:
            self._refresh(channel, now)
        return accepted

    def _release_held_back(self, now: float) -> None:
        """Messages that a rate cap held back, and that nothing newer has replaced, go on when their time comes."""
        due_s = inf
        for slot in list(self._held_back):
            channel = self.channels.get(slot)
            if channel is not None and channel.release(now):
                topic = channel.stream.id.topic
                self.trace.record(now, topic, TraceEvent.QUEUED, seq=channel.queue[-1].seq, peer=self.peer)
                self._refresh(channel, now)
            if channel is None or channel.newest is None:
                self._held_back.discard(slot)
            else:
                due_s = min(due_s, channel.newest_due_s)
        self._held_back_due_s = due_s

    def reject(self, channel: OutChannel, message: Message, reason: DropReason, *, now: float) -> None:
        """Drop a message on its way in; of a reliable stream a tombstone goes on in its place."""
        self._now = now
        channel.reject(message, reason)
        self.trace.record(now, message.stream.topic, TraceEvent.DROPPED, seq=message.seq, reason=reason)
        self._refresh(channel, now)

    def abandon(self, channel: OutChannel, seq: int, reason: DropReason, *, now: float) -> bool:
        """Give up message `seq` of a reliable stream, if nothing of it was sent; its receiver is told."""
        self._now = now
        abandoned = channel.abandon(seq, reason)
        self._refresh(channel, now)
        return abandoned

    def shed(self, channel: OutChannel, room_bytes: int, reason: DropReason, *, now: float) -> int:
        """Give up messages that wait and have not been begun until the channel's `kept_bytes` is less by `room_bytes`;
        returns by how much it is less, 0: there was none."""
        self._now = now
        freed_bytes = channel.shed(room_bytes, reason)
        self._refresh(channel, now)
        if channel.gaps and channel.watermark >= channel.gaps[0][0]:  # nothing of the stream is left before it
            self._watermark_moved(channel)
        return freed_bytes

    def _refresh(self, channel: OutChannel, now: float) -> None:
        """Tell the scheduler what this channel would send next."""
        out = channel.head(now) if channel.ready and channel.wanted else None
        if out is None:
            if channel.offered:
                channel.offered = False
                self.scheduler.withdraw(channel.slot)
            return
        size_bytes: float = out.unsent_bytes
        codec = channel.codec
        if codec is not None and out.coding is not Coding.DONE:
            if out.withheld:
                channel.offered = True
                self.scheduler.withdraw(channel.slot, encoding=True)
                return
            size_bytes *= codec.ratio
        spec = channel.spec
        since_s = out.message.born_s
        if channel.coalesced and channel.last_sent_s is not None:
            # With message age each new sample would reset the priority, and the topic could starve.
            since_s = channel.last_sent_s
        channel.offered = True
        self.dirty = True
        self.scheduler.offer(
            channel.slot,
            priority=_class_of(channel, out),
            weight=spec.weight,
            size_bytes=size_bytes,
            since_s=since_s,
            stale_after_s=spec.lifespan_s if self._paper else None,
        )

    # --- encoding -------------------------------------------------------------------------------------------------

    def set_compression(self, channel: OutChannel, setting: Compression | None, *, now: float) -> None:
        """Use another mode from the next body on (None: auto). Nothing is lost or changes its place."""
        if channel.codec is not None:
            channel.codec.use(setting)
            self._now = now
            self._refresh(channel, now)

    def _encoded(self, channel: OutChannel, out: OutMessage, now: float) -> bool:
        """Whether the body of what was chosen can go now. If not, it comes back when it is encoded."""
        assert self.encoder is not None and channel.codec is not None
        if self.encoder.ready(channel, out, channel.codec, now=now):
            return True
        if self.trace.enabled:
            self.trace.record(now, out.message.stream.topic, TraceEvent.ENCODING, seq=out.seq, peer=self.peer)
        self._refresh(channel, now)
        return False

    def _recoded(self, channel: OutChannel, now: float) -> None:
        """A body is encoded, or may be now."""
        self._now = now
        if self.channels.get(channel.slot) is channel:
            self._refresh(channel, now)

    def encode_with(self, coder: Coder) -> None:
        """Encode the bodies of all channels that are opened from now on."""
        self.encoder = Encoder(coder, rate_bps=lambda: self.lane.estimator.rate_bps, refresh=self._recoded)

    def _new_codec(self, stream: StreamInfo) -> ChannelCodec | None:
        if self.encoder is None:
            return None
        spec, info = stream.spec, stream.info
        modes = tuple(mode for mode in spec.lossy if LOSSY[mode] == plain_type(info.type_name))
        setting = spec.compression
        if setting in LOSSY and setting not in modes:
            setting = None  # of a rule for several types
        return ChannelCodec(setting, LossyTopic(modes, info.encoding, spec.lossy_params) if modes else None)

    # --- bytes out ------------------------------------------------------------------------------------------------

    def _next_data(self, lane: Lane, now: float) -> bytes | None:
        """The next kind-16 datagram of an established session for one lane, or None."""
        if not self.dirty and len(self.lanes) == 1:
            return None  # nothing has changed since the last answer, and `handle_timeout` says when time has
        self._now = now
        if self._unsaid:
            self._say(now)
        if lane.copies and (copy := lane.due_copy(now)) is not None:
            self.scheduler.charge(PriorityClass.CONTROL, len(copy), now=now)
            self.wire_bytes += len(copy) + OVERHEAD_BYTES
            lane.priority = PriorityClass.CONTROL
            return copy
        lane.priority = PriorityClass.STATE
        frames: list[bytes] = []
        items: list[SentData | SentWatermark | SentPing] = []
        if not lane.stalled or now >= lane.probe_due_s:
            if lane is self.lane or lane is self.express:
                self.dirty = False
                try:
                    window_open = self._compose(lane, frames, items, now)
                except Exception:  # goes on to whoever called; only the state is put right here
                    self._give_back(lane, items, now)  # what was taken would be neither in flight nor waiting
                    raise
                if not items and not window_open and not lane.path.held and self._backlog:
                    lane.path.held = not lane.stalled
            # A stream delivers what is under way, so one question at a time is enough there.
            if not items and (lane.ping or lane.stalled) and not (lane.lossless and lane.flight.packets):
                frames.append(framing.PING_FRAME)
                items.append(SentPing())
            lane.ping = False
            if lane.stalled:
                lane.probe_due_s = now + PROBE_INTERVAL_S
        arrivals = lane.arrivals
        if arrivals.unacked and not self._half_read and (items or arrivals.due or now >= arrivals.deadline_s()):
            # In front: the receiver's clock estimate has the newest sample before it judges the age of what follows.
            frames.insert(
                0,
                framing.encode_ack(
                    lane.id, arrivals.highest, arrivals.mask, arrivals.echo_us, arrivals.received_us, arrivals.cum_bytes
                ),
            )
            arrivals.flushed(now)
        if not frames:
            return None
        if not items:
            self.dirty = self.dirty or len(self.lanes) > 1
            return b"".join((self._header(0, now), *frames))
        flight = lane.flight
        datagram = b"".join((self._header(flight.next_number, now), *frames))
        nbytes = len(datagram) + OVERHEAD_BYTES
        estimator = lane.estimator
        inflight_bytes = nbytes + (flight.inflight_bytes if lane.beside is None else lane.under_way_bytes)
        # What could be picked if window and pacer let it is held back by them; ordering `paper` holds back by itself.
        control = self._control
        waits = (lane is self.lane or lane is self.express) and bool(
            control.queue or control.active or self.scheduler.pick(now=now, window_open=True) is not None
        )
        path = lane.path
        app_limited = not waits and not path.held and inflight_bytes < estimator.window_bytes
        path.held = False
        flight.sent(now=now, nbytes=nbytes, items=items, app_limited=app_limited, priority=lane.priority)
        estimator.on_sent(now=now, nbytes=nbytes, inflight_bytes=inflight_bytes)
        pacer = lane.pacer
        pacer.sent(now=now, nbytes=nbytes, pacing_bps=estimator.pacing_bps)
        if lane is self.lane and (rate_bps := estimator.rate_bps) is not None:
            pacer.due_s = self.cadences.hold(pacer.due_s, 8 * (lane.fragment_bytes + OVERHEAD_BYTES) / rate_bps)
        self.wire_bytes += nbytes
        lane.ping_due_s = now + PING_INTERVAL_S
        if len(self.lanes) > 1:
            self.dirty = True
        elif lane.open_at(now):
            self.dirty = waits or bool(self._watermarks)
        else:
            self.dirty = bool(self._watermarks) or (waits and self._pick(now, window_open=False) is not None)
        redundant = lane.redundant
        if redundant or lane is self.express:
            lane.spare = not waits or self.scheduler.within_share(now)
            if redundant and lane.spare and any(type(item) is SentData and _urgent(item.channel) for item in items):
                lane.copies.append((now + COPY_DELAY_S, flight.next_number - 1, datagram))
        return datagram

    def may_copy(self, nbytes: int) -> bool:
        """Whether the express lane's latest datagram, of `nbytes`, may go over its second connection as well; then it
        counts as class control's. While something waits for the link copies come out of that class's share."""
        if self.express is not None:
            if not self.express.spare:
                return False
            self.scheduler.charge(PriorityClass.CONTROL, nbytes, now=self._now)
            self.wire_bytes += nbytes + OVERHEAD_BYTES
        return True

    def _header(self, number: int, now: float) -> bytes:
        return framing.encode_header(framing.Kind.DATA, self.tag, number, microseconds(now), version=self.version)

    @property
    def _backlog(self) -> bool:
        """Whether more could be sent if the window allowed it."""
        pending = self.scheduler.pending
        return bool(
            self._control_waits
            or pending(PriorityClass.BULK)
            or pending(PriorityClass.STATE)
            or pending(PriorityClass.CONTROL)
        )

    @property
    def control_heard(self) -> int:
        """The number of the last control message up to which the peer has acknowledged all."""
        return self._control.watermark

    @property
    def _control_waits(self) -> bool:
        return bool(self._control.queue or self._control.active)

    def _compose(
        self, lane: Lane, frames: list[bytes], items: list[SentData | SentWatermark | SentPing], now: float
    ) -> bool:
        """Fill one datagram: watermarks, then what the scheduler picks, of one class; control ahead of all but class 0.

        Control keeps to the window like everything below class 0, as a thousand announcements must not fill the path;
        but a little of it rides in each datagram of class 0, at the cost of that class's share: that is its floor, also
        where class 0 alone has more than the link carries. Returns whether window
        and pacer were open to the other classes.
        """
        limit = lane.fragment_bytes - (framing.ACK.size if lane.arrivals.unacked else 0)
        express = lane is self.express
        window_open = lane.open_at(now)
        size = framing.HEADER_BYTES
        if self._watermarks and not express:
            size = self._put_watermarks(frames, items, size)
        control = self._control
        served: PriorityClass | None = None
        ride = False  # it is the turn of a little control, behind class 0
        spoke = False
        full = limit - max(framing.DATA_FIRST_BYTES + MIN_SHARE_BYTES, limit // CRUMB)
        while size <= full:
            if express:
                chosen = self.scheduler.pick_control(now=now, window_open=window_open)
            else:
                chosen = self._pick(now, window_open=window_open)
            channel = self.channels[chosen] if chosen is not None else None
            urgent = channel is not None and channel.spec.priority is PriorityClass.CONTROL
            said = control.head(now) if self._control_waits and not express else None
            if said is not None and (ride or (window_open and not urgent)):
                before = size
                end = min(limit, size + framing.DATA_FIRST_BYTES + RIDE_BYTES) if ride else limit
                size = self._put(control, said, frames, items, size, end, now)
                spoke = True
                if not said.has_unsent:
                    self._control_sent(said.seq)
                if ride:
                    self.scheduler.charge(PriorityClass.CONTROL, size - before, now=now)
                    break
                continue
            if channel is None:
                break
            out = channel.head(now)
            if out is None:
                self._refresh(channel, now)
                continue
            if out.coding is Coding.RAW and channel.codec is not None and not self._encoded(channel, out, now):
                continue
            priority = _class_of(channel, out)
            if served is None and priority is not PriorityClass.CONTROL:
                limit = self._cut(lane, limit, now)
            shared = said is not None and priority is PriorityClass.CONTROL
            end = limit - framing.DATA_FIRST_BYTES - RIDE_BYTES if shared else limit
            if frames and (
                (served is not None and priority is not served)
                or (out.size if out.ranges is None else out.unsent_bytes) > end - size - framing.DATA_FIRST_BYTES
            ):
                if shared and served is PriorityClass.CONTROL:
                    ride = True
                    continue
                break
            served = priority
            before = size
            size = self._put(channel, out, frames, items, size, end, now)
            ride = shared and not window_open
            self.scheduler.charge(priority, size - before, now=now)
            self._refresh(channel, now)
            if lane.stalled:
                break
        if served is PriorityClass.CONTROL or (served is PriorityClass.BULK and not spoke):
            lane.priority = served
        return window_open

    def _cut(self, lane: Lane, limit: int, now: float) -> int:
        """Bytes of a datagram without class 0: so many that the link is free when class 0 wants it next."""
        rate_bps = lane.estimator.rate_bps
        if rate_bps is None:
            return limit
        share = self.cadences.share(now, 8 * (limit + OVERHEAD_BYTES) / rate_bps)
        return limit if share >= 1.0 else int(share * (limit + OVERHEAD_BYTES)) - OVERHEAD_BYTES

    def _put_watermarks(self, frames: list[bytes], items: list[SentData | SentWatermark | SentPing], size: int) -> int:
        for slot in list(self._watermarks)[:MAX_WATERMARKS]:
            if not self.incoming[slot].reports.heard(self._control.watermark):
                continue  # of drops first: behind the watermark it would take them for delivered
            frames.append(framing.encode_watermark(slot, self._watermarks.pop(slot)))
            items.append(SentWatermark(slot))
            size += framing.WATERMARK.size
        return size

    def _pick(self, now: float, *, window_open: bool) -> int | None:
        """The scheduler's choice; under `ordering: paper` what it found stale is dropped first."""
        if self.express is not None:  # class control goes there
            return self.scheduler.pick_rest(now=now) if window_open else None
        slot = self.scheduler.pick(now=now, window_open=window_open)
        if self._paper:
            for stale in self.scheduler.take_stale(now):
                channel = self.channels[stale]
                channel.drop_head(DropReason.STALE, now)
                self._refresh(channel, now)
        return slot

    def _put(
        self,
        channel: OutChannel,
        out: OutMessage,
        frames: list[bytes],
        items: list[SentData | SentWatermark | SentPing],
        size: int,
        limit: int,
        now: float,
    ) -> int:
        """Append one fragment of `out`; returns the datagram's new size."""
        message = out.message
        if self.trace.enabled and not out.started:
            self.trace.record(now, message.stream.topic, TraceEvent.CHOSEN, seq=out.seq, peer=self.peer)
        start, end = channel.take(out, max(limit - size - framing.DATA_FIRST_BYTES, MIN_SHARE_BYTES), now)
        items.append(SentData(channel, out, out.generation, start, end))
        flags = framing.FLAG_TOMBSTONE if message.tombstone else 0
        if message.replay:
            flags |= framing.FLAG_REPLAY
        if channel.spec.priority is PriorityClass.CONTROL:
            flags |= framing.FLAG_URGENT
        if start == 0:
            age_s = now - message.born_s
            error_s = message.error_s + framing.AGE_UNIT_S  # the age itself is cut to its unit
            head = framing.encode_data_first(
                flags, channel.slot, out.seq, out.size, end, message.stamp_ns, age_s, message.codec, error_s
            )
        else:
            head = framing.encode_data_next(flags, channel.slot, out.seq, start, out.size, end - start)
        frames.append(head)
        frames.append(message.body if end - start == out.size else message.body[start:end])
        return size + len(head) + end - start


def _why_capped(channel: OutChannel, thinned: bool) -> str:
    return f"the adaptation lets {channel.share:.0%} of the messages in" if thinned else "max_rate_hz"


def _class_of(channel: OutChannel, out: OutMessage) -> PriorityClass:
    """A replay for a late joiner competes with deferrable traffic only, never with live state."""
    return PriorityClass.BULK if out.message.replay else channel.spec.priority


def _urgent(channel: OutChannel) -> bool:
    return channel.spec.priority is PriorityClass.CONTROL and channel.slot != CONTROL_CHANNEL
