"""One lane of a hop: its flight, its arrivals, its estimator, its fragment size."""

from collections import deque
from dataclasses import replace
from typing import Final

from sern_core.path.capacity import CapacityEstimator, Pacer
from sern_core.path.congestion.fixed import FixedWindow
from sern_core.path.congestion.hybrid import HybridWindow
from sern_core.path.congestion.params import DEFAULT_HYBRID
from sern_core.path.copies import CopyRest
from sern_core.path.flight import Arrivals, Flight
from sern_core.vocabulary.params import LinkParams, Redundancy, WindowAlgorithm
from sern_core.vocabulary.types import PriorityClass

LANE_ZMQ: Final = 0
LANE_UDP: Final = 1
LANE_PRIORITY: Final = 2
"""Class control alone, over TCP connections of its own: behind no bulk byte, and no retransmission of one."""
LANE_NAMES: Final = {LANE_ZMQ: "zmq", LANE_UDP: "udp", LANE_PRIORITY: "priority"}

DATAGRAM_BYTES: Final = 1171
"""A datagram of the UDP lane: with seal, session and kind it is 1200 bytes of UDP payload, which every path carries."""
MIN_FRAGMENT_BYTES: Final = 1200
FRAGMENT_TIME_S: Final = 0.003
"""On a stream lane one fragment takes about 3 ms of the link: what a more urgent message may have to wait."""
UNKNOWN_RATE_FRAGMENT_BYTES: Final = 1400
OVERHEAD_BYTES: Final = 60
"""What one datagram costs beside its own bytes: ZMTP, CURVE, TCP/IP or UDP/IP and AEAD."""
PROVEN_ACKS: Final = 3
"""A lane that failed while another one worked is used again after so many acknowledged questions."""
PING_INTERVAL_S: Final = 0.5
PING_GROWTH: Final = 16
LEASED_PING_INTERVAL_S: Final = 16.0
"""On a leased lane the pause before a question grows by that factor up to this while nothing else goes either way."""
IDLE_BYTES: Final = 256
"""What has come since the last question was no more than the peer's own questions if it is no more than this."""
PROBE_INTERVAL_S: Final = 0.1
MAX_PROBE_INTERVAL_S: Final = 0.2
"""While stalled, one fresh class-0 message goes out this often and finds out whether the path is back: once in a round
trip, between these two. On 64 kbit/s a probe every 0.1 s is a share of the link that poses wait for."""


COPY_DELAY_S: Final = 0.005
"""Losses come in bursts: a copy right behind its original would share its fate. Long enough to leave a short burst,
short against what a command may be late. Of 7 ms, 2 % loss makes one pose in a hundred 7 ms late; with 5 ms, bursts of
ten packets take .2 % more of the poses, each of which the next one replaces."""
COPY_LOSS: Final = 0.005
"""Above this share of losses class control is sent twice."""
COPY_PACKETS: Final = 2000
"""And for so many packets after: at 2 % the share falls below the threshold in lucky moments, and what is lost in them
would have had no copy."""
LOSS_GAIN: Final = 0.01


def _estimator(params: LinkParams) -> CapacityEstimator:
    if params.window.algorithm is WindowAlgorithm.FIXED:
        return FixedWindow(params.window.fixed_bytes)
    hybrid = replace(DEFAULT_HYBRID, variable_queue_s=params.window.variable_rate_queue_s)
    return HybridWindow(fragment_bytes=MIN_FRAGMENT_BYTES + OVERHEAD_BYTES, params=hybrid)


class Path:
    """What the lanes over one path have in common: one window, one pace, and one count of what has arrived.

    The priority lane shares the path of the stream that it is beside. With a window of its own each of them would take
    the other's traffic for a slower link, and class control would have none while the stream has nothing to send.
    """

    __slots__ = ("arrived_bytes", "estimator", "held", "pacer")

    def __init__(self, estimator: CapacityEstimator) -> None:
        self.estimator = estimator
        self.pacer = Pacer()
        self.arrived_bytes = 0
        self.held = False
        """Something has waited for the window or the pace since the last datagram left: that left because there was
        room again, and not because there was something to send, even if nothing is left behind it."""


