"""Why a topic is missing, or less of it is there than was published, in words for `sern top` and the page. Pure.

`view` puts two samples of a daemon together. A daemon knows its own half: a robot's client what leaves it, a site's
what arrives, a relay both halves of its own hops. What lies beyond is said as far as it is known, and where to look.
"""

import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Final

from sern_core.vocabulary.types import DropReason
from sern_runtime.watching.state import (
    UNKNOWN,
    Change,
    Flow,
    Json,
    LinkLine,
    Sample,
    TopicLine,
    View,
    change,
    choices,
    class_order,
    link_lines,
)
from sern_runtime.watching.words import dropped_because

OK: Final = "ok"
NOTE: Final = "note"
WARN: Final = "warn"
BAD: Final = "bad"
LEVELS: Final = (BAD, WARN, OK, NOTE)
"""In the order in which they are shown."""
LINK_REASONS: Final = frozenset({
    DropReason.SUPERSEDED, DropReason.LIFESPAN, DropReason.TOO_SLOW, DropReason.STALE, DropReason.RETENTION,
    DropReason.REFUSED, DropReason.QUEUE_FULL,
})  # fmt: skip
"""Drops of what the link was too slow for."""
ON_ARRIVAL: Final = frozenset({
    DropReason.LOST, DropReason.REASSEMBLY, DropReason.UNDECODABLE, DropReason.UNKNOWN_CHANNEL,
})  # fmt: skip
"""Drops of what came here."""
STILL_S: Final = 3.0
"""A topic of which nothing came for so long is worth a word, unless it is latched."""
DENIED: Final = 3
"""Refusals of the access rules that a relay is asked about."""
SPOOL_SHOWN: Final = 3
"""Topics of which it is said that messages are missing."""
SET_SHOWN: Final = 5
"""Topics that are shown with what is set of them by hand."""
MUCH: Final = 0.1
"""A share of what is offered whose loss is worth a word."""
NO_LINK: Final = "there is no link to the relay"
AWAY: Final = frozenset({"away", "forgotten", "never", "silent"})
LITERAL: Final = re.compile(r"(?:/[A-Za-z0-9_~]+)+")
NAMESPACED: Final = re.compile(r"(.*)\(\?:([^()|]*)\)")

Word = tuple[str, str]
"""A level, and what there is to say."""


def view(before: Sample, now: Sample) -> View:
    """What is shown after the second of two looks."""
    comparison = Comparison(before, now)
    return comparison.view(comparison.topics())


class Comparison:
    """Two looks at a daemon, of which topic by topic is judged: of thousands it takes long."""

    def __init__(self, before: Sample, now: Sample) -> None:
        self._before = before
        self._now = now
        self._interval_s = max(now.at_s - before.at_s, 1e-3)
        lines = link_lines(before, now, self._interval_s)
        self._links = lines if now.relay else [line for line in lines if line.peer == _relay_name(now)]
        self._peers = [] if now.relay else [line for line in lines if line not in self._links]
        self._situation = _Situation(now, self._links, self._peers)

    def topics(self) -> Iterator[TopicLine]:
        """A line for each topic, those included that are missing, in no order."""
        for name, flow in self._now.flows.items():
            changed = change(self._before.flows.get(name), flow, self._interval_s)
            yield _topic(name, flow, changed, self._situation)
        for name, word in self._situation.missing():
            yield _missing(name, word)

    def view(self, topics: Iterable[TopicLine]) -> View:
        """All of it, with these topics, urgent classes first, and in each what is wrong."""
        now = self._now
        in_order = sorted(topics, key=lambda line: (class_order(line.priority), LEVELS.index(line.level), line.topic))
        return View(
            now.name,
            "relay" if now.relay else "client",
            now.time,
            tuple(self._links),
            tuple(choices(now.adaptation)),
            tuple(self._peers),
            tuple(in_order),
            tuple(self._situation.notes(now.refused_total - self._before.refused_total)),
            tuple(now.events),
        )


