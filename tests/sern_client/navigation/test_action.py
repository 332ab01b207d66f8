"""The action navigate_to_pose: what its clients are answered."""

import asyncio
from typing import Any

import numpy as np
import pytest

from sern_client.action_conversion import bodies as action_bodies
from sern_client.action_conversion.bodies import NO_STAMP, NO_UUID, GoalInfo
from sern_client.navigation.action import ACTION, KEEP_S, NavigateToPose, Types
from sern_core.vocabulary.types import TopicName
from sern_navigation.navigator import Code, Goal, State
from sern_runtime import ros_types
from tests.sern_client.navigation import bodies
from tests.sern_client.navigation.graph import Graph

ONE, OTHER = bytes(range(16)), bytes(range(16, 32))
EXECUTING, CANCELING, SUCCEEDED, CANCELED, ABORTED, UNKNOWN = 2, 3, 4, 5, 6, 0


class Site:
    """An action at a graph, and what it was told to do."""

    def __init__(self) -> None:
        self.now_s = 100.0
        self.went: list[Goal] = []
        self.cancelled = 0
        self.graph = Graph()
        self.types = Types.known()
        self.action = NavigateToPose(
            TopicName("/navigate_to_pose"), self.types, go=self.went.append, cancel=self._cancel,
            now=lambda: self.now_s, wall_ns=lambda: round(self.now_s * 1e9),
        )  # fmt: skip
        self.action.serve(self.graph.endpoint, self.graph.endpoint)

    def _cancel(self) -> None:
        self.cancelled += 1

    def goal(self, uuid: bytes, x_m: float, *, frame_id: str = "map") -> bytes:
        kind = self.types.send_goal.request
        ident = ros_types.new_in(kind.store, "unique_identifier_msgs/msg/UUID", uuid=np.frombuffer(uuid, np.uint8))
        goal = ros_types.new_in(kind.store, f"{ACTION}_Goal", pose=bodies.goal(x_m, 0.0, frame_id=frame_id))
        message = ros_types.new_in(kind.store, kind.name, goal_id=ident, goal=goal)
        return bytes(kind.store.serialize_cdr(message, kind.name))

    async def give(self, uuid: bytes, x_m: float) -> bool:
        return action_bodies.is_accepted(await self.action.send_goal(self.goal(uuid, x_m)))

    async def result(self, uuid: bytes) -> tuple[int, int, str]:
        kind = self.types.get_result.response
        said = kind.store.deserialize_cdr(await self.action.get_result(action_bodies.result_request(uuid)), kind.name)
        return said.status, said.result.error_code, said.result.error_msg  # type: ignore[attr-defined]

    async def cancel(self, uuid: bytes) -> int:
        return action_bodies.cancel_code(
            await self.action.cancel_goal(action_bodies.cancel_request(GoalInfo(uuid, NO_STAMP)))
        )

    @property
    def statuses(self) -> dict[bytes, int]:
        return dict(action_bodies.split_statuses(self.graph.said["/navigate_to_pose/_action/status"][-1]))


async def test_a_goal_is_pursued_and_its_client_hears_how_it_ended() -> None:
    site = Site()
    assert site.statuses == {} and await site.give(ONE, 3.0)
    assert site.went == [Goal(3.0, 0.0, None, "map")] and site.statuses == {ONE: EXECUTING}
    waiting = asyncio.create_task(site.result(ONE))
    await asyncio.sleep(0)
    site.action.end(State.SUCCEEDED, Code.NONE, "")
    assert await waiting == (SUCCEEDED, 0, "") and site.statuses == {ONE: SUCCEEDED}
    assert await site.result(ONE) == (SUCCEEDED, 0, ""), "also who asks later"


