"""Message and byte accounting of one link: every message offered has exactly one fate, every drop a reason.

Plain integers bumped by the hot path; metrics are collected from them at scrape. Counters of a topic exist, at zero,
from the moment its stream does, so that a rate over them never misses the first event.
"""

from collections.abc import Callable, Collection, Iterable, Mapping
from types import MappingProxyType
from typing import Final

from sern_core.vocabulary.message import StreamInfo
from sern_core.vocabulary.types import DropReason, PriorityClass, TopicName

MAX_TOPICS: Final = 4096
OTHER_TOPIC: Final = TopicName("/other")
"""Where topics beyond MAX_TOPICS are counted together, and those that ended long ago: a peer cannot grow this table
without bound, and sums stay what they were."""
IDLE_S: Final = 3600.0
"""How long the counters of a topic without streams are kept by themselves."""

LOSSES: Final = (DropReason.RETENTION, DropReason.DISCONNECTED, DropReason.SHUTDOWN)
"""Reasons for which a reliable message is given up that its subscribers still wanted."""

NO_DROPS: Final[Mapping[DropReason, int]] = MappingProxyType(dict.fromkeys(DropReason, 0))
"""What the drops by reason are, of every topic that has had none yet: a table each would take more than all else that
is counted."""


class _Drops:
    """Drops by reason, every one of them from the start on."""

    __slots__ = ("_counts", "by_reason")

    def __init__(self) -> None:
        self.by_reason: Mapping[DropReason, int] = NO_DROPS
        self._counts: dict[DropReason, int] | None = None  # what `by_reason` shows since the first drop

    def _count(self, reason: DropReason, count: int = 1) -> None:
        counts = self._counts
        if counts is None:
            counts = self.by_reason = self._counts = dict(NO_DROPS)
        counts[reason] += count

    def _add(self, other: "_Drops") -> None:
        if other._counts is not None:
            for reason, count in other._counts.items():
                self._count(reason, count)


class SendCounters(_Drops):
    """One topic's way out: offered = delivered + dropped + queued + in flight. Refused messages were not offered."""

    __slots__ = (
        "delivered",
        "delivered_bytes",
        "dropped",
        "dropped_bytes",
        "offered",
        "offered_bytes",
        "priority",
        "refused",
        "refused_bytes",
        "reliable_unconfirmed",
        "topic",
    )

    def __init__(self, topic: TopicName, priority: PriorityClass) -> None:
        super().__init__()
        self.topic = topic
        self.priority = priority
        self.offered = self.offered_bytes = 0
        self.delivered = self.delivered_bytes = 0
        self.dropped = self.dropped_bytes = 0
        self.refused = self.refused_bytes = 0
        self.reliable_unconfirmed = 0
        """Those dropped as UNCONFIRMED that were lost if they did not arrive: for a reason in LOSSES."""

    def add(self, other: "SendCounters") -> None:
        """Take over what another topic's counters say."""
        for name in _SEND_SUMS:
            setattr(self, name, getattr(self, name) + getattr(other, name))
        self._add(other)

    def offer(self, nbytes: int) -> None:
        self.offered += 1
        self.offered_bytes += nbytes

    def deliver(self, nbytes: int, count: int = 1) -> None:
        """The peer has it: acknowledged (best effort) or below its watermark (reliable). `nbytes` of all of them."""
        self.delivered += count
        self.delivered_bytes += nbytes

    def drop(self, reason: DropReason, nbytes: int, count: int = 1) -> None:
        """`nbytes` of all of them."""
        self.dropped += count
        self.dropped_bytes += nbytes
        self._count(reason, count)

    def refuse(self, nbytes: int) -> None:
        """A reliable queue was full and the caller was told."""
        self.refused += 1
        self.refused_bytes += nbytes
        self._count(DropReason.REFUSED)


class ReceiveCounters(_Drops):
    """One topic's way in. `age_s` is the age of the newest delivered message when it was delivered."""

    __slots__ = ("age_s", "delivered", "delivered_bytes", "last_born_s", "priority", "topic")

    def __init__(self, topic: TopicName, priority: PriorityClass) -> None:
        super().__init__()
        self.topic = topic
        self.priority = priority
        self.delivered = self.delivered_bytes = 0
        self.age_s = 0.0
        self.last_born_s: float | None = None

    def add(self, other: "ReceiveCounters") -> None:
        """Take over what another topic's counters say; what is delivered here stays the latest."""
        self.delivered += other.delivered
        self.delivered_bytes += other.delivered_bytes
        self._add(other)

    def arrived(self, nbytes: int, age_s: float, now: float) -> None:
        self.delivered += 1
        self.delivered_bytes += nbytes
        self.age_s = age_s
        self.last_born_s = now - age_s

    def drop_arrived(self, reason: DropReason, count: int = 1) -> None:
        self._count(reason, count)

    def age_of_information_s(self, now: float) -> float | None:
        """How old the freshest delivered sample is now; None before the first."""
        return None if self.last_born_s is None else now - self.last_born_s


