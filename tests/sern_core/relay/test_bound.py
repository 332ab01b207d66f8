"""access.max_queue_bytes: what may wait for one client at the relay, and who gives way."""

import tracemalloc
from random import Random
from typing import Any

import pytest

from sern_core.link.link import Link
from sern_core.path.congestion.fixed import FixedWindow
from sern_core.relay.access import DEFAULT_QUEUE_BYTES, AccessRule, AccessTable
from sern_core.relay.bound import DROP_MARKER_BYTES
from sern_core.stream.out_channel import OutChannel
from sern_core.stream.prices import CLIENT_OVERHEAD_BYTES, MESSAGE_OVERHEAD_BYTES
from sern_core.vocabulary.message import TopicSpec
from sern_core.vocabulary.types import ClientName, DropReason, PriorityClass, Reliability
from sern_core.wire import framing
from sern_sim.models import LinkModel
from tests.exploring import seeds
from tests.fuzz.test_hostile_peer import Hostile, _whole
from tests.world import World, spec

LARGE_BYTES = 20_000 + CLIENT_OVERHEAD_BYTES
LIMIT_BYTES = 5 * LARGE_BYTES + 7 * DROP_MARKER_BYTES
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
    return sum(channel.kept_bytes for channel in to_site(world).sender.channels.values())


def queue_full(world: World, topic: str) -> int:
    return sum(c.by_reason[DropReason.QUEUE_FULL] for t, c in to_site(world).sender.ledger.topics.items() if t == topic)


def bounded_world(*, checked: bool = True) -> World:
    world = World(access=BOUNDED)

    def check(_now: float) -> None:
        assert waiting(world) <= LIMIT_BYTES

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
        robot.send(cloud, b"c" * 20_000)
    world.run(0.5)
    robot.send(costmap, b"k" * 8_000)
    robot.send(grid, b"m" * 8_000)
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
        assert robot.send(log, b"l" * 20_000)
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
        robot.send(log, b"l" * 20_000)
    world.run(0.2)
    assert waiting(world) == 5 * LARGE_BYTES
    robot.send(command, b"g" * 15_000)
    world.run(30.0)
    assert site.seqs("/cmd") == [1]
    assert site.seqs("/log") == [1, 2, 3, 4]  # the newest went: those before it keep their order
    assert site.skipped_count["/log"] == 1 and not site.expired_seqs["/log"]
    assert [(drop.seq, drop.reason) for drop in robot.dropped_out] == [(5, DropReason.QUEUE_FULL)]
    assert queue_full(world, "/log") == 1 and log.held_bytes == 0
    robot.send(log, b"again")
    world.until(lambda: site.seqs("/log")[-1] == 6)


