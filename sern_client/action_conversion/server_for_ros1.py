"""An action server of ROS 2 at another site, as ROS 1 nodes here see it: five topics, as actionlib has them.

A goal goes out as a call of its server's service, and so do its cancelling and the question for its result. Each of
these calls is answered, also where the link is gone (`sern_client.services`), and what is not known then is told to the
client as REJECTED or ABORTED, with a cancel after the goal: what its client believes dead must not drive a robot.
"""

import logging
import secrets
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from sern_client.action_conversion import bodies
from sern_client.action_conversion.bodies import NO_STAMP, NO_UUID, GoalInfo, Stamp
from sern_client.action_conversion.cancelling import Cancelling
from sern_client.action_conversion.goals import MAX_LIVE, GoalTable
from sern_client.action_conversion.statuses import ENDED_ROS2, ROS1_STATUS, Ros1Status, Ros2Status, ros2_status
from sern_client.action_conversion.types import ActionTypes
from sern_client.actions import GoalId
from sern_client.endpoints.base import ServiceHandler
from sern_client.endpoints.common.calls import Tasks
from sern_client.endpoints.common.saying import SayOnce
from sern_client.endpoints.conversion import Converter
from sern_core.vocabulary.errors import ConfigError, ServiceError
from sern_runtime import clock
from sern_runtime.loop import Timer

KEEP_S: Final = 5.0
"""How long the status speaks of a goal that ended, as actionlib has it."""
STATUS_S: Final = 0.2
"""How often the status is said, as actionlib has it: its clients look whether they hear it."""
EARLY_S: Final = 5.0
MAX_EARLY: Final = 64
"""Cancellings that came before their goals, on another connection: how long, and how many, are remembered."""
MAX_SAID: Final = 20
_ON_ITS_WAY: Final = (Ros1Status.PENDING, Ros1Status.ACTIVE, Ros1Status.PREEMPTING)
"""What a goal is before it ends; it never goes back, which actionlib's clients take for an error."""

_log = logging.getLogger(__name__)


@dataclass(slots=True, eq=False)
class _Goal:
    ident: GoalId
    uuid: bytes
    status: Ros1Status = Ros1Status.PENDING
    text: str = ""
    accepted: bool = False
    cancelled: bool = False


