"""Goals that nobody will answer: what their clients are told."""

import asyncio
import struct
from collections.abc import AsyncIterator, Callable
from functools import partial
from typing import Any

import pytest

from sern_client import actions
from sern_client.actions import (
    ABORTED,
    MAX_GOALS,
    MAX_STATUSES,
    REJECTED,
    STATUS_TYPE,
    GoalId,
    GoalWatch,
    cancel_request,
    goal_id,
    mentioned_goals,
    refusal,
)
from sern_client.endpoints.base import ServiceInfo, Sink
from sern_core.stream.out_channel import OutChannel
from sern_core.topics.patterns import compile_pattern
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.ledger import SendCounters
from sern_core.vocabulary.message import StreamId, StreamInfo, TopicInfo, TopicSpec
from sern_core.vocabulary.types import ClientName, DropReason, Encoding, PriorityClass, TopicName
from sern_runtime import clock, ros_types
from tests.steps import steps
from tests.support import until

HEADER = "Header header\n"
BELOW = (
    "=" * 80 + "\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
    + "=" * 80 + "\nMSG: actionlib_msgs/GoalID\ntime stamp\nstring id\n"
)  # fmt: skip
GOAL_TEXT = HEADER + "actionlib_msgs/GoalID goal_id\nCountGoal goal\n" + BELOW + "=" * 80
GOAL_TEXT += "\nMSG: count/CountGoal\nint32 goal\n"
RESULT_TEXT = (
    HEADER + "actionlib_msgs/GoalStatus status\nCountResult result\n" + BELOW
    + "=" * 80 + "\nMSG: actionlib_msgs/GoalStatus\nGoalID goal_id\nuint8 status\nstring text\n"
    + "=" * 80 + "\nMSG: count/CountResult\nint32[] steps\nstring words\n"
)  # fmt: skip
IDENT = GoalId(7, 8, "/client-1-7.8")
ACTION = "/robot1/count"


def topic(part: str, kind: str = "count/msg/Any", definition: str = "") -> TopicInfo:
    return TopicInfo(TopicName(f"{ACTION}/{part}"), kind, Encoding.ROS1, "", definition)


GOAL = topic("goal", "count/msg/CountActionGoal", GOAL_TEXT)
RESULT = topic("result", "count/msg/CountActionResult", RESULT_TEXT)


STATUS = topic("status", STATUS_TYPE)


def body(definition: str, name: str, fill: Callable[[Any], None]) -> bytes:
    resolved = ros_types.resolve(name, definition, Encoding.ROS1)
    message: Any = ros_types.new_in(resolved.store, resolved.name)
    fill(message)
    return bytes(resolved.store.serialize_ros1(message, resolved.name))


def goal_body(ident: GoalId = IDENT) -> bytes:
    def fill(message: Any) -> None:
        message.header.frame_id = "map"
        message.goal_id.stamp.sec, message.goal_id.stamp.nanosec, message.goal_id.id = ident
        message.goal.goal = 3

    return body(GOAL_TEXT, "count/msg/CountActionGoal", fill)


def result_for(text: str) -> bytes:
    def fill(message: Any) -> None:
        message.status.goal_id.id = text

    return body(RESULT_TEXT, RESULT.type_name, fill)


def result_of(data: bytes) -> Any:
    resolved = ros_types.resolve(RESULT.type_name, RESULT_TEXT, Encoding.ROS1)
    return resolved.store.deserialize_ros1(data, resolved.name)


def status_body(*texts: str) -> bytes:
    statuses = []
    for text in texts:
        status: Any = ros_types.new("actionlib_msgs/msg/GoalStatus", Encoding.ROS1)
        status.goal_id.id = text
        statuses.append(status)
    return ros_types.serialise(
        ros_types.new(STATUS_TYPE, Encoding.ROS1, status_list=statuses), STATUS_TYPE, Encoding.ROS1
    )


