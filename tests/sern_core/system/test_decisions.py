"""Every event of the decision trace, and every reason to hold a message, is made to happen in virtual time."""

from collections.abc import Callable
from functools import cache, partial
from typing import Final

import pytest

from sern_core.link.holds import LOOK_S, LOOKED_AT
from sern_core.link.view import LinkSettings
from sern_core.site.lease import CommandLease
from sern_core.stream.out_channel import OutChannel
from sern_core.summaries.spec import SummaryLevel
from sern_core.vocabulary.codec_names import Compression
from sern_core.vocabulary.params import SchedulerParams
from sern_core.vocabulary.trace import LINK, HoldReason, TraceEvent, TraceRecord
from sern_core.vocabulary.types import ClientName, DropReason, Ordering, PriorityClass, TopicName
from sern_sim.models import LinkModel, RateStep, Window
from tests.sensors import FittedTopic
from tests.sern_core.link.test_lanes import TwoLanes, models
from tests.sern_core.link.test_priority_lane import PriorityScene, stream
from tests.world import SimClient, World, spec

THIN = LinkModel(rate_bps=500e3, delay_s=0.02).as_stream()
POSE, POINTS = TopicName("/robot/pose"), TopicName("/robot/points")


def pair(
    world: World, robot: LinkModel | None = None, *, scheduler: SchedulerParams | None = None
) -> tuple[SimClient, SimClient]:
    return world.client("robot", robot, scheduler=scheduler), world.client("site", patterns=["/robot/.*"])


def records(client: SimClient, topic: str = "") -> tuple[TraceRecord, ...]:
    return client.core.trace.records(TopicName(topic))


def relay_records(world: World, topic: str) -> tuple[TraceRecord, ...]:
    """What the relay knows of the way to the site."""
    return world.relay.hub.traces.of(ClientName("site")).records(TopicName(topic))


# --- events -----------------------------------------------------------------------------------------------------------


@cache
def crossing() -> tuple[World, SimClient, SimClient]:
    """A reliable message, and one of many fragments, over a thin link."""
    world = World()
    robot, site = pair(world, THIN)
    log, cloud = robot.publish("/robot/log", spec(reliable=True)), robot.publish("/robot/points", spec())
    world.run(2.0)
    assert robot.send(log, b"a line") and robot.send(cloud, bytes(50_000))
    world.until(world.quiet)
    return world, robot, site


def robot_of(played: tuple[World, SimClient, SimClient]) -> tuple[TraceRecord, ...]:
    return played[1].core.trace.records()


def site_of(played: tuple[World, SimClient, SimClient]) -> tuple[TraceRecord, ...]:
    return played[2].core.trace.records()


@cache
def rate_capped() -> tuple[TraceRecord, ...]:
    world = World()
    robot, _site = pair(world)
    pose = robot.publish("/robot/pose", spec(max_rate_hz=5.0))
    world.run(1.0)
    robot.every(0.05, pose, b"pose")
    world.run(1.0)
    return records(robot, "/robot/pose")


def refused() -> tuple[TraceRecord, ...]:
    world = World()
    robot, _site = pair(world)
    log = robot.publish("/robot/log", spec(reliable=True, max_queue_bytes=2_000))
    assert robot.send(log, bytes(1_000)) and not robot.send(log, bytes(1_000))
    return records(robot, "/robot/log")


def replayed() -> tuple[TraceRecord, ...]:
    world = World()
    robot, _site = pair(world)
    a_map = robot.publish("/robot/map", spec(latched=True))
    world.run(1.0)
    assert robot.send(a_map, b"map")
    world.run(1.0)
    world.restart_client("site")
    world.run(1.0)
    return relay_records(world, "/robot/map")


def encoding() -> tuple[TraceRecord, ...]:
    world = World(compress=True, encode_bytes_per_s=1e6)
    robot, _site = pair(world, THIN)
    log = robot.publish("/robot/log", spec(compression=Compression.ZSTD))
    world.run(1.0)
    assert robot.send(log, b"the hall is empty " * 10_000)
    world.until(world.quiet)
    return records(robot, "/robot/log")


