"""The lanes of one link: which there are, which carries data now, and which class control. Pure."""

from collections.abc import Callable
from typing import Any, Final

from sern_core.link.end import End
from sern_core.path.capacity import AckSample
from sern_core.path.clocksync import ClockSync
from sern_core.path.flight import Packet
from sern_core.path.lanes import LANE_PRIORITY, LANE_UDP, LANE_ZMQ, PROVEN_ACKS, Lane
from sern_core.path.stream_choice import StreamChoice
from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.trace import LINK, Field, TraceEvent

RATE_INTERVAL_S: Final = 0.05
TOLD_CHANGE: Final = 1.5
"""A rate that is known to be so many times what was told, or as much less, is told to the trace of decisions."""


class LaneSet:
    """`lossless`, `any_size` and `leased` are of the lane on which sessions begin (`Lane`). `settled` says whether the
    peer has all that it was told; `give_back` gets what packets carried that did not arrive; `on_rate` gets the rate of
    the lane that carries data, None: unknown, and whether it was ever full."""

    def __init__(
        self,
        end: End,
        *,
        lossless: bool,
        any_size: bool | None = None,
        leased: bool = False,
        paper: bool,
        settled: Callable[[], bool],
        give_back: Callable[[Lane, list[Any], float], None],
        on_rate: Callable[[float | None, bool, float], None],
        now: float,
    ) -> None:
        self._end = end
        self._paper = paper
        self._settled = settled
        self._give_back = give_back
        self._on_rate = on_rate
        self._rate_due_s = now
        self._told_bps = 0.0
        self._choice = StreamChoice(end.params.stream_from_bps)
        self._choice_due_s = now
        self.clock = ClockSync()
        """The peer's clock, as the stamps of all lanes tell."""
        self.lane = Lane(LANE_ZMQ, end.params, lossless=lossless, any_size=any_size, leased=leased)
        """The lane that carries data now."""
        self.by_id = {LANE_ZMQ: self.lane}
        self.priority_lane: Lane | None = None
        """The lane that carries class control beside it, if there is one."""
        self.wire_bytes = 0
        """Bytes of numbered datagrams sent so far, second copies and headers included."""
        self.background_bytes = 0
        """Those of them that were fragments of streams in the background."""

    @property
    def stream(self) -> Lane:
        """The lane of the transport on which the session began."""
        return self.by_id[LANE_ZMQ]

    # --- coming and going -----------------------------------------------------------------------------------------

    def begin(self, now: float) -> None:
        """A session has begun, on the stream lane."""
        lane = self.lane = self.stream
        lane.up = True
        lane.new_session(now)
        lane.estimator.on_reset(now=now)
        self._choice = StreamChoice(self._end.params.stream_from_bps)
        self._rate_known(now)

    def forget_clock(self) -> None:
        """The peer is another process."""
        self.clock = ClockSync()

    def recall_all(self, now: float) -> None:
        """The session ends: what is in flight goes back, and the stream lane is the one."""
        for lane in self.by_id.values():
            self.recall(lane, now)
        self.lane = self.stream

    def leave(self) -> bool:
        """The other lanes end with the session. Returns whether there was a datagram lane."""
        udp = self.by_id.pop(LANE_UDP, None)  # its keys end with the session
        if (priority_lane := self.by_id.pop(LANE_PRIORITY, None)) is not None:
            priority_lane.leave()
        self.priority_lane = None
        return udp is not None

    def open(self, lane_id: int, now: float) -> None:
        """A lane beside the stream has a transport: ask whether it works, then use it."""
        beside = self.stream if lane_id == LANE_PRIORITY else None
        if (old := self.by_id.get(lane_id)) is not None:
            old.leave()
        lane = self.by_id[lane_id] = Lane(lane_id, self._end.params, lossless=False, beside=beside)
        lane.up = True
        lane.new_session(now)
        stream_rtt = self.stream.flight.rtt
        if stream_rtt.samples:
            lane.flight.rtt.sample(stream_rtt.srtt_s, now=now)
        if beside is None:
            lane.estimator.on_reset(now=now)
        self._end.dirty = True

    def close(self, lane: Lane, now: float) -> None:
        """A lane's transport is gone, and it is in `by_id` no more."""
        if self.lane is lane:
            self._use(self.stream, now)
        self._choose_priority_lane(now)
        self.recall(lane, now)
        lane.leave()

    def lost_stream(self, udp: Lane, now: float) -> None:
        """The stream lane's transport is gone, and the session goes on over the datagram lane."""
        self.stream.up = False
        self.recall(self.stream, now)
        self._use(udp, now)
        self._choose_priority_lane(now)

    # --- which carries what ---------------------------------------------------------------------------------------

    def choose(self, now: float) -> None:
        """UDP where it works and ZMQ is not much the cheaper (`StreamChoice`), else ZMQ; in a blackout stay, and be
        found by whichever lane answers first."""
        zmq, udp = self.stream, self.by_id.get(LANE_UDP)
        if udp is not None and udp.usable and udp.proofs >= (PROVEN_ACKS if zmq.usable else 1):
            lane = zmq if self._streams(zmq, now) else udp
            # What the peer was told over the one must be there before data can overtake it on the other.
            if self.lane is lane or self._settled() or not self.lane.usable:
                self._use(lane, now)
        elif zmq.usable:
            self._use(zmq, now)
        self._choose_priority_lane(now)

    def _streams(self, zmq: Lane, now: float) -> bool:
        """Whether data goes over the stream although datagrams get through."""
        if not zmq.lossless:
            return False
        if not zmq.usable:
            self._choice.failed(now)
        elif now >= self._choice_due_s:
            self._choice_due_s = now + RATE_INTERVAL_S
            self._choice.look(self.lane, now=now)
        return self._choice.stream

    def _choose_priority_lane(self, now: float) -> None:
        """Class control goes beside the stream while that works; what the peer was told must be there before it."""
        lane = self.by_id.get(LANE_PRIORITY)
        if lane is not None and (self.lane.id != LANE_ZMQ or self._paper or not lane.usable):
            lane = None
        if lane is not None and lane is not self.priority_lane and (lane.proofs < PROVEN_ACKS or not self._settled()):
            return
        if lane is not self.priority_lane:
            left, self.priority_lane = self.priority_lane, lane
            if left is not None:
                self.recall(left, now)
            self._tell(now, TraceEvent.LANE_USED, lane=(lane or self.lane).name, what="class control")
            self._end.dirty = True

    def _use(self, lane: Lane, now: float) -> None:
        old = self.lane
        if lane is old:
            return
        self.lane = lane
        if old.usable and lane.lossless:
            lane.estimator.goes_on_from(old.estimator, now=now)
        if not old.usable:  # else it delivers what it has, or gives back what it loses
            self.recall(old, now)
        self._tell(now, TraceEvent.LANE_USED, lane=lane.name, what="data")
        self._end.dirty = True
        self._rate_known(now)

    def _tell_rate(self, now: float) -> None:
        told_bps, rate_bps = self._told_bps, self.lane.estimator.rate_bps or 0.0
        if rate_bps and not told_bps / TOLD_CHANGE < rate_bps < told_bps * TOLD_CHANGE:
            self._told_bps = rate_bps
            rtt_s = self.lane.flight.rtt.srtt_s
            self._tell(now, TraceEvent.CAPACITY, rate_bps=round(rate_bps), rtt_s=rtt_s)

    def _tell(self, now: float, event: TraceEvent, **fields: Field) -> None:
        self._end.trace.record(now, LINK, event, 0, peer=self._end.peer, **fields)

    def recall(self, lane: Lane, now: float) -> None:
        """Requeue every packet in flight on `lane`. The receiver drops duplicates."""
        self._give_back(lane, [item for packet in lane.flight.abandon() for item in packet.items], now)

    def _rate_known(self, now: float) -> None:
        self._rate_due_s = now + RATE_INTERVAL_S
        known = self.lane.estimator.rate_bps is not None
        rate_bps = self.lane.rate_changed() or None
        self._on_rate(rate_bps, known, now)
        if known and self._end.trace.enabled:
            self._tell_rate(now)

    # --- acknowledgements and silence -----------------------------------------------------------------------------

    def acknowledged_by(self, lane_id: int, highest: int) -> Lane | None:
        """The lane that an acknowledgement is about; None: one that was closed meanwhile. Raises WireError."""
        lane = self.by_id.get(lane_id)
        if lane is None:
            if lane_id in (LANE_UDP, LANE_PRIORITY):
                return None
            raise WireError(f"acknowledgement of unknown lane {lane_id}")
        if highest >= lane.flight.next_number:
            raise WireError(f"acknowledgement of packet {highest}, which was never sent")
        return lane

    def acknowledged(
        self,
        lane: Lane,
        highest: int,
        sack: int,
        *,
        echo_us: int,
        received_us: int,
        cum_bytes: int,
        stamp_us: int,
        now: float,
    ) -> list[Packet]:
        """The peer has packets of `lane`; returns those that it was not known to have. `stamp_us`: when it said so."""
        flight = lane.flight
        newer = highest > flight.highest_acked
        packets = flight.acked(highest, sack, now=now)
        if newer:
            newest = packets[-1] if packets else None
            named = newest is not None and newest.number == highest
            # When it left we know better than the peer, unless it was given up meanwhile.
            sent_s = newest.sent_s if newest is not None and named else echo_us * 1e-6
            stamp_s, received_s = stamp_us * 1e-6, received_us * 1e-6
            if self.clock.sample(sent_s, received_s, stamp_s, now):  # else no two clocks can have given these stamps
                rtt_s = max(1e-6, now - sent_s - (stamp_s - received_s))
                flight.rtt.sample(rtt_s, now=now)
                lane.estimator.on_ack(
                    AckSample(
                        now,
                        rtt_s,
                        sum([packet.nbytes for packet in packets]),
                        lane.under_way_bytes,
                        received_s,
                        lane.arrived(cum_bytes),
                        newest is not None and newest.app_limited,
                        sent_s,
                        newest.nbytes if newest is not None and named else 0,
                        named and not sack & 1 and highest - 1 in flight.packets,
                    )
                )
                lane.pacer.paced(now=now, pacing_bps=lane.estimator.pacing_bps)
                if (lane is self.lane or lane is self.priority_lane) and now >= self._rate_due_s:
                    self._rate_known(now)
        if packets:
            lane.resolved(acked=len(packets))
        if newer or packets:
            if lane.stalled:
                lane.stalled = False
                self._tell(now, TraceEvent.LANE_ANSWERS, lane=lane.name)
            lane.proofs += 1
            lane.answered = True
            self._end.dirty = True
            if len(self.by_id) > 1:
                self.choose(now)
        return packets

    def find_losses(self, lane: Lane, now: float) -> None:
        """Give back what packets carried that count as lost by now."""
        gone = lane.flight.lost(now=now)
        if gone:
            lane.resolved(lost=len(gone))
        for packet in gone:
            lane.estimator.on_loss(now=now, nbytes=packet.nbytes)
            self._end.dirty = True
        if gone:
            self._give_back(lane, [item for packet in gone for item in packet.items], now)

    def find_silence(self, lane: Lane, now: float) -> None:
        """Nothing was acknowledged for too long: the lane counts as stalled."""
        stall_s = lane.stall_deadline()
        if stall_s is None or now < stall_s:
            return
        lane.stalled = True
        lane.stalled_at_s = now
        lane.proofs = 0
        lane.probe_due_s = now
        if lane.beside is None or not lane.beside.usable:
            lane.estimator.on_stall(now=now)
        self._tell(now, TraceEvent.LANE_SILENT, lane=lane.name)
        if len(self.by_id) > 1:
            self.choose(now)

    def validate(self, check: Callable[[bool, str], None]) -> None:
        """Internal consistency, for tests."""
        for lane in self.by_id.values():
            lane.flight.validate(check)
