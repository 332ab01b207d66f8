"""The live picture of a running demo: one table in 80x24, or one line every few seconds where there is no terminal."""

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from sern_core.vocabulary.types import CLASS_LABELS
from sern_sim.profiles import LinkProfile

LINE_INTERVAL_S: Final = 5.0
RATE_WINDOW_S: Final = 2.0
MAX_TOPICS: Final = 7
STYLES: Final = {"control": "green", "state": "cyan", "bulk": "magenta"}


@dataclass(frozen=True, slots=True)
class TopicSample:
    """Counters of one topic, both ends joined, at one time. `age_s` of the newest message at the far side."""

    priority: str
    offered: int = 0
    delivered: int = 0
    delivered_bytes: int = 0
    dropped: Mapping[str, int] = field(default_factory=dict)
    age_s: float | None = None


@dataclass(frozen=True, slots=True)
class Sample:
    """All there is to see at script time `t_s`. `estimate_bps` and `waiting_bytes` where the system knows them."""

    t_s: float
    topics: Mapping[str, TopicSample]
    capacity_bps: float = 0.0
    estimate_bps: float | None = None
    waiting_bytes: int | None = None
    link_packets: int | None = None
    round_trip_s: float | None = None


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the table: rates in messages and bits per second over the last interval."""

    name: str
    priority: str
    offered_hz: float
    delivered_hz: float
    delivered_bps: float
    age_s: float | None
    dropped: int
    reasons: Mapping[str, int]


def join(*clients: Mapping[str, Any]) -> dict[str, TopicSample]:
    """The /api/topics of several clients as one: the sender knows what was offered, the receiver what arrived."""
    joined: dict[str, TopicSample] = {}
    for topics in clients:
        for name, counters in topics.items():
            past = joined.get(name, TopicSample(counters["class"]))
            dropped = dict(past.dropped)
            for reason, count in counters["dropped"].items():
                if count and reason != "duplicate":
                    dropped[reason] = dropped.get(reason, 0) + count
            if counters["direction"] == "send":
                joined[name] = replace(past, offered=past.offered + counters["offered"], dropped=dropped)
                continue
            joined[name] = replace(
                past,
                delivered=past.delivered + counters["delivered"],
                delivered_bytes=past.delivered_bytes + counters["bytes_delivered"],
                dropped=dropped,
                age_s=counters.get("age_s", past.age_s),
            )
    return joined


def rows(before: Sample, now: Sample) -> tuple[list[Row], list[Row]]:
    """(classes, topics), each in order of urgency."""
    interval = max(now.t_s - before.t_s, 1e-3)
    topics = []
    for name, sample in now.topics.items():
        past = before.topics.get(name, TopicSample(sample.priority))
        topics.append(
            Row(
                name,
                sample.priority,
                (sample.offered - past.offered) / interval,
                (sample.delivered - past.delivered) / interval,
                8 * (sample.delivered_bytes - past.delivered_bytes) / interval,
                sample.age_s,
                sum(sample.dropped.values()),
                sample.dropped,
            )
        )
    topics.sort(key=lambda row: (CLASS_LABELS.index(row.priority), row.name))
    return [_sum(label, [row for row in topics if row.priority == label]) for label in CLASS_LABELS], topics


def _sum(label: str, members: Sequence[Row]) -> Row:
    reasons: dict[str, int] = {}
    for row in members:
        for reason, count in row.reasons.items():
            reasons[reason] = reasons.get(reason, 0) + count
    ages = [row.age_s for row in members if row.age_s is not None]
    return Row(
        label,
        label,
        sum(row.offered_hz for row in members),
        sum(row.delivered_hz for row in members),
        sum(row.delivered_bps for row in members),
        max(ages, default=None),
        sum(row.dropped for row in members),
        reasons,
    )


def phase(profile: LinkProfile, t_s: float) -> str:
    """What the link is doing, in words: `4 Mbit/s`, `blackout, 3.2 s to go`, `4 Mbit/s, blackout in 2 s`."""
    if t_s < 0:
        return "before the start"
    window = profile.up.next_blackout(t_s)
    if window is not None and window.start_s <= t_s:
        return f"BLACKOUT, {window.end_s - t_s:.0f} s to go"
    text = rate(profile.rate_bps_at(t_s))
    change = profile.next_change_s(t_s)
    if change is None or change - t_s > 10:
        return text
    if window is not None and window.start_s == change:
        return f"{text}, blackout in {change - t_s:.0f} s"
    return f"{text}, {rate(profile.rate_bps_at(change))} in {change - t_s:.0f} s"


def rate(bps: float | None) -> str:
    if bps is None:
        return "unlimited"
    if bps >= 0.9995e6:
        return f"{bps / 1e6:.3g} Mbit/s"
    return f"{bps / 1e3:.0f} kbit/s"


def age(seconds: float | None) -> str:
    if seconds is None or math.isnan(seconds):
        return "-"
    return f"{seconds * 1e3:.0f} ms" if seconds < 1 else f"{seconds:.1f} s"


class LiveView:
    """`with LiveView(...) as view: view.show(sample)`. On a terminal a table that stays; else a line now and then."""

    def __init__(
        self, console: Console, title: str, profile: LinkProfile, duration_s: float, *, namespace: str = ""
    ) -> None:
        self._console = console
        self._title = title
        self._profile = profile
        self._duration_s = duration_s
        self._live: Live | None = None
        self._namespace = namespace
        self._past: deque[Sample] = deque()
        self._next_line_s = 0.0

    def __enter__(self) -> "LiveView":
        if self._console.is_terminal:
            self._live = Live(console=self._console, auto_refresh=False, transient=True)
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.stop()
            self._live = None

    def show(self, sample: Sample) -> None:
        self._past.append(sample)
        while len(self._past) > 2 and self._past[1].t_s <= sample.t_s - RATE_WINDOW_S:
            self._past.popleft()
        before = self._past[0]
        if self._live is not None:
            self._live.update(self.render(before, sample), refresh=True)
        elif sample.t_s >= self._next_line_s:
            self._next_line_s = sample.t_s + LINE_INTERVAL_S
            self._console.print(self.line(before, sample), soft_wrap=True)

    def line(self, before: Sample, now: Sample) -> str:
        classes, _ = rows(before, now)
        parts = [f"{row.name} {row.delivered_hz:.0f}/{row.offered_hz:.0f} Hz, age {age(row.age_s)}" for row in classes]
        return f"{now.t_s:5.1f} s  {phase(self._profile, now.t_s)}  |  " + "  |  ".join(parts)

    def render(self, before: Sample, now: Sample) -> RenderableType:
        classes, topics = rows(before, now)
        table = Table(
            box=None, pad_edge=False, collapse_padding=True, padding=(0, 2, 0, 0), width=min(80, self._console.width)
        )
        table.add_column("", no_wrap=True, overflow="ellipsis", ratio=1)
        for heading in ("in Hz", "out Hz", "kbit/s", "age", "dropped"):
            table.add_column(heading, justify="right", no_wrap=True)
        table.add_column("why", no_wrap=True, overflow="ellipsis", max_width=22)
        for row in classes:
            self._add(table, row, f"bold {STYLES[row.priority]}")
        table.add_row()
        for row in topics[:MAX_TOPICS]:
            self._add(table, row, STYLES[row.priority])
        return Group(self._headline(now), Text(), table, Text(), self._link(now), self._progress(now))

    def _add(self, table: Table, row: Row, style: str) -> None:
        why = ", ".join(reason for reason, _ in sorted(row.reasons.items(), key=lambda item: -item[1])[:2])
        table.add_row(
            row.name.removeprefix(self._namespace),
            f"{row.offered_hz:.0f}",
            f"{row.delivered_hz:.0f}",
            f"{row.delivered_bps / 1e3:.0f}",
            age(row.age_s),
            str(row.dropped),
            why,
            style=style,
        )

    def _headline(self, now: Sample) -> Text:
        black = self._profile.blackout_at(max(0.0, now.t_s))
        words = phase(self._profile, now.t_s)
        return Text.assemble(
            (f" {self._title} ", "bold reverse"), "  ", (words, "bold red" if black else "bold"), no_wrap=True
        )

    def _link(self, now: Sample) -> Text:
        parts = [f"link {rate(now.capacity_bps)}"]
        if now.estimate_bps is not None:
            parts.append(f"estimated {rate(now.estimate_bps)}")
        if now.round_trip_s is not None:
            parts.append(f"RTT {age(now.round_trip_s)}")
        if now.waiting_bytes is not None:
            parts.append(f"waiting {now.waiting_bytes / 1000:.0f} kB")
        if now.link_packets is not None:
            parts.append(f"queue {now.link_packets} packets")
        return Text("  ".join(parts), no_wrap=True, overflow="ellipsis")

    def _progress(self, now: Sample) -> Text:
        """The run from left to right: done, to come, and where the link is gone."""
        width = min(80, self._console.width) - 14
        text = Text(no_wrap=True)
        for cell in range(width):
            at = (cell + 0.5) * self._duration_s / width
            black = self._profile.blackout_at(at)
            text.append("█" if at <= now.t_s else "░", "red" if black else "blue")
        text.append(f" {max(0.0, now.t_s):.0f} / {self._duration_s:.0f} s")
        return text
