"""A bounded log of decisions, and the story of why a topic's last message was sent, held or dropped.

Each topic has a ring of its own, so that a pose at 50 Hz does not push out what happened to a map. Events of the link
itself (`link_up`, `link_down`, `window`) are recorded under LINK and woven into every story.

Recording costs one call and one tuple; when `enabled` is false it costs the call, and the hot path may test `enabled`
itself to save that.
"""

from collections import deque
from collections.abc import Mapping
from enum import StrEnum
from heapq import merge
from typing import Any, Final, NamedTuple

from sern_core.vocabulary.errors import UsageError
from sern_core.vocabulary.types import TopicName

LINK: Final = TopicName("")
"""The topic of events that concern the whole link."""
OTHER: Final = TopicName("other")
"""Where topics beyond `max_topics` are recorded together; no topic has this name, they start with a slash."""
DEFAULT_CAPACITY: Final = 128
DEFAULT_MAX_TOPICS: Final = 1024

Field = int | float | str


class TraceEvent(StrEnum):
    """What was decided. Closed: tests and tools match on it."""

    OFFERED = "offered"  # the source handed it over
    QUEUED = "queued"  # it waits in its topic's queue
    SUPERSEDED = "superseded"  # a newer sample took its place
    ENCODING = "encoding"  # its body is being compressed or summarised
    CHOSEN = "chosen"  # the scheduler took it for the link
    HELD = "held"  # the scheduler passed it over for now
    FRAGMENT_SENT = "fragment_sent"
    SENT = "sent"  # its last fragment was sent
    ACKED = "acked"
    LOST = "lost"  # a fragment was judged lost
    RETRANSMITTED = "retransmitted"
    DELIVERED = "delivered"  # handed to the sink at this end, or reported delivered by the other
    DROPPED = "dropped"
    REFUSED = "refused"  # the sender was told no
    REPLAYED = "replayed"  # sent again to a late joiner or after an outage
    RATE_CAPPED = "rate_capped"
    LEASE_EXPIRED = "lease_expired"  # on_link_loss fired for a command topic
    WINDOW = "window"  # the link's window or capacity estimate changed much
    LINK_UP = "link_up"
    LINK_DOWN = "link_down"


_VERDICTS: Final[Mapping[TraceEvent, str]] = {
    TraceEvent.OFFERED: "was offered and nothing was decided yet",
    TraceEvent.QUEUED: "is waiting in its queue",
    TraceEvent.SUPERSEDED: "was dropped: a newer sample took its place",
    TraceEvent.ENCODING: "is being encoded",
    TraceEvent.CHOSEN: "was chosen for the link",
    TraceEvent.HELD: "is held",
    TraceEvent.FRAGMENT_SENT: "is being sent",
    TraceEvent.SENT: "was sent and is not acknowledged yet",
    TraceEvent.ACKED: "was sent and acknowledged",
    TraceEvent.LOST: "lost a fragment on the way",
    TraceEvent.RETRANSMITTED: "was sent again after a loss",
    TraceEvent.DELIVERED: "was delivered",
    TraceEvent.DROPPED: "was dropped",
    TraceEvent.REFUSED: "was refused",
    TraceEvent.REPLAYED: "was replayed",
    TraceEvent.RATE_CAPPED: "was left out by a rate cap",
}
"""How a story ends, by the message's last event. Events that decide nothing about a message are not here."""

_SUFFIXES: Final = (("_bytes", " bytes"), ("_bps", " bit/s"), ("_hz", " Hz"), ("_s", " s"))


class TraceRecord(NamedTuple):
    """One decision. `number` counts all records of a trace, `now` is the caller's monotonic time in seconds.

    `seq` is the message's number in its stream, 0 when the event is not about one message.
    """

    number: int
    now: float
    topic: TopicName
    event: TraceEvent
    seq: int
    fields: Mapping[str, Field]