class Site:
    """A watch, with the link and the local nodes on its two sides."""

    def __init__(self, patience_s: float = 60.0) -> None:
        self.accepts = True
        self.cancels: list[bytes] = []
        self.results: list[bytes] = []
        self.advertised: list[TopicInfo] = []
        self.closed = 0
        self.watch = GoalWatch(((compile_pattern(ACTION), patience_s),), self._advertise)
        spec = TopicSpec(PriorityClass.CONTROL, lifespan_s=0.0)
        stream = StreamInfo(StreamId(ClientName("site"), 1, GOAL.name), GOAL, spec)
        self.channel = OutChannel(
            0, stream, SendCounters(GOAL.name, spec.priority), lambda _channel_id, _outs, _reason: None, first=1
        )
        self.give: Sink = self.watch.outgoing(GOAL, self.channel, self._send)
        self.watch.outgoing(topic("cancel"), self.channel, self._cancel)

    def _send(self, _data: bytes, _stamp_ns: int) -> bool:
        self.channel.start_at(self.channel.next_seq + 1)
        return self.accepts

    def _cancel(self, data: bytes, _stamp_ns: int) -> bool:
        self.cancels.append(data)
        return True

    def _advertise(self, info: TopicInfo) -> "Site":
        self.advertised.append(info)
        return self

    def publish(self, data: bytes, stamp_ns: int) -> None:
        assert stamp_ns > 10**18
        self.results.append(data)

    def close(self) -> None:
        self.closed += 1

    def server_appears(self) -> None:
        self.watch.opened(RESULT, self.results.append)
        self.watch.opened(STATUS, lambda _data: None)

    async def told(self, status: int, *words: str) -> None:
        await until(lambda: self.results, "the client is told")
        (data,) = self.results
        result = result_of(data)
        assert result.status.status == status and all(word in result.status.text for word in words)
        ident = result.status.goal_id
        assert GoalId(ident.stamp.sec, ident.stamp.nanosec, ident.id) == IDENT
        assert self.cancels == [IDENT.pack()]
        assert self.watch.reported == 1


@pytest.fixture
async def site() -> AsyncIterator[Site]:
    made = Site()
    yield made
    made.watch.close()


def test_the_id_is_read_from_the_bytes() -> None:
    data = goal_body()
    assert goal_id(data) == IDENT
    end = data.index(b"8") + 1 if data.endswith(b"8") else len(data) - 4
    for size in range(end):
        with pytest.raises(ConfigError, match="no action goal"):
            goal_id(data[:size])


async def test_a_goal_that_the_link_refuses(site: Site) -> None:
    site.server_appears()
    site.accepts = False
    assert not site.give(goal_body(), 1)
    await site.told(REJECTED, "too much waits for the link")


async def test_a_goal_that_is_dropped_on_its_way(site: Site) -> None:
    site.server_appears()
    seq = site.channel.next_seq
    assert site.give(goal_body(), 1)
    site.watch.send_dropped(site.channel.stream.id, seq + 1, 1, DropReason.LIFESPAN)
    site.watch.send_dropped(site.channel.stream.id, seq, 1, DropReason.LIFESPAN)
    site.watch.send_dropped(site.channel.stream.id, seq, 1, DropReason.LIFESPAN)
    await site.told(REJECTED, "dropped on its way: lifespan")


@pytest.mark.parametrize("count", [1, 2, 3, 2**61])
async def test_a_run_of_messages_that_is_dropped_takes_its_goals(site: Site, count: int) -> None:
    site.server_appears()
    other = site.channel.stream.id._replace(topic=TopicName("/other/goal"))
    first = site.channel.next_seq
    assert site.give(goal_body(), 1)
    site.watch.send_dropped(other, first, count, DropReason.LIFESPAN)
    site.watch.send_dropped(site.channel.stream.id, first + 1, count, DropReason.LIFESPAN)
    await asyncio.sleep(0)
    assert site.watch.watched == 1 and not site.results
    site.watch.send_dropped(site.channel.stream.id, max(1, first - count + 1), count, DropReason.LIFESPAN)
    await site.told(REJECTED, "dropped on its way: lifespan")


