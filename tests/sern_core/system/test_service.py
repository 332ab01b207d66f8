"""Who is served when, seen on the wire: classes, floors, preemption, ages on other clocks, stalls, refusals."""

from collections import defaultdict
from collections.abc import Iterator
from typing import NamedTuple

import pytest

from sern_core.link.control_stream import CONTROL_CHANNEL_ID
from sern_core.link.link import Link
from sern_core.relay.access import AccessRule, AccessTable
from sern_core.stream.out_channel import OutChannel
from sern_core.vocabulary.params import SchedulerParams
from sern_core.vocabulary.types import DropReason, Ordering, PriorityClass
from sern_core.wire import framing
from sern_sim.models import LinkModel, RateStep, Window
from tests.world import Clock, SimClient, World, spec

THIN = LinkModel(rate_bps=1e6, delay_s=0.025).as_stream()
CLASSES = (PriorityClass.CONTROL, PriorityClass.STATE, PriorityClass.BULK)


class Piece(NamedTuple):
    """One DATA frame as it left."""

    at_s: float
    channel_id: int
    seq: int
    offset: int
    nbytes: int


class Tap:
    """Reads what leaves a client."""

    def __init__(self, client: SimClient) -> None:
        self.pieces: list[Piece] = []
        self.datagrams = 0
        self.pings = 0
        self._now = 0.0
        client.port.sent = self._sent

    def _sent(self, data: bytes, now: float) -> None:
        if data[2] == framing.Kind.DATA:
            self._now = now
            self.datagrams += 1
            framing.decode_frames(data, self)

    def on_data(
        self,
        flags: int,
        channel_id: int,
        seq: int,
        offset: int,
        total: int,
        body: framing.Datagram,
        stamp_ns: int,
        age_s: float,
        codec: int,
        error_s: float,
    ) -> None:
        self.pieces.append(Piece(self._now, channel_id, seq, offset, len(body)))

    def on_ack(self, lane: int, highest: int, sack: int, echo_us: int, received_us: int, cum_bytes: int) -> None: ...

    def on_watermark(self, channel_id: int, delivered: int) -> None: ...

    def on_ping(self) -> None:
        self.pings += 1

    def of(self, channel: OutChannel) -> Iterator[Piece]:
        return (piece for piece in self.pieces if piece.channel_id == channel.channel_id)


def overloaded(
    world: World, rates: dict[PriorityClass, float], *, size: int = 5_000, scheduler: SchedulerParams | None = None
) -> tuple[SimClient, SimClient, dict[PriorityClass, OutChannel], Tap]:
    """A robot that offers each class at its rate in bits per second over `THIN`."""
    robot = world.client("robot", THIN, scheduler=scheduler)
    site = world.client("site", patterns=["/robot/.*"])
    channels = {
        priority: robot.publish(f"/robot/{priority.name.lower()}", spec(priority, depth=10)) for priority in rates
    }
    world.run(2.0)
    for priority, rate_bps in rates.items():
        robot.every(8 * size / rate_bps, channels[priority], bytes(size), first_s=0.01 * priority)
    return robot, site, channels, Tap(robot)


def shares(tap: Tap, channels: dict[PriorityClass, OutChannel], since_s: float) -> dict[PriorityClass, float]:
    nbytes: dict[PriorityClass, int] = defaultdict(int)
    for priority, channel in channels.items():
        nbytes[priority] = sum(piece.nbytes for piece in tap.of(channel) if piece.at_s >= since_s)
    total = sum(nbytes.values())
    return {priority: nbytes[priority] / total for priority in channels}


def test_no_class_starves_and_each_has_its_share() -> None:
    """Every class alone would fill the link twice: class 0 gets its bucket's half, bulk its tenth, state the rest."""
    world = World().watch()
    _, _, channels, tap = overloaded(world, dict.fromkeys(CLASSES, 2e6))
    world.run(14.0)
    got = shares(tap, channels, world.now - 10.0)
    assert got[PriorityClass.CONTROL] == pytest.approx(0.5, abs=0.07)
    assert got[PriorityClass.BULK] == pytest.approx(0.1, abs=0.03)
    assert got[PriorityClass.STATE] == pytest.approx(0.4, abs=0.08)


