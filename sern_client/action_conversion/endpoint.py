"""An endpoint whose nodes use actions of the other ROS: it stands between the bridge and the real endpoint.

The site that uses an action is where the encodings differ. To the bridge the action's parts stay those of its server:
five topics of ROS 1, or three services and two topics of ROS 2. To the nodes here they are those of their own ROS. All
else passes to the endpoint behind this one, and is converted there as ever. What is between the two sides of an action
is `ServerForRos2` or `ServerForRos1`.

An action is converted once all its parts are there. Where it cannot be, its topics and services pass as any others.
"""

import logging
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Final

from sern_client.action_conversion.crossing import Crossing, Part
from sern_client.action_conversion.stages import ROS2_STATUS_TYPE, Ros1Stage, Ros2Stage
from sern_client.action_conversion.types import PAIRS, Pair, ros1_action, ros2_action
from sern_client.actions import STATUS_TYPE
from sern_client.endpoints.base import (
    CountingEndpoint,
    Difference,
    Endpoint,
    Held,
    KeepingEndpoint,
    Publisher,
    ServiceEndpoint,
    ServiceEvents,
    ServiceHandler,
    ServiceInfo,
    ServiceServer,
    Sink,
    Subscription,
    TopicEvents,
    ViewingEndpoint,
    keepers_of,
    viewers_of,
)
from sern_client.endpoints.common.saying import SayOnce
from sern_client.endpoints.conversion import Converter, HasConverter, serve
from sern_core.topics.patterns import Pattern
from sern_core.vocabulary.errors import UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import DropReason, Encoding, TopicName
from sern_runtime.ros_files import TypeFiles

_UNDER: Final = "/_action/"
_ENDS: Final = {"send_goal": "SendGoal", "get_result": "GetResult"}
_CANCEL_SERVICE: Final = "action_msgs/srv/CancelGoal"

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Rule:
    """Actions that nodes here use: by local name, and how long a goal may wait for its first answer."""

    match: Pattern
    answer_s: float


@dataclass(slots=True, eq=False)
class _Announced:
    """A topic of ours that the bridge takes for one of a node here."""

    info: TopicInfo
    given: Callable[[Sink | None], None]
    subscriptions: "list[_Subscription]" = field(default_factory=list)

    def settle(self) -> None:
        self.given(self.subscriptions[-1].sink if self.subscriptions else None)


@dataclass(slots=True, eq=False)
class _Subscription:
    """The bridge's, of such a topic."""

    sink: Sink
    topic: _Announced

    def close(self) -> None:
        if self in self.topic.subscriptions:
            self.topic.subscriptions.remove(self)
            self.topic.settle()


@dataclass(slots=True, eq=False)
class _Taken:
    """A topic of nodes here that belongs to an action: while it is there, and of its type, it is not the bridge's."""

    sink_of: Callable[[TopicInfo], Sink | None]
    subscription: Subscription | None = None


class _Events:
    """The `TopicEvents` handed to the endpoint behind."""

    def __init__(self, owner: "ActionEndpoint") -> None:
        self._owner = owner

    def topic_added(self, info: TopicInfo) -> None:
        self._owner.node_topic_added(info)

    def topic_removed(self, name: TopicName) -> None:
        self._owner.node_topic_removed(name)


class _Own:
    """A publisher of ours at the endpoint behind, counted while it is open."""

    def __init__(self, publisher: Publisher, name: TopicName, counts: Counter[TopicName]) -> None:
        self._publisher = publisher
        self._name = name
        self._counts = counts
        self._closed = False
        counts[name] += 1

    def publish(self, body: bytes, stamp_ns: int) -> None:
        self._publisher.publish(body, stamp_ns)

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            self._counts[self._name] -= 1
            self._publisher.close()


