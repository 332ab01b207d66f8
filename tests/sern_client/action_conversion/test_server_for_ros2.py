"""Nodes of ROS 2 here give goals to a server of ROS 1: what they are told, whatever happens."""

import asyncio
import struct
from collections import Counter
from collections.abc import AsyncIterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sern_client.action_conversion import bodies, crossing, server_for_ros2
from sern_client.action_conversion.bodies import NO_STAMP, NO_UUID, GoalInfo, Stamp
from sern_client.action_conversion.server_for_ros2 import ServerForRos2
from sern_client.action_conversion.statuses import Ros1Status, Ros2Status
from sern_client.action_conversion.types import ActionTypes
from sern_client.actions import MAX_STATUSES, STATUS_TYPE, GoalId
from sern_client.endpoints.base import Held, Publisher
from sern_client.endpoints.conversion import Converter
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import clock, ros_types
from tests.sern_client.action_conversion.files import FIBONACCI, files, types_of
from tests.sern_client.action_conversion.nodes import ACTION, Site, publish, refuse, ros1_topic
from tests.support import until

UUID = bytes(range(16))
OTHER = bytes(range(100, 116))
GOAL, CANCEL = TopicName(f"{ACTION}/goal"), TopicName(f"{ACTION}/cancel")
STATUS, FEEDBACK = TopicName(f"{ACTION}/_action/status"), TopicName(f"{ACTION}/_action/feedback")
REFUSED = bodies.goal_response(accepted=False, stamp=NO_STAMP)
PENDING, ACTIVE, PREEMPTED, SUCCEEDED = (
    Ros1Status.PENDING,
    Ros1Status.ACTIVE,
    Ros1Status.PREEMPTED,
    Ros1Status.SUCCEEDED,
)
SEQUENCE = struct.pack("<I3i", 3, 1, 1, 2)


class Robot:
    """The server of ROS 1 as its streams are at the site."""

    def __init__(self, site: Site, types: ActionTypes) -> None:
        self.site = site
        self.types = types
        self.parts: dict[str, Publisher] = {}

    def open(self, *parts: str) -> None:
        kinds: dict[str, tuple[str, ros_types.TypeText | None]] = {
            "status": (STATUS_TYPE, None),
            "feedback": self.types.feedback.topic,
            "result": self.types.result.topic,
        }
        for part in parts or kinds:
            self.parts[part] = self.site.endpoint.advertise(ros1_topic(part, *kinds[part]))

    def close(self, *parts: str) -> None:
        for part in parts or tuple(self.parts):
            self.parts.pop(part).close()

    async def appears(self) -> None:
        self.open()
        await until(lambda: GOAL in self.site.events.infos and CANCEL in self.site.events.infos, "it is shown")
        for name in (GOAL, CANCEL):
            self.site.take(name)

    def given(self, number: int = -1) -> GoalId:
        return bodies.split_goal(self.site.given[GOAL][number])[0]

    def says(self, *statuses: tuple[GoalId, int]) -> None:
        each = [bodies.ros1_status(ident, status, "") for ident, status in statuses]
        publish(self.parts["status"], bodies.ros1_statuses(1, NO_STAMP, each))

    def feedback(self, ident: GoalId, status: int = ACTIVE, own: bytes = SEQUENCE) -> None:
        publish(self.parts["feedback"], bodies.ros1_header(1, NO_STAMP) + bodies.ros1_status(ident, status, "") + own)

    def result(self, ident: GoalId, status: int, own: bytes = SEQUENCE, text: str = "") -> None:
        publish(self.parts["result"], bodies.ros1_header(1, NO_STAMP) + bodies.ros1_status(ident, status, text) + own)


@pytest.fixture
async def site(tmp_path: Path) -> AsyncIterator[Site]:
    made = await Site(Encoding.CDR, tmp_path).start()
    yield made
    await made.endpoint.stop()


@pytest.fixture
async def robot(site: Site) -> Robot:
    made = Robot(site, types_of("count/Count", list(site.endpoint.files)))
    await made.appears()
    return made