_SEND_SUMS: Final = (
    "offered", "offered_bytes", "delivered", "delivered_bytes", "dropped", "dropped_bytes", "refused", "refused_bytes",
    "reliable_unconfirmed",
)  # fmt: skip


class _Idle:
    """Since when topics have had no stream."""

    def __init__(self) -> None:
        self._since_s: dict[TopicName, float] = {}

    def over(self, topics: Iterable[TopicName], used: Collection[TopicName], now: float) -> list[TopicName]:
        """Those of `topics` that have not been in use for IDLE_S."""
        since_s = self._since_s
        self._since_s = {topic: since_s.get(topic, now) for topic in topics if topic not in used}
        self._since_s.pop(OTHER_TOPIC, None)
        over = [topic for topic, at_s in self._since_s.items() if now - at_s > IDLE_S]
        for topic in over:
            del self._since_s[topic]
        return over


class SendLedger:
    """Counters of what goes out over one link, by topic."""

    def __init__(self) -> None:
        self.topics: dict[TopicName, SendCounters] = {}
        self._idle = _Idle()

    def tidy(self, used: Collection[TopicName], *, now: float) -> None:
        """Count topics together with all others once they had no stream for IDLE_S; `used`: those that have one."""
        for topic in self._idle.over(self.topics, used, now):
            counters = self.topics.pop(topic)
            self.topics.setdefault(OTHER_TOPIC, SendCounters(OTHER_TOPIC, counters.priority)).add(counters)

    def topic(self, topic: TopicName, priority: PriorityClass) -> SendCounters:
        name = topic if topic in self.topics or len(self.topics) < MAX_TOPICS else OTHER_TOPIC
        counters = self.topics.get(name)
        if counters is None:
            counters = self.topics[name] = SendCounters(name, priority)
        return counters

    def validate(
        self, held: Iterable[tuple[SendCounters, int, int, int, int]], check: Callable[[bool, str], None]
    ) -> None:
        """offered = delivered + dropped + queued + in flight, by topic, in messages and bytes. `held`, of each open
        channel: its counters, messages and bytes queued, messages and bytes in flight."""
        messages: dict[TopicName, int] = dict.fromkeys(self.topics, 0)
        nbytes: dict[TopicName, int] = dict.fromkeys(self.topics, 0)
        for counters, queued, queued_bytes, flying, flying_bytes in held:
            messages[counters.topic] += queued + flying
            nbytes[counters.topic] += queued_bytes + flying_bytes
        for topic, c in self.topics.items():
            check(
                c.offered == c.delivered + c.dropped + messages[topic],
                f"{topic}: {c.offered} offered is not {c.delivered} delivered + {c.dropped} dropped"
                f" + {messages[topic]} held",
            )
            check(
                c.offered_bytes == c.delivered_bytes + c.dropped_bytes + nbytes[topic],
                f"{topic}: {c.offered_bytes} bytes offered is not {c.delivered_bytes} delivered + {c.dropped_bytes}"
                f" dropped + {nbytes[topic]} held",
            )
            dropped = sum(count for reason, count in c.by_reason.items() if reason is not DropReason.REFUSED)
            check(c.dropped == dropped, f"{topic}: {c.dropped} dropped, but {dropped} by reason")
            check(c.refused == c.by_reason[DropReason.REFUSED], f"{topic}: refusals do not add up")


class ReceiveLedger:
    """Counters of what arrives, by topic. What belongs to no stream that is known here is counted for OTHER_TOPIC."""

    def __init__(self) -> None:
        self.topics: dict[TopicName, ReceiveCounters] = {}
        self._idle = _Idle()

    def tidy(self, used: Collection[TopicName], *, now: float) -> None:
        """Forget topics as `SendLedger.tidy` does."""
        for topic in self._idle.over(self.topics, used, now):
            counters = self.topics.pop(topic)
            self.topics.setdefault(OTHER_TOPIC, ReceiveCounters(OTHER_TOPIC, counters.priority)).add(counters)

    def of(self, stream: StreamInfo) -> ReceiveCounters:
        topic = stream.id.topic
        return self.topics.get(topic) or self._named(topic, stream.spec.priority)

    def stray(self) -> None:
        """A message of a stream that was never announced, or has ended."""
        self._named(OTHER_TOPIC, PriorityClass.BULK).drop_arrived(DropReason.UNKNOWN_CHANNEL)

    def _named(self, topic: TopicName, priority: PriorityClass) -> ReceiveCounters:
        name = topic if topic in self.topics or len(self.topics) < MAX_TOPICS else OTHER_TOPIC
        counters = self.topics.get(name)
        if counters is None:
            counters = self.topics[name] = ReceiveCounters(name, priority)
        return counters
