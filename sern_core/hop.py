"""The data plane of one end of a hop: from messages to datagrams and back, for one session after another.

`Link` (link.py) adds the control plane: handshake, announcements, interest. The next fragment is chosen only when the
lane can take it (late binding), so that nothing waits where it can no longer be overtaken.
"""

from abc import ABC, abstractmethod
from typing import Any, Final, NamedTuple

from sern_core import wire
from sern_core.capacity import AckSample
from sern_core.clocksync import ClockSync
from sern_core.errors import WireError
from sern_core.flight import ACK_DELAY_S
from sern_core.fragments import InStream, Reassembly
from sern_core.lanes import (
    COPY_DELAY_S,
    LANE_UDP,
    LANE_ZMQ,
    OVERHEAD_BYTES,
    PING_INTERVAL_S,
    PROBE_INTERVAL_S,
    PROVEN_ACKS,
    Lane,
)
from sern_core.ledger import SendCounters, SendLedger
from sern_core.message import Message, StreamId, StreamInfo, TopicInfo, TopicSpec
from sern_core.params import LinkParams, SchedulerParams
from sern_core.queues import OutChannel, OutMessage
from sern_core.scheduler import Scheduler
from sern_core.trace import LINK, DecisionTrace, TraceEvent
from sern_core.types import (
    CLASSES,
    ClientName,
    DropReason,
    Encoding,
    Ordering,
    PriorityClass,
    Reliability,
    TopicName,
)

CONTROL_CHANNEL: Final = 0
CONTROL_TOPIC: Final = TopicName("/_sern/control")
SWEEP_INTERVAL_S: Final = 0.25
RATE_INTERVAL_S: Final = 0.05
MIN_SHARE_BYTES: Final = 64
"""A fragment smaller than this is not worth its header: the datagram ends instead."""
MAX_WATERMARKS: Final = 64
MAX_CONTROL_BYTES: Final = 2 + wire.MAX_ENVELOPE_BYTES + wire.MAX_ATTACHMENT_BYTES + 1024
"""A control message: envelope and packed attachment (what cannot be packed grows a little)."""


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