def test_below_its_bucket_class_0_waits_for_nobody() -> None:
    """Lower classes go ahead of it only from their floors: a tenth of the bytes each."""
    world = World().watch()
    _, site, channels, tap = overloaded(
        world, {PriorityClass.CONTROL: 300e3, PriorityClass.STATE: 2e6, PriorityClass.BULK: 2e6}, size=1_000
    )
    world.run(12.0)
    got = shares(tap, channels, world.now - 8.0)
    assert got[PriorityClass.CONTROL] >= 0.25 and got[PriorityClass.BULK] == pytest.approx(0.1, abs=0.03)
    ages = sorted(g.age_s for g in site.on("/robot/control") if g.at_s > world.now - 8.0)
    assert ages[int(0.99 * len(ages))] < 0.025 + 0.06
    assert channels[PriorityClass.CONTROL].counters.dropped == 0


def test_a_class_that_is_alone_has_the_whole_link() -> None:
    for priority in CLASSES:
        world = World().watch()
        overloaded(world, {priority: 2e6})
        world.run(3.0)
        before = world.hops["robot"].forward.stats
        world.run(5.0)
        assert world.hops["robot"].forward.stats.minus(before).utilisation > 0.85, priority.name


def test_a_newcomer_goes_ahead_at_the_next_fragment_and_the_rest_resumes() -> None:
    world = World().watch()
    robot = world.client("robot", THIN)
    site = world.client("site", patterns=["/robot/.*"])
    cloud = robot.publish("/robot/cloud", spec(PriorityClass.BULK))
    plan = robot.publish("/robot/plan", spec(PriorityClass.STATE))
    world.run(2.0)
    robot.send(cloud, bytes(100_000))
    world.run(0.3)
    tap = Tap(robot)
    robot.send(plan, bytes(1000))
    world.run(3.0)
    before = [
        piece for piece in tap.pieces if piece.channel_id == cloud.channel_id and piece.at_s < next(tap.of(plan)).at_s
    ]
    assert len(before) <= 1, "at most the fragment that was due"
    assert site.got[0].topic == "/robot/plan" and site.got[1].body == bytes(100_000)
    offsets = [piece.offset for piece in tap.of(cloud)]
    assert offsets == sorted(set(offsets)) and cloud.counters.delivered == 1, "nothing is sent twice"


def test_only_what_was_lost_is_sent_again() -> None:
    world = World(lossless=False).watch()
    robot = world.client("robot", LinkModel(rate_bps=1e6, delay_s=0.025, loss=0.1))
    site = world.client("site", patterns=["/robot/.*"])
    cloud = robot.publish("/robot/cloud", spec(reliable=True))
    world.run(2.0)
    tap = Tap(robot)
    robot.send(cloud, bytes(200_000))
    world.until(lambda: cloud.watermark == 1)
    sent = sum(piece.nbytes for piece in tap.of(cloud))
    lost = world.hops["robot"].forward.stats.lost_packets
    assert site.got[0].body == bytes(200_000)
    # A lost acknowledgement costs nothing, a lost fragment one more; a late one may look lost now and then.
    assert sent <= 200_000 + 1200 * (lost + 5)


def test_control_messages_keep_to_the_window_and_let_class_0_pass() -> None:
    """Six hundred announcements at once, at 256 kbit/s: a pose beside them is hardly later than alone."""
    world = World()
    model = LinkModel(rate_bps=256e3, delay_s=0.05).as_stream()
    robot = world.client("robot", model)
    site = world.client("site", patterns=["/robot/odom"])
    pose = robot.publish("/robot/odom", spec(PriorityClass.CONTROL))
    world.run(2.0)
    robot.every(0.05, pose, bytes(100))
    world.run(5.0)
    tap = Tap(robot)
    began_s = world.now
    for number in range(600):
        robot.publish(f"/robot/t{number}", spec(PriorityClass.BULK))
    world.until(lambda: len(world.relay.hub.relayed) == 601)
    assert sum(p.nbytes for p in tap.pieces if p.channel_id == CONTROL_CHANNEL_ID) > 100_000
    ages = [g.age_s for g in site.got if g.at_s > began_s]
    assert len(ages) > 50 and max(ages) < 0.5, "the window at its start; all at once they would take 4 s"


CLOCKS = [
    (Clock(), Clock(), Clock()),
    (Clock(-9e4, 100.0), Clock(12345.6, -100.0), Clock(1e6, 50.0)),
]


