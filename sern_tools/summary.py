"""What a run amounts to: per-class statistics from message logs and counters, and whether the promises were kept.

Pure: files are read by `message_log`; everything here works on what they held. Times in results are seconds since
the start of the link's script unless a name says otherwise.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sern_core.vocabulary.types import CLASS_LABELS
from sern_tools.counters import Counters
from sern_tools.fates import NO_DROP, UNCONFIRMED, Fates, Route, fates
from sern_tools.message_log import Event, TopicLog

FRESH_S: Final = 0.5
"""A pose counts as fresh when it is no older than this above the link's floor."""
OVERTAKING_MARGIN_S: Final = 0.010
"""Overtaking by less is the grain of two connections and of a busy machine, not an order."""
LATE_LOG_S: Final = 0.020
"""What may pass between the last check of a command's age and the line in the log."""
DATAGRAM_SHARE: Final = 0.5
"""The lane falls back to TCP for a while after a blackout, and never for most of a run."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class RunFacts:
    """What the logs do not say. `floor_s`: idle one-way latency per origin, measured on the same link."""

    origin_ns: int  # wall time of the script's 0
    duration_s: float
    floor_s: Mapping[str, float]
    blackouts: tuple[tuple[float, float], ...] = ()
    reliable_topics: frozenset[str] = frozenset()
    command_lifespans_s: Mapping[str, float] = field(default_factory=dict)
    pose_topic: str = ""
    relay: str = "relay"  # under which name its log was read
    subscribers: Mapping[str, str] = field(default_factory=dict)  # who gets the messages of each origin


@dataclass(slots=True)
class Statistics:
    """One topic, or one class: sums of its topics and quantiles over all its messages. Latency is in seconds."""

    name: str
    offered: int = 0
    delivered: int = 0  # distinct messages
    refused: int = 0
    dropped: Counter[str] = field(default_factory=Counter)
    undelivered: int = 0  # neither delivered nor reported: lost without a word, or still under way at the end
    duplicates: int = 0
    out_of_order: int = 0
    corrupted: int = 0
    offered_bytes: int = 0
    delivered_bytes: int = 0
    latency_s: list[float] = field(default_factory=list)
    under_way: int = 0  # still queued or in flight at the end, where there are counters
    overtaken: int = 0  # delivered after a less urgent message that was offered later
    above_floor_s: list[float] = field(default_factory=list)

    def quantile_s(self, q: float) -> float:
        """NaN when nothing was delivered."""
        return float(np.quantile(self.latency_s, q)) if self.latency_s else math.nan

    @property
    def unseen(self) -> int:
        """Messages that went into the system and of which nothing more is known."""
        known = self.delivered + self.refused + self.under_way + sum(self.dropped.values())
        return max(0, self.offered - known)

    @property
    def delivered_share(self) -> float:
        return self.delivered / self.offered if self.offered else math.nan

    def add(self, other: "Statistics") -> None:
        for name in (
            "offered",
            "delivered",
            "refused",
            "undelivered",
            "under_way",
            "duplicates",
            "out_of_order",
            "corrupted",
            "offered_bytes",
            "delivered_bytes",
            "overtaken",
        ):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        self.dropped.update(other.dropped)
        self.latency_s += other.latency_s
        self.above_floor_s += other.above_floor_s


@dataclass(slots=True)
class Result:
    """One system over one run."""

    system: str
    facts: RunFacts
    topics: dict[str, Statistics]
    classes: dict[str, Statistics]
    logs: dict[str, TopicLog]
    first_fresh_pose_s: list[float]  # per blackout that ended in the run; inf when none came
    accounting_gap: int | None = None  # messages that no counter accounts for; None without counters
    accounting_notes: list[str] = field(default_factory=list)
    fates: dict[str, Fates] = field(default_factory=dict)  # by topic; with counters only
    unconfirmed: int = 0  # messages whose fate a sender could not know
    unconfirmed_arrived: int = 0  # those of them of which the next place says it

    def arrivals(self, priority: str) -> tuple[Floats, Floats]:
        """(time of delivery, latency) of every delivery of a class, by time; both in seconds."""
        pairs = sorted(
            ((d.wall_ns - self.facts.origin_ns) / 1e9, d.latency_s)
            for log in self.logs.values()
            if log.priority == priority
            for d in log.deliveries
        )
        table = np.asarray(pairs, dtype=np.float64).reshape(-1, 2)
        return table[:, 0], table[:, 1]

    def pose_age(self, step_s: float = 0.05) -> tuple[Floats, Floats]:
        """(time, age of the newest pose that the far side has) over the run; NaN before the first one."""
        times = np.arange(0.0, self.facts.duration_s, step_s)
        ages = np.full_like(times, np.nan)
        log = self.logs.get(self.facts.pose_topic)
        if log is None or not log.deliveries:
            return times, ages
        deliveries = sorted(log.deliveries)
        arrived = np.array([(d.wall_ns - self.facts.origin_ns) / 1e9 for d in deliveries])
        newest = np.maximum.accumulate([(d.stamp_ns - self.facts.origin_ns) / 1e9 for d in deliveries])
        index = np.searchsorted(arrived, times, side="right") - 1
        known = index >= 0
        ages[known] = times[known] - newest[index[known]]
        return times, ages


@dataclass(frozen=True, slots=True)
class Verdict:
    """A promise, what was measured, and whether it held. `limit` and `value` share the unit in `name`.

    `noun`: what is counted, where the value is a count that should be 0.
    """

    name: str
    promise: str
    value: float
    limit: float
    ok: bool
    detail: str = ""
    noun: str = ""


def analyse(
    system: str, logs: dict[str, TopicLog], facts: RunFacts, counters: Mapping[str, Sequence[Counters]] | None = None
) -> Result:
    """Statistics of one run. `counters` per global topic, from the daemons' summaries; None where there are none."""
    topics: dict[str, Statistics] = {}
    for name, log in sorted(logs.items()):
        reasons: Counter[str] = Counter()
        for counter in (counters or {}).get(name, ()):
            reasons.update(counter.dropped)
        topics[name] = _topic(log, facts, reasons if counters is not None else None)
    for name, overtaken in _overtaken(logs).items():
        topics[name].overtaken = overtaken
    classes = {label: Statistics(label) for label in CLASS_LABELS}
    result = Result(system, facts, topics, classes, logs, _first_fresh_pose(logs, facts))
    if counters is not None:
        _account(result, counters)
    for name, statistics in topics.items():
        classes[logs[name].priority].add(statistics)
    return result