@pytest.mark.parametrize("away", [True, False])
def test_of_small_messages_about_one_goes_for_each_that_needs_room(away: bool) -> None:
    world = bounded_world().watch(0.5)
    robot, site = world.clients["robot"], world.clients["site"]
    log = robot.publish("/log", spec(PriorityClass.BULK, reliable=True))
    poses = robot.publish("/pose", spec(PriorityClass.STATE, depth=100))
    world.run(1.0)
    if away:
        world.hops["site"].break_connection(reconnect_s=5.0)
        world.run(0.5)
    large = 0 if away else 4  # so that the small ones are not begun
    for _ in range(large):
        robot.send(log, b"l" * 20_000)
    for _ in range((LIMIT_BYTES - large * LARGE_BYTES) // (CLIENT_OVERHEAD_BYTES + 2)):
        robot.send(log, b"xx")
    world.run(0.5)
    assert queue_full(world, "/log") == 0
    for _ in range(10):
        robot.send(poses, b"p" * 8)
    world.run(0.2)
    assert 1 <= queue_full(world, "/log") <= 12
    world.run(60.0)
    sent, got = log.next_seq - 1, site.seqs("/log")
    assert len(site.seqs("/pose")) == 10
    assert got == list(range(1, len(got) + 1)) and site.skipped_count["/log"] == sent - len(got)
    assert sorted(drop.seq for drop in robot.dropped_out) == list(range(len(got) + 1, sent + 1))
    assert log.held_bytes == 0 and waiting(world) == 0
    robot.send(log, b"again")
    world.until(lambda: site.seqs("/log")[-1] == sent + 1)


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
        robot.send(log, b"l" * 20_000)
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
        robot.send(log, b"l" * 20_000)
    world.run(60.0)
    assert site.seqs("/log") == list(range(1, 13))


def thinned(world: World, topic: str) -> OutChannel:
    """The channel of a topic, which the adaptation leaves most messages of out."""
    channel = next(c for c in to_site(world).sender.channels.values() if c.stream.id.topic == topic)
    channel.adapt(share=0.05, depth_max=channel.spec.depth)
    return channel


def test_what_the_adaptation_holds_back_makes_room_too() -> None:
    world = bounded_world()
    robot, site = world.clients["robot"], world.clients["site"]
    cloud = robot.publish("/points", spec(PriorityClass.BULK, depth=1))
    command = robot.publish("/cmd", spec(PriorityClass.CONTROL, reliable=True))
    world.run(1.0)
    channel = thinned(world, "/points")
    robot.send(cloud, b"c" * (LIMIT_BYTES - 3_000))
    world.run(0.1)
    assert channel.newest is not None and not channel.queue
    robot.send(command, b"g" * 3_000)
    world.run(10.0)
    assert site.seqs("/cmd") == [1]
    assert queue_full(world, "/points") == 1 and queue_full(world, "/cmd") == 0


def test_a_message_that_is_held_back_takes_nobodys_place() -> None:
    """Unless it is let in, it waits beside the one before it."""
    world = bounded_world()
    robot = world.clients["robot"]
    log = robot.publish("/log", spec(PriorityClass.STATE, reliable=True))
    cloud = robot.publish("/points", spec(PriorityClass.BULK, depth=1))
    world.run(1.0)
    for _ in range(2):
        robot.send(log, b"l" * 20_000)
    world.run(0.4)
    size = LIMIT_BYTES - waiting(world) - CLIENT_OVERHEAD_BYTES
    robot.send(cloud, b"c" * size)
    world.run(0.3)
    channel = thinned(world, "/points")
    assert len(channel.queue) == 1 and waiting(world) == LIMIT_BYTES
    robot.send(cloud, b"c" * size)
    world.run(0.3)
    assert channel.newest is not None and not channel.queue
    assert queue_full(world, "/points") == 1
    world.run(60.0)
    assert world.clients["site"].seqs("/points") == [2]


@pytest.mark.parametrize("seed", seeds(5))
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
        for channel in to_site(world).sender.channels.values():
            if random.random() < 0.02:
                channel.adapt(share=random.choice([0.1, 0.5, 1.0]), depth_max=channel.spec.depth)

    cancel = world.network.every(0.05, send, node=robot).cancel
    world.run(10.0)
    cancel()
    world.until(lambda: waiting(world) == 0)
    world.run(1.0)
    for channel in channels:
        topic = channel.stream.id.topic
        sent = list(range(1, channel.next_seq))
        if channel.reliable:
            got, expired = site.seqs(topic), site.expired_seqs[topic]
            assert len(got) + len(expired) + site.skipped_count[topic] == len(sent)
            assert {drop.seq for drop in robot.dropped_out if drop.topic == topic} == set(sent) - set(got)
            assert got == sorted(set(got)) and not set(got) & set(expired)
        else:
            assert site.seqs(topic) == sorted(set(site.seqs(topic)))
    assert waiting(world) == 0


def test_a_client_that_is_away_holds_no_more_than_its_bound_whatever_comes() -> None:
    """Also when its origin keeps to no bound of its own, and in messages that are next to nothing."""
    world = World(access=BOUNDED)
    peer, site = Hostile(world), Hostile(world, "site")
    site.control({"t": "subscribe", "patterns": [".*"], "more": False})
    site.port.disconnected(now=site.now)
    peer.announce(1, "/robot/a", reliable=True)
    peer.announce(2, "/robot/b", reliable=True)
    link = to_site(world)
    for seq in range(1, 3000):
        peer.say(_whole(1, seq, b"x" * (seq % 3)), _whole(2, seq, b"\x01", flags=framing.FLAG_DROP_MARKER))
        while (data := peer.port.next_datagram(now=peer.now)) is not None:
            peer.say(framing.encode_ack(0, framing.decode_header(data).number, 2**64 - 1, 0, 0, 10**6))
        assert waiting(world) <= LIMIT_BYTES
        assert sum(len(channel.gaps) + len(channel.retained) for channel in link.sender.channels.values()) < 500
    assert all(channel.next_seq == 3000 for channel in link.sender.channels.values())
    world.relay.hub.validate()


def test_what_was_left_out_is_skipped_in_its_turn_and_reported() -> None:
    world = World(access=BOUNDED).watch(0.5)
    robot = world.client("robot")
    site = world.client("site", patterns=[".*"])
    log = robot.publish("/log", spec(PriorityClass.BULK, reliable=True))
    world.run(1.0)
    world.hops["site"].break_connection(reconnect_s=30.0)
    world.run(0.5)
    for _ in range(400):  # so many that not even a drop marker of each has room
        robot.send(log, b"l" * 200)
        world.run(0.02)
    world.run(60.0)
    got = site.seqs("/log")
    assert 40 < len(got) < 200 and got == list(range(1, len(got) + 1))
    assert {drop.seq for drop in robot.dropped_out} == set(range(1, 401)) - set(got)
    assert len(got) + len(site.expired_seqs["/log"]) + site.skipped_count["/log"] == 400
    robot.send(log, b"again")
    world.until(lambda: site.seqs("/log")[-1] == 401)
    world.until(lambda: log.held_bytes == 0)


def test_there_is_a_bound_where_no_rule_gives_one() -> None:
    assert AccessTable([AccessRule(client=".*")]).limits(ClientName("any")).max_queue_bytes == DEFAULT_QUEUE_BYTES
    assert AccessTable([]).limits(ClientName("any")).max_queue_bytes == DEFAULT_QUEUE_BYTES


def test_a_full_queue_is_not_added_up_for_each_message() -> None:
    world = World(access=BOUNDED)
    peer, site = Hostile(world), Hostile(world, "site")
    site.control({"t": "subscribe", "patterns": [".*"], "more": False})
    site.port.disconnected(now=site.now)
    for index in range(200):
        peer.announce(index + 1, f"/robot/t{index}", reliable=True)
    for _ in range(4):
        while (data := peer.port.next_datagram(now=peer.now)) is not None:
            peer.say(framing.encode_ack(0, framing.decode_header(data).number, 2**64 - 1, 0, 0, 10**6))
    looked = 0
    link = to_site(world)

    class Counted(dict[int, OutChannel]):
        def values(self) -> Any:
            nonlocal looked
            looked += 1
            return super().values()

    link.sender.channels = Counted(link.sender.channels)
    for seq in range(1, 40):
        peer.say(*(_whole(channel + 1, seq, b"x" * 30) for channel in range(200)))
        peer.now -= 1e-4  # all in one instant
    assert looked < 20


def test_a_message_counts_for_what_it_takes() -> None:
    """Also while it is in flight, and its objects are its own: of all that came, none is shared."""
    count = 5_000
    world = World()
    site, robot = Hostile(world, "site"), Hostile(world)
    robot.announce(1, "/robot/log", reliable=True)
    site.control({"t": "subscribe", "patterns": [".*"], "more": False})
    link = to_site(world)
    link.lane.estimator = link.lane.path.estimator = FixedWindow(64_000_000)
    while site.port.next_datagram(now=site.now) is not None:
        pass
    site.say(framing.encode_ack(0, link.lane.flight.next_number - 1, 0, 0, int(site.now * 1e6), 100))
    site.control({"t": "want", "ch": 1, "on": True})
    (channel,) = link.sender.channels.values()
    tracemalloc.start()
    try:
        before_bytes = tracemalloc.get_traced_memory()[0]
        for first in range(1, count, 500):
            robot.say(*(_whole(1, seq, bytes((seq & 255, seq >> 8))) for seq in range(first, first + 500)))
            while (due_s := robot.hub.links[robot.name].reading.due_s) is not None:
                robot.now = max(robot.now, due_s)
                robot.port.handle_timeout(now=robot.now)
        site.now = robot.now
        while site.port.next_datagram(now=site.now) is not None:
            site.now += 1e-4
        taken_bytes = tracemalloc.get_traced_memory()[0] - before_bytes
    finally:
        tracemalloc.stop()
    assert channel.kept == len(channel.flying) == count
    counted_bytes = channel.held_bytes + count * MESSAGE_OVERHEAD_BYTES
    assert 0.5 * counted_bytes < taken_bytes < counted_bytes < channel.kept_bytes


def test_what_a_robot_keeps_over_its_retention_fits_into_the_defaults() -> None:
    """Ten topics at 10 Hz with 100 bytes, of which nothing is confirmed for as long as they are kept."""
    spec_of_all = TopicSpec(reliability=Reliability.RELIABLE)
    kept = int(10 * spec_of_all.retention_s)
    assert kept * (100 + MESSAGE_OVERHEAD_BYTES) <= spec_of_all.max_queue_bytes
    assert 10 * kept * (100 + CLIENT_OVERHEAD_BYTES) <= DEFAULT_QUEUE_BYTES
