"""The action navigate_to_pose (nav2_msgs/NavigateToPose) at an endpoint: one goal at a time, as Nav2 has it.

A goal that comes while another one is pursued takes its place, and the other ends as aborted. Every goal that was
accepted has a result, whoever asks for it within a minute of its end, with a code and a line for people.
"""

import asyncio
import logging
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final
from uuid import UUID

import numpy as np

from sern_client.action_conversion import bodies
from sern_client.action_conversion.bodies import NO_STAMP, NO_UUID, GoalInfo, Stamp
from sern_client.action_conversion.goals import GoalTable
from sern_client.action_conversion.stages import ROS2_STATUS_TYPE
from sern_client.action_conversion.statuses import Ros2Status
from sern_client.actions import GoalId
from sern_client.endpoints.base import Endpoint, Publisher, ServiceEndpoint, ServiceHandler, ServiceInfo
from sern_client.navigation.hearing import goal_of
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding, TopicName
from sern_navigation.navigator import Code, Goal, State
from sern_runtime import clock, ros_services, ros_types
from sern_runtime.ros_files import installed_files
from sern_runtime.ros_types import ResolvedType

ACTION: Final = "nav2_msgs/action/NavigateToPose"
KEEP_S: Final = 60.0
"""How long the result of a goal that ended can be asked for."""
UNKNOWN: Final = 9000
CODES: Final = {
    Code.NONE: 0,
    Code.START_OUTSIDE_MAP: 203,
    Code.GOAL_OUTSIDE_MAP: 204,
    Code.START_OCCUPIED: 205,
    Code.GOAL_OCCUPIED: 206,
    Code.TIMEOUT: 207,
    Code.NO_VALID_PATH: 208,
    Code.FAILED_TO_MAKE_PROGRESS: 105,
    Code.NO_VALID_CONTROL: 106,
    Code.NO_POSE: 9002,
}
"""Nav2's numbers: of ComputePathToPose, FollowPath and NavigateToPose (TF_ERROR); what has none there is UNKNOWN."""

_log = logging.getLogger(__name__)


@dataclass(slots=True, eq=False)
class _Goal:
    ident: GoalId
    uuid: bytes
    given_s: float
    result: "asyncio.Future[bytes]"
    status: Ros2Status = Ros2Status.EXECUTING
    info: GoalInfo = field(init=False)

    def __post_init__(self) -> None:
        self.info = GoalInfo(self.uuid, Stamp(self.ident.secs, self.ident.nsecs))


@dataclass(frozen=True, slots=True)
class Types:
    """What the action's bodies look like, here or as SERN ships it."""

    send_goal: ros_services.ResolvedService
    get_result: ros_services.ResolvedService
    cancel_goal: ros_services.ResolvedService
    feedback: ResolvedType

    @classmethod
    def known(cls, type_paths: tuple[Path, ...] = ()) -> "Types":
        """ConfigError: a definition that a directory has cannot be read."""
        files = installed_files(type_paths)[0]
        message = files.message(f"{ACTION}_FeedbackMessage") or ""

        def service(type_name: str) -> ros_services.ResolvedService:
            return ros_services.resolve(type_name, files.service(type_name) or "", Encoding.CDR)

        return cls(
            service(f"{ACTION}_SendGoal"),
            service(f"{ACTION}_GetResult"),
            service("action_msgs/srv/CancelGoal"),
            ros_types.resolve(f"{ACTION}_FeedbackMessage", message, Encoding.CDR),
        )


