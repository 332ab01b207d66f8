"""Hand-written message logs: a short run that keeps every promise, for tests to spoil."""

from dataclasses import dataclass, field, replace

from sern_tools.counters import Counters
from sern_tools.message_log import Delivery, Offer, TopicLog
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
)


@dataclass
class Run:
    """Lines per topic, in milliseconds since the start, and the daemons' counters."""

    logs: dict[str, TopicLog] = field(default_factory=dict)
    counters: dict[str, list[Counters]] = field(default_factory=dict)

    def offer(self, topic: str, seq: int, at_ms: float, size: int = 100) -> None:
        log = self.logs.setdefault(topic, TopicLog(topic, PRIORITIES[topic]))
        log.origin = "site" if topic == COMMAND else "robot"
        log.offers[seq] = Offer(ORIGIN_NS + int(at_ms * MS), seq, size, seq * 7)

    def deliver(self, topic: str, seq: int, at_ms: float) -> None:
        offer = self.logs[topic].offers[seq]
        delivery = Delivery(ORIGIN_NS + int(at_ms * MS), seq, offer.size_bytes, offer.crc32, offer.wall_ns, age_s=None)
        self.logs[topic].deliveries.append(delivery)

    def count(self) -> None:
        """Counters that agree with the logs: what was not delivered was dropped by its lifespan."""
        for topic, log in self.logs.items():
            sender, receiver = ("site", "robot") if topic == COMMAND else ("robot", "site")
            missing = log.offered - len(log.deliveries)
            self.counters[topic] = [
                Counters(sender, "send", offered=log.offered, dropped={"lifespan": missing}),
                Counters("relay", "relay", dropped={"duplicate": 3}),
                Counters(receiver, "receive", delivered=len(log.deliveries)),
            ]

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
