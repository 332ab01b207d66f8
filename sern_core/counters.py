"""Accounting of messages and bytes for one hop or one daemon: nothing disappears without a reason.

For each (topic, class) and at every instant, in messages and in bytes alike:

    offered == delivered + Σ dropped(reason) + refused + in_queue + in_flight

Every method below moves a message from one place to another and keeps the balance; the fields are plain integers and
may be bumped directly where a call is too dear, as long as the balance holds when the caller returns.

Bytes are those of the message as it was offered, whatever a codec makes of it; `wire_bytes` are what really went on
the wire, with headers and repeats, and are in no balance. A replay is offered again: `replayed` tells how many of the
offers were replays. `delivered` means handed to the sink on the receiving side and acknowledged on the sending side.
"""

import math
from bisect import bisect_left
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Final

from sern_core.errors import UsageError
from sern_core.types import CLASSES, DropReason, PriorityClass, TopicName

DROP_KEYS: Final = tuple(reason for reason in DropReason if reason is not DropReason.REFUSED)
"""Reasons with a drop counter. Refusals have counters of their own, because the sender knows of them."""
OTHER: Final = TopicName("other")
"""The row of topics beyond `max_topics`."""
DEFAULT_MAX_TOPICS: Final = 4_096
LATENCY_EDGES_S: Final = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0)
"""Upper edges of latency and age bins; a value on an edge belongs below it, as in Prometheus."""


def _zeros() -> dict[DropReason, int]:
    return dict.fromkeys(DROP_KEYS, 0)


