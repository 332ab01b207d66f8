"""The data plane of one end of a hop: from messages to datagrams and back, for one session after another.

`Sender` (sending.py) composes what leaves; this adds what arrives, losses, the choice between lanes, and time.
`Session` and `Link` add the control plane: handshake, announcements, interest.
"""

from abc import abstractmethod
from typing import Any, Final

from sern_core.bodies.codecs import KNOWN_CODECS
from sern_core.link.sending import CONTROL_CHANNEL, RATE_INTERVAL_S, SWEEP_INTERVAL_S, Sender, SentData, SentWatermark
from sern_core.path.capacity import AckSample
from sern_core.path.lanes import LANE_EXPRESS, LANE_UDP, LANE_ZMQ, OVERHEAD_BYTES, PING_INTERVAL_S, PROVEN_ACKS, Lane
from sern_core.stream.in_stream import SLICE_US, InStream
from sern_core.stream.out_channel import LAPSED_A_SWEEP, OutChannel
from sern_core.stream.out_message import OutMessage
from sern_core.vocabulary.errors import RemoteError, WireError
from sern_core.vocabulary.trace import LINK, TraceEvent
from sern_core.vocabulary.types import DropReason
from sern_core.wire import framing

MAX_CONTROL_BYTES: Final = 2 + framing.MAX_ENVELOPE_BYTES + framing.MAX_ATTACHMENT_BYTES + 1024
"""A control message: envelope and packed attachment (what cannot be packed grows a little)."""
WATERMARK_US: Final = 4
DONE_PER_US: Final = 2
"""Kept messages that are let go of in a microsecond when the peer has them."""


