"""What it costs a client that the far side wants a topic, or wants it no more, or has lost a message of it.

A peer says so of all topics as often as it likes. So each time must cost as much as it changes, however many topics
there are: what is counted are the steps of Python's own interpreter, which are the same in every run.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from sern_client.endpoints.ros1.endpoint import Ros1Endpoint, Ros1Options
from sern_client.endpoints.ros1.first_messages import FirstMessages
from sern_client.endpoints.ros1.subscription import Topic
from sern_core.summaries.patches import PatchParams
from sern_core.summaries.spec import SummarySpec, VoxelParams
from sern_core.topics.patterns import compile_pattern
from sern_core.topics.rules import DiscoveryMode, TopicRule
from sern_core.vocabulary.message import StreamInfo
from sern_core.vocabulary.types import DropReason, Encoding, TopicName
from sern_runtime import ros_types
from tests.bridges import Shell, bridge_of
from tests.steps import steps

FEW, MANY = 20, 1_000
CLOUD, GRID = TopicName("/robot/cloud"), TopicName("/robot/grid")
RULES = (
    TopicRule(compile_pattern(CLOUD), summaries=(SummarySpec(VoxelParams()),)),
    TopicRule(compile_pattern(GRID), summaries=(SummarySpec(PatchParams()),)),
)


class Robot:
    """A client of a ROS 1 master with so many topics, the last of which have summaries."""

    def __init__(self, topics: int) -> None:
        self.endpoint = Ros1Endpoint(Ros1Options(host="127.0.0.1", namespace="/robot"), environ={})
        shell = Shell()
        self.faults = shell.faults
        self.bridge = bridge_of(self.endpoint, RULES, DiscoveryMode.DYNAMIC, name="robot", shell=shell, now=0.0)
        self.core = self.bridge.core
        for number in range(topics):
            self.add(TopicName(f"/robot/t{number}"), "std_msgs/msg/String")
        self.add(CLOUD, "sensor_msgs/msg/PointCloud2")
        self.add(GRID, "nav_msgs/msg/OccupancyGrid")

    def add(self, name: TopicName, type_name: str) -> None:
        known = name.removeprefix("/robot")
        topic = self.endpoint._topics[known] = Topic(known, name, self.endpoint)
        topic.announced = replace(ros_types.topic_info(name, type_name, Encoding.ROS1), latched=False)
        self.bridge.outbound.topic_added(topic.announced)

    def stream(self, name: str) -> StreamInfo:
        return next(each.stream for each in self.core.link.sender.channels.values() if each.stream.id.topic == name)

    def interested(self) -> dict[str, bool]:
        return {topic.local: topic._interest for topic in self.endpoint._topics.values()}


async def wants_one(topics: int) -> Callable[[], None]:
    robot = Robot(topics)
    last = robot.stream(f"/robot/t{topics - 1}")
    return lambda: robot.bridge.wanted(last, False)


async def wants_a_summary(topics: int) -> Callable[[], None]:
    robot = Robot(topics)
    (summary,) = (each for each in robot.bridge.outbound.summaries.topics if each.source.stream.id.topic == CLOUD)
    return lambda: robot.bridge.wanted(summary.channel.stream, True)


async def wants_what_is_no_topic(topics: int) -> Callable[[], None]:
    robot = Robot(topics)
    stream = robot.stream("/robot/t0")
    strange = replace(stream, id=stream.id._replace(topic=TopicName("/robot/strange")))
    return lambda: robot.bridge.wanted(strange, True)


async def drops_one(topics: int) -> Callable[[], None]:
    robot = Robot(topics)
    last = robot.stream(f"/robot/t{topics - 1}")
    return lambda: robot.bridge.send_dropped(last, 1, 1, DropReason.UNWANTED, "")


async def asks_the_endpoint(topics: int) -> Callable[[], None]:
    robot = Robot(topics)
    return lambda: robot.endpoint.interest(TopicName(f"/robot/t{topics - 1}"), False)


async def takes_another(topics: int) -> Callable[[], object]:
    robot = Robot(topics)
    name = TopicName(f"/robot/t{topics - 1}")
    return lambda: robot.endpoint.subscribe(name, lambda _body, _stamp_ns: True)


async def has_missed_what_was_held(messages: int) -> Callable[[], None]:
    """A subscriber turns up when so many messages for it are lost already."""
    told: dict[DropReason, int] = {}

    def dropped(why: DropReason, count: int = 1) -> None:
        told[why] = told.get(why, 0) + count

    first_messages = FirstMessages(
        "/chat", max_messages=1, max_bytes=100, overflow=DropReason.QUEUE_FULL, dropped=dropped, done=lambda: None
    )
    for _ in range(messages + 1):
        first_messages.keep(b"x", 10.0)

    def registered() -> None:
        first_messages.registered(["/listener"])
        assert told == {DropReason.QUEUE_FULL: messages}
        first_messages.close()

    return registered


EVENTS = (
    wants_one, wants_a_summary, wants_what_is_no_topic, drops_one, asks_the_endpoint, takes_another,
    has_missed_what_was_held,
)  # fmt: skip


@pytest.mark.parametrize("make", EVENTS, ids=lambda make: make.__name__)
async def test_the_price_does_not_grow_with_what_there_is(make: Any) -> None:
    few, many = steps(await make(FEW)), steps(await make(MANY))
    assert many <= 1.2 * few


async def test_what_is_wanted_is_the_topic_of_the_stream() -> None:
    robot = Robot(3)
    everything = set(robot.interested())
    robot.bridge.wanted(robot.stream("/robot/t1"), False)
    robot.bridge.wanted(robot.stream(CLOUD), False)
    assert {name for name, wanted in robot.interested().items() if not wanted} == {"/robot/t1", CLOUD}
    (summary,) = (each for each in robot.bridge.outbound.summaries.topics if each.source.stream.id.topic == CLOUD)
    summary.channel.wanted = True
    robot.bridge.wanted(summary.channel.stream, True)
    assert robot.interested() == {name: name != "/robot/t1" for name in everything}
    robot.endpoint.interest(TopicName("/t1"), True)
    assert not robot.interested()["/robot/t1"], "a name outside the namespace is no topic of ours"
    assert robot.faults == []


async def test_a_topic_that_has_ended_is_not_wanted_and_begins_anew() -> None:
    robot = Robot(2)
    stream = robot.stream("/robot/t0")
    cloud = robot.endpoint._topics["/cloud"]
    (summary,) = (each for each in robot.bridge.outbound.summaries.topics if each.source.stream.id.topic == CLOUD)
    robot.bridge.outbound.topic_removed(TopicName("/robot/t0"))
    robot.bridge.outbound.topic_removed(CLOUD)
    before = robot.interested()
    robot.bridge.wanted(stream, False)
    robot.bridge.wanted(summary.channel.stream, False)
    robot.bridge.send_dropped(summary.channel.stream, 1, 1, DropReason.UNWANTED, "")
    assert robot.interested() == before and robot.bridge.outbound.streams == {
        channel.stream.id for channel in robot.core.link.sender.channels.values()
    }
    assert cloud.announced is not None
    robot.bridge.outbound.topic_added(cloud.announced)
    robot.bridge.wanted(robot.stream(CLOUD), False)
    assert not robot.interested()[CLOUD]
    robot.bridge.close()
    assert not robot.bridge.outbound.streams and robot.faults == []
