"""Goals that the far side will never answer, told to who gave them.

An action of ROS 1 (actionlib) is five topics, and its client waits for ever for a goal that was lost on its way. At the
client's site each goal that goes out is therefore watched: where it is dropped, or nothing is heard of it in time, the
client gets a result with the status REJECTED (never taken up, as far as we know) or ABORTED (it was under way), and a
cancel goes after the goal, because what its client believes dead must not drive a robot. An action of ROS 2 is services
and topics; there the answers of `refusal` take the place of those that do not come.
"""

import asyncio
import logging
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from heapq import heapify, heappop, heappush
from itertools import count
from math import inf
from typing import Any, Final, NamedTuple

from sern_client.endpoints.base import Publisher, ServiceInfo, Sink
from sern_core.stream.out_channel import OutChannel
from sern_core.topics.patterns import Pattern
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.message import StreamId, TopicInfo
from sern_core.vocabulary.types import DropReason, Encoding, TopicName
from sern_runtime import clock, ros_services, ros_types
from sern_runtime.loop import Timer

REJECTED, ABORTED = 5, 4
"""Values of actionlib_msgs/GoalStatus."""
ACCEPT_S: Final = 5.0
"""How long beyond its lifespan on the link a goal may take until its server is heard of it."""
MAX_GOALS: Final = 1000
"""Goals of one action that are watched at a time; of more, the oldest are watched no longer."""
SPARE_ENTRIES: Final = 64
"""How many times of goals that have ended may be queued beside as many as there are goals."""
MAX_STATUSES: Final = 4000
"""Goals that one status message may mention: 5 ms of the event loop. A server mentions those of the last seconds."""
STATUS_TYPE: Final = "actionlib_msgs/msg/GoalStatusArray"

_LITTLE_ENDIAN: Final = b"\x00\x01\x00\x00"
_UUID: Final = slice(4, 20)
"""Where the goal's id is in a request of `send_goal`."""
_TIME: Final = struct.Struct("<II")
_LENGTH: Final = struct.Struct("<I")
_HEADER_BYTES: Final = 12  # seq and stamp of a std_msgs/Header, before its frame_id

_log = logging.getLogger(__name__)


def refusal(info: ServiceInfo) -> bytes | None:
    """What a service of an action of ROS 2 answers when the one of the far side does not: the goal is not accepted,
    nothing is cancelled, the result is unknown. None for other services, and for a result that nobody can make up.
    """
    if info.encoding is not Encoding.CDR:
        return None
    part = info.name.rpartition("/_action/")[2]
    if part == "send_goal":
        return _LITTLE_ENDIAN + bytes(12)  # bool accepted, builtin_interfaces/Time stamp
    if part == "cancel_goal":
        return _LITTLE_ENDIAN + b"\x01" + bytes(7)  # int8 return_code ERROR_REJECTED, GoalInfo[] goals_canceling
    if part != "get_result":
        return None
    try:
        resolved = ros_services.resolve(info.type_name, info.definition, Encoding.CDR).response
        empty = ros_types.new_in(resolved.store, resolved.name)  # int8 status STATUS_UNKNOWN
        return bytes(resolved.store.serialize_cdr(empty, resolved.name))
    except ConfigError:
        return None


def cancel_request(send_goal_request: bytes) -> bytes | None:
    """action_msgs/CancelGoal for the goal of a request of `send_goal`, both as CDR; None where there is none in it."""
    if len(send_goal_request) < _UUID.stop or send_goal_request[1] > 1:
        return None
    return send_goal_request[:4] + send_goal_request[_UUID] + bytes(8)  # GoalInfo: UUID goal_id, Time stamp


class _Ros1Text(str):
    """A text that goes out with the bytes it came with, UTF-8 or not; ROS 1 does not ask."""

    __slots__ = ()

    def encode(self, encoding: str = "utf-8", errors: str = "surrogateescape") -> bytes:
        return super().encode(encoding, errors)