def goal(uuid: bytes = UUID, order: int = 5) -> bytes:
    return bodies.HEAD + uuid + struct.pack("<i", order)


def statuses(site: Site) -> dict[bytes, int]:
    return dict(bodies.split_statuses(site.nodes.published[STATUS].bodies[-1]))


def result(status: int, *sequence: int) -> bytes:
    return bodies.HEAD + struct.pack(f"<b3xI{len(sequence)}i", status, len(sequence), *sequence)


async def give(site: Site, robot: Robot, uuid: bytes = UUID) -> tuple["asyncio.Task[bytes]", GoalId]:
    """A goal that waits for an answer, and what it is called in ROS 1."""
    before = len(site.given[GOAL])
    answer = asyncio.ensure_future(site.call("send_goal")(goal(uuid)))
    await until(lambda: len(site.given[GOAL]) > before, "the goal is given")
    return answer, robot.given()


async def accepted(site: Site, robot: Robot, uuid: bytes = UUID) -> GoalId:
    """A goal that is under way."""
    answer, ident = await give(site, robot, uuid)
    robot.says((ident, ACTIVE))
    assert bodies.is_accepted(await answer)
    return ident


async def test_it_is_shown_as_an_action_of_ros_2(site: Site, robot: Robot) -> None:
    served, published = site.nodes.served, site.nodes.published
    assert set(served) == {f"{ACTION}/_action/{part}" for part in ("send_goal", "cancel_goal", "get_result")}
    assert set(published) == {STATUS, FEEDBACK}
    assert all(each.info.type_hash.startswith("RIHS01_") for each in (*served.values(), *published.values()))
    assert published[STATUS].info.latched and statuses(site) == {}
    goal_info = site.events.infos[GOAL]
    assert (goal_info.type_name, goal_info.encoding) == ("count/msg/CountActionGoal", Encoding.ROS1)
    assert goal_info.type_hash == robot.types.goal.topic[1].type_hash


async def test_a_goal_its_feedback_and_its_result(site: Site, robot: Robot) -> None:
    answer, ident = await give(site, robot)
    body = site.given[GOAL][0]
    assert bodies.split_goal(body) == (ident, struct.pack("<i", 5))
    resolved = ros_types.resolve("count/msg/CountActionGoal", robot.types.goal.topic[1].definition, Encoding.ROS1)
    read: Any = resolved.store.deserialize_ros1(body, resolved.name)
    assert read.goal.order == 5
    await asyncio.sleep(0)
    assert not answer.done() and statuses(site) == {}
    robot.says((GoalId(1, 2, "another's"), ACTIVE), (ident, ACTIVE))
    response = await answer
    assert bodies.is_accepted(response)
    assert Stamp(*struct.unpack_from("<iI", response, 8)) == Stamp(ident.secs, ident.nsecs)
    assert statuses(site) == {UUID: Ros2Status.EXECUTING}

    asked = asyncio.ensure_future(site.call("get_result")(bodies.result_request(UUID)))
    robot.feedback(ident)
    robot.feedback(GoalId(0, 0, "another's"))
    assert site.nodes.published[FEEDBACK].bodies == [bodies.HEAD + UUID + SEQUENCE]
    robot.says((ident, SUCCEEDED))
    await asyncio.sleep(0)
    assert not asked.done()
    robot.result(ident, SUCCEEDED)
    assert await asked == result(Ros2Status.SUCCEEDED, 1, 1, 2)
    assert statuses(site) == {UUID: Ros2Status.SUCCEEDED}
    # Whoever asks later is told the same, and what comes later changes nothing.
    robot.result(ident, Ros1Status.ABORTED)
    robot.feedback(ident)
    robot.says((ident, ACTIVE))
    assert await site.call("get_result")(bodies.result_request(UUID)) == result(Ros2Status.SUCCEEDED, 1, 1, 2)
    assert statuses(site) == {UUID: Ros2Status.SUCCEEDED} and len(site.nodes.published[FEEDBACK].bodies) == 1


