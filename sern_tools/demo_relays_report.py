"""What `sern demo --relays` found: what it cost each stream that a relay was killed, and where the clients went.

Pure but for printing: the logs have been read. All clients are on one host, whose clock they share.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import median
from typing import Final

from rich.console import Console
from rich.table import Table

from sern_tools.checkout import commit
from sern_tools.demo_report import print_verdicts, reach, seconds
from sern_tools.message_log import TopicLog
from sern_tools.summary import Result, RunFacts, Verdict, analyse, judge

GAP_LIMIT_S: Final = 10.0
"""A stream that has not gone on by then is not the one that a client could go on with."""
NEVER: Final = math.inf


@dataclass(frozen=True, slots=True)
class Stream:
    """A topic that is looked at. `label`: what people call it; `source` and `taker` are clients."""

    topic: str
    label: str
    source: str
    taker: str
    reliable: bool = False
    lifespan_s: float | None = None
    """How long a command counts."""


@dataclass(frozen=True, slots=True)
class Move:
    """A client that has a link to another relay, so long after the kill."""

    client: str
    relay: str
    after_s: float


@dataclass(frozen=True, slots=True)
class Run:
    """What was done, and seen of the clients. Times are those of the wall clock."""

    killed: str
    origin_ns: int
    kill_ns: int
    end_ns: int
    before: Mapping[str, str | None]
    """The relay of each client before the kill; None: it had none."""
    after: Mapping[str, str | None]
    moves: Sequence[Move] = ()


@dataclass(frozen=True, slots=True)
class Row:
    """One stream. Latencies are medians; NaN where nothing arrived."""

    stream: Stream
    sent: int
    before_s: float
    gap_s: float
    """From the kill to the arrival of the first message that was sent after it; `NEVER` where none came."""
    after_s: float
    """The latency of what was sent after that one had arrived."""
    lost: int
    doubled: int
    out_of_order: int
    oldest_s: float
    """The age of the oldest message that arrived."""


@dataclass(frozen=True, slots=True)
class RelaysReport:
    command: str
    started: str
    run: Run
    rows: Sequence[Row]
    verdicts: Sequence[Verdict]

    @property
    def ok(self) -> bool:
        return all(verdict.ok for verdict in self.verdicts)


def within(log: TopicLog, origin_ns: int, end_ns: int) -> TopicLog:
    """The part of a log that is of messages offered in that time."""
    outside = {seq for seq, offer in log.offers.items() if not origin_ns <= offer.wall_ns < end_ns}
    return replace(
        log,
        offers={seq: offer for seq, offer in log.offers.items() if seq not in outside},
        deliveries=[each for each in log.deliveries if each.seq not in outside],
    )


def missing(log: TopicLog, origin_ns: int) -> set[int]:
    """Messages that were taken in since then and have not been delivered, nor reported as lost."""
    since = {seq for seq, offer in log.offers.items() if offer.wall_ns >= origin_ns}
    return since - {each.seq for each in log.deliveries} - log.refused - log.expired.keys()


def judged(
    command: str, started: str, run: Run, streams: Sequence[Stream], logs: Mapping[str, TopicLog]
) -> RelaysReport:
    """What the run comes to. Of best-effort streams what was sent up to its end counts, of reliable ones all."""
    kept: dict[str, TopicLog] = {}
    for stream in streams:
        log = logs.get(stream.topic, TopicLog(stream.topic, "bulk"))
        until_ns = max((offer.wall_ns + 1 for offer in log.offers.values()), default=0)
        kept[stream.topic] = within(log, run.origin_ns, until_ns if stream.reliable else run.end_ns)
    facts = RunFacts(
        origin_ns=run.origin_ns,
        duration_s=(run.end_ns - run.origin_ns) / 1e9,
        floor_s={},
        reliable_topics=frozenset(stream.topic for stream in streams if stream.reliable),
        command_lifespans_s={each.topic: each.lifespan_s for each in streams if each.lifespan_s is not None},
    )
    result = analyse("SERN", kept, facts)
    rows = [_row(stream, kept[stream.topic], result, run) for stream in streams]
    verdicts = [*judge(result, None, overtaken_share_limits={}), _goes_on(rows), _found(run)]
    return RelaysReport(command, started, run, rows, verdicts)


def _row(stream: Stream, log: TopicLog, result: Result, run: Run) -> Row:
    before = [each.latency_s for each in log.deliveries if each.wall_ns < run.kill_ns]
    fresh = [each for each in log.deliveries if each.stamp_ns >= run.kill_ns]
    first_ns = min((each.wall_ns for each in fresh), default=None)
    after = [each.latency_s for each in fresh if first_ns is not None and each.stamp_ns >= first_ns]
    statistics = result.topics[stream.topic]
    return Row(
        stream=stream,
        sent=statistics.offered - statistics.refused,
        before_s=median(before) if before else math.nan,
        gap_s=NEVER if first_ns is None else (first_ns - run.kill_ns) / 1e9,
        after_s=median(after) if after else math.nan,
        lost=len(missing(log, run.origin_ns)),
        doubled=statistics.duplicates,
        out_of_order=statistics.out_of_order,
        oldest_s=max((each.latency_s for each in log.deliveries), default=math.nan),
    )


def _goes_on(rows: Sequence[Row]) -> Verdict:
    longest = max(rows, key=lambda row: row.gap_s)
    return Verdict(
        "longest_gap_s",
        f"every stream goes on within {GAP_LIMIT_S:g} s of the kill",
        longest.gap_s,
        GAP_LIMIT_S,
        longest.gap_s <= GAP_LIMIT_S,
        longest.stream.label,
    )


def _found(run: Run) -> Verdict:
    """Whose relay lives stays there; whose relay was killed is at another."""
    astray = [
        client
        for client, relay in run.before.items()
        if run.after.get(client) in (None, run.killed) or (relay != run.killed and run.after[client] != relay)
    ]
    return Verdict(
        "clients_astray",
        f"who was at {run.killed} is at another relay, and nobody else has moved",
        len(astray),
        0,
        not astray,
        ", ".join(astray),
        noun="astray",
    )


# Terminal and JSON ----------------------------------------------------------------------------------------------------


def show(report: RelaysReport, console: Console) -> None:
    """Two tables that fit 80 columns, and which promises were kept."""
    run = report.run
    table = Table(
        title=f"What it cost that {run.killed} was killed", title_justify="left", box=None, padding=(0, 2, 0, 0)
    )
    table.add_column("stream", no_wrap=True)
    for heading in ("sent", "takes\nbefore", "gap at\nthe kill", "takes\nafter", "lost", "doubled", "out of\norder"):
        table.add_column(heading, justify="right", no_wrap=True, vertical="bottom")
    for row in report.rows:
        table.add_row(
            row.stream.label + (" *" if row.stream.reliable else ""),
            str(row.sent),
            seconds(row.before_s),
            seconds(row.gap_s),
            seconds(row.after_s),
            str(row.lost),
            str(row.doubled),
            str(row.out_of_order),
        )
    console.print(table)
    console.print("* reliable: kept until the site has it. Of the others the newest goes, and what")
    console.print("  it takes the place of, or nobody could carry, counts as lost.")
    for row in report.rows:
        if row.stream.lifespan_s is not None:
            oldest, lifespan = seconds(row.oldest_s), seconds(row.stream.lifespan_s)
            console.print(f"The oldest of the {row.stream.label}: {oldest}, of {lifespan} allowed.", highlight=False)
    console.print()
    places = Table(title="Where the clients were", title_justify="left", box=None, padding=(0, 2, 0, 0))
    for heading in ("client", "before", "after", "how long it took"):
        places.add_column(heading, no_wrap=True)
    for client, relay in run.before.items():
        took = [move.after_s for move in run.moves if move.client == client]
        after = run.after.get(client)
        words = "stayed" if not took and after == relay else f"{took[-1]:.1f} s" if took else "-"
        places.add_row(client, relay or "none", after or "none", words)
    console.print(places)
    console.print()
    print_verdicts(report.verdicts, console)


def as_json(report: RelaysReport) -> str:
    """The benchmarks' shape; a number that does not exist is null."""
    run = report.run
    rows: list[dict[str, object]] = []
    for row in report.rows:
        figures: dict[str, float] = {
            "sent_messages": row.sent,
            "before_p50_s": row.before_s,
            "gap_s": row.gap_s,
            "after_p50_s": row.after_s,
            "oldest_s": row.oldest_s,
            "lost_messages": row.lost,
            "doubled_messages": row.doubled,
            "out_of_order_messages": row.out_of_order,
        }
        named = {"case": row.stream.topic, "from": row.stream.source, "to": row.stream.taker}
        finite = {name: value if math.isfinite(value) else None for name, value in figures.items()}
        rows.append({**named, "reliable": row.stream.reliable, **finite})
    for client, relay in run.before.items():
        took = [move.after_s for move in run.moves if move.client == client]
        moved = took[-1] if took else None
        rows.append({"case": client, "relay_before": relay, "relay_after": run.after.get(client), "moved_s": moved})
    document = {"benchmark": "demo-relays", "commit": commit(), "killed": run.killed, "rows": rows}
    return json.dumps({**document, "reach": reach(report.verdicts)}, indent=2, allow_nan=False) + "\n"