@pytest.mark.parametrize("clocks", CLOCKS)
@pytest.mark.parametrize("lossless", [True, False])
@pytest.mark.parametrize("asymmetric", [True, False])
def test_a_command_is_never_late_whatever_the_clocks(
    clocks: tuple[Clock, Clock, Clock], lossless: bool, asymmetric: bool
) -> None:
    """Over two hops of changing delay, with clocks that agree on nothing; 0.3 s as the simulator's clock sees it."""
    world = World(lossless=lossless, relay_clock=clocks[1]).watch()

    def model(delay_s: float) -> LinkModel:
        made = LinkModel(
            rate_bps=500e3,
            delay_s=delay_s,
            jitter_s=0.02,
            loss=0.0 if lossless else 0.05,
            rate_steps=(RateStep(5.0, 60e3), RateStep(9.0, 500e3)),
            blackouts=(Window(7.0, 7.4), Window(10.0, 13.0)),
        )
        return made.as_stream() if lossless else made

    slow, quick = model(0.1), model(0.005)
    desk = world.client("desk", slow, quick if asymmetric else slow, clock=clocks[0])
    robot = world.client("robot", slow if asymmetric else quick, quick, clock=clocks[2], patterns=["/robot/cmd_vel"])
    command = desk.publish("/robot/cmd_vel", spec(PriorityClass.CONTROL, lifespan_s=0.3))
    cloud = desk.publish("/robot/cloud", spec(PriorityClass.BULK))
    world.run(3.0)
    desk.every(0.02, command, bytes(100))
    desk.every(0.2, cloud, bytes(20_000))
    world.run(12.0)
    ages = [got.at_s - desk.sent["/robot/cmd_vel", got.seq][0] for got in robot.got]
    assert len(ages) > 100 and max(ages) <= 0.3 * 1.0002
    for got in robot.got:
        true_s = got.at_s - desk.sent["/robot/cmd_vel", got.seq][0]
        assert abs(true_s - got.age_s) <= got.error_s + 1e-4


def test_a_stall_is_found_and_probed_with_fresh_poses_and_the_first_after_it_is_fresh() -> None:
    world = World(lossless=False).watch()
    robot = world.client("robot", LinkModel(rate_bps=1e6, delay_s=0.025, blackouts=(Window(4.0, 12.0),)))
    site = world.client("site", patterns=["/robot/.*"])
    pose = robot.publish("/robot/odom", spec(PriorityClass.CONTROL))
    cloud = robot.publish("/robot/cloud", spec(PriorityClass.BULK))
    world.run(2.0)
    robot.every(0.02, pose, bytes(100))
    robot.every(0.05, cloud, bytes(10_000))
    world.run(3.01)  # not between a probe and its copy
    link = robot.core.link
    assert [link.lane.stalled, link.lane.estimator.rate_bps] == [True, None]
    tap = Tap(robot)
    world.run(4.99)
    probes = list(tap.of(pose))
    assert 49 <= len({probe.seq for probe in probes}) <= 51, "one every 100 ms"
    first_at_s = {probe.seq: probe.at_s for probe in reversed(probes)}  # a copy may follow
    assert all(at_s - robot.sent["/robot/odom", seq][0] < 0.021 for seq, at_s in first_at_s.items())
    assert not list(tap.of(cloud)), "nothing else"
    world.run(3.0)
    came_back_s = world.network.start_s + 12.0
    first = next(got for got in site.got if got.at_s > came_back_s)
    assert first.topic == "/robot/odom" and first.at_s - came_back_s < 0.2 and first.age_s < 0.06
    world.run(6.0)
    assert not link.lane.stalled
    assert len([g for g in site.on("/robot/cloud") if g.at_s > world.now - 3.0]) >= 24