async def test_a_status_is_published_when_it_changes(site: Site, robot: Robot) -> None:
    ident = await accepted(site, robot)
    count = len(site.nodes.published[STATUS].bodies)
    for _ in range(3):
        robot.says((ident, ACTIVE))
    assert len(site.nodes.published[STATUS].bodies) == count
    robot.says((ident, PENDING))  # from before what a feedback has said
    assert statuses(site) == {UUID: Ros2Status.EXECUTING}
    robot.says((ident, Ros1Status.PREEMPTING))
    assert statuses(site) == {UUID: Ros2Status.CANCELING}


@pytest.mark.parametrize(
    ("ros1", "ros2"),
    [
        (Ros1Status.PREEMPTED, Ros2Status.CANCELED),
        (Ros1Status.RECALLED, Ros2Status.CANCELED),
        (Ros1Status.ABORTED, Ros2Status.ABORTED),
        (Ros1Status.LOST, Ros2Status.ABORTED),
        (Ros1Status.REJECTED, Ros2Status.ABORTED),
        (Ros1Status.ACTIVE, Ros2Status.ABORTED),
        (200, Ros2Status.ABORTED),
    ],
)
async def test_how_a_goal_ends(site: Site, robot: Robot, ros1: int, ros2: int) -> None:
    ident = await accepted(site, robot)
    robot.result(ident, ros1)
    assert await site.call("get_result")(bodies.result_request(UUID)) == result(ros2, 1, 1, 2)
    assert statuses(site) == {UUID: ros2}


@pytest.mark.parametrize("by_status", [True, False])
async def test_a_goal_that_is_rejected_was_not_accepted(site: Site, robot: Robot, by_status: bool) -> None:
    """Also by what `GoalWatch` says in the server's place."""
    answer, ident = await give(site, robot)
    if by_status:
        robot.says((ident, Ros1Status.REJECTED))
    robot.result(ident, Ros1Status.REJECTED, b"\0\0\0\0", "SERN: it was dropped on its way")
    assert await answer == REFUSED
    assert statuses(site) == {}
    assert await site.call("get_result")(bodies.result_request(UUID)) == result(Ros2Status.UNKNOWN)


async def test_a_goal_of_which_the_result_is_the_first_thing_heard(site: Site, robot: Robot) -> None:
    answer, ident = await give(site, robot)
    robot.result(ident, SUCCEEDED)
    assert bodies.is_accepted(await answer)
    assert await site.call("get_result")(bodies.result_request(UUID)) == result(Ros2Status.SUCCEEDED, 1, 1, 2)


class Clock:
    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 100.0
        monkeypatch.setattr(clock, "now", lambda: self.now)


def server(site: Site) -> Any:
    stage: Any = site.endpoint._actions[ACTION].stage
    return stage._server


