"""Hand-written message logs: a short run that keeps every promise, for tests to spoil."""

from collections import Counter
from dataclasses import dataclass, field, replace

from sern_tools.counters import Counters
from sern_tools.message_log import Delivery, Event, Offer, TopicLog
from sern_tools.summary import Result, RunFacts, analyse

ORIGIN_NS = 1_700_000_000_000_000_000
MS = 1_000_000
POSE, COMMAND, MAP, CLOUD = "/robot/pose", "/robot/cmd_vel", "/robot/map", "/robot/points"
PRIORITIES = {POSE: "control", COMMAND: "control", MAP: "state", CLOUD: "bulk"}
FLOOR_S = 0.025
FACTS = RunFacts(
    origin_ns=ORIGIN_NS,
    duration_s=10.0,
    floor_s={"robot": FLOOR_S, "site": FLOOR_S},
    blackouts=((4.0, 6.0),),
    reliable_topics=frozenset({MAP}),
    command_lifespans_s={COMMAND: 0.3},
    pose_topic=POSE,
    subscribers={"robot": "site", "site": "robot"},
)


def ends(topic: str) -> tuple[str, str]:
    """The origin of a topic, and who takes it."""
    return ("site", "robot") if topic == COMMAND else ("robot", "site")


@dataclass
class Run:
    """Lines per topic, in milliseconds since the start, and the daemons' counters."""

    logs: dict[str, TopicLog] = field(default_factory=dict)
    counters: dict[str, list[Counters]] = field(default_factory=dict)

    def offer(self, topic: str, seq: int, at_ms: float, size: int = 100) -> None:
        log = self.logs.setdefault(topic, TopicLog(topic, PRIORITIES[topic]))
        log.origin = ends(topic)[0]
        log.offers[seq] = Offer(ORIGIN_NS + int(at_ms * MS), seq, size, seq * 7)

    def deliver(self, topic: str, seq: int, at_ms: float) -> None:
        offer = self.logs[topic].offers[seq]
        delivery = Delivery(ORIGIN_NS + int(at_ms * MS), seq, offer.size_bytes, offer.crc32, offer.wall_ns, age_s=None)
        self.logs[topic].deliveries.append(delivery)

    def count(self) -> None:
        """What agrees with the offers and deliveries: the rest was dropped at its origin, by its lifespan. What an
        earlier call has written is written anew."""
        for topic, log in self.logs.items():
            sender, receiver = ends(topic)
            delivered = {delivery.seq for delivery in log.deliveries}
            log.dropped.clear()
            log.lines.clear()
            log.received = {"relay": delivered}
            self.counters[topic] = [
                Counters(sender, "send", offered=log.offered),
                Counters("relay", "onward"),
                Counters(receiver, "receive", delivered=len(log.deliveries)),
                Counters("relay", "inward", dropped={"duplicate": 3}),
            ]
            for seq in log.offers.keys() - delivered:
                self.drop(topic, seq, "lifespan")

    def drop(self, topic: str, seq: int, reason: str, *, at: str = "origin", counted: bool = True) -> None:
        """A drop in a log and in the counters. `at`: origin, onward or inward (at the relay), or subscriber."""
        sender, receiver = ends(topic)
        place, peer, event, index = {
            "origin": (sender, "relay", Event.DROPPED, 0),
            "onward": ("relay", receiver, Event.DROPPED, 1),
            "subscriber": (receiver, "relay", Event.DISCARDED, 2),
            "inward": ("relay", sender, Event.DISCARDED, 3),
        }[at]
        log = self.logs[topic]
        table = log.dropped if event is Event.DROPPED else log.discarded
        table.setdefault((place, peer), {})[seq] = reason
        log.lines.setdefault(event, Counter())[place, reason] += 1
        if counted:
            entry = self.counters[topic][index]
            by_reason = Counter(entry.dropped) + Counter({reason: 1})
            self.counters[topic][index] = replace(entry, dropped=dict(by_reason))

    def lose(self, topic: str, seq: int, *, received: bool) -> None:
        """Nobody has delivered message `seq`; whether the relay had it."""
        log = self.logs[topic]
        log.deliveries = [delivery for delivery in log.deliveries if delivery.seq != seq]
        with_counter(self, topic, 2, delivered=len(log.deliveries))
        if not received:
            log.received["relay"].discard(seq)

    def analyse(self, system: str = "sern", facts: RunFacts = FACTS) -> Result:
        return analyse(system, self.logs, facts, self.counters or None)


def good_run(*, latency_ms: float = 30.0, facts: RunFacts = FACTS) -> Run:
    """Poses and commands every 20 ms, a map each second, a cloud every 200 ms; a blackout from 4 s to 6 s.

    Poses and commands of the blackout are dropped, maps wait for its end, clouds for their turn.
    """
    run = Run()
    start_ms, end_ms = (1000 * t for t in facts.blackouts[0])
    for topic in (POSE, COMMAND):
        for seq in range(1, 501):
            at_ms = seq * 20.0
            run.offer(topic, seq, at_ms)
            if not start_ms <= at_ms < end_ms:
                run.deliver(topic, seq, at_ms + latency_ms)
    for seq in range(1, 10):
        at_ms = seq * 1000.0
        run.offer(MAP, seq, at_ms, size=1000)
        run.deliver(MAP, seq, max(at_ms, end_ms + 50 + seq if start_ms <= at_ms < end_ms else 0) + 2 * latency_ms)
    for seq in range(1, 50):
        at_ms = seq * 200.0
        run.offer(CLOUD, seq, at_ms, size=50_000)
        if not start_ms <= at_ms < end_ms:
            run.deliver(CLOUD, seq, at_ms + 400)
    run.count()
    return run


def with_counter(run: Run, topic: str, index: int, **changes: int) -> None:
    run.counters[topic][index] = replace(run.counters[topic][index], **changes)  # type: ignore[arg-type]
