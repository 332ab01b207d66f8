"""Clock offset, skew and their uncertainty from link pings, and the round-trip estimator of a hop.

A ping leaves at t1 (local clock), arrives at t2 and is answered at t3 (peer's clock), and the answer arrives at t4
(local clock). As in NTP (RFC 5905, section 8):

    θ = ((t2−t1) + (t3−t4)) / 2        offset, peer's clock minus local clock
    δ = (t4−t1) − (t3−t2)              round trip without the peer's processing time

The offset that one ping shows is wrong by at most δ/2, whatever the asymmetry of the path. Queueing only ever adds
to δ, so the ping of least δ among the last eight tells most (RFC 5905, section 10, the clock filter). Every
acknowledged packet may serve as a ping: samples that come close together count as one, the best of them.

Clocks also drift apart. The skew is the least-squares slope of those best offsets over 60 s. The fixed part of the
path's delay shifts them all alike and cancels in the slope, so the error of each is taken as how far its δ was above
the least δ, and once more the mean of that, because the least one may have met a queue as well. The sum of these
errors at their worst signs bounds the skew's error as long as the path keeps its asymmetry. Skew is used only where
it is known better than MAX_SKEW_PPM, the tolerance of any clock.

Two offsets whose error bounds do not overlap cannot be of one pair of clocks: one of them stood still (a virtual
machine that was paused) or was stepped, and the estimate starts over from the newer one. Which one it was decides what
is older than it looks:

- The peer's clock fell behind. What it had before and sends afterwards is older, by what was lost, than it says.
  `behind_s` tells how much a message may have lost, from when it was born on the peer's clock; small changes of the
  estimate count as well, as a short pause hides in its bounds.
- Ours fell behind. What was sent before and lay in our buffers looks as if it had come at once. The first thing that
  was sent later, by more than the bounds, comes from the future: nothing is known of the offset then, until a new
  sample. Peers send something twice a second: what we lost within such a silence nothing shows.
"""

import math
from collections import deque
from typing import Final, NamedTuple

from sern_core.vocabulary.errors import UsageError

MAX_SHIFTS: Final = 8
"""Changes of the estimate that are remembered: those of two seconds at least, and of steps the last ones."""
FILTER_SAMPLES: Final = 8
"""Stages of the clock filter (RFC 5905, section 7.2, NSTAGE)."""
STAGE_S: Final = 0.25
"""Samples closer together than this share a stage, which keeps the one of least δ: eight acknowledgements in a row
may all have stood in the same queue."""
SKEW_WINDOW_S: Final = 60.0
"""Span of the offsets that the skew is fitted to, and the greatest age of a sample in the filter."""
MAX_SKEW_PPM: Final = 500.0
"""Frequency tolerance that every clock keeps (RFC 5905, section 7.2, MAXFREQ: 500e-6 s/s)."""
WANDER_PPM: Final = 15.0
"""How fast a skew that is known may change (RFC 5905, section 7.2, PHI: 15e-6 s/s)."""
MAX_FIT_POINTS: Final = 256
"""Offsets kept for the skew: more than the stages of its window."""
MIN_FIT_POINTS: Final = 6
MIN_FIT_SPAN_S: Final = 20.0
"""Fewer offsets, or closer ones, tell too little about the path's least delay to judge a skew."""
RTT_WINDOW_S: Final = 10.0
"""Window of the least round-trip time."""
RTT_GRANULARITY_S: Final = 0.001
"""G of RFC 6298: the least margin of the retransmission timeout over the smoothed RTT."""
MIN_RTO_S: Final = 0.1
"""Least retransmission timeout; RFC 6298 says 1 s, which is long for a pose at 50 Hz."""
MAX_RTO_S: Final = 60.0
STAMP_UNIT_S: Final = 1e-6
_PPM: Final = 1e-6


class OneWayDelay(NamedTuple):
    """A delay in seconds, and by how much it may be wrong either way; the true one is never negative."""

    delay_s: float
    uncertainty_s: float


class _Sample(NamedTuple):
    """One ping: local time of its middle, offset, round trip, and the bound of the offset's error."""

    at_s: float
    offset_s: float
    rtt_s: float
    bound_s: float


