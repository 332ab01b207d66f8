"""The data plane of one end of a hop: datagrams out, acknowledgements in, losses and time, lane by lane. Pure."""

from collections.abc import Callable
from typing import Any, Final

from sern_core.link.answers import Answers
from sern_core.link.composer import Composer, Waiting
from sern_core.link.control_stream import CONTROL_CHANNEL_ID, ControlStream
from sern_core.link.datagram import Datagram, SentData, SentWatermark
from sern_core.link.end import End
from sern_core.link.holds import Holds
from sern_core.link.housekeeping import Housekeeping
from sern_core.link.lane_set import LaneSet
from sern_core.link.sender import Sender
from sern_core.link.streams_in import StreamsIn
from sern_core.path.lanes import (
    COPY_DELAY_S,
    LANE_ZMQ,
    MAX_PROBE_INTERVAL_S,
    OVERHEAD_BYTES,
    PING_INTERVAL_S,
    PROBE_INTERVAL_S,
    Lane,
)
from sern_core.stream.out_channel import OutChannel
from sern_core.stream.out_message import OutMessage
from sern_core.vocabulary.message import Message, TopicSpec
from sern_core.vocabulary.types import PriorityClass
from sern_core.wire import framing

ASK_AGAIN_S: Final = 10.0
"""On a stream that does not answer, a question follows another so much later."""