def _topic(log: TopicLog, facts: RunFacts, reasons: Counter[str] | None) -> Statistics:
    seen: set[int] = set()
    last = 0
    statistics = Statistics(log.topic, offered=log.offered, refused=len(log.refused))
    statistics.offered_bytes = sum(offer.size_bytes for offer in log.offers.values())
    floor_s = facts.floor_s.get(log.origin, 0.0)
    for delivery in log.deliveries:
        offer = log.offers.get(delivery.seq)
        if offer is None or (offer.size_bytes, offer.crc32) != (delivery.size_bytes, delivery.crc32):
            statistics.corrupted += 1
        if delivery.seq in seen:
            statistics.duplicates += 1
            continue
        seen.add(delivery.seq)
        statistics.out_of_order += delivery.seq < last
        last = max(last, delivery.seq)
        statistics.delivered_bytes += delivery.size_bytes
        statistics.latency_s.append(delivery.latency_s)
        statistics.above_floor_s.append(delivery.latency_s - floor_s)
    statistics.delivered = len(seen)
    if reasons is None:
        statistics.dropped = log.drop_reasons()
    else:
        statistics.dropped = Counter({reason: n for reason, n in reasons.items() if n and reason != "duplicate"})
    accounted = seen | log.refused | log.expired.keys()
    statistics.undelivered = len(log.offers.keys() - accounted)
    return statistics


def _overtaken(logs: Mapping[str, TopicLog]) -> dict[str, int]:
    """Per topic: messages delivered after a less urgent message from the same origin that was offered after them."""
    found: dict[str, int] = {}
    for name, log in logs.items():
        rank = CLASS_LABELS.index(log.priority)
        later = [o for o in logs.values() if o.origin == log.origin and CLASS_LABELS.index(o.priority) > rank]
        table = np.concatenate([_times(other) for other in later]) if later else np.empty((0, 2))
        mine = _times(log)
        if not len(table) or not len(mine):
            continue
        table = table[np.argsort(table[:, 0])]
        first_delivery_from = np.append(np.minimum.accumulate(table[::-1, 1])[::-1], np.inf)
        margin_ns = OVERTAKING_MARGIN_S * 1e9
        index = np.searchsorted(table[:, 0], mine[:, 0] + margin_ns, side="right")
        found[name] = int(np.count_nonzero(first_delivery_from[index] < mine[:, 1] - margin_ns))
    return found


def _times(log: TopicLog) -> Floats:
    """(offered, delivered) in wall nanoseconds; float64 is exact to a fraction of a microsecond here."""
    first: dict[int, int] = {}
    for delivery in log.deliveries:
        first.setdefault(delivery.seq, delivery.wall_ns)
    pairs = [(log.offers[seq].wall_ns, wall_ns) for seq, wall_ns in first.items() if seq in log.offers]
    return np.asarray(pairs, dtype=np.float64).reshape(-1, 2)