class NavigateToPose:
    """`go` pursues a goal; `cancel` gives the one up that is pursued. `end`, `feedback` are for who drives."""

    def __init__(
        self,
        name: str,
        types: Types,
        *,
        go: Callable[[Goal], None],
        cancel: Callable[[], None],
        now: Callable[[], float] = clock.now,
        wall_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self.goals: GoalTable[_Goal] = GoalTable(KEEP_S)
        self._name = name
        self._types = types
        self._go = go
        self._cancel = cancel
        self._now = now
        self._wall_ns = wall_ns
        self._pursued: _Goal | None = None
        self._status: Publisher | None = None
        self._feedback: Publisher | None = None
        self._open = ExitStack()

    # --- at the endpoint ----------------------------------------------------------------------------------------------

    def serve(self, endpoint: Endpoint, services: ServiceEndpoint) -> None:
        """Open services and topics. ConfigError: the endpoint cannot serve it."""
        with ExitStack() as stack:
            status = ros_types.topic_info(
                f"{self._name}/_action/status", ROS2_STATUS_TYPE, Encoding.CDR, latched=True, reliable=True
            )
            feedback = TopicInfo(
                TopicName(f"{self._name}/_action/feedback"), self._types.feedback.name, Encoding.CDR,
                self._types.feedback.text.type_hash, self._types.feedback.text.definition, reliable=True,
            )  # fmt: skip
            self._status = endpoint.advertise(status)
            stack.callback(self._status.close)
            self._feedback = endpoint.advertise(feedback)
            stack.callback(self._feedback.close)
            handlers: tuple[tuple[str, ros_services.ResolvedService, ServiceHandler], ...] = (
                ("send_goal", self._types.send_goal, self.send_goal),
                ("cancel_goal", self._types.cancel_goal, self.cancel_goal),
                ("get_result", self._types.get_result, self.get_result),
            )
            for part, service, handler in handlers:
                info = ServiceInfo(
                    TopicName(f"{self._name}/_action/{part}"), service.name, Encoding.CDR,
                    service.text.type_hash, service.text.definition,
                )  # fmt: skip
                stack.callback(services.serve(info, handler).close)
            self._open = stack.pop_all()
        self._tell()

    def close(self) -> None:
        """Whoever waits for a result is told that the goal is aborted."""
        self.end(State.ABORTED, Code.CANCELLED, "the navigation stops")
        self._open.close()

    # --- from its clients ---------------------------------------------------------------------------------------------

    async def send_goal(self, request: bytes) -> bytes:
        """The handler of the service: any goal that can be read is accepted."""
        try:
            message = _read(self._types.send_goal.request, request)
        except ConfigError as error:
            _log.error("%s: a goal is refused: %s", self._name, error)
            return bodies.goal_response(accepted=False, stamp=NO_STAMP)
        uuid = bytes(message.goal_id.uuid)
        stamp = Stamp.of(self._wall_ns())
        ident = GoalId(*stamp, f"{UUID(bytes=uuid)}-{stamp.secs}.{stamp.nsecs:09d}")
        goal = _Goal(ident, uuid, self._now(), asyncio.get_running_loop().create_future())
        problem = self.goals.add(goal)
        if problem:
            _log.error("%s: a goal is refused: %s", self._name, problem)
            return bodies.goal_response(accepted=False, stamp=NO_STAMP)
        self.end(State.ABORTED, Code.CANCELLED, "another goal took its place")
        self._pursued = goal
        wanted = goal_of(message.goal.pose)
        _log.info("%s: goal (%.2f, %.2f) in %s", self._name, wanted.x_m, wanted.y_m, wanted.frame_id)
        self._tell()
        self._go(wanted)
        return bodies.goal_response(accepted=True, stamp=stamp)

    async def cancel_goal(self, request: bytes) -> bytes:
        """The handler of the service: of one goal, of all that were given up to then, or of all."""
        try:
            meant = bodies.split_cancel_request(request)
        except ConfigError as error:
            _log.error("%s: a request to cancel is refused: %s", self._name, error)
            return bodies.cancel_response(bodies.REJECTED)
        goal = self._pursued
        if meant.uuid != NO_UUID and (goal is None or goal.uuid != meant.uuid):
            known = self.goals.of_uuid(meant.uuid) is not None
            return bodies.cancel_response(bodies.TERMINATED if known else bodies.UNKNOWN_GOAL)
        if goal is None or (meant.uuid == NO_UUID and meant.stamp != NO_STAMP and goal.info.stamp > meant.stamp):
            return bodies.cancel_response(bodies.NONE)
        goal.status = Ros2Status.CANCELING
        self._tell()
        self._cancel()
        return bodies.cancel_response(bodies.NONE, [goal.info])

    async def get_result(self, request: bytes) -> bytes:
        """The handler of the service: waits until the goal has ended."""
        try:
            goal = self.goals.of_uuid(bodies.request_uuid(request))
        except ConfigError as error:
            _log.error("%s: nothing is told of a result: %s", self._name, error)
            goal = None
        if goal is None:
            return self._result(Ros2Status.UNKNOWN, 0, "")
        return await asyncio.shield(goal.result)

    # --- from who drives ----------------------------------------------------------------------------------------------

    @property
    def pursued(self) -> bool:
        """Whether the goal that is pursued came from here."""
        return self._pursued is not None

    def end(self, state: State, code: Code, message: str) -> None:
        """The goal has ended so. Without one this does nothing."""
        goal, self._pursued = self._pursued, None
        if goal is None:
            return
        goal.status = {State.SUCCEEDED: Ros2Status.SUCCEEDED, State.CANCELLED: Ros2Status.CANCELED}.get(
            state, Ros2Status.ABORTED
        )
        ended = self._result(goal.status, CODES.get(code, UNKNOWN) if goal.status is Ros2Status.ABORTED else 0, message)
        goal.result.set_result(ended)
        self.goals.end(goal, len(ended), now=self._now())
        _log.info("%s: the goal is %s%s", self._name, state.value, f": {message}" if message else "")
        self._tell()

    def tell(self, current_pose: Any, *, recoveries: int, distance_m: float, eta_s: float) -> None:
        """Feedback of the goal that is pursued: `current_pose` is a PoseStamped in CDR's types."""
        goal = self._pursued
        self.goals.expire(now=self._now())
        if goal is None or self._feedback is None:
            return
        store, name = self._types.feedback.store, self._types.feedback.name
        feedback = ros_types.new_in(
            store,
            f"{ACTION}_Feedback",
            current_pose=current_pose,
            navigation_time=_duration(self._now() - goal.given_s),
            estimated_time_remaining=_duration(eta_s),
            number_of_recoveries=recoveries,
            distance_remaining=distance_m,
        )
        ident = ros_types.new_in(store, "unique_identifier_msgs/msg/UUID", uuid=_octets(goal.uuid))
        message = ros_types.new_in(store, name, goal_id=ident, feedback=feedback)
        self._feedback.publish(bytes(store.serialize_cdr(message, name)), self._wall_ns())

    def _result(self, status: Ros2Status, code: int, message: str) -> bytes:
        """What `get_result` answers; of what the result has, in the distribution that is here."""
        response = self._types.get_result.response
        has = {name for name, _ in response.store.fielddefs[f"{ACTION}_Result"][1]}
        fields = {key: value for key, value in (("error_code", code), ("error_msg", message)) if key in has}
        own = ros_types.new_in(response.store, f"{ACTION}_Result", **fields)
        said = ros_types.new_in(response.store, response.name, status=int(status), result=own)
        return bytes(response.store.serialize_cdr(said, response.name))

    def _tell(self) -> None:
        if self._status is not None:
            each = [(goal.info, int(goal.status)) for goal in self.goals]
            self._status.publish(bodies.ros2_statuses(each), self._wall_ns())


def _read(kind: ResolvedType, body: bytes) -> Any:
    """ConfigError: it is none."""
    try:
        return kind.store.deserialize_cdr(body, kind.name)
    except Exception as error:  # noqa: BLE001  (of many types, whatever the bytes are)
        raise ConfigError(f"{len(body)} bytes are no {kind.name}: {ros_types.one_line(error)}") from None


def _duration(seconds: float) -> Any:
    whole = min(max(0.0, seconds), 2.0**31 - 1)
    return ros_types.new(
        "builtin_interfaces/msg/Duration", Encoding.CDR, sec=int(whole), nanosec=int((whole % 1.0) * 1e9)
    )


def _octets(uuid: bytes) -> Any:
    return np.frombuffer(uuid, np.uint8)
