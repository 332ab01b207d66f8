"""What an endpoint's topics become on the link: which are offered, as what, and what is said when one cannot be."""

import logging
from typing import Any

import pytest

from sern_client.endpoints.base import Difference
from sern_client.outbound import CLOSED
from sern_client.tables import Tables
from sern_core.stream.out_channel import OutChannel
from sern_core.topics.patterns import compile_pattern
from sern_core.topics.rules import Direction, Discovery, DiscoveryMode, TopicRule
from sern_core.vocabulary.errors import UsageError
from sern_core.vocabulary.message import StreamId, StreamInfo, TopicInfo
from sern_core.vocabulary.types import ClientName, DropReason, Encoding, Reliability, TopicName
from sern_runtime import clock, ros_types
from tests.bridges import FakeEndpoint, Shell, bridge_of
from tests.world import spec

TEXT = "std_msgs/msg/String"
POSE = TopicName("/pose")
DYNAMIC = DiscoveryMode.DYNAMIC


def topic(name: str, type_name: str = TEXT) -> TopicInfo:
    return ros_types.topic_info(name, type_name, Encoding.CDR)


class Robot:
    """A robot's bridge; `outbound` is what a test drives."""

    def __init__(self, *rules: TopicRule, mode: DiscoveryMode = DYNAMIC, **options: Any) -> None:
        self.endpoint = FakeEndpoint()
        self.shell = Shell()
        self.bridge = bridge_of(
            self.endpoint, rules, mode, name="robot", namespace="/robot", shell=self.shell, **options
        )
        self.outbound = self.bridge.outbound
        self.core = self.bridge.core

    @property
    def channels(self) -> dict[str, OutChannel]:
        return {channel.stream.id.topic: channel for channel in self.core.link.sender.channels.values()}

    def offers(self) -> set[str]:
        """The global names that are offered; each has one subscription, and the other way round."""
        assert len(self.endpoint.open) == len(self.channels)
        return set(self.channels)

    def publish(self, name: TopicName, body: bytes) -> bool:
        return self.endpoint.open[name].sink(body, 1)


async def test_a_topic_that_is_thinned_says_so_of_itself() -> None:
    rules = [
        TopicRule(compile_pattern("/pose"), max_rate_hz=2.5),
        TopicRule(compile_pattern("/log"), max_rate_hz=2.5, reliability=Reliability.RELIABLE),
    ]
    robot = Robot(*rules)
    for name in ("/pose", "/log", "/other"):
        robot.outbound.topic_added(topic(name))
    said = {name: channel.stream.attributes for name, channel in robot.channels.items()}
    assert said == {"/robot/pose": {"max_rate_hz": "2.5"}, "/robot/log": {}, "/robot/other": {}}


async def test_a_topic_is_offered_under_its_global_name_and_its_messages_go_there() -> None:
    robot = Robot()
    robot.outbound.topic_added(topic(POSE))
    assert robot.offers() == {"/robot/pose"} and robot.shell.kicks == 1
    assert robot.publish(POSE, b"here") and robot.shell.kicks == 2
    assert robot.channels["/robot/pose"].counters.offered == 1
    robot.outbound.topic_added(topic(POSE))  # told again
    assert len(robot.endpoint.subscriptions) == 1


@pytest.mark.parametrize(
    ("direction", "offered"), [(Direction.SEND, True), (Direction.BOTH, True), (Direction.RECEIVE, False)]
)
async def test_what_a_rule_only_receives_is_not_offered(direction: Direction, offered: bool) -> None:
    robot = Robot(TopicRule(compile_pattern(POSE), direction=direction))
    robot.outbound.topic_added(topic(POSE))
    assert (robot.offers() == {"/robot/pose"}) is offered and bool(robot.shell.kicks) is offered


