"""Nodes of ROS 1 here give goals to a server of ROS 2: what they are told, whatever happens."""

import asyncio
import struct
from collections import Counter
from collections.abc import AsyncIterator
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sern_client.action_conversion import bodies, cancelling, server_for_ros1
from sern_client.action_conversion.bodies import HEAD, NO_STAMP, NO_UUID, GoalInfo, Stamp, StatusPart
from sern_client.action_conversion.cancelling import Cancelling
from sern_client.action_conversion.server_for_ros1 import ServerForRos1
from sern_client.action_conversion.statuses import Ros1Status, Ros2Status
from sern_client.actions import STATUS_TYPE, GoalId, goal_id, mentioned_goals, refusal
from sern_client.endpoints.base import Held, Publisher, ServiceInfo, ServiceServer
from sern_client.endpoints.conversion import Converter
from sern_core.vocabulary.errors import ServiceError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import clock
from tests.sern_client.action_conversion.files import FIBONACCI, files, types_of
from tests.sern_client.action_conversion.nodes import ACTION, Site, publish, refuse, ros1_topic
from tests.support import until

IDENT = GoalId(7, 8, "/client-1-7.8")
OTHER = GoalId(9, 8, "/client-2-9.8")
GOAL, CANCEL = TopicName(f"{ACTION}/goal"), TopicName(f"{ACTION}/cancel")
TYPES = {
    "send_goal": "count/action/Count_SendGoal",
    "cancel_goal": "action_msgs/srv/CancelGoal",
    "get_result": "count/action/Count_GetResult",
    "feedback": "count/action/Count_FeedbackMessage",
    "status": "action_msgs/msg/GoalStatusArray",
}
SERVICES = ("send_goal", "cancel_goal", "get_result")
SEQUENCE = struct.pack("<I3i", 3, 1, 1, 2)
ACCEPTED = bodies.goal_response(accepted=True, stamp=Stamp(1, 2))


class Call:
    """One of a service of the robot, until it is answered."""

    def __init__(self, part: str, request: bytes) -> None:
        self.part = part
        self.request = request
        self.answer: asyncio.Future[bytes] = asyncio.get_running_loop().create_future()

    @property
    def uuid(self) -> bytes:
        return self.request[4:20]


class Robot:
    """The server of ROS 2 as its streams and services are at the site."""

    def __init__(self, site: Site, known: Path, *, bare: bool = False) -> None:
        self.site = site
        self.calls: list[Call] = []
        self.parts: dict[str, Publisher | ServiceServer] = {}
        self._files = files(known, count__Count=FIBONACCI)[0]
        self._bare = bare

    def open(self, *parts: str) -> None:
        for part in parts or TYPES:
            name, kind = TopicName(f"{ACTION}/_action/{part}"), TYPES[part]
            if part in SERVICES:
                text = "" if self._bare else self._files.service(kind)
                assert text is not None
                info = ServiceInfo(name, kind, Encoding.CDR, "RIHS01_1", text)
                self.parts[part] = self.site.endpoint.serve(info, partial(self._called, part))
            else:
                text = "" if self._bare else self._files.message(kind)
                assert text is not None
                self.parts[part] = self.site.endpoint.advertise(TopicInfo(name, kind, Encoding.CDR, "RIHS01_2", text))

    def close(self, *parts: str) -> None:
        for part in parts or tuple(self.parts):
            self.parts.pop(part).close()

    async def _called(self, part: str, request: bytes) -> bytes:
        call = Call(part, request)
        self.calls.append(call)
        return await call.answer

    async def appears(self) -> None:
        self.open()
        await until(lambda: len(self.site.nodes.published) == 3, "it is shown")

    async def call(self, part: str, number: int = 1) -> Call:
        """The call of that number of a service."""

        def found() -> list[Call]:
            return [call for call in self.calls if call.part == part]

        await until(lambda: len(found()) >= number, f"{part} is called")
        return found()[number - 1]

    def publish(self, part: str, body: bytes) -> None:
        publisher: Any = self.parts[part]
        publish(publisher, body)

    def says(self, *statuses: tuple[bytes, int]) -> None:
        self.publish("status", bodies.ros2_statuses((GoalInfo(uuid, Stamp(1, 2)), status) for uuid, status in statuses))