def lost() -> tuple[TraceRecord, ...]:
    world = World(lossless=False)
    robot, _site = pair(world, LinkModel(rate_bps=1e6, delay_s=0.02, loss=0.2))
    log = robot.publish("/robot/log", spec(reliable=True))
    world.run(5.0)
    assert robot.send(log, bytes(50_000))
    world.until(world.quiet)
    return records(robot, "/robot/log")


@cache
def dropped() -> tuple[TraceRecord, ...]:
    world = World()
    robot, _site = pair(world)
    pose = robot.publish("/robot/pose", spec())
    assert robot.send(pose, b"1") and robot.send(pose, b"2")  # nobody is connected yet
    return records(robot, "/robot/pose")


def lease_expired() -> tuple[TraceRecord, ...]:
    """A lease ends, and the core is told as a site's bridge tells it."""
    world = World()
    robot, site = pair(world)
    command = robot.publish("/robot/cmd", spec(PriorityClass.CONTROL))
    world.run(1.0)
    assert robot.send(command, b"go")
    world.run(0.1)
    lease = CommandLease(0.5)
    lease.renew(born_s=site.now - site.on("/robot/cmd")[-1].age_s, now=site.now)
    while not lease.expired:
        world.run(0.05)
        if lease.due(now=site.now):
            site.core.lease_expired(command.stream.id, lease.after_s, now=site.now)
    return records(site, "/robot/cmd")


@cache
def down() -> tuple[TraceRecord, ...]:
    world = World()
    robot, _site = pair(world)
    world.run(1.0)
    world.hops["robot"].break_connection(reconnect_s=0.5)
    world.run(2.0)
    return records(robot, LINK)


@cache
def lanes() -> tuple[TraceRecord, ...]:
    path, datagrams = models(Window(4.0, 6.0))
    two = TwoLanes(stream=path, datagrams=datagrams)
    two.world.run(9.0)
    return records(two.robot, LINK)


def capacity() -> tuple[TraceRecord, ...]:
    world = World()
    robot, _site = pair(world, LinkModel(delay_s=0.02, rate_bps=4e6, rate_steps=(RateStep(8.0, 0.4e6),)).as_stream())
    cloud = robot.publish("/robot/points", spec(PriorityClass.BULK))
    world.run(1.0)
    robot.every(0.05, cloud, bytes(50_000))
    world.run(15.0)
    return records(robot, LINK)


@cache
def levels() -> tuple[TraceRecord, ...]:
    """A link of 0.5 Mbit/s and then ten times that, for clouds of 150 kB."""
    world = World(lossless=False)
    robot, _site = pair(world, LinkModel(delay_s=0.025, rate_bps=0.5e6, rate_steps=(RateStep(3.0, 5e6),)))
    clouds = FittedTopic(robot, "/robot/points", 150_000, 8_000, 10.0)
    world.run(20.0)
    assert clouds.fit.level is SummaryLevel.RAW
    return records(robot, LINK)


EVENTS: Final[dict[TraceEvent, Callable[[], tuple[TraceRecord, ...]]]] = {
    TraceEvent.QUEUED: lambda: robot_of(crossing()),
    TraceEvent.RATE_CAPPED: rate_capped,
    TraceEvent.REFUSED: refused,
    TraceEvent.REPLAYED: replayed,
    TraceEvent.HELD: rate_capped,
    TraceEvent.ENCODING: encoding,
    TraceEvent.BEGUN: lambda: robot_of(crossing()),
    TraceEvent.SENT: lambda: robot_of(crossing()),
    TraceEvent.LOST: lost,
    TraceEvent.ACKED: lambda: robot_of(crossing()),
    TraceEvent.CONFIRMED: lambda: robot_of(crossing()),
    TraceEvent.DROPPED: dropped,
    TraceEvent.DELIVERED: lambda: site_of(crossing()),
    TraceEvent.LEASE_EXPIRED: lease_expired,
    TraceEvent.LINK_UP: down,
    TraceEvent.LINK_DOWN: down,
    TraceEvent.LANE_USED: lanes,
    TraceEvent.LANE_SILENT: lanes,
    TraceEvent.LANE_ANSWERS: lanes,
    TraceEvent.CAPACITY: capacity,
    TraceEvent.SUMMARISED: levels,
    TraceEvent.WHOLE: levels,
}