def _first_fresh_pose(logs: Mapping[str, TopicLog], facts: RunFacts) -> list[float]:
    log = logs.get(facts.pose_topic)
    found: list[float] = []
    for _, end_s in facts.blackouts:
        if end_s >= facts.duration_s:
            continue
        end_ns = facts.origin_ns + round(end_s * 1e9)
        limit_s = FRESH_S + (facts.floor_s.get(log.origin, 0.0) if log else 0.0)
        fresh = (d.wall_ns for d in (log.deliveries if log else ()) if d.wall_ns >= end_ns and d.latency_s <= limit_s)
        found.append(min(((wall_ns - end_ns) / 1e9 for wall_ns in fresh), default=math.inf))
    return found


NOT_DROPPED: Final = frozenset({"duplicate", "refused"})
"""What counters have among the reasons that is no drop: it came twice, or its caller was told."""


def _account(result: Result, counters: Mapping[str, Sequence[Counters]]) -> None:
    """Every message that was offered has one fate, by its seq (`sern_tools/fates.py`), and the daemons' counters say
    of every place what the logs say of it, reason by reason. Nothing is tolerated."""
    result.accounting_gap = 0
    facts = result.facts
    for name, log in sorted(result.logs.items()):
        topic = result.topics[name]
        route = Route(log.origin, facts.relay, facts.subscribers.get(log.origin, ""))
        found = fates(log, route, reliable=name in facts.reliable_topics)
        topic.dropped, topic.under_way = found.dropped(), found.waiting
        result.fates[name] = found
        given_up = (
            log.dropped.get((route.origin, route.relay), {}),
            log.dropped.get((route.relay, route.subscriber), {}),
        )
        result.unconfirmed += sum(UNCONFIRMED in (sent.get(seq) for sent in given_up) for seq in found.by_seq)
        result.unconfirmed_arrived += sum(
            UNCONFIRMED in (sent.get(seq) for sent in given_up) and fate.what != UNCONFIRMED
            for seq, fate in found.by_seq.items()
        )
        gaps = Counter(found.faults.values())
        for seq, what in sorted(found.faults.items())[:1]:
            result.accounting_notes.append(f"{name}: {len(found.faults)} without one fate, first {seq}: {what}")
        entries = counters.get(name, ())
        said = {
            "offered": (log.offered, sum(c.offered + c.refused for c in entries if c.direction == "send")),
            "delivered": (len(log.deliveries), sum(c.delivered for c in entries if c.direction == "receive")),
        }
        for direction, events in _LINES_OF.items():
            lines: Counter[str] = Counter()
            for event in events:
                for (place, reason), count in log.lines.get(event, Counter()).items():
                    if (place == facts.relay) == (direction in ("onward", "inward")):
                        lines[reason] += count
            counted: Counter[str] = Counter()
            for entry in entries:
                if entry.direction == direction:
                    counted.update({reason: n for reason, n in entry.dropped.items() if reason not in NOT_DROPPED})
            for reason in lines.keys() | counted.keys():
                said[f"dropped ({direction}, {reason})"] = (lines[reason], counted[reason])
        result.accounting_gap += gaps.total()
        for what, (logged, counted_) in said.items():
            if logged != counted_:
                result.accounting_gap += abs(logged - counted_)
                result.accounting_notes.append(f"{name}: {logged} {what} in the logs, {counted_} in the counters")


_LINES_OF: Final = {
    "send": (Event.DROPPED,),
    "onward": (Event.DROPPED,),
    "inward": (Event.DISCARDED,),
    "receive": (Event.DISCARDED, Event.EXPIRED),
}
"""Which lines of the message logs the counters of one direction count."""