@dataclass(slots=True, eq=False)
class TopicCounters:
    """The counters of one topic in one class. Handed out once, kept by the hot path. Sizes are in bytes."""

    topic: TopicName
    priority: PriorityClass
    offered: int = 0
    offered_bytes: int = 0
    replayed: int = 0  # of the offered
    replayed_bytes: int = 0
    delivered: int = 0
    delivered_bytes: int = 0
    refused: int = 0
    refused_bytes: int = 0
    in_queue: int = 0
    in_queue_bytes: int = 0
    in_flight: int = 0
    in_flight_bytes: int = 0
    sent: int = 0  # times a message went from the queue into flight, again after a loss included
    sent_bytes: int = 0
    wire_bytes: int = 0
    dropped: dict[DropReason, int] = field(default_factory=_zeros)
    dropped_bytes: dict[DropReason, int] = field(default_factory=_zeros)

    # A new message ---------------------------------------------------------------------------------------------------

    def queue(self, size_bytes: int) -> None:
        """Offered, and waits."""
        self.offered += 1
        self.offered_bytes += size_bytes
        self.in_queue += 1
        self.in_queue_bytes += size_bytes

    def queue_replay(self, size_bytes: int) -> None:
        """Offered again for a late joiner or after an outage, and waits."""
        self.replayed += 1
        self.replayed_bytes += size_bytes
        self.queue(size_bytes)

    def refuse(self, size_bytes: int) -> None:
        """Offered, and refused to the sender, who knows."""
        self.offered += 1
        self.offered_bytes += size_bytes
        self.refused += 1
        self.refused_bytes += size_bytes

    def drop_new(self, reason: DropReason, size_bytes: int) -> None:
        """Offered, and dropped at once: rate cap, too large, forbidden, unwanted."""
        if reason is DropReason.REFUSED:
            self.refuse(size_bytes)
            return
        self.offered += 1
        self.offered_bytes += size_bytes
        self.dropped[reason] += 1
        self.dropped_bytes[reason] += size_bytes

    def deliver_new(self, size_bytes: int) -> None:
        """Offered, and handed to the sink at once: the receiving side."""
        self.offered += 1
        self.offered_bytes += size_bytes
        self.delivered += 1
        self.delivered_bytes += size_bytes

    # A waiting message -----------------------------------------------------------------------------------------------

    def send(self, size_bytes: int) -> None:
        """From the queue into flight: its last fragment was sent."""
        self.in_queue -= 1
        self.in_queue_bytes -= size_bytes
        self.in_flight += 1
        self.in_flight_bytes += size_bytes
        self.sent += 1
        self.sent_bytes += size_bytes

    def deliver_queued(self, size_bytes: int) -> None:
        """From the queue to the sink: held for order on the receiving side, or a hop inside the process."""
        self.in_queue -= 1
        self.in_queue_bytes -= size_bytes
        self.delivered += 1
        self.delivered_bytes += size_bytes

    def drop_queued(self, reason: DropReason, size_bytes: int) -> None:
        """Dropped while waiting."""
        self.in_queue -= 1
        self.in_queue_bytes -= size_bytes
        self._drop(reason, size_bytes)

    # A message in flight ---------------------------------------------------------------------------------------------

    def ack(self, size_bytes: int) -> None:
        """Acknowledged as a whole."""
        self.in_flight -= 1
        self.in_flight_bytes -= size_bytes
        self.delivered += 1
        self.delivered_bytes += size_bytes

    def requeue(self, size_bytes: int) -> None:
        """Back into the queue: it is still wanted and will be sent again."""
        self.in_flight -= 1
        self.in_flight_bytes -= size_bytes
        self.in_queue += 1
        self.in_queue_bytes += size_bytes

    def drop_in_flight(self, reason: DropReason, size_bytes: int) -> None:
        """Dropped after it was sent: lost and no longer wanted, or the peer is gone."""
        self.in_flight -= 1
        self.in_flight_bytes -= size_bytes
        self._drop(reason, size_bytes)

    # Reading ---------------------------------------------------------------------------------------------------------

    def imbalance(self) -> tuple[int, int]:
        """Messages and bytes that are unaccounted for (positive) or counted twice (negative); (0, 0) is right."""
        messages = self.delivered + sum(self.dropped.values()) + self.refused + self.in_queue + self.in_flight
        size_bytes = (
            self.delivered_bytes
            + sum(self.dropped_bytes.values())
            + self.refused_bytes
            + self.in_queue_bytes
            + self.in_flight_bytes
        )
        return self.offered - messages, self.offered_bytes - size_bytes

    def add(self, other: "TopicCounters") -> None:
        """Add another topic's counters to these, for sums."""
        for name in _FIELDS:
            setattr(self, name, getattr(self, name) + getattr(other, name))
        for reason in DROP_KEYS:
            self.dropped[reason] += other.dropped[reason]
            self.dropped_bytes[reason] += other.dropped_bytes[reason]

    def to_json(self) -> dict[str, Any]:
        """Every field by its name, `class` as a word, `dropped` and `dropped_bytes` by reason."""
        return {
            "topic": self.topic,
            "class": self.priority.name.lower(),
            **{name: getattr(self, name) for name in _FIELDS},
            "dropped": {reason.value: count for reason, count in self.dropped.items()},
            "dropped_bytes": {reason.value: count for reason, count in self.dropped_bytes.items()},
        }

    def validate(self) -> None:
        """Raises AssertionError when the balance is off or a count is negative."""
        messages, size_bytes = self.imbalance()
        assert messages == size_bytes == 0, (
            f"{self.topic}: {messages} messages, {size_bytes} bytes unaccounted for: {self.to_json()}"
        )
        counts = [getattr(self, name) for name in _FIELDS]
        assert min(*counts, *self.dropped.values(), *self.dropped_bytes.values()) >= 0, f"{self.topic}: negative count"
        assert self.dropped.keys() == self.dropped_bytes.keys() == set(DROP_KEYS), f"{self.topic}: drop reasons"
        assert self.replayed <= self.offered, f"{self.topic}: more replays than offers"

    def _drop(self, reason: DropReason, size_bytes: int) -> None:
        if reason is DropReason.REFUSED:
            self.refused += 1
            self.refused_bytes += size_bytes
            return
        self.dropped[reason] += 1
        self.dropped_bytes[reason] += size_bytes


_FIELDS: Final = tuple(
    name for name in TopicCounters.__dataclass_fields__ if name not in {"topic", "priority", "dropped", "dropped_bytes"}
)


