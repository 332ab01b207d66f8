"""An independent model of a link with classes, queues and an encoder, fragment by fragment.

Nothing of the predictor's formulas is in here: messages arrive, are thinned, wait in a keep-newest queue per topic, are
encoded one at a time, cut into fragments, sent in class order with resume, lost at random and repaired while wanted. A
run can be cloned at any instant, which is how the oracle tries every configuration on the queues as they are.
"""

from bisect import bisect_right
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from heapq import heappop, heappush
from math import ceil, inf
from random import Random
from typing import Final

from sern_core.adaptation.model import NO_CODEC, ClassOutcome, Configuration
from sern_core.bodies.codecs import CodecProfile
from sern_core.vocabulary.types import CLASSES, PriorityClass

FRAGMENT_BYTES: Final = 1140
HEADER_BYTES: Final = 60
SERIALISE_S: Final = 100e-6
REPAIR_S: Final = 0.02
LIFESPAN_S: Final = 1.0


@dataclass(frozen=True)
class Topic:
    """A stream with a period (jittered), sizes with a coefficient of variation, and a deadline."""

    name: str
    priority: PriorityClass
    period_s: float
    mean_bytes: float
    deadline_s: float
    size_cv: float = 0.1
    codecs: dict[str, CodecProfile] = field(default_factory=dict)
    from_s: float = 0.0
    until_s: float = inf
    jitter: float = 0.1


@dataclass(frozen=True)
class Path:
    """The link over time: rate by steps, and loss, round trip and how much slower the CPU is as functions."""

    rates: tuple[tuple[float, float], ...]  # (from_s, bits per second), ascending
    loss: Callable[[float], float] = lambda _t: 0.0
    rtt_s: Callable[[float], float] = lambda _t: 0.05
    slowdown: Callable[[float], float] = lambda _t: 1.0

    def rate_bps(self, t: float) -> float:
        return self.rates[max(0, bisect_right(self.rates, (t, inf)) - 1)][1]

    def mean_rate_bps(self, from_s: float, to_s: float) -> float:
        """What the link could carry between two times, bits a second."""
        bits, at_s = 0.0, max(0.0, from_s)
        begin_s = at_s
        while at_s < to_s:
            until_s = min(self.next_change_s(at_s), to_s)
            bits += self.rate_bps(at_s) * (until_s - at_s)
            at_s = until_s
        return bits / (to_s - begin_s)

    def next_change_s(self, t: float) -> float:
        index = bisect_right(self.rates, (t, inf))
        return self.rates[index][0] if index < len(self.rates) else inf


def arrivals(topics: list[Topic], duration_s: float, seed: int) -> list[tuple[float, int, float]]:
    """(time, topic index, body bytes) of a whole run, in order."""
    found = []
    for index, topic in enumerate(topics):
        random = Random(f"{seed} {topic.name}")
        t = topic.from_s + random.random() * topic.period_s
        while t < min(duration_s, topic.until_s):
            size = max(16.0, random.gauss(topic.mean_bytes, topic.size_cv * topic.mean_bytes))
            found.append((t + topic.jitter * topic.period_s * random.random(), index, size))
            t += topic.period_s
    return sorted(found)


class _Message:
    __slots__ = ("begun", "body_bytes", "born_s", "fragments", "lost", "remaining", "topic", "wire_bytes")

    def __init__(self, topic: int, born_s: float, body_bytes: float) -> None:
        self.topic = topic
        self.born_s = born_s
        self.body_bytes = body_bytes
        self.begun = False
        self.fragments = self.remaining = self.lost = 0
        self.wire_bytes = 0.0  # of one fragment

    def copy(self) -> "_Message":
        new = object.__new__(_Message)
        for name in _Message.__slots__:
            setattr(new, name, getattr(self, name))
        return new


class _Counts:
    __slots__ = ("admitted", "body", "delivered", "encoded", "latency_s", "offered", "on_time", "wire")

    def __init__(self) -> None:
        self.offered = self.admitted = self.on_time = self.delivered = 0
        self.latency_s = self.wire = self.body = self.encoded = 0.0