async def test_a_goal_that_waits_its_turn_is_accepted(
    site: Site, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    time = Clock(monkeypatch)
    answer, ident = await give(site, robot)
    robot.says((ident, PENDING))
    time.now += server_for_ros2.PENDING_S / 2
    robot.says((ident, PENDING))
    server(site)._due()
    await asyncio.sleep(0)
    assert not answer.done()
    time.now += server_for_ros2.PENDING_S / 2
    server(site)._due()
    assert bodies.is_accepted(await answer) and statuses(site) == {UUID: Ros2Status.ACCEPTED}
    robot.says((ident, Ros1Status.RECALLING))
    assert statuses(site) == {UUID: Ros2Status.CANCELING}
    robot.result(ident, Ros1Status.RECALLED)
    assert statuses(site) == {UUID: Ros2Status.CANCELED}


async def test_a_goal_of_which_nobody_says_anything_is_refused_and_cancelled(
    site: Site, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    time = Clock(monkeypatch)
    answer, ident = await give(site, robot)
    assert server(site)._timer.deadline_s == 110.0
    time.now = 110.0
    server(site)._due()
    assert await answer == REFUSED
    assert [bodies.split_cancel(body) for body in site.given[CANCEL]] == [GoalId(0, 0, ident.text)]


async def test_a_goal_that_ended_is_forgotten_after_a_while(
    site: Site, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    time = Clock(monkeypatch)
    ident = await accepted(site, robot)
    robot.result(ident, SUCCEEDED)
    assert server(site)._timer.deadline_s == 100.0 + server_for_ros2.KEEP_S
    time.now += server_for_ros2.KEEP_S
    server(site)._due()
    assert statuses(site) == {} and server(site)._timer.deadline_s is None
    assert await site.call("get_result")(bodies.result_request(UUID)) == result(Ros2Status.UNKNOWN)
    again, _ = await give(site, robot)  # the same id is another goal now
    robot.says((ident, Ros1Status.REJECTED), (robot.given(), ACTIVE))
    assert bodies.is_accepted(await again)


async def test_cancelling_one(site: Site, robot: Robot) -> None:
    ident, other = await accepted(site, robot), await accepted(site, robot, OTHER)
    answer = await site.call("cancel_goal")(bodies.cancel_request(GoalInfo(UUID, NO_STAMP)))
    assert answer == bodies.cancel_response(bodies.NONE, [GoalInfo(UUID, Stamp(ident.secs, ident.nsecs))])
    assert [bodies.split_cancel(body) for body in site.given[CANCEL]] == [GoalId(0, 0, ident.text)]
    robot.says((ident, ACTIVE), (other, ACTIVE))  # it has not heard of it yet
    assert statuses(site) == {UUID: Ros2Status.CANCELING, OTHER: Ros2Status.EXECUTING}
    robot.result(ident, PREEMPTED)
    assert await site.call("get_result")(bodies.result_request(UUID)) == result(Ros2Status.CANCELED, 1, 1, 2)
    for uuid, code in ((UUID, bodies.TERMINATED), (bytes(15) + b"\1", bodies.UNKNOWN_GOAL)):
        answer = await site.call("cancel_goal")(bodies.cancel_request(GoalInfo(uuid, NO_STAMP)))
        assert answer == bodies.cancel_response(code)
    assert len(site.given[CANCEL]) == 1


async def test_cancelling_all_means_all_there_are(site: Site, robot: Robot) -> None:
    await accepted(site, robot)
    await accepted(site, robot, OTHER)
    answer = await site.call("cancel_goal")(bodies.cancel_request(GoalInfo(NO_UUID, NO_STAMP)))
    assert bodies.cancel_code(answer) == bodies.NONE and answer[8] == 2
    assert [bodies.split_cancel(body) for body in site.given[CANCEL]] == [GoalId(0, 0, "")]


async def test_cancelling_those_of_before(site: Site, robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("time.time_ns", lambda: 2 * 10**18)
    ident = await accepted(site, robot)
    monkeypatch.setattr("time.time_ns", lambda: 2 * 10**18 + 5)
    await accepted(site, robot, OTHER)
    meant = Stamp(ident.secs, ident.nsecs + 2)
    answer = await site.call("cancel_goal")(bodies.cancel_request(GoalInfo(NO_UUID, meant)))
    assert answer == bodies.cancel_response(bodies.NONE, [GoalInfo(UUID, Stamp(ident.secs, ident.nsecs))])
    assert [bodies.split_cancel(body).text for body in site.given[CANCEL]] == [ident.text]


async def test_what_the_link_refuses(site: Site, robot: Robot, caplog: pytest.LogCaptureFixture) -> None:
    ident = await accepted(site, robot)
    site.accepts = False
    assert await site.call("send_goal")(goal(OTHER)) == REFUSED
    answer = await site.call("cancel_goal")(bodies.cancel_request(GoalInfo(UUID, NO_STAMP)))
    assert answer == bodies.cancel_response(bodies.REJECTED)
    assert f"goal {ident.text} could not be cancelled" in caplog.text
    assert statuses(site) == {UUID: Ros2Status.EXECUTING}


async def test_a_goal_before_the_link_has_the_topic(site: Site, caplog: pytest.LogCaptureFixture) -> None:
    robot = Robot(site, types_of("count/Count", list(site.endpoint.files)))
    robot.open()
    await until(lambda: len(site.nodes.served) == 3, "it is shown")
    assert await site.call("send_goal")(goal()) == REFUSED
    assert f"{ACTION}: a goal is refused: it cannot go to the link" in caplog.text


async def test_bodies_that_are_none(site: Site, robot: Robot, caplog: pytest.LogCaptureFixture) -> None:
    ident = await accepted(site, robot)
    for _ in range(3):
        assert await site.call("send_goal")(bodies.HEAD + OTHER) == REFUSED
        assert await site.call("send_goal")(b"") == REFUSED
        assert await site.call("cancel_goal")(b"") == bodies.cancel_response(bodies.REJECTED)
        assert await site.call("get_result")(b"") == result(Ros2Status.UNKNOWN)
        for part in robot.parts.values():
            publish(part, b"\1")
        robot.feedback(ident, own=b"\1")
    assert len(caplog.records) == 6 and all(record.message.startswith(f"{ACTION}: ") for record in caplog.records)
    assert not any("\n" in record.message for record in caplog.records)
    assert site.endpoint.converter.failures == 24
    robot.result(ident, SUCCEEDED, b"\1")
    assert await site.call("get_result")(bodies.result_request(UUID)) == result(Ros2Status.ABORTED)
    assert "counts as aborted: its result is lost" in caplog.text


async def test_a_status_of_too_many_goals(site: Site, robot: Robot, caplog: pytest.LogCaptureFixture) -> None:
    answer, ident = await give(site, robot)
    many = [(GoalId(0, 0, ""), 1)] * MAX_STATUSES
    robot.says(*many, (ident, ACTIVE))
    assert f"{ACTION}: a status of its goals is not read: it mentions 4001 goals, more than 4000" in caplog.text
    robot.says(*many[1:], (ident, ACTIVE))
    assert bodies.is_accepted(await answer)


async def test_the_same_goal_twice_and_too_many_goals(
    site: Site, robot: Robot, caplog: pytest.LogCaptureFixture
) -> None:
    await accepted(site, robot)
    assert await site.call("send_goal")(goal()) == REFUSED
    assert "a goal is refused: a goal of that id is under way" in caplog.text
    for number in range(1, 64):
        await accepted(site, robot, bytes([number]) * 16)
    assert await site.call("send_goal")(goal(OTHER)) == REFUSED
    assert "a goal is refused: 64 goals are under way already" in caplog.text
    assert len(site.given[GOAL]) == 64


async def test_a_client_that_goes_before_it_is_answered(site: Site, robot: Robot) -> None:
    answer, ident = await give(site, robot)
    answer.cancel()
    await until(lambda: site.given[CANCEL], "its goal is cancelled")
    assert [bodies.split_cancel(body).text for body in site.given[CANCEL]] == [ident.text]
    robot.result(ident, PREEMPTED)


async def test_a_server_that_goes_is_shown_until_its_goals_have_ended(site: Site, robot: Robot) -> None:
    ident = await accepted(site, robot)
    asked = asyncio.ensure_future(site.call("get_result")(bodies.result_request(UUID)))
    robot.close()
    await asyncio.sleep(0)
    assert await site.call("send_goal")(goal(OTHER)) == REFUSED
    # As `GoalWatch` tells of it: the topic is there for this one message.
    robot.open("result")
    robot.result(ident, Ros1Status.ABORTED, b"\0\0\0\0")
    robot.close("result")
    assert await asked == result(Ros2Status.ABORTED)
    await until(lambda: not site.nodes.served and not site.nodes.published, "it is withdrawn")
    assert not site.endpoint._actions
    assert GOAL not in site.events.infos and CANCEL not in site.events.infos
    robot.open()
    await until(lambda: len(site.nodes.served) == 3, "it comes back")


async def test_a_server_that_comes_back_goes_on_with_its_goals(site: Site, robot: Robot) -> None:
    ident = await accepted(site, robot)
    robot.close()
    robot.open()
    await asyncio.sleep(0)
    robot.result(ident, SUCCEEDED)
    assert await site.call("get_result")(bodies.result_request(UUID)) == result(Ros2Status.SUCCEEDED, 1, 1, 2)
    await accepted(site, robot, OTHER)


async def test_a_server_of_another_type_takes_the_place_of_the_one_before(tmp_path: Path) -> None:
    """Its streams may be there before those of the first have ended."""
    other = "int64 order\n---\n---\nbool more\n"
    site = await Site(Encoding.CDR, tmp_path, count__Count=FIBONACCI, other__Other=other).start()
    first, second = (Robot(site, types_of(name, list(site.endpoint.files))) for name in ("count/Count", "other/Other"))
    await first.appears()
    second.open()

    def others() -> bool:
        """Whether all that there is at the site is the second one's."""
        packages = sorted(server.info.type_name.partition("/")[0] for server in site.nodes.served.values())
        goal = site.events.infos.get(GOAL)
        return packages == ["action_msgs", "other", "other"] and goal is not None and "other" in goal.type_name

    await until(others, "it is the other's")
    first.close()
    await asyncio.sleep(0)
    assert others()
    second.close()
    await site.endpoint.stop()


async def test_whoever_waits_is_answered_when_this_site_stops(tmp_path: Path) -> None:
    site = await Site(Encoding.CDR, tmp_path).start()
    robot = Robot(site, types_of("count/Count", list(site.endpoint.files)))
    await robot.appears()
    await accepted(site, robot)
    asked = asyncio.ensure_future(site.call("get_result")(bodies.result_request(UUID)))
    answer, _ = await give(site, robot, OTHER)
    robot.close()
    await site.endpoint.stop()
    assert await asked == result(Ros2Status.UNKNOWN) and await answer == REFUSED


# What is not converted ----------------------------------------------------------------------------------------------


async def test_a_type_that_is_not_known_is_said_once_and_its_topics_pass(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    site = await Site(Encoding.CDR, tmp_path / "here", other__Other=FIBONACCI).start()
    robot = Robot(site, types_of("count/Count", files(tmp_path / "elsewhere", count__Count=FIBONACCI)))
    robot.open()
    await until(lambda: len(site.nodes.published) == 3, "its topics pass")
    assert set(site.nodes.published) == {f"{ACTION}/{part}" for part in ("status", "feedback", "result")}
    (line,) = [record.message for record in caplog.records if record.levelname == "ERROR"]
    assert line.startswith(f"action {ACTION} is not converted: the definition of count/action/Count, which stands for")
    assert line.endswith("add the directory of its .action file to type_paths of the ROS 2 endpoint")
    robot.result(GoalId(1, 2, "a"), SUCCEEDED)
    assert len(site.nodes.published[TopicName(f"{ACTION}/result")].bodies) == 1
    robot.close("result")
    robot.open("result")
    assert len(site.nodes.published) == 3
    robot.close()
    assert not site.nodes.published
    await site.endpoint.stop()


async def test_actions_that_differ_are_said_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    site = await Site(
        Encoding.CDR, tmp_path / "here", count__Count="int32 order\n---\nint64[] sequence\n---\nint32[] sequence\n"
    ).start()
    robot = Robot(site, types_of("count/Count", files(tmp_path / "elsewhere", count__Count=FIBONACCI)))
    robot.open()
    await until(lambda: "count/msg/CountResult and its like in the other ROS differ in sequence" in caplog.text, "said")
    await until(lambda: len(site.nodes.published) == 3, "its topics pass")
    robot.close()
    await site.endpoint.stop()


async def test_what_the_endpoint_refuses_leaves_nothing_behind(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    site = await Site(Encoding.CDR, tmp_path).start()
    refuse(site.nodes, f"{ACTION}/_action/get_result", "a node here serves it already")
    robot = Robot(site, types_of("count/Count", list(site.endpoint.files)))
    robot.open()
    await until(lambda: f"action {ACTION} is not converted: a node here serves it already" in caplog.text, "it is said")
    assert not site.nodes.served and not site.events.infos
    assert set(site.nodes.published) == {f"{ACTION}/{part}" for part in ("status", "feedback", "result")}
    robot.close()
    await site.endpoint.stop()


async def test_goals_need_the_namespace_of_all(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    site = await Site(Encoding.CDR, tmp_path, namespace="/site").start()
    robot = Robot(site, types_of("count/Count", list(site.endpoint.files)))
    robot.open()
    assert len(site.nodes.published) == 3
    assert caplog.text.count('which needs client.namespace: "/" at this site') == 1
    robot.close()
    await site.endpoint.stop()


async def test_an_action_that_lacks_a_part_is_told_of(
    site: Site, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(crossing, "INCOMPLETE_S", 0.01)
    robot = Robot(site, types_of("count/Count", list(site.endpoint.files)))
    robot.open("status", "feedback")
    await until(lambda: "nothing has come of its result; see that its server runs" in caplog.text, "it is said")
    robot.open("result")
    await until(lambda: len(site.nodes.served) == 3, "it is shown")


async def test_topics_that_are_no_actions_pass(site: Site) -> None:
    for part, kind in (("status", "std_msgs/msg/String"), ("result", "std_msgs/msg/String"), ("more", STATUS_TYPE)):
        publisher = site.endpoint.advertise(ros1_topic(part, kind))
        assert list(site.nodes.published) == [f"{ACTION}/{part}"]
        publisher.close()
    other = ros1_topic("status", STATUS_TYPE)
    publisher = site.endpoint.advertise(ros_types.topic_info("/robot2/status", other.type_name, Encoding.ROS1))
    assert list(site.nodes.published) == ["/robot2/status"]
    publisher.close()


async def test_the_tables_are_compared_as_they_are(site: Site, robot: Robot) -> None:
    names = {part: TopicName(f"{ACTION}/{part}") for part in ("status", "feedback", "result")}
    held = Held(_count(*names.values(), "/other"), _count(GOAL, CANCEL, "/more"))
    assert site.endpoint.validate(held) == []
    assert site.nodes.held == Held(_count("/other", STATUS, FEEDBACK), _count("/more"))
    del held.publishers[names["result"]]
    assert [each.name for each in site.endpoint.validate(held)] == [names["result"]]


def _count(*names: str) -> Counter[TopicName]:
    return Counter(TopicName(name) for name in names)


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["status", "feedback", "result", "send_goal", "cancel_goal", "get_result"]),
            st.binary(max_size=80),
        ),
        max_size=5,
    )
)
def test_whatever_comes_stops_nothing(said: list[tuple[str, bytes]]) -> None:
    """Every call is answered, also where it begins as it should."""

    async def play() -> None:
        with TemporaryDirectory() as place:
            types = types_of("count/Count", files(Path(place), count__Count=FIBONACCI))
        told: list[bytes] = []
        made = ServerForRos2(
            "/count", types, answer_s=5.0, publish_status=told.append, publish_feedback=told.append,
            idle=lambda: None, counts=Converter(),
        )  # fmt: skip
        made.goal_sink = made.cancel_sink = lambda _body, _stamp_ns: True
        calls = []
        for kind, body in said:
            begins = bodies.HEAD if "_" in kind else bodies.ros1_header(1, NO_STAMP)
            for each in (body, begins + body):
                done = getattr(made, kind)(each)
                if done is not None:
                    calls.append(asyncio.ensure_future(done))
        await asyncio.sleep(0)
        made.close()
        assert all(answer[:2] == b"\0\1" for answer in await asyncio.gather(*calls))

    asyncio.run(play())