@pytest.mark.parametrize("event", TraceEvent)
def test_every_event_is_recorded_where_it_happens(event: TraceEvent) -> None:
    found = [record for record in EVENTS[event]() if record.event is event]
    assert found, f"{event} is recorded nowhere"


def test_the_way_of_a_message_is_told_in_order() -> None:
    _world, robot, site = crossing()
    log = [record.event for record in records(robot, "/robot/log")]
    assert log == [TraceEvent.QUEUED, TraceEvent.SENT, TraceEvent.ACKED, TraceEvent.CONFIRMED]
    cloud = [record.event for record in records(robot, "/robot/points") if record.event is not TraceEvent.HELD]
    assert cloud == [TraceEvent.QUEUED, TraceEvent.BEGUN, TraceEvent.SENT, TraceEvent.ACKED]
    (arrived,) = records(site, "/robot/log")
    assert arrived.event is TraceEvent.DELIVERED and arrived.fields["origin"] == "robot"
    assert 0.02 < float(arrived.fields["age_s"]) < 0.2


# --- why a message is held --------------------------------------------------------------------------------------------


def busy(world: World, robot: SimClient) -> None:
    """Everything that a robot may have, over a link that carries a part of it."""
    for topic, priority, size, period_s in (
        ("/robot/pose", PriorityClass.CONTROL, 600, 0.02),
        ("/robot/cmd", PriorityClass.CONTROL, 400, 0.02),
        ("/robot/scan", PriorityClass.STATE, 3_000, 0.1),
        ("/robot/plan", PriorityClass.STATE, 9_000, 0.5),
        ("/robot/points", PriorityClass.BULK, 40_000, 0.5),
        ("/robot/image", PriorityClass.BULK, 60_000, 0.5),
    ):
        channel = robot.publish(topic, spec(priority))
        robot.every(period_s, channel, bytes(size), first_s=1.0)


@cache
def loaded() -> tuple[TraceRecord, ...]:
    world = World()
    robot, _site = pair(world, THIN)
    busy(world, robot)
    world.run(10.0)
    return robot.core.trace.records()


def by_the_paper() -> tuple[TraceRecord, ...]:
    world = World()
    robot, _site = pair(world, THIN, scheduler=SchedulerParams(ordering=Ordering.PAPER))
    busy(world, robot)
    world.run(5.0)
    return robot.core.trace.records()


def alone(model: LinkModel, *, lossless: bool = True) -> tuple[TraceRecord, ...]:
    """One large message at a time, with the link to itself."""
    world = World(lossless=lossless)
    robot, _site = pair(world, model)
    cloud = robot.publish("/robot/points", spec(PriorityClass.BULK))
    robot.every(0.5, cloud, bytes(60_000), first_s=1.0)
    world.run(3.0)
    return robot.core.trace.records()


def silent() -> tuple[TraceRecord, ...]:
    world = World(lossless=False)
    robot, _site = pair(world, LinkModel(rate_bps=1e6, delay_s=0.02, blackouts=(Window(3.0, 6.0),)))
    busy(world, robot)
    world.run(7.0)
    return robot.core.trace.records()


def unannounced() -> tuple[TraceRecord, ...]:
    """A message before the peer can have answered."""
    world = World()
    robot, _site = pair(world, LinkModel(delay_s=0.4).as_stream())
    world.run(3.0)
    assert robot.send(robot.publish("/robot/plan", spec()), b"plan")
    world.run(3.0)
    return records(robot, "/robot/plan")


def undefined() -> tuple[TraceRecord, ...]:
    """A relay offers a stream to a site that lacks the text of its type, and waits for that of its answer."""
    world = World()
    robot = world.client("robot")
    world.client("site", LinkModel(rate_bps=200e3, delay_s=0.3).as_stream(), patterns=["/robot/.*"])
    world.run(3.0)
    plan = robot.publish("/robot/plan", spec(), "string data\n" * 4_000)
    robot.every(0.1, plan, b"plan")
    world.run(6.0)
    return relay_records(world, "/robot/plan")


