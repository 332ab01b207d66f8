"""How nodes of one ROS see an action of the other: what is opened for it at this site's endpoint."""

import asyncio
import logging
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from typing import Final, Protocol

from sern_client.action_conversion.cancelling import Cancelling
from sern_client.action_conversion.crossing import GONE, Part
from sern_client.action_conversion.server_for_ros1 import ServerForRos1
from sern_client.action_conversion.server_for_ros2 import ServerForRos2
from sern_client.action_conversion.types import (
    ActionTypes,
    Names,
    Pair,
    in_steps,
    names_of_ros1,
    names_of_ros2,
    ros1_action,
    ros1_text,
    ros2_action,
    ros2_text,
    ros2_texts,
)
from sern_client.actions import STATUS_TYPE
from sern_client.endpoints.base import Publisher, ServiceHandler, ServiceInfo, ServiceServer, Sink
from sern_client.endpoints.common.saying import SayOnce
from sern_client.endpoints.conversion import Converter
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import ros_services, ros_types
from sern_runtime.ros_files import TypeFiles

ROS2_STATUS_TYPE: Final = "action_msgs/msg/GoalStatusArray"
CANCEL_TYPE: Final = "actionlib_msgs/msg/GoalID"

_log = logging.getLogger(__name__)


class Here(Protocol):
    """This site's endpoint and the bridge before it, as a stage uses them. `files`: definitions of ROS 2, the nearest
    first."""

    converter: Converter
    files: Sequence[TypeFiles]
    pairs: tuple[Pair, ...]

    def advertise_own(self, info: TopicInfo) -> Publisher:
        """ConfigError where that cannot be."""
        ...

    def serve_own(self, info: ServiceInfo, handler: ServiceHandler) -> ServiceServer:
        """ConfigError where that cannot be."""
        ...

    def announce(self, info: TopicInfo, given: Callable[[Sink | None], None]) -> Callable[[], None]:
        """Tell the bridge of a topic that no node has; `given` hears where its messages go, and when they go nowhere.
        What is returned ends it."""
        ...

    def take(self, name: TopicName, sink_of: Callable[[TopicInfo], Sink | None]) -> Callable[[], None]:
        """Have a topic of nodes here while there is one: it is no longer the bridge's. None of `sink_of`: it is left
        to it. What is returned ends that."""
        ...