class Lane:
    """State of one lane of one link. `lossless`: a stream (TCP) underneath. `any_size`: datagrams may be large, as over
    a stream, lost or not (None: where nothing is lost). `leased`: it leads to another relay, and what carries it tells
    within seconds that the peer is gone: an idle lane need not ask often, and acknowledgements are sparse. `beside`: of
    which lane it shares the path, until `leave`."""

    def __init__(
        self,
        lane: int,
        params: LinkParams,
        *,
        lossless: bool,
        any_size: bool | None = None,
        leased: bool = False,
        beside: "Lane | None" = None,
    ) -> None:
        self.id = lane
        self.lossless = lossless
        self.any_size = lossless if any_size is None else any_size
        self.fragment_bytes_max = params.fragment_bytes_max if self.any_size else DATAGRAM_BYTES
        self.beside = beside
        """The other lane of the path; None: there is none."""
        self.path: Path = Path(_estimator(params)) if beside is None else beside.path
        self.estimator = self.path.estimator
        self.pacer = self.path.pacer
        self.acknowledged_bytes = 0
        """What has arrived of this lane's datagrams in the session, as the peer said last."""
        if beside is not None:
            beside.beside = self
        self.flight = Flight(lossless=lossless)
        self.leased = leased
        self.arrivals = Arrivals(lossless=lossless, sparse=leased)
        self.stalled = False
        self.stalled_at_s = 0.0
        """When it was last found to be."""
        self.probe_due_s = 0.0
        self.up = False  # it has a transport
        self.proofs = 0  # questions answered since it was opened or had stalled
        self.answered = False  # at all, in the session
        self.ping = False
        self.ping_due_s = 0.0
        self._ping_interval_max_s = LEASED_PING_INTERVAL_S if leased else PING_INTERVAL_S
        self._ping_interval_s = PING_INTERVAL_S
        self._came_bytes = 0  # by the last question
        self.loss = 0.0
        """Share of recent packets that were lost."""
        self.acked_packets = 0
        self.lost_packets = 0
        """Both since the lane was opened."""
        self.copies: deque[tuple[float, int, bytes]] = deque()
        """Second copies to send: when, of which packet, the datagram."""
        self.copy_rest = CopyRest()
        self._copied_packets = 0  # so many more will have copies
        self.copies_wanted: bool | None = None
        """What the adaptation says of them, where the configuration leaves it open (`auto`); None: the loss decides."""
        self._unacked_bytes = 0.0
        """What arrives between two acknowledgements of a fast stream, beyond the two fragments that make one due."""
        self.priority = PriorityClass.STATE
        """The most urgent class in the latest datagram; acknowledgements, questions and control messages are STATE."""
        self.spare = True
        """Whether a second copy of the latest datagram keeps nobody waiting, or is within class control's share."""
        self._redundancy = params.redundancy
        self.fragment_bytes = self._fragment_bytes(None)

    def _fragment_bytes(self, rate_bps: float | None) -> int:
        if not self.any_size:
            return DATAGRAM_BYTES
        if rate_bps is None:
            return min(UNKNOWN_RATE_FRAGMENT_BYTES, self.fragment_bytes_max)
        return int(min(max(FRAGMENT_TIME_S * rate_bps / 8, MIN_FRAGMENT_BYTES), self.fragment_bytes_max))

    def rate_changed(self) -> float | None:
        """Adopt the rate that the path carries at least; returns it."""
        rate_bps = self.estimator.bound_bps
        self.fragment_bytes = self._fragment_bytes(rate_bps)
        self._unacked_bytes = max(0.0, self.arrivals.spacing_s * (rate_bps or 0.0) / 8 - 2 * self.fragment_bytes)
        return rate_bps

    def leave(self) -> None:
        """The lane beside goes on alone."""
        if self.beside is not None:
            self.beside.beside = None
            self.beside = None

    @property
    def under_way_bytes(self) -> int:
        """Bytes in flight on the path: here, and on the lane beside unless that waits for a lost segment."""
        beside = self.beside
        nbytes = self.flight.inflight_bytes
        return nbytes if beside is None or beside.stalled else nbytes + beside.flight.inflight_bytes

    def arrived(self, cum_bytes: int) -> int:
        """The peer has got so many bytes of this lane in all; returns the bytes that it has got over the path."""
        if cum_bytes > self.acknowledged_bytes:
            self.path.arrived_bytes += cum_bytes - self.acknowledged_bytes
            self.acknowledged_bytes = cum_bytes
        return self.path.arrived_bytes

    @property
    def window_open(self) -> bool:
        """Whether the bytes in flight leave room; class 0 asks only when its token bucket is spent, and the pacer has
        a word as well."""
        if self.stalled:
            return False
        nbytes = self.flight.inflight_bytes if self.beside is None else self.under_way_bytes
        return nbytes < self.estimator.window_bytes + self._unacked_bytes

    def open_at(self, now: float) -> bool:
        """Whether a datagram below class 0 may leave now."""
        return self.window_open and self.pacer.ready(now)

    def pacing_deadline(self) -> float:
        """When the pacer lets the next datagram go."""
        return self.pacer.due_s

    def stall_deadline(self) -> float | None:
        flight = self.flight
        if self.stalled or flight.waiting_since_s is None:
            return None
        return flight.waiting_since_s + flight.stall_timeout_s()

    @property
    def name(self) -> str:
        return LANE_NAMES[self.id]

    def resolved(self, *, acked: int = 0, lost: int = 0) -> None:
        """The fate of packets is known: follow the share of losses, over about the last hundred."""
        self.acked_packets += acked
        self.lost_packets += lost
        self.loss *= (1.0 - LOSS_GAIN) ** (acked + lost)
        self.loss = min(1.0, self.loss + LOSS_GAIN * lost)
        self._copied_packets = COPY_PACKETS if self.loss > COPY_LOSS else self._copied_packets - acked - lost

    @property
    def redundant(self) -> bool:
        """Whether class control is sent twice here; the priority lane's connections see to that themselves."""
        if self.lossless or self.id == LANE_PRIORITY or self._redundancy is Redundancy.OFF:
            return False
        if self._redundancy is Redundancy.ALWAYS:
            return True
        return self._copied_packets > 0 if self.copies_wanted is None else self.copies_wanted

    def due_copy(self, now: float) -> bytes | None:
        """A second copy whose time has come and whose packet nobody has acknowledged yet."""
        copies = self.copies
        while copies and copies[0][0] <= now:
            _, number, datagram = copies.popleft()
            if number in self.flight.packets:
                return datagram
        return None

    def question_due(self, now: float, *, only_asked: bool = False) -> None:
        """A numbered datagram leaves (`only_asked`: it is a question itself), or the lane is about to ask."""
        came_bytes = self.arrivals.cum_bytes
        idle = only_asked and not self.stalled and came_bytes - self._came_bytes <= IDLE_BYTES
        interval_s = PING_GROWTH * self._ping_interval_s if idle else PING_INTERVAL_S
        if not self.lossless and self.proofs < PROVEN_ACKS and not self.stalled_at_s:
            interval_s = PROBE_INTERVAL_S  # a lane that is new is to carry data soon; one that failed may wait
        self._ping_interval_s = min(interval_s, self._ping_interval_max_s)
        self._came_bytes = came_bytes
        self.ping_due_s = now + self._ping_interval_s

    @property
    def usable(self) -> bool:
        return self.up and not self.stalled

    def new_session(self, now: float) -> None:
        """Numbers start again; the flight was abandoned before."""
        self.proofs = 0
        self.answered = False
        self.ping = False
        self.ping_due_s = now
        self._ping_interval_s = PING_INTERVAL_S
        self._came_bytes = 0
        self.copies.clear()
        self.copy_rest.restart()
        self.flight = Flight(lossless=self.lossless)
        self.arrivals = Arrivals(lossless=self.lossless, sparse=self.leased)
        self.acknowledged_bytes = 0
        if self.beside is None:
            self.pacer = self.path.pacer = Pacer()
        self.stalled = False