class GoalId(NamedTuple):
    """actionlib_msgs/GoalID: when the client gave the goal, and what it calls it. Bytes of `text` that are no UTF-8
    are lone surrogates in it."""

    secs: int
    nsecs: int
    text: str

    def pack(self) -> bytes:
        text = self.text.encode(errors="surrogateescape")
        return _TIME.pack(self.secs, self.nsecs) + _LENGTH.pack(len(text)) + text

    @property
    def shown(self) -> str:
        """The text for people: what is no UTF-8 is escaped."""
        return self.text.encode(errors="surrogateescape").decode(errors="backslashreplace")


def goal_id(body: bytes) -> GoalId:
    """The id of an action goal, which follows its header. ConfigError for bytes that have none."""
    try:
        (length,) = _LENGTH.unpack_from(body, _HEADER_BYTES)
        at = _HEADER_BYTES + _LENGTH.size + length
        secs, nsecs = _TIME.unpack_from(body, at)
        at += _TIME.size
        (length,) = _LENGTH.unpack_from(body, at)
    except struct.error:
        raise ConfigError(f"{len(body)} bytes are no action goal") from None
    at += _LENGTH.size
    if at + length > len(body):
        raise ConfigError(f"{len(body)} bytes are no action goal")
    return GoalId(secs, nsecs, body[at : at + length].decode(errors="surrogateescape"))


def mentioned_goals(body: bytes) -> list[tuple[str, int]]:
    """The texts of the goal ids in a GoalStatusArray of ROS 1, each with the byte of its status. ConfigError for bytes
    that are none, and for more than MAX_STATUSES."""
    found: list[tuple[str, int]] = []
    try:
        (length,) = _LENGTH.unpack_from(body, _HEADER_BYTES)
        at = _HEADER_BYTES + _LENGTH.size + length
        (count,) = _LENGTH.unpack_from(body, at)
        if count > MAX_STATUSES:
            raise ConfigError(f"it mentions {count} goals, more than {MAX_STATUSES}")
        at += _LENGTH.size
        for _ in range(count):
            at += _TIME.size
            (length,) = _LENGTH.unpack_from(body, at)
            at += _LENGTH.size
            end = at + length
            found.append((body[at:end].decode(errors="surrogateescape"), body[end]))
            (length,) = _LENGTH.unpack_from(body, end + 1)
            at = end + 1 + _LENGTH.size + length
    except (IndexError, struct.error):
        at = len(body) + 1
    if at > len(body):
        raise ConfigError(f"{len(body)} bytes are no {STATUS_TYPE}")
    return found


def result_body(info: TopicInfo, goal: GoalId, status: int, text: str) -> bytes:
    """An action result without content. ConfigError when its type is not known, or is none."""
    resolved = ros_types.resolve(info.type_name, info.definition, Encoding.ROS1)
    result: Any = ros_types.new_in(resolved.store, resolved.name)
    try:
        result.status.goal_id.stamp.sec = goal.secs
        result.status.goal_id.stamp.nanosec = goal.nsecs
        result.status.goal_id.id = _Ros1Text(goal.text)
        result.status.status = status
        result.status.text = text
    except AttributeError:
        raise ConfigError(f"type {info.type_name} is no action result") from None
    return bytes(resolved.store.serialize_ros1(result, resolved.name))


@dataclass(slots=True)
class _Goal:
    """One that is on its way or under way. `due_s`: when we give it up, unless something is heard of it.

    `queued_s`: when we look at it next, never later than `due_s`.
    """

    ident: GoalId
    stream: StreamId
    seq: int
    due_s: float
    heard: bool = False
    queued_s: float = inf
    watched: bool = True


@dataclass(slots=True, eq=False)
class _Action:
    """An action of another site that nodes here use. `patience_s`: how long a goal may go unmentioned."""

    name: str
    patience_s: float
    accept_s: float = ACCEPT_S
    goals: dict[str, _Goal] = field(default_factory=dict)
    tells: bool = False  # whether its status is of the type that is read
    complained: bool = False
    result: TopicInfo | None = None  # as it was last seen
    publish: Callable[[bytes], None] | None = None  # while the far side has its result
    cancel: Sink | None = None