@pytest.fixture
async def site(tmp_path: Path) -> AsyncIterator[Site]:
    made = await Site(Encoding.ROS1, tmp_path / "site", nothing__Of=FIBONACCI).start()
    yield made
    await made.endpoint.stop()


@pytest.fixture
async def robot(site: Site, tmp_path: Path) -> Robot:
    made = Robot(site, tmp_path / "robot")
    await made.appears()
    return made


def client_appears(site: Site, tmp_path: Path, text: str = FIBONACCI) -> None:
    types = types_of("count/Count", files(tmp_path / "client", count__Count=text))
    site.nodes.add(ros1_topic("goal", *types.goal.topic))
    site.nodes.add(ros1_topic("cancel", "actionlib_msgs/msg/GoalID"))


def give(site: Site, ident: GoalId = IDENT, own: bytes = b"\5\0\0\0") -> None:
    assert site.nodes.sinks[GOAL].sink(bodies.ros1_goal(1, ident, own), 1)


def cancel(site: Site, ident: GoalId) -> None:
    assert site.nodes.sinks[CANCEL].sink(ident.pack(), 1)


def statuses(site: Site) -> dict[str, int]:
    return dict(mentioned_goals(site.nodes.published[TopicName(f"{ACTION}/status")].bodies[-1]))


def results(site: Site) -> list[StatusPart]:
    return [bodies.split_status(body) for body in site.nodes.published[TopicName(f"{ACTION}/result")].bodies]


def response(status: int, *sequence: int) -> bytes:
    return HEAD + struct.pack(f"<b3xI{len(sequence)}i", status, len(sequence), *sequence)


async def accepted(site: Site, robot: Robot, ident: GoalId = IDENT, number: int = 1) -> bytes:
    """A goal that is under way; what it is called in ROS 2."""
    give(site, ident)
    call = await robot.call("send_goal", number)
    call.answer.set_result(ACCEPTED)
    await robot.call("get_result", number)
    return call.uuid


def server(site: Site) -> Any:
    stage: Any = site.endpoint._actions[ACTION].stage
    return stage._server


async def test_it_is_shown_as_an_action_of_ros_1(site: Site, robot: Robot, tmp_path: Path) -> None:
    types = types_of("count/Count", files(tmp_path / "own", count__Count=FIBONACCI))
    published = {name.rpartition("/")[2]: each.info for name, each in site.nodes.published.items()}
    assert (published["feedback"].type_name, published["feedback"].type_hash) == (
        "count/msg/CountActionFeedback",
        types.feedback.topic[1].type_hash,
    )
    assert published["result"].type_hash == types.result.topic[1].type_hash
    assert published["status"].type_name == STATUS_TYPE and published["status"].latched
    assert statuses(site) == {} and not site.nodes.served
    count = len(site.nodes.published[TopicName(f"{ACTION}/status")].bodies)
    await until(lambda: len(site.nodes.published[TopicName(f"{ACTION}/status")].bodies) > count + 2, "again and again")


