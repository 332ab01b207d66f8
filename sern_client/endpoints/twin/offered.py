"""Topics that the client of the twins makes itself and offers to all sites, such as the map of its scene."""

import asyncio
from collections import Counter
from collections.abc import Set
from dataclasses import dataclass, field

from sern_client.endpoints.base import Held, Sink, TopicEvents
from sern_client.endpoints.common.held import HeldSubscription
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import DropReason, TopicName


@dataclass(slots=True, eq=False)
class _Topic:
    info: TopicInfo
    subscriptions: "list[HeldSubscription[_Topic]]" = field(default_factory=list)
    last: tuple[bytes, int] | None = None
    """The last message of a latched topic, for who comes late."""


class Offered:
    """`taken`: names that are not to be had."""

    def __init__(self, taken: Set[TopicName]) -> None:
        self._taken = taken
        self._topics: dict[TopicName, _Topic] = {}
        self._events: TopicEvents | None = None
        self.drops: Counter[DropReason] = Counter()

    def __contains__(self, name: TopicName) -> bool:
        return name in self._topics

    def announce(self, events: TopicEvents) -> None:
        """Announce what there is, and what comes from now on."""
        self._events = events
        for topic in self._topics.values():
            events.topic_added(topic.info)

    def offer(self, info: TopicInfo) -> "OfferedPublisher":
        """ConfigError: there is such a topic."""
        if info.name in self._taken or info.name in self._topics:
            raise ConfigError(f"{info.name}: the twins have such a topic already: give it another name")
        self._topics[info.name] = _Topic(info)
        if self._events is not None:
            self._events.topic_added(info)
        return OfferedPublisher(self, info.name)

    def subscribe(self, name: TopicName, sink: Sink) -> "HeldSubscription[_Topic]":
        topic = self._topics.get(name)
        if topic is None:
            raise UsageError(f"{name}: nobody offers it")
        subscription = HeldSubscription(sink, topic, topic.subscriptions)
        topic.subscriptions.append(subscription)
        if topic.last is not None:
            asyncio.get_running_loop().call_soon(self._give_last, subscription)
        return subscription

    def publish(self, name: TopicName, body: bytes, stamp_ns: int) -> None:
        topic = self._topics.get(name)
        if topic is None:
            return
        if topic.info.latched:
            topic.last = (body, stamp_ns)
        for subscription in list(topic.subscriptions):
            self._give(subscription, body, stamp_ns)

    def withdraw(self, name: TopicName) -> None:
        topic = self._topics.pop(name, None)
        if topic is None:
            return
        for subscription in list(topic.subscriptions):
            subscription.close()
        if self._events is not None:
            self._events.topic_removed(name)

    def close(self) -> None:
        for topic in self._topics.values():
            for subscription in list(topic.subscriptions):
                subscription.close()

    @property
    def held(self) -> Held:
        return Held(
            Counter(self._topics.keys()),
            Counter({name: len(topic.subscriptions) for name, topic in self._topics.items() if topic.subscriptions}),
        )

    def _give_last(self, subscription: "HeldSubscription[_Topic]") -> None:
        if not subscription.closed and subscription.topic.last is not None:
            self._give(subscription, *subscription.topic.last)

    def _give(self, subscription: "HeldSubscription[_Topic]", body: bytes, stamp_ns: int) -> None:
        if not subscription.sink(body, stamp_ns):
            self.drops[DropReason.REFUSED] += 1


@dataclass(frozen=True, slots=True)
class OfferedPublisher:
    """A `Publisher` of one topic that is offered."""

    topics: Offered
    name: TopicName

    def publish(self, body: bytes, stamp_ns: int) -> None:
        self.topics.publish(self.name, body, stamp_ns)

    def close(self) -> None:
        self.topics.withdraw(self.name)