async def test_a_goal_of_which_nothing_is_heard(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(actions, "ACCEPT_S", 0.05)
    site = Site()
    site.server_appears()
    site.give(goal_body(), 1)
    await site.told(REJECTED, "nothing was heard of it")
    site.watch.close()


async def test_a_goal_that_was_heard_of_and_then_no_more() -> None:
    site = Site(patience_s=0.05)
    site.server_appears()
    site.give(goal_body(), 1)
    site.watch.message(STATUS.name, Encoding.ROS1, status_body("/other", IDENT.text))
    await site.told(ABORTED, "nothing was heard of it for 0.05 s")
    site.watch.close()


def test_goals_are_read_from_the_bytes_of_a_status() -> None:
    data = status_body("", "/other", IDENT.text)
    assert mentioned_goals(data) == [("", 0), ("/other", 0), (IDENT.text, 0)]
    assert mentioned_goals(data.replace(b"/o", b"\xfco")) == [("", 0), ("\udcfcother", 0), (IDENT.text, 0)]
    assert mentioned_goals(status_body()) == []
    for size in range(len(data)):
        with pytest.raises(ConfigError, match="are no actionlib_msgs/msg/GoalStatusArray"):
            mentioned_goals(data[:size])


async def test_a_status_of_too_many_goals_is_not_read(caplog: pytest.LogCaptureFixture) -> None:
    site = Site(patience_s=0.0)
    site.server_appears()
    site.give(goal_body(), 1)
    many = status_body(IDENT.text, *[""] * MAX_STATUSES)
    for _ in range(3):
        site.watch.message(STATUS.name, Encoding.ROS1, many)
    assert not site.watch._actions[ACTION].goals[IDENT.text].heard
    (record,) = caplog.records
    assert record.message == f"{ACTION}: a status of its goals is not read: it mentions 4001 goals, more than 4000"
    site.watch.close()


async def test_what_a_status_costs_does_not_grow_with_the_goals_it_does_not_mention() -> None:
    costs = []
    for goals in (10, MAX_GOALS - 1):
        site = Site()
        site.server_appears()
        for number in range(goals):
            site.give(goal_body(GoalId(1, 2, f"goal {number}")), 1)
        one = status_body("goal 5")
        look = partial(site.watch.message, STATUS.name, Encoding.ROS1, one)
        costs.append(steps(look, within=actions.__file__))
        costs.append(steps(partial(site.give, goal_body(), 1), within=actions.__file__))
        site.watch.close()
    assert costs[0] > 100 and costs[2:] == costs[:2]


async def test_goals_that_end_leave_nothing_that_grows() -> None:
    """A client that gives goals again and again, while one of before is under way."""
    site = Site()
    site.server_appears()
    site.give(goal_body(), 1)
    for number in range(2000):
        site.give(goal_body(GoalId(1, 2, f"goal {number}")), 1)
        site.watch.message(RESULT.name, Encoding.ROS1, result_for(f"goal {number}"))
        site.watch.message(STATUS.name, Encoding.ROS1, status_body(IDENT.text))
    assert site.watch.watched == 1 and len(site.watch._due_next) < 100
    site.watch.close()


async def test_each_goal_is_given_up_when_it_is_its_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is heard of one moves its time, earlier or later, and no other's."""
    now = 100.0
    monkeypatch.setattr(clock, "now", lambda: now)
    site = Site(patience_s=2.0)  # ACCEPT_S is longer
    site.server_appears()
    given, armed = [], []
    for number in range(4):
        site.give(goal_body(GoalId(1, 2, f"goal {number}")), 1)
        now += 1.0
    site.watch.message(STATUS.name, Encoding.ROS1, status_body("goal 3"))  # due at 106; the others at 105, 106, 107
    now = 105.0
    site.watch._due()
    given.append(len(site.cancels))
    site.watch.message(STATUS.name, Encoding.ROS1, status_body("goal 2"))  # due at 107, as before
    now = 106.0
    site.watch.message(STATUS.name, Encoding.ROS1, status_body("goal 3"))  # due at 108
    site.watch._due()
    given.append(len(site.cancels))
    armed.append(site.watch._timer.deadline_s)
    now = 107.0
    site.watch._due()
    given.append(len(site.cancels))
    now = 108.0
    site.watch._due()
    given.append(len(site.cancels))
    armed.append(site.watch._timer.deadline_s)
    assert given == [1, 2, 3, 4] and armed == [107.0, None] and site.watch.watched == 0
    assert [goal_id(bytes(16) + cancel).text for cancel in site.cancels] == ["goal 0", "goal 1", "goal 2", "goal 3"]
    site.watch.close()


async def test_a_status_of_another_type_is_not_read(site: Site) -> None:
    site.server_appears()
    site.give(goal_body(), 1)
    goal = site.watch._actions[ACTION].goals[IDENT.text]
    for kind, heard in (("evil/msg/GoalStatusArray", False), (STATUS_TYPE, True)):
        site.watch.opened(topic("status", kind), lambda _data: None)
        site.watch.message(STATUS.name, Encoding.ROS1, status_body(IDENT.text))
        assert goal.heard == heard


async def test_a_server_that_is_gone_is_spoken_for(site: Site) -> None:
    site.server_appears()
    site.watch.ended(RESULT.name)
    site.accepts = False
    site.give(goal_body(), 1)
    await site.told(REJECTED)
    assert site.advertised == [RESULT] and site.closed == 1


async def test_a_goal_with_a_result_is_done_and_what_is_no_goal_is_let_through(site: Site) -> None:
    site.server_appears()
    seq = site.channel.next_seq
    assert site.give(b"\1\2\3", 1) and site.give(goal_body(), 1)
    site.watch.message(RESULT.name, Encoding.ROS1, b"\0")
    site.watch.message(STATUS.name, Encoding.ROS1, b"\0")
    site.watch.message(RESULT.name, Encoding.ROS1, result_for(IDENT.text))
    site.watch.send_dropped(site.channel.stream.id, seq, 1, DropReason.LIFESPAN)
    site.accepts = False
    site.give(goal_body(GoalId(0, 0, "another")), 1)
    await until(lambda: site.results, "the next is told of")
    assert [result_of(data).status.goal_id.id for data in site.results] == ["another"]


async def test_a_goal_that_is_given_again_is_watched_in_place_of_the_one_before(site: Site) -> None:
    """A client that does not see its server does so; what becomes of the first makes no difference any more."""
    site.server_appears()
    seq = site.channel.next_seq
    for _ in range(3):
        site.give(goal_body(), 1)
    assert site.watch.watched == 1
    site.watch.message(RESULT.name, Encoding.ROS1, result_for(IDENT.text))
    site.watch.send_dropped(site.channel.stream.id, seq, 1, DropReason.LIFESPAN)
    assert site.watch.watched == 0 and site.results == []


async def test_a_goal_behind_one_that_was_refused_is_watched(site: Site) -> None:
    """What was refused took no number: the next one has it."""
    sent: list[bytes] = []

    def send(data: bytes, _stamp_ns: int) -> bool:
        if not sent:
            sent.append(data)
            return False
        site.channel.start_at(site.channel.next_seq + 1)
        return True

    site.server_appears()
    give = site.watch.outgoing(GOAL, site.channel, send)
    seq = site.channel.next_seq
    later = IDENT._replace(text="/client-2-7.8")
    assert not give(goal_body(), 1)
    assert give(goal_body(later), 1)
    await site.told(REJECTED, "too much waits for the link")
    assert site.watch.watched == 1
    site.watch.send_dropped(site.channel.stream.id, seq, 1, DropReason.LIFESPAN)
    await until(lambda: len(site.results) == 2, "the client is told of the second one")
    assert "dropped on its way" in result_of(site.results[1]).status.text
    assert site.cancels == [IDENT.pack(), later.pack()] and site.watch.watched == 0


async def test_clients_that_are_gone_are_told_nothing(site: Site) -> None:
    site.server_appears()
    seq = site.channel.next_seq
    site.give(goal_body(), 1)
    site.watch.withdrawn(GOAL.name)
    site.watch.send_dropped(site.channel.stream.id, seq, 1, DropReason.LIFESPAN)
    site.accepts = False
    site.give(goal_body(GoalId(0, 0, "another")), 1)
    await until(lambda: site.results, "the next is told of")
    assert len(site.results) == 1 and site.watch.reported == 1


async def test_goals_beside_one_that_nobody_can_be_told_of(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(actions, "ACCEPT_S", 0.05)
    site = Site()
    told: list[bytes] = []

    def publish(data: bytes) -> None:
        if goal_id(data).text == "bad":
            raise OSError("no message")
        told.append(data)

    site.watch.opened(RESULT, publish)
    latin = goal_body(GoalId(0, 0, "uber")).replace(b"uber", b"\xfcber")
    for data in (goal_body(GoalId(0, 0, "bad")), latin, goal_body(GoalId(0, 0, "last"))):
        site.give(data, 1)
    await until(lambda: site.watch.reported == 2, "the others are told")
    assert [goal_id(data).pack()[12:] for data in told] == [b"\xfcber", b"last"]
    assert [data[12:] for data in site.cancels] == [b"bad", b"\xfcber", b"last"]
    assert "the client of goal bad could not be told" in caplog.text and r"goal \xfcber is given up" in caplog.text
    site.give(goal_body(GoalId(0, 0, "later")), 1)
    await until(lambda: site.watch.reported == 3, "the timer goes on")
    site.watch.close()


async def test_a_goal_that_cannot_be_cancelled_is_told_all_the_same(site: Site) -> None:
    def broken(_data: bytes, _stamp_ns: int) -> bool:
        raise OSError("no message")

    site.watch.outgoing(topic("cancel"), site.channel, broken)
    site.server_appears()
    site.accepts = False
    site.give(goal_body(), 1)
    await until(lambda: site.watch.reported == 1)
    assert [result_of(data).status.status for data in site.results] == [REJECTED]


async def test_other_topics_are_left_alone(site: Site) -> None:
    sink: Sink = lambda _body, _stamp_ns: True  # noqa: E731
    for name, encoding in (("/robot2/count/goal", Encoding.ROS1), (GOAL.name, Encoding.CDR), ("/goal", Encoding.ROS1)):
        info = TopicInfo(TopicName(name), GOAL.type_name, encoding)
        assert site.watch.outgoing(info, site.channel, sink) is sink


def action_service(part: str, definition: str = "", encoding: Encoding = Encoding.CDR) -> ServiceInfo:
    return ServiceInfo(TopicName(f"/count/_action/{part}"), "count/action/Count_Any", encoding, "", definition)


def test_what_is_answered_for_ros_2() -> None:
    head = b"\0\1\0\0"
    assert refusal(action_service("send_goal")) == head + bytes(12)
    assert refusal(action_service("cancel_goal")) == head + b"\1" + bytes(7)
    result = "unique_identifier_msgs/UUID goal_id\n---\nint8 status\nint32[] sequence\n"
    result += "=" * 80 + "\nMSG: unique_identifier_msgs/UUID\nuint8[16] uuid\n"
    answer = refusal(action_service("get_result", result))
    assert answer is not None and answer[:12] == head + bytes(8)
    assert refusal(action_service("get_result")) is None
    assert refusal(action_service("send_goal", encoding=Encoding.ROS1)) is None
    assert refusal(ServiceInfo(TopicName("/send_goal"), "count/srv/Any", Encoding.CDR, "")) is None


@pytest.mark.parametrize("head", [b"\0\1\0\0", b"\0\0\0\0"])
def test_the_goal_of_a_request_can_be_cancelled(head: bytes) -> None:
    uuid = bytes(range(16))
    assert cancel_request(head + uuid + struct.pack("<i", 5)) == head + uuid + bytes(8)
    assert cancel_request(head + uuid[:15]) is None
    assert cancel_request(b"\0\3\0\0" + uuid) is None