def test_the_papers_ordering_end_to_end() -> None:
    """Alg. prioritize as printed: what exceeds an interval's budget is never sent, a stale one of bulk is dropped."""
    world = World().watch()
    robot = world.client("robot", THIN, scheduler=SchedulerParams(ordering=Ordering.PAPER))
    site = world.client("site", patterns=["/robot/.*"])
    pose = robot.publish("/robot/odom", spec(PriorityClass.CONTROL))
    scan = robot.publish("/robot/scan", spec(PriorityClass.BULK, lifespan_s=0.5, depth=10))
    log = robot.publish("/robot/log", spec(PriorityClass.STATE, reliable=True))
    world.run(3.0)
    robot.every(0.02, pose, bytes(100))
    robot.every(0.02, scan, bytes(1000))
    robot.every(0.5, log, bytes(100))
    world.run(5.0)
    huge = robot.publish("/robot/huge", spec(PriorityClass.BULK, lifespan_s=0.5))
    world.run(0.5)
    robot.every(1.0, huge, bytes(200_000))
    world.run(5.0)
    # One of each topic an interval of 50 ms.
    assert len(site.on("/robot/odom")) > 180 and len(site.on("/robot/scan")) > 150
    assert site.seqs("/robot/log") == list(range(1, len(site.on("/robot/log")) + 1)) and len(site.on("/robot/log")) > 15
    assert not site.on("/robot/huge") and huge.counters.by_reason[DropReason.STALE] > 0


def test_definitions_travel_once_and_are_there_before_the_stream_opens() -> None:
    world = World().watch()
    robots = [world.client(f"robot{n}") for n in (1, 2)]
    taps = [Tap(robot) for robot in robots]
    text = "string data\n" * 1000
    for robot in robots:
        for number in range(3):
            robot.publish(f"/{robot.name}/t{number}", spec(), definition=text)
        world.run(2.0)
    sites = [world.client(f"site{n}", THIN, patterns=[".*"]) for n in (1, 2)]
    world.run(3.0)
    for site in sites:
        assert len(site.opened) == 6 and all(stream.info.definition == text for stream in site.opened)
    control = [sum(p.nbytes for p in tap.pieces if p.channel_id == CONTROL_CHANNEL_ID) for tap in taps]
    assert control[1] < control[0], "the relay has it from the first robot"


def test_names_are_refused_by_name_and_nothing_else_stops() -> None:
    access = AccessTable(
        [
            AccessRule(client="robot1", publish=("/robot1/.*", "/tf", "/shared"), subscribe=(".*",)),
            AccessRule(client="robot2", publish=(".*",), subscribe=(".*",)),
        ]
    )
    world = World(access=access).watch()
    one, two = (world.client(name, patterns=[".*"]) for name in ("robot1", "robot2"))
    fine = one.publish("/robot1/odom", spec())
    shared = one.publish("/shared", spec())
    forbidden = one.publish("/robot2/cmd_vel", spec())
    tf1 = one.publish("/tf", spec(many_writers=True, depth=10))
    world.run(1.0)
    stolen = two.publish("/shared", spec())
    tf2 = two.publish("/tf", spec(many_writers=True, depth=10))
    world.run(1.0)
    assert [code for code, _ in one.refusals] == ["forbidden"]
    assert "robot1 may not publish /robot2/cmd_vel" in one.refusals[0][1] and "\n" not in one.refusals[0][1]
    assert [code for code, _ in two.refusals] == ["name_taken"]
    assert "robot1 owns that name" in two.refusals[0][1]
    assert forbidden.wanted is False and stolen.wanted is False
    for channel in (fine, shared, tf1):
        one.send(channel, b"1")
    two.send(tf2, b"2")
    one.send(forbidden, b"x")
    world.run(1.0)
    assert {(got.topic, got.body) for got in two.got} == {("/robot1/odom", b"1"), ("/shared", b"1"), ("/tf", b"1")}
    assert {(got.topic, got.body) for got in one.got} == {("/tf", b"2")}, "and nothing of its own comes back"
    assert forbidden.counters.dropped == forbidden.counters.offered == 1


def test_rules_that_change_end_what_they_no_longer_allow() -> None:
    world = World().watch()
    robot = world.client("robot")
    site = world.client("site", patterns=["/robot/.*"])
    log = robot.publish("/robot/log", spec(reliable=True))
    pose = robot.publish("/robot/odom", spec())
    world.run(2.0)
    rules = AccessTable([AccessRule(client=".*", publish=("/robot/odom",), subscribe=(".*",))])
    world.network.after(0.0, lambda _now: world.relay.hub.revoke(rules, now=world.relay.now))
    world.run(1.0)
    assert [code for code, _ in robot.refusals] == ["forbidden"] and log.wanted is False and pose.wanted is True
    assert robot.send(log, b"x") and robot.send(pose, b"y")
    world.run(1.0)
    assert [got.topic for got in site.got] == ["/robot/odom"]
    assert log.counters.dropped == 1 and not log.retained


