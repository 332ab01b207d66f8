"""The window backs off from a queue that is too long: once a round trip, and at once where it is far too long."""

from math import inf
from typing import Final

from sern_core.path.capacity import AckSample
from sern_core.path.congestion.growth import Growth
from sern_core.path.congestion.params import HybridParams
from sern_core.path.congestion.path_model import PathModel

SMALL_JITTER: Final = 0.15
"""Share of a round trip."""


class Backoff:
    """The cuts of the window, and what a queue that is too long says of the rate: the link may have got slower.

    A cut takes a round trip to show; until `hold_until_s` there is no other.
    """

    __slots__ = ("_growth", "_params", "_path", "far_since_s", "hold_until_s")

    def __init__(self, params: HybridParams, path: PathModel, growth: Growth) -> None:
        self._params = params
        self._path = path
        self._growth = growth
        self.restart()

    def restart(self) -> None:
        """What was seen says nothing about what will be."""
        self.far_since_s: float | None = None
        """When, by the receiver's clock, the queue became far too long; None: it is not."""
        self.hold_until_s = -inf

    def urgent(self, now: float, receiver_s: float) -> bool:
        """A packet has met a queue that is far too long. Whether it is for longer than a moment."""
        if self.far_since_s is None:
            self.far_since_s = receiver_s
            return False
        return receiver_s >= self.far_since_s + self._params.emergency_s and now >= self.hold_until_s

    @property
    def _held_s(self) -> float:
        """What jitter adds to the least round trip: a window without it would be too small, and its rate again."""
        path = self._path
        if not path.view.jittery or path.view.calm:
            return 0.0
        return max(0.0, path.view.jitter_s - SMALL_JITTER * (path.rtt_s or 0.0))

    def cut_at_once(self, now: float, window: float, least_window: float, queue_s: float) -> float | None:
        """The queue is far too long: the link got slower. Returns the window; None: too little is known of the path."""
        path = self._path
        rtt_s, rate = path.rtt_s, path.rate.arrived.rate()
        if rtt_s is None or rate is None:
            return None
        self._replace_rate(now, rate)
        path.rate.skip_span()
        self.hold_until_s = now + max(0.1, rtt_s + queue_s)
        self.far_since_s = None
        self._growth.empty_epochs = 0
        return min(window, max(self._params.emergency_cut * rate * (rtt_s + self._held_s), least_window))

    def cut(self, now: float, window: float, rate: float, rtt_s: float, *, epochs: int) -> float:
        """The window after an epoch whose queue was too long, as it was for so many `epochs`. `rate`: what is known."""
        self._growth.stop()
        if now < self.hold_until_s:
            return window
        path = self._path
        recent = path.rate.lately or rate
        if epochs >= 2 and path.slowdown.faster_rate is None:
            self._replace_rate(now, recent)
        self.hold_until_s = now + rtt_s
        return min(window, self._params.cut * min(recent, rate) * (rtt_s + self._held_s) + path.fragment)

    def look_for_slower_link(self, sample: AckSample) -> float | None:
        """A packet has met a queue that is too long. Returns the rate of the link, in bytes/s, if it got slower, or
        somebody else has his share of it."""
        rate = self._path.slower_rate(sample)
        if rate is not None:
            self._replace_rate(sample.now, rate)
            self._path.rate.skip_span()
        return rate

    def _replace_rate(self, now: float, rate: float) -> None:
        if self._path.replace_rate(now, rate):
            self._growth.got_slower(now)
