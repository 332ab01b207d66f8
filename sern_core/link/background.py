"""What streams in the background may have under way, so that they keep nobody waiting. Pure."""

from math import inf
from typing import Final

from sern_core.path.lanes import OVERHEAD_BYTES, Lane

LIVE_S: Final = 5.0
"""While something live below class 0 fills the link, and for so long after, its window holds for the background too:
the queue that it keeps is there already, and what measures the link is not to be disturbed."""
TIME_S: Final = 0.003
MIN_BYTES: Final = 600
"""A datagram of the background takes about `TIME_S` of the link: a message of class 0 may come right behind it. On a
slow link it has `MIN_BYTES`; in a smaller one headers would take more than a tenth."""


class Background:
    """One link's."""

    __slots__ = ("_filled_s",)

    def __init__(self) -> None:
        self._filled_s = -inf  # when something live had to wait for the window last

    def live_waits(self, now: float) -> None:
        """Something live below class 0 waits for the window."""
        self._filled_s = now

    def limit(self, lane: Lane, now: float) -> int:
        """Bytes of the next datagram."""
        rate_bps = lane.estimator.rate_bps
        if rate_bps is None or self._shares(now):
            return lane.fragment_bytes
        return min(lane.fragment_bytes, max(int(TIME_S * rate_bps / 8), MIN_BYTES))

    def room(self, lane: Lane, now: float) -> bool:
        """Whether one more datagram, where the window is open, would queue nowhere."""
        if self._shares(now):
            return True
        nbytes = lane.under_way_bytes
        return not nbytes or nbytes + self.limit(lane, now) + OVERHEAD_BYTES <= lane.estimator.unqueued_bytes

    def _shares(self, now: float) -> bool:
        return now < self._filled_s + LIVE_S
