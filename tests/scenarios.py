"""Random worlds for property tests: links, topics and faults as plain data, and what must hold of every run.

A scenario begins with `SETTLE_S` of calm in which everybody connects and every stream is opened, then load and faults
for `LOAD_S`, then calm again until everything has drained.
"""

from dataclasses import dataclass
from functools import partial
from itertools import pairwise

from hypothesis import strategies as st

from sern_core.stream.in_stream import PARTIAL_IDLE_S
from sern_core.stream.out_channel import OutChannel
from sern_core.vocabulary.message import StreamId, TopicSpec
from sern_core.vocabulary.params import LinkParams
from sern_core.vocabulary.types import DropReason, PriorityClass
from sern_sim.models import Jitter, LinkModel, Window
from tests.world import Clock, SimClient, World, spec

SETTLE_S = 8.0
LOAD_S = 8.0
DRAIN_S = 600.0
SIZES = (0, 1, 100, 1_000, 20_000, 300_000)


@dataclass(frozen=True)
class Topic:
    """One topic of the robot: its spec and its load."""

    spec: TopicSpec
    period_s: float
    size_bytes: int


@dataclass(frozen=True)
class Fault:
    """Something that happens `at_s` after the load began."""

    at_s: float
    kind: str


@dataclass(frozen=True)
class Scenario:
    seed: int
    lossless: bool
    robot: LinkModel
    site: LinkModel
    topics: tuple[Topic, ...]
    faults: tuple[Fault, ...]
    robot_clock: Clock
    site_clock: Clock
    relay_clock: Clock


FAULTS = ("relay", "robot link", "site link", "site", "joiner", "leave")


@st.composite
def _links(draw: st.DrawFn, lossless: bool) -> LinkModel:
    edges = sorted(draw(st.sets(st.integers(0, int(10 * LOAD_S)), max_size=6)))
    windows = [Window(SETTLE_S + a / 10, SETTLE_S + b / 10) for a, b in zip(edges[::2], edges[1::2], strict=False)]
    model = LinkModel(
        rate_bps=draw(st.sampled_from([None, 256e3, 1e6, 8e6])),
        delay_s=draw(st.sampled_from([0.0, 0.001, 0.025, 0.3])),
        jitter_s=draw(st.sampled_from([0.0, 0.0, 0.005, 0.05])),
        jitter=draw(st.sampled_from(Jitter)),
        # A stream that loses every fifth segment carries next to nothing, however patient one is.
        loss=draw(st.sampled_from([0.0, 0.0, 0.02, 0.05 if lossless else 0.2])),
        reorder=draw(st.sampled_from([0.0, 0.1])),
        reorder_delay_s=draw(st.sampled_from([0.01, 0.2])),
        duplicate=draw(st.sampled_from([0.0, 0.1])),
        blackouts=tuple(windows),
        disconnect_after_s=draw(st.sampled_from([0.5, 2.0, 5.0])),
        reconnect_s=draw(st.sampled_from([0.0, 0.5])),
    )
    return model.as_stream() if lossless else model


@st.composite
def _topics(draw: st.DrawFn) -> Topic:
    reliable = draw(st.booleans())
    size = draw(st.sampled_from(SIZES))
    period_s = draw(st.sampled_from([0.02, 0.1, 0.5]))
    # At most about twice what the thinnest link carries, so that the run stays short.
    period_s = max(period_s, size * 8 / 512e3)
    topic_spec = spec(
        draw(st.sampled_from(PriorityClass)),
        reliable=reliable,
        latched=draw(st.booleans()),
        depth=draw(st.sampled_from([1, 1, 3, 10])),
        lifespan_s=draw(st.sampled_from([None, None, 0.3, 1.0, 5.0])),
        max_rate_hz=draw(st.sampled_from([None, None, 5.0])),
        retention_s=draw(st.sampled_from([600.0, 600.0, 3.0])),
        max_queue_bytes=draw(st.sampled_from([32 * 2**20, 50_000])),
    )
    return Topic(topic_spec, period_s, size)


