"""What `sern top` and the page show, out of what a daemon tells: two looks at its counters make rates, and each topic
gets a word.

Pure: `read` turns answers into a `Sample`; who has the rows before they are an answer puts those of topics into a
`FlowTable`, one at a time. Why a topic is not there, or less of it than there was, is `why`'s.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

from sern_core.site.services import parse as parse_service
from sern_core.vocabulary.types import CLASS_LABELS, TopicName

NOT_LOSSES: Final = frozenset({"duplicate", "unwanted"})
"""Reasons that are counted apart: nobody misses these messages."""
EVENTS: Final = 50
UNKNOWN: Final = "?"
"""The class of a topic that nobody announces."""
Json = Mapping[str, Any]


@dataclass(slots=True)
class Flow:
    """A topic's counters at one time, and what is known of it. `reasons` are of drops on the way out, by the peer."""

    priority: str
    sends: bool = False
    receives: bool = False
    wanted: bool = False
    answered: bool = True
    announced: bool = True
    untaken: bool = False
    latched: bool = False
    owners: tuple[str, ...] = ()
    max_rate_hz: float | None = None
    thinned: int = 0
    offered: int = 0
    delivered: int = 0
    delivered_bytes: int = 0
    received: int = 0
    received_bytes: int = 0
    queued: int = 0
    age_s: float | None = None
    reasons: dict[str, Counter[str]] = field(default_factory=dict)
    lost: Counter[str] = field(default_factory=Counter)
    """Drops of what arrived, by reason."""

    def drops(self) -> Counter[str]:
        """All of them, by reason."""
        total = Counter(self.lost)
        for reasons in self.reasons.values():
            total.update(reasons)
        return Counter({reason: count for reason, count in total.items() if reason not in NOT_LOSSES})


@dataclass(frozen=True, slots=True)
class Sample:
    """What a daemon said at one time, `at_s` on the reader's monotonic clock."""

    at_s: float
    time: str
    name: str
    relay: bool
    flows: Mapping[str, Flow]
    links: Sequence[Json]
    clients: Sequence[Json]
    adaptation: Json | None
    events: Sequence[Json]
    refused_total: int


@dataclass(frozen=True, slots=True)
class LinkLine:
    """One link. `state` as in /api/clients; rates in bit/s and bytes a second."""

    peer: str
    state: str
    why: str
    lane: str | None
    capacity_bps: float | None
    round_trip_s: float | None
    loss: float | None
    waiting_bytes: int
    sent_bytes: int | None
    sent_bytes_per_s: float | None
    received_bytes: int | None
    received_bytes_per_s: float | None
    since_s: float | None
    heard_s: float | None


@dataclass(frozen=True, slots=True)
class Choice:
    """What the adaptation has chosen for a link, in words, and why."""

    peer: str
    text: str
    reason: str


@dataclass(frozen=True, slots=True)
class TopicLine:
    """One topic, with a rate beside each total. `level`: ok, note, warn or bad; `why` says what is not as one may
    expect, and is empty for ok."""

    topic: str
    priority: str
    hz: float
    messages: int
    bytes_per_s: float
    bytes: int
    age_s: float | None
    drops_hz: float
    drops: int
    reasons: Mapping[str, int]
    reasons_hz: Mapping[str, float]
    level: str
    why: str


@dataclass(frozen=True, slots=True)
class View:
    """Everything that is shown. `peers` are whom a client knows beside its relay; `notes` are (level, text)."""

    name: str
    role: str
    time: str
    links: tuple[LinkLine, ...]
    choices: tuple[Choice, ...]
    peers: tuple[LinkLine, ...]
    topics: tuple[TopicLine, ...]
    notes: tuple[tuple[str, str], ...]
    events: tuple[Json, ...]


def class_order(priority: str) -> int:
    """Urgent classes first, and before them what is asked for and not there."""
    return CLASS_LABELS.index(priority) if priority in CLASS_LABELS else -1


# --- reading answers --------------------------------------------------------------------------------------------------


