"""Acknowledgements of a path that sends at a rate, and whose queue is as a test wants it."""

from sern_core.path.capacity import AckSample
from sern_core.path.congestion.params import DEFAULT_HYBRID
from sern_core.path.congestion.path_model import PathModel, Seen

FRAGMENT_BYTES = 1260
RTT_S = 0.05
MEMORY_S = DEFAULT_HYBRID.base_window_s


class Path:
    """A `PathModel`, and a full link of `rate` bytes/s that it is told of."""

    def __init__(self, rate: float = 500e3) -> None:
        self.model = PathModel(DEFAULT_HYBRID, FRAGMENT_BYTES)
        self.rate = rate
        self.now = 100.0
        self.window = 1e6
        self._cum_bytes = 0

    def packet(
        self,
        queue_s: float = 0.0,
        *,
        app_limited: bool = False,
        overtook: bool = False,
        nbytes: int = FRAGMENT_BYTES,
    ) -> AckSample:
        """One packet more has arrived, and queued for so long."""
        self.now += nbytes / self.rate
        self._cum_bytes += nbytes
        sent_s = self.now - RTT_S - queue_s
        received_s = 7e4 + sent_s + RTT_S / 2 + queue_s
        return AckSample(
            self.now,
            RTT_S + queue_s,
            nbytes,
            20_000,
            received_s,
            self._cum_bytes,
            app_limited,
            sent_s,
            nbytes,
            overtook,
        )

    def epoch(self, queue_s: float = 0.0, *, app_limited: bool = False, nbytes: int = FRAGMENT_BYTES) -> Seen:
        """Packets that queue alike, until an epoch is over."""
        model = self.model
        if model.epoch_s is None:
            model.begin_epoch(self.now)
        while not model.epoch_over(self.now):
            sample = self.packet(queue_s, app_limited=app_limited, nbytes=nbytes)
            model.note(sample)
            carried = model.rate.measure(
                sample.receiver_s, sample.cum_bytes, app_limited=app_limited, held=False, rtt_s=model.rtt_s or 0.0
            )
            if carried is not None:
                model.rate.note(self.now, carried[0], model.rtt_s or 0.0)
                if not carried[1]:
                    model.rate.saturate()
        seen = model.close_epoch(self.now, MEMORY_S, self.window, steered=True)
        model.begin_epoch(self.now)
        return seen

    def settled(self) -> "Path":
        """It has been empty for a second, and its rate is known."""
        for _ in range(20):
            self.epoch()
        assert self.model.rate.value is not None and self.model.rtt_s is not None
        return self
