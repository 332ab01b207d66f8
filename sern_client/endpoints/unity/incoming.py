"""Topics of other sites, for the scenes that subscribe to them.

A scene may subscribe before a topic is there, and goes on being subscribed when it goes and comes again. What is wanted
is told for the topic, not for each scene: while any scene with a fitting type is subscribed to it.
"""

import logging
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Final

from sern_client.endpoints.base import Viewed
from sern_client.endpoints.common.ages import SUFFIX as AGE_SUFFIX
from sern_client.endpoints.common.ages import TYPE as AGE_TYPE
from sern_client.endpoints.unity import names
from sern_client.endpoints.unity.ages import AgeWatch, AgeWatches
from sern_client.endpoints.unity.commands import Command, shown
from sern_client.endpoints.unity.faults import Fault, Faults
from sern_client.endpoints.unity.frames import frame
from sern_client.endpoints.unity.outbox import ALL, NEWEST, SOME, Keep
from sern_client.endpoints.unity.scene import Scene
from sern_client.tf_latch import TF_TYPE, TfLatch, is_static_tf
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import DropReason, Encoding, TopicName

MAX_SUBSCRIPTIONS: Final = 4000
"""Subscriptions that one scene may have."""

_log = logging.getLogger(__name__)


@dataclass(slots=True, eq=False)
class _Subscribed:
    """A scene's subscription to a topic, as it spells it. `watch`: it is to the age of one."""

    scene: Scene
    name: TopicName
    spelling: str
    type_name: str
    watch: AgeWatch | None = None


class SceneStream:
    """The `Publisher` of one stream that comes."""

    def __init__(self, info: TopicInfo, owner: "Incoming") -> None:
        self.info = info
        self.closed = False
        reliable = info.latched if info.reliable is None else info.reliable
        # Each message of /tf is about other frames than the one before.
        self.keep: Keep = ALL if reliable else SOME if info.type_name == TF_TYPE else NEWEST
        self._owner = owner
        self._static = TfLatch(info.encoding) if is_static_tf(info.name, info.type_name) else None
        self._last: bytes | None = None

    @property
    def latched(self) -> bytes | None:
        """What a late subscriber gets."""
        if self._static is not None and len(self._static):
            return self._static.merged()
        return self._last

    def publish(self, body: bytes, stamp_ns: int) -> None:
        del stamp_ns  # the protocol carries no time beside the message
        if self.closed:
            self._owner.drops[DropReason.DISCONNECTED] += 1
            return
        if self.info.latched or self._static is not None:
            self._latch(body)
        self._owner.give(self, body)

    def close(self) -> None:
        """What was published before still leaves."""
        if not self.closed:
            self.closed = True
            self._owner.closed(self)

    def _latch(self, body: bytes) -> None:
        if self._static is not None:
            try:
                self._static.keep(self, body)
                return
            except ConfigError as error:
                _log.debug("%s: cannot be merged for late subscribers: %s", self.info.name, error)
        self._last = body


@dataclass(slots=True)
class _Topic:
    offered: TopicInfo | None = None
    streams: list[SceneStream] = field(default_factory=list)
    subscribed: dict[tuple[Scene, str], _Subscribed] = field(default_factory=dict)
    wanted: bool = False

    @property
    def type_name(self) -> str | None:
        """The type of what there is now; None: it is not there."""
        if self.streams:
            return self.streams[0].info.type_name
        return None if self.offered is None else self.offered.type_name

    @property
    def empty(self) -> bool:
        return self.offered is None and not self.streams and not self.subscribed