class ActionEndpoint:
    """An `Endpoint` and `ServiceEndpoint` over one that is both: `inner`, and `services` for what it serves. Its nodes
    take bodies of `encoding`. Other actions than those of `rules`, and those of the nodes' own ROS, are left alone.

    `namespace`: the site's; goals of ROS 1 are a topic of it. `files`: definitions of ROS 2, the nearest first.
    `pairs`: actions that correspond though they do not look alike.
    """

    def __init__(
        self,
        inner: Endpoint,
        services: ServiceEndpoint,
        encoding: Encoding,
        rules: Sequence[Rule],
        *,
        namespace: str,
        files: Sequence[TypeFiles],
        pairs: Iterable[Pair] = PAIRS,
    ) -> None:
        self.inner = inner
        self.converter = inner.converter if isinstance(inner, HasConverter) else Converter()
        self.files = files
        self.pairs = tuple(pairs)
        self._services = services
        self._ros2 = encoding is Encoding.CDR
        self._rules = rules
        self._namespace = namespace
        self._events: TopicEvents | None = None
        self._said = SayOnce(_log, logging.ERROR)
        self._actions: dict[TopicName, Crossing] = {}
        self._announced: dict[TopicName, _Announced] = {}
        self._node_topics: dict[TopicName, TopicInfo] = {}  # goals and cancellings of nodes of ROS 1, of these rules
        self._taken: dict[TopicName, _Taken] = {}
        self._publishers: Counter[TopicName] = Counter()  # ours, at the endpoint behind

    # --- Endpoint ---------------------------------------------------------------------------------------------------

    async def start(self, events: TopicEvents) -> None:
        self._events = events
        await self.inner.start(_Events(self))

    async def stop(self) -> None:
        for action in self._actions.values():
            action.close()
        for action in self._actions.values():
            await action.stop()
        self._events = None
        await self.inner.stop()

    def subscribe(self, name: TopicName, sink: Sink) -> Subscription:
        announced = self._announced.get(name)
        if announced is None:
            return self.inner.subscribe(name, sink)
        subscription = _Subscription(sink, announced)
        announced.subscriptions.append(subscription)
        announced.settle()
        return subscription

    def advertise(self, info: TopicInfo) -> Publisher:
        """A part of an action that is to be converted is kept; anything else is published at the endpoint behind."""
        found = self._topic_part(info)
        if found is None:
            return self.pass_topic(info)
        action, kind = found
        return action.open(kind, info)

    def interest(self, name: TopicName, wanted: bool) -> None:
        if name not in self._announced and not (name in self._taken and self._taken[name].subscription is not None):
            self.inner.interest(name, wanted)

    def validate(self, held: Held) -> list[Difference]:
        """Also of what is ours at the endpoint behind, and of the bridge's that is not there."""
        kept = Counter(part.info.name for part in self._parts() if isinstance(part.info, TopicInfo) and not part.passes)
        topics = Counter(each.info.name for each in self._announced.values() for _ in each.subscriptions)
        mine = Held(
            Counter({name: held.publishers[name] for name in kept}),
            Counter({name: held.subscriptions[name] for name in topics}),
        )
        found = mine.differences(Held(kept, topics))
        taken = Counter(name for name, each in self._taken.items() if each.subscription is not None)
        return found + self.inner.validate(
            Held(
                +(held.publishers - mine.publishers + self._publishers),
                +(held.subscriptions - mine.subscriptions + taken),
            )
        )

    @property
    def encoding(self) -> None:
        """It converts by itself."""
        return None

    @property
    def exhausted(self) -> bool:
        return self.inner.exhausted

    @property
    def drops(self) -> dict[DropReason, int]:
        return dict(self.inner.drops) if isinstance(self.inner, CountingEndpoint) else {}

    @property
    def keepers(self) -> Sequence[KeepingEndpoint]:
        return keepers_of(self.inner)

    @property
    def viewers(self) -> Sequence[ViewingEndpoint]:
        return viewers_of(self.inner)

    # --- ServiceEndpoint --------------------------------------------------------------------------------------------

    def watch_services(self, events: ServiceEvents) -> None:
        self._services.watch_services(events)

    async def call(self, name: TopicName, request: bytes, *, timeout_s: float) -> bytes:
        return await self._services.call(name, request, timeout_s=timeout_s)

    def serve(self, info: ServiceInfo, handler: ServiceHandler) -> ServiceServer:
        """A part of an action that is to be converted is kept; anything else is served at the endpoint behind."""
        found = self._service_part(info)
        if found is None:
            return self.pass_service(info, handler)
        action, kind = found
        return action.open(kind, info, handler)

    # --- which parts of which action --------------------------------------------------------------------------------

    def _topic_part(self, info: TopicInfo) -> tuple[Crossing, str] | None:
        if self._ros2:
            name, _, kind = info.name.rpartition("/")
            status, types = STATUS_TYPE, {kind: ros1_action(info.type_name, kind)}
            foreign = info.encoding is Encoding.ROS1 and kind in Ros2Stage.needed
        else:
            name, _, kind = info.name.partition(_UNDER)
            status, types = ROS2_STATUS_TYPE, {"feedback": ros2_action(info.type_name, "FeedbackMessage")}
            foreign = info.encoding is Encoding.CDR and kind in ("status", "feedback")
        fits = info.type_name == status if kind == "status" else types.get(kind) is not None
        return self._of(name, kind) if foreign and fits else None

    def _service_part(self, info: ServiceInfo) -> tuple[Crossing, str] | None:
        name, _, kind = info.name.partition(_UNDER)
        if self._ros2 or info.encoding is not Encoding.CDR or kind not in Ros1Stage.needed:
            return None
        if kind == "cancel_goal":
            fits = info.type_name == _CANCEL_SERVICE
        else:
            fits = kind in _ENDS and ros2_action(info.type_name, _ENDS[kind]) is not None
        return self._of(name, kind) if fits else None

    def _of(self, name: str, kind: str) -> tuple[Crossing, str] | None:
        """The action of a name, if a rule is about it."""
        known = self._actions.get(TopicName(name))
        if known is None:
            rule = self._rule(name)
            if rule is None:
                return None
            if self._ros2 and self._namespace != "/":
                self._said(
                    f"action {name} is not converted: goals of ROS 1 are a topic, which needs client.namespace: "
                    '"/" at this site'
                )
                return None
            known = self._actions[TopicName(name)] = self._make(TopicName(name), rule)
        return known, kind

    def _make(self, name: TopicName, rule: Rule) -> Crossing:
        def idle() -> None:
            if name in self._actions:
                self._actions[name].settle_soon()

        def gone() -> None:
            del self._actions[name]

        stage: Ros1Stage | Ros2Stage
        if self._ros2:
            stage = Ros2Stage(name, self, answer_s=rule.answer_s, idle=idle)
        else:
            stage = Ros1Stage(name, self, idle=idle)
        return Crossing(name, stage, self, self._said, gone)

    def _rule(self, name: str) -> Rule | None:
        return next((rule for rule in self._rules if rule.match.fullmatch(name)), None)

    def _parts(self) -> list[Part]:
        return [part for action in self._actions.values() for part in action]

    # --- Passing: what is not converted -----------------------------------------------------------------------------

    def pass_topic(self, info: TopicInfo) -> Publisher:
        return self.converter.advertise(self.inner, info)

    def pass_service(self, info: ServiceInfo, handler: ServiceHandler) -> ServiceServer:
        return serve(self._services, info, handler)

    # --- Here: what a stage has at the endpoint behind, and before the bridge ---------------------------------------

    def advertise_own(self, info: TopicInfo) -> Publisher:
        """A topic of a converted action."""
        return _Own(self.pass_topic(info), info.name, self._publishers)

    def serve_own(self, info: ServiceInfo, handler: ServiceHandler) -> ServiceServer:
        """A service of a converted action."""
        return self.pass_service(info, handler)

    def announce(self, info: TopicInfo, given: Callable[[Sink | None], None]) -> Callable[[], None]:
        """Tell the bridge of a topic that no node has; what is returned ends it."""
        self._announced[info.name] = _Announced(info, given)
        if self._events is not None:
            self._events.topic_added(info)
        return partial(self._retract, info.name)

    def _retract(self, name: TopicName) -> None:
        if self._events is not None:
            self._events.topic_removed(name)
        self._announced.pop(name).given(None)

    def take(self, name: TopicName, sink_of: Callable[[TopicInfo], Sink | None]) -> Callable[[], None]:
        """Have a topic of nodes here while there is one; what is returned ends that."""
        taken = self._taken[name] = _Taken(sink_of)
        info = self._node_topics.get(name)
        if info is not None:
            self._subscribe(taken, info, known=True)
        return partial(self._give_back, name)

    def _give_back(self, name: TopicName) -> None:
        taken, info = self._taken.pop(name), self._node_topics.get(name)
        if taken.subscription is not None:
            taken.subscription.close()
            if info is not None and self._events is not None:
                self._events.topic_added(info)

    def _subscribe(self, taken: _Taken, info: TopicInfo, *, known: bool) -> bool:
        """Take it. `known`: the bridge has it. False: it is not what the action needs."""
        sink = taken.sink_of(info)
        if sink is None:
            return False
        if known and self._events is not None:
            self._events.topic_removed(info.name)
        try:
            taken.subscription = self.inner.subscribe(info.name, sink)
        except UsageError as error:
            _log.error("%s cannot be taken: %s", info.name, error)
            return True
        self.inner.interest(info.name, True)
        return True

    def node_topic_added(self, info: TopicInfo) -> None:
        """A topic of nodes here."""
        if not self._ros2 and self._is_given(info.name):
            self._node_topics[info.name] = info
            taken = self._taken.get(info.name)
            if taken is not None and (taken.subscription is not None or self._subscribe(taken, info, known=False)):
                return
        if self._events is not None:
            self._events.topic_added(info)

    def node_topic_removed(self, name: TopicName) -> None:
        """A topic of nodes here is gone."""
        self._node_topics.pop(name, None)
        taken = self._taken.get(name)
        if taken is not None and taken.subscription is not None:
            subscription, taken.subscription = taken.subscription, None
            subscription.close()
        elif self._events is not None:
            self._events.topic_removed(name)

    def _is_given(self, name: TopicName) -> bool:
        """Whether it is what clients of an action of these rules publish in ROS 1."""
        action, _, part = name.rpartition("/")
        return part in ("goal", "cancel") and self._rule(action) is not None
