"""`sern topics`: the topics at a relay or a client: whose, what, how much, how old, and what was dropped.

In and out are the daemon's own: at a relay, in is what its clients sent it and out what its subscribers have; at a
client, in is what came from the relay and out what the relay has. Rates come from two looks at the counters. A relay
also lists what is announced and taken by nobody, with a mark. Where there are several, it lists the topics of all, and
says at which relay the owner is.
"""

import json
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Annotated, Any, Final, Literal, NamedTuple

import typer
from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from sern_core.site.services import parse as parse_service
from sern_core.topics.patterns import Pattern, compile_pattern
from sern_core.vocabulary.errors import SernError, UsageError
from sern_core.vocabulary.types import CLASS_LABELS, TopicName
from sern_tools.api import NotFoundError, checked_api, drop_output, get_json, is_stream, local_api, say

MIN_INTERVAL_S: Final = 0.1
PLAIN_WIDTH: Final = 200
"""Characters of a line where the output is no terminal: nothing is cut short in a file."""
REREAD_S: Final = 30.0
"""How long to wait before it is asked again whose a topic is that nobody had."""
OBJECTS_PATH: Final = "/api/objects?definitions=no&values=no"
NOT_LOSSES: Final = frozenset({"duplicate"})
"""Reasons that do not mean that a message is missing."""


@dataclass(slots=True)
class Counts:
    """Counters of one topic at one time. `subscribers`: links over which it is wanted now. `untaken`: it is
    announced at a relay, and nobody takes it there. `relays`: those that its owners are at, where there are several."""

    priority: str
    received: int = 0
    received_bytes: int = 0
    delivered: int = 0
    delivered_bytes: int = 0
    queued: int = 0
    subscribers: int = 0
    untaken: bool = False
    relays: set[str] = field(default_factory=set)
    age_s: float | None = None
    reasons: Counter[str] = field(default_factory=Counter)


