"""How fast packets leave while the window is open."""

from sern_core.path.congestion.growth import Growth
from sern_core.path.congestion.losses import Losses
from sern_core.path.congestion.mode import Mode
from sern_core.path.congestion.params import HybridParams
from sern_core.path.congestion.path_model import PathModel


class Pace:
    """The pace, in bytes/s; None: at once. `capped`: it keeps below the capacity. `initial_bytes`: the first window."""

    __slots__ = ("_growth", "_initial_bytes", "_losses", "_params", "_path", "capped", "value")

    def __init__(
        self, params: HybridParams, path: PathModel, growth: Growth, losses: Losses, initial_bytes: float
    ) -> None:
        self._params = params
        self._path = path
        self._growth = growth
        self._losses = losses
        self._initial_bytes = initial_bytes
        self.value: float | None = None
        self.capped = False

    def set(self, mode: Mode, window: float) -> None:
        """Pace such a window. Until a round trip is known the pace stays as it is."""
        self.capped = False
        rtt_s, params = self._path.rtt_s, self._params
        if rtt_s is None:
            return
        if mode.starting:
            # The first train leaves at once: its dispersion is the bottleneck's, not our own.
            self.value = None if window <= self._initial_bytes else params.startup_pacing * window / rtt_s
        elif mode.competing:  # the window alone bounds
            self.value = params.compete_pacing * window / rtt_s
        elif mode.varying:  # the window bounds, and what it lets go is spread
            self.value = params.variable_pacing * window / (rtt_s + (params.variable_queue_s or 0.0))
        else:
            self._steer(window, rtt_s)

    def _steer(self, window: float, rtt_s: float) -> None:
        """Keep the queue short."""
        params, rate, view, loss = self._params, self._path.rate, self._path.view, self._losses.usual
        pace = self.value = params.pacing_gain * window / rtt_s
        carried = rate.value
        if carried is None or not rate.peak or not rate.shown:
            return  # nothing has been delivered in an epoch yet, or too little to go by
        if self._growth.room.trying:
            return  # the window alone is to say how much is under way
        if view.empty:
            if view.gentle and rate.saturated:
                tried = self._growth.probing * carried / (1 - loss)
                self.capped = tried < pace
                self.value = min(pace, tried)
        else:
            gain = params.drain_pacing
            if view.queue_s < 2 * view.target_s + view.serialise_s:
                gain = params.pacing_gain
                if view.calm:
                    gain = params.calm_pacing + params.calm_share * max(0.0, 1 - carried / rate.peak)
            if view.calm:
                carried /= 1 - loss  # what arrives is less than what was sent
            if rate.bursts:
                gain = max(gain, params.burst_pacing)
            self.capped = view.calm and gain * carried < pace
            self.value = max(min(pace, gain * carried), 1.0)