class RttEstimator:
    """Smoothed round-trip time and its variation (RFC 6298, section 2), and the least one over a window.

    Before the first sample `srtt_s` and `rttvar_s` are 0, `min_s` is infinite and `rto_s` is 1 s (RFC 6298, 2.1).
    """

    __slots__ = ("_least", "_window_s", "latest_s", "rttvar_s", "samples", "srtt_s")

    def __init__(self, *, window_s: float = RTT_WINDOW_S) -> None:
        if not window_s > 0.0:
            raise UsageError(f"RttEstimator: window_s is {window_s}; give a positive number of seconds")
        self._window_s = window_s
        self._least: deque[tuple[float, float]] = deque()  # (time, rtt), both rising: the first is the least
        self.srtt_s = 0.0
        self.rttvar_s = 0.0
        self.latest_s = 0.0
        self.samples = 0

    def sample(self, rtt_s: float, *, now: float) -> None:
        """Take one round-trip time; raises UsageError when it is negative or not finite."""
        if not (rtt_s >= 0.0 and math.isfinite(rtt_s)):
            raise UsageError(f"RttEstimator: a round-trip time of {rtt_s} s cannot be; measure it on one clock")
        if self.samples:
            self.rttvar_s += (abs(self.srtt_s - rtt_s) - self.rttvar_s) / 4.0
            self.srtt_s += (rtt_s - self.srtt_s) / 8.0
        else:
            self.srtt_s = rtt_s
            self.rttvar_s = rtt_s / 2.0
        self.samples += 1
        self.latest_s = rtt_s
        least = self._least
        while least and least[-1][1] >= rtt_s:
            least.pop()
        least.append((now, rtt_s))
        while least[0][0] < now - self._window_s:
            least.popleft()

    @property
    def min_s(self) -> float:
        """The least sample of the window that ends at the newest sample."""
        return self._least[0][1] if self._least else math.inf

    @property
    def rto_s(self) -> float:
        """Retransmission timeout: SRTT + max(G, 4·RTTVAR), between MIN_RTO_S and MAX_RTO_S."""
        if not self.samples:
            return 1.0
        margin_s = 4.0 * self.rttvar_s
        rto_s = self.srtt_s + (margin_s if margin_s > RTT_GRANULARITY_S else RTT_GRANULARITY_S)
        if rto_s < MIN_RTO_S:
            return MIN_RTO_S
        return rto_s if rto_s < MAX_RTO_S else MAX_RTO_S

    def reset(self) -> None:
        """Forget everything: the path is another one."""
        self._least.clear()
        self.srtt_s = self.rttvar_s = self.latest_s = 0.0
        self.samples = 0