def test_a_client_above_its_limit_is_held_to_it_and_told() -> None:
    access = AccessTable(
        [AccessRule(client=".*", publish=(".*",), subscribe=(".*",), replay=(".*",), max_rate_hz=20.0)]
    )
    world = World(access=access).watch()
    robot = world.client("robot")
    site = world.client("site", patterns=["/robot/.*"])
    log = robot.publish("/robot/log", spec(reliable=True))
    world.run(2.0)
    robot.every(0.01, log, b"x")
    world.run(5.0)
    delivered, expired = site.seqs("/robot/log"), site.expired_seqs["/robot/log"]
    assert 75 <= len(delivered) <= 150
    assert site.turns[log.stream.id] == list(range(1, len(delivered) + len(expired) + 1))
    dropped = {drop.seq for drop in robot.dropped_out}
    assert {drop.reason for drop in robot.dropped_out} == {DropReason.RATE_CAP}
    assert not dropped & set(delivered) and set(expired) <= dropped


def test_an_idle_link_says_little() -> None:
    world = World()
    robot = world.client("robot", LinkModel(delay_s=0.05).as_stream())
    robot.publish("/robot/odom", spec())
    world.run(5.0)
    before = world.hops["robot"].forward.stats
    world.run(60.0)
    sent = world.hops["robot"].forward.stats.minus(before)
    assert sent.sent_packets / 60 < 5 and sent.sent_bytes / 60 < 300


def links_of(world: World) -> list[Link]:
    return list(world.links())


def test_nothing_grows_while_clients_come_and_go() -> None:
    world = World(lossless=False).watch(1.0)
    robot = world.client("robot", LinkModel(rate_bps=1e6, delay_s=0.02, loss=0.02))
    site = world.client("site", LinkModel(rate_bps=1e6, delay_s=0.02, loss=0.02), patterns=["/robot/.*"])
    channels = [robot.publish(f"/robot/t{n}", spec(reliable=bool(n % 2), latched=n > 2, depth=3)) for n in range(4)]
    for channel in channels:
        robot.every(0.1, channel, bytes(500))
    for _ in range(6):
        world.run(3.0)
        world.hops["site"].break_connection()
        world.run(2.0)
        site = world.restart_client("site")
        world.run(2.0)
        world.restart_relay()
    world.run(10.0)
    assert len(site.opened) == 4
    for link in links_of(world):
        assert len(link.taking.streams) <= 4 and len(link.sender.channels) <= 4 and len(link.definitions) <= 1
        assert link.lane.flight.inflight_bytes < 100_000 and len(link.lane.flight.packets) < 500
        assert all(len(channel.retained) < 200 for channel in link.sender.channels.values())
    assert len(world.relay.hub.links) == 2 and not world.relay.hub.streams.draining


@pytest.mark.parametrize("depth", [1, 2, 5])
@pytest.mark.parametrize("downlink", [False, True])
def test_robots_of_one_rate_all_get_through_a_full_link(depth: int, downlink: bool) -> None:
    """Five robots send the same at the same rate, one after the other, over a link that carries six tenths of it. Whose
    sample is always the youngest is replaced by its next one before its turn comes, unless the topic's wait counts."""
    size, period_s, count = 10_000, 0.05, 5
    thin = LinkModel(rate_bps=0.6 * 8 * size * count / period_s, delay_s=0.005).as_stream()
    for start in range(8):
        world = World().watch()
        robot = world.client("robot", None if downlink else thin)
        site = world.client("site", thin if downlink else None, patterns=["/robot/.*"])
        topics = [f"/robot/{number}" for number in range(count)]
        channels = [robot.publish(topic, spec(PriorityClass.STATE, depth=depth)) for topic in topics]
        world.run(2.0)
        for number, channel in enumerate(channels):
            first_s = 0.001 * start + number * period_s / (count + 0.5)
            robot.every(period_s, channel, bytes(size), first_s=first_s)
        world.run(6.0)
        got = [len(site.on(topic)) for topic in topics]
        assert min(got) >= 0.5 * max(got), f"started {start} ms later: {got}"
