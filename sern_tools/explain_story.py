"""Sentences out of the records of a decision trace: what became of the messages of a topic, and why.

`lives` puts the records of one topic together, message by message; `lines` says each in a sentence, those that had
the same fate for the same reason in one, with what happened to the link in between.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from sern_core.vocabulary.trace import HoldReason, TraceEvent
from sern_core.vocabulary.types import DropReason
from sern_runtime.watching.words import dropped_because

Record = Mapping[str, Any]
"""A record as /api/trace tells it."""

BRIEF_S: Final = 0.02
"""Waiting for less than this is not worth a word."""

LINK_EVENTS: Final = frozenset({
    TraceEvent.LINK_UP, TraceEvent.LINK_DOWN, TraceEvent.LANE_USED, TraceEvent.LANE_SILENT, TraceEvent.LANE_ANSWERS,
    TraceEvent.CAPACITY, TraceEvent.LEASE_EXPIRED, TraceEvent.SUMMARISED, TraceEvent.WHOLE,
})  # fmt: skip
"""What is about no single message."""

NAMES: Final[Mapping[str, str]] = {
    HoldReason.LINK_DOWN: "a connection",
    HoldReason.SILENT: "a silent link",
    HoldReason.ANNOUNCEMENT: "the announcement",
    HoldReason.DEFINITION: "the definition",
    HoldReason.CONTROL: "the link's own messages",
    HoldReason.WINDOW: "room on the link",
    HoldReason.PACING: "room on the link",
    HoldReason.CLASS: "a more urgent class",
    HoldReason.OUTRANKED: "another topic of the class",
    HoldReason.FLOOR: "a less urgent class's little",
    HoldReason.SHARE: "class control's share",
    HoldReason.INTERVAL: "the interval",
    HoldReason.ENCODER: "compression",
    HoldReason.RATE_CAP: "max_rate_hz",
    HoldReason.ADAPTATION: "the adaptation",
}
"""What was waited for, in two or three words."""

ADVICE: Final[Mapping[str, str]] = {
    HoldReason.LINK_DOWN: "see the daemon's log for why the relay is not reached",
    HoldReason.SILENT: "the path is gone or blocked: nothing sent comes back; wait, or move",
    HoldReason.DEFINITION: "it goes once the text of its type is across; a thin link takes a while",
    HoldReason.WINDOW: "the link carries no more: send less, or a summary of it (docs/adaptation.md)",
    HoldReason.PACING: "the link carries no more: send less, or a summary of it (docs/adaptation.md)",
    HoldReason.CLASS: "if it matters more than that, give it a more urgent class in `topics`",
    HoldReason.OUTRANKED: "if it matters more than that, give it a more urgent class or a greater weight in `topics`",
    HoldReason.FLOOR: "the link carries no more: send less, or a summary of it (docs/adaptation.md)",
    HoldReason.SHARE: "class control has more than its share: move topics to class state, or thin them (max_rate_hz)",
    HoldReason.INTERVAL: "ordering `paper` sends only what fits an interval whole; `class` sends it in parts",
    HoldReason.ENCODER: "the CPU is the limit: a faster compression, or none, for the large topics",
    HoldReason.RATE_CAP: "raise max_rate_hz in `topics` if it must be more",
    HoldReason.ADAPTATION: "`sern explain` without a topic says why the adaptation thins",
    DropReason.UNWANTED: "`sern topics` says who takes it; a site's file names it in `subscribe`",
    DropReason.FORBIDDEN: "see `access` in the relay's file",
    DropReason.TOO_LARGE: "raise link.max_message_bytes at both ends and the relay",
    DropReason.QUEUE_FULL: "see access.max_queue_bytes in the relay's file",
    DropReason.REFUSED: "the link has not carried it away: a thinner topic, or a larger max_queue_bytes",
    DropReason.STORAGE: "make room where the recording goes",
    DropReason.E_STOP: "release it by name where that is safe (sern release)",
    DropReason.NOT_HOLDER: "take it over (sern take)",
    DropReason.TOO_SLOW: "thin it, send a summary of it (docs/summaries.md), or give it a longer lifespan_s",
}
"""What to do about it, by the reason of what is held or dropped now."""


@dataclass
class Life:
    """What is known of one message. `way` is "out", or "in" for what arrived here."""

    seq: int
    way: str
    origin: str
    first_s: float
    peer: str = ""
    size_bytes: int | None = None
    replay: bool = False
    holds: dict[str, Record] = field(default_factory=dict)
    """The last record of each reason to wait, the latest last."""
    held_s: float | None = None
    encoding_s: float | None = None
    begun_s: float | None = None
    sent_s: float | None = None
    acked_s: float | None = None
    confirmed_s: float | None = None
    delivered: Record | None = None
    ended: Record | None = None
    """What dropped it, left it out or refused it."""
    lost: int = 0
    last_s: float = 0.0


def rate(value: float | None) -> str:
    """Bits a second as a person writes them."""
    if value is None:
        return "unknown"
    for unit, size in (("Mbit/s", 1e6), ("kbit/s", 1e3)):
        if value >= size:
            return f"{value / size:.3g} {unit}"
    return f"{value:.0f} bit/s"


def size(nbytes: float) -> str:
    """Bytes as a person writes them."""
    for unit, base in (("MB", 1e6), ("kB", 1e3)):
        if nbytes >= base:
            return f"{nbytes / base:.3g} {unit}"
    return f"{nbytes:.0f} B"


def span(seconds: float) -> str:
    """A time that something took."""
    if seconds < 0.0995:
        return f"{1e3 * seconds:.0f} ms"
    return f"{seconds:.1f} s" if seconds < 99.95 else f"{seconds:.0f} s"


def held_because(record: Record) -> str:
    """Why a message was held, for what the record of that says, or what /api/trace says of a stream now."""
    reason = record["reason"]
    after = f"{record.get('after', 'another topic')} ({record.get('after_class', '?')})"
    carries = f", which carries {rate(record['rate_bps'])}" if "rate_bps" in record else ""
    match reason:
        case HoldReason.LINK_DOWN:
            return "there is no connection"
        case HoldReason.SILENT:
            return "the link is silent: nothing is acknowledged"
        case HoldReason.ANNOUNCEMENT:
            return "the other end has not said yet whether it wants the topic"
        case HoldReason.DEFINITION:
            return "the other end is still being sent the definition of its type"
        case HoldReason.CONTROL:
            return "the link's own messages (announcements, answers) go first"
        case HoldReason.WINDOW:
            under_way = f"{size(record['inflight_bytes'])} are under way on " if "inflight_bytes" in record else ""
            return f"{under_way}a full link{carries}" if under_way else f"the link is full{carries}"
        case HoldReason.PACING:
            return f"its turn on a full link{carries}"
        case HoldReason.CLASS:
            return f"{after} goes first"
        case HoldReason.OUTRANKED:
            return f"{after}, of the same class, goes first"
        case HoldReason.FLOOR:
            return f"{after} gets the little that every class is given"
        case HoldReason.SHARE:
            return f"class control has used up its share of the link, and {after} wants it too"
        case HoldReason.INTERVAL:
            return "it does not fit into this interval (ordering: paper)"
        case HoldReason.ENCODER:
            return "its turn to be compressed"
        case HoldReason.RATE_CAP:
            return f"max_rate_hz lets {record.get('rate_hz', 0):g} a second through"
        case HoldReason.ADAPTATION:
            return f"the adaptation lets {record.get('share', 0):.0%} of the messages in"
    return str(reason)


# --- putting records together -----------------------------------------------------------------------------------------


def lives(records: Iterable[Record]) -> list[Life]:
    """The messages that the records of one topic are about, in the order of their first record."""
    found: dict[tuple[str, str, str, int], Life] = {}
    holds: dict[tuple[str, str, str], Record] = {}  # what a stream waits for now
    for record in records:
        event = TraceEvent(record["event"])
        if event in LINK_EVENTS:
            if event is TraceEvent.LINK_UP:
                holds.clear()
            continue
        way = "out" if "peer" in record else "in"
        stream = (way, record.get("peer", ""), record.get("origin", ""))
        if event is TraceEvent.CONFIRMED:
            for key, each in found.items():
                if key[:3] == stream and each.seq <= record["seq"] and each.ended is None and each.confirmed_s is None:
                    each.confirmed_s = each.last_s = record["now_s"]
            continue
        if not record["seq"]:
            continue
        life = found.get((*stream, record["seq"]))
        begins = event in (TraceEvent.QUEUED, TraceEvent.REPLAYED) and life is not None and life.ended is not None
        if life is None or begins:
            life = Life(record["seq"], way, stream[2], record["now_s"], peer=stream[1])
            found.pop((*stream, record["seq"]), None)  # the same number again, of a stream that began anew
            found[(*stream, record["seq"])] = life
        _note(life, event, record, holds.get(stream))
        if event is TraceEvent.HELD:
            holds[stream] = record
        elif event in (TraceEvent.SENT, TraceEvent.BEGUN):
            holds.pop(stream, None)
    return list(found.values())


def _note(life: Life, event: TraceEvent, record: Record, hold: Record | None) -> None:
    now_s = life.last_s = record["now_s"]
    if "size_bytes" in record and life.size_bytes is None:
        life.size_bytes = record["size_bytes"]
    if event is TraceEvent.REPLAYED:
        life.replay = True
    elif event is TraceEvent.HELD:
        life.holds.pop(record["reason"], None)
        life.holds[record["reason"]] = record
        life.held_s = now_s if life.held_s is None else life.held_s
    elif event is TraceEvent.ENCODING:
        life.encoding_s = now_s
    elif event is TraceEvent.BEGUN:
        life.begun_s = now_s
    elif event is TraceEvent.SENT:
        life.sent_s = now_s
        life.begun_s = now_s if life.begun_s is None else life.begun_s
    elif event is TraceEvent.ACKED:
        life.acked_s = now_s
    elif event is TraceEvent.LOST:
        life.lost += record.get("fragments", 1)
    elif event is TraceEvent.DELIVERED:
        life.delivered = record
    elif event in (TraceEvent.DROPPED, TraceEvent.RATE_CAPPED, TraceEvent.REFUSED):
        life.ended = record
    if hold is not None and not life.holds and life.begun_s is None and event is not TraceEvent.HELD:
        life.holds[hold["reason"]] = hold  # what was before it in its stream waited for that, and so did it


# --- saying it --------------------------------------------------------------------------------------------------------


def fate(life: Life) -> str:
    """What became of a message, without times: messages alike are told of together."""
    if life.ended is not None:
        if life.ended["event"] == TraceEvent.RATE_CAPPED:
            return f"left out: {held_because(life.ended)}"
        if life.ended["event"] == TraceEvent.REFUSED:
            return f"refused: the topic's queue is full ({life.ended.get('waiting', 0)} wait), the publisher was told"
        return f"dropped: {dropped_because(life.ended['reason'])}"
    if life.delivered is not None:
        return f"arrived here from {life.origin}"
    if life.confirmed_s is not None:
        return "confirmed: everybody has it"
    if life.acked_s is not None:
        return f"arrived at {life.peer}"
    if life.sent_s is not None:
        return f"sent to {life.peer}, not acknowledged yet"
    if life.begun_s is not None:
        return f"being sent to {life.peer}"
    if life.encoding_s is not None:
        return "being compressed"
    if life.holds:
        return f"waits: {held_because(last_hold(life))}"
    return "waits in its queue"


def last_hold(life: Life) -> Record:
    """The newest reason for which it was held."""
    return next(reversed(life.holds.values()))


def sentence(life: Life) -> str:
    """The whole way of a message in one line."""
    parts = []
    if life.replay:
        parts.append("is sent again to a late joiner")
    waited_s = (life.begun_s if life.begun_s is not None else life.last_s) - life.first_s
    over = life.begun_s is not None or life.ended is not None
    if life.holds and over and (waited_s >= BRIEF_S or life.ended is not None):
        causes = "; ".join(dict.fromkeys(held_because(record) for record in life.holds.values()))
        parts.append(f"waited {span(waited_s)} ({causes})")
    elif waited_s >= BRIEF_S and life.begun_s is not None:
        parts.append(f"waited {span(waited_s)}")
    if life.encoding_s is not None and over:
        parts.append("was compressed")
    if life.lost:
        parts.append(f"lost {life.lost} {'fragment' if life.lost == 1 else 'fragments'}, which went again")
    told = fate(life)
    if life.delivered is not None and life.ended is None:
        told += f", {span(life.delivered['age_s'])} old"
    elif life.ended is None and life.acked_s is not None:
        done_s = life.acked_s if life.confirmed_s is None else life.confirmed_s
        told += f" after {span(done_s - life.first_s)}"
    return ", ".join([*parts, told])


def link_sentence(record: Record) -> str:
    """What happened to the link, to a lease, or to what a topic is sent as."""
    lane = record.get("lane", "")
    match TraceEvent(record["event"]):
        case TraceEvent.LINK_UP:
            return f"connected to {record['peer']}"
        case TraceEvent.LINK_DOWN:
            return f"connection to {record['peer']} ended: {record.get('reason', '?')}"
        case TraceEvent.LANE_USED:
            return f"{record.get('what', 'data')} goes over the {lane} lane from here on"
        case TraceEvent.LANE_SILENT:
            return f"the {lane} lane fell silent: nothing is acknowledged"
        case TraceEvent.LANE_ANSWERS:
            return f"the {lane} lane answers again"
        case TraceEvent.CAPACITY:
            return f"carries about {rate(record['rate_bps'])}, round trip {span(record['rtt_s'])}"
        case TraceEvent.LEASE_EXPIRED:
            return f"no fresh command for {span(record['after_s'])}: the stop command was published"
        case TraceEvent.SUMMARISED:
            late = f"within the topic's lifespan of {span(record['lifespan_s'])}"
            return f"too slow for {record['name']} to arrive {late}: its summary goes in its place from here on"
        case TraceEvent.WHOLE:
            return f"carries {record['name']} in time: it goes as it comes from here on"
    return str(record["event"])


def _alike(life: Life) -> tuple[object, ...]:
    """Neighbours for which this is equal are told of in one line."""
    calm = life.ended is None and not life.lost and not life.replay
    hold = last_hold(life)["reason"] if life.holds else None
    if calm and life.acked_s is not None:
        hold = None
    return life.way, life.peer, life.origin, fate(life), hold, life.lost


def lines(records: Sequence[Record], *, now_s: float, last: int) -> Iterator[str]:
    """The last messages of one topic, the newest last, and what happened to the link meanwhile. Times are how long ago.

    Messages next to each other that fared alike share one of `last` lines. What happened to the link has at most as
    many beside: of a quiet topic on a restless link the messages are what was asked for.
    """
    told = lives(records)
    runs: list[list[Life]] = []
    for life in told:
        if runs and _alike(runs[-1][0]) == _alike(life):
            runs[-1].append(life)
        else:
            runs.append([life])
    runs = runs[-last:]
    entries = [(run[0].first_s, 1, _run_line(run)) for run in runs]
    since_s = entries[0][0] if entries else now_s
    link = [record for record in records if TraceEvent(record["event"]) in LINK_EVENTS]
    before = [record for record in link if record["now_s"] < since_s][-1:]
    seen = [*before, *(record for record in link if record["now_s"] >= since_s)]
    older, newest = seen[:-last], seen[-last:]
    if older:
        entries.append(
            (older[-1]["now_s"], 0, f"{'link':>13} {'':>8}  {len(older)} changes up to here (--last shows more)")
        )
    entries += [(record["now_s"], 0, f"{'link':>13} {'':>8}  {link_sentence(record)}") for record in newest]
    for at_s, _order, text in sorted(entries, key=lambda entry: entry[:2]):
        yield f"{_ago(now_s - at_s):>9}  {text}"


def _ago(seconds: float) -> str:
    return f"{max(seconds, 0.0):.1f} s" if seconds < 1000 else f"{seconds / 60:.0f} min"


def _run_line(run: Sequence[Life]) -> str:
    first, final = run[0], run[-1]
    told = size(first.size_bytes) if first.size_bytes is not None else ""
    if len(run) == 1:
        return f"{first.seq:>13} {told:>8}  {sentence(first)}"
    numbers = f"{first.seq}-{final.seq}"
    taken = span(final.first_s - first.first_s)
    return f"{numbers:>13} {told:>8}  {len(run)} messages in {taken}, the last: {sentence(final)}"


def in_short(records: Iterable[Record]) -> str:
    """How the messages that are on record fared, and what they waited for, by number; empty: there are none."""
    told = lives(records)
    if not told:
        return ""
    fates = Counter(_outcome(life) for life in told)
    causes = Counter(reason for life in told if life.ended is not None for reason in life.holds)
    text = f"of {len(told)} messages " + ", ".join(f"{count} {word}" for word, count in fates.most_common())
    if causes:
        words = ", ".join(f"{NAMES.get(reason, reason)} {count}" for reason, count in causes.most_common())
        text += f"; those dropped had waited for: {words}"
    return text


def _outcome(life: Life) -> str:
    if life.ended is not None:
        word = "refused" if life.ended["event"] == TraceEvent.REFUSED else "dropped"
        return f"{word} ({life.ended.get('reason', 'queue full')})"
    if life.acked_s is not None or life.confirmed_s is not None or life.delivered is not None:
        return "arrived"
    if life.sent_s is not None:
        return "sent"
    return "being sent" if life.begun_s is not None else "waiting"


def verdict(records: Sequence[Record]) -> str:
    """What became of the last message, in one line."""
    told = lives(records)
    if not told:
        return "nothing is recorded of its messages"
    final = told[-1]
    return f"message {final.seq} {sentence(final)}"


def advice(records: Sequence[Record], standing: Mapping[str, Any] | None) -> str:
    """What to do about what is held now, or was dropped last; empty: nothing."""
    if standing is not None and standing.get("reason") in ADVICE:
        return ADVICE[standing["reason"]]
    told = lives(records)
    if not told:
        return ""
    final = told[-1]
    if final.ended is None:
        return ADVICE.get(last_hold(final)["reason"], "") if final.holds and final.begun_s is None else ""
    reason = str(final.ended.get("reason", DropReason.REFUSED))
    if reason in (DropReason.SUPERSEDED, DropReason.LIFESPAN) and final.holds:
        reason = str(last_hold(final)["reason"])  # that it was dropped follows from what it waited for
    return ADVICE.get(reason, "")
