"""A simply adaptive window: keep a small standing queue, measured as delay above the empty path.

Once an epoch (a round trip, at least 40 ms) the queueing delay q = st - RTprop is compared with a target: below it
and window-limited the window grows (by 1.6 in start-up, then by a few per cent), above `hi` it is cut to 0.95 of
the bandwidth-delay product that the receiver saw. RTprop is the 10 s minimum of st, the 20th percentile of the
epoch's round trips. In the family of TCP Vegas (Brakmo 1994) and of BBR's receiver-independent rate filter, with the
rate timed at the receiver so that acknowledgement bunching does not disturb it.
"""

from collections import deque
from typing import Final

from sern_core.path.capacity import AckSample, CapacityEstimator, Receiver

MIN_EPOCH_S: Final = 0.040
RTPROP_WINDOW_S: Final = 10.0
RATE_WINDOW_S: Final = 1.2
MIN_RATE_SPAN_S: Final = 0.120
TARGET_QUEUE_S: Final = 0.002
STARTUP_GAIN: Final = 1.6
STEADY_GAIN: Final = 1.05
PROBE_GAIN: Final = 1.10
CUT: Final = 0.95
INITIAL_WINDOW_BYTES: Final = 24_000
MIN_FRAGMENTS: Final = 3
MAX_WINDOW_BYTES: Final = 64 * 2**20


class DelayWindow(CapacityEstimator):
    """`fragment_bytes` is the size of one datagram on the lane: the window never falls below three of them."""

    def __init__(self, *, fragment_bytes: int = 1400, initial_bytes: int = INITIAL_WINDOW_BYTES) -> None:
        self._fragment_bytes = fragment_bytes
        self._initial_bytes = initial_bytes
        self._rtprops: deque[tuple[float, float]] = deque()
        self._rates: deque[tuple[float, float]] = deque()
        self._receiver = Receiver()
        self._begin()

    def _begin(self) -> None:
        self._window = float(self._initial_bytes)
        self._startup = True
        self._epoch_start: float | None = None
        self._epoch_rtts: list[float] = []
        self._epoch_limited = False
        self._empty_epochs = 0
        self._above_epochs = 0
        self._mark: tuple[float, int] | None = None
        self._span_limited = False
        self._rtprops.clear()
        self._rates.clear()
        self._queue_s = 0.0

    @property
    def window_bytes(self) -> float:
        return self._window

    @property
    def rate_bps(self) -> float | None:
        return self._rates[0][1] if self._rates else None

    @property
    def rtprop_s(self) -> float | None:
        return self._rtprops[0][1] if self._rtprops else None

    def snapshot(self) -> dict[str, float | None]:
        return {**super().snapshot(), "queue_s": self._queue_s, "startup": float(self._startup)}

    def on_sent(self, *, now: float, nbytes: int, inflight_bytes: int) -> None:
        if inflight_bytes >= self._window - self._fragment_bytes:
            self._epoch_limited = True

    def on_ack(self, sample: AckSample) -> None:
        self._measure_rate(sample)
        if self._epoch_start is None:
            self._epoch_start = sample.now
        self._epoch_rtts.append(sample.rtt_s)
        if not self._rtprops or sample.rtt_s < self._rtprops[0][1]:
            self._remember_rtprop(sample.now, sample.rtt_s)
        span_s = max(MIN_EPOCH_S, self._rtprops[0][1])
        if sample.now - self._epoch_start >= span_s:
            self._close_epoch(sample.now)

    def _measure_rate(self, sample: AckSample) -> None:
        if self._receiver.went_back(sample.receiver_s, sample.cum_bytes) or self._mark is None:
            self._mark = (sample.receiver_s, sample.cum_bytes)
            self._span_limited = sample.app_limited
            return
        self._span_limited = self._span_limited or sample.app_limited
        since_s, since_bytes = self._mark
        span_s = sample.receiver_s - since_s
        if span_s < max(MIN_RATE_SPAN_S, 2 * (self.rtprop_s or 0.0)):
            return
        rate_bps = 8 * (sample.cum_bytes - since_bytes) / span_s
        self._mark = (sample.receiver_s, sample.cum_bytes)
        # An application-limited span only shows what was offered: it may raise the estimate, never lower it.
        if rate_bps > (self.rate_bps or 0.0) or (rate_bps > 0.0 and not self._span_limited):
            while self._rates and self._rates[-1][1] <= rate_bps:
                self._rates.pop()
            self._rates.append((sample.now, rate_bps))
        while len(self._rates) > 1 and self._rates[0][0] < sample.now - RATE_WINDOW_S and not self._span_limited:
            self._rates.popleft()
        self._span_limited = False

    def _remember_rtprop(self, now: float, rtt_s: float) -> None:
        while self._rtprops and self._rtprops[-1][1] >= rtt_s:
            self._rtprops.pop()
        self._rtprops.append((now, rtt_s))
        while len(self._rtprops) > 1 and self._rtprops[0][0] < now - RTPROP_WINDOW_S:
            self._rtprops.popleft()

    def _close_epoch(self, now: float) -> None:
        rtts = sorted(self._epoch_rtts)
        typical_s = rtts[len(rtts) // 5]
        self._remember_rtprop(now, typical_s)
        rtprop_s = self._rtprops[0][1]
        self._queue_s = max(0.0, typical_s - rtprop_s)
        rate_bps = self.rate_bps
        serialise_s = 8 * self._fragment_bytes / rate_bps if rate_bps else 0.0
        spread_s = rtts[len(rtts) * 4 // 5] - typical_s
        jitter_s = min(spread_s, 0.020 + 0.2 * rtprop_s)
        high_s = max(0.010, 0.2 * rtprop_s) + serialise_s + 1.5 * jitter_s
        target_s = TARGET_QUEUE_S + serialise_s / 2 + jitter_s
        if self._queue_s > high_s:
            self._startup = False
            self._empty_epochs = 0
            self._above_epochs += 1
            if rate_bps:
                bdp = rate_bps / 8 * (rtprop_s + jitter_s)
                self._window = min(self._window, CUT * bdp) if self._above_epochs < 3 else self._window * 0.8
        else:
            self._above_epochs = 0
            if self._epoch_limited:
                self._grow(high_s, target_s)
        floor = MIN_FRAGMENTS * self._fragment_bytes
        self._window = min(max(self._window, floor), MAX_WINDOW_BYTES)
        self._epoch_start = now
        self._epoch_rtts.clear()
        self._epoch_limited = False

    def _grow(self, high_s: float, target_s: float) -> None:
        if self._startup and self._queue_s < high_s / 2:
            self._window *= STARTUP_GAIN
            return
        self._startup = False
        self._empty_epochs = self._empty_epochs + 1 if self._queue_s < target_s / 2 else 0
        if self._empty_epochs >= 3:
            self._window *= PROBE_GAIN if self._empty_epochs < 6 else 1.25
        else:
            lean = min(1.0, max(-2.0, (target_s - self._queue_s) / target_s))
            self._window *= 1 + (STEADY_GAIN - 1) * lean

    def on_loss(self, *, now: float, nbytes: int) -> None:
        """Loss on a radio link says little about its capacity; delay decides."""

    def on_reset(self, *, now: float) -> None:
        self._begin()

    def on_stall(self, *, now: float) -> None:
        self._rates.clear()
        self._mark = None
        self._epoch_start = None
        self._epoch_rtts.clear()
        self._window = max(min(self._window, float(self._initial_bytes)), MIN_FRAGMENTS * self._fragment_bytes)