class DataPlane:
    """Moves datagrams of an established session, and says when a lane has something to do by time alone."""

    def __init__(
        self,
        end: End,
        lanes: LaneSet,
        control: ControlStream,
        sender: Sender,
        taking: StreamsIn,
        answers: Answers,
        composer: Composer,
        housekeeping: Housekeeping,
    ) -> None:
        self._end = end
        self._lanes = lanes
        self._control = control
        self._sender = sender
        self._taking = taking
        self._answers = answers
        self._composer = composer
        self._housekeeping = housekeeping
        self.holds = Holds(end, lanes, control, sender, composer.background)
        """Why what waits does."""
        self.on_arrived: Callable[[TopicSpec, Message, float], None] | None = None
        """Called when the peer has a message whole: what holds for its topic, the message, now."""

    # --- bytes out ------------------------------------------------------------------------------------------------

    def next_datagram(self, lane: Lane, now: float) -> bytes | None:
        """The next kind-16 datagram of an established session for one lane, or None."""
        end, lanes = self._end, self._lanes
        if not end.dirty and len(lanes.by_id) == 1:
            return None  # nothing has changed since the last answer, and `handle_timeout` says when time has
        end.now = now
        if self._answers.unsaid:
            self._answers.say(now)
        if lane.copies and (copy := lane.due_copy(now)) is not None:
            self._sender.scheduler.charge(PriorityClass.CONTROL, len(copy), now=now)
            lanes.wire_bytes += len(copy) + OVERHEAD_BYTES
            lane.copy_rest.sent(copy=True)
            lane.priority = PriorityClass.CONTROL
            return copy
        lane.priority = PriorityClass.STATE
        datagram = Datagram()
        if not lane.stalled or now >= lane.probe_due_s:
            self._fill(datagram, lane, now)
            if now >= self.holds.due_s and self._sender.scheduler.busy:
                self.holds.served = self._composer.served
                self.holds.look(now)
        arrivals = lane.arrivals
        if arrivals.unacked and not end.half_read and (datagram.items or arrivals.due or now >= arrivals.deadline_s()):
            # In front: the receiver's clock estimate has the newest sample before it judges the age of what follows.
            acks = arrivals.take(framing.MAX_ACK_FRAMES, now)
            datagram.frames[:0] = [framing.encode_ack(lane.id, *ack) for ack in acks]
            end.dirty = end.dirty or arrivals.due
        if not datagram.frames:
            return None
        if not datagram.items:
            end.dirty = end.dirty or len(lanes.by_id) > 1
            return b"".join((end.header(0, now), *datagram.frames))
        return self._sent(datagram, lane, now)

    def _fill(self, datagram: Datagram, lane: Lane, now: float) -> None:
        lanes = self._lanes
        if lane is lanes.lane or lane is lanes.priority_lane:
            self._end.dirty = False
            try:
                window_open = self._composer.fill(datagram, lane, now)
            except Exception:  # goes on to whoever called; only the state is put right here
                self.give_back(lane, datagram.items, now)  # what was taken would be neither in flight nor waiting
                raise
            if not datagram.items and not window_open and not lane.path.held and self._backlog:
                lane.path.held = not lane.stalled
        # A stream delivers what is under way, so one question at a time is enough there: unless whoever would answer it
        # is not there any more.
        asked = lane.lossless and now < lane.flight.latest_sent_s + ASK_AGAIN_S
        if not datagram.items and (lane.ping or lane.stalled) and not asked:
            datagram.ping()
        lane.ping = False
        if lane.stalled:
            lane.probe_due_s = now + min(max(PROBE_INTERVAL_S, lane.flight.rtt.srtt_s), MAX_PROBE_INTERVAL_S)

    def _sent(self, draft: Datagram, lane: Lane, now: float) -> bytes:
        """Number a datagram and take it into account; returns its bytes."""
        end, lanes, scheduler = self._end, self._lanes, self._sender.scheduler
        flight = lane.flight
        datagram = b"".join((end.header(flight.next_number, now), *draft.frames))
        nbytes = len(datagram) + OVERHEAD_BYTES
        estimator = lane.estimator
        inflight_bytes = nbytes + (flight.inflight_bytes if lane.beside is None else lane.under_way_bytes)
        # What could be picked if window and pacer let it is held back by them; ordering `paper` holds back by itself.
        carries = lane is lanes.lane or lane is lanes.priority_lane
        waiting = self._composer.waits(lane, now) if carries else Waiting.NOTHING
        waits = waiting is not Waiting.NOTHING
        path = lane.path
        app_limited = not waits and not path.held and inflight_bytes < estimator.window_bytes
        path.held = False
        flight.sent(now=now, nbytes=nbytes, items=draft.items, app_limited=app_limited, priority=lane.priority)
        estimator.on_sent(now=now, nbytes=nbytes, inflight_bytes=inflight_bytes)
        pacer = lane.pacer
        # The background waits for room on the path, too, and makes good nothing.
        paced = waiting is Waiting.LIVE and inflight_bytes < estimator.window_bytes
        pacer.sent(now=now, nbytes=nbytes, pacing_bps=estimator.pacing_bps, waits=paced)
        if lane is lanes.lane and (rate_bps := estimator.rate_bps) is not None:
            full_s = 8 * (lane.fragment_bytes + OVERHEAD_BYTES) / rate_bps
            pacer.due_s = self._sender.cadences.hold(pacer.due_s, full_s)
        lanes.wire_bytes += nbytes
        lane.question_due(now, only_asked=draft.asks)
        watermarks = bool(self._taking.watermarks)
        if len(lanes.by_id) > 1:
            end.dirty = True
        elif lane.open_at(now):
            end.dirty = waits or watermarks
        else:
            end.dirty = watermarks or (waits and self._composer.pick(now, window_open=False) is not None)
        redundant = lane.redundant
        if redundant or lane is lanes.priority_lane:
            lane.spare = not waits or scheduler.within_share(now)
            lane.copy_rest.sent(copy=False)
            if (
                redundant
                and lane.spare
                and lane.copy_rest.may(now, queues=estimator.queues)
                and any(type(item) is SentData and _urgent(item.channel) for item in draft.items)
            ):
                lane.copies.append((now + COPY_DELAY_S, flight.next_number - 1, datagram))
        return datagram

    def may_copy(self, nbytes: int) -> bool:
        """Whether the priority lane's latest datagram, of `nbytes`, may go over its second connection as well; then it
        counts as class control's. While something waits for the link copies come out of that class's share."""
        lanes = self._lanes
        if lanes.priority_lane is not None:
            if not lanes.priority_lane.spare:
                return False
            self._sender.scheduler.charge(PriorityClass.CONTROL, nbytes, now=self._end.now)
            lanes.wire_bytes += nbytes + OVERHEAD_BYTES
        return True

    @property
    def _backlog(self) -> bool:
        """Whether more could be sent if the window allowed it."""
        return self._control.waits or self._sender.pending

    # --- what became of it ----------------------------------------------------------------------------------------

    def acknowledged(
        self, lane_id: int, highest: int, sack: int, echo_us: int, received_us: int, cum_bytes: int, stamp_us: int
    ) -> None:
        """An acknowledgement of what we sent, given at `stamp_us` of the peer's clock. Raises WireError."""
        end, now = self._end, self._end.now
        lane = self._lanes.acknowledged_by(lane_id, highest)
        if lane is None:
            return
        packets = self._lanes.acknowledged(
            lane,
            highest,
            sack,
            echo_us=echo_us,
            received_us=received_us,
            cum_bytes=cum_bytes,
            stamp_us=stamp_us,
            now=now,
        )
        for packet in packets:
            for item in packet.items:
                if type(item) is SentData and item.channel.fragment_acked(item.out, item.generation):
                    if self.on_arrived is not None:
                        self.on_arrived(item.channel.spec, item.out.message, now)
                    if end.trace.steps and item.channel.channel_id != CONTROL_CHANNEL_ID:
                        self._sender.told.acked(item.channel, item.out, now)
        control = self._control.out
        if control.retained:
            control.settle()
        if not lane.flight.lossless:
            self._lanes.find_losses(lane, now)

    def give_back(self, lane: Lane, items: list[Any], now: float) -> None:
        """What packets carried did not arrive: send again what is still wanted."""
        lost: dict[OutChannel, list[tuple[OutMessage, int, int, int]]] = {}
        for item in items:
            if type(item) is SentData:
                lost.setdefault(item.channel, []).append((item.out, item.generation, item.start, item.end))
            elif type(item) is SentWatermark:
                self._taking.tell_again(item.channel_id)
            else:
                lane.ping = True
        self._sender.lost(lost, now)

    # --- time -----------------------------------------------------------------------------------------------------

    def deadline_s(self, lane: Lane) -> float:
        """When `handle_timeout` or `next_datagram` has something to do on this lane by time alone."""
        deadline = lane.ping_due_s
        if lane is self._lanes.lane and self._sender.held_back_due_s < deadline:
            deadline = self._sender.held_back_due_s
        if lane.id == LANE_ZMQ and (due_s := self._housekeeping.due_s) < deadline:
            deadline = due_s
        if self._answers.unsaid and (due_s := self._answers.deadline_s) < deadline:
            deadline = due_s
        arrivals = lane.arrivals
        if arrivals.unacked and not self._end.half_read and (due_s := arrivals.deadline_s()) < deadline:
            deadline = due_s
        candidate = lane.probe_due_s if lane.stalled else lane.stall_deadline()
        if candidate is not None and candidate < deadline:
            deadline = candidate
        if not lane.lossless and (candidate := lane.flight.loss_deadline()) is not None and candidate < deadline:
            deadline = candidate
        if lane is self._lanes.lane and self._backlog:
            candidate = self._service_deadline(lane)
            if candidate is not None and candidate < deadline:
                deadline = candidate
        if lane.copies and (due_s := lane.copies[0][0]) < deadline:
            deadline = due_s
        if lane is self._lanes.priority_lane:
            candidate = self._priority_lane_deadline(lane)
            if candidate is not None and candidate < deadline:
                deadline = candidate
        return deadline

    def _service_deadline(self, lane: Lane) -> float | None:
        """When something that waits may leave by time alone: the pacer or class 0's bucket lets it."""
        now, scheduler = self._end.now, self._sender.scheduler
        if lane.window_open and not lane.pacer.ready(now):
            pacing_s = lane.pacing_deadline()
            bucket_s = scheduler.next_deadline(now=now, window_open=False)
            return pacing_s if bucket_s is None or pacing_s < bucket_s else bucket_s
        return scheduler.next_deadline(now=now, window_open=lane.open_at(now))

    def _priority_lane_deadline(self, lane: Lane) -> float | None:
        """The same for class control on its own connections."""
        bucket_s = self._sender.scheduler.control_deadline()
        if bucket_s is not None and lane.window_open and not lane.pacer.ready(self._end.now):
            return min(bucket_s, lane.pacing_deadline())
        return bucket_s

    def handle_timeout(self, lane: Lane, now: float) -> None:
        """Time has passed for a lane of the session."""
        self._end.now = now
        self._lanes.find_losses(lane, now)
        self._lanes.find_silence(lane, now)
        if now >= self._sender.held_back_due_s:
            self._sender.release_held_back(now)
        if now >= lane.ping_due_s:
            lane.ping = True
            lane.ping_due_s = now + PING_INTERVAL_S  # unless one leaves now
        if lane.id == LANE_ZMQ and now >= self._housekeeping.due_s:
            self._housekeeping.sweep(now)
        self._end.dirty = True


def _urgent(channel: OutChannel) -> bool:
    return channel.spec.priority is PriorityClass.CONTROL and channel.channel_id != CONTROL_CHANNEL_ID
