"""When the next message of a periodic topic is due.

A class-0 message waits for no other of its link but the one datagram that the link is just sending: on average for half
of it, at 4 Mbit/s more than a millisecond. Most class-0 topics are periodic, so their next message can be foreseen, and
what leaves before it can be cut to end just then (`Cadences.share`). A prediction that is wrong costs nothing but that.
"""

from math import ceil
from typing import Final

SETTLED: Final = 8
"""Messages before a topic counts as periodic."""
PHASE_GAIN: Final = 0.25
PERIOD_GAIN: Final = 0.05
ERROR_GAIN: Final = 0.1
MAX_ERROR: Final = 0.05
"""Mean error, as a share of the period, up to which a topic is periodic."""
SLIP: Final = 0.25
"""An error of more than this share of the period is another rhythm."""
MAX_MISSED: Final = 4
MAX_TOPICS: Final = 16
"""More topics of class 0 than this leave no gap to fit anything into."""
MIN_DATAGRAMS: Final = 2.5
"""Class 0 that leaves no room for so many full datagrams between two messages, all topics together, is none to wait
for: all that is sent would be cut small."""
AFTER_S: Final = 0.0003
"""The cut aims this long after the message is due: its source may be that late, and the cut must not end far ahead."""
MIN_SHARE: Final = 0.25
"""Less than this share of a full datagram is not worth one of its own."""
HORIZON: Final = 16.0
"""The cut is spread over at most this many datagrams: more would not make them larger."""
NEVER_S: Final = 1.0
"""Look again after this time, or with the next message, when nothing is foreseen."""


class Cadence:
    """A second-order loop on the times of a topic's messages: period and phase."""

    __slots__ = ("_count", "_due_s", "_error", "_seen_s", "period_s")

    def __init__(self, now: float) -> None:
        self._seen_s = now
        self._count = 0  # messages in this rhythm
        self.period_s = 0.0
        """Seconds between two messages, as far as it is periodic."""
        self._due_s = now
        self._error = 0.0  # mean, as a share of the period

    def arrived(self, now: float) -> None:
        gap_s = now - self._seen_s
        self._seen_s = now
        period_s = self.period_s
        periods = round((now - self._due_s) / period_s) + 1 if period_s > 0.0 else 0
        if not 0 < periods <= MAX_MISSED:
            self._begin(now, gap_s)
            return
        error_s = now - self._due_s - (periods - 1) * period_s
        share = abs(error_s) / period_s
        if share > SLIP:
            self._begin(now, gap_s)
            return
        self._count += 1
        self._error += ERROR_GAIN * (share - self._error)
        self.period_s = period_s + PERIOD_GAIN * error_s / periods
        self._due_s = now - (1.0 - PHASE_GAIN) * error_s + self.period_s

    def _begin(self, now: float, gap_s: float) -> None:
        self._count = 0
        self.period_s = gap_s
        self._due_s = now + gap_s
        self._error = 0.0

    def due_after(self, now: float) -> float | None:
        """When the first message behind `now` is due; None: nobody knows."""
        period_s = self.period_s
        if self._count < SETTLED or self._error > MAX_ERROR:
            return None
        if now > self._due_s + MAX_MISSED * period_s:
            return None  # it has ended, for all one knows
        return self._due_s + max(0, ceil((now - self._due_s) / period_s)) * period_s


class Cadences:
    """The cadences of a link's class-0 topics, by channel."""

    def __init__(self) -> None:
        self._topics: dict[int, Cadence] = {}
        self._due_s = -1.0
        """The next one, as of the last search; passed, or a new message came: search again."""

    def arrived(self, channel_id: int, *, now: float) -> None:
        cadence = self._topics.get(channel_id)
        if cadence is None:
            self._topics[channel_id] = Cadence(now)
        else:
            cadence.arrived(now)
        self._due_s = -1.0

    def forget(self, channel_id: int) -> None:
        self._topics.pop(channel_id, None)
        self._due_s = -1.0

    def share(self, now: float, datagram_s: float) -> float:
        """How much of a full datagram, which takes `datagram_s` of the link, should leave now: 1, or less, so that one
        of these and the equal ones behind it ends when the next class-0 message is due."""
        left_s = self._due(now, datagram_s) + AFTER_S - now
        if left_s < MIN_SHARE * datagram_s or left_s > HORIZON * datagram_s:
            return 1.0
        return left_s / (datagram_s * ceil(left_s / datagram_s))

    def hold(self, at_s: float, datagram_s: float) -> float:
        """When a datagram that could leave at `at_s` should: not right ahead of a class-0 message."""
        free_s = self._due(at_s, datagram_s) + AFTER_S
        return free_s if free_s < at_s + MIN_SHARE * datagram_s else at_s

    def _due(self, now: float, datagram_s: float) -> float:
        """When the next class-0 message should come, or should have come a moment ago; far away: nobody knows."""
        since_s = now - AFTER_S
        if since_s > self._due_s:
            self._due_s = now + NEVER_S
            if len(self._topics) <= MAX_TOPICS:
                found = [(due_s, topic) for topic in self._topics.values() if (due_s := topic.due_after(since_s))]
                rate_hz = sum([1.0 / topic.period_s for _, topic in found])
                if found and rate_hz * MIN_DATAGRAMS * datagram_s <= 1.0:
                    self._due_s = min([due_s for due_s, _ in found])
        return self._due_s
