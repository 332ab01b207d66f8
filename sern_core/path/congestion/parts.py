"""Parts of the window estimator: the delay of the empty path, rates over sliding windows, the swing of a queue, and
CUBIC's window for company that keeps a queue."""

from collections import deque
from math import inf
from typing import Final

CUBIC_C: Final = 0.4
CUBIC_BETA: Final = 0.7
CUBIC_RENO: Final = 3 * (1 - CUBIC_BETA) / (1 + CUBIC_BETA)
BURST_RATE_SPAN_S: Final = 0.150
MARK_SPACING_S: Final = 0.020
MAX_MARKS: Final = 16
SWING_AFTER_S: Final = 2.0
AGREE_S: Final = 2.0
EASED_S: Final = 0.001
EASED_SHARE: Final = 0.35
"""A share of the time that a packet takes."""
EASED_PACKETS: Final = 6
"""One after the other."""
EASED_MEMORY_S: Final = 10.0
EASED_SPAN_S: Final = 1.0
EASED_SPANS: Final = 3
"""Spans that must be known before anything is compared."""
EASED_STEADY: Final = 0.2
"""A rate that is another one by more makes everything before incomparable."""


class BaseDelay:
    """The least forward delay of one size of packets over a sliding window."""

    __slots__ = ("before_s", "epoch", "least", "noted_s")

    def __init__(self) -> None:
        self.before_s: float | None = None
        self.noted_s = -inf
        self.least: deque[tuple[float, float]] = deque()  # (time, delay), both rising
        self.epoch: list[float] = []

    @property
    def value_s(self) -> float | None:
        return self.least[0][1] if self.least else None

    def note(self, now: float, delay_s: float, window_s: float) -> None:
        # Two epochs must agree: one may have had few packets, and all of them early. One of long ago says nothing.
        before_s, self.before_s = self.before_s if now <= self.noted_s + AGREE_S else None, delay_s
        self.noted_s = now
        if before_s is not None and before_s > delay_s:
            delay_s = before_s
        least = self.least
        while least and least[-1][1] >= delay_s:
            least.pop()
        least.append((now, delay_s))
        while least[0][0] < now - window_s:
            least.popleft()

    def keep_least(self, now: float) -> None:
        """What was longer was a queue: it must not become the least when that is too old."""
        if self.least:
            self.least = deque([(now, self.least[0][1])])
            self.before_s = None

    def take_over(self, other: "BaseDelay") -> None:
        """What is known of packets of another size holds for these."""
        self.before_s, self.noted_s, self.least = other.before_s, other.noted_s, deque(other.least)

    def shift(self, delay_s: float) -> None:
        """The empty path takes so much longer from now on."""
        self.least = deque([(at_s, least_s + delay_s) for at_s, least_s in self.least])
        if self.before_s is not None:
            self.before_s += delay_s


class GreatestRate:
    """The greatest rate, in bytes/s, of those noted in a sliding window."""

    __slots__ = ("_rates",)

    def __init__(self) -> None:
        self._rates: deque[tuple[float, float]] = deque()  # (time, bytes/s), the greatest first

    def note(self, now: float, rate: float, window_s: float) -> float:
        rates = self._rates
        while rates and rates[-1][1] <= rate:
            rates.pop()
        rates.append((now, rate))
        while rates[0][0] < now - window_s:
            rates.popleft()
        return rates[0][1]

    def clear(self) -> None:
        self._rates.clear()


class LatelyArrived:
    """Bytes by the receiver's clock, noted every 20 ms, for the rate of a moment."""

    __slots__ = ("_marks",)

    def __init__(self) -> None:
        self._marks: deque[tuple[float, int]] = deque(maxlen=MAX_MARKS)

    def note(self, receiver_s: float, cum_bytes: int) -> None:
        marks = self._marks
        if not marks or receiver_s >= marks[-1][0] + MARK_SPACING_S:
            marks.append((receiver_s, cum_bytes))

    def rate(self) -> float | None:
        """Bytes/s that arrived in the last 150 ms; None while that is not known."""
        marks = self._marks
        if len(marks) < 2:
            return None
        last_s, last_bytes = marks[-1]
        since = next((mark for mark in reversed(marks) if last_s - mark[0] >= BURST_RATE_SPAN_S), marks[0])
        return (last_bytes - since[1]) / (last_s - since[0]) or None