class ServerForRos1:
    """`calls`: the services of the action by the last part of their names, as they are now; they raise ServiceError.
    The others take bodies of ROS 1. `idle` is called when the last goal has ended. `counts`: what could
    not be converted is counted there. `new_uuid`: 16 bytes."""

    def __init__(
        self,
        name: str,
        types: ActionTypes,
        calls: Mapping[str, ServiceHandler],
        cancelling: Cancelling,
        *,
        publish_status: Callable[[bytes], None],
        publish_feedback: Callable[[bytes], None],
        publish_result: Callable[[bytes], None],
        idle: Callable[[], None],
        counts: Converter,
        new_uuid: Callable[[], bytes] = lambda: secrets.token_bytes(bodies.UUID_BYTES),
    ) -> None:
        self.away = ""
        """Why no goal is taken, in a few words: its server is gone for now."""
        self.goals: GoalTable[_Goal] = GoalTable(KEEP_S)
        self._name = name
        self._types = types
        self._calls = calls
        self._publish_status = publish_status
        self._publish_feedback = publish_feedback
        self._publish_result = publish_result
        self._idle = idle
        self._counts = counts
        self._new_uuid = new_uuid
        self._seq = 0
        self._unnamed = 0
        self._early: dict[str, float] = {}
        self._said = SayOnce(_log, most=MAX_SAID)
        self._timer = Timer(self._due)
        self._running = Tasks(MAX_LIVE)
        self._cancelling = cancelling
        self._closed = False

    @property
    def busy(self) -> bool:
        """Whether any goal is under way."""
        return self.goals.busy

    def start(self) -> None:
        """Tell nodes here that there are no goals, and go on with that."""
        self._tell()
        self._timer.arm(clock.now() + STATUS_S)

    def close(self) -> None:
        """Whoever waits is told that nothing is known."""
        for goal in self.goals.live:
            self._end(goal, Ros1Status.ABORTED, "SERN: this site stops")
        self._closed = True
        self._timer.close()
        self._running.cancel()

    async def ended(self) -> None:
        """Return when nothing goes on any more; after `close`."""
        await self._running.ended()

    # --- from nodes here --------------------------------------------------------------------------------------------

    def goal(self, body: bytes) -> None:
        """An action goal. One that is under way already is not given again."""
        uuid = self._new_uuid()
        try:
            ident, own = bodies.split_goal(body)
            request = self._types.goal.to_ros2(uuid, own)
        except ConfigError as error:
            self._complain("a goal is dropped", error)
            return
        if not ident.text:  # as of `rostopic pub`; actionlib gives it a name, too
            self._unnamed += 1
            ident = ident._replace(text=f"sern-{self._unnamed}-{ident.secs}.{ident.nsecs:09d}")
        earlier = self.goals.of_text(ident.text)
        if earlier is not None and not self.goals.has_ended(earlier):
            self._said(f"{self._name}: goal {ident.shown} is under way and came again; the second is left out")
            return
        goal = _Goal(ident, uuid)
        problem = self.away or ("too many goals end only now" if self._running.full else "") or self.goals.add(goal)
        if problem:
            _log.warning("%s: goal %s is rejected: %s", self._name, ident.shown, problem)
            self._say_result(goal, Ros1Status.REJECTED, f"SERN: {problem}", self._types.result.zero)
            return
        if self._early.pop(ident.text, 0.0) > clock.now():
            self._end(goal, Ros1Status.RECALLED, "SERN: cancelled before it was given")
            return
        self._tell()
        self._running.begin(self._run(goal, request), name="goal")

    def cancel(self, body: bytes) -> None:
        """An actionlib_msgs/GoalID: of one goal, of all that were given up to then, or of all there are."""
        try:
            meant = bodies.split_cancel(body)
        except ConfigError as error:
            self._complain("a cancelling is dropped", error)
            return
        stamp = Stamp(meant.secs, meant.nsecs)
        every = not meant.text and stamp == NO_STAMP
        if every:  # those of other sites as well; once, because later it would mean goals that are not given yet
            self._cancelling.begin(GoalInfo(NO_UUID, NO_STAMP), lambda: True, once=True)
        for goal in self.goals.live:
            if not (every or goal.ident.text == meant.text or NO_STAMP < _given(goal) <= stamp):
                continue
            goal.cancelled = True
            if goal.accepted:
                self._cancel(goal)
        if meant.text and self.goals.of_text(meant.text) is None:
            now = clock.now()
            self._early = {text: until_s for text, until_s in self._early.items() if until_s > now}
            if len(self._early) < MAX_EARLY:
                self._early[meant.text] = now + EARLY_S

    # --- from the link ----------------------------------------------------------------------------------------------

    def status(self, body: bytes) -> None:
        """An action_msgs/GoalStatusArray. Goals that were not given here are left out."""
        try:
            mentioned = bodies.split_statuses(body)
        except ConfigError as error:
            self._complain("a status of its goals is not read", error)
            return
        before = [goal.status for goal in self.goals]
        for uuid, value in mentioned:
            goal, status = self.goals.of_uuid(uuid), ros2_status(value)
            if goal is None or self.goals.has_ended(goal) or status in ENDED_ROS2 or status is Ros2Status.UNKNOWN:
                continue  # what ends a goal is its result
            goal.status = max(goal.status, ROS1_STATUS[status], key=_ON_ITS_WAY.index)  # feedback overtakes a status
        if [goal.status for goal in self.goals] != before:
            self._tell()

    def feedback(self, body: bytes) -> None:
        try:
            uuid, own = self._types.feedback.to_ros1(body)
        except ConfigError as error:
            self._complain("a feedback is dropped, and others like it", error)
            return
        goal = self.goals.of_uuid(uuid)
        if goal is None or self.goals.has_ended(goal):
            return
        if goal.status is Ros1Status.PENDING:
            goal.status = Ros1Status.ACTIVE
            self._tell()
        self._publish_feedback(self._head() + bodies.ros1_status(goal.ident, goal.status, goal.text) + own)

    # --- a goal -----------------------------------------------------------------------------------------------------

    async def _run(self, goal: _Goal, request: bytes) -> None:
        """Give it, wait for its result, tell its client."""
        try:
            if await self._give(goal, request):
                await self._wait(goal)
        except Exception:  # noqa: BLE001  (a fault of one goal; its client must hear of it all the same)
            _log.exception("%s: goal %s has failed", self._name, goal.ident.shown)
            self._give_up(goal, Ros1Status.ABORTED, "it failed at its client's site")

    async def _give(self, goal: _Goal, request: bytes) -> bool:
        """Whether it is accepted. One that is under way was, also where the answer that says so did not come."""
        lost: str | None = None
        try:
            goal.accepted = bodies.is_accepted(await self._call("send_goal", request))
        except (ServiceError, ConfigError) as error:
            lost = str(error)
        goal.accepted = goal.accepted or goal.status is not Ros1Status.PENDING
        if goal.accepted:
            if goal.cancelled:
                self._cancel(goal)
        elif lost is not None:
            self._give_up(goal, Ros1Status.REJECTED, lost)
        else:
            why = "its server does not accept it, or did not answer in time"
            _log.warning("%s: goal %s is rejected: %s", self._name, goal.ident.shown, why)
            self._end(goal, Ros1Status.REJECTED, f"SERN: {why}")
        return goal.accepted

    async def _wait(self, goal: _Goal) -> None:
        try:
            response = await self._call("get_result", bodies.result_request(goal.uuid))
            before, own = self._types.result.to_ros1(response)
        except (ServiceError, ConfigError) as error:
            self._give_up(goal, Ros1Status.ABORTED, str(error))
            return
        status = ros2_status(before[0])
        if status in ENDED_ROS2:
            self._end(goal, ROS1_STATUS[status], "", own)
        else:
            self._give_up(goal, Ros1Status.ABORTED, "nothing is known of its result")

    def _give_up(self, goal: _Goal, status: Ros1Status, why: str) -> None:
        """What its client believes dead must not drive a robot, should it be under way."""
        _log.warning("%s: goal %s is given up and cancelled: %s", self._name, goal.ident.shown, why)
        self._end(goal, status, f"SERN: {why}")
        self._cancelling.begin(GoalInfo(goal.uuid, NO_STAMP), lambda: True)

    def _end(self, goal: _Goal, status: Ros1Status, text: str, own: bytes | None = None) -> None:
        if self._closed or self.goals.has_ended(goal):
            return
        goal.status, goal.text = status, text
        self.goals.end(goal, now=clock.now())
        self._say_result(goal, status, text, self._types.result.zero if own is None else own)
        self._tell()
        if not self.busy:
            self._idle()

    def _say_result(self, goal: _Goal, status: Ros1Status, text: str, own: bytes) -> None:
        self._publish_result(self._head() + bodies.ros1_status(goal.ident, status, text) + own)

    async def _call(self, part: str, request: bytes) -> bytes:
        handler = self._calls.get(part)
        if handler is None:
            raise ServiceError(f"its service {part} is gone")
        return await handler(request)

    def _cancel(self, goal: _Goal) -> None:
        """Ask the server to cancel the goal, until that has ended."""
        self._cancelling.begin(GoalInfo(goal.uuid, NO_STAMP), lambda: not self.goals.has_ended(goal))

    # --- time -------------------------------------------------------------------------------------------------------

    def _due(self) -> None:
        now = clock.now()
        self.goals.expire(now=now)
        self._tell()
        self._timer.arm(now + STATUS_S)

    def _head(self) -> bytes:
        self._seq += 1
        return bodies.ros1_header(self._seq, Stamp.of(time.time_ns()))

    def _tell(self) -> None:
        if not self._closed:
            self._seq += 1
            each = [bodies.ros1_status(goal.ident, goal.status, goal.text) for goal in self.goals]
            self._publish_status(bodies.ros1_statuses(self._seq, Stamp.of(time.time_ns()), each))

    def _complain(self, what: str, error: ConfigError) -> None:
        self._counts.failures += 1
        self._said(f"{self._name}: {what}: {error}", what)


def _given(goal: _Goal) -> Stamp:
    return Stamp(goal.ident.secs, goal.ident.nsecs)