def read(
    at_s: float,
    clients: Json,
    links: Sequence[Json],
    topics: Json,
    adaptation: Json | None = None,
    events: Sequence[Json] = (),
) -> Sample:
    """Out of /api/clients, /api/link, /api/topics, /api/mmcf (None: there is none) and /api/events."""
    flows = FlowTable(relay=clients["role"] == "relay")
    for part in topic_parts(topics):
        flows.add(part)
    return sample(at_s, clients, clients["clients"], links, flows, adaptation, events)


class TopicPart(NamedTuple):
    """One row of /api/topics. `table`: that of a relay where it is (`links`, of `peer`; `received`; `announced`), or
    `client`."""

    table: str
    peer: str
    topic: str
    row: Json


def topic_parts(topics: Json) -> Iterator[TopicPart]:
    """The rows of /api/topics."""
    if not (topics.keys() >= {"links", "received", "announced"}):
        for name, row in topics.items():
            yield TopicPart("client", "", name, row)
        return
    for client, rows in topics["links"].items():
        for name, row in rows.items():
            yield TopicPart("links", client, name, row)
    for table in ("received", "announced"):
        for name, row in topics[table].items():
            yield TopicPart(table, "", name, row)


class FlowTable:
    """What is known of each topic, out of rows in any order. Streams of services are none."""

    def __init__(self, *, relay: bool) -> None:
        self.relay = relay
        self.flows: dict[str, Flow] = {}

    def add(self, part: TopicPart) -> None:
        name, row = part.topic, part.row
        flow = self.flows.get(name)
        if flow is None:
            if parse_service(TopicName(name)) is not None:
                return
            flow = self.flows[name] = Flow(row["class"], announced=not self.relay)
        match part.table:
            case "links":
                _sent(flow, part.peer, row)
            case "received":
                _arrived(flow, row)
            case "announced":
                flow.announced = True
                flow.untaken = not row["taken"]
                flow.owners = tuple(sorted(row["owners"]))
                flow.latched = row["latched"]
            case _:
                _of_client(flow, row)


def sample(
    at_s: float,
    head: Json,
    clients: Sequence[Json],
    links: Sequence[Json],
    flows: FlowTable,
    adaptation: Json | None,
    events: Sequence[Json],
) -> Sample:
    """A sample of parts that were read one by one; `head` is /api/clients without its rows."""
    return Sample(
        at_s,
        head["time"],
        head["name"],
        flows.relay,
        flows.flows,
        links,
        clients,
        adaptation,
        tuple(events),
        head["refused_total"],
    )


def _of_client(flow: Flow, row: Json) -> None:
    flow.latched = row["latched"]
    flow.owners = tuple(owner for owner in row["owner"].split(",") if owner)
    if row["direction"] == "send":
        _sent(flow, "", row)
        if "received" in row:
            _arrived(flow, row["received"])
    else:
        _arrived(flow, row)


def _sent(flow: Flow, peer: str, row: Json) -> None:
    flow.sends = True
    flow.wanted = flow.wanted or row["wanted"]
    flow.answered = row["answered"]
    flow.max_rate_hz = row["max_rate_hz"]
    flow.thinned += row["thinned"]
    flow.offered += row["offered"]
    flow.delivered += row["delivered"]
    flow.delivered_bytes += row["bytes_delivered"]
    flow.queued += row["in_queue"] + row["in_flight"]
    reasons: Counter[str] = Counter(row["dropped"])
    if row["refused"]:
        reasons["refused"] = row["refused"]
    flow.reasons[peer] = reasons


def _arrived(flow: Flow, row: Json) -> None:
    flow.receives = True
    flow.received += row["delivered"]
    flow.received_bytes += row["bytes_delivered"]
    flow.age_s = row["age_s"]
    flow.lost.update(row["dropped"])


# --- between two looks ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Change:
    """What a topic did between two looks, a second: `let_go` is what left its way out by reason, for whom most."""

    offered_hz: float
    delivered_hz: float
    received_hz: float
    thinned_hz: float
    unwanted_hz: float
    drops_hz: Mapping[str, float]
    bytes_per_s: float
    worst_peer: str
    """The peer for whom most was dropped; empty: nothing was, or there is only one."""