class DecisionTrace:
    """Keeps the last `capacity` events of each of up to `max_topics` topics."""

    __slots__ = ("_capacity", "_max_topics", "_number", "_rings", "enabled")

    def __init__(
        self, capacity: int = DEFAULT_CAPACITY, *, max_topics: int = DEFAULT_MAX_TOPICS, enabled: bool = True
    ) -> None:
        if capacity < 1 or max_topics < 1:
            raise UsageError(f"DecisionTrace: capacity {capacity} and max_topics {max_topics} must be at least 1")
        self.enabled = enabled
        self._capacity = capacity
        self._max_topics = max_topics
        self._number = 0
        self._rings: dict[TopicName, deque[tuple[int, float, TopicName, TraceEvent, int, dict[str, Field]]]] = {}

    def record(self, now: float, topic: TopicName, event: TraceEvent, seq: int = 0, **fields: Field) -> None:
        """Note one decision. Names of fields carry units: `size_bytes`, `age_s`, `budget_bytes`; `reason` is a word."""
        if not self.enabled:
            return
        ring = self._rings.get(topic)
        if ring is None:
            ring = self._new_ring(topic)
        self._number += 1
        ring.append((self._number, now, topic, event, seq, fields))

    @property
    def topics(self) -> tuple[TopicName, ...]:
        """Topics with a ring of their own, sorted."""
        return tuple(sorted(topic for topic in self._rings if topic not in (LINK, OTHER)))

    def records(self, topic: TopicName | None = None) -> tuple[TraceRecord, ...]:
        """Records of a topic, or of everything (None), in the order they were made."""
        if topic is None:
            return tuple(TraceRecord(*entry) for entry in merge(*self._rings.values()))
        if topic in self._rings:
            return tuple(TraceRecord(*entry) for entry in self._rings[topic])
        return tuple(TraceRecord(*entry) for entry in self._rings.get(OTHER, ()) if entry[2] == topic)

    def story(self, topic: TopicName) -> list[str]:
        """Why the topic's last message was sent, held or dropped, one line an event, the verdict last.

        The last message is the one offered last, or when no offer is in the log the one of the newest event.
        """
        mine = self.records(topic)
        first = next((at for at in reversed(range(len(mine))) if mine[at].event is TraceEvent.OFFERED), None)
        if first is None:
            first = next((at for at in reversed(range(len(mine))) if mine[at].seq), None)
            if first is None:
                return [f"{topic}: nothing is recorded" + ("" if self.enabled else "; the trace is switched off")]
            first = next(at for at, record in enumerate(mine) if record.seq == mine[first].seq)
        seq = mine[first].seq
        about = [record for record in mine[first:] if record.seq in (seq, 0)]
        link = [record for record in self.records(LINK) if record.number > mine[first].number]
        start = mine[first].now
        lines = [f"{topic} message {seq}"]
        lines += [
            f"  {record.now - start:+.3f} s  {'link: ' if record.topic == LINK else ''}{_line(record)}"
            for record in merge(about, link)
        ]
        last = next((record for record in reversed(about) if record.event in _VERDICTS), None)
        if last is None:
            lines.append(f"message {seq} has no decision in the log")
        else:
            why = _why(last)
            lines.append(f"message {seq} {_VERDICTS[last.event]}{': ' + why if why else ''}")
        return lines

    def to_json(self, topic: TopicName | None = None) -> list[dict[str, Any]]:
        """Records as JSON objects: number, now_s, topic, event, seq, and the fields beside them."""
        return [
            {
                **record.fields,
                "number": record.number,
                "now_s": record.now,
                "topic": record.topic,
                "event": record.event.value,
                "seq": record.seq,
            }
            for record in self.records(topic)
        ]

    def clear(self) -> None:
        self._rings.clear()

    def validate(self) -> None:
        """Check bounds and order; raises AssertionError."""
        assert len(self._rings) <= self._max_topics + 2, "too many rings"
        for topic, ring in self._rings.items():
            assert 0 < len(ring) <= self._capacity, f"{topic}: {len(ring)} records"
            numbers = [entry[0] for entry in ring]
            assert numbers == sorted(set(numbers)) and numbers[-1] <= self._number, f"{topic}: out of order"
            assert topic == OTHER or all(entry[2] == topic for entry in ring), f"{topic}: another topic's records"

    def _new_ring(self, topic: TopicName) -> deque[tuple[int, float, TopicName, TraceEvent, int, dict[str, Field]]]:
        own = len(self._rings) - (LINK in self._rings) - (OTHER in self._rings)
        if topic != LINK and own >= self._max_topics:
            topic = OTHER
            if topic in self._rings:
                return self._rings[topic]
        ring = self._rings[topic] = deque(maxlen=self._capacity)
        return ring


def _line(record: TraceRecord) -> str:
    details = ", ".join(f"{_name(key)} {_value(key, value)}" for key, value in record.fields.items())
    return record.event.value.replace("_", " ") + (f" ({details})" if details else "")


def _why(record: TraceRecord) -> str:
    """The deciding event's reason, then its other fields."""
    parts = [str(record.fields["reason"])] if "reason" in record.fields else []
    parts += [f"{_name(key)} {_value(key, value)}" for key, value in record.fields.items() if key != "reason"]
    return ", ".join(parts)


def _name(key: str) -> str:
    suffix = next((suffix for suffix, _ in _SUFFIXES if key.endswith(suffix)), "")
    return key.removesuffix(suffix).replace("_", " ")


def _value(key: str, value: Field) -> str:
    unit = next((unit for suffix, unit in _SUFFIXES if key.endswith(suffix)), "")
    return (f"{value:.4g}" if isinstance(value, float) else str(value)) + unit