async def test_a_goal_its_feedback_and_its_result(site: Site, robot: Robot, tmp_path: Path) -> None:
    client_appears(site, tmp_path)
    assert site.events.infos == {} and site.nodes.interests == {GOAL: True, CANCEL: True}
    give(site)
    assert statuses(site) == {IDENT.text: Ros1Status.PENDING}
    sent = await robot.call("send_goal")
    assert sent.request == HEAD + sent.uuid + struct.pack("<i", 5)
    sent.answer.set_result(ACCEPTED)
    asked = await robot.call("get_result")
    assert asked.request == bodies.result_request(sent.uuid)
    robot.says((bytes(16), Ros2Status.EXECUTING), (sent.uuid, Ros2Status.ACCEPTED))
    assert statuses(site) == {IDENT.text: Ros1Status.PENDING}
    robot.says((bytes(16), Ros2Status.EXECUTING), (sent.uuid, Ros2Status.EXECUTING))
    assert statuses(site) == {IDENT.text: Ros1Status.ACTIVE}
    robot.publish("feedback", HEAD + sent.uuid + SEQUENCE)
    robot.publish("feedback", HEAD + bytes(16) + SEQUENCE)
    (body,) = site.nodes.published[TopicName(f"{ACTION}/feedback")].bodies
    assert bodies.split_status(body) == StatusPart(IDENT, Ros1Status.ACTIVE, "", SEQUENCE)
    robot.says((sent.uuid, Ros2Status.SUCCEEDED))
    assert statuses(site) == {IDENT.text: Ros1Status.ACTIVE} and not results(site)
    asked.answer.set_result(response(Ros2Status.SUCCEEDED, 1, 1, 2))
    await until(lambda: results(site), "its result is told")
    assert results(site) == [StatusPart(IDENT, Ros1Status.SUCCEEDED, "", SEQUENCE)]
    assert statuses(site) == {IDENT.text: Ros1Status.SUCCEEDED}
    robot.publish("feedback", HEAD + sent.uuid + SEQUENCE)
    robot.says((sent.uuid, Ros2Status.EXECUTING))
    assert statuses(site) == {IDENT.text: Ros1Status.SUCCEEDED}
    assert len(site.nodes.published[TopicName(f"{ACTION}/feedback")].bodies) == 1


async def test_feedback_of_a_goal_shows_that_it_is_under_way(site: Site, robot: Robot, tmp_path: Path) -> None:
    client_appears(site, tmp_path)
    uuid = await accepted(site, robot)
    robot.publish("feedback", HEAD + uuid + SEQUENCE)
    assert statuses(site) == {IDENT.text: Ros1Status.ACTIVE}
    robot.says((uuid, Ros2Status.ACCEPTED))  # from before
    assert statuses(site) == {IDENT.text: Ros1Status.ACTIVE}
    robot.says((uuid, Ros2Status.CANCELING))
    robot.says((uuid, Ros2Status.EXECUTING))
    assert statuses(site) == {IDENT.text: Ros1Status.PREEMPTING}


@pytest.mark.parametrize(
    ("ros2", "ros1"),
    [(Ros2Status.CANCELED, Ros1Status.PREEMPTED), (Ros2Status.ABORTED, Ros1Status.ABORTED)],
)
async def test_how_a_goal_ends(site: Site, robot: Robot, tmp_path: Path, ros2: int, ros1: int) -> None:
    client_appears(site, tmp_path)
    await accepted(site, robot)
    (await robot.call("get_result")).answer.set_result(response(ros2, 3))
    await until(lambda: results(site), "its result is told")
    assert results(site) == [StatusPart(IDENT, ros1, "", struct.pack("<Ii", 1, 3))]
    assert not [call for call in robot.calls if call.part == "cancel_goal"]


async def test_a_goal_that_is_not_accepted(site: Site, robot: Robot, tmp_path: Path) -> None:
    client_appears(site, tmp_path)
    give(site)
    answer = refusal(ServiceInfo(TopicName("/a/_action/send_goal"), "", Encoding.CDR, ""))
    assert answer is not None
    (await robot.call("send_goal")).answer.set_result(answer)
    await until(lambda: results(site), "it is told")
    (told,) = results(site)
    assert (told.ident, told.status, told.own) == (IDENT, Ros1Status.REJECTED, bytes(4))
    assert told.text == "SERN: its server does not accept it, or did not answer in time"
    assert statuses(site) == {IDENT.text: Ros1Status.REJECTED}


@pytest.mark.parametrize(
    ("answer", "status", "text"),
    [
        (ServiceError("no link"), Ros1Status.REJECTED, "SERN: no link"),
        (b"\1", Ros1Status.REJECTED, "SERN: 1 bytes cannot be read"),
        (OSError("broken"), Ros1Status.ABORTED, "SERN: it failed at its client's site"),
    ],
)
async def test_a_goal_that_nobody_answers(
    site: Site, robot: Robot, tmp_path: Path, answer: bytes | Exception, status: Ros1Status, text: str
) -> None:
    """It may have got there, so it is cancelled."""
    client_appears(site, tmp_path)
    give(site)
    call = await robot.call("send_goal")
    if isinstance(answer, bytes):
        call.answer.set_result(answer)
    else:
        call.answer.set_exception(answer)
    await until(lambda: results(site), "it is told")
    assert [(told.status, told.text) for told in results(site)] == [(status, text)]
    assert (await robot.call("cancel_goal")).uuid == call.uuid


