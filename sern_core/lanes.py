"""One lane of a hop: its flight, its arrivals, its estimator, its fragment size."""

from typing import Final

from sern_core.capacity import CapacityEstimator
from sern_core.control.delay import DelayWindow
from sern_core.control.fixed import FixedWindow
from sern_core.flight import Arrivals, Flight
from sern_core.params import LinkParams, WindowAlgorithm

LANE_ZMQ: Final = 0
LANE_UDP: Final = 1
LANE_NAMES: Final = {LANE_ZMQ: "zmq", LANE_UDP: "udp"}

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
PROBE_INTERVAL_S: Final = 0.2
"""While stalled, one fresh class-0 message goes out this often and finds out whether the path is back."""


class Lane:
    """State of one lane of one link. `lossless`: a stream (TCP) underneath."""

    def __init__(self, lane: int, params: LinkParams, *, lossless: bool) -> None:
        self.id = lane
        self.lossless = lossless
        self.fragment_bytes_max = params.fragment_bytes_max if lossless else DATAGRAM_BYTES
        self.estimator: CapacityEstimator
        if params.window.algorithm is WindowAlgorithm.FIXED:
            self.estimator = FixedWindow(params.window.fixed_bytes)
        else:
            self.estimator = DelayWindow(fragment_bytes=MIN_FRAGMENT_BYTES + OVERHEAD_BYTES)
        self.flight = Flight(lossless=lossless)
        self.arrivals = Arrivals()
        self.stalled = False
        self.probe_due_s = 0.0
        self.up = False  # it has a transport
        self.proofs = 0  # questions answered since it was opened or had stalled
        self.ping = False
        self.ping_due_s = 0.0
        self.fragment_bytes = self._fragment_bytes(None)

    def _fragment_bytes(self, rate_bps: float | None) -> int:
        if not self.lossless:
            return DATAGRAM_BYTES
        if rate_bps is None:
            return min(UNKNOWN_RATE_FRAGMENT_BYTES, self.fragment_bytes_max)
        return int(min(max(FRAGMENT_TIME_S * rate_bps / 8, MIN_FRAGMENT_BYTES), self.fragment_bytes_max))

    def rate_changed(self) -> float | None:
        """Adopt the estimator's capacity; returns it."""
        rate_bps = self.estimator.rate_bps
        self.fragment_bytes = self._fragment_bytes(rate_bps)
        return rate_bps

    @property
    def window_open(self) -> bool:
        return self.flight.inflight_bytes < self.estimator.window_bytes

    def stall_deadline(self) -> float | None:
        flight = self.flight
        if self.stalled or flight.waiting_since_s is None:
            return None
        return flight.waiting_since_s + flight.stall_timeout_s()

    @property
    def name(self) -> str:
        return LANE_NAMES[self.id]

    @property
    def usable(self) -> bool:
        return self.up and not self.stalled

    def new_session(self, now: float) -> None:
        """Numbers start again; the flight was abandoned before."""
        self.proofs = 0
        self.ping = False
        self.ping_due_s = now
        self.flight = Flight(lossless=self.lossless)
        self.arrivals = Arrivals()
        self.stalled = False