class Hop(ABC):
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
        self.scheduler = Scheduler(scheduler, now=now)
        self._paper = scheduler.ordering is Ordering.PAPER
        self.trace = trace
        self.clock = ClockSync()
        self.ledger = SendLedger()
        """Counters of what goes out, by topic."""
        self.strays = 0  # fragments of streams that are unknown here (drop reason `unknown_channel`)
        self.channels: dict[int, OutChannel] = {}
        self.incoming: dict[int, InStream] = {}
        """Streams of this session by the peer's channel number."""
        self.reassembly = Reassembly(max(64 * 2**20, 2 * link.max_message_bytes))
        self.established = False
        self.version = wire.VERSION_MAX
        self.tag = boot % 255  # so that a late datagram of an earlier process is not taken for one of ours
        self.dirty = False
        """Something may be sendable: the owner should poll `next_datagram`."""
        self._rx_lane = self.lane
        self._sweep_due_s = now + SWEEP_INTERVAL_S
        self._rate_due_s = now
        self._up_since_s = now
        self._watermarks: dict[int, int] = {}  # channel -> delivered, not yet on the wire
        self._rx_stamp_us = 0
        self._rx_delay: tuple[float, float] | None = None  # of the datagram at hand, and its uncertainty
        self._now = now
        self._control, self._control_in = self._control_streams()

    # --- what the control plane provides --------------------------------------------------------------------------

    @abstractmethod
    def _control_message(self, stream: InStream, message: Message) -> None: ...

    @abstractmethod
    def _in_drop(self, stream: InStream, reason: DropReason, nbytes: int, seq: int) -> None: ...

    @abstractmethod
    def _control_sent(self, seq: int) -> None:
        """Control message `seq` is on the wire."""

    @abstractmethod
    def _watermark_moved(self, channel: OutChannel) -> None: ...

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
        control = OutChannel(CONTROL_CHANNEL, stream, counters, lambda _out, _reason: None, first=1)
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
        backlog = channel.offered
        accepted = channel.submit(message, now=now, forced=forced)
        if self.trace.enabled:
            event = TraceEvent.QUEUED if accepted else TraceEvent.REFUSED
            self.trace.record(now, message.stream.topic, event, seq=message.seq, peer=self.peer)
        if not backlog or channel.coalesced:
            self._refresh(channel, now)
        return accepted

    def reject(self, channel: OutChannel, message: Message, reason: DropReason, *, now: float) -> None:
        """Drop a message on its way in; of a reliable stream a tombstone goes on in its place."""
        self._now = now
        channel.reject(message, reason)
        self.trace.record(now, message.stream.topic, TraceEvent.DROPPED, seq=message.seq, reason=reason)
        self._refresh(channel, now)

    def shed(self, channel: OutChannel, reason: DropReason, *, now: float) -> int:
        """Give up one message that waits and has not been begun; returns the bytes that are free now, 0: none."""
        self._now = now
        freed_bytes = channel.shed(reason)
        self._refresh(channel, now)
        return freed_bytes

    def _refresh(self, channel: OutChannel, now: float) -> None:
        """Tell the scheduler what this channel would send next."""
        out = channel.head(now) if channel.ready and channel.wanted else None
        if out is None:
            if channel.offered:
                channel.offered = False
                self.scheduler.withdraw(channel.slot)
            return
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
            size_bytes=out.unsent_bytes,
            since_s=since_s,
            stale_after_s=spec.lifespan_s if self._paper else None,
        )

    # --- bytes out ------------------------------------------------------------------------------------------------

    def _next_data(self, lane: Lane, now: float) -> bytes | None:
        """The next kind-16 datagram of an established session for one lane, or None."""
        self._now = now
        if lane.copies and (copy := lane.due_copy(now)) is not None:
            self.scheduler.charge(PriorityClass.CONTROL, len(copy), now=now)
            return copy
        frames: list[bytes] = []
        items: list[SentData | SentWatermark | SentPing] = []
        if not lane.stalled or now >= lane.probe_due_s:
            if lane is self.lane:
                self.dirty = False
                self._compose(frames, items, now)
            # A stream delivers what is under way, so one question at a time is enough there.
            if not items and (lane.ping or lane.stalled) and not (lane.lossless and lane.flight.packets):
                frames.append(wire.PING_FRAME)
                items.append(SentPing())
            lane.ping = False
            if lane.stalled:
                lane.probe_due_s = now + PROBE_INTERVAL_S
        arrivals = lane.arrivals
        if arrivals.unacked and (items or arrivals.due or now >= arrivals.since_s + ACK_DELAY_S):
            # In front: the receiver's clock estimate has the newest sample before it judges the age of what follows.
            frames.insert(
                0,
                wire.encode_ack(
                    lane.id, arrivals.highest, arrivals.mask, arrivals.echo_us, arrivals.received_us, arrivals.cum_bytes
                ),
            )
            arrivals.flushed()
        if not frames:
            return None
        self.dirty = True
        if not items:
            return b"".join((self._header(0, now), *frames))
        flight = lane.flight
        datagram = b"".join((self._header(flight.next_number, now), *frames))
        nbytes = len(datagram) + OVERHEAD_BYTES
        estimator = lane.estimator
        inflight_bytes = flight.inflight_bytes + nbytes
        app_limited = inflight_bytes < estimator.window_bytes and not (lane is self.lane and self._backlog)
        flight.sent(now=now, nbytes=nbytes, items=items, app_limited=app_limited)
        estimator.on_sent(now=now, nbytes=nbytes, inflight_bytes=inflight_bytes)
        lane.pacer.sent(now=now, nbytes=nbytes, pacing_bps=estimator.pacing_bps)
        lane.ping_due_s = now + PING_INTERVAL_S
        if lane.redundant and any(type(item) is SentData and _urgent(item.channel) for item in items):
            lane.copies.append((now + COPY_DELAY_S, flight.next_number - 1, datagram))
        return datagram

    def _header(self, number: int, now: float) -> bytes:
        return wire.encode_header(wire.Kind.DATA, self.tag, number, microseconds(now), version=self.version)

    @property
    def _backlog(self) -> bool:
        """Whether more could be sent if the window allowed it."""
        control = self._control
        scheduler = self.scheduler
        return bool(control.queue or control.active) or any(scheduler.pending(priority) for priority in CLASSES)

    def _compose(self, frames: list[bytes], items: list[SentData | SentWatermark | SentPing], now: float) -> None:
        """Fill one datagram: watermarks, then what the scheduler picks, of one class; control ahead of all but class 0.

        Control keeps to the window like everything below class 0: a thousand announcements must not fill the path.
        """
        lane = self.lane
        limit = lane.fragment_bytes - (wire.ACK.size if lane.arrivals.unacked else 0)
        scheduler = self.scheduler
        window_open = lane.open_at(now)
        size = wire.HEADER_BYTES
        if self._watermarks:
            size = self._put_watermarks(frames, items, size)
        control = self._control
        served: PriorityClass | None = None
        while size < limit - MIN_SHARE_BYTES:
            chosen = self._pick(now, window_open=window_open)
            channel = self.channels[chosen] if chosen is not None else None
            if window_open and (channel is None or channel.spec.priority is not PriorityClass.CONTROL):
                order = control.head(now)
                if order is not None:
                    size = self._put(control, order, frames, items, size, limit, now)
                    if not order.has_unsent:
                        self._control_sent(order.seq)
                    continue
            if channel is None:
                break
            out = channel.head(now)
            if out is None:
                self._refresh(channel, now)
                continue
            priority = _class_of(channel, out)
            if frames and (
                (served is not None and priority is not served)
                or out.unsent_bytes > limit - size - wire.DATA_FIRST_BYTES
            ):
                break
            served = priority
            before = size
            size = self._put(channel, out, frames, items, size, limit, now)
            scheduler.charge(priority, size - before, now=now)
            self._refresh(channel, now)
            if lane.stalled:
                break

    def _put_watermarks(self, frames: list[bytes], items: list[SentData | SentWatermark | SentPing], size: int) -> int:
        for slot in list(self._watermarks)[:MAX_WATERMARKS]:
            if self._must_hear(self.incoming[slot]):
                continue  # of drops first: behind the watermark it would take them for delivered
            frames.append(wire.encode_watermark(slot, self._watermarks.pop(slot)))
            items.append(SentWatermark(slot))
            size += wire.WATERMARK.size
        return size

    def _must_hear(self, stream: InStream) -> bool:
        """Whether the peer does not know yet of all the drops that were reported to it."""
        reports = stream.reports
        while reports and 0 < reports[0].control_seq <= self._control.watermark:
            del reports[0]
        return bool(reports)

    def _pick(self, now: float, *, window_open: bool) -> int | None:
        """The scheduler's choice; under `ordering: paper` what it found stale is dropped first."""
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
        start, end = channel.take(out, max(limit - size - wire.DATA_FIRST_BYTES, MIN_SHARE_BYTES), now)
        flags = wire.FLAG_TOMBSTONE if message.tombstone else 0
        if message.replay:
            flags |= wire.FLAG_REPLAY
        if channel.spec.priority is PriorityClass.CONTROL:
            flags |= wire.FLAG_URGENT
        if start == 0:
            age_s = now - message.born_s
            error_s = message.error_s + wire.AGE_UNIT_S  # the age itself is cut to its unit
            head = wire.encode_data_first(
                flags, channel.slot, out.seq, out.size, end, message.stamp_ns, age_s, 0, error_s
            )
        else:
            head = wire.encode_data_next(flags, channel.slot, out.seq, start, out.size, end - start)
        frames.append(head)
        frames.append(message.body if end - start == out.size else message.body[start:end])
        items.append(SentData(channel, out, out.generation, start, end))
        return size + len(head) + end - start

    # --- bytes in -------------------------------------------------------------------------------------------------

    def _receive_data(self, lane: Lane, header: wire.Header, data: bytes, now: float) -> None:
        """A kind-16 datagram of this session."""
        self._rx_lane = lane
        self._rx_stamp_us = header.stamp_us
        self._rx_delay = None
        self._now = now
        if header.number:
            arrivals = lane.arrivals
            if not arrivals.arrived(header.number, header.stamp_us, len(data) + OVERHEAD_BYTES, now=now):
                return
            self.dirty = True  # an acknowledgement is owed
        wire.decode_frames(data, self)

    def on_data(
        self,
        flags: int,
        channel: int,
        seq: int,
        offset: int,
        total: int,
        body: bytes,
        stamp_ns: int,
        age_s: float,
        codec: int,
        error_s: float,
    ) -> None:
        """FrameSink: one fragment."""
        now = self._now
        if codec:
            raise WireError(f"codec {codec} was not agreed")
        if flags & wire.FLAG_URGENT:
            self._rx_lane.arrivals.due = True
        if channel == CONTROL_CHANNEL:
            stream = self._control_in
            if total > MAX_CONTROL_BYTES:
                raise WireError(f"control message of {total} bytes exceeds {MAX_CONTROL_BYTES}")
        else:
            known = self.incoming.get(channel)
            if known is None:
                self.strays += 1
                return
            stream = known
        wide = wire.widen_seq(seq, stream.delivered)
        if total > self.params.max_message_bytes:
            if offset == 0:
                stream.give_up(wide, DropReason.TOO_LARGE, total, now)
            return
        born_s = now
        if offset == 0:
            if self._rx_delay is None:
                self._rx_delay = self.clock.one_way_delay_s(self._rx_stamp_us * 1e-6, now)
            delay_s, uncertainty_s = self._rx_delay
            born_s = now - age_s - delay_s
            error_s += uncertainty_s  # infinite before the first round trip
        stream.fragment(flags, wide, offset, total, body, stamp_ns, born_s, error_s, now)

    def on_ack(self, lane: int, highest: int, sack: int, echo_us: int, received_us: int, cum_bytes: int) -> None:
        """FrameSink: an acknowledgement of what we sent."""
        state = self.lanes.get(lane)
        if state is None:
            if lane == LANE_UDP:
                return  # of a lane that was closed meanwhile
            raise WireError(f"acknowledgement of unknown lane {lane}")
        flight = state.flight
        if highest >= flight.next_number:
            raise WireError(f"acknowledgement of packet {highest}, which was never sent")
        now = self._now
        newer = highest > flight.highest_acked
        packets = flight.acked(highest, sack, now=now)
        if newer:
            sent_s, stamp_s, received_s = echo_us * 1e-6, self._rx_stamp_us * 1e-6, received_us * 1e-6
            rtt_s = max(1e-6, now - sent_s - (stamp_s - received_s))
            flight.rtt.sample(rtt_s, now=now)
            self.clock.sample(sent_s, received_s, stamp_s, now)
            newest = packets[-1] if packets else None
            state.estimator.on_ack(
                AckSample(
                    now,
                    rtt_s,
                    sum([packet.nbytes for packet in packets]),
                    flight.inflight_bytes,
                    received_s,
                    cum_bytes,
                    newest is not None and newest.app_limited,
                    sent_s,
                    newest.nbytes if newest is not None and newest.number == highest else 0,
                )
            )
            if state is self.lane and now >= self._rate_due_s:
                self._rate_known(now)
        if packets:
            state.resolved(acked=len(packets))
        if newer or packets:
            state.stalled = False
            state.proofs += 1
            state.answered = True
            self.dirty = True
            if len(self.lanes) > 1:
                self._choose_lane(now)
        for packet in packets:
            for item in packet.items:
                if type(item) is SentData:
                    item.channel.fragment_acked(item.out, item.generation)
        control = self._control
        if control.retained:
            control.settle()
        if not flight.lossless:
            self._find_losses(state, now)

    # --- lanes ----------------------------------------------------------------------------------------------------

    def _choose_lane(self, now: float) -> None:
        """UDP where it works, else ZMQ; in a blackout stay, and be found by whichever lane answers first."""
        zmq, udp = self.lanes[LANE_ZMQ], self.lanes.get(LANE_UDP)
        if udp is not None and udp.usable and udp.proofs >= (PROVEN_ACKS if zmq.usable else 1):
            # What the peer was told over the stream must be there before data can overtake it.
            if self.lane is udp or not self._control.retained or not zmq.usable:
                self._use_lane(udp, now)
        elif zmq.usable:
            self._use_lane(zmq, now)

    def _use_lane(self, lane: Lane, now: float) -> None:
        old = self.lane
        if lane is old:
            return
        self.lane = lane
        if not old.lossless or not old.usable:
            self._recall(old, now)
        self.trace.record(now, LINK, TraceEvent.LINK_UP, peer=self.peer, reason=f"lane {lane.name}")
        self._rate_known(now)
        self.dirty = True

    def _recall(self, lane: Lane, now: float) -> None:
        """What is in flight on this lane goes another way; what arrives twice is dropped there."""
        for packet in lane.flight.abandon():
            self._give_back(lane, packet.items, now)

    def _rate_known(self, now: float) -> None:
        self._rate_due_s = now + RATE_INTERVAL_S
        self.scheduler.set_rate(self.lane.rate_changed() or None, now=now)

    def _find_losses(self, lane: Lane, now: float) -> None:
        gone = lane.flight.lost(now=now)
        if gone:
            lane.resolved(lost=len(gone))
        for packet in gone:
            lane.estimator.on_loss(now=now, nbytes=packet.nbytes)
            self._give_back(lane, packet.items, now)
            self.dirty = True

    def _give_back(self, lane: Lane, items: list[Any], now: float) -> None:
        """What a packet carried did not arrive: send again what is still wanted."""
        for item in items:
            if type(item) is SentData:
                channel = item.channel
                again = channel.fragment_lost(item.out, item.generation, item.start, item.end, now=now)
                if again and self.trace.enabled:
                    self.trace.record(
                        now, item.out.message.stream.topic, TraceEvent.LOST, seq=item.out.seq, peer=self.peer
                    )
                if self.channels.get(channel.slot) is channel:
                    self._refresh(channel, now)
            elif type(item) is SentWatermark:
                if item.channel in self.incoming:
                    self._watermarks[item.channel] = self.incoming[item.channel].confirmed
            else:
                lane.ping = True

    def on_watermark(self, channel: int, delivered: int) -> None:
        """FrameSink: everything of a reliable channel up to `delivered` has had its turn at the far side."""
        out_channel = self.channels.get(channel)
        if out_channel is None or not out_channel.reliable:
            return
        # It may lie beyond what was submitted here: the peer had more from an earlier relay (`OutChannel.submit`).
        wide = wire.widen_seq(delivered, out_channel.watermark)
        if wide > out_channel.watermark:
            out_channel.delivered_to(wide)
            self._refresh(out_channel, self._now)
            self._watermark_moved(out_channel)

    def on_ping(self) -> None:
        """FrameSink: the peer asks for an acknowledgement now."""
        self._rx_lane.arrivals.due = True
        self.dirty = True

    def confirm(self, stream: InStream, delivered: int) -> None:
        """Tell the peer that its reliable stream is delivered up to `delivered`; remembered while it is away."""
        if delivered > stream.confirmed:
            stream.confirmed = delivered
            if stream.channel_id is not None:
                self._watermarks[stream.channel_id] = delivered
                self.dirty = True

    # --- time -----------------------------------------------------------------------------------------------------

    def _data_deadline(self, lane: Lane) -> float | None:
        """When `handle_timeout` or `next_datagram` has something to do on this lane by time alone."""
        deadline = lane.ping_due_s
        if lane.id == LANE_ZMQ and self._sweep_due_s < deadline:
            deadline = self._sweep_due_s
        arrivals = lane.arrivals
        if arrivals.unacked:
            due_s = arrivals.since_s + ACK_DELAY_S
            if due_s < deadline:
                deadline = due_s
        for candidate in (
            lane.stall_deadline(),
            lane.flight.loss_deadline(),
            lane.probe_due_s if lane.stalled else None,
            lane.copies[0][0] if lane.copies else None,
            self._service_deadline(lane) if lane is self.lane else None,
        ):
            if candidate is not None and candidate < deadline:
                deadline = candidate
        return deadline

    def _service_deadline(self, lane: Lane) -> float | None:
        """When something that waits may leave by time alone: the pacer or class 0's bucket lets it."""
        now = self._now
        if lane.window_open and not lane.pacer.ready(now) and self._backlog:
            pacing_s = lane.pacing_deadline()
            bucket_s = self.scheduler.next_deadline(now=now, window_open=False)
            return pacing_s if bucket_s is None or pacing_s < bucket_s else bucket_s
        return self.scheduler.next_deadline(now=now, window_open=lane.open_at(now))

    def _data_timeout(self, lane: Lane, now: float) -> None:
        self._now = now
        self._find_losses(lane, now)
        stall_s = lane.stall_deadline()
        if stall_s is not None and now >= stall_s:
            lane.stalled = True
            lane.proofs = 0
            lane.probe_due_s = now
            lane.estimator.on_stall(now=now)
            reason = f"{lane.name}: no acknowledgement"
            self.trace.record(now, LINK, TraceEvent.LINK_DOWN, peer=self.peer, reason=reason)
            if len(self.lanes) > 1:
                self._choose_lane(now)
        if now >= lane.ping_due_s:
            lane.ping = True
            lane.ping_due_s = now + PING_INTERVAL_S
        if lane.id == LANE_ZMQ and now >= self._sweep_due_s:
            self._sweep(now)
        self.dirty = True

    def _sweep(self, now: float) -> None:
        """Expire what nobody will send, also while the link is down."""
        self._sweep_due_s = now + SWEEP_INTERVAL_S
        for channel in list(self.channels.values()):
            watermark = channel.watermark
            channel.sweep(now, up=self.established)
            if channel.offered or channel.active:
                self._refresh(channel, now)
            if channel.watermark > watermark:
                self._watermark_moved(channel)
        for stream in self.incoming.values():
            self._must_hear(stream)
            if 0 < stream.pause_seq <= self._control.watermark:
                stream.forget(DropReason.UNWANTED)


def _urgent(channel: OutChannel) -> bool:
    return channel.spec.priority is PriorityClass.CONTROL and channel.slot != CONTROL_CHANNEL


def _class_of(channel: OutChannel, out: OutMessage) -> PriorityClass:
    """A replay for a late joiner competes with deferrable traffic only, never with live state."""
    return PriorityClass.BULK if out.message.replay else channel.spec.priority