def _relay_name(sample: Sample) -> str:
    return str(sample.links[0]["peer"]) if sample.links else ""


def _topic(name: str, flow: Flow, changed: Change, situation: "_Situation") -> TopicLine:
    level, why = situation.word(name, flow, changed)
    drops = flow.drops()
    receives = flow.receives and (not flow.sends or situation.relay or changed.received_hz > changed.delivered_hz)
    return TopicLine(
        name,
        flow.priority,
        changed.received_hz if receives else changed.delivered_hz,
        flow.received if receives else flow.delivered,
        changed.bytes_per_s,
        flow.received_bytes if receives else flow.delivered_bytes,
        flow.age_s,
        sum(changed.drops_hz.values()),
        drops.total(),
        dict(drops.most_common()),
        dict(changed.drops_hz),
        level,
        why,
    )


def _missing(name: str, word: Word) -> TopicLine:
    return TopicLine(name, UNKNOWN, 0.0, 0, 0.0, 0, None, 0.0, 0, {}, {}, *word)


class _Situation:
    """What is known of links and clients, by which a topic is judged."""

    def __init__(self, sample: Sample, links: list[LinkLine], peers: list[LinkLine]) -> None:
        self.relay = sample.relay
        self._sample = sample
        self._clients = {line.peer: line for line in (links if sample.relay else peers)}
        own = None if sample.relay or not links else links[0]
        self._down = own is not None and own.state != "connected"
        row: Mapping[str, Any] = {} if sample.relay or not sample.links else sample.links[0]
        self._refused: Mapping[str, str] = row.get("refused", {})
        self._denied: list[str] = row.get("subscriptions_refused", [])
        self._wants: list[str] = row.get("subscribed", [])
        self._stays: list[str] = row.get("stays_here", [])
        self._set: Json = row.get("by_hand", {})
        self._spool: Json = row.get("spool", {})
        self._at: Json = row.get("relay", {})
        self._summaries = {
            item["stream"].rpartition(f"/{item['kind']}")[0] or item["stream"]: item
            for item in row.get("summaries", ())
            if item["level"] != "raw"
        }

    # --- topics that there are --------------------------------------------------------------------------------------

    def word(self, name: str, flow: Flow, changed: Change) -> Word:
        """How a topic fares."""
        if self.relay:
            return self._at_relay(flow, changed)
        if flow.sends and not flow.receives:
            return self._sent(name, flow, changed)
        return self._arrives(flow, changed)

    def _sent(self, name: str, flow: Flow, changed: Change) -> Word:
        if name in self._refused:
            return BAD, f"access denied: {self._refused[name]}"
        if not flow.offered:
            return NOTE, "nothing was published yet"
        if flow.answered and not flow.wanted:
            return NOTE, "nobody subscribes to it"
        if self._down:
            return BAD, NO_LINK
        if not flow.answered:
            return WARN, "waits for the relay to say whether anybody wants it"
        found = self._dropped(flow, changed)
        item = self._summaries.get(name)
        if item is not None:
            by = "the link is too slow for whole ones" if item["by_link"] else "its rule or the adaptation says so"
            level, more = (NOTE, "") if found is None else (found[0], f"; {found[1]}")
            return level, f"sent as {item['kind']}, {by}{more}"
        if found is not None:
            return found
        if not flow.latched and not changed.offered_hz:
            return NOTE, "nothing new is published"
        return OK, ""

    def _dropped(self, flow: Flow, changed: Change) -> Word | None:
        """What is let go of, if that is worth a word."""
        offered_hz = changed.offered_hz or changed.received_hz
        slow_hz = sum(hz for reason, hz in changed.drops_hz.items() if reason in LINK_REASONS)
        where = f" to {changed.worst_peer}" if changed.worst_peer else ""
        if slow_hz > MUCH * offered_hz and slow_hz > 0:
            level = WARN if changed.delivered_hz else BAD
            reasons = ", ".join(f"{r} {hz:.1f}/s" for r, hz in changed.drops_hz.items() if r in LINK_REASONS)
            some = "only part of it fits" if changed.delivered_hz else "it does not fit"
            return level, f"{some} the link{where}: {reasons}"
        capped_hz = changed.drops_hz.get(DropReason.RATE_CAP, 0.0)
        if capped_hz > MUCH * offered_hz:
            passed_hz = max(0.0, offered_hz - capped_hz)
            let_in = f"{passed_hz:.1f} of {offered_hz:.1f} Hz are let in"
            if changed.thinned_hz > MUCH * offered_hz:
                return WARN, f"thinned by the adaptation{where}: {let_in}"
            cap = "" if flow.max_rate_hz is None else f" {flow.max_rate_hz:g}"
            return NOTE, f"rate cap (max_rate_hz{cap}): {let_in}"
        other = {r: hz for r, hz in changed.drops_hz.items() if r not in LINK_REASONS and r != DropReason.RATE_CAP}
        if sum(other.values()) > MUCH * offered_hz:
            reason, hz = next(iter(other.items()))
            where = "" if reason in ON_ARRIVAL else where
            return WARN, f"{hz:.1f}/s dropped{where} ({reason}): {dropped_because(reason)}"
        return None

    def _arrives(self, flow: Flow, changed: Change) -> Word:
        if self._down:
            return BAD, NO_LINK
        gone = self._gone(flow.owners)
        if gone:
            return BAD, gone
        if not flow.owners:
            return NOTE, "its publisher has ended it"
        lost_hz = sum(hz for reason, hz in changed.drops_hz.items())
        if lost_hz > MUCH * (changed.received_hz + lost_hz):
            reason, hz = next(iter(changed.drops_hz.items()))
            return WARN, f"{hz:.1f}/s dropped on arrival ({reason}): {dropped_because(reason)}"
        if not flow.received:
            return WARN, f"announced by {_names(flow.owners)}, and nothing came yet"
        return self._still(flow, changed)

    def _still(self, flow: Flow, changed: Change) -> Word:
        if flow.latched or changed.received_hz or flow.age_s is None or flow.age_s < STILL_S:
            return OK, ""
        who = _names(flow.owners) or "its publisher"
        verb = "are" if len(flow.owners) > 1 else "is"
        return WARN, f"nothing for {span(flow.age_s)}, though {who} {verb} connected: look at `sern top` there"

    def _at_relay(self, flow: Flow, changed: Change) -> Word:
        gone = self._gone(flow.owners)
        if gone:
            return BAD, gone
        if not flow.announced:
            return NOTE, "its publisher has ended it"
        if flow.untaken:
            return NOTE, "nobody subscribes to it"
        found = self._dropped(flow, changed)
        if found is not None:
            return found
        if not flow.received:
            return NOTE, f"announced by {_names(flow.owners)}, and nothing came yet"
        return self._still(flow, changed)

    def _gone(self, owners: tuple[str, ...]) -> str:
        """Words that all who publish it are away; empty: they are not. Why is said once, beside the client."""
        lines = [self._clients.get(owner) for owner in owners]
        away = [line for line in lines if line is not None and line.state in AWAY]
        if not owners or len(away) < len(owners):
            return ""
        first = away[0]
        how_long = "" if first.since_s is None else f" for {span(first.since_s)}"
        return f"{first.peer} " + ("does not answer" if first.state == "silent" else f"is gone{how_long}")

    # --- topics that there are not ----------------------------------------------------------------------------------

    def missing(self) -> Iterator[tuple[str, Word]]:
        """Topics that this client asks for by name, and that nobody announces to it."""
        for pattern in self._wants:
            name = literal(pattern)
            if name is None or name in self._sample.flows:
                continue
            denied = next((text for text in self._denied if name in text.replace(":", " ").split()), None)
            owner = name.split("/")[1]
            if denied is not None:
                yield name, (BAD, f"access denied: {denied}")
            elif self._down:
                yield name, (BAD, NO_LINK)
            elif gone := self._gone((owner,)):
                yield name, (BAD, gone)
            elif owner == self._sample.name:
                yield name, (WARN, "nobody publishes it to here: no site is there that does, or none may")
            elif owner in self._clients:
                yield name, (BAD, f"{owner} is connected and does not offer it; see `sern top` there, and the relay's")
            else:
                yield name, (BAD, f"nobody announces it: {owner} never came, does not offer it, or may not")

    def notes(self, refused: int) -> Iterator[Word]:
        """What is said of no single topic."""
        if self._stays:
            some = ", ".join(self._stays[:3]) + (", ..." if len(self._stays) > 3 else "")
            yield NOTE, f"stays here, as no rule in `topics` names it: {some}"
        yield from _by_hand(self._set)
        yield from _of_spool(self._spool)
        yield from _at_relay(self._at)
        names = {literal(pattern) for pattern in self._wants}
        for text in self._denied:
            if not any(name in text.replace(":", " ").split() for name in names if name):
                yield BAD, f"access denied: {text}"
        if self.relay:
            denied = [event for event in self._sample.events if event["kind"] == "denied"]
            for text in list(dict.fromkeys(event["text"] for event in denied))[-DENIED:]:
                yield BAD, text.partition(": ")[2]
        if refused > 0:
            yield WARN, f"{refused} connections were refused just now: `sern clients` says whose"


