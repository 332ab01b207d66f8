"""Topics that scenes publish. A topic of two scenes is one, as with two nodes of ROS: what both say goes out."""

import asyncio
import logging
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final

from sern_client.endpoints.base import Sink, TopicEvents
from sern_client.endpoints.common.interest import OnDemand, Subscriptions
from sern_client.endpoints.common.saying import SayOnce
from sern_client.endpoints.unity import names
from sern_client.endpoints.unity.commands import Command, shown
from sern_client.endpoints.unity.faults import Fault, Faults
from sern_client.endpoints.unity.scene import Scene
from sern_client.endpoints.unity.types import SceneTypes
from sern_core.topics.patterns import PatternSet
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import DropReason, TopicName

MAX_PUBLICATIONS: Final = 1000
"""Topics that one scene may publish."""

_log = logging.getLogger(__name__)

_Taken = Callable[[bytes, int], None]


@dataclass(slots=True, eq=False)
class _Topic:
    info: TopicInfo
    spellings: dict[Scene, set[str]] = field(default_factory=dict)
    taking: list[_Taken] = field(default_factory=list)
    last: tuple[bytes, int] | None = None
    """The last message of a latched topic."""


class Publications:
    """`allowed`: patterns of local names that a scene may publish."""

    def __init__(self, allowed: Sequence[str], types: SceneTypes, faults: Faults, drops: Counter[DropReason]) -> None:
        self.subscriptions: Subscriptions[OnDemand] = Subscriptions(SayOnce(_log))
        self._allowed = PatternSet(allowed)
        self._types = types
        self._faults = faults
        self._drops = drops
        self._events: TopicEvents | None = None
        self._topics: dict[TopicName, _Topic] = {}
        self._of_scenes: dict[Scene, dict[str, _Topic]] = {}

    def start(self, events: TopicEvents) -> None:
        self._events = events

    def close(self) -> None:
        """Nothing is announced any more."""
        self._events = None
        self.subscriptions.close()

    def __iter__(self) -> Iterator[tuple[TopicName, str]]:
        """All that scenes publish, and their types."""
        return ((name, topic.info.type_name) for name, topic in self._topics.items())

    # --- of scenes --------------------------------------------------------------------------------------------------

    def publish(self, scene: Scene, command: Command) -> None:
        of_scene = self._of_scenes.setdefault(scene, {})
        if command.topic in of_scene:
            known = of_scene[command.topic].info.type_name
            if not names.same_type(known, command.type_name):
                self._refuse_type(scene, of_scene[command.topic].info, command)
            return
        try:
            name, type_name = names.local_name(command.topic), names.our_type(command.type_name)
        except ConfigError as error:
            self._faults(Fault.NAME, f"cannot publish: {error}", scene)
            return
        if not self._allowed.fullmatch(name):
            text = f"a scene may not publish {name}: name it under publish of the unity endpoint, in the client's file"
            self._faults(Fault.NOT_ALLOWED, text, scene)
            return
        if len(of_scene) >= MAX_PUBLICATIONS:
            self._faults(Fault.TOO_MANY, f"cannot publish more than {MAX_PUBLICATIONS} topics", scene)
            return
        topic = self._topics.get(name)
        if topic is not None and not names.same_type(topic.info.type_name, type_name):
            self._refuse_type(scene, topic.info, command)
            return
        if topic is None:
            topic = self._announce(scene, name, type_name, latched=command.latch)
            if topic is None:
                return
        elif scene not in topic.spellings:
            _log.info("%s: %d scenes publish it; what they say goes out as one topic", name, len(topic.spellings) + 1)
        topic.spellings.setdefault(scene, set()).add(command.topic)
        of_scene[command.topic] = topic

    def publishes(self, scene: Scene, spelling: str) -> bool:
        return spelling in self._of_scenes.get(scene, ())

    def message(self, scene: Scene, spelling: str, body: bytes) -> None:
        """A message of a topic that the scene publishes."""
        topic = self._of_scenes[scene][spelling]
        if not self._types.is_body(body):
            self._drops[DropReason.UNDECODABLE] += 1
            text = f"{topic.info.name}: a message of {len(body)} bytes is no body of {self._types.encoding}; dropped"
            self._faults(Fault.BODY, text, scene)
            return
        stamp_ns = time.time_ns()
        if topic.info.latched:
            topic.last = body, stamp_ns
        for take in list(topic.taking):
            take(body, stamp_ns)

    def remove(self, scene: Scene, spelling: str) -> None:
        topic = self._of_scenes.get(scene, {}).pop(spelling, None)
        if topic is None:
            return
        spellings = topic.spellings[scene]
        spellings.discard(spelling)
        if not spellings:
            del topic.spellings[scene]
        if not topic.spellings:
            del self._topics[topic.info.name]
            if self._events is not None:
                self._events.topic_removed(topic.info.name)

    def gone(self, scene: Scene) -> None:
        for spelling in list(self._of_scenes.get(scene, ())):
            self.remove(scene, spelling)
        self._of_scenes.pop(scene, None)

    def _announce(self, scene: Scene, name: TopicName, type_name: str, *, latched: bool) -> _Topic | None:
        try:
            known = self._types.message(type_name)
        except ConfigError as error:
            self._faults(Fault.UNKNOWN_TYPE, f"cannot publish {name}: {error}", scene)
            return None
        info = TopicInfo(name, type_name, self._types.encoding, known.type_hash, known.definition, latched)
        topic = self._topics[name] = _Topic(info)
        if self._events is not None:
            self._events.topic_added(info)
        return topic

    def _refuse_type(self, scene: Scene, there: TopicInfo, command: Command) -> None:
        text = (
            f"{there.name}: the scene publishes {shown(command.type_name)}, and {names.their_type(there.type_name)} is "
            "published by that name already; it is not taken"
        )
        self._faults(Fault.OTHER_TYPE, text, scene)

    # --- of the bridge ----------------------------------------------------------------------------------------------

    def subscribe(self, name: TopicName, sink: Sink) -> OnDemand:
        topic = self._topics.get(name)
        if topic is None:
            raise UsageError(f"{name}: no such topic was announced")
        return self.subscriptions.add(OnDemand(topic.info, sink, self._receive, self.subscriptions.remove))

    def _receive(self, info: TopicInfo, arrived: _Taken) -> Callable[[], None]:
        topic = self._topics.get(info.name)
        if topic is None:  # it went, and the bridge has yet to close its subscription
            return lambda: None
        topic.taking.append(arrived)
        if topic.last is not None:
            asyncio.get_running_loop().call_soon(arrived, *topic.last)
        return lambda: topic.taking.remove(arrived)
