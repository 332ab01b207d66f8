"""A plain fixed window: for known links, for comparison, and for tests."""

from sern_core.path.capacity import AckSample, CapacityEstimator, Receiver


class FixedWindow(CapacityEstimator):
    """`window_bytes` never changes; the capacity is what the receiver saw over the last few round trips."""

    def __init__(self, window_bytes: int, *, rate_bps: float | None = None) -> None:
        self._window_bytes = float(window_bytes)
        self._configured_bps = rate_bps
        self._rate_bps = rate_bps
        self._rtprop_s: float | None = None
        self._mark: tuple[float, int] | None = None
        self._receiver = Receiver()

    @property
    def window_bytes(self) -> float:
        return self._window_bytes

    @property
    def rate_bps(self) -> float | None:
        return self._rate_bps

    @property
    def rtprop_s(self) -> float | None:
        return self._rtprop_s

    def on_sent(self, *, now: float, nbytes: int, inflight_bytes: int) -> None:
        """A fixed window learns nothing from sending."""

    def on_ack(self, sample: AckSample) -> None:
        if self._rtprop_s is None or sample.rtt_s < self._rtprop_s:
            self._rtprop_s = sample.rtt_s
        if self._configured_bps is not None:
            return
        if self._receiver.went_back(sample.receiver_s, sample.cum_bytes) or self._mark is None:
            self._mark = (sample.receiver_s, sample.cum_bytes)
            return
        since_s, since_bytes = self._mark
        span_s = sample.receiver_s - since_s
        if span_s >= max(0.12, 2 * self._rtprop_s):
            if not sample.app_limited and sample.cum_bytes > since_bytes:
                self._rate_bps = 8 * (sample.cum_bytes - since_bytes) / span_s
            self._mark = (sample.receiver_s, sample.cum_bytes)

    def on_loss(self, *, now: float, nbytes: int) -> None:
        """Loss does not move a fixed window."""

    def on_reset(self, *, now: float) -> None:
        self._mark = None
        self._rate_bps = self._configured_bps

    def on_stall(self, *, now: float) -> None:
        self._mark = None