class Queues:
    """The state of one end of the link. `run` advances it; `take` hands out what the interval came to."""

    def __init__(self, topics: list[Topic], path: Path, offered: list[tuple[float, int, float]], *, seed: int) -> None:
        self.topics = topics
        self.path = path
        self.offered = offered
        self.random = Random(seed)
        self.now = 0.0
        self.next = 0
        self.configuration = Configuration()
        phases = Random(f"thinning {seed}")  # which messages a share lets in must not suit one trace in every run
        self.thinned = [phases.random() for _ in topics]
        self.waiting: list[deque[_Message]] = [deque() for _ in topics]
        self.active: list[_Message | None] = [None] * len(topics)  # begun, with fragments to send
        self.last_sent_s = [0.0] * len(topics)
        self.begun_born_s = [0.0] * len(topics)  # birth of the newest message that was begun
        self.encoding: tuple[float, int] | None = None  # until when, of which topic
        self.repairs: list[tuple[float, int, _Message]] = []
        self._number = 0
        self._reset()

    def _reset(self) -> None:
        self.counts = [_Counts() for _ in CLASSES]
        self.cpu_s = self.idle_s = 0.0
        self.packets = self.packets_lost = 0
        self.seen: list[tuple[float, int, float]] = []

    def clone(self) -> "Queues":
        """The same state; what it does afterwards leaves this one alone. Interval counts start at zero."""
        new = object.__new__(Queues)
        new.__dict__.update(self.__dict__)
        copies: dict[int, _Message] = {}

        def copy(message: _Message) -> _Message:
            return copies.setdefault(id(message), message.copy())

        new.random = Random(0)
        new.random.setstate(self.random.getstate())
        new.thinned = list(self.thinned)
        new.waiting = [deque(copy(m) for m in queue) for queue in self.waiting]
        new.active = [None if m is None else copy(m) for m in self.active]
        new.last_sent_s = list(self.last_sent_s)
        new.begun_born_s = list(self.begun_born_s)
        new.repairs = [(at, number, copy(m)) for at, number, m in self.repairs]
        new._reset()
        return new

    def apply(self, configuration: Configuration) -> None:
        self.configuration = configuration
        for index, topic in enumerate(self.topics):
            queue = self.waiting[index]
            while len(queue) > configuration.queues[topic.priority]:
                queue.popleft()

    # --- what happens -----------------------------------------------------------------------------------------------

    def run(self, until_s: float) -> None:
        path = self.path
        while self.now < until_s:
            self._admit()
            event_s = min(
                self.offered[self.next][0] if self.next < len(self.offered) else inf,
                self.repairs[0][0] if self.repairs else inf,
                self.encoding[0] if self.encoding is not None else inf,
                path.next_change_s(self.now),
                until_s,
            )
            message = self._pick()
            if message is None:
                if self.encoding is not None:
                    event_s = min(event_s, self.encoding[0])
                self.idle_s += event_s - self.now
                self.now = event_s
                continue
            self._send(message, event_s)

    def _admit(self) -> None:
        """Everything that is due by now."""
        now = self.now
        while self.next < len(self.offered) and self.offered[self.next][0] <= now:
            born_s, index, size = self.offered[self.next]
            self.next += 1
            self.seen.append((born_s, index, size))
            priority = self.topics[index].priority
            self.counts[priority].offered += 1
            self.cpu_s += SERIALISE_S * self.path.slowdown(now)
            self.thinned[index] += self.configuration.rates[priority]
            if self.thinned[index] < 1.0 - 1e-9:
                self.cpu_s -= SERIALISE_S * self.path.slowdown(now)
                continue
            self.thinned[index] -= 1.0
            self.counts[priority].admitted += 1
            queue = self.waiting[index]
            if len(queue) >= self.configuration.queues[priority]:
                queue.popleft()
            queue.append(_Message(index, born_s, size))
        while self.repairs and self.repairs[0][0] <= now:
            message = heappop(self.repairs)[2]
            index = message.topic
            fresher = bool(self.waiting[index]) or self.begun_born_s[index] > message.born_s
            if now - message.born_s > LIFESPAN_S or (message.fragments == 1 and fresher):
                continue
            if self.active[index] is not None:
                heappush(self.repairs, (now + 0.005, self._next_number(), message))
                continue
            message.remaining, message.lost = message.lost, 0
            self.active[index] = message
        if self.encoding is not None and self.encoding[0] <= now:
            self.encoding = None

    def _next_number(self) -> int:
        self._number += 1
        return self._number

    def _pick(self) -> _Message | None:
        """The most urgent class; in it the topic whose score (age over remaining size) is highest."""
        now = self.now
        busy = self.encoding[1] if self.encoding is not None else -1
        for priority in CLASSES:
            while True:
                best, best_score = -1, -1.0
                for index, topic in enumerate(self.topics):
                    if topic.priority is not priority or index == busy:
                        continue
                    active = self.active[index]
                    if active is not None and now - active.born_s > LIFESPAN_S:
                        active = self.active[index] = None
                    if active is not None:
                        remaining = active.remaining * active.wire_bytes
                    else:
                        queue = self.waiting[index]
                        while queue and now - queue[0].born_s > LIFESPAN_S:
                            queue.popleft()
                        if not queue:
                            continue
                        remaining = queue[0].body_bytes
                    score = (1.0 + now - self.last_sent_s[index]) / (remaining + 64.0)
                    if score > best_score:
                        best, best_score = index, score
                if best < 0:
                    break
                message = self.active[best]
                if message is not None:
                    return message
                started = self._begin(best)
                if started is not None:
                    return started
                if busy >= 0 and self.encoding is not None and self.encoding[1] == busy:
                    break  # the encoder is taken: the next class
                busy = best
        return None

    def _begin(self, index: int) -> _Message | None:
        """Take the topic's next message; None while it has to be encoded first."""
        topic = self.topics[index]
        mode = self.configuration.codec
        profile = topic.codecs.get(mode) if mode != NO_CODEC else None
        if profile is not None and self.encoding is not None:
            return None
        message = self.waiting[index].popleft()
        encoded = message.body_bytes * (profile.ratio if profile is not None else 1.0)
        counts = self.counts[topic.priority]
        if profile is not None:
            counts.body += message.body_bytes
            counts.encoded += encoded
        message.begun = True
        self.begun_born_s[index] = max(self.begun_born_s[index], message.born_s)
        message.fragments = message.remaining = max(1, ceil(encoded / FRAGMENT_BYTES))
        message.wire_bytes = encoded / message.fragments + HEADER_BYTES
        self.active[index] = message
        if profile is None:
            return message
        encode_s = message.body_bytes / profile.speed_bytes_per_s * self.path.slowdown(self.now)
        self.cpu_s += encode_s
        self.encoding = (self.now + encode_s, index)
        return None

    def _send(self, message: _Message, event_s: float) -> None:
        path, index = self.path, message.topic
        topic = self.topics[index]
        rate_bps = path.rate_bps(self.now)
        if rate_bps <= 0.0:
            self.now = min(event_s, path.next_change_s(self.now))
            return
        copies = 2 if self.configuration.redundancy and topic.priority is PriorityClass.CONTROL else 1
        fragment_s = 8.0 * message.wire_bytes * copies / rate_bps
        count = min(message.remaining, max(1, ceil((event_s - self.now) / fragment_s)))
        self.now += count * fragment_s
        message.remaining -= count
        counts = self.counts[topic.priority]
        counts.wire += count * copies * message.wire_bytes
        loss = path.loss(self.now)
        self.packets += count * copies
        if loss > 0.0:
            draw = self.random.random
            for _ in range(count):
                lost = [draw() < loss for _ in range(copies)]
                self.packets_lost += sum(lost)
                message.lost += all(lost)
        self.last_sent_s[index] = self.now
        if message.remaining:
            return
        self.active[index] = None
        rtt_s = path.rtt_s(self.now)
        if message.lost:
            heappush(self.repairs, (self.now + rtt_s + REPAIR_S, self._next_number(), message))
            return
        latency_s = self.now + rtt_s / 2.0 - message.born_s
        counts.delivered += 1
        counts.latency_s += latency_s
        counts.on_time += latency_s <= topic.deadline_s

    def outcomes(self) -> tuple[ClassOutcome, ...]:
        return tuple(
            ClassOutcome(
                priority, c.offered, c.admitted, c.on_time, c.delivered, c.latency_s, c.wire, c.body, c.encoded
            )
            for priority, c in zip(CLASSES, self.counts, strict=True)
        )

    def take(self) -> None:
        """Start a new interval."""
        self._reset()


def slowed(profile: CodecProfile, slowdown: float) -> CodecProfile:
    return replace(profile, speed_bytes_per_s=profile.speed_bytes_per_s / slowdown)
