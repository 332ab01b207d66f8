"""Topics of other sites, as scenes subscribe to them.

A topic comes while a scene subscribes to it, whoever comes late to a latched one gets what holds now, and the age of a
topic is one of its own (`common/ages`).
"""

import logging
from collections import Counter, deque
from collections.abc import Callable, Iterable
from math import isnan
from typing import Final

from sern_client.endpoints.base import Viewed
from sern_client.endpoints.common.ages import SUFFIX, Ages, age_body
from sern_client.endpoints.unity.scene import Scene
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import DropReason, Encoding, TopicName
from sern_runtime import ros_types

MAX_SUBSCRIPTIONS: Final = 2_000
"""Of one connection."""
MAX_KEPT: Final = 1_000
MAX_KEPT_BYTES: Final = 32 * 2**20
"""Of one latched topic: the newest are kept; one message always is."""
AGE_TYPE: Final = "std_msgs/msg/Float32"

_log = logging.getLogger(__name__)


class Topics:
    """`scenes()`: those that are connected."""

    def __init__(self, encoding: Encoding, viewed: Viewed, scenes: Callable[[], Iterable[Scene]]) -> None:
        self.dropped: Counter[DropReason] = Counter()
        self.publishers: list[TopicPublisher] = []
        self._encoding = encoding
        self._viewed = viewed
        self._scenes = scenes
        self._offered: dict[TopicName, TopicInfo] = {}
        self._wanted: Counter[TopicName] = Counter()
        self._ages = Ages(viewed, self._show_age)

    def close(self) -> None:
        self._ages.close()

    # What there is

    def offered(self, info: TopicInfo) -> None:
        self._offered[info.name] = info

    def withdrawn(self, name: TopicName) -> None:
        self._offered.pop(name, None)

    def advertise(self, info: TopicInfo) -> "TopicPublisher":
        publisher = TopicPublisher(self, info)
        self.publishers.append(publisher)
        for scene in self._scenes():
            if info.name in scene.spelled:
                self._check(scene, info.name, scene.types.get(info.name, ""))
        return publisher

    def known(self) -> dict[TopicName, str]:
        """All topics that there are, with their types, and those of their ages."""
        found = {name: info.type_name for name, info in self._offered.items()}
        found |= {publisher.name: publisher.info.type_name for publisher in self.publishers}
        return found | {TopicName(name + SUFFIX): AGE_TYPE for name in found}

    # Who subscribes

    def subscribe(self, scene: Scene, name: TopicName, spelled: str, type_name: str) -> None:
        """A scene subscribes; also to what is not there yet."""
        if name not in scene.spelled and len(scene.spelled) >= MAX_SUBSCRIPTIONS:
            scene.error(f"{name}: {MAX_SUBSCRIPTIONS} topics are subscribed to over this connection already")
            return
        new = name not in scene.spelled
        scene.spelled[name], scene.types[name] = spelled, type_name
        self._check(scene, name, type_name)
        if not new:
            return
        self._wanted[name] += 1
        if self._wanted[name] == 1:
            self._look(name, looked=True)
        for publisher in self.publishers:
            if publisher.name == name:
                for body in publisher.kept:
                    scene.message(name, body, reliable=True)

    def unsubscribe(self, scene: Scene, name: TopicName) -> None:
        if scene.spelled.pop(name, None) is None:
            return
        scene.types.pop(name, None)
        scene.waiting.forget(name)
        self._wanted[name] -= 1
        if not self._wanted[name]:
            del self._wanted[name]
            self._look(name, looked=False)

    def gone(self, scene: Scene) -> None:
        for name in list(scene.spelled):
            self.unsubscribe(scene, name)

    def _look(self, name: TopicName, *, looked: bool) -> None:
        if name.endswith(SUFFIX):
            self._ages.look(TopicName(name.removesuffix(SUFFIX)), looked)
        else:
            self._viewed.want(name, looked)

    def _check(self, scene: Scene, name: TopicName, type_name: str) -> None:
        """Tell a scene that it reads a topic as what it is not."""
        there = self.known().get(name)
        if there is not None and ros_types.canonical(there) != type_name:
            scene.error(f"{name} is {there}, and the scene subscribes to it as {type_name}")
        elif there is None and ros_types.describe(type_name, self._encoding) is None:
            scene.error(f"{name}: the type {type_name} is not known here, and no site has such a topic")

    # What comes

    def show(self, publisher: "TopicPublisher", body: bytes) -> None:
        reliable = publisher.info.reliable is not False or publisher.info.latched
        for scene in self._scenes():
            scene.message(publisher.name, body, reliable=reliable)

    def ended(self, publisher: "TopicPublisher") -> None:
        self.publishers.remove(publisher)

    def _show_age(self, name: TopicName, age_s: float) -> None:
        if not isnan(age_s):  # a scene has no use for an age that is not known
            body = age_body(age_s, self._encoding)
            for scene in self._scenes():
                scene.message(TopicName(name + SUFFIX), body, reliable=False)


class TopicPublisher:
    """A `Publisher` of what comes from another site."""

    def __init__(self, owner: Topics, info: TopicInfo) -> None:
        self.info = info
        self.name = info.name
        self.kept: deque[bytes] = deque()
        self._depth = min(info.depth or 1, MAX_KEPT) if info.latched else 0
        self._kept_bytes = 0
        self._owner = owner
        self._closed = False

    def publish(self, body: bytes, stamp_ns: int) -> None:
        del stamp_ns
        if self._closed:
            self._owner.dropped[DropReason.DISCONNECTED] += 1
            return
        if self._depth:
            self._keep(body)
        self._owner.show(self, body)

    def _keep(self, body: bytes) -> None:
        self.kept.append(body)
        self._kept_bytes += len(body)
        while len(self.kept) > 1 and (len(self.kept) > self._depth or self._kept_bytes > MAX_KEPT_BYTES):
            self._kept_bytes -= len(self.kept.popleft())

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            self.kept.clear()
            self._owner.ended(self)


def type_of(message_name: str, kind: str) -> str:
    """`std_msgs/String`, as scenes write types, as it is called here; `kind`: msg or srv. ConfigError: it is none."""
    parts = message_name.split("/")
    if len(parts) == 2 and all(part.isidentifier() for part in parts):
        return f"{parts[0]}/{kind}/{parts[1]}"
    if len(parts) == 3 and parts[1] == kind and parts[0].isidentifier() and parts[2].isidentifier():
        return message_name
    raise ConfigError(f"{message_name[:80]!r} is no type, such as std_msgs/String")
