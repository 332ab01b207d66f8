"""Topics that whoever connects to an endpoint publishes: there while one of them does, with all their messages."""

import logging
import time
from collections import Counter
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field

from sern_client.endpoints.base import Sink, TopicEvents
from sern_client.endpoints.common.held import HeldSubscription
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import DropReason, TopicName

MAX_TOPICS = 200
"""Of all who connect."""

_log = logging.getLogger(__name__)


@dataclass(slots=True, eq=False)
class _Topic:
    info: TopicInfo
    writers: set[Hashable] = field(default_factory=set)
    subscriptions: "list[HeldSubscription[TopicName]]" = field(default_factory=list)


class PublishedTopics:
    """`who`: what they are called in messages, such as `scenes`; `may_publish`: whether they may publish a name."""

    def __init__(self, who: str, may_publish: Callable[[str], bool], events: TopicEvents) -> None:
        self.dropped: Counter[DropReason] = Counter()
        self._who = who
        self._may_publish = may_publish
        self._events = events
        self._topics: dict[TopicName, _Topic] = {}

    @property
    def subscriptions(self) -> Counter[TopicName]:
        """How many are open, by topic."""
        return Counter({name: len(topic.subscriptions) for name, topic in self._topics.items() if topic.subscriptions})

    def subscribe(self, name: TopicName, sink: Sink) -> HeldSubscription[TopicName]:
        topic = self._topics.get(name)
        if topic is None:
            raise UsageError(f"{name}: none of the {self._who} publishes such a topic")
        subscription = HeldSubscription(sink, name, topic.subscriptions)
        topic.subscriptions.append(subscription)
        return subscription

    def begin(self, writer: Hashable, info: TopicInfo) -> None:
        """A writer is going to publish a topic. ConfigError: it may not, or another one has it as another type."""
        name = info.name
        if not self._may_publish(name):
            raise ConfigError(f"{name} may not be published from here: `publish` of this site's file does not name it")
        topic = self._topics.get(name)
        if topic is not None:
            if (topic.info.type_name, topic.info.type_hash) != (info.type_name, info.type_hash):
                raise ConfigError(f"{name} is published as {topic.info.type_name} by another of the {self._who}")
            topic.writers.add(writer)
            return
        if len(self._topics) >= MAX_TOPICS:
            raise ConfigError(f"{name}: {MAX_TOPICS} topics are published by the {self._who} already")
        self._topics[name] = _Topic(info, {writer})
        self._events.topic_added(info)
        _log.info("%s publish %s (%s)", self._who, name, info.type_name)

    def has(self, writer: Hashable, name: TopicName) -> bool:
        """Whether a writer publishes a topic."""
        topic = self._topics.get(name)
        return topic is not None and writer in topic.writers

    def end(self, writer: Hashable, name: TopicName) -> None:
        """A writer publishes a topic no more."""
        topic = self._topics.get(name)
        if topic is not None and writer in topic.writers:
            topic.writers.discard(writer)
            if not topic.writers:
                del self._topics[name]
                self._events.topic_removed(name)

    def end_all(self, writer: Hashable) -> None:
        """A writer has gone."""
        for name in list(self._topics):
            self.end(writer, name)

    def publish(self, writer: Hashable, name: TopicName, body: bytes) -> bool:
        """A message of a writer. False: it has no such topic."""
        topic = self._topics.get(name)
        if topic is None or writer not in topic.writers:
            self.dropped[DropReason.UNKNOWN_CHANNEL] += 1
            return False
        if not topic.subscriptions:
            self.dropped[DropReason.UNWANTED] += 1
        stamp_ns = time.time_ns()
        for subscription in list(topic.subscriptions):
            if not subscription.sink(body, stamp_ns):
                self.dropped[DropReason.REFUSED] += 1
        return True

    def close(self) -> None:
        for topic in self._topics.values():
            for subscription in list(topic.subscriptions):
                subscription.close()
        self._topics.clear()