class ClockSync:
    """Offset and skew of one peer's clock. Local times are those of the caller's monotonic clock, in seconds.

    Until the first sample `ready` is false, the offset is 0 and every uncertainty infinite.
    """

    def __init__(self) -> None:
        self.rtt = RttEstimator()
        self.rejected = 0
        """Samples that no pair of clocks can give (not finite, negative times); a peer's fault, or a step between."""
        self.steps = 0
        """How often either clock was stepped."""
        self.ahead_s = math.inf
        """The peer's clock cannot be ahead of ours by more than this and the drift since the best sample: `witness`."""
        self._stepped: deque[tuple[float, float]] = deque(maxlen=MAX_SHIFTS)  # peer's time, and what its clock lost
        self._shifted: deque[tuple[float, float]] = deque(maxlen=MAX_SHIFTS)  # the same, within the bounds
        self.behind_until_s = -math.inf
        """The newest of these times: of what was born later `behind_s` is 0."""
        self._filter: deque[_Sample] = deque(maxlen=FILTER_SAMPLES)
        self._stage_s = 0.0  # when the newest stage began
        self._best: _Sample | None = None
        self._fit: deque[_Sample] = deque(maxlen=MAX_FIT_POINTS)
        self._skew = 0.0
        self._skew_bound = math.inf

    def sample(self, t1: float, t2: float, t3: float, t4: float) -> bool:
        """Take one ping: t1 and t4 local, t2 and t3 the peer's, in seconds. False when it was rejected."""
        rtt_s = (t4 - t1) - (t3 - t2)
        offset_s = ((t2 - t1) + (t3 - t4)) / 2.0
        drift_s = MAX_SKEW_PPM * _PPM * (t4 - t1)
        # The peer's processing time is measured on its clock, so a tiny round trip may come out below zero.
        possible = math.isfinite(rtt_s) and math.isfinite(offset_s) and t4 >= t1 and t3 >= t2
        if not possible or rtt_s < -drift_s - 1e-6:
            self.rejected += 1
            return False
        rtt_s = max(0.0, rtt_s)
        new = _Sample((t1 + t4) / 2.0, offset_s, rtt_s, rtt_s / 2.0 + drift_s)
        best = self._best
        if best is not None:
            apart_s = abs(new.offset_s - best.offset_s)
            if apart_s > new.bound_s + best.bound_s + MAX_SKEW_PPM * _PPM * abs(new.at_s - best.at_s):
                if new.offset_s < best.offset_s:
                    self._fell_behind(self._stepped, t3, apart_s + new.bound_s + best.bound_s)
                self._restart()
                self.steps += 1
        self.rtt.sample(rtt_s, now=t4)
        if self._filter and new.at_s < self._stage_s + STAGE_S:
            if new.rtt_s >= self._filter[-1].rtt_s:
                return True
            self._filter[-1] = new
        else:
            self._filter.append(new)
            self._stage_s = new.at_s
        best = min(
            (held for held in self._filter if held.at_s >= new.at_s - SKEW_WINDOW_S),
            key=lambda held: (held.rtt_s, -held.at_s),
        )
        known = self._best
        if best is not known:
            if known is not None and best.offset_s < known.offset_s:
                self._fell_behind(self._shifted, t3, known.offset_s - best.offset_s)
            self._best = best
            self.ahead_s = best.offset_s + best.bound_s
            self._fit_skew(best)
        return True

    def witness(self, sent_peer_s: float, received_local_s: float) -> None:
        """Something arrived that was sent at `sent_peer_s`. Call it where that is ahead by more than `ahead_s`."""
        sent_local_s, uncertainty_s = self.to_local_s(sent_peer_s)
        if sent_local_s - received_local_s > uncertainty_s + STAMP_UNIT_S:
            self._restart()
            self.steps += 1

    def behind_s(self, born_peer_s: float) -> float:
        """How much older than it looks something may be that was born at `born_peer_s`, as the peer's clock was slow,
        stood still or was set back since then. To be added to the error of its age."""
        if born_peer_s > self.behind_until_s:
            return 0.0
        return sum(lost_s for at_s, lost_s in (*self._stepped, *self._shifted) if born_peer_s <= at_s)

    def _fell_behind(self, losses: deque[tuple[float, float]], at_peer_s: float, lost_s: float) -> None:
        losses.append((at_peer_s, lost_s))
        self.behind_until_s = at_peer_s

    def reset(self) -> None:
        """Forget everything: the peer is another process, or the path another one. The counters stay."""
        self._restart()
        self.rtt.reset()

    @property
    def ready(self) -> bool:
        return self._best is not None

    @property
    def offset_s(self) -> float:
        """Peer's clock minus local clock at the best recent sample."""
        return self._best.offset_s if self._best is not None else 0.0

    @property
    def error_s(self) -> float:
        """Bound of the offset's error at that sample: half its round trip."""
        return self._best.rtt_s / 2.0 if self._best is not None else math.inf

    @property
    def skew_ppm(self) -> float:
        """How much faster the peer's clock runs, in parts per million; 0 until it is known well enough."""
        return self._skew / _PPM

    @property
    def skew_error_ppm(self) -> float:
        """Bound of the skew's error, MAX_SKEW_PPM while the skew is unknown."""
        return min(self._skew_bound / _PPM, MAX_SKEW_PPM)

    def offset_at(self, local_s: float) -> tuple[float, float]:
        """Offset at a local time, and its uncertainty, which grows with the distance from the best sample."""
        best = self._best
        if best is None:
            return 0.0, math.inf
        away_s = local_s - best.at_s
        rate = MAX_SKEW_PPM * _PPM
        if math.isfinite(self._skew_bound):
            rate = min(rate, self._skew_bound + WANDER_PPM * _PPM)
        return best.offset_s + self._skew * away_s, best.bound_s + rate * abs(away_s)

    def to_local_s(self, peer_s: float) -> tuple[float, float]:
        """A time on the peer's clock as local time, and its uncertainty."""
        # The offset changes by parts per million: that of about the right moment is the right one.
        near_s = peer_s - self.offset_s
        offset_s, uncertainty_s = self.offset_at(near_s)
        return peer_s - offset_s, uncertainty_s

    def one_way_delay_s(self, sent_peer_s: float, received_local_s: float) -> OneWayDelay:
        """How long something was under way that left at `sent_peer_s` (peer's clock); (0, inf) before any sample.

        Add both parts to an age that must not be judged too young.
        """
        sent_local_s, uncertainty_s = self.to_local_s(sent_peer_s)
        if math.isinf(uncertainty_s):
            return OneWayDelay(0.0, math.inf)
        return OneWayDelay(max(0.0, received_local_s - sent_local_s), uncertainty_s)

    def _restart(self) -> None:
        self._filter.clear()
        self._fit.clear()
        self._best = None
        self.ahead_s = math.inf
        self._forget_skew()

    def _forget_skew(self) -> None:
        self._skew = 0.0
        self._skew_bound = math.inf

    def _fit_skew(self, newest: _Sample) -> None:
        fit = self._fit
        if fit and newest.at_s < fit[-1].at_s + STAGE_S and newest.rtt_s <= fit[-1].rtt_s:
            fit.pop()
        fit.append(newest)
        while fit[0].at_s < newest.at_s - SKEW_WINDOW_S:
            fit.popleft()
        if len(fit) < MIN_FIT_POINTS or newest.at_s - fit[0].at_s < MIN_FIT_SPAN_S:
            self._forget_skew()
            return
        # Times and offsets relative to the newest point: the clocks' absolute values would eat the digits.
        count = len(fit)
        mean_t = sum(point.at_s - newest.at_s for point in fit) / count
        mean_o = sum(point.offset_s - newest.offset_s for point in fit) / count
        least_s = min(point.rtt_s for point in fit)
        mean_excess_s = sum(point.rtt_s for point in fit) / count - least_s
        spread = slope = error = 0.0
        for point in fit:
            t = point.at_s - newest.at_s - mean_t
            spread += t * t
            slope += t * (point.offset_s - newest.offset_s - mean_o)
            excess_s = point.rtt_s - least_s + mean_excess_s
            drift_s = point.bound_s - point.rtt_s / 2.0
            error += abs(t) * (excess_s / 2.0 + drift_s)
        if error < MAX_SKEW_PPM * _PPM * spread and abs(slope) <= MAX_SKEW_PPM * _PPM * spread:
            self._skew = slope / spread
            self._skew_bound = error / spread
        else:
            self._forget_skew()
