"""What arrives, datagram by datagram: acknowledgements, watermarks, and fragments for their streams. Pure."""

from collections.abc import Callable
from typing import Final

from sern_core.bodies.codecs import KNOWN_CODECS
from sern_core.link.control_stream import CONTROL_CHANNEL_ID, MAX_CONTROL_BYTES, ControlStream
from sern_core.link.data_plane import DataPlane
from sern_core.link.end import End
from sern_core.link.events import Events
from sern_core.link.lane_set import LaneSet
from sern_core.link.sender import Sender
from sern_core.link.streams_in import StreamsIn
from sern_core.path.lanes import OVERHEAD_BYTES, Lane
from sern_core.stream.in_stream import Reassembly
from sern_core.vocabulary.errors import RemoteError, WireError
from sern_core.vocabulary.types import DropReason
from sern_core.wire import framing

WATERMARK_US: Final = 4
DONE_PER_US: Final = 2
"""Kept messages that are let go of in a microsecond when the peer has them."""


class Receiver:
    """The `FrameSink` of one end."""

    def __init__(
        self,
        end: End,
        lanes: LaneSet,
        control: ControlStream,
        sender: Sender,
        taking: StreamsIn,
        plane: DataPlane,
        reassembly: Reassembly,
        events: Events,
    ) -> None:
        self._end = end
        self._lane = lanes.lane  # of the datagram at hand
        self._stamp_us = 0
        self._delay: tuple[float, float, float] | None = None
        """Delay of the datagram at hand, its uncertainty, and for how long the clocks had not shifted."""
        self._lanes = lanes
        self._control = control
        self._sender = sender
        self._taking = taking
        self._plane = plane
        self._reassembly = reassembly
        self._events = events
        self.strays = 0
        """Fragments of streams that are unknown here."""
        self.on_stray: Callable[[], None] | None = None
        """Called for each message of a stream that is unknown here (drop reason `unknown_channel`)."""

    def receive(
        self, lane: Lane, number: int, stamp_us: int, data: framing.Datagram, now: float, position: int = 0
    ) -> int:
        """Read a kind-16 datagram of the session, from `position` on if it was read up to there before. Returns where
        to go on when that has cost enough for one turn; 0: it is read. Raises WireError."""
        self._lane = lane
        self._stamp_us = stamp_us
        self._delay = None
        self._end.now = now
        clock = self._lanes.clock
        if stamp_us * 1e-6 - now > clock.ahead_s:
            clock.witness(stamp_us * 1e-6, now)
        if number and not position:
            arrivals = lane.arrivals
            if not arrivals.arrived(number, stamp_us, len(data) + OVERHEAD_BYTES, now=now):
                return 0
            if arrivals.due or arrivals.unacked <= 2:
                self._end.dirty = True  # an acknowledgement is due; of the third and later ones the deadline is known
        return framing.decode_frames(data, self, position or framing.HEADER_BYTES)

    def on_data(
        self,
        flags: int,
        channel_id: int,
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
        now = self._end.now
        if codec and (
            codec not in KNOWN_CODECS or channel_id == CONTROL_CHANNEL_ID or flags & framing.FLAG_DROP_MARKER
        ):
            raise WireError(f"codec {codec} has no place there")
        if flags & framing.FLAG_URGENT:
            self._lane.arrivals.due = True
        if channel_id == CONTROL_CHANNEL_ID:
            stream = self._control.incoming
            if total > MAX_CONTROL_BYTES:
                raise WireError(f"control message of {total} bytes exceeds {MAX_CONTROL_BYTES}")
        else:
            known = self._taking.incoming.get(channel_id)
            if known is None:
                self.strays += 1
                if offset == 0 and self.on_stray is not None:
                    self.on_stray()
                return None
            stream = known
        wide = framing.widen_seq(seq, stream.delivered)
        if wide >= framing.MAX_SEQ:  # what follows it could not be announced
            raise WireError(f"seq {wide}: streams end below {framing.MAX_SEQ}")
        if total > self._end.params.max_message_bytes:
            if offset == 0:
                stream.give_up(wide, DropReason.TOO_LARGE, total, now)
            return None
        born_s = now
        if offset == 0:
            clock = self._lanes.clock
            if self._delay is None:
                stamp_s = self._stamp_us * 1e-6
                self._delay = (*clock.one_way_delay_s(stamp_s, now), stamp_s - clock.behind_until_s)
            delay_s, uncertainty_s, in_step_s = self._delay
            born_s = now - age_s - delay_s
            error_s += uncertainty_s  # infinite before the first round trip
            if age_s >= in_step_s:
                error_s += clock.behind_s(self._stamp_us * 1e-6 - age_s)  # what the peer's clock lost meanwhile
        try:
            stream.fragment(flags, wide, offset, total, body, stamp_ns, born_s, error_s, now, codec)
        except RemoteError:
            raise
        except Exception as error:
            if channel_id == CONTROL_CHANNEL_ID:
                raise  # what follows it depends on it: the session ends
            self._events.fault(error)
            stream.fail(wide, total, now)
        return self._reassembly.work_us > self._reassembly.slice_us

    def on_ack(self, lane: int, highest: int, sack: int, echo_us: int, received_us: int, cum_bytes: int) -> None:
        """FrameSink: an acknowledgement of what we sent."""
        self._delay = None  # it may tell more of the peer's clock
        self._plane.acknowledged(lane, highest, sack, echo_us, received_us, cum_bytes, self._stamp_us)

    def on_watermark(self, channel_id: int, delivered: int) -> bool | None:
        """FrameSink: everything of a reliable channel up to `delivered` has had its turn at the far side."""
        channel = self._sender.channels.get(channel_id)
        if channel is None or not channel.reliable:
            return None
        # It may lie beyond what was submitted here: the peer had more from an earlier relay (`OutChannel.submit`).
        wide = framing.widen_seq(delivered, channel.watermark)
        if wide > channel.watermark:
            done = self._sender.watermark(channel, wide, self._end.now)
            self._reassembly.work_us += WATERMARK_US + done // DONE_PER_US
        return self._reassembly.work_us > self._reassembly.slice_us

    def on_ping(self) -> None:
        """FrameSink: the peer asks for an acknowledgement now."""
        self._lane.arrivals.due = True
        self._end.dirty = True