def _clocks() -> st.SearchStrategy[Clock]:
    return st.builds(Clock, st.sampled_from([0.0, -9e4, 5e3, 1e6]), st.sampled_from([0.0, 100.0, -100.0]))


@st.composite
def scenarios(draw: st.DrawFn) -> Scenario:
    lossless = draw(st.booleans())
    fault = st.builds(Fault, st.integers(0, int(LOAD_S)).map(float), st.sampled_from(FAULTS))
    faults = draw(st.lists(fault, max_size=4, unique_by=lambda each: each.at_s))
    return Scenario(
        seed=draw(st.integers(0, 999)),
        lossless=lossless,
        robot=draw(_links(lossless)),
        site=draw(_links(lossless)),
        topics=tuple(draw(st.lists(_topics(), min_size=1, max_size=4))),
        faults=tuple(sorted(faults, key=lambda fault: fault.at_s)),
        robot_clock=draw(_clocks()),
        site_clock=draw(_clocks()),
        relay_clock=draw(_clocks()),
    )


class Run:
    """A scenario being played. `lives` are all processes of clients that ever were, `steady` the subscribers that were
    there all along."""

    def __init__(self, scenario: Scenario, link: LinkParams | None = None) -> None:
        self.scenario = scenario
        world = World(scenario.seed, link=link, lossless=scenario.lossless, relay_clock=scenario.relay_clock)
        self.world = world.watch(0.25)
        self.robot = self.world.client("robot", scenario.robot, clock=scenario.robot_clock)
        self.site = self.world.client("site", scenario.site, clock=scenario.site_clock, patterns=["/robot/.*"])
        self.lives = [self.robot, self.site]
        self.channels: list[OutChannel] = []
        self.steady = {self.site.name}
        self.restarts = 0
        self.joiners = 0

    def play(self) -> "Run":
        world, scenario = self.world, self.scenario
        self.channels = [
            self.robot.publish(f"/robot/t{index}", topic.spec) for index, topic in enumerate(scenario.topics)
        ]
        world.run(SETTLE_S)
        world.until(lambda: len(self.site.opened) == len(self.channels), what="all streams are open")
        world.run(2.0)  # the robot knows who is there
        stops = [
            self.robot.every(topic.period_s, channel, partial(_body, topic.size_bytes), first_s=0.01 * index)
            for index, (topic, channel) in enumerate(zip(scenario.topics, self.channels, strict=True))
        ]
        for fault in scenario.faults:
            world.network.after(fault.at_s, partial(self._fault, fault.kind))
        world.run(LOAD_S + 0.5)
        for stop in stops:
            stop()
        world.run(1.0)
        world.until(world.quiet, within_s=DRAIN_S, what="everything has drained")
        world.run(PARTIAL_IDLE_S + 1.0)
        world.validate()
        return self

    def _fault(self, kind: str, _now: float) -> None:
        world = self.world
        if kind == "relay":
            self.restarts += 1
            world.restart_relay()
        elif kind == "robot link":
            world.hops["robot"].break_connection()
        elif kind == "site link":
            world.hops["site"].break_connection()
        elif kind == "site":
            self.steady.discard(self.site.name)
            self.lives.append(world.restart_client("site"))
        elif kind == "joiner":
            self.joiners += 1
            name = f"joiner{self.joiners}"
            self.lives.append(world.client(name, self.scenario.site, patterns=["/robot/.*"]))
        else:
            self.steady.discard(self.site.name)
            world.clients["site"].subscribe()

    # What must hold

    def check(self) -> None:
        for life in self.lives[1:]:
            for index, channel in enumerate(self.channels):
                self._check_stream(life, channel.stream.id, self.scenario.topics[index])
        site = self.lives[1]
        for index, channel in enumerate(self.channels):
            topic = self.scenario.topics[index]
            if topic.spec.reliable and site.name in self.steady:
                self._check_reliable(site, channel, topic)
            if topic.spec.latched:
                self._check_latched(channel, topic)
        self._check_memory()

    def _check_stream(self, life: SimClient, stream: StreamId, topic: Topic) -> None:
        """Every subscriber of every stream, however late, has order, each once, the bodies, and the lifespans."""
        turns = [seq for seq in life.turns[stream] if seq > 0]
        assert all(a < b for a, b in pairwise(turns)), f"{life.name} {stream.topic}: out of order {turns}"
        for got in life.got:
            if got.stream != stream:
                continue
            sent_s, body = self.robot.sent[stream.topic, got.seq]
            assert got.body == body
            age_s = got.at_s - sent_s
            drift_s = 1.1e-4 * age_s  # a second on these clocks is within 100 ppm of one
            if topic.spec.lifespan_s is not None:
                assert age_s <= topic.spec.lifespan_s + drift_s, f"{stream.topic} {got.seq} is {age_s} s old"
            # What the receiver believes is right within what it says of its error.
            assert abs(age_s - got.age_s) <= got.error_s + drift_s, f"age {got.age_s} ± {got.error_s}, but {age_s}"

    def _check_reliable(self, site: SimClient, channel: OutChannel, topic: Topic) -> None:
        """Everything accepted was delivered to the subscriber that was there all along, or reported."""
        name = channel.stream.id.topic
        accepted = {seq for sent_name, seq in self.robot.sent if sent_name == name}
        assert accepted == set(range(1, channel.next_seq)), "the origin counts with gaps"
        delivered = set(site.seqs(name))
        expired = set(site.expired_seqs[name])
        dropped = {drop.seq for drop in self.robot.dropped_out if drop.topic == name}
        unaccounted = accepted - delivered - expired - dropped
        assert not unaccounted, f"{name}: neither delivered nor reported: {sorted(unaccounted)}"
        turns = site.turns[channel.stream.id]
        skipped = -sum(turn for turn in turns if turn < 0)
        missing = accepted - delivered - expired
        assert skipped == len(missing), f"{name}: {skipped} skipped, but {sorted(missing)} are missing"
        if topic.spec.lifespan_s is None and topic.spec.retention_s > 100.0:
            assert delivered == accepted, f"{name}: {sorted(accepted - delivered)} were dropped without a reason"
        lies = dropped & delivered
        reasons = {drop.reason for drop in self.robot.dropped_out if drop.topic == name and drop.seq in lies}
        # Its sender gave up while the confirmation was under way; of nothing else may a delivery be unknown.
        assert reasons <= {DropReason.UNCONFIRMED}, f"{name}: {reasons} reported, but delivered"

    def _check_latched(self, channel: OutChannel, topic: Topic) -> None:
        """Whoever is there has the newest messages, `depth` of them where none may be lost or overtaken."""
        if topic.spec.lifespan_s is not None or topic.spec.max_rate_hz is not None or topic.spec.retention_s < 100.0:
            return
        last = channel.next_seq - 1
        wanted = list(range(max(1, last - topic.spec.depth + 1), last + 1))
        if not topic.spec.reliable:
            wanted = wanted[-1:]
        for client in self.world.clients.values():
            if client is self.robot or not client.core.subscription.patterns:
                continue
            seqs = client.seqs(channel.stream.id.topic)
            assert seqs[-len(wanted) :] == wanted, f"{client.name} {channel.stream.id.topic}: {seqs[-5:]} not {wanted}"

    def _check_memory(self) -> None:
        """What a run leaves behind is bounded by what is open."""
        streams = len(self.channels)
        for link in self.world.links():
            assert len(link.taking.streams) <= streams and len(link.sender.channels) <= streams
            assert link.reassembly.held_bytes == 0
            assert not any(stream.reports for stream in link.taking.streams.values())
            assert not any(channel.gaps for channel in link.sender.channels.values() if not channel.retained)
        assert not self.world.relay.hub.streams.draining


def _body(size: int, seq: int) -> bytes:
    return (b"%08d" % seq * (size // 8 + 1))[:size]
