"""An action server of ROS 1 at another site, as ROS 2 nodes here see it: three services and two topics.

A goal goes out as a message of ROS 1, and what its server says of it (status, feedback, result) comes back. That the
link refuses a goal, or that nothing is heard of it, `sern_client.actions.GoalWatch` finds out, as for nodes of ROS 1,
and says with a result. So whoever waits here is answered by what comes in.
"""

import asyncio
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final
from uuid import UUID

from sern_client.action_conversion import bodies
from sern_client.action_conversion.bodies import NO_STAMP, NO_UUID, GoalInfo, Stamp
from sern_client.action_conversion.goals import GoalTable
from sern_client.action_conversion.statuses import (
    ENDED_ROS1,
    ENDED_ROS2,
    ROS2_STATUS,
    Ros1Status,
    Ros2Status,
    ros1_status,
)
from sern_client.action_conversion.types import ActionTypes
from sern_client.actions import GoalId, mentioned_goals
from sern_client.endpoints.base import Sink
from sern_client.endpoints.common.saying import SayOnce
from sern_client.endpoints.conversion import Converter
from sern_core.vocabulary.errors import ConfigError
from sern_runtime import clock
from sern_runtime.loop import Timer

KEEP_S: Final = 60.0
"""How long the result of a goal that ended can be asked for."""
PENDING_S: Final = 1.0
"""A goal that its server has not accepted after so long, nor rejected, counts as accepted: it waits its turn there."""
MAX_SAID: Final = 20

_log = logging.getLogger(__name__)


@dataclass(slots=True, eq=False)
class _Goal:
    """`decide_s`: when it is answered, whatever is known then; None once it is. `asked`: cancelling was."""

    ident: GoalId
    uuid: bytes
    accepted: asyncio.Future[bool]
    result: asyncio.Future[bytes]
    decide_s: float | None
    status: Ros2Status = Ros2Status.UNKNOWN
    pending: bool = False
    asked: bool = False
    info: GoalInfo = field(init=False)

    def __post_init__(self) -> None:
        self.info = GoalInfo(self.uuid, Stamp(self.ident.secs, self.ident.nsecs))