@pytest.mark.parametrize("lost", [ServiceError("no link"), None])
async def test_a_goal_that_is_under_way_was_accepted_whatever_becomes_of_the_answer(
    site: Site, robot: Robot, tmp_path: Path, lost: ServiceError | None
) -> None:
    """Its status overtakes the answer, which the link then loses, or which was not in time."""
    client_appears(site, tmp_path)
    give(site)
    call = await robot.call("send_goal")
    robot.says((call.uuid, Ros2Status.EXECUTING))
    cancel(site, IDENT)
    if lost is not None:
        call.answer.set_exception(lost)
    else:
        answer = refusal(ServiceInfo(TopicName("/a/_action/send_goal"), "", Encoding.CDR, ""))
        assert answer is not None
        call.answer.set_result(answer)
    (await robot.call("get_result")).answer.set_result(response(Ros2Status.CANCELED, 3))
    assert (await robot.call("cancel_goal")).uuid == call.uuid
    await until(lambda: results(site), "its result is told")
    assert results(site) == [StatusPart(IDENT, Ros1Status.PREEMPTED, "", struct.pack("<Ii", 1, 3))]


@pytest.mark.parametrize("answer", [response(Ros2Status.UNKNOWN), b"\1", response(77), ServiceError("no link")])
async def test_a_result_that_nobody_knows(
    site: Site, robot: Robot, tmp_path: Path, answer: bytes | ServiceError, caplog: pytest.LogCaptureFixture
) -> None:
    """Its client takes it for dead, so it must not drive a robot."""
    client_appears(site, tmp_path)
    uuid = await accepted(site, robot)
    call = await robot.call("get_result")
    if isinstance(answer, bytes):
        call.answer.set_result(answer)
    else:
        call.answer.set_exception(answer)
    await until(lambda: results(site), "it is told")
    (told,) = results(site)
    assert (told.status, told.own) == (Ros1Status.ABORTED, bytes(4)) and told.text.startswith("SERN: ")
    cancelled = await robot.call("cancel_goal")
    assert cancelled.request == bodies.cancel_request(GoalInfo(uuid, NO_STAMP))
    assert f"goal {IDENT.text} is given up and cancelled: " in caplog.text