def announcing() -> tuple[TraceRecord, ...]:
    """A thousand new streams are announced over a thin link while a scan is to be sent."""
    world = World()
    robot, _site = pair(world, THIN)
    scan = robot.publish("/robot/scan", spec(depth=5))
    world.run(2.0)
    robot.every(0.05, scan, bytes(300))
    world.run(1.0)
    for number in range(1_000):
        robot.publish(f"/robot/topic{number}", spec())
    world.run(3.0)
    return records(robot, "/robot/scan")


def several_bodies() -> tuple[TraceRecord, ...]:
    world = World(compress=True, encode_bytes_per_s=0.5e6)
    robot, _site = pair(world, LinkModel(rate_bps=2e6, delay_s=0.02).as_stream())
    channels = [robot.publish(f"/robot/log{n}", spec(compression=Compression.ZSTD)) for n in range(4)]
    world.run(1.0)
    for channel in channels:
        assert robot.send(channel, b"the hall is empty " * 10_000)
    world.until(world.quiet)
    return robot.core.trace.records()


def thinned() -> tuple[TraceRecord, ...]:
    world = World()
    robot, _site = pair(world)
    pose = robot.publish("/robot/pose", spec())
    pose.adapt(share=0.2, depth_max=1)
    world.run(1.0)
    robot.every(0.05, pose, b"pose")
    world.run(1.0)
    return records(robot, "/robot/pose")


HOLDS: Final[dict[HoldReason, Callable[[], tuple[TraceRecord, ...]]]] = {
    HoldReason.LINK_DOWN: dropped,
    HoldReason.SILENT: silent,
    HoldReason.ANNOUNCEMENT: unannounced,
    HoldReason.DEFINITION: undefined,
    HoldReason.CONTROL: announcing,
    HoldReason.WINDOW: lambda: alone(LinkModel(rate_bps=500e3, delay_s=0.2).as_stream()),
    HoldReason.PACING: lambda: alone(LinkModel(rate_bps=500e3, delay_s=0.02), lossless=False),
    HoldReason.CLASS: loaded,
    HoldReason.OUTRANKED: loaded,
    HoldReason.FLOOR: loaded,
    HoldReason.SHARE: loaded,
    HoldReason.INTERVAL: by_the_paper,
    HoldReason.ENCODER: several_bodies,
    HoldReason.RATE_CAP: rate_capped,
    HoldReason.ADAPTATION: thinned,
}


@pytest.mark.parametrize("reason", HoldReason)
def test_every_reason_to_hold_a_message_is_told(reason: HoldReason) -> None:
    found = [each for each in HOLDS[reason]() if each.event is TraceEvent.HELD and each.fields["reason"] == reason]
    assert found, f"nothing is held because of {reason}"
    if reason in (HoldReason.CLASS, HoldReason.OUTRANKED, HoldReason.FLOOR):
        assert all(each.fields["after"] != each.topic for each in found), "who goes first is another topic"
        assert all(str(each.fields["after"]).startswith("/robot/") for each in found)
    if reason is HoldReason.CLASS:
        assert {each.fields["after_class"] for each in found} <= {"control", "state"}


def test_a_reason_is_told_when_it_changes_and_not_for_each_choice() -> None:
    found = loaded()
    held = [each for each in found if each.event is TraceEvent.HELD and each.topic == POINTS]
    seconds = found[-1].now - found[0].now
    assert 3 < len(held) < 6 * seconds, "a reason is told once a second, or when it is new"