class Hop(Sender):
    """Both halves. State is set up by `Sender`."""

    # --- bytes in -------------------------------------------------------------------------------------------------

    def _receive_data(
        self, lane: Lane, number: int, stamp_us: int, data: framing.Datagram, now: float, position: int = 0
    ) -> None:
        """A kind-16 datagram of the session; `position`: it was read up to there before."""
        self._rx_lane = lane
        self._rx_stamp_us = stamp_us
        self._rx_delay = None
        self._now = now
        if stamp_us * 1e-6 - now > self.clock.ahead_s:
            self.clock.witness(stamp_us * 1e-6, now)
        if number and not position:
            arrivals = lane.arrivals
            if not arrivals.arrived(number, stamp_us, len(data) + OVERHEAD_BYTES, now=now):
                return
            if arrivals.due or arrivals.unacked <= 2:
                self.dirty = True  # an acknowledgement is owed; of the third and later ones the deadline is known
        position = framing.decode_frames(data, self, position or framing.HEADER_BYTES)
        if position:
            self._pause_reading(lane, number, stamp_us, data, position, now)

    @abstractmethod
    def _pause_reading(
        self, lane: Lane, number: int, stamp_us: int, data: framing.Datagram, position: int, now: float
    ) -> None:
        """Leave the frames from `position` on for later, so that others get their turn."""

    def on_data(
        self,
        flags: int,
        channel: int,
        seq: int,
        offset: int,
        total: int,
        body: framing.Datagram,
        stamp_ns: int,
        age_s: float,
        codec: int,
        error_s: float,
    ) -> bool | None:
        """FrameSink: one fragment."""
        now = self._now
        if codec and (codec not in KNOWN_CODECS or channel == CONTROL_CHANNEL or flags & framing.FLAG_TOMBSTONE):
            raise WireError(f"codec {codec} has no place there")
        if flags & framing.FLAG_URGENT:
            self._rx_lane.arrivals.due = True
        if channel == CONTROL_CHANNEL:
            stream = self._control_in
            if total > MAX_CONTROL_BYTES:
                raise WireError(f"control message of {total} bytes exceeds {MAX_CONTROL_BYTES}")
        else:
            known = self.incoming.get(channel)
            if known is None:
                self.strays += 1
                if offset == 0 and self.on_stray is not None:
                    self.on_stray()
                return None
            stream = known
        wide = framing.widen_seq(seq, stream.delivered)
        if wide >= framing.MAX_SEQ:
            raise WireError(
                f"seq {wide}: streams end below {framing.MAX_SEQ}"
            )  # what follows it could not be announced
        if total > self.params.max_message_bytes:
            if offset == 0:
                stream.give_up(wide, DropReason.TOO_LARGE, total, now)
            return None
        born_s = now
        if offset == 0:
            if self._rx_delay is None:
                stamp_s = self._rx_stamp_us * 1e-6
                self._rx_delay = (*self.clock.one_way_delay_s(stamp_s, now), stamp_s - self.clock.behind_until_s)
            delay_s, uncertainty_s, in_step_s = self._rx_delay
            born_s = now - age_s - delay_s
            error_s += uncertainty_s  # infinite before the first round trip
            if age_s >= in_step_s:
                error_s += self.clock.behind_s(self._rx_stamp_us * 1e-6 - age_s)  # what the peer's clock lost meanwhile
        try:
            stream.fragment(flags, wide, offset, total, body, stamp_ns, born_s, error_s, now, codec)
        except RemoteError:
            raise
        except Exception as error:
            if stream is self._control_in:
                raise  # what follows it depends on it: the session ends
            self.fault(error)
            stream.fail(wide, total, now)
        return self.reassembly.work_us > SLICE_US

    def on_ack(self, lane: int, highest: int, sack: int, echo_us: int, received_us: int, cum_bytes: int) -> None:
        """FrameSink: an acknowledgement of what we sent."""
        state = self.lanes.get(lane)
        if state is None:
            if lane in (LANE_UDP, LANE_EXPRESS):
                return  # of a lane that was closed meanwhile
            raise WireError(f"acknowledgement of unknown lane {lane}")
        flight = state.flight
        if highest >= flight.next_number:
            raise WireError(f"acknowledgement of packet {highest}, which was never sent")
        now = self._now
        newer = highest > flight.highest_acked
        packets = flight.acked(highest, sack, now=now)
        if newer:
            newest = packets[-1] if packets else None
            named = newest is not None and newest.number == highest
            # When it left we know better than the peer, unless it was given up meanwhile.
            sent_s = newest.sent_s if newest is not None and named else echo_us * 1e-6
            stamp_s, received_s = self._rx_stamp_us * 1e-6, received_us * 1e-6
            self._rx_delay = None
            if self.clock.sample(sent_s, received_s, stamp_s, now):  # else no two clocks can have given these stamps
                rtt_s = max(1e-6, now - sent_s - (stamp_s - received_s))
                flight.rtt.sample(rtt_s, now=now)
                state.estimator.on_ack(
                    AckSample(
                        now,
                        rtt_s,
                        sum([packet.nbytes for packet in packets]),
                        state.under_way_bytes,
                        received_s,
                        state.arrived(cum_bytes),
                        newest is not None and newest.app_limited,
                        sent_s,
                        newest.nbytes if newest is not None and named else 0,
                    )
                )
                state.pacer.paced(now=now, pacing_bps=state.estimator.pacing_bps)
                if (state is self.lane or state is self.express) and now >= self._rate_due_s:
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
                    whole = item.channel.fragment_acked(item.out, item.generation)
                    if whole:
                        if self.on_arrived is not None:
                            self.on_arrived(item.channel, item.out, now)
                        if self.trace.enabled and item.channel.slot != CONTROL_CHANNEL:
                            topic = item.out.message.stream.topic
                            self.trace.record(now, topic, TraceEvent.ACKED, seq=item.out.seq, peer=self.peer)
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
        self._choose_express(now)

    def _choose_express(self, now: float) -> None:
        """Class control goes beside the stream while that works; what the peer was told must be there before it."""
        lane = self.lanes.get(LANE_EXPRESS)
        if lane is not None and (self.lane.id != LANE_ZMQ or self._paper or not lane.usable):
            lane = None
        if lane is not None and lane is not self.express and (lane.proofs < PROVEN_ACKS or self._control.retained):
            return
        if lane is not self.express:
            left, self.express = self.express, lane
            if left is not None:
                self._recall(left, now)
            state = "takes" if lane is not None else "leaves"
            self.trace.record(now, LINK, TraceEvent.LINK_UP, peer=self.peer, reason=f"class control {state} express")
            self.dirty = True

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
        self._give_back(lane, [item for packet in lane.flight.abandon() for item in packet.items], now)

    def _rate_known(self, now: float) -> None:
        self._rate_due_s = now + RATE_INTERVAL_S
        known = self.lane.estimator.rate_bps is not None
        self.scheduler.set_rate(self.lane.rate_changed() or None, now=now, full=known)

    def _find_losses(self, lane: Lane, now: float) -> None:
        gone = lane.flight.lost(now=now)
        if gone:
            lane.resolved(lost=len(gone))
        for packet in gone:
            lane.estimator.on_loss(now=now, nbytes=packet.nbytes)
            self.dirty = True
        if gone:
            self._give_back(lane, [item for packet in gone for item in packet.items], now)

    def _give_back(self, lane: Lane, items: list[Any], now: float) -> None:
        """What packets carried did not arrive: send again what is still wanted."""
        lost: dict[OutChannel, list[tuple[OutMessage, int, int, int]]] = {}
        for item in items:
            if type(item) is SentData:
                lost.setdefault(item.channel, []).append((item.out, item.generation, item.start, item.end))
            elif type(item) is SentWatermark:
                if item.channel in self.incoming:
                    self._watermarks[item.channel] = self.incoming[item.channel].confirmed
            else:
                lane.ping = True
        for channel, fragments in lost.items():
            again = channel.fragments_lost(fragments, now=now)
            if self.trace.enabled:
                topic = channel.stream.id.topic
                for out in again:
                    self.trace.record(now, topic, TraceEvent.LOST, seq=out.seq, peer=self.peer)
            if self.channels.get(channel.slot) is channel:
                self._refresh(channel, now)

    def _forget_paused(self, stream: InStream) -> None:
        """The peer knows that nobody wants this stream: it has given up what is half received or waits here."""
        stream.forget(DropReason.UNWANTED)

    def on_watermark(self, channel: int, delivered: int) -> bool | None:
        """FrameSink: everything of a reliable channel up to `delivered` has had its turn at the far side."""
        out_channel = self.channels.get(channel)
        if out_channel is None or not out_channel.reliable:
            return None
        # It may lie beyond what was submitted here: the peer had more from an earlier relay (`OutChannel.submit`).
        wide = framing.widen_seq(delivered, out_channel.watermark)
        if wide > out_channel.watermark:
            done = out_channel.delivered_to(wide)
            self._refresh(out_channel, self._now)
            self._watermark_moved(out_channel)
            self.reassembly.work_us += WATERMARK_US + done // DONE_PER_US
        return self.reassembly.work_us > SLICE_US

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

    def _data_deadline(self, lane: Lane) -> float:
        """When `handle_timeout` or `next_datagram` has something to do on this lane by time alone."""
        deadline = lane.ping_due_s
        if lane is self.lane and self._held_back_due_s < deadline:
            deadline = self._held_back_due_s
        if lane.id == LANE_ZMQ and self._sweep_due_s < deadline:
            deadline = self._sweep_due_s
        if self._unsaid and (due_s := self._say_deadline()) < deadline:
            deadline = due_s
        arrivals = lane.arrivals
        if arrivals.unacked and not self._half_read and (due_s := arrivals.deadline_s()) < deadline:
            deadline = due_s
        for candidate in (
            lane.probe_due_s if lane.stalled else lane.stall_deadline(),
            None if lane.lossless else lane.flight.loss_deadline(),
            self._service_deadline(lane) if lane is self.lane and self._backlog else None,
            lane.copies[0][0] if lane.copies else None,
            self._express_deadline(lane) if lane is self.express else None,
        ):
            if candidate is not None and candidate < deadline:
                deadline = candidate
        return deadline

    def _service_deadline(self, lane: Lane) -> float | None:
        """When something that waits may leave by time alone: the pacer or class 0's bucket lets it."""
        now = self._now
        if lane.window_open and not lane.pacer.ready(now):
            pacing_s = lane.pacing_deadline()
            bucket_s = self.scheduler.next_deadline(now=now, window_open=False)
            return pacing_s if bucket_s is None or pacing_s < bucket_s else bucket_s
        return self.scheduler.next_deadline(now=now, window_open=lane.open_at(now))

    def _express_deadline(self, lane: Lane) -> float | None:
        """The same for class control on its own connections."""
        bucket_s = self.scheduler.control_deadline()
        if bucket_s is not None and lane.window_open and not lane.pacer.ready(self._now):
            return min(bucket_s, lane.pacing_deadline())
        return bucket_s

    def _data_timeout(self, lane: Lane, now: float) -> None:
        self._now = now
        self._find_losses(lane, now)
        stall_s = lane.stall_deadline()
        if stall_s is not None and now >= stall_s:
            lane.stalled = True
            lane.proofs = 0
            lane.probe_due_s = now
            if lane.beside is None or not lane.beside.usable:
                lane.estimator.on_stall(now=now)
            reason = f"{lane.name}: no acknowledgement"
            self.trace.record(now, LINK, TraceEvent.LINK_DOWN, peer=self.peer, reason=reason)
            if len(self.lanes) > 1:
                self._choose_lane(now)
        if now >= self._held_back_due_s:
            self._release_held_back(now)
        if now >= lane.ping_due_s:
            lane.ping = True
            lane.ping_due_s = now + PING_INTERVAL_S
        if lane.id == LANE_ZMQ and now >= self._sweep_due_s:
            self._sweep(now)
        self.dirty = True

    def _sweep(self, now: float) -> None:
        """Expire what nobody will send, also while the link is down."""
        self._sweep_due_s = now + SWEEP_INTERVAL_S
        if now >= self._held_back_due_s:
            self._release_held_back(now)
        room = LAPSED_A_SWEEP
        for channel in list(self.channels.values()):
            watermark = channel.watermark
            room -= channel.sweep(now, up=self.established, room=room)
            if channel.offered or channel.active:
                self._refresh(channel, now)
            if channel.watermark > watermark:
                self._watermark_moved(channel)
        self.lapsed += LAPSED_A_SWEEP - room
        if room <= 0:
            self._sweep_due_s = now  # the rest in another turn of the loop
        for stream in self.incoming.values():
            stream.reports.heard(self._control.watermark)
            if 0 < stream.pause_seq <= self._control.watermark:
                self._forget_paused(stream)