class Eased:
    """Whether packets take less time than a link of the known rate needs to send them.

    What a packet takes on a link is in its delay, so one that got faster shows in the first packets over it, however
    few they are: 1,260 bytes take 34 ms at 0.3 Mbit/s and 2.5 ms at 4. What is left of the delay is compared with its
    least value of the last seconds. A queue says nothing, neither packets in it nor that it went, so it is compared
    with packets that left when there was nothing else to send. Where a packet went there and its acknowledgement back
    in less time than the link needs to send it there is nothing to compare: such a link there is not.
    """

    __slots__ = ("_count", "_known_s", "_least", "_rate", "_shorter", "_until_s", "at_s")

    def __init__(self) -> None:
        self.at_s = -inf
        self._rate = 0.0
        self._count = 0  # of packets in a row that have left less than the least
        self._shorter = 0  # of those whose round trip was less than the link takes for them
        self._least: deque[tuple[float, float]] = deque()  # (since, least) of spans of EASED_SPAN_S
        self._known_s = -inf  # the least of the spans that are over; -inf: too few
        self._until_s = -inf  # when that is another

    def note(self, now: float, delay_s: float, rtt_s: float, nbytes: float, rate: float, *, queued: bool) -> None:
        """A packet of `nbytes` came after `delay_s` over a link of `rate` bytes/s, and its acknowledgement after
        `rtt_s`; `queued`: maybe behind others."""
        if abs(rate - self._rate) > EASED_STEADY * self._rate:
            self._rate = rate
            self._forget()
        if now >= self._until_s:
            self._span_over(now)
        took_s = nbytes / rate
        left_s = delay_s - took_s
        least_s = max(EASED_S, EASED_SHARE * took_s)
        shorter, early = rtt_s < took_s - least_s, left_s < self._known_s - least_s
        self._shorter += shorter
        self._count = self._count + 1 if early else 0
        if self._count >= EASED_PACKETS or self._shorter >= EASED_PACKETS:
            self.at_s = now
            self._forget()
        if queued or early or shorter:
            return
        least = self._least
        if not least or now >= least[-1][0] + EASED_SPAN_S:
            least.append((now, left_s))
            self._until_s = now + EASED_SPAN_S
        elif left_s < least[-1][1]:
            least[-1] = (least[-1][0], left_s)

    def _forget(self) -> None:
        self._count = self._shorter = 0
        self._least.clear()
        self._known_s = self._until_s = -inf

    def _span_over(self, now: float) -> None:
        least = self._least
        while least and least[0][0] < now - EASED_MEMORY_S:
            least.popleft()
        known = [value for since_s, value in least if since_s <= now - EASED_SPAN_S]
        self._known_s = min(known) if len(known) >= EASED_SPANS else -inf
        self._until_s = now + EASED_SPAN_S


class Swing:
    """How far a queue goes up and down since `since_s`; None: not looked at."""

    __slots__ = ("_least_s", "_most_s", "since_s")

    def __init__(self) -> None:
        self.since_s: float | None = None
        self._least_s = self._most_s = 0.0

    def wider(self, now: float, queue_s: float, than_s: float) -> bool:
        """Whether, looked at for two seconds, it swings by more than `than_s`."""
        if self.since_s is None:
            self.since_s = now
            self._least_s = self._most_s = queue_s
            return False
        self._least_s = min(self._least_s, queue_s)
        self._most_s = max(self._most_s, queue_s)
        return now > self.since_s + SWING_AFTER_S and self._most_s - self._least_s > than_s


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