async def test_a_topic_without_a_rule_stays_here_and_is_said_once(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    robot = Robot(TopicRule(compile_pattern("/odom")), mode=DiscoveryMode.MANUAL)
    for _ in range(3):
        robot.outbound.topic_added(topic(POSE))
        robot.outbound.topic_removed(POSE)
    robot.outbound.topic_added(topic("/odom"))
    assert robot.offers() == {"/robot/odom"}
    assert caplog.text.count("/pose (std_msgs/msg/String) stays here: no rule in `topics` names it") == 1


def test_what_is_denied_is_not_said_to_want_a_rule() -> None:
    denied = Discovery(DiscoveryMode.MANUAL, deny=(compile_pattern(POSE),))
    assert not denied.wants(POSE, TEXT, listed=True)


async def test_two_topics_that_would_have_one_name_are_one_and_an_error(caplog: pytest.LogCaptureFixture) -> None:
    rule = TopicRule(compile_pattern("/old"), remap=POSE)
    robot = Robot(rule)
    robot.outbound.topic_added(topic("/old"))
    robot.outbound.topic_added(topic(POSE))
    assert robot.offers() == {"/robot/pose"} and set(robot.endpoint.open) == {"/old"}
    assert "/pose is a local topic and also the new name that `remap` gives to /old" in caplog.text


async def test_a_name_that_is_offered_already_stays_with_its_first_topic(caplog: pytest.LogCaptureFixture) -> None:
    robot = Robot()
    taken = robot.core.publish(topic("/robot/pose"), spec(), now=clock.now())
    robot.outbound.topic_added(topic(POSE))
    assert robot.channels == {"/robot/pose": taken} and robot.endpoint.subscriptions == []
    assert "/pose cannot be offered as /robot/pose" in caplog.text


async def test_a_topic_that_cannot_be_taken_is_withdrawn_and_may_come_again(caplog: pytest.LogCaptureFixture) -> None:
    robot = Robot()
    robot.endpoint.refusals[POSE] = UsageError("its node has gone")
    robot.outbound.topic_added(topic(POSE))
    assert robot.offers() == set() and not robot.outbound.streams and robot.shell.kicks == 0
    assert "/pose cannot be taken: its node has gone" in caplog.text
    robot.endpoint.refusals.clear()
    robot.outbound.topic_added(topic(POSE))
    assert robot.offers() == {"/robot/pose"}


async def test_a_topic_that_ends_is_offered_no_more() -> None:
    robot = Robot()
    robot.outbound.topic_added(topic(POSE))
    stream = robot.channels["/robot/pose"].stream
    kicks = robot.shell.kicks
    robot.outbound.topic_removed(POSE)
    assert robot.offers() == set() and robot.endpoint.subscriptions[0][1].closed and robot.shell.kicks == kicks + 1
    robot.outbound.wanted(stream, True)  # it was on its way
    robot.outbound.topic_removed(POSE)
    assert robot.endpoint.interests == [] and robot.shell.kicks == kicks + 1


async def test_stopped_sources_offer_nothing_more() -> None:
    robot = Robot()
    robot.outbound.topic_added(topic(POSE))
    for _ in range(2):
        robot.outbound.stop_sources()
    robot.outbound.topic_added(topic("/odom"))
    assert robot.endpoint.open == {} and set(robot.channels) == {"/robot/pose"}, "what is owed is still sent"
    robot.outbound.close()


async def test_the_endpoint_is_told_who_wants_its_topics() -> None:
    robot = Robot()
    for name in (POSE, TopicName("/odom")):
        robot.outbound.topic_added(topic(name))
    stream = robot.channels["/robot/odom"].stream
    robot.bridge.wanted(stream, True)
    robot.bridge.wanted(stream, False)
    strange = StreamId(ClientName("robot"), 1, TopicName("/robot/other"))
    robot.bridge.wanted(StreamInfo(strange, topic("/robot/other"), spec(), {}), True)
    assert robot.endpoint.interests == [("/odom", True), ("/odom", False)]


@pytest.mark.parametrize(
    ("count", "where", "reason", "line"),
    [
        (1, "", DropReason.QUEUE_FULL, "our reliable message 7 was dropped here: queue_full"),
        (1, "site", DropReason.LIFESPAN, "our reliable message 7 was dropped for site: lifespan"),
        (3, "", DropReason.QUEUE_FULL, "our reliable messages 7 to 9 were dropped here: queue_full"),
        (3, "site", DropReason.LIFESPAN, "our reliable messages 7 to 9 were dropped for site: lifespan"),
        (3, "", DropReason.UNWANTED, None),
    ],
)
async def test_a_reliable_message_that_somebody_wanted_is_not_lost_in_silence(
    count: int, where: str, reason: DropReason, line: str | None, caplog: pytest.LogCaptureFixture
) -> None:
    robot = Robot(TopicRule(compile_pattern(POSE), reliability=Reliability.RELIABLE))
    robot.outbound.topic_added(topic(POSE))
    stream = robot.channels["/robot/pose"].stream
    robot.bridge.send_dropped(stream, 7, count, reason, where)
    assert [record.getMessage() for record in caplog.records] == ([] if line is None else [f"/robot/pose: {line}"])
    caplog.clear()
    robot.outbound.close()
    robot.bridge.send_dropped(stream, 7, count, reason, where)  # told in one line, of all
    assert caplog.records == []


async def test_best_effort_may_be_dropped_without_a_word(caplog: pytest.LogCaptureFixture) -> None:
    robot = Robot()
    robot.outbound.topic_added(topic(POSE))
    robot.bridge.send_dropped(robot.channels["/robot/pose"].stream, 1, 1, DropReason.SUPERSEDED, "")
    assert caplog.records == []


async def test_refused_publications_are_counted(caplog: pytest.LogCaptureFixture) -> None:
    robot = Robot()
    robot.outbound.topic_added(topic(POSE))
    robot.bridge.publication_refused(robot.channels["/robot/pose"].stream, "forbidden", "not yours to publish")
    assert robot.outbound.refusals == 1
    assert "the relay refuses /robot/pose (forbidden): not yours to publish" in caplog.text


async def test_a_log_that_fails_costs_no_message() -> None:
    class BrokenLog:
        def offered(self, *_: object, **_more: object) -> None:
            raise OSError("no space")

    log: Any = BrokenLog()
    robot = Robot(log=log)
    robot.outbound.topic_added(topic(POSE))
    assert robot.publish(POSE, b"here") and robot.channels["/robot/pose"].counters.offered == 1
    assert robot.bridge.site.parts.failures["message_log"] == 1


async def test_frame_ids_leave_with_their_prefix() -> None:
    robot = Robot(frame_prefix="robot/")
    name = "std_msgs/msg/Header"
    robot.outbound.topic_added(topic("/head", name))
    header = ros_types.header(1, "odom", Encoding.CDR, 0)
    assert robot.publish(TopicName("/head"), ros_types.serialise(header, name, Encoding.CDR))
    (message,) = (out.message for out in robot.channels["/robot/head"].queue)
    assert b"robot/odom\0" in message.body


async def test_what_is_open_at_the_endpoint_is_compared_and_mended(caplog: pytest.LogCaptureFixture) -> None:
    robot = Robot()
    tables = Tables(robot.bridge)
    robot.outbound.topic_added(topic(POSE))
    assert tables.validate() == [] and dict(robot.endpoint.held.subscriptions) == {POSE: 1}
    difference = Difference(POSE, "is not open there", "subscription")
    tables.repair([difference])
    assert len(robot.endpoint.subscriptions) == 2 and robot.publish(POSE, b"again")
    robot.endpoint.refusals[POSE] = UsageError("its node has gone")
    tables.repair([difference])
    assert robot.offers() == set() and "/pose cannot be taken again: its node has gone" in caplog.text


async def test_a_channel_that_is_closed_behind_its_back_shows() -> None:
    robot = Robot()
    robot.outbound.topic_added(topic(POSE))
    robot.core.unpublish(robot.channels["/robot/pose"], now=clock.now())
    assert Tables(robot.bridge).validate() == [Difference(POSE, CLOSED)]


async def test_nothing_is_left_after_the_end() -> None:
    robot = Robot()
    robot.outbound.topic_added(topic(POSE))
    robot.outbound.close()
    assert robot.endpoint.open == {} and not robot.outbound.streams and robot.outbound.pending == 0
    robot.outbound.topic_removed(POSE)
    robot.outbound.topic_added(topic(POSE))
    assert robot.endpoint.open == {}
