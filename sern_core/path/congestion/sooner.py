"""Whether packets come sooner than the link, as it is known, can have brought them."""

from math import inf
from typing import Final

from sern_core.path.congestion.params import HybridParams
from sern_core.path.congestion.queue_view import QueueView

SOONER_SHARE: Final = 0.35
"""A packet counts if it comes sooner by so much of the time that it takes. It counts for that share, up to..."""
SOONER_MOST: Final = 0.7
SOONER_SUM: Final = 1.8
"""... and so much together, one after the other, is believed: jitter makes one packet in five come sooner than the
least delay that is gone by."""
SOONER_TIMES: Final = 2.0
"""The window grows by no more at once: the least delay may have been that of a short queue."""
CLEAR_SHARE: Final = 0.5
"""After the queue has made way by so much: the least delay may have been that of half a packet."""
HOLD_S: Final = 1.0
HOLD_RTTS: Final = 4
"""After anything else than steering a queue may have gone, which the least delay is not free of at once."""


class Sooner:
    """A packet of L bytes takes L/C on a link of rate C, so one that comes by x sooner than over the empty path shows a
    link of at least L/(L/C − x). Only where a packet takes long can that be told from noise."""

    __slots__ = ("_clear_until_s", "_least_s", "_params", "_sum", "_until_s")

    def __init__(self, params: HybridParams) -> None:
        self._params = params
        self._until_s = self._clear_until_s = 0.0
        self.restart()

    def restart(self) -> None:
        """What came before says nothing of what comes now."""
        self._sum = 0.0
        self._least_s = inf

    def hold(self, now: float, rtt_s: float) -> None:
        """Believe nothing for a while."""
        self._until_s = now + HOLD_S + HOLD_RTTS * rtt_s
        self.restart()

    def makes_way(self, now: float, rtt_s: float) -> None:
        """The queue does, so packets show the least delay: for a while believe only what is more than a queue."""
        self._clear_until_s = now + HOLD_S + HOLD_RTTS * rtt_s
        self.restart()

    def times(self, now: float, early_s: float, view: QueueView) -> float:
        """A large packet came `early_s` sooner than over the empty path: how many times as fast the link is at least;
        1.0: nothing tells that it is."""
        took_s = view.serialise_s
        noise_s = max(0.0, view.jitter_s - took_s)
        clear = now < self._clear_until_s
        least_s = (CLEAR_SHARE if clear else SOONER_SHARE) * took_s + noise_s
        # No link saves more than the packet took: then it was a queue that is gone.
        if took_s < self._params.gentle_packet_s or early_s < least_s or (clear and early_s > took_s):
            self.restart()
            return 1.0
        self._least_s = min(self._least_s, early_s)
        self._sum += min(SOONER_MOST, early_s / took_s)
        if self._sum < SOONER_SUM or now < self._until_s:
            return 1.0
        times = took_s / max(took_s - self._least_s, took_s / SOONER_TIMES)
        self.restart()
        return times