class Ros2Stage:
    """Nodes of ROS 2 here, a server of ROS 1 there."""

    needed = frozenset({"status", "feedback", "result"})

    def __init__(self, name: TopicName, here: Here, *, answer_s: float, idle: Callable[[], None]) -> None:
        self._name = name
        self._here = here
        self._answer_s = answer_s
        self._idle = idle
        self._server: ServerForRos2 | None = None
        self._types: ActionTypes | None = None
        self._opened = ExitStack()

    @property
    def busy(self) -> bool:
        return self._server is not None and self._server.busy

    @property
    def pending(self) -> bool:
        return False

    def begin(self) -> None:
        assert self._types is not None
        types = self._types
        with ExitStack() as stack:
            server = self._open(types, stack)
            self._opened = stack.pop_all()
        self._server = server
        server.start()
        _log.info("%s: %s stand for each other; nodes of ROS 2 can give goals", self._name, types.names)

    def refresh(self, parts: Mapping[str, Part], away: str) -> None:
        del parts
        if self._server is not None:
            self._server.away = away

    def message(self, kind: str, body: bytes) -> None:
        if self._server is not None:
            getattr(self._server, kind)(body)

    def end(self) -> None:
        """Its nodes are answered before what serves them ends."""
        server, self._server = self._server, None
        if server is not None:
            server.close()
        asyncio.get_running_loop().call_soon(self._opened.close)
        self._opened = ExitStack()

    async def stop(self) -> None:
        await asyncio.sleep(0)

    def prepare(self, parts: Mapping[str, Part]) -> Iterator[None]:
        found = {part: ros1_action(parts[part].info.type_name, part) for part in ("result", "feedback")}
        action = found["result"]
        if action is None or found["feedback"] != action:
            raise ConfigError(f"its result is of {action}, its feedback of {found['feedback']}")
        names = names_of_ros1(action, self._here.pairs)
        ros2 = ros2_texts(names.ros2, self._here.files)
        if ros2 is None:
            raise _unknown(names)
        ros1 = {part: ros1_text(action, part, _own(parts[part]), parts[part].info.definition) for part in found}
        yield
        self._types = yield from in_steps(names, ros2, ros1)

    def _open(self, types: ActionTypes, stack: ExitStack) -> ServerForRos2:
        here, action = self._here, types.names.ros2
        status = ros_types.topic_info(
            f"{self._name}/_action/status", ROS2_STATUS_TYPE, Encoding.CDR, latched=True, reliable=True
        )
        text = _first(files.message(f"{action}_FeedbackMessage") for files in self._here.files)
        feedback_type = f"{action}_FeedbackMessage"
        feedback = TopicInfo(
            TopicName(f"{self._name}/_action/feedback"), feedback_type, Encoding.CDR,
            ros_types.hash_of(feedback_type, text, Encoding.CDR), text, reliable=True,
        )  # fmt: skip
        server = ServerForRos2(
            self._name,
            types,
            answer_s=self._answer_s,
            publish_status=_publish(status.name, here.advertise_own(status), stack),
            publish_feedback=_publish(feedback.name, here.advertise_own(feedback), stack),
            idle=self._idle,
            counts=self._here.converter,
        )
        goal_type, goal_text = types.goal.topic
        stack.callback(
            here.announce(
                TopicInfo(
                    TopicName(f"{self._name}/goal"), goal_type, Encoding.ROS1, goal_text.type_hash, goal_text.definition
                ),
                partial(setattr, server, "goal_sink"),
            )
        )
        cancel = ros_types.topic_info(f"{self._name}/cancel", CANCEL_TYPE, Encoding.ROS1)
        stack.callback(here.announce(cancel, partial(setattr, server, "cancel_sink")))
        for part, type_name, handler in (
            ("send_goal", f"{action}_SendGoal", server.send_goal),
            ("cancel_goal", "action_msgs/srv/CancelGoal", server.cancel_goal),
            ("get_result", f"{action}_GetResult", server.get_result),
        ):
            definition = _first(files.service(type_name) for files in self._here.files)
            known = ros_services.resolve(type_name, definition, Encoding.CDR).text
            info = ServiceInfo(
                TopicName(f"{self._name}/_action/{part}"), type_name, Encoding.CDR, known.type_hash, known.definition
            )
            stack.callback(here.serve_own(info, handler).close)
        return server


