"""A bounded log of decisions: what became of each message at one end of a hop, and what it had to wait for.

Each topic has a ring of its own, so that a pose at 50 Hz does not push out what happened to a map. Events of the link
itself are recorded under LINK. `sern explain` makes sentences of the records.

Recording costs one call and one tuple; when `enabled` is false it costs the call, and the hot path may test `enabled`
itself to save that. Without `steps` only what is out of the ordinary is recorded: what a relay can afford.
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
RECORD_BYTES: Final = 640
"""What a record counts for in `max_bytes`: CPython 3.11 takes 300 to 600 bytes for one."""
DEFAULT_MAX_BYTES: Final = 8 * 2**20

Field = int | float | str


class TraceEvent(StrEnum):
    """What was decided. Closed: a test makes each of them happen, and tools have a sentence for each."""

    # On the way out
    QUEUED = "queued"  # it waits in its topic's queue
    RATE_CAPPED = "rate_capped"  # left out by a rate cap: a newer one came before its time
    REFUSED = "refused"  # the queue of a reliable topic is full, and the sender was told no
    REPLAYED = "replayed"  # a latched message is sent again, to a late joiner
    HELD = "held"  # it was passed over, for a HoldReason
    ENCODING = "encoding"  # another thread makes its body smaller
    BEGUN = "begun"  # its first fragment leaves, and more follow
    SENT = "sent"  # its last fragment left
    LOST = "lost"  # a fragment was lost on the way, and goes again
    ACKED = "acked"  # the other end has it whole
    CONFIRMED = "confirmed"  # reliable: all required clients have everything up to it
    # On both
    DROPPED = "dropped"  # for a DropReason
    # On the way in
    DELIVERED = "delivered"  # handed on at this end
    LEASE_EXPIRED = "lease_expired"  # no fresh command came, and the stop command was published
    # The link
    LINK_UP = "link_up"  # a session begins
    LINK_DOWN = "link_down"  # and ends
    LANE_USED = "lane_used"  # data, or class control, goes another way from now on
    LANE_SILENT = "lane_silent"  # nothing is acknowledged any more
    LANE_ANSWERS = "lane_answers"  # and it is again
    CAPACITY = "capacity"  # the link is known to carry much more, or less, than before
    SUMMARISED = "summarised"  # a topic's messages are too large for it: their summary goes in their place
    WHOLE = "whole"  # it carries them in time, and they go as they come again


class HoldReason(StrEnum):
    """Why a message that waits is not the one that is sent."""

    LINK_DOWN = "link_down"  # there is no session
    SILENT = "silent"  # nothing is acknowledged: only questions go out, whether the path is back
    ANNOUNCEMENT = "announcement"  # the other end has not said yet whether it wants the stream
    DEFINITION = "definition"  # nor can it before it has the text of the type, which it has asked for
    CONTROL = "control"  # the link's own messages go first
    WINDOW = "window"  # as much is under way as the link carries
    PACING = "pacing"  # the link is busy with the datagram before
    CLASS = "class"  # a more urgent class goes first
    OUTRANKED = "outranked"  # another topic of its class has the higher score
    FLOOR = "floor"  # a less urgent class is given its floor
    SHARE = "share"  # class control has had its share of the link, and others wait
    INTERVAL = "interval"  # ordering `paper`: it did not fit into this interval's budget
    ENCODER = "encoder"  # as many bodies are being encoded as may be at a time
    RATE_CAP = "rate_cap"  # the topic's max_rate_hz
    ADAPTATION = "adaptation"  # the adaptation lets in a share of the topic's messages


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
    """Keeps the last `capacity` events of each of up to `max_topics` topics, and `max_bytes` of all together.

    Without `steps` it is told only what is out of the ordinary: a message that went its way leaves nothing.
    """

    __slots__ = ("_capacity", "_max_records", "_max_topics", "_number", "_rings", "_size", "enabled", "steps")

    def __init__(
        self,
        capacity: int = DEFAULT_CAPACITY,
        *,
        max_topics: int = DEFAULT_MAX_TOPICS,
        max_bytes: int = DEFAULT_MAX_BYTES,
        enabled: bool = True,
        steps: bool = True,
    ) -> None:
        if capacity < 1 or max_topics < 1:
            raise UsageError(f"DecisionTrace: capacity {capacity} and max_topics {max_topics} must be at least 1")
        if max_bytes < RECORD_BYTES:
            raise UsageError(f"DecisionTrace: max_bytes {max_bytes} must be at least {RECORD_BYTES}")
        self.enabled = enabled
        self.steps = steps and enabled
        """Whether to record also what happens to every message; read by whoever records."""
        self._capacity = capacity
        self._max_topics = max_topics
        self._max_records = max_bytes // RECORD_BYTES
        self._number = 0
        self._size = 0
        self._rings: dict[TopicName, deque[tuple[int, float, TopicName, TraceEvent, int, dict[str, Field]]]] = {}

    def record(self, now: float, topic: TopicName, event: TraceEvent, seq: int = 0, **fields: Field) -> None:
        """Note one decision. Names of fields carry units: `size_bytes`, `age_s`, `rate_bps`; `reason` is a word."""
        if not self.enabled:
            return
        ring = self._rings.get(topic)
        if ring is None:
            ring = self._new_ring(topic)
        self._number += 1
        if len(ring) < self._capacity:
            self._size += 1
        ring.append((self._number, now, topic, event, seq, fields))
        if self._size > self._max_records:
            self._make_room(topic, ring)

    @property
    def topics(self) -> tuple[TopicName, ...]:
        """Topics of which something is recorded, sorted."""
        named = set(self._rings) | {entry[2] for entry in self._rings.get(OTHER, ())}
        return tuple(sorted(named - {LINK, OTHER}))

    def records(self, topic: TopicName | None = None) -> tuple[TraceRecord, ...]:
        """Records of a topic, or of everything (None), in the order they were made."""
        if topic is None:
            return tuple(TraceRecord(*entry) for entry in merge(*self._rings.values()))
        if topic in self._rings:
            return tuple(TraceRecord(*entry) for entry in self._rings[topic])
        return tuple(TraceRecord(*entry) for entry in self._rings.get(OTHER, ()) if entry[2] == topic)

    def about(self, topic: TopicName) -> tuple[TraceRecord, ...]:
        """Records of a topic, and what happened to the link from shortly before the first of them on."""
        mine, link = self.records(topic), self.records(LINK)
        if not mine:
            return link
        earlier = [record for record in link if record.number < mine[0].number][-1:]  # how the link was then
        later = [record for record in link if record.number > mine[0].number]
        return tuple(merge(mine, earlier + later))

    def to_json(self, topic: TopicName | None = None) -> list[dict[str, Any]]:
        """Records as JSON objects: number, now_s, topic, event, seq, and the fields beside them."""
        return [record_json(record) for record in self.records(topic)]

    def clear(self) -> None:
        self._rings.clear()
        self._size = 0

    def validate(self) -> None:
        """Check bounds and order; raises AssertionError."""
        assert len(self._rings) <= self._max_topics + 2, "too many rings"
        assert self._size == sum(map(len, self._rings.values())), "records are miscounted"
        assert self._size <= self._max_records, "more records than there is room for"
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

    def _make_room(
        self, topic: TopicName, ring: deque[tuple[int, float, TopicName, TraceEvent, int, dict[str, Field]]]
    ) -> None:
        """Let go of the oldest record of a topic with more than its share: most often of the one just recorded."""
        if len(ring) == 1 or len(ring) * len(self._rings) <= self._max_records:
            topic, ring = max(self._rings.items(), key=lambda item: len(item[1]))
        ring.popleft()
        self._size -= 1
        if not ring:
            del self._rings[topic]


def record_json(record: TraceRecord) -> dict[str, Any]:
    """A record as a JSON object."""
    return {
        **record.fields,
        "number": record.number,
        "now_s": record.now,
        "topic": record.topic,
        "event": record.event.value,
        "seq": record.seq,
    }
