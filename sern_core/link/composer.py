"""What goes into the next datagram of a lane: watermarks, control messages, and fragments of one class. Pure."""

from collections.abc import Callable
from enum import IntEnum
from typing import Final

from sern_core.link.background import Background
from sern_core.link.control_stream import ControlStream
from sern_core.link.datagram import MIN_SHARE_BYTES, Datagram
from sern_core.link.end import End
from sern_core.link.lane_set import LaneSet
from sern_core.link.outlook import Outlook
from sern_core.link.sender import Sender, class_of
from sern_core.link.streams_in import StreamsIn
from sern_core.path.lanes import OVERHEAD_BYTES, Lane
from sern_core.stream.coding import Coding
from sern_core.stream.out_channel import OutChannel
from sern_core.stream.out_message import OutMessage
from sern_core.vocabulary.types import DropReason, PriorityClass
from sern_core.wire import framing

MIN_FILL_DIVISOR: Final = 32
"""A datagram with less than 1/32 of its size free is sent as it is."""
RIDE_BYTES: Final = 256
"""Most bytes of a control message that travel with each datagram of class 0. Where class 0 alone keeps the window shut,
what would open a better lane, or another stream, must come through all the same."""
MAX_WATERMARKS: Final = 64


class Waiting(IntEnum):
    """What waits for window and pacer of a lane, the most urgent of it."""

    NOTHING = 0
    BACKGROUND = 1
    LIVE = 2