def test_a_relay_tells_what_is_out_of_the_ordinary_and_no_step_of_what_is_not() -> None:
    world = World().watch()
    robot = world.client("robot")
    world.client("site", THIN, patterns=["/robot/.*"])
    pose, cloud = robot.publish("/robot/pose", spec()), robot.publish("/robot/points", spec(PriorityClass.BULK))
    world.run(2.0)
    robot.every(0.1, pose, b"pose")
    world.run(5.0)
    assert relay_records(world, POSE) == ()
    robot.every(0.1, cloud, bytes(40_000))
    world.run(5.0)
    told = relay_records(world, POINTS)
    reasons = {each.fields["reason"] for each in told if each.event is TraceEvent.DROPPED}
    assert reasons == {DropReason.SUPERSEDED}
    assert {each.event for each in told} <= {TraceEvent.HELD, TraceEvent.SENT, TraceEvent.DROPPED}
    assert all(each.fields["origin"] == "robot" for each in told)
    assert len([each for each in told if each.event is TraceEvent.DROPPED]) < 7, "once a second of each reason"


def test_a_client_that_is_forgotten_leaves_no_trace() -> None:
    world = World()
    _robot, _site = pair(world)
    world.run(1.0)
    hub = world.relay.hub
    assert set(hub.traces.by_client()) == {"robot", "site"}
    hub.forget(ClientName("robot"), "revoked", now=world.relay.now)
    assert set(hub.traces.by_client()) == {"site"}


def test_class_control_beside_the_stream_waits_for_no_bulk() -> None:
    scene = PriorityScene(second=stream())
    scene.run(4.0)
    held = [each for each in records(scene.robot, "/robot/pose") if each.event is TraceEvent.HELD]
    assert all(each.fields["reason"] != HoldReason.CLASS for each in held)
    used = [each for each in records(scene.robot, LINK) if each.event is TraceEvent.LANE_USED]
    assert {"peer": "relay", "lane": "priority", "what": "class control"} in [each.fields for each in used]


def test_how_a_stream_stands_is_told_without_changing_anything() -> None:
    world = World()
    robot, _site = pair(world, THIN)
    busy(world, robot)
    world.run(4.0)
    link = robot.core.link
    before = link.sender.scheduler.waiting()
    standings = {channel.stream.id.topic: link.plane.holds.standing(channel, robot.now)
                 for channel in link.sender.channels.values()}  # fmt: skip
    cloud = standings[POINTS]
    assert cloud["waiting"] >= 1 and cloud["rank"] >= 0 and cloud["unsent_bytes"] > 0
    assert cloud["reason"] in set(HoldReason)
    assert link.sender.scheduler.waiting() == before


def test_what_is_held_back_stands_with_the_rate_or_the_share_that_is_let_in() -> None:
    world = World()
    robot, _site = pair(world)
    capped_topic, thinned_topic = robot.publish("/robot/a", spec(max_rate_hz=2.0)), robot.publish("/robot/b", spec())
    channels = (capped_topic, thinned_topic)
    world.run(1.0)
    link = robot.core.link
    link.apply(LinkSettings(shares=(0.4, 0.4, 0.4)), now=robot.now)
    for _ in range(2):
        for channel in channels:
            assert robot.send(channel, b"x")
    capped, thinned = (link.plane.holds.standing(channel, robot.now) for channel in channels)
    assert (capped["reason"], capped["rate_hz"]) == (HoldReason.RATE_CAP, 2.0)
    assert (thinned["reason"], thinned["share"]) == (HoldReason.ADAPTATION, 0.4)


def test_a_look_is_bounded() -> None:
    """However much waits, a look reads a few streams, and comes back to all of them."""
    world = World()
    robot, _site = pair(world, LinkModel(rate_bps=64e3, delay_s=0.02).as_stream())
    count = 5 * LOOKED_AT

    def send(channel: OutChannel, _now: float) -> None:
        assert robot.send(channel, bytes(5_000))

    for number in range(count):
        channel = robot.publish(f"/robot/topic{number}", spec(PriorityClass.BULK, reliable=True))
        world.network.at(3.0, partial(send, channel))
    world.run(3.0 + 2 * LOOK_S)
    held = {each.topic for each in robot.core.trace.records() if each.event is TraceEvent.HELD}
    assert len(held) < count
    world.run(10.0)
    held = {each.topic for each in robot.core.trace.records() if each.event is TraceEvent.HELD}
    assert len(held) > count - LOOKED_AT, "but for those that left before they were looked at"
