"""access.max_queue_bytes: what may wait for one client at the relay, and who gives way."""

from random import Random

import pytest

from sern_core.access import AccessRule, AccessTable
from sern_core.link import Link
from sern_core.types import ClientName, DropReason, PriorityClass
from sern_sim.models import LinkModel
from tests.world import World, spec

LIMIT_BYTES = 50_000
BOUNDED = AccessTable(
    [
        AccessRule(client="site", subscribe=(".*",), max_queue_bytes=LIMIT_BYTES),
        AccessRule(client=".*", publish=(".*",), subscribe=(".*",)),
    ]
)


def slow(rate_bps: float = 64_000) -> LinkModel:
    return LinkModel(rate_bps=rate_bps, delay_s=0.01).as_stream()


def to_site(world: World) -> Link:
    return world.relay.hub.links[ClientName("site")]


def waiting(world: World) -> int:
    return sum(channel.held_bytes for channel in to_site(world).channels.values())


def queue_full(world: World, topic: str) -> int:
    return sum(c.by_reason[DropReason.QUEUE_FULL] for t, c in to_site(world).ledger.topics.items() if t == topic)


def bounded_world(*, checked: bool = True) -> World:
    world = World(access=BOUNDED)

    def check(_now: float) -> None:
        tombstones = sum(out.message.tombstone > 0 for c in to_site(world).channels.values() for out in c.retained)
        assert waiting(world) <= LIMIT_BYTES + tombstones

    world.client("robot")
    world.client("site", slow(), patterns=[".*"])
    world.until(lambda: "site" in world.relay.hub.links and to_site(world).established, what="site connected")
    if checked:
        world.network.every(0.01, check)
    return world


def test_bulk_gives_way_and_nothing_else_does() -> None:
    world = bounded_world()
    robot, site = world.clients["robot"], world.clients["site"]
    cloud = robot.publish("/points", spec(PriorityClass.BULK, depth=100))
    costmap = robot.publish("/costmap", spec(PriorityClass.STATE, depth=100))
    grid = robot.publish("/map", spec(PriorityClass.STATE, reliable=True))
    pose = robot.publish("/odom", spec(PriorityClass.CONTROL))
    world.run(1.0)
    for _ in range(10):
        robot.send(cloud, b"c" * 10_000)
    world.run(0.5)
    robot.send(costmap, b"k" * 4_000)
    robot.send(grid, b"m" * 4_000)
    robot.every(0.1, pose, b"p" * 100)
    world.run(30.0)
    assert queue_full(world, "/points") >= 5
    assert queue_full(world, "/costmap") == queue_full(world, "/map") == queue_full(world, "/odom") == 0
    assert site.seqs("/map") == site.seqs("/costmap") == [1]
    assert len(site.seqs("/odom")) > 250
    assert site.seqs("/points")[-1] == 10  # the oldest went
    world.validate()


def test_reliable_messages_over_the_bound_are_reported_to_their_origin() -> None:
    world = bounded_world()
    robot, site = world.clients["robot"], world.clients["site"]
    log = robot.publish("/log", spec(PriorityClass.BULK, reliable=True))
    world.run(1.0)
    for _ in range(12):
        assert robot.send(log, b"l" * 10_000)
    world.run(30.0)
    lost = site.expired_seqs["/log"]
    assert len(lost) >= 6
    assert sorted(site.seqs("/log") + lost) == list(range(1, 13))
    assert site.seqs("/log")[:4] == [1, 2, 3, 4]  # who came first stays
    assert [(drop.topic, drop.seq, drop.reason) for drop in robot.dropped_out] == [
        ("/log", seq, DropReason.QUEUE_FULL) for seq in lost
    ]
    assert queue_full(world, "/log") == len(lost)
    assert log.held_bytes == 0  # the origin need not keep any of them
    world.validate()


def test_urgent_messages_pass_over_reliable_bulk() -> None:
    world = bounded_world()
    robot, site = world.clients["robot"], world.clients["site"]
    log = robot.publish("/log", spec(PriorityClass.BULK, reliable=True))
    command = robot.publish("/cmd", spec(PriorityClass.CONTROL, reliable=True))
    world.run(1.0)
    for _ in range(5):
        robot.send(log, b"l" * 10_000)
    world.run(0.2)
    assert waiting(world) == LIMIT_BYTES
    robot.send(command, b"g" * 5_000)
    world.run(30.0)
    assert site.seqs("/cmd") == [1]
    assert site.seqs("/log") == [1, 2, 3, 4]
    assert site.expired_seqs["/log"] == [5]  # the newest: those before it keep their order
    assert queue_full(world, "/log") == 1


def test_a_single_message_above_the_bound_is_refused_entry() -> None:
    world = bounded_world()
    robot, site = world.clients["robot"], world.clients["site"]
    cloud = robot.publish("/points", spec(PriorityClass.BULK))
    odom = robot.publish("/odom", spec(PriorityClass.BULK))
    world.run(1.0)
    robot.send(cloud, b"c" * (LIMIT_BYTES + 1))
    robot.send(odom, b"o")
    world.run(10.0)
    assert site.seqs("/points") == []
    assert queue_full(world, "/points") == 1
    assert site.seqs("/odom") == [1]


def test_others_are_not_held_to_it() -> None:
    world = bounded_world()
    robot = world.clients["robot"]
    other = world.client("other", slow(), patterns=[".*"])
    log = robot.publish("/log", spec(PriorityClass.BULK, reliable=True))
    world.run(1.0)
    for _ in range(12):
        robot.send(log, b"l" * 10_000)
    world.run(60.0)
    assert other.seqs("/log") == list(range(1, 13))


def test_new_access_rules_lift_the_bound() -> None:
    world = bounded_world(checked=False)
    robot, site = world.clients["robot"], world.clients["site"]
    log = robot.publish("/log", spec(PriorityClass.BULK, reliable=True))
    world.run(1.0)
    world.relay.hub.revoke(
        AccessTable([AccessRule(client=".*", publish=(".*",), subscribe=(".*",))]), now=world.relay.now
    )
    for _ in range(12):
        robot.send(log, b"l" * 10_000)
    world.run(60.0)
    assert site.seqs("/log") == list(range(1, 13))


@pytest.mark.parametrize("seed", range(8))
def test_whatever_comes_the_bound_holds_and_nothing_is_lost_silently(seed: int) -> None:
    world = bounded_world().watch(0.5)
    robot, site = world.clients["robot"], world.clients["site"]
    random = Random(seed)
    channels = [
        robot.publish(
            f"/topic{index}",
            spec(random.choice(list(PriorityClass)), reliable=index % 2 == 0, depth=random.choice([1, 3, 50])),
        )
        for index in range(6)
    ]
    world.run(1.0)

    def send(_now: float) -> None:
        robot.send(random.choice(channels), b"x" * random.choice([10, 1_000, 9_000, 30_000]))

    cancel = world.network.every(0.05, send, node=robot).cancel
    world.run(10.0)
    cancel()
    world.run(60.0)
    for channel in channels:
        topic = channel.stream.id.topic
        sent = list(range(1, channel.next_seq))
        if channel.reliable:
            assert sorted(site.seqs(topic) + site.expired_seqs[topic]) == sent
            assert {drop.seq for drop in robot.dropped_out if drop.topic == topic} == set(site.expired_seqs[topic])
        else:
            assert site.seqs(topic) == sorted(set(site.seqs(topic)))
    assert waiting(world) == 0