class GoalWatch:
    """Watches actions that match one of `rules`: (local name, how long nothing may be heard of an accepted goal)."""

    def __init__(self, rules: tuple[tuple[Pattern, float], ...], advertise: Callable[[TopicInfo], Publisher]) -> None:
        self.reported = 0
        """Goals whose clients were told that they have failed."""
        self._rules = rules
        self._advertise = advertise
        self._actions: dict[str, _Action] = {}
        self._by_message: dict[tuple[StreamId, int], tuple[_Action, _Goal]] = {}
        self._due_next: list[tuple[float, int, _Action, _Goal]] = []  # a heap: when to look, and at which goal
        self._entries = count()
        self._timer = Timer(self._due)

    @property
    def watched(self) -> int:
        """Goals that are watched now, without those that the link has just refused."""
        return len(self._by_message)

    def close(self) -> None:
        self._timer.cancel()
        self._actions.clear()
        self._by_message.clear()
        self._due_next.clear()

    def _part(self, name: TopicName, encoding: Encoding) -> tuple[_Action, str] | None:
        """The action that a topic of ours belongs to, and what it is there."""
        action, _, part = name.rpartition("/")
        if encoding is not Encoding.ROS1 or part not in {"goal", "cancel", "status", "result"}:
            return None
        known = self._actions.get(action)
        if known is None:
            patience_s = next((patience_s for match, patience_s in self._rules if match.fullmatch(action)), None)
            if patience_s is None:
                return None
            known = self._actions[action] = _Action(action, patience_s)
        return known, part

    # What goes out

    def outgoing(self, info: TopicInfo, channel: OutChannel, sink: Sink) -> Sink:
        """The sink of a topic that is offered to the link, with its goals watched where it has any."""
        found = self._part(info.name, info.encoding)
        if found is None:
            return sink
        action, part = found
        if part == "cancel":
            action.cancel = sink
        if part != "goal":
            return sink
        action.accept_s = (channel.spec.lifespan_s or 0.0) + ACCEPT_S

        def watched(body: bytes, stamp_ns: int) -> bool:
            goal = self._given(action, channel, body)
            accepted = sink(body, stamp_ns)
            if not accepted and goal is not None:
                self._unlist(goal)  # the next goal has its number
                self._fail_soon(action, goal, "too much waits for the link")
            return accepted

        return watched

    def withdrawn(self, name: TopicName) -> None:
        """A topic of this site has ended. Who gave its goals is gone."""
        found = self._part(name, Encoding.ROS1)
        if found is None:
            return
        action, part = found
        if part == "cancel":
            action.cancel = None
        elif part == "goal":
            for text in list(action.goals):
                self._forget(action, text)

    def _given(self, action: _Action, channel: OutChannel, body: bytes) -> _Goal | None:
        try:
            ident = goal_id(body)
        except ConfigError:
            return None
        if ident.text in action.goals:
            self._forget(action, ident.text)
        while len(action.goals) >= MAX_GOALS:
            self._forget(action, next(iter(action.goals)))
        goal = _Goal(ident, channel.stream.id, channel.next_seq, clock.now() + action.accept_s)
        action.goals[ident.text] = goal
        self._by_message[goal.stream, goal.seq] = action, goal
        self._queue(action, goal)
        self._arm()
        return goal

    def send_dropped(self, stream: StreamId, first: int, count: int, reason: DropReason) -> None:
        """Messages of ours, `count` from seq `first` on, were dropped, here or on their way."""
        watched = self._by_message
        if count <= len(watched):
            keys = [key for seq in range(first, first + count) if (key := (stream, seq)) in watched]
        else:
            keys = [key for key in watched if key[0] == stream and first <= key[1] < first + count]
        for key in keys:
            action, goal = watched[key]
            self._fail_soon(action, goal, f"it was dropped on its way: {reason}")

    # What comes in

    def opened(self, info: TopicInfo, publish: Callable[[bytes], None]) -> None:
        """A stream from another site is published here."""
        found = self._part(info.name, info.encoding)
        if found is None:
            return
        action, part = found
        if part == "result":
            action.result = info
            action.publish = publish
        elif part == "status":
            action.tells = info.type_name == STATUS_TYPE

    def ended(self, name: TopicName) -> None:
        found = self._part(name, Encoding.ROS1)
        if found is not None and found[1] == "result":
            found[0].publish = None

    def message(self, name: TopicName, encoding: Encoding, body: bytes) -> None:
        """Something arrived; what it says of goals that are watched counts."""
        action, _, part = name.rpartition("/")
        known = self._actions.get(action)
        if known is None or not known.goals or encoding is not Encoding.ROS1 or part not in {"status", "result"}:
            return
        if part == "status":
            if known.tells:
                self._mentioned(known, body)
            return
        try:
            ended = goal_id(body)  # a result begins as a goal does: header, then status, then goal id
        except ConfigError:
            return
        if ended.text in known.goals:
            self._forget(known, ended.text)

    def _mentioned(self, action: _Action, body: bytes) -> None:
        try:
            mentioned = mentioned_goals(body)
        except ConfigError as error:
            if not action.complained:
                action.complained = True
                _log.warning("%s: a status of its goals is not read: %s", action.name, error)
            return
        due_s = clock.now() + action.patience_s
        for text, _ in mentioned:
            goal = action.goals.get(text)
            if goal is not None:
                goal.heard = True
                goal.due_s = due_s
                if due_s < goal.queued_s:
                    self._queue(action, goal)
        self._arm()

    # Who waits

    def _forget(self, action: _Action, text: str) -> None:
        goal = action.goals.pop(text)
        goal.watched = False
        self._unlist(goal)

    def _unlist(self, goal: _Goal) -> None:
        """No message is this goal any more; its number may be another's."""
        found = self._by_message.get((goal.stream, goal.seq))
        if found is not None and found[1] is goal:
            del self._by_message[goal.stream, goal.seq]

    def _queue(self, action: _Action, goal: _Goal) -> None:
        goal.queued_s = goal.due_s
        heappush(self._due_next, (goal.due_s, next(self._entries), action, goal))
        if len(self._due_next) > 2 * self.watched + SPARE_ENTRIES:
            self._due_next = [entry for entry in self._due_next if self._is_current(entry)]
            heapify(self._due_next)

    @staticmethod
    def _is_current(entry: tuple[float, int, _Action, _Goal]) -> bool:
        """Whether it is to be looked at: the goal has not ended, and is not queued for earlier."""
        at_s, _, _, goal = entry
        return goal.watched and at_s == goal.queued_s

    def _arm(self) -> None:
        while self._due_next and not self._is_current(self._due_next[0]):
            heappop(self._due_next)
        self._timer.arm(self._due_next[0][0] if self._due_next else None)

    def _due(self) -> None:
        now = clock.now()
        while self._due_next and self._due_next[0][0] <= now:
            entry = heappop(self._due_next)
            _, _, action, goal = entry
            if not self._is_current(entry):
                continue
            if goal.due_s > now:  # it was heard of since
                self._queue(action, goal)
                continue
            for_s = action.patience_s if goal.heard else action.accept_s
            self._fail(action, goal, f"nothing was heard of it for {for_s:g} s")
        self._arm()

    def _fail_soon(self, action: _Action, goal: _Goal, why: str) -> None:
        """Not from within the core, which is in the middle of something."""
        asyncio.get_running_loop().call_soon(self._fail, action, goal, why)

    def _fail(self, action: _Action, goal: _Goal, why: str) -> None:
        if action.goals.get(goal.ident.text) is not goal:
            return
        self._forget(action, goal.ident.text)
        _log.warning("%s: goal %s is given up and cancelled: %s", action.name, goal.ident.shown, why)
        try:
            if action.cancel is not None:
                action.cancel(goal.ident.pack(), time.time_ns())
        except Exception:  # noqa: BLE001  (a fault of one goal; its client is told, and the other goals go on)
            _log.exception("%s: goal %s could not be cancelled", action.name, goal.ident.shown)
        if action.result is None:
            return  # its client has never seen a server either
        try:
            body = result_body(action.result, goal.ident, ABORTED if goal.heard else REJECTED, f"SERN: {why}")
            if action.publish is not None:
                action.publish(body)
            else:
                publisher = self._advertise(action.result)
                publisher.publish(body, time.time_ns())
                publisher.close()
        except ConfigError as error:
            _log.error("%s: the client of goal %s cannot be told: %s", action.name, goal.ident.shown, error)
            return
        except Exception:  # noqa: BLE001  (a fault of one goal)
            _log.exception("%s: the client of goal %s could not be told", action.name, goal.ident.shown)
            return
        self.reported += 1