class Ros1Stage:
    """Nodes of ROS 1 here, a server of ROS 2 there."""

    needed = frozenset({"send_goal", "cancel_goal", "get_result", "status", "feedback"})

    def __init__(self, name: TopicName, here: Here, *, idle: Callable[[], None]) -> None:
        self._name = name
        self._here = here
        self._idle = idle
        self._calls: dict[str, ServiceHandler] = {}
        self._cancelling = Cancelling(name, self._calls, idle)
        self._server: ServerForRos1 | None = None
        self._last: ServerForRos1 | None = None
        self._types: ActionTypes | None = None
        self._opened = ExitStack()

    @property
    def busy(self) -> bool:
        return self._server is not None and self._server.busy

    @property
    def pending(self) -> bool:
        return self._cancelling.count > 0

    def begin(self) -> None:
        assert self._types is not None
        types = self._types
        with ExitStack() as stack:
            server = self._open(types, stack)
            self._opened = stack.pop_all()
        self._server = self._last = server
        server.start()
        _log.info("%s: %s stand for each other; nodes of ROS 1 can give goals", self._name, types.names)

    def refresh(self, parts: Mapping[str, Part], away: str) -> None:
        self._calls.update({kind: part.handler for kind, part in parts.items() if part.handler is not None})
        if self._server is not None:
            self._server.away = away

    def message(self, kind: str, body: bytes) -> None:
        if self._server is not None:
            getattr(self._server, kind)(body)

    def end(self) -> None:
        server, self._server = self._server, None
        if server is not None:
            server.close()
        self._opened.close()
        self._opened = ExitStack()

    async def stop(self) -> None:
        if self._last is not None:
            await self._last.ended()
        await self._cancelling.stop()

    def prepare(self, parts: Mapping[str, Part]) -> Iterator[None]:
        sources = (("goal", "send_goal", "SendGoal"), ("result", "get_result", "GetResult"),
                   ("feedback", "feedback", "FeedbackMessage"))  # fmt: skip
        found = {part: ros2_action(parts[kind].info.type_name, end) for part, kind, end in sources}
        action = found["goal"]
        if action is None or any(other != action for other in found.values()):
            raise ConfigError("its parts are of different actions: " + ", ".join(sorted(map(str, found.values()))))
        names = names_of_ros2(action, self._here.pairs)
        if all(parts[kind].info.definition for _, kind, _ in sources):
            ros2 = {
                part: ros2_text(action, part, _own(parts[kind]), parts[kind].info.definition)
                for part, kind, _ in sources
            }
        else:
            known = ros2_texts(action, self._here.files)
            if known is None:
                raise _unknown(names)
            ros2 = known
        yield
        self._types = yield from in_steps(names, ros2, {})

    def _open(self, types: ActionTypes, stack: ExitStack) -> ServerForRos1:
        here = self._here

        def topic(part: str, kind: str, text: ros_types.TypeText, *, latched: bool = False) -> Callable[[bytes], None]:
            name = TopicName(f"{self._name}/{part}")
            info = TopicInfo(name, kind, Encoding.ROS1, text.type_hash, text.definition, latched, reliable=True)
            return _publish(name, here.advertise_own(info), stack)

        status = ros_types.describe(STATUS_TYPE, Encoding.ROS1)
        assert status is not None
        server = ServerForRos1(
            self._name,
            types,
            self._calls,
            self._cancelling,
            publish_status=topic("status", STATUS_TYPE, status, latched=True),
            publish_feedback=topic("feedback", *types.feedback.topic),
            publish_result=topic("result", *types.result.topic),
            idle=self._idle,
            counts=self._here.converter,
        )
        server.away = GONE  # until it is told otherwise

        def goals(info: TopicInfo) -> Sink | None:
            try:
                action = ros1_action(info.type_name, "goal")
                if action != types.names.ros1:
                    raise ConfigError(f"it is {info.type_name}, of an action of {types.names.ros1}")
                text = ros1_text(action, "goal", ros_types.ros1_name(info.type_name), info.definition)
                ours = ros_types.resolve(types.goal.ros1.name, text, Encoding.ROS1)
                types.goal.check(ours, types.goal.ros1)
            except ConfigError as error:
                _log.error("%s is not taken: %s; give goals of the server's version of the type", info.name, error)
                return None
            return partial(_taken, server.goal)

        stack.callback(here.take(TopicName(f"{self._name}/goal"), goals))
        stack.callback(here.take(TopicName(f"{self._name}/cancel"), lambda _: partial(_taken, server.cancel)))
        return server


def _publish(name: str, publisher: Publisher, stack: ExitStack) -> Callable[[bytes], None]:
    """What publishes. A fault there is said once, and holds up nothing else."""
    stack.callback(publisher.close)
    said = SayOnce(_log, most=1)

    def publish(body: bytes) -> None:
        try:
            publisher.publish(body, time.time_ns())
        except Exception as error:  # noqa: BLE001  (of one topic; the goals go on)
            said(f"{name} could not be published here", error=error)

    return publish


def _taken(take: Callable[[bytes], None], body: bytes, stamp_ns: int) -> bool:
    del stamp_ns
    take(body)
    return True


def _own(part: Part) -> str:
    """What a definition calls the type that it begins with, which is no section of it."""
    return part.info.type_name


def _first(texts: Iterable[str | None]) -> str:
    return next((text for text in texts if text is not None), "")


def _unknown(names: Names) -> ConfigError:
    return ConfigError(
        f"the definition of {names.ros2}, which stands for {names.ros1} of ROS 1, is not known; add the directory of "
        "its .action file to type_paths of the ROS 2 endpoint"
    )
