"""Requests between clients: what is heard, and what one that is none costs."""

from dataclasses import replace

import pytest

from sern_client.asking import ASK_S, MAX_TEXT_BYTES, TEXT_TYPE
from sern_core.vocabulary.errors import ConfigError, SernError, UsageError
from sern_core.vocabulary.message import Message, StreamId, StreamInfo
from sern_core.vocabulary.types import ClientName, Encoding, TopicName
from sern_runtime import clock, ros_types
from tests.bridges import FakeEndpoint, Shell, bridge_of
from tests.world import spec

TAKE = TopicName("/robot/cmd_vel/take")


class Robot:
    def __init__(self) -> None:
        self.endpoint, self.shell = FakeEndpoint(), Shell()
        self.bridge = bridge_of(self.endpoint, [], name="robot", namespace="/robot", shell=self.shell)
        self.heard: list[tuple[str, str]] = []
        self.bridge.asking.listen(TAKE, self._hear)
        info = ros_types.topic_info(TAKE, TEXT_TYPE, Encoding.CDR)
        self.stream = StreamInfo(StreamId(ClientName("anna"), 1, TAKE), info, spec(reliable=True), {})

    def _hear(self, who: ClientName, text: str) -> None:
        if text == "no":
            raise UsageError("that is nothing")
        self.heard.append((who, text))

    def says(self, body: bytes) -> None:
        now = clock.now()
        self.bridge.message(self.stream, Message(self.stream.id, 1, body, 1, now), now=now)


def body(text: str) -> bytes:
    return ros_types.serialise(ros_types.new(TEXT_TYPE, Encoding.CDR, data=text), TEXT_TYPE, Encoding.CDR)


async def test_a_request_is_heard_and_published_nowhere() -> None:
    robot = Robot()
    robot.bridge.stream_opened(robot.stream)
    robot.says(body("ask"))
    assert robot.heard == [("anna", "ask")] and robot.endpoint.publishers == []
    assert robot.bridge.inbound.validate() == [] and robot.shell.faults == []


async def test_what_is_none_is_said_once_and_changes_nothing(caplog: pytest.LogCaptureFixture) -> None:
    robot = Robot()
    robot.bridge.stream_opened(robot.stream)
    for _ in range(3):
        for bad in (b"", b"\0\1\0\0\xff\xff\xff\xff", body("x" * MAX_TEXT_BYTES), body("no")):
            robot.says(bad)
    assert robot.heard == [] and robot.shell.faults == [] and caplog.text.count("a request of anna") == 1
    robot.says(body("ask"))
    assert robot.heard == [("anna", "ask")]


async def test_a_stream_of_another_type_holds_no_requests() -> None:
    robot = Robot()
    other = ros_types.topic_info(TAKE, "std_msgs/msg/Bool", Encoding.CDR)
    with pytest.raises(ConfigError, match="is std_msgs/msg/Bool, not std_msgs/msg/String"):
        robot.bridge.stream_opened(replace(robot.stream, info=other))


async def test_without_a_link_nothing_is_asked() -> None:
    robot = Robot()
    with pytest.raises(SernError, match="there is no link to the relay; nothing was asked"):
        await robot.bridge.asking.ask(TopicName("/other/cmd_vel/take"), "ask")
    assert ASK_S > 0 and not robot.bridge.core.link.sender.channels