@pytest.mark.parametrize(
    ("code", "number"),
    [(Code.NO_VALID_PATH, 208), (Code.GOAL_OCCUPIED, 206), (Code.NO_VALID_CONTROL, 106), (Code.MAP_REFUSED, 9000)],
)
async def test_what_went_wrong_has_nav2s_number_and_a_line(code: Code, number: int) -> None:
    site = Site()
    await site.give(ONE, 3.0)
    site.action.end(State.ABORTED, code, "a wall all round")
    assert await site.result(ONE) == (ABORTED, number, "a wall all round")


async def test_another_goal_takes_the_place_of_the_first() -> None:
    site = Site()
    await site.give(ONE, 3.0)
    assert await site.give(OTHER, 4.0)
    status, _, why = await site.result(ONE)
    assert status == ABORTED and "another goal" in why and site.statuses == {ONE: ABORTED, OTHER: EXECUTING}
    assert not await site.give(OTHER, 5.0), "it is under way"
    assert [goal.x_m for goal in site.went] == [3.0, 4.0]


@pytest.mark.parametrize("uuid", [ONE, NO_UUID])
async def test_cancelling_one_goal_or_all(uuid: bytes) -> None:
    site = Site()
    await site.give(ONE, 3.0)
    assert await site.cancel(uuid) == action_bodies.NONE
    assert site.cancelled == 1 and site.statuses == {ONE: CANCELING}
    site.action.end(State.CANCELLED, Code.CANCELLED, "the goal was cancelled")
    assert (await site.result(ONE))[:2] == (CANCELED, 0)


async def test_cancelling_what_is_not_there() -> None:
    site = Site()
    assert await site.cancel(ONE) == action_bodies.UNKNOWN_GOAL
    await site.give(ONE, 3.0)
    site.action.end(State.SUCCEEDED, Code.NONE, "")
    assert await site.cancel(ONE) == action_bodies.TERMINATED and await site.cancel(NO_UUID) == action_bodies.NONE
    assert site.cancelled == 0


async def test_bytes_that_are_no_request() -> None:
    site = Site()
    assert not action_bodies.is_accepted(await site.action.send_goal(b"\0\1\0\0abc"))
    assert action_bodies.cancel_code(await site.action.cancel_goal(b"x")) == action_bodies.REJECTED
    kind = site.types.get_result.response
    said: Any = kind.store.deserialize_cdr(await site.action.get_result(b""), kind.name)
    assert said.status == UNKNOWN and not site.went


async def test_feedback_says_how_far_it_is() -> None:
    site = Site()
    await site.give(ONE, 3.0)
    site.now_s += 2.5
    site.action.tell(bodies.goal(1.0, 0.5), recoveries=2, distance_m=4.0, eta_s=8.0)
    kind = site.types.feedback
    said: Any = kind.store.deserialize_cdr(site.graph.said["/navigate_to_pose/_action/feedback"][-1], kind.name)
    assert bytes(said.goal_id.uuid) == ONE
    feedback = said.feedback
    assert (feedback.distance_remaining, feedback.number_of_recoveries) == (4.0, 2)
    assert (feedback.navigation_time.sec, feedback.navigation_time.nanosec) == (2, 500_000_000)
    assert feedback.estimated_time_remaining.sec == 8 and feedback.current_pose.pose.position.y == 0.5


async def test_results_are_forgotten_after_a_while() -> None:
    site = Site()
    await site.give(ONE, 3.0)
    site.action.end(State.SUCCEEDED, Code.NONE, "")
    site.now_s += KEEP_S + 1
    site.action.tell(bodies.goal(0.0, 0.0), recoveries=0, distance_m=0.0, eta_s=0.0)
    assert (await site.result(ONE))[0] == UNKNOWN


async def test_at_the_end_whoever_waits_is_told() -> None:
    site = Site()
    await site.give(ONE, 3.0)
    waiting = asyncio.create_task(site.result(ONE))
    await asyncio.sleep(0)
    site.action.close()
    status, _, why = await waiting
    assert status == ABORTED and why == "the navigation stops" and not site.graph.open
