"""How fast packets leave while the window is open."""

from sern_core.path.congestion.link_rate import LinkRate
from sern_core.path.congestion.params import HybridParams
from sern_core.path.congestion.queue_view import QueueView


class Pace:
    """The pace, in bytes/s; None: at once. `capped`: it keeps below the capacity."""

    __slots__ = ("_params", "capped", "value")

    def __init__(self, params: HybridParams) -> None:
        self._params = params
        self.value: float | None = None
        self.capped = False

    def start(self, window: float, initial_bytes: float, rtt_s: float | None) -> None:
        """Pace start-up. The first train leaves at once: its dispersion is the bottleneck's, not our own."""
        self.capped = False
        if rtt_s is not None:
            self.value = None if window <= initial_bytes else self._params.startup_pacing * window / rtt_s

    def vary(self, window: float, rtt_s: float | None) -> None:
        """Let the window bound, and spread what it lets go."""
        self.capped = False
        if rtt_s is not None:
            self.value = self._params.variable_pacing * window / (rtt_s + (self._params.variable_queue_s or 0.0))

    def compete(self, window: float, rtt_s: float | None) -> None:
        """Let the window alone bound."""
        self.capped = False
        if rtt_s is not None:
            self.value = self._params.compete_pacing * window / rtt_s

    def steer(
        self, window: float, rtt_s: float | None, rate: LinkRate, view: QueueView, loss: float, probing: float | None
    ) -> None:
        """Keep the queue short. `loss`: share that is lost on the way; `probing`: times the capacity that an empty path
        is tried with, None: the window alone is to say how much is under way."""
        self.capped = False
        if rtt_s is None:
            return
        params = self._params
        pace = self.value = params.pacing_gain * window / rtt_s
        carried = rate.value
        if carried is None or not rate.peak:
            return  # nothing has been delivered in an epoch yet
        if probing is None:
            return
        if view.empty:
            if view.gentle and rate.saturated:
                tried = probing * carried / (1 - loss)
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
            self.capped = view.calm and gain * carried < pace
            self.value = max(min(pace, gain * carried), 1.0)