class Incoming:
    """`knows` says whether a type is known here without a topic that brings it."""

    def __init__(
        self, encoding: Encoding, faults: Faults, drops: Counter[DropReason], knows: Callable[[str], bool]
    ) -> None:
        self.drops = drops
        self.viewed: Viewed | None = None
        self._encoding = encoding
        self._faults = faults
        self._knows = knows
        self._topics: dict[TopicName, _Topic] = {}
        self._of_scenes: dict[Scene, dict[str, _Subscribed]] = {}
        self._ages = AgeWatches(encoding, lambda: () if self.viewed is None else self.viewed.topics())

    # --- what other sites have --------------------------------------------------------------------------------------

    def offered(self, info: TopicInfo) -> None:
        topic = self._topics.setdefault(info.name, _Topic())
        topic.offered = info
        self._changed(info.name, topic)

    def withdrawn(self, name: TopicName) -> None:
        topic = self._topics.get(name)
        if topic is not None:
            topic.offered = None
            topic.wanted = False
            self._changed(name, topic)
            self._tidy(name, topic)

    def advertise(self, info: TopicInfo) -> SceneStream:
        """ConfigError when the bodies are of the other ROS, or another stream of the name is of another type."""
        if info.encoding is not self._encoding:
            raise ConfigError(f"{info.name}: {info.encoding} messages cannot be read by a scene of {self._encoding}")
        topic = self._topics.setdefault(info.name, _Topic())
        if topic.streams and not names.same_type(topic.streams[0].info.type_name, info.type_name):
            there = topic.streams[0].info.type_name
            raise ConfigError(f"{info.name}: what comes is {info.type_name}, and {there} comes under that name already")
        stream = SceneStream(info, self)
        topic.streams.append(stream)
        self._changed(info.name, topic)
        return stream

    def closed(self, stream: SceneStream) -> None:
        topic = self._topics[stream.info.name]
        topic.streams.remove(stream)
        self._changed(stream.info.name, topic)
        self._tidy(stream.info.name, topic)

    def give(self, stream: SceneStream, body: bytes) -> None:
        """A message of a stream, to all that are subscribed to it."""
        for subscribed in self._topics[stream.info.name].subscribed.values():
            if names.same_type(subscribed.type_name, stream.info.type_name):
                self._put(subscribed, stream, body, stream.keep)

    @property
    def publishers(self) -> Counter[TopicName]:
        return Counter({name: len(topic.streams) for name, topic in self._topics.items() if topic.streams})

    def __iter__(self) -> Iterator[tuple[TopicName, str]]:
        """All topics that there are, and their types."""
        for name, topic in self._topics.items():
            if topic.type_name is not None:
                yield name, topic.type_name

    # --- what scenes want -------------------------------------------------------------------------------------------

    def subscribe(self, scene: Scene, command: Command) -> None:
        of_scene = self._of_scenes.setdefault(scene, {})
        try:
            name, type_name = names.local_name(command.topic), names.our_type(command.type_name)
        except ConfigError as error:
            self._faults(Fault.NAME, f"cannot subscribe: {error}", scene)
            return
        if command.topic not in of_scene and len(of_scene) >= MAX_SUBSCRIPTIONS:
            self._faults(Fault.TOO_MANY, f"cannot subscribe to more than {MAX_SUBSCRIPTIONS} topics", scene)
            return
        earlier = of_scene.get(command.topic)
        if earlier is not None and earlier.type_name == type_name:
            return
        self.unsubscribe(scene, command.topic)
        subscribed = of_scene[command.topic] = _Subscribed(scene, name, command.topic, type_name)
        topic = self._topics.setdefault(name, _Topic())
        topic.subscribed[scene, command.topic] = subscribed
        if self._judge_age(subscribed, topic):
            return
        if topic.type_name is None and not self._knows(type_name):
            self._faults(
                Fault.UNKNOWN_TYPE,
                f"{name}: the type {shown(names.their_type(type_name))} is not known here, and no site has the topic "
                "yet; it comes when one has",
                scene,
            )
        self._check(subscribed, topic)
        self._want(name, topic)
        for stream in topic.streams:
            self._give_latched(subscribed, stream)

    def unsubscribe(self, scene: Scene, spelling: str) -> None:
        subscribed = self._of_scenes.get(scene, {}).pop(spelling, None)
        if subscribed is None:
            return
        if subscribed.watch is not None:
            subscribed.watch.close()
            scene.outbox.forget(subscribed, DropReason.UNWANTED)
        topic = self._topics[subscribed.name]
        del topic.subscribed[scene, spelling]
        for stream in topic.streams:
            scene.outbox.forget((subscribed, stream), DropReason.UNWANTED)
        self._want(subscribed.name, topic)
        self._tidy(subscribed.name, topic)

    def gone(self, scene: Scene) -> None:
        for spelling in list(self._of_scenes.get(scene, ())):
            self.unsubscribe(scene, spelling)
        self._of_scenes.pop(scene, None)

    def close(self) -> None:
        self._ages.close()

    # --- both together ----------------------------------------------------------------------------------------------

    def _changed(self, name: TopicName, topic: _Topic) -> None:
        """The topic may be of another type than before."""
        for subscribed in topic.subscribed.values():
            self._judge_age(subscribed, topic)
            self._check(subscribed, topic)
        self._want(name, topic)

    def _check(self, subscribed: _Subscribed, topic: _Topic) -> None:
        there = topic.type_name
        if there is not None and not names.same_type(there, subscribed.type_name):
            self._faults(
                Fault.OTHER_TYPE,
                f"{subscribed.name}: the scene subscribes to {shown(names.their_type(subscribed.type_name))}, the "
                f"topic is {names.their_type(there)}; it is not sent",
                subscribed.scene,
            )

    def _want(self, name: TopicName, topic: _Topic) -> None:
        offered = topic.offered
        if offered is None:
            return
        wanted = any(names.same_type(each.type_name, offered.type_name) for each in topic.subscribed.values())
        if wanted is not topic.wanted:
            topic.wanted = wanted
            if self.viewed is not None:
                self.viewed.want(name, wanted)

    def _tidy(self, name: TopicName, topic: _Topic) -> None:
        if topic.empty and self._topics.get(name) is topic:
            del self._topics[name]

    def _give_latched(self, subscribed: _Subscribed, stream: SceneStream) -> None:
        body = stream.latched
        if body is not None and names.same_type(subscribed.type_name, stream.info.type_name):
            self._put(subscribed, stream, body, stream.keep)

    def _put(self, subscribed: _Subscribed, stream: SceneStream, body: bytes, keep: Keep) -> None:
        subscribed.scene.outbox.put((subscribed, stream), frame(subscribed.spelling, body), keep)
        subscribed.scene.wake()

    # --- ages -------------------------------------------------------------------------------------------------------

    def _judge_age(self, subscribed: _Subscribed, topic: _Topic) -> bool:
        """Whether a subscription is to the age of a topic, and no topic of its own."""
        if topic.type_name is not None or not subscribed.name.endswith(AGE_SUFFIX):
            if subscribed.watch is not None:
                subscribed.watch.close()
                subscribed.watch = None
            return False
        if subscribed.watch is None:
            self._watch_age(subscribed)
        return True

    def _watch_age(self, subscribed: _Subscribed) -> None:
        if not names.same_type(subscribed.type_name, AGE_TYPE):
            asked = shown(names.their_type(subscribed.type_name))
            text = f"{subscribed.name}: the scene subscribes to {asked}, ages are {names.their_type(AGE_TYPE)}"
            self._faults(Fault.OTHER_TYPE, text, subscribed.scene)
            return

        def told(body: bytes) -> None:
            subscribed.scene.outbox.put(subscribed, frame(subscribed.spelling, body), NEWEST)
            subscribed.scene.wake()

        aged = TopicName(subscribed.name.removesuffix(AGE_SUFFIX))
        subscribed.watch = self._ages.watch(aged, told)
