"""What viewers publish: a topic of this site while one of them does, with its messages as any other endpoint's.

Who may is the file's word (`publish`); what becomes of it is the matter of rules, leases and the relay, as of all that
a site sends. Messages in JSON become bodies here; others pass as they are.
"""

import logging
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from sern_client.endpoints.base import Sink, TopicEvents
from sern_client.endpoints.common.held import HeldSubscription
from sern_client.endpoints.foxglove.frames import Fault
from sern_client.endpoints.foxglove.news import WARNING, News
from sern_client.endpoints.foxglove.server import Advertised
from sern_core.vocabulary.errors import BodyError, ConfigError, UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.names import topic_name
from sern_core.vocabulary.types import DropReason, Encoding, TopicName
from sern_runtime import ros_json, ros_types
from sern_runtime.ros_types import ResolvedType

JSON: Final = "json"
ENCODINGS: Final = (JSON, "cdr", "ros1")
"""What viewers may publish in. They take the first that they can write, and JSON is the one for which they need to know
nothing of a type."""
MAX_TOPICS: Final = 200
"""Topics that all viewers together may publish."""
_STATUS: Final = "sern/publish"

_log = logging.getLogger(__name__)


@dataclass(slots=True, eq=False)
class _Published:
    """A topic that viewers publish."""

    info: TopicInfo
    kind: ResolvedType
    writers: set[tuple[int, int]] = field(default_factory=set)
    subscriptions: "list[HeldSubscription[TopicName]]" = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class _Writer:
    """A viewer's channel. `topic` None: it was refused, and `refused` says why. The viewer is told when it sends
    something: a 3D panel announces goals as soon as it is open."""

    name: str
    topic: _Published | None
    json: bool = False
    refused: "_RefusedError | None" = None


class _RefusedError(Exception):
    def __init__(self, fault: Fault, problem: str) -> None:
        super().__init__(problem)
        self.fault = fault


class Publishing:
    """`may_publish` says whether a name may be published; `encoding` is that of messages in JSON; `fault` counts and
    says what a viewer did wrong."""

    def __init__(
        self,
        may_publish: Callable[[str], bool],
        encoding: Encoding,
        events: TopicEvents,
        news: News,
        fault: Callable[[Fault, str], None],
    ) -> None:
        self.dropped: Counter[DropReason] = Counter()
        self._may_publish = may_publish
        self._encoding = encoding
        self._events = events
        self._news = news
        self._fault = fault
        self._topics: dict[TopicName, _Published] = {}
        self._writers: dict[tuple[int, int], _Writer] = {}

    @property
    def subscriptions(self) -> Counter[TopicName]:
        """How many are open, by topic."""
        return Counter({name: len(topic.subscriptions) for name, topic in self._topics.items() if topic.subscriptions})

    def subscribe(self, name: TopicName, sink: Sink) -> HeldSubscription[TopicName]:
        topic = self._topics.get(name)
        if topic is None:
            raise UsageError(f"{name}: no viewer publishes such a topic")
        subscription = HeldSubscription(sink, name, topic.subscriptions)
        topic.subscriptions.append(subscription)
        return subscription

    def advertised(self, client: int, said: Advertised) -> None:
        """A viewer is going to publish."""
        key = client, said.number
        self.unadvertised(*key)
        try:
            topic = self._topic(said)
        except _RefusedError as error:
            self._writers[key] = _Writer(said.topic, None, refused=error)
            return
        self._writers[key] = _Writer(said.topic, topic, json=said.encoding == JSON)
        topic.writers.add(key)
        if len(topic.writers) == 1:
            self._events.topic_added(topic.info)
            _log.info("viewers publish %s (%s)", topic.info.name, topic.info.type_name)

    def unadvertised(self, client: int, number: int) -> None:
        """A viewer publishes there no more."""
        key = client, number
        writer = self._writers.pop(key, None)
        if writer is None:
            return
        if not any(each.name == writer.name for each in self._writers.values()):
            self._news.take_back([_status(writer.name)])
        if writer.topic is not None:
            writer.topic.writers.discard(key)
            if not writer.topic.writers:
                del self._topics[writer.topic.info.name]
                self._events.topic_removed(writer.topic.info.name)

    def published(self, client: int, number: int, body: bytes) -> None:
        """A message of a viewer."""
        writer = self._writers.get((client, number))
        if writer is None or writer.topic is None:
            self.dropped[DropReason.UNKNOWN_CHANNEL] += 1
            if writer is not None and writer.refused is not None:
                text = f"{writer.name[:255]} is not published: {writer.refused}"
                self._fault(writer.refused.fault, f"a viewer is told: {text}")
                self._news.say(_status(writer.name), text)
                self._writers[client, number] = _Writer(writer.name, None)  # it is told once
            return
        topic = writer.topic
        if writer.json:
            try:
                body = ros_json.body_of(topic.kind, body)
            except (BodyError, ConfigError) as error:
                self.dropped[DropReason.UNDECODABLE] += 1
                text = f"{writer.name}: a message was not sent: {error}"
                self._fault(Fault.MESSAGE, f"a viewer is told: {text}")
                self._news.say(_status(writer.name), text)
                return
        if not topic.subscriptions:
            self.dropped[DropReason.UNWANTED] += 1
            text = f"{writer.name}: nothing of this site's file sends it, so it stays here"
            self._news.say(_status(writer.name), text, WARNING)
        stamp_ns = time.time_ns()
        for subscription in list(topic.subscriptions):
            if not subscription.sink(body, stamp_ns):
                self.dropped[DropReason.REFUSED] += 1

    def close(self) -> None:
        for topic in self._topics.values():
            for subscription in list(topic.subscriptions):
                subscription.close()
        self._topics.clear()
        self._writers.clear()

    def _topic(self, said: Advertised) -> _Published:
        try:
            name = topic_name(said.topic)
        except UsageError as error:
            raise _RefusedError(Fault.TOPIC, str(error)) from None
        if not self._may_publish(name):
            raise _RefusedError(Fault.TOPIC, "`publish` of this site's file does not name it")
        if said.encoding not in ENCODINGS:
            raise _RefusedError(
                Fault.TYPE, f"{said.encoding[:40]!r} is no encoding that is taken; {', '.join(ENCODINGS)}"
            )
        encoding = self._encoding if said.encoding == JSON else Encoding(said.encoding)
        try:
            # What comes with JSON is no definition of ROS.
            kind = ros_types.resolve(said.type_name, "" if said.encoding == JSON else said.definition, encoding)
        except ConfigError as error:
            raise _RefusedError(Fault.TYPE, str(error)) from None
        known = self._topics.get(name)
        if known is not None:
            if (known.kind.name, known.kind.encoding, known.kind.text) != (kind.name, kind.encoding, kind.text):
                raise _RefusedError(
                    Fault.TYPE, f"another viewer publishes it as {known.kind.name} ({known.kind.encoding})"
                )
            return known
        if len(self._topics) >= MAX_TOPICS:
            raise _RefusedError(Fault.TOPIC, f"viewers publish {MAX_TOPICS} topics already")
        info = TopicInfo(name, kind.name, kind.encoding, kind.text.type_hash, kind.text.definition)
        topic = self._topics[name] = _Published(info, kind)
        return topic


def _status(topic: str) -> str:
    return f"{_STATUS}{topic[:255]}"
