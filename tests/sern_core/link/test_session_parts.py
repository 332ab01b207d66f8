"""A session begins and ends in every part of a link: what is left of it, and what outlives it."""

from sern_core.link.handshake import NEW_SESSION
from sern_core.path.lanes import LANE_UDP
from sern_core.vocabulary.types import PriorityClass
from sern_core.wire import framing
from sern_sim.models import LinkModel
from tests.sern_core.link.test_lanes import TwoLanes, models
from tests.world import SimClient, World, spec


def connected() -> tuple[World, SimClient]:
    world = World()
    robot = world.client("robot", LinkModel(delay_s=0.2).as_stream())
    world.client("site", patterns=["/robot/.*"])
    world.run(3.0)
    assert robot.core.link.established
    return world, robot


def test_the_datagrams_of_a_session_are_known_by_how_they_begin() -> None:
    _, robot = connected()
    end = robot.core.link.end
    assert end.data_prefix == end.header(1, robot.now)[:4]
    robot.core.link.close("enough", now=robot.now)
    assert end.data_prefix == b""
    assert framing.decode_header(end.header(1, robot.now)).tag == end.tag, "which the next one counts on from"


def test_what_was_announced_and_is_in_flight_ends_with_the_session_and_queues_do_not() -> None:
    world, robot = connected()
    channel = robot.publish("/robot/log", spec(reliable=True))
    world.run(1.0)
    for number in range(3):
        assert robot.send(channel, bytes(500) + bytes([number]))
    world.run(0.3)  # sent at the next deadline, and not acknowledged yet
    link = robot.core.link
    assert channel.ready
    assert link.lane.flight.inflight_bytes > 0
    link.disconnected(now=robot.now, reason="gone")
    left = link.observe(now=robot.now)
    assert not left.established and left.inflight_bytes == 0
    assert [topic.ready for topic in link.topics()] == [False]
    assert [(kept.seq, kept.exposed) for kept in link.undelivered()] == [(1, True), (2, True), (3, True)]
    link.validate()


def test_the_end_of_a_session_is_told_once() -> None:
    _, robot = connected()
    link = robot.core.link
    link.disconnected(now=robot.now, reason="gone")
    link.disconnected(now=robot.now, reason="gone again")
    assert robot.downs == ["gone"]


def test_a_datagram_lane_ends_with_its_session() -> None:
    two = TwoLanes(stream=models()[0], datagrams=models()[1])
    two.world.run(3.0)
    link = two.core.link
    assert LANE_UDP in link.lanes.by_id
    link.close("enough", now=two.robot.now)
    assert LANE_UDP not in link.lanes.by_id and link.lane is link.lanes.stream


def test_the_next_session_with_the_same_process_goes_on_and_one_with_another_begins() -> None:
    world, robot = connected()
    channel = robot.publish("/robot/pose", spec(PriorityClass.CONTROL))
    world.run(1.0)
    world.hops["robot"].break_connection(reconnect_s=0.1)
    world.run(1.0)
    assert robot.ups == [False, True] and channel.ready
    world.restart_relay()
    world.run(5.0)
    assert robot.ups == [False, True, False]
    assert NEW_SESSION not in robot.downs, "there was no session any more"