def judge(
    sern: Result,
    baseline: Result | None,
    *,
    overtaken_share_limits: Mapping[str, float],
    baseline_factor: float = 10.0,
    fresh_limit_s: float = 3.0,
    late_log_s: float = LATE_LOG_S,
    datagram_share: float | None = None,
) -> list[Verdict]:
    """The promises of a run. A promise that the run could not put to the test is not in the list.

    `datagram_share`: share of the time that the datagram lane was in use on a link that lets datagrams through.
    """
    verdicts = [_reliable(sern), _intact(sern), *_order(sern, overtaken_share_limits), *_commands(sern, late_log_s)]
    if sern.accounting_gap is not None:
        notes = [*sern.accounting_notes[:4], *_sum_words(sern)]
        verdicts.append(
            Verdict(
                "uncounted_messages",
                "every drop is counted, message by message: offered = delivered + refused + dropped + waiting",
                sern.accounting_gap,
                0,
                sern.accounting_gap == 0,
                "; ".join(notes),
                noun="uncounted",
            )
        )
    if datagram_share is not None:
        verdicts.append(
            Verdict(
                "datagram_share",
                f"datagrams carry it, where they get through, more than {DATAGRAM_SHARE:.0%} of the time",
                datagram_share,
                DATAGRAM_SHARE,
                datagram_share > DATAGRAM_SHARE,
            )
        )
    if baseline is not None:
        ours, theirs = sern.classes["control"].quantile_s(0.99), baseline.classes["control"].quantile_s(0.99)
        verdicts.append(
            Verdict(
                "control_p99_s",
                f"class control, p99 latency: below a {_ordinal(baseline_factor)} of plain ZMQ's",
                ours,
                theirs / baseline_factor,
                ours < theirs / baseline_factor,
                f"plain ZMQ: {theirs:.3f} s",
            )
        )
    if sern.first_fresh_pose_s:
        worst = max(sern.first_fresh_pose_s)
        verdicts.append(
            Verdict(
                "first_fresh_pose_s",
                f"a fresh pose within {fresh_limit_s:g} s of the end of a blackout",
                worst,
                fresh_limit_s,
                worst <= fresh_limit_s,
            )
        )
    return verdicts


def _sum_words(result: Result) -> list[str]:
    """The sum, in words, and what became of those whose sender could not know."""
    total = sum(found.decided.total() + len(found.faults) for found in result.fates.values())
    parts: Counter[str] = Counter()
    for found in result.fates.values():
        for fate, count in found.decided.items():
            parts[fate.what if fate.what in NO_DROP else f"dropped at the {fate.place}"] += count
    notes = [f"{total} offered = " + " + ".join(f"{count} {what}" for what, count in parts.most_common())]
    if result.unconfirmed:
        notes.append(
            f"{result.unconfirmed} given up unconfirmed, of which the next place knows {result.unconfirmed_arrived}"
        )
    return notes


def _ordinal(factor: float) -> str:
    return "tenth" if factor == 10 else f"{factor:g}th part"


def _reliable(result: Result) -> Verdict:
    """Complete: each message delivered once, or refused, or reported as expired; and in order."""
    broken, notes, total = 0, [], 0
    for name in sorted(result.facts.reliable_topics & result.topics.keys()):
        topic = result.topics[name]
        total += topic.offered
        faults = {"missing": topic.undelivered, "twice": topic.duplicates, "out of order": topic.out_of_order}
        broken += sum(faults.values())
        notes += [f"{name}: {n} {what}" for what, n in faults.items() if n]
    if total == 0:
        notes.append("no reliable message was offered")
    return Verdict(
        "reliable_faults",
        "reliable messages arrive complete, once and in order",
        broken,
        0,
        broken == 0 and total > 0,
        "; ".join(notes) or f"{total} messages",
        noun="missing or out of place",
    )


def _intact(result: Result) -> Verdict:
    corrupted = sum(topic.corrupted for topic in result.topics.values())
    promise = "every message that arrives is one that was sent, byte for byte"
    return Verdict("corrupted_messages", promise, corrupted, 0, corrupted == 0, noun="altered")


def _order(result: Result, limits: Mapping[str, float]) -> list[Verdict]:
    verdicts = []
    for label, limit in limits.items():
        statistics = result.classes[label]
        if not statistics.delivered:
            continue
        share = statistics.overtaken / statistics.delivered
        verdicts.append(
            Verdict(
                f"{label}_overtaken_share",
                f"class order: class {label} is overtaken by later, less urgent messages only from their floor",
                share,
                limit,
                share <= limit,
                f"{statistics.overtaken} of {statistics.delivered}",
            )
        )
    return verdicts


def _commands(result: Result, late_log_s: float) -> list[Verdict]:
    late, worst_s, total = 0, 0.0, 0
    for name, lifespan_s in result.facts.command_lifespans_s.items():
        log = result.logs.get(name)
        for delivery in log.deliveries if log else ():
            total += 1
            worst_s = max(worst_s, delivery.latency_s - lifespan_s)
            late += delivery.latency_s > lifespan_s + late_log_s
    if not result.facts.command_lifespans_s:
        return []
    return [
        Verdict(
            "expired_commands",
            "no command is delivered after its lifespan",
            late,
            0,
            late == 0 and total > 0,
            f"{total} delivered" + (f", the latest {worst_s:.2f} s too late" if late else ""),
            noun="late",
        )
    ]