class LatencyHistogram:
    """Counts of latencies or ages in bins with the fixed edges LATENCY_EDGES_S; seconds."""

    __slots__ = ("counts", "max_s", "sum_s")

    def __init__(self) -> None:
        self.counts = [0] * (len(LATENCY_EDGES_S) + 1)  # the last bin is above every edge
        self.sum_s = 0.0
        self.max_s = 0.0

    def observe(self, value_s: float) -> None:
        """Count one value; below zero counts as zero (two clocks that disagree), not finite is a UsageError."""
        if not math.isfinite(value_s):
            raise UsageError(f"LatencyHistogram: {value_s} is not a latency; leave it out")
        value_s = max(0.0, value_s)
        self.counts[bisect_left(LATENCY_EDGES_S, value_s)] += 1
        self.sum_s += value_s
        self.max_s = max(self.max_s, value_s)

    @property
    def count(self) -> int:
        return sum(self.counts)

    def quantile(self, q: float) -> float | None:
        """The q-quantile in seconds, linear inside its bin, never above the largest value; None when empty."""
        if not 0.0 <= q <= 1.0:
            raise UsageError(f"LatencyHistogram: quantile {q} is not between 0 and 1")
        count = self.count
        if not count:
            return None
        rank = q * count
        below = 0
        for index, inside in enumerate(self.counts):
            if inside and below + inside >= rank:
                low_s = LATENCY_EDGES_S[index - 1] if index else 0.0
                high_s = LATENCY_EDGES_S[index] if index < len(LATENCY_EDGES_S) else self.max_s
                high_s = min(high_s, self.max_s)
                return low_s + (high_s - low_s) * max(0.0, rank - below) / inside
            below += inside
        return self.max_s

    def merge(self, other: "LatencyHistogram") -> None:
        """Add another histogram's counts to this one."""
        for index, inside in enumerate(other.counts):
            self.counts[index] += inside
        self.sum_s += other.sum_s
        self.max_s = max(self.max_s, other.max_s)

    def to_json(self) -> dict[str, Any]:
        """`counts` has one more element than `edges_s`; quantiles are null when nothing was counted."""
        return {
            "edges_s": list(LATENCY_EDGES_S),
            "counts": list(self.counts),
            "count": self.count,
            "sum_s": self.sum_s,
            "max_s": self.max_s,
            "p50_s": self.quantile(0.5),
            "p95_s": self.quantile(0.95),
            "p99_s": self.quantile(0.99),
        }


class HopCounters:
    """All counters of one hop or daemon: a row per (topic, class), and a latency histogram per class.

    Beyond `max_topics` rows further topics share the row OTHER of their class, so that names cannot use up memory.
    """

    __slots__ = ("_max_topics", "_rows", "latency")

    def __init__(self, *, max_topics: int = DEFAULT_MAX_TOPICS) -> None:
        self._max_topics = max_topics
        self._rows: dict[tuple[TopicName, PriorityClass], TopicCounters] = {}
        self.latency: dict[PriorityClass, LatencyHistogram] = {priority: LatencyHistogram() for priority in CLASSES}

    def topic(self, topic: TopicName, priority: PriorityClass) -> TopicCounters:
        """The counters of a topic in a class, the same object every time."""
        row = self._rows.get((topic, priority))
        if row is not None:
            return row
        if len(self._rows) >= self._max_topics and topic != OTHER:
            return self.topic(OTHER, priority)
        row = self._rows[topic, priority] = TopicCounters(topic, priority)
        return row

    def rows(self) -> tuple[TopicCounters, ...]:
        """Every row, by class and topic."""
        return tuple(sorted(self._rows.values(), key=lambda row: (row.priority, row.topic)))

    def by_class(self) -> dict[PriorityClass, TopicCounters]:
        """Sums per class, every class present; new objects."""
        sums = {priority: TopicCounters(TopicName(""), priority) for priority in CLASSES}
        for row in self._rows.values():
            sums[row.priority].add(row)
        return sums

    def snapshot(self) -> dict[str, Any]:
        """JSON: `topics` a list of rows, `classes` the sums and the latency of each class by its name."""
        return {
            "topics": [row.to_json() for row in self.rows()],
            "classes": {
                priority.name.lower(): {**_without_topic(row.to_json()), "latency": self.latency[priority].to_json()}
                for priority, row in self.by_class().items()
            },
        }

    def validate(self) -> None:
        """Raises AssertionError when any row's balance is off."""
        for row in self._rows.values():
            row.validate()


def merged(histograms: Iterable[LatencyHistogram]) -> LatencyHistogram:
    """One histogram of all."""
    total = LatencyHistogram()
    for histogram in histograms:
        total.merge(histogram)
    return total


def _without_topic(row: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in row.items() if key not in {"topic", "class"}}
