"""Parts of the window estimator: the delay of the empty path, and CUBIC's window for company that keeps a queue."""

from collections import deque
from collections.abc import Iterable
from itertools import pairwise
from typing import Final

CUBIC_C: Final = 0.4
CUBIC_BETA: Final = 0.7
CUBIC_RENO: Final = 3 * (1 - CUBIC_BETA) / (1 + CUBIC_BETA)


def one_gap(train: Iterable[tuple[float, int]], gap_s: float) -> bool:
    """Whether two packets of a train are further apart than `gap_s`."""
    return any(later - earlier > gap_s for (earlier, _), (later, _) in pairwise(train))


class BaseDelay:
    """The least forward delay of one size of packets over a sliding window."""

    __slots__ = ("before_s", "epoch", "least")

    def __init__(self) -> None:
        self.before_s: float | None = None
        self.least: deque[tuple[float, float]] = deque()  # (time, delay), both rising
        self.epoch: list[float] = []

    @property
    def value_s(self) -> float | None:
        return self.least[0][1] if self.least else None

    def note(self, now: float, delay_s: float, window_s: float) -> None:
        # Two epochs must agree: one may have had few packets, and all of them early.
        before_s, self.before_s = self.before_s, delay_s
        if before_s is not None and before_s > delay_s:
            delay_s = before_s
        least = self.least
        while least and least[-1][1] >= delay_s:
            least.pop()
        least.append((now, delay_s))
        while least[0][0] < now - window_s:
            least.popleft()

    def shift(self, delay_s: float) -> None:
        """The empty path takes so much longer from now on."""
        self.least = deque([(at_s, least_s + delay_s) for at_s, least_s in self.least])
        if self.before_s is not None:
            self.before_s += delay_s


class Cubic:
    """The window of CUBIC (RFC 9438, section 4) in bytes, from the time somebody else was found to keep the queue."""

    __slots__ = ("began_s", "cut_s", "from_bytes", "k_s", "most_bytes", "since_s")

    def __init__(self, now: float, window: float, fragment: float) -> None:
        self.began_s = now
        self.cut_s = now
        self.most_bytes = window
        self._from(now, window, fragment)

    def _from(self, now: float, window: float, fragment: float) -> None:
        self.since_s = now
        self.from_bytes = window
        self.k_s: float = (max(0.0, self.most_bytes - window) / fragment / CUBIC_C) ** (1 / 3)

    def window(self, now: float, rtt_s: float, fragment: float) -> float:
        t = now - self.since_s
        cubic: float = self.most_bytes + CUBIC_C * fragment * (t + rtt_s - self.k_s) ** 3
        reno = self.from_bytes + CUBIC_RENO * fragment * t / rtt_s
        return cubic if cubic > reno else reno

    def cut(self, now: float, window: float, fragment: float) -> float:
        """A loss: the new window. Fast convergence (4.7) lets others have what they lack."""
        self.cut_s = now
        self.most_bytes = window if window >= self.most_bytes else window * (1 + CUBIC_BETA) / 2
        window *= CUBIC_BETA
        self._from(now, window, fragment)
        return window
