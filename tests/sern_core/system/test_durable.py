"""Durable topics in virtual time: whatever dies, what was acknowledged arrives once and in order."""

import random
from collections.abc import Callable
from dataclasses import replace

import pytest

from sern_core.vocabulary.errors import UsageError
from sern_core.vocabulary.message import TopicSpec
from sern_core.vocabulary.types import PriorityClass, Reliability
from sern_sim.models import LinkModel, Window
from tests.exploring import seeds
from tests.sern_core.system.durable_world import DurableRelay, DurableRobot, SimDisk
from tests.world import World

SPEC = TopicSpec(
    priority=PriorityClass.STATE,
    reliability=Reliability.RELIABLE,
    depth=10,
    lifespan_s=None,
    retention_s=1e6,
    durable=True,
)
TOPIC = "/robot/log"
THIN = LinkModel(rate_bps=256e3, delay_s=0.05, disconnect_after_s=2.0, reconnect_s=0.5).as_stream()


class Play:
    """A robot that publishes ten times a second, a site that is there all along, and a relay. Robot and relay have
    disks. `site`: the link of the site."""

    def __init__(self, seed: int, *, relay_disk: bool = True, site: LinkModel = THIN) -> None:
        self.rng = random.Random(seed)
        world = self.world = World(seed).watch(0.25)
        self.robot = DurableRobot(world, world.client("robot", THIN), SimDisk(), TOPIC, SPEC)
        self.relay = DurableRelay(world, SimDisk()) if relay_disk else None
        self.site = world.client("site", site, patterns=["/robot/.*"])
        world.network.every(0.5, self.robot.look)
        world.run(8.0)
        self.stop = world.network.every(0.1, lambda _now: self.robot.offer()).cancel

    def kill_robot(self) -> None:
        self.robot.begin(self.world.restart_client("robot"))

    def kill_relay(self) -> None:
        self.world.restart_relay()
        if self.relay is not None:
            self.relay.begin()

    def kill_both(self) -> None:
        self.kill_relay()
        self.kill_robot()

    def robot_link(self) -> None:
        self.world.hops["robot"].break_connection()

    def site_link(self) -> None:
        self.world.hops["site"].break_connection()

    def finish(self) -> list[int]:
        """Let everything arrive. Returns what the site got, in its order."""
        self.stop()
        self.world.run(2.0)
        self.world.until(self.world.quiet, within_s=600.0, what="everything has arrived")
        self.world.run(2.0)
        return [int(got.body) for got in self.site.on(TOPIC)]

    def check(self) -> None:
        got = self.finish()
        assert got == sorted(set(got)), "twice, or out of order"
        lost = self.robot.acknowledged - set(got)
        assert not lost, f"acknowledged, and lost: {sorted(lost)}"
        assert len(got) > 10


@pytest.mark.parametrize("seed", seeds(25))
@pytest.mark.parametrize("relay_disk", [True, False])
def test_what_was_acknowledged_arrives_once_whatever_dies(seed: int, relay_disk: bool) -> None:
    play = Play(seed, relay_disk=relay_disk)
    deeds: list[Callable[[], None]] = [
        play.kill_robot, play.kill_relay, play.kill_both, play.robot_link, play.site_link,
    ]  # fmt: skip
    for _ in range(play.rng.randint(1, 5)):
        play.world.run(play.rng.choice((0.03, 0.3, 1.0, 3.0)))
        play.rng.choice(deeds)()
    play.world.run(3.0)
    play.check()


def test_the_relay_frees_the_robot_of_what_a_site_that_is_away_will_get() -> None:
    """The site is cut off for a minute, in which relay and robot are killed: the robot keeps nothing of what the relay
    has stored for the site."""
    away = replace(THIN, blackouts=(Window(10.0, 70.0),))
    play = Play(3, site=away)
    play.world.run(12.0)
    assert len(play.robot.channel.retained) < 15
    play.kill_both()
    play.world.run(12.0)
    assert len(play.robot.channel.retained) < 15 and len(play.site.on(TOPIC)) < 30
    play.world.run(50.0)
    play.check()
    assert play.robot.acknowledged == {int(got.body) for got in play.site.on(TOPIC)}