@dataclass(frozen=True, slots=True)
class Identity:
    """Who publishes a topic and as what. Several owners are joined with commas."""

    type_name: str
    owner: str


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the table, and one element of `--json`: a rate beside each total. `age_s` of the freshest sample at
    this daemon. `relay`: that of the owner, where there are several; those of several owners are joined with commas."""

    topic: str
    priority: str
    type_name: str | None
    owner: str | None
    relay: str | None
    in_hz: float
    out_hz: float
    in_bytes_per_s: float
    out_bytes_per_s: float
    age_s: float | None
    subscribers: int
    untaken: bool
    queued: int
    dropped: int
    dropped_by_reason: Mapping[str, int]
    in_messages: int
    out_messages: int
    in_bytes: int
    out_bytes: int
    dropped_hz: float
    dropped_hz_by_reason: Mapping[str, float]


def _is_relay(answer: Mapping[str, Any]) -> bool:
    return answer.keys() >= {"links", "received"}


def parse_topics(answer: Mapping[str, Any]) -> dict[str, Counts]:
    """/api/topics of a relay (`links` and `received`) or of a client (a flat map of topics)."""
    tables = [*answer["links"].values(), answer["received"]] if _is_relay(answer) else [answer]
    topics: dict[str, Counts] = {}
    for table in tables:
        for name, row in table.items():
            counts = topics.setdefault(name, Counts(row["class"]))
            if row["direction"] == "receive":
                counts.received += row["delivered"]
                counts.received_bytes += row["bytes_delivered"]
                counts.age_s = row.get("age_s")
            else:
                counts.delivered += row["delivered"]
                counts.delivered_bytes += row["bytes_delivered"]
                counts.queued += row["in_queue"] + row["in_flight"]
                counts.subscribers += bool(row["wanted"])
            counts.reasons.update({reason: n for reason, n in row["dropped"].items() if reason not in NOT_LOSSES})
    # A topic that nobody takes stays at its origin: no counter at the relay knows it. Older relays do not list them.
    if not _is_relay(answer):
        return topics
    here = answer.get("announced", {})
    for name, announced in (*here.items(), *answer.get("elsewhere", {}).items()):
        counts = topics.setdefault(name, Counts(announced["class"]))
        counts.relays.update(announced.get("relays", ()))
        counts.untaken = not here.get(name, announced)["taken"]
    return topics


def parse_identities(answer: Mapping[str, Any]) -> dict[str, Identity]:
    """/api/objects of a relay, or /api/topics of a client."""
    if "objects" not in answer:
        return {topic: Identity(row["type"], row["owner"]) for topic, row in answer.items() if row.get("owner")}
    found: dict[str, Identity] = {}
    for item in answer["objects"]:
        if not is_stream(item):
            continue
        topic = item["attributes"]["topic"]
        known = found.get(topic)
        owner = item["owner"] if known is None else f"{known.owner},{item['owner']}"
        found[topic] = Identity(item["type"], owner)
    return found


def compare(
    before: Mapping[str, Counts], now: Mapping[str, Counts], interval_s: float, identities: Mapping[str, Identity]
) -> list[Row]:
    """Rows by urgency and name. A topic that was not there `before`, or began anew, counts from 0."""
    rows = []
    for name, counts in now.items():
        past = before.get(name)
        if past is None or counts.received < past.received or counts.delivered < past.delivered:
            past = Counts(counts.priority)
        identity = identities.get(name)
        lately = counts.reasons - past.reasons
        rows.append(
            Row(
                topic=name,
                priority=counts.priority,
                type_name=None if identity is None else identity.type_name,
                owner=None if identity is None else identity.owner,
                relay=",".join(sorted(counts.relays)) or None,
                in_hz=(counts.received - past.received) / interval_s,
                out_hz=(counts.delivered - past.delivered) / interval_s,
                in_bytes_per_s=(counts.received_bytes - past.received_bytes) / interval_s,
                out_bytes_per_s=(counts.delivered_bytes - past.delivered_bytes) / interval_s,
                age_s=counts.age_s,
                subscribers=counts.subscribers,
                untaken=counts.untaken,
                queued=counts.queued,
                dropped=counts.reasons.total(),
                dropped_by_reason=dict(counts.reasons.most_common()),
                in_messages=counts.received,
                out_messages=counts.delivered,
                in_bytes=counts.received_bytes,
                out_bytes=counts.delivered_bytes,
                dropped_hz=lately.total() / interval_s,
                dropped_hz_by_reason={reason: count / interval_s for reason, count in lately.most_common()},
            )
        )
    return sorted(rows, key=lambda row: (CLASS_LABELS.index(row.priority), row.topic))


class Watcher:
    """Looks at one daemon again and again. `clock` in monotonic seconds."""

    def __init__(
        self,
        api: str,
        pattern: Pattern | None = None,
        *,
        services: bool = False,
        get: Callable[[str, str], Any] = get_json,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.api = api
        self._pattern = pattern
        self._services = services or pattern is not None  # who asks for a name gets it
        self._get = get
        self._clock = clock
        self._identities: dict[str, Identity] = {}
        self._asked: set[str] = set()
        self._asked_s = 0.0
        self._has_registry = True
        self._at_s, self._before = self._look()

    def _look(self) -> tuple[float, dict[str, Counts]]:
        at_s = self._clock()
        answer = self._get(self.api, "/api/topics")
        topics = parse_topics(answer)
        if not _is_relay(answer):
            self._has_registry = False
            self._identities |= parse_identities(answer)
        if self._pattern is not None:
            topics = {name: counts for name, counts in topics.items() if self._pattern.fullmatch(name)}
        if not self._services:
            topics = {name: counts for name, counts in topics.items() if parse_service(TopicName(name)) is None}
        return at_s, topics

    def rows(self) -> list[Row]:
        """What changed since the call before. Raises SernError when the daemon does not answer."""
        at_s, now = self._look()
        # The registry is large: it is read for names that are new. Some have counters and no object there, or none yet.
        missing = now.keys() - self._identities.keys()
        if self._has_registry and missing and (not missing <= self._asked or at_s - self._asked_s >= REREAD_S):
            self._asked, self._asked_s = missing, at_s
            try:
                self._identities = parse_identities(self._get(self.api, OBJECTS_PATH))
            except NotFoundError:
                self._has_registry = False
        rows = compare(self._before, now, max(at_s - self._at_s, 1e-3), self._identities)
        self._at_s, self._before = at_s, now
        return rows


def _why(row: Row) -> str:
    return " ".join(f"{reason} {count}" for reason, count in list(row.dropped_by_reason.items())[:3])


def _why_now(row: Row) -> str:
    return " ".join(f"{reason} {hz:.1f}/s" for reason, hz in list(row.dropped_hz_by_reason.items())[:3])


class Column(NamedTuple):
    """One column of the table, shown on terminals of at least `width` characters."""

    label: str
    cell: Callable[[Row], str]
    width: int = 0
    number: bool = True


UNTAKEN: Final = " *"
UNTAKEN_NOTE: Final = "* nobody here takes it: it does not come to this relay"
RELAY: Final = "relay"

COLUMNS: Final = (
    Column("topic", lambda row: row.topic + UNTAKEN * row.untaken, number=False),
    Column("class", lambda row: row.priority, number=False),
    Column("type", lambda row: row.type_name or "", 150, number=False),
    Column("owner", lambda row: row.owner or "", 110, number=False),
    Column(RELAY, lambda row: row.relay or "", 110, number=False),
    Column("in", lambda row: si(row.in_messages), 170),
    Column("in Hz", lambda row: f"{row.in_hz:.1f}" if row.in_hz else ""),
    Column("out", lambda row: si(row.out_messages), 170),
    Column("out Hz", lambda row: f"{row.out_hz:.1f}" if row.out_hz else ""),
    Column("in B", lambda row: si(row.in_bytes), 170),
    Column("in B/s", lambda row: si(row.in_bytes_per_s), 100),
    Column("out B", lambda row: si(row.out_bytes), 170),
    Column("out B/s", lambda row: si(row.out_bytes_per_s), 100),
    Column("age s", lambda row: "" if row.age_s is None else f"{row.age_s:.{3 if row.age_s < 10 else 0}f}"),
    Column("subs", lambda row: str(row.subscribers or ""), 100),
    Column("queued", lambda row: str(row.queued or ""), 100),
    Column("drops", lambda row: str(row.dropped or "")),
    Column("drop/s", lambda row: f"{row.dropped_hz:.1f}" if row.dropped_hz else ""),
    Column("why", _why, 100, number=False),
    Column("now", _why_now, 170, number=False),
)


def table(rows: list[Row], width: int = PLAIN_WIDTH) -> Table:
    """The table for a terminal of that many characters; what there is no room for is left out."""
    result = Table(box=None, pad_edge=False)
    several = any(row.relay for row in rows)
    columns = [column for column in COLUMNS if width >= column.width and (several or column.label != RELAY)]
    for column in columns:
        justify: Literal["right", "left"] = "right" if column.number else "left"
        result.add_column(column.label, no_wrap=True, justify=justify)
    for row in rows:
        result.add_row(*(Text(column.cell(row)) for column in columns))
    if any(row.untaken for row in rows):
        result.caption = Text(UNTAKEN_NOTE)
        result.caption_justify = "left"
    return result


def si(value: float) -> str:
    """A number of bytes a second in at most six characters, powers of 1000; empty for none."""
    if value < 0.5:
        return ""
    for unit in ("", "k", "M", "G"):
        if value < 999.5 or unit == "G":
            return f"{value:.0f}{unit}" if not unit or value >= 99.95 else f"{value:.1f}{unit}"
        value /= 1000
    raise AssertionError("unreachable")


def run_topics(
    api: str,
    pattern: str | None,
    *,
    watch: bool,
    as_json: bool,
    interval_s: float,
    services: bool = False,
    out: Console | None = None,
    pause: Callable[[float], None] = time.sleep,
) -> None:
    """Print the table once, or until interrupted. Raises SernError."""
    out = out or Console(highlight=False)
    if not out.is_terminal:
        out.width = PLAIN_WIDTH
    try:
        compiled = None if pattern is None else compile_pattern(pattern)
    except UsageError as error:
        raise UsageError(f"pattern {pattern!r} {error}") from None
    watcher = Watcher(checked_api(api), compiled, services=services)
    if not watch:
        pause(interval_s)
        rows = watcher.rows()
        if as_json:
            out.file.write(json.dumps([asdict(row) for row in rows], indent=1) + "\n")
        elif rows:
            out.print(table(rows, out.width))
        else:
            raise SernError(f"{watcher.api}: no topics" + ("" if pattern is None else f" that match {pattern}"))
        return
    if as_json or not out.is_terminal:
        while True:
            pause(interval_s)
            rows = watcher.rows()
            if as_json:
                out.file.write(json.dumps([asdict(row) for row in rows]) + "\n")
                out.file.flush()
            else:
                out.print(table(rows, out.width))
    with Live(console=out, auto_refresh=False, screen=True) as live:
        while True:
            pause(interval_s)
            live.update(table(watcher.rows(), out.width), refresh=True)


def topics(
    pattern: Annotated[
        str | None, typer.Argument(help="Only topics whose whole name this regular expression matches.")
    ] = None,
    api: Annotated[
        str | None,
        typer.Option(
            "--api", help="HTTP address of a relay or a client (http.listen in its file) [default: this machine's]."
        ),
    ] = None,
    watch: Annotated[bool, typer.Option("--watch", "-w", help="Again and again, until Ctrl-C.")] = False,
    services: Annotated[
        bool, typer.Option("--services", help="Also the streams of services: offers, calls, replies.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="JSON; with --watch one line a look.")] = False,
    interval_s: Annotated[
        float, typer.Option("--interval", min=MIN_INTERVAL_S, help="Seconds between two looks.")
    ] = 1.0,
) -> None:
    """List the topics at a relay or a client: class, owner, rates, age and drops. At one of several relays: the topics
    of all, and which relay the owner is at.

    Exit code 0 when listed (or ended by Ctrl-C), 1 when there is no daemon or no topic, 2 for wrong usage.
    """
    try:
        run_topics(api or local_api(), pattern, watch=watch, as_json=as_json, interval_s=interval_s, services=services)
    except KeyboardInterrupt:
        raise typer.Exit(0) from None
    except BrokenPipeError:
        drop_output()
    except SernError as error:
        raise typer.Exit(say("sern topics", error)) from None