class ServerForRos2:
    """`answer_s`: how long a goal may be unanswered at most. `publish_status` and `publish_feedback` take bodies of
    ROS 2. `idle` is called when the last goal has ended. `counts`: what could
    not be converted is counted there.

    `goal_sink` and `cancel_sink`: where goals and cancellings of ROS 1 go; None while they cannot go anywhere.
    """

    def __init__(
        self,
        name: str,
        types: ActionTypes,
        *,
        answer_s: float,
        publish_status: Callable[[bytes], None],
        publish_feedback: Callable[[bytes], None],
        idle: Callable[[], None],
        counts: Converter,
    ) -> None:
        self.goal_sink: Sink | None = None
        self.cancel_sink: Sink | None = None
        self.away = ""
        """Why no goal is taken, in a few words: its server is gone for now."""
        self.goals: GoalTable[_Goal] = GoalTable(KEEP_S)
        self._name = name
        self._types = types
        self._answer_s = answer_s
        self._publish_status = publish_status
        self._publish_feedback = publish_feedback
        self._idle = idle
        self._counts = counts
        self._seq = 0
        self._said = SayOnce(_log, most=MAX_SAID)
        self._told: list[tuple[bytes, Ros2Status]] | None = None
        self._timer = Timer(self._due)
        self._closed = False

    @property
    def busy(self) -> bool:
        """Whether any goal is under way."""
        return self.goals.busy

    def start(self) -> None:
        """Tell nodes here that there are no goals."""
        self._tell()

    def close(self) -> None:
        """Whoever waits is told that nothing is known."""
        self._closed = True
        self._timer.close()
        for goal in self.goals.live:
            self._decide(goal, False)
            if not goal.result.done():
                goal.result.set_result(self._types.no_result(Ros2Status.UNKNOWN))

    # --- from nodes here --------------------------------------------------------------------------------------------

    async def send_goal(self, request: bytes) -> bytes:
        """The handler of the service; every goal is answered."""
        goal = self._given(request)
        if goal is None:
            return bodies.goal_response(accepted=False, stamp=NO_STAMP)
        try:
            accepted = await asyncio.shield(goal.accepted)
        except asyncio.CancelledError:
            if not self._closed and not self.goals.has_ended(goal):  # nobody here knows that it was given
                self._cancel(goal.ident)
            raise
        return bodies.goal_response(accepted=accepted, stamp=goal.info.stamp if accepted else NO_STAMP)

    async def cancel_goal(self, request: bytes) -> bytes:
        """The handler of the service. What is cancelled is whatever the request means, and all there is at the server
        when it means all. To stop is never too late: it waits for the link as long as it has to."""
        try:
            meant = bodies.split_cancel_request(request)
        except ConfigError as error:
            self._complain("a request to cancel is refused", error)
            return bodies.cancel_response(bodies.REJECTED)
        if meant.uuid != NO_UUID:
            goal = self.goals.of_uuid(meant.uuid)
            if goal is None:
                return bodies.cancel_response(bodies.UNKNOWN_GOAL)
            if self.goals.has_ended(goal):
                return bodies.cancel_response(bodies.TERMINATED)
            goals, said = [goal], [goal.ident]
        elif meant.stamp == NO_STAMP:
            goals, said = self.goals.live, [GoalId(0, 0, "")]
        else:
            goals = [goal for goal in self.goals.live if goal.info.stamp <= meant.stamp]
            said = [goal.ident for goal in goals]
        sent = [self._cancel(ident) for ident in said]
        if not all(sent):
            return bodies.cancel_response(bodies.REJECTED)
        for goal in goals:
            goal.asked = True
            if goal.status is Ros2Status.EXECUTING:
                goal.status = Ros2Status.CANCELING
        self._tell()
        return bodies.cancel_response(bodies.NONE, [goal.info for goal in goals])

    async def get_result(self, request: bytes) -> bytes:
        """The handler of the service: waits until the goal has ended."""
        try:
            goal = self.goals.of_uuid(bodies.request_uuid(request))
        except ConfigError as error:
            self._complain("nothing is told of a result", error)
            goal = None
        if goal is None:
            return self._types.no_result(Ros2Status.UNKNOWN)
        return await asyncio.shield(goal.result)

    def _given(self, request: bytes) -> _Goal | None:
        if self.away or self.goal_sink is None:
            self._said(f"{self._name}: a goal is refused: {self.away or 'it cannot go to the link'}")
            return None
        try:
            uuid, own = self._types.goal.to_ros1(request)
        except ConfigError as error:
            self._complain("a goal is refused", error)
            return None
        loop = asyncio.get_running_loop()
        stamp = Stamp.of(time.time_ns())
        # A client may use its id again for another goal, while its server still speaks of the one before.
        ident = GoalId(*stamp, f"{UUID(bytes=uuid)}-{stamp.secs}.{stamp.nsecs:09d}")
        goal = _Goal(ident, uuid, loop.create_future(), loop.create_future(), clock.now() + self._answer_s)
        problem = self.goals.add(goal)
        if problem:
            self._said(f"{self._name}: a goal is refused: {problem}")
            return None
        self._seq += 1
        if not self.goal_sink(bodies.ros1_goal(self._seq, ident, own), time.time_ns()):
            self._refused(goal)
        self._arm()
        return goal

    def _cancel(self, ident: GoalId) -> bool:
        """Ask the server to. Without the stamp: with one it would mean earlier goals too."""
        sink = self.cancel_sink
        if sink is None or not sink(GoalId(0, 0, ident.text).pack(), time.time_ns()):
            _log.warning("%s: goal %s could not be cancelled: it cannot go to the link", self._name, ident.shown or "*")
            return False
        return True

    # --- from the link ----------------------------------------------------------------------------------------------

    def status(self, body: bytes) -> None:
        """An actionlib_msgs/GoalStatusArray. Goals that were not given here are left out."""
        try:
            mentioned = mentioned_goals(body)
        except ConfigError as error:
            self._complain("a status of its goals is not read", error)
            return
        for text, value in mentioned:
            goal = self.goals.of_text(text)
            if goal is not None and not self.goals.has_ended(goal):
                self._heard(goal, ros1_status(value))
        self._tell()
        self._arm()

    def feedback(self, body: bytes) -> None:
        try:
            said = bodies.split_status(body)
            goal = self.goals.of_text(said.ident.text)
            if goal is None or self.goals.has_ended(goal):
                return
            converted = self._types.feedback.to_ros2(goal.uuid, said.own)
        except ConfigError as error:
            self._complain("a feedback is dropped, and others like it", error)
            return
        self._heard(goal, ros1_status(said.status))
        self._publish_feedback(converted)
        self._tell()

    def result(self, body: bytes) -> None:
        try:
            said = bodies.split_status(body)
        except ConfigError as error:
            self._complain("a result is dropped", error)
            return
        goal = self.goals.of_text(said.ident.text)
        if goal is None or self.goals.has_ended(goal):
            return
        status = ros1_status(said.status)
        shown = said.text.encode(errors="surrogateescape").decode(errors="replace")
        if status is not Ros1Status.SUCCEEDED:
            name = "an unknown status" if status is None else status.name
            _log.info("%s: goal %s has ended with %s: %s", self._name, goal.ident.shown, name, shown[:200])
        if status is Ros1Status.REJECTED and not goal.accepted.done():
            self._refused(goal)
            return
        ended = Ros2Status.ABORTED if status is None else ROS2_STATUS[status]
        if ended not in ENDED_ROS2:  # it has a result, so it is over
            ended = Ros2Status.ABORTED
        try:
            converted = self._types.result.to_ros2(bytes((ended,)), said.own)
        except ConfigError as error:
            self._complain(f"goal {goal.ident.shown} counts as aborted: its result is lost", error)
            ended = Ros2Status.ABORTED
            converted = self._types.no_result(ended)
        self._decide(goal, True)
        self._end(goal, ended, converted)

    # --- a goal -----------------------------------------------------------------------------------------------------

    def _heard(self, goal: _Goal, status: Ros1Status | None) -> None:
        """Its server says this of a goal that has not ended. What ends it is its result."""
        if status is None:
            return
        if status is Ros1Status.REJECTED and not goal.accepted.done():
            self._refused(goal)
            return
        if status in (Ros1Status.PENDING, Ros1Status.RECALLING) and not goal.accepted.done():
            if not goal.pending:
                goal.pending = True
                due_s = clock.now() + PENDING_S
                goal.decide_s = due_s if goal.decide_s is None else min(goal.decide_s, due_s)
            return
        self._decide(goal, True)
        if status in ENDED_ROS1:
            return
        said = ROS2_STATUS[status]
        if goal.asked and said is Ros2Status.EXECUTING:
            said = Ros2Status.CANCELING
        goal.status = max(goal.status, said)  # feedback overtakes a status, and a goal does not go back

    def _decide(self, goal: _Goal, accepted: bool) -> None:
        goal.decide_s = None
        if not goal.accepted.done():
            goal.accepted.set_result(accepted)
            if accepted:
                goal.status = Ros2Status.ACCEPTED

    def _refused(self, goal: _Goal) -> None:
        """It never was a goal, as nodes of ROS 2 see it."""
        self._decide(goal, False)
        self._end(goal, Ros2Status.UNKNOWN, self._types.no_result(Ros2Status.UNKNOWN))

    def _end(self, goal: _Goal, status: Ros2Status, result: bytes) -> None:
        goal.status = status
        if not goal.result.done():
            goal.result.set_result(result)
        self.goals.end(goal, len(result), now=clock.now())
        self._tell()
        self._arm()
        if not self.busy:
            self._idle()

    def _tell(self) -> None:
        """Publish the status of the goals, where it is not what it was."""
        told = [(goal, goal.status) for goal in self.goals if goal.status is not Ros2Status.UNKNOWN]
        short: list[tuple[bytes, Ros2Status]] = [(goal.uuid, status) for goal, status in told]
        if short != self._told and not self._closed:
            self._told = short
            self._publish_status(bodies.ros2_statuses((goal.info, status) for goal, status in told))

    # --- time -------------------------------------------------------------------------------------------------------

    def _arm(self) -> None:
        if self._closed:
            return
        times = [goal.decide_s for goal in self.goals.live if goal.decide_s is not None]
        if self.goals.due_s is not None:
            times.append(self.goals.due_s)
        self._timer.arm(min(times, default=None))

    def _due(self) -> None:
        now = clock.now()
        for goal in self.goals.live:
            if goal.decide_s is None or goal.decide_s > now:
                continue
            if goal.pending:
                self._decide(goal, True)
                continue
            _log.warning("%s: goal %s is refused and cancelled: nothing was heard of it", self._name, goal.ident.shown)
            self._cancel(goal.ident)
            self._refused(goal)
        self.goals.expire(now=now)
        self._tell()
        self._arm()

    def _complain(self, what: str, error: ConfigError) -> None:
        self._counts.failures += 1
        self._said(f"{self._name}: {what}: {error}", what)