async def test_cancelling_one(site: Site, robot: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A cancel is sent again as long as nobody takes it: the link may be away."""
    monkeypatch.setattr(cancelling, "CANCEL_AGAIN_S", (0.001, 0.002))
    client_appears(site, tmp_path)
    uuid = await accepted(site, robot)
    await accepted(site, robot, OTHER, 2)
    cancel(site, GoalId(0, 0, IDENT.text))
    for number, answer in enumerate((bodies.cancel_response(bodies.REJECTED), b"", bodies.cancel_response(0)), 1):
        call = await robot.call("cancel_goal", number)
        assert call.request == bodies.cancel_request(GoalInfo(uuid, NO_STAMP))
        call.answer.set_result(answer)
    robot.says((uuid, Ros2Status.CANCELING))
    assert statuses(site) == {IDENT.text: Ros1Status.PREEMPTING, OTHER.text: Ros1Status.PENDING}
    (await robot.call("get_result")).answer.set_result(response(Ros2Status.CANCELED))
    await until(lambda: results(site), "its result is told")
    assert results(site)[0].status == Ros1Status.PREEMPTED
    assert len([call for call in robot.calls if call.part == "cancel_goal"]) == 3


async def test_a_goal_that_ends_is_cancelled_no_more(
    site: Site, robot: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cancelling, "CANCEL_AGAIN_S", (0.0, 0.0))
    client_appears(site, tmp_path)
    await accepted(site, robot)
    cancel(site, GoalId(0, 0, IDENT.text))
    call = await robot.call("cancel_goal")
    (await robot.call("get_result")).answer.set_result(response(Ros2Status.SUCCEEDED))
    await until(lambda: results(site), "it has ended")
    call.answer.set_result(bodies.cancel_response(bodies.REJECTED))
    await until(lambda: server(site)._cancelling.count == 0, "nothing goes on")
    assert len([call for call in robot.calls if call.part == "cancel_goal"]) == 1


async def test_a_goal_that_is_cancelled_before_it_is_accepted(site: Site, robot: Robot, tmp_path: Path) -> None:
    client_appears(site, tmp_path)
    give(site)
    call = await robot.call("send_goal")
    cancel(site, IDENT)
    call.answer.set_result(ACCEPTED)
    assert (await robot.call("cancel_goal")).uuid == call.uuid


async def test_cancelling_all_means_all_there_are_once(site: Site, robot: Robot, tmp_path: Path) -> None:
    client_appears(site, tmp_path)
    uuids = {await accepted(site, robot), await accepted(site, robot, OTHER, 2)}
    cancel(site, GoalId(0, 0, ""))
    calls = [await robot.call("cancel_goal", number) for number in (1, 2, 3)]
    assert {call.uuid for call in calls} == {NO_UUID} | uuids
    next(call for call in calls if call.uuid == NO_UUID).answer.set_result(bodies.cancel_response(bodies.REJECTED))
    await until(lambda: server(site)._cancelling.count == 2, "what means all is not said again")


async def test_cancelling_those_of_before(site: Site, robot: Robot, tmp_path: Path) -> None:
    client_appears(site, tmp_path)
    uuid = await accepted(site, robot)
    await accepted(site, robot, OTHER, 2)
    cancel(site, GoalId(8, 0, ""))
    assert (await robot.call("cancel_goal")).uuid == uuid
    assert server(site)._cancelling.count == 1


async def test_a_goal_whose_cancelling_came_first_is_not_given(
    site: Site, robot: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each of the two comes over a connection of its own."""
    now = 100.0
    monkeypatch.setattr(clock, "now", lambda: now)
    client_appears(site, tmp_path)
    for number in range(100):
        cancel(site, GoalId(0, 0, f"other {number}"))
    now += server_for_ros1.EARLY_S
    cancel(site, GoalId(0, 0, IDENT.text))
    assert list(server(site)._early) == [IDENT.text]
    give(site)
    assert [(told.ident, told.status) for told in results(site)] == [(IDENT, Ros1Status.RECALLED)]
    assert not robot.calls
    cancel(site, GoalId(0, 0, OTHER.text))
    now += server_for_ros1.EARLY_S
    await accepted(site, robot, OTHER)


async def test_the_same_goal_twice_is_given_once(
    site: Site, robot: Robot, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    client_appears(site, tmp_path)
    await accepted(site, robot)
    give(site)
    assert f"goal {IDENT.text} is under way and came again; the second is left out" in caplog.text
    (await robot.call("get_result")).answer.set_result(response(Ros2Status.SUCCEEDED))
    await until(lambda: results(site), "it has ended")
    assert len([call for call in robot.calls if call.part == "send_goal"]) == 1
    await accepted(site, robot, IDENT, 2)  # now it is another


async def test_goals_without_a_name_have_one_each(site: Site, robot: Robot, tmp_path: Path) -> None:
    client_appears(site, tmp_path)
    for number in (1, 2):
        await accepted(site, robot, GoalId(3, 4, ""), number)
    assert list(statuses(site)) == ["sern-1-3.000000004", "sern-2-3.000000004"]


async def test_too_many_goals(site: Site, robot: Robot, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    client_appears(site, tmp_path)
    for number in range(64):
        give(site, GoalId(0, 0, f"goal {number}"))
    give(site)
    assert [(told.ident, told.status) for told in results(site)] == [(IDENT, Ros1Status.REJECTED)]
    assert f"goal {IDENT.text} is rejected: " in caplog.text
    await robot.call("send_goal", 64)
    assert len(robot.calls) == 64


async def test_bodies_that_are_none(site: Site, robot: Robot, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    client_appears(site, tmp_path)
    for _ in range(3):
        for sink in site.nodes.sinks.values():
            sink.sink(b"\1", 1)
        give(site, own=b"\1")
        robot.publish("status", b"\1")
        robot.publish("feedback", HEAD + bytes(17))
    assert len(caplog.records) == 4 and all(record.message.startswith(f"{ACTION}: ") for record in caplog.records)
    assert not any("\n" in record.message for record in caplog.records)
    assert site.endpoint.converter.failures == 15
    await accepted(site, robot)


async def test_a_goal_that_ended_is_told_of_for_a_while(
    site: Site, robot: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 100.0
    monkeypatch.setattr(clock, "now", lambda: now)
    client_appears(site, tmp_path)
    await accepted(site, robot)
    (await robot.call("get_result")).answer.set_result(response(Ros2Status.SUCCEEDED))
    await until(lambda: results(site), "it has ended")
    now += server_for_ros1.KEEP_S / 2
    server(site)._due()
    assert statuses(site) == {IDENT.text: Ros1Status.SUCCEEDED}
    now += server_for_ros1.KEEP_S / 2
    server(site)._due()
    assert statuses(site) == {} and server(site)._timer.deadline_s == now + server_for_ros1.STATUS_S


async def test_a_server_that_goes_is_shown_until_its_goals_have_ended(site: Site, robot: Robot, tmp_path: Path) -> None:
    client_appears(site, tmp_path)
    await accepted(site, robot)
    call = await robot.call("get_result")
    robot.close()
    await asyncio.sleep(0)
    give(site, OTHER)
    assert [(told.ident, told.status, told.text) for told in results(site)] == [
        (OTHER, Ros1Status.REJECTED, "SERN: its server is gone")
    ]
    told = site.nodes.published[TopicName(f"{ACTION}/result")].bodies
    call.answer.set_result(response(Ros2Status.UNKNOWN))
    await until(lambda: not site.nodes.published, "it is withdrawn")
    assert [goal_id(body) for body in told] == [OTHER, IDENT]
    # What nodes here publish is the bridge's again.
    assert set(site.events.infos) == {GOAL, CANCEL} and not site.nodes.sinks
    robot.open()
    await until(lambda: len(site.nodes.published) == 3, "it comes back")
    assert site.events.infos == {} and set(site.nodes.sinks) == {GOAL, CANCEL}
    await accepted(site, robot, number=2)


async def test_a_goal_is_cancelled_when_its_server_comes_back(
    site: Site, robot: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its client was told that it has failed, and it may be under way still."""
    monkeypatch.setattr(cancelling, "CANCEL_AGAIN_S", (0.001, 0.002))
    client_appears(site, tmp_path)
    uuid = await accepted(site, robot)
    call = await robot.call("get_result")
    robot.close()
    call.answer.set_exception(ServiceError("is gone"))
    refused = await robot.call("cancel_goal")
    refused.answer.set_exception(ServiceError("is gone"))
    await until(lambda: not site.nodes.published, "it is withdrawn")
    robot.calls.clear()
    robot.open("cancel_goal")
    cancelled = await robot.call("cancel_goal")
    cancelled.answer.set_result(bodies.cancel_response(bodies.NONE))
    assert cancelled.uuid == uuid
    assert ACTION in site.endpoint._actions
    robot.close()
    await until(lambda: not site.endpoint._actions, "nothing is left of it")


async def test_clients_come_before_and_after(site: Site, tmp_path: Path) -> None:
    client_appears(site, tmp_path)
    assert set(site.events.infos) == {GOAL, CANCEL}
    robot = Robot(site, tmp_path / "robot")
    await robot.appears()
    assert site.events.infos == {} and set(site.nodes.sinks) == {GOAL, CANCEL}
    for name in (GOAL, CANCEL):
        site.nodes.remove(name)
    assert not site.nodes.sinks
    client_appears(site, tmp_path)
    assert site.events.infos == {} and set(site.nodes.sinks) == {GOAL, CANCEL}


async def test_goals_of_another_type_are_not_taken(
    site: Site, robot: Robot, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    client_appears(site, tmp_path, "int64 order\n---\n---\n")
    assert set(site.nodes.sinks) == {CANCEL}
    assert f"{GOAL} is not taken: count/msg/CountGoal and its like in the other ROS differ in order" in caplog.text


async def test_whoever_waits_is_answered_when_this_site_stops(tmp_path: Path) -> None:
    site = await Site(Encoding.ROS1, tmp_path / "site").start()
    robot = Robot(site, tmp_path / "robot")
    await robot.appears()
    client_appears(site, tmp_path)
    await accepted(site, robot)
    cancel(site, IDENT)
    await robot.call("cancel_goal")
    told = site.nodes.published[TopicName(f"{ACTION}/result")].bodies
    await site.endpoint.stop()
    assert [bodies.split_status(body)[:3] for body in told] == [(IDENT, Ros1Status.ABORTED, "SERN: this site stops")]


async def test_a_server_whose_definitions_do_not_come_with_it(tmp_path: Path) -> None:
    site = await Site(Encoding.ROS1, tmp_path / "site").start()
    robot = Robot(site, tmp_path / "robot", bare=True)
    await robot.appears()
    client_appears(site, tmp_path)
    await accepted(site, robot)
    await site.endpoint.stop()


async def test_a_type_that_is_not_known_is_said_once_and_passes(
    site: Site, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    robot = Robot(site, tmp_path / "robot", bare=True)
    robot.open()
    await until(lambda: "is not converted: the definition of count/action/Count" in caplog.text, "it is said")
    # As any other topic and service, each with what is wrong with it.
    assert set(site.nodes.published) == {f"{ACTION}/_action/status"} or not site.nodes.published
    robot.close()


async def test_what_the_endpoint_refuses_leaves_nothing_behind(
    site: Site, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    refuse(site.nodes, f"{ACTION}/result", "outside the namespace")
    robot = Robot(site, tmp_path / "robot")
    robot.open()
    await until(lambda: f"action {ACTION} is not converted: outside the namespace" in caplog.text, "it is said")
    assert f"{ACTION}/status" not in site.nodes.published
    robot.close()


async def test_the_tables_are_compared_as_they_are(site: Site, robot: Robot, tmp_path: Path) -> None:
    client_appears(site, tmp_path)
    parts = [TopicName(f"{ACTION}/_action/{part}") for part in ("status", "feedback")]
    held = Held(Counter([*parts, TopicName("/other")]), Counter([TopicName("/more")]))
    assert site.endpoint.validate(held) == []
    own = [TopicName(f"{ACTION}/{part}") for part in ("status", "feedback", "result")]
    assert site.nodes.held == Held(Counter([TopicName("/other"), *own]), Counter([TopicName("/more"), GOAL, CANCEL]))


@given(
    st.lists(st.tuples(st.sampled_from(["goal", "cancel", "status", "feedback"]), st.binary(max_size=80)), max_size=5)
)
def test_whatever_comes_stops_nothing(said: list[tuple[str, bytes]]) -> None:
    """No body raises, random from its first byte or after a beginning as it should be."""

    async def play() -> None:
        with TemporaryDirectory() as place:
            types = types_of("count/Count", files(Path(place), count__Count=FIBONACCI))
        told: list[bytes] = []
        server = ServerForRos1(
            "/count", types, {}, Cancelling("/count", {}, lambda: None), publish_status=told.append,
            publish_feedback=told.append, publish_result=told.append, idle=lambda: None, counts=Converter(),
        )  # fmt: skip
        for kind, body in said:
            begins = {"goal": bodies.ros1_header(1, NO_STAMP), "cancel": bytes(8)}.get(kind, HEAD)
            getattr(server, kind)(body)
            getattr(server, kind)(begins + body)
        await asyncio.sleep(0)
        server.close()
        await server.ended()

    asyncio.run(play())


async def test_a_topic_that_cannot_be_published_holds_up_nothing(
    site: Site, robot: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(body: bytes, stamp_ns: int) -> None:
        raise OSError("no message")

    client_appears(site, tmp_path)
    monkeypatch.setattr(site.nodes.published[TopicName(f"{ACTION}/status")], "publish", broken)
    await accepted(site, robot)
    (await robot.call("get_result")).answer.set_result(response(Ros2Status.SUCCEEDED))
    await until(lambda: results(site), "its result is told")
    server(site)._due()
    assert caplog.text.count(f"{ACTION}/status could not be published here") == 1