def test_a_full_disk_acknowledges_nothing_and_loses_nothing() -> None:
    play = Play(5)
    play.world.run(1.0)
    play.robot.disk.full = True
    before = len(play.robot.acknowledged)
    play.world.run(2.0)
    assert len(play.robot.acknowledged) <= before + 1
    play.robot.disk.full = False
    play.world.run(1.0)
    play.check()
    assert play.robot.acknowledged == set(range(1, play.robot.offered + 1))


def test_a_full_disk_of_the_relay_leaves_messages_with_the_robot() -> None:
    """The site gets them all the same, and the robot keeps what the site has not confirmed."""
    play = Play(6)
    assert play.relay is not None
    play.relay.disk.full = True
    play.world.run(2.0)
    play.kill_relay()
    play.world.run(2.0)
    play.relay.disk.full = False
    play.check()


def test_a_topic_that_is_not_durable_any_more_leaves_nothing() -> None:
    """Its stream ends, what is left on disk goes, and the name is free for a topic of another rule."""
    play = Play(7)
    play.world.run(1.0)
    play.stop()
    robot = play.robot
    robot.disk.commit_s = 0.0
    robot.topics.give_way(robot.info.name)
    play.world.run(1.0)
    assert robot.disk.contents is not None
    assert [kept.rows for kept in robot.disk.contents.streams.values()] == [[]]
    client = robot.client
    client.core.publish(robot.info, replace(SPEC, durable=False), now=client.now)


def test_a_name_is_offered_once() -> None:
    robot = Play(8).robot
    with pytest.raises(UsageError, match=r"/robot/log is offered already"):
        robot.topics.publish(robot.info, SPEC)


def test_who_goes_shortly_before_the_relay_dies_gets_nothing_twice() -> None:
    """A site ends, and a moment later the relay: the next relay knows how far the site was."""
    play = Play(9)
    play.world.run(1.6)
    before = [int(got.body) for got in play.site.on(TOPIC)]
    play.site.core.link.close("it ends", now=play.site.now)
    play.world.run(0.2)
    before = [int(got.body) for got in play.site.on(TOPIC)]
    play.kill_relay()
    play.site = play.world.restart_client("site")
    got = [*before, *play.finish()]
    assert got == sorted(set(got)) and len(got) > len(before) > 10


def test_a_site_knows_what_it_has_of_a_stream_that_was_gone_for_a_while() -> None:
    """The relay dies before what it has handed on is on its disk, and the robot with it. The next relay delivers what
    it has and lets go of the stream, and only then the robot is back, with what nobody has confirmed to it."""
    play = Play(10)
    assert play.relay is not None
    play.world.run(1.0)
    play.relay.disk.full = True
    play.world.run(1.0)
    dead = play.robot.client
    play.world.restart_relay()
    play.relay.disk.full = False
    play.relay.begin()
    dead.core.link.disconnected(now=dead.now)
    play.world.hops["robot"].break_connection()
    again = play.world.restart_client("robot")
    play.world.run(20.0)
    play.robot.begin(again)
    play.world.run(3.0)
    play.check()


@pytest.mark.parametrize("relay_disk", [True, False])
def test_what_a_robot_acknowledged_before_it_knew_for_whom_waits_for_those_who_come_back(relay_disk: bool) -> None:
    """Robot and relay die before the robot has on disk who takes the topic, and the robot is back before the site: the
    next relay knows nothing of the site, and does not say that nobody wants the topic."""
    play = Play(11, relay_disk=relay_disk, site=replace(THIN, reconnect_s=8.0))
    play.robot.disk = SimDisk()
    play.kill_both()
    play.world.run(20.0)
    play.check()
    assert min(int(got.body) for got in play.site.on(TOPIC)) == 1


def test_what_nobody_takes_is_let_go_of_when_the_relay_has_been_there_for_a_while() -> None:
    play = Play(12)
    play.site.subscribe("/other")
    play.robot.disk = SimDisk()
    play.kill_both()
    play.world.run(10.0)
    assert len(play.robot.channel.retained) > 50
    play.world.run(60.0)
    assert len(play.robot.channel.retained) < 5