def change(before: Flow | None, now: Flow, interval_s: float) -> Change:
    """A topic that was not there before, or began anew, counts from 0."""
    if before is None or now.offered < before.offered or now.received < before.received:
        before = Flow(now.priority)
    per_s = 1.0 / interval_s
    by_peer: dict[str, Counter[str]] = {}
    for peer, reasons in now.reasons.items():
        by_peer[peer] = Counter(reasons) - before.reasons.get(peer, Counter())
    lost = now.lost - before.lost
    total = sum(by_peer.values(), Counter(lost))
    real = {reason: count * per_s for reason, count in total.most_common() if reason not in NOT_LOSSES}
    worst = max(by_peer, key=lambda peer: sum(n for r, n in by_peer[peer].items() if r not in NOT_LOSSES), default="")
    out_bytes, in_bytes = now.delivered_bytes - before.delivered_bytes, now.received_bytes - before.received_bytes
    nbytes = in_bytes if not now.sends or in_bytes > out_bytes else out_bytes
    return Change(
        (now.offered - before.offered) * per_s,
        (now.delivered - before.delivered) * per_s,
        (now.received - before.received) * per_s,
        max(0, now.thinned - before.thinned) * per_s,
        total["unwanted"] * per_s,
        real,
        nbytes * per_s,
        worst if real else "",
    )


def link_lines(before: Sample, now: Sample, interval_s: float) -> list[LinkLine]:
    """Every client or peer, with what is known of the link to it."""
    by_peer = {row["peer"]: row for row in now.links}
    past = {row["name"]: row for row in before.clients}
    lines = []
    for row in now.clients:
        link = by_peer.get(row["name"])
        up = row["state"] == "connected"
        rate = None if link is None or not up else link.get("rate_bps") or _known(now.adaptation, row["name"])
        earlier = past.get(row["name"], {})
        lines.append(
            LinkLine(
                peer=row["name"],
                state=row["state"],
                why=row["why"] or (link or {}).get("why", ""),
                lane=row["lane"],
                capacity_bps=rate,
                round_trip_s=row["round_trip_s"],
                loss=row["loss"],
                waiting_bytes=0 if link is None else sum(part["bytes"] for part in link["queue"].values()),
                sent_bytes=row["sent_bytes"],
                sent_bytes_per_s=_rate(earlier.get("sent_bytes"), row["sent_bytes"], interval_s),
                received_bytes=row["received_bytes"],
                received_bytes_per_s=_rate(earlier.get("received_bytes"), row["received_bytes"], interval_s),
                since_s=row["since_s"],
                heard_s=row["heard_s"],
            )
        )
    return lines


def _known(adaptation: Json | None, peer: str) -> float | None:
    """What the adaptation takes the link to carry, where the link was never full."""
    for link in () if adaptation is None else adaptation["links"]:
        if link["peer"] == peer and link["history"]:
            capacity: float | None = link["history"][-1]["link"]["capacity_bps"]
            return capacity
    return None


def _rate(before: int | None, now: int | None, interval_s: float) -> float | None:
    if now is None:
        return None
    return (now - (before if before is not None and before <= now else 0)) / interval_s


def choices(adaptation: Json | None) -> list[Choice]:
    """What the adaptation has in force, and what it said of it last."""
    found = []
    for link in () if adaptation is None else adaptation["links"]:
        last = link["history"][-1] if link["history"] else None
        found.append(Choice(link["peer"], in_words(link["configuration"]), "" if last is None else str(last["reason"])))
    return found


def in_words(configuration: Json) -> str:
    """A configuration without its letters: what is let in, how it is compressed, what goes twice or as a summary."""
    thin = [f"{label} {share:.0%}" for label, share in configuration["rates"].items() if share < 1.0]
    parts = [f"let in: {', '.join(thin)}" if thin else "everything is let in"]
    codec = configuration["codec"]
    parts.append("no compression" if codec == "none" else f"compressed: {codec}")
    if configuration["redundancy"]:
        parts.append("control twice")
    levels = configuration["summaries"] or {}
    whole = [label for label in CLASS_LABELS if levels.get(label)]
    if whole:
        parts.append(f"summaries: {', '.join(whole)}")
    return "; ".join(parts)
