"""Relay and clients over the virtual-time network: the promises, end to end."""

import pytest

from sern_core.path.congestion.fixed import FixedWindow
from sern_core.vocabulary.types import PriorityClass
from sern_sim.models import LinkModel
from tests.world import World, spec


def thin(rate_bps: float = 4e6, delay_s: float = 0.025, **more: object) -> LinkModel:
    return LinkModel(rate_bps=rate_bps, delay_s=delay_s, **more).as_stream()  # type: ignore[arg-type]


def test_one_message_arrives_whole_and_with_its_age() -> None:
    world = World()
    robot = world.client("robot", thin())
    site = world.client("site", patterns=["/robot/.*"])
    channel = robot.publish("/robot/map", spec(reliable=True), definition="string data")
    world.network.at(1.0, lambda now: robot.core.send(channel, b"x" * 100_000, 123, now=now), node=robot)
    world.run(3.0)
    assert [(got.seq, got.body) for got in site.got] == [(1, b"x" * 100_000)]
    # Serialising 100 kB at 4 Mbit/s takes 0.2 s; the delay is 25 ms.
    assert site.got[0].age_s == pytest.approx(0.23, abs=0.05)
    assert site.opened[0].info.definition == "string data"
    assert channel.counters.delivered == 1
    world.validate()


def test_pose_stays_fresh_under_overload() -> None:
    world = World()
    robot = world.client("robot", thin())
    site = world.client("site", patterns=["/robot/.*"])
    pose = robot.publish("/robot/odom", spec(PriorityClass.CONTROL))
    cloud = robot.publish("/robot/points", spec(PriorityClass.BULK))
    world.network.every(0.02, lambda now: robot.core.send(pose, b"p" * 100, 0, now=now), node=robot)
    world.network.every(0.1, lambda now: robot.core.send(cloud, b"c" * 100_000, 0, now=now), node=robot)
    world.run(12.0)
    late = [got for got in site.on("/robot/odom") if got.at_s - world.network.start_s > 2.0]
    ages = sorted(got.age_s for got in late)
    assert len(late) >= 0.95 * 50 * 10
    assert ages[int(len(ages) * 0.99)] < 0.060
    assert len(site.on("/robot/points")) >= 12 * 4 * 0.8  # of the 5 a second that fit
    world.validate()


@pytest.mark.parametrize("lossless", [True, False])
def test_reliable_survives_a_relay_restart_once_and_in_order(lossless: bool) -> None:
    world = World(lossless=lossless)
    model = thin() if lossless else LinkModel(rate_bps=4e6, delay_s=0.025, loss=0.02)
    robot = world.client("robot", model)
    site = world.client("site", model, patterns=["/robot/.*"])
    log = robot.publish("/robot/log", spec(reliable=True))
    bodies: list[bytes] = []

    def offer(now: float) -> None:
        if len(bodies) < 400:
            bodies.append(b"%06d" % len(bodies) * 100)
            assert robot.core.send(log, bodies[-1], 0, now=now)

    world.network.every(0.02, offer, node=robot)
    world.run(3.0)
    world.restart_relay()
    world.run(3.0)
    world.restart_relay()
    world.run(20.0)
    assert [got.body for got in site.got] == bodies
    assert log.counters.delivered == 400
    world.validate()


@pytest.mark.parametrize(("size", "rate_bps"), [(100, 0.125e6), (700, 0.25e6), (2000, 0.25e6)])
@pytest.mark.parametrize("lossless", [True, False])
def test_thirteen_times_as_much_class_control_as_the_link_carries_leaves_a_way_for_what_must_be_said(
    lossless: bool, size: int, rate_bps: float
) -> None:
    """The window is open now and then, and class control alone takes it each time."""
    world = World(lossless=lossless)
    model = LinkModel(rate_bps=rate_bps, delay_s=0.025)
    robot = world.client("robot", model.as_stream() if lossless else model)
    site = world.client("site", patterns=["/robot/.*"])
    pose = robot.publish("/robot/pose", spec(PriorityClass.CONTROL, depth=10))
    robot.every(size * 8 / (13 * rate_bps), pose, b"p" * size)
    world.run(10.0)  # what was sent before the link's capacity was known has left its queue
    robot.publish("/robot/chat", spec(reliable=True), definition="string data")
    world.until(lambda: len(site.opened) == 2, within_s=2.0, what="the site hears of another stream")
    world.validate()


def test_urgent_messages_that_keep_the_window_shut_leave_a_way_for_what_must_be_said() -> None:
    """Class control passes the window, and its bytes in flight alone are more than the window."""
    world = World()
    robot = world.client("robot", thin(rate_bps=1e6, delay_s=0.25))
    site = world.client("site", patterns=["/robot/.*"])
    pose = robot.publish("/robot/pose", spec(PriorityClass.CONTROL))
    robot.every(0.02, pose, b"p" * 700)
    world.until(lambda: site.on("/robot/pose"), what="poses")
    lane = robot.core.link.lane
    lane.estimator = FixedWindow(1_000, rate_bps=1e6)
    world.run(2.0)
    shut: list[bool] = []
    world.network.every(0.001, lambda _now: shut.append(not lane.window_open))
    robot.publish("/robot/chat", spec(reliable=True), definition="string data")
    world.until(lambda: len(site.opened) == 2, what="the site hears of another stream")
    assert shut and all(shut)
    world.validate()
