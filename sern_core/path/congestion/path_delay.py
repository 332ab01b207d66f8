"""The delay of the empty path, and what of an epoch's delays is a queue."""

from collections import deque
from typing import Final

from sern_core.path.congestion.link_rate import LinkRate
from sern_core.path.congestion.params import HybridParams
from sern_core.path.congestion.parts import BaseDelay

STALE_S: Final = 2.0
"""Where no large packet has come for so long, small ones may show that the path is shorter."""


class PathDelay:
    """The least forward delay, of small and of large packets."""

    __slots__ = ("_closed_s", "_early_s", "_large", "_leasts", "_params", "_small", "held_s")

    def __init__(self, params: HybridParams) -> None:
        self._params = params
        self._small, self._large = BaseDelay(), BaseDelay()
        self._closed_s = 0.0  # when the last epoch was over
        self.restart()

    def restart(self) -> None:
        """What was under way says nothing about what will be; the least delays stand."""
        self._small.epoch.clear()
        self._large.epoch.clear()
        self.held_s = 0.0
        """What packets are held by the jitter of those before them, beyond the least delay."""
        self._leasts: deque[float] = deque(maxlen=self._params.quicker_epochs)  # of the delay of large packets
        self._early_s = 0.0  # by how much the packets of the last epoch came sooner than the least delay

    def queue_s(self, delay_s: float, nbytes: int, fragment: float, rate: LinkRate, *, overtook: bool) -> float:
        """A packet of `nbytes` (0: unknown) came after `delay_s`: how long it has queued. One that came sooner than any
        could on the way that is known, because it overtook others, had a way of its own and says nothing."""
        base = self._large if nbytes == 0 or 2 * nbytes >= fragment else self._small
        if base is self._large and 0 < nbytes < fragment:
            # As if it had been a full one: else the least delay would be that of shorter ones. While there was never
            # more to send than the link took, what it takes is not known: what little was sent would make it seconds.
            if rate.peak and rate.saturated:
                delay_s += (fragment - nbytes) / rate.peak
            elif 10 * nbytes < 9 * fragment:
                base = self._small
        least = base.least
        if overtook and least and delay_s < least[0][1] + self.held_s:
            return 0.0
        base.epoch.append(delay_s)
        return delay_s - least[0][1] - self.held_s if least else 0.0

    def close_epoch(self, now: float, window_s: float) -> None:
        """Take the 20th percentiles of the epoch for what the path may have at least."""
        self._closed_s = now
        for base in (self._small, self._large):
            if base.epoch:
                base.epoch.sort()
                base.note(now, base.epoch[len(base.epoch) // 5], window_s)
                base.epoch.clear()

    def got_quicker(self, serialise_s: float) -> bool:
        """Whether large packets come sooner than before by more than noise. No packet can take less than the link needs
        for it, so it is another link."""
        leasts = self._leasts
        leasts.append(self._large.value_s or 0.0)
        if max(leasts) - leasts[-1] > 0.5 * serialise_s > self._params.calm_packet_s:
            leasts.clear()
            return True
        return False

    def came_early(self, early_s: float) -> None:
        """The packets of an epoch came sooner than the least delay by `early_s`, or later: if they do twice, jitter
        holds back less than was taken for it."""
        before_s, self._early_s = self._early_s, max(0.0, early_s)
        self.held_s = max(0.0, self.held_s - min(before_s, self._early_s))

    def empty_s(self, *, segmented: bool) -> float:
        """The delay of the empty path, of large packets; an epoch must have been closed.

        Fragments of a stream (`segmented`) get smaller with its rate. Then there are small packets only, and what the
        last large ones met would be taken for the path for ever.
        """
        large, small = self._large.least, self._small.least
        stale = segmented and self._closed_s > self._large.noted_s + STALE_S
        if not large or (stale and small and small[0][1] < large[0][1]):
            large = small
        return large[0][1] + self.held_s

    def longer_packets(self, delay_s: float) -> None:
        """The largest packets take so much longer from now on."""
        self._large.shift(delay_s)

    def no_large_since(self, at_s: float) -> bool:
        """Whether there are small packets only, and were large ones before."""
        return bool(self._large.least and self._small.least) and self._large.noted_s < at_s

    def smaller_packets(self, serialise_s: float) -> None:
        """What were small packets are the large ones from now on; the largest of them takes so long to serialise."""
        self._large.take_over(self._small)
        self._large.shift(serialise_s)

    def keep_least(self, now: float) -> None:
        """What was longer was a queue: it must not become the least when that is too old."""
        self._small.keep_least(now)
        self._large.keep_least(now)

    def longer_path(self, now: float, queue_s: float) -> None:
        """What looked like a queue is a longer way."""
        for base in (self._small, self._large):
            if base.least:
                delay_s = base.least[0][1] + self.held_s + queue_s
                base.least.clear()
                base.least.append((now, delay_s))
        self.held_s = 0.0