def _by_hand(said: Json) -> Iterator[Word]:
    """What somebody has set at the daemon and no file says."""
    for name, keys in list(said.get("topics", {}).items())[:SET_SHOWN]:
        words = " ".join(f"{key}={value}" for key, value in keys.items())
        waits = ", once what it owes is delivered" if name in said.get("changing", ()) else ""
        yield NOTE, f"set by hand: {name} {words}{waits}"
    more = len(said.get("topics", {})) - SET_SHOWN
    if more > 0:
        yield NOTE, f"set by hand: {more} more topics; `sern set` lists them"
    if said.get("profile"):
        yield NOTE, f"set by hand: profile {said['profile']}"


def _of_spool(said: Json) -> Iterator[Word]:
    """What a client keeps for later, or lacks of what a robot has kept."""
    if said.get("problem"):
        yield BAD, f"spool: {said['problem']}"
    if said.get("kept_messages"):
        yield NOTE, f"spool: {said['kept_messages']:,} messages are kept here, {said['kept_bytes'] / 1e6:,.1f} MB"
    lacking = sorted(said.get("missing", {}).items(), key=lambda item: (-item[1], item[0]))
    for topic, messages in lacking[:SPOOL_SHOWN]:
        yield NOTE, f"spool: {messages:,} messages of {topic} are at its robot and not here yet"
    if len(lacking) > SPOOL_SHOWN:
        yield NOTE, f"spool: and of {len(lacking) - SPOOL_SHOWN} more topics; `sern spool ls` lists them"


def _at_relay(said: Json) -> Iterator[Word]:
    """Words of which of several relays a client is at."""
    if len(said.get("relays", ())) < 2:
        return
    moves = f"; it moved {said['moves']} times" if said["moves"] else ""
    where = f"{said['name']}, {said['address']}" if said["name"] else said["address"]
    if said["preferred"]:
        yield NOTE, f"at the preferred relay ({where}){moves}"
        return
    first = said["relays"][0]
    answers = f"has answered for {span(first['answering_s'])}" if first["answering_s"] is not None else first["why"]
    yield WARN, f"at another relay ({where}) than the preferred one, {first['address']}: {answers}{moves}"


def literal(pattern: str) -> str | None:
    """The one topic that a pattern matches, where that can be seen from it; None: it may match several."""
    found = NAMESPACED.fullmatch(pattern)
    text = pattern if found is None else found[1] + found[2]
    return text if LITERAL.fullmatch(text) else None


def _names(owners: tuple[str, ...]) -> str:
    return ", ".join(owners[:2]) + (f" and {len(owners) - 2} more" if len(owners) > 2 else "")


def span(seconds: float) -> str:
    """A time span for a sentence."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.0f} h"