class Composer:
    """`control_sent` is told the number of each control message that is on the wire whole."""

    def __init__(
        self,
        end: End,
        lanes: LaneSet,
        control: ControlStream,
        sender: Sender,
        taking: StreamsIn,
        control_sent: Callable[[int], None],
        *,
        now: float,
    ) -> None:
        self._end = end
        self._lanes = lanes
        self._control = control
        self._sender = sender
        self._taking = taking
        self._control_sent = control_sent
        self._outlook = Outlook(now)
        self.background = Background()
        self.served: OutChannel | None = None
        """What left last, while decisions are traced; control messages aside."""

    def fill(self, datagram: Datagram, lane: Lane, now: float) -> bool:
        """Fill one datagram: watermarks, then what the scheduler picks, of one class; control ahead of all but class 0.

        Control keeps to the window like everything below class 0, as a thousand announcements must not fill the path;
        but a little of it rides in each datagram of class 0, at the cost of that class's share: that is its floor, also
        where class 0 alone has more than the link carries. Returns whether window and pacer were open to the other
        classes.
        """
        sender, scheduler = self._sender, self._sender.scheduler
        control = self._control
        limit = lane.fragment_bytes - framing.ACK.size * min(lane.arrivals.acks, framing.MAX_ACK_FRAMES)
        control_only = lane is self._lanes.priority_lane
        window_open = lane.open_at(now)
        pends = scheduler.pends
        if not window_open and pends:
            self._outlook.waits(now)
            if scheduler.pending(PriorityClass.STATE) or scheduler.pending(PriorityClass.BULK):
                self.background.live_waits(now)
        # Behind a window that is shut class control alone may leave.
        waits = pends or control.waits if window_open else scheduler.pending(PriorityClass.CONTROL)
        if not (waits or self._taking.watermarks or sender.paper):
            return window_open
        if not control_only and self._taking.watermarks:
            for channel_id, seq in self._taking.take_watermarks(MAX_WATERMARKS, acked_seq=control.acked_seq):
                datagram.watermark(channel_id, seq)
        served: PriorityClass | None = None
        ride = False  # it is the turn of a little control, behind class 0
        spoke = False
        full = limit - max(framing.DATA_FIRST_BYTES + MIN_SHARE_BYTES, limit // MIN_FILL_DIVISOR)
        while datagram.size <= full:
            if control_only:
                chosen = scheduler.pick_control(now=now, window_open=window_open)
            else:
                chosen = self.pick(now, window_open=window_open)
            channel = sender.channels[chosen] if chosen is not None else None
            urgent = channel is not None and channel.spec.priority is PriorityClass.CONTROL
            said = control.out.head(now) if not control_only and control.waits else None
            if said is not None and (ride or (window_open and not urgent)):
                end = min(limit, datagram.size + framing.DATA_FIRST_BYTES + RIDE_BYTES) if ride else limit
                grown = self._put(datagram, control.out, said, end, now)
                spoke = True
                if not said.has_unsent:
                    self._control_sent(said.seq)
                if ride:
                    scheduler.charge(PriorityClass.CONTROL, grown, now=now)
                    break
                continue
            if channel is None or (channel.spec.background and not self.background.room(lane, now)):
                break
            out = channel.head(now)
            if out is None:
                sender.refresh(channel, now)
                continue
            if out.coding is Coding.RAW and channel.codec is not None and not sender.encoded(channel, out, now):
                continue
            if not self._outlook.in_time(channel, out, lane, now):
                channel.drop_head(DropReason.TOO_SLOW, now)
                sender.refresh(channel, now)
                continue
            priority = class_of(channel, out)
            if served is None and priority is not PriorityClass.CONTROL:
                limit = self._cut(lane, limit, now)
            if served is None and channel.spec.background:
                limit = min(limit, self.background.limit(lane, now))
            shared = said is not None and priority is PriorityClass.CONTROL
            end = limit - framing.DATA_FIRST_BYTES - RIDE_BYTES if shared else limit
            if datagram.frames and (
                (served is not None and priority is not served)
                or (out.size if out.ranges is None else out.unsent_bytes)
                > end - datagram.size - framing.DATA_FIRST_BYTES
            ):
                if shared and served is PriorityClass.CONTROL:
                    ride = True
                    continue
                break
            served = priority
            grown = self._put(datagram, channel, out, end, now)
            ride = shared and not window_open
            scheduler.charge(priority, grown, now=now, background=channel.spec.background)
            if channel.spec.background:
                self._lanes.background_bytes += grown
            self._outlook.sent(priority, grown, now)
            sender.refresh(channel, now)
            if lane.stalled:
                break
        if served is PriorityClass.CONTROL or (served is PriorityClass.BULK and not spoke):
            lane.priority = served
        return window_open

    def waits(self, lane: Lane, now: float) -> Waiting:
        """What would leave if window and pacer let it. What the background holds back by itself does not: the link was
        not full then. Unless a queue stays: then it is, and slower than it was."""
        chosen = self._sender.scheduler.pick(now=now, window_open=True)
        if chosen is None:
            self._outlook.nothing_waits()
        if chosen is None or self._control.waits:
            return Waiting.LIVE if self._control.waits else Waiting.NOTHING
        if not self._sender.channels[chosen].spec.background:
            return Waiting.LIVE
        full = lane.estimator.queues or self.background.room(lane, now)
        return Waiting.BACKGROUND if full else Waiting.NOTHING

    def pick(self, now: float, *, window_open: bool) -> int | None:
        """The channel that the lane with the data would serve next; class control goes over the priority lane, if there
        is one."""
        if self._lanes.priority_lane is not None:
            return self._sender.scheduler.pick_rest(now=now) if window_open else None
        return self._sender.pick(now, window_open=window_open)

    def _cut(self, lane: Lane, limit: int, now: float) -> int:
        """Bytes of a datagram without class 0: so many that the link is free when class 0 wants it next."""
        rate_bps = lane.estimator.rate_bps
        if rate_bps is None:
            return limit
        share = self._sender.cadences.share(now, 8 * (limit + OVERHEAD_BYTES) / rate_bps)
        return limit if share >= 1.0 else int(share * (limit + OVERHEAD_BYTES)) - OVERHEAD_BYTES

    def _put(self, datagram: Datagram, channel: OutChannel, out: OutMessage, limit: int, now: float) -> int:
        """Append one fragment; returns by how many bytes the datagram grew."""
        started = out.started
        grown = datagram.fragment(channel, out, limit, now)
        trace = self._end.trace
        if trace.enabled and channel is not self._control.out:
            self.served = channel
            told = self._sender.told
            if trace.steps or channel.channel_id in told.holding:
                told.left(channel, out, started, now)
        return grown
