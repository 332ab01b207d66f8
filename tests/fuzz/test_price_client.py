"""What it costs a client when its relay ends a long backlog at a word: `price.py` says how it is measured.

The client is whole but for its sockets: core, bridge and endpoint, in a session with a relay's core.
"""

import logging

import pytest

from sern_client.endpoints.ros1.endpoint import Ros1Endpoint, Ros1Options
from sern_client.endpoints.ros1.subscription import Topic
from sern_core.stream.prices import MESSAGE_OVERHEAD_BYTES
from sern_core.topics.patterns import compile_pattern
from sern_core.topics.rules import DiscoveryMode, TopicRule
from sern_core.vocabulary.message import DEFAULT_RELIABLE_QUEUE_BYTES
from sern_core.vocabulary.types import DROP_CODES, DropReason, Encoding, Reliability, TopicName
from sern_runtime import clock, ros_types
from tests.bridges import Shell, bridge_of
from tests.fuzz.price import Input, Make, within_budget
from tests.fuzz.test_hostile_peer import Hostile
from tests.world import World

LOST = DROP_CODES[DropReason.LOST]
LOG = TopicName("/robot/log")
BACKLOG = DEFAULT_RELIABLE_QUEUE_BYTES // (MESSAGE_OVERHEAD_BYTES + 1)
"""The most one-byte messages that a reliable stream keeps by default."""


class Robot:
    """A client with one reliable topic, which a subscriber of its relay wants."""

    def __init__(self) -> None:
        self.now = clock.now()
        endpoint = Ros1Endpoint(Ros1Options(host="127.0.0.1", namespace="/robot"), environ={})
        rules = (TopicRule(compile_pattern(LOG), reliability=Reliability.RELIABLE),)
        shell = Shell()
        self.faults = shell.faults
        self.bridge = bridge_of(endpoint, rules, DiscoveryMode.DYNAMIC, name="robot", shell=shell, now=self.now)
        self.core = self.bridge.core
        topic = endpoint._topics["/log"] = Topic("/log", LOG, endpoint)
        topic.announced = ros_types.topic_info(LOG, "std_msgs/msg/String", Encoding.ROS1)
        self.bridge.outbound.topic_added(topic.announced)
        world = World()
        Hostile(world, "site").control({"t": "subscribe", "patterns": [LOG], "more": False})
        self.port = world.relay.port(self.core.name)
        self.core.link.connected(now=self.now)
        for _ in range(5):
            while (data := self.core.link.next_datagram(now=self.now)) is not None:
                self.port.receive(data, now=self.now)
            self.hear()
        self.relay = world.relay.hub.links[self.core.name]
        (self.channel,) = self.core.link.sender.channels.values()
        assert self.channel.wanted and self.channel.reliable

    def hear(self) -> None:
        """What the relay has to say, and all that comes of it."""
        self.now += 0.001
        while (data := self.port.next_datagram(now=self.now)) is not None:
            self.core.link.receive(data, now=self.now)

    def one_more_slice(self) -> bool:
        due_s = self.core.link.reading.due_s
        if due_s is None:
            return False
        self.now = max(self.now, due_s)
        self.core.link.handle_timeout(now=self.now)
        return True

    def keeps(self, messages: int) -> None:
        for _ in range(messages):
            assert self.core.send(self.channel, b"x", 0, now=self.now)


def told(name: str, **envelope: object) -> Make:
    """The relay says this of the stream."""

    def make() -> Input:
        robot = Robot()
        robot.keeps(BACKLOG)
        robot.relay.control.send({"t": name, "ch": robot.channel.channel_id, **envelope}, now=robot.now)

        def rest() -> bool:
            more = robot.one_more_slice()
            assert more or all(out.counted for out in robot.channel.retained)
            assert robot.faults == []
            return more

        return Input(100, robot.hear, rest=rest)

    make.__name__ = f"told_{name}"
    return make


def told_that_a_client_is_forgotten() -> Input:
    """The only one who was to get them is forgotten: they are dropped for it, and then confirmed."""
    robot = Robot()
    robot.keeps(BACKLOG)
    (stream,) = robot.relay.taking.streams.values()
    dropped = {"t": "dropped", "ch": robot.channel.channel_id, "seq": 1, "code": LOST, "to": "site", "n": BACKLOG}
    robot.relay.control.send(dropped, now=robot.now)

    def rest() -> bool:
        if robot.one_more_slice():
            return True
        if not robot.channel.retained:
            return False
        assert all(out.counted for out in robot.channel.retained)
        robot.relay.taking.confirm(stream, BACKLOG)
        robot.hear()
        return True

    return Input(100, robot.hear, rest=rest)


EVENTS = (
    told("dropped", seq=1, code=LOST, to="site", n=2**61),
    told("want", on=False),
    told("refuse", code="forbidden", why=""),
    told_that_a_client_is_forgotten,
)


@pytest.mark.parametrize("make", EVENTS, ids=lambda make: make.__name__)
async def test_the_end_of_a_backlog_holds_the_loop_for_a_bounded_time(make: Make) -> None:
    assert within_budget(make)


@pytest.mark.parametrize(
    ("first", "count", "line"),
    [
        (1, 1, "our reliable message 1 was dropped for site: lost"),
        (3, 5, "our reliable messages 3 to 7 were dropped for site: lost"),
        (9, 2**61, "our reliable messages 9 to 10 were dropped for site: lost"),
    ],
)
async def test_the_log_has_a_line_for_a_run(
    first: int, count: int, line: str, caplog: pytest.LogCaptureFixture
) -> None:
    robot = Robot()
    robot.keeps(10)
    dropped = {"t": "dropped", "ch": robot.channel.channel_id, "seq": first, "code": LOST, "to": "site", "n": count}
    robot.relay.control.send(dropped, now=robot.now)
    caplog.clear()
    with caplog.at_level(logging.WARNING):
        robot.hear()
    said = [record.getMessage() for record in caplog.records]
    assert [text for text in said if "reliable message" in text] == [f"{LOG}: {line}"]
    assert robot.faults == []
