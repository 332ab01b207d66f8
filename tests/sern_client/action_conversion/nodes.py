"""The nodes of a site under the test's hand, behind an `ActionEndpoint`, and the bridge before it."""

import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any, Final

from sern_client.action_conversion.endpoint import ActionEndpoint, Rule
from sern_client.endpoints.base import (
    Difference,
    Held,
    Publisher,
    ServiceEvents,
    ServiceHandler,
    ServiceInfo,
    ServiceServer,
    Sink,
    TopicEvents,
)
from sern_core.topics.patterns import compile_pattern
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import ros_types
from tests.sern_client.action_conversion.files import FIBONACCI, files
from tests.support import Events

ACTION: Final = TopicName("/robot1/count")


class Open:
    """A publisher or server that is open at the nodes."""

    def __init__(self, info: Any, table: dict[TopicName, "Open"], handler: ServiceHandler | None = None) -> None:
        self.info = info
        self.bodies: list[bytes] = []
        self.handler = handler
        self._table = table
        table[info.name] = self

    def publish(self, body: bytes, stamp_ns: int) -> None:
        assert stamp_ns > 10**18
        self.bodies.append(body)

    def close(self) -> None:
        if self._table.get(self.info.name) is self:
            del self._table[self.info.name]


class Taken:
    def __init__(self, nodes: "Nodes", name: TopicName, sink: Sink) -> None:
        self.sink = sink
        self._nodes = nodes
        self._name = name
        assert name not in nodes.sinks, "taken twice"
        nodes.sinks[name] = self

    def close(self) -> None:
        self._nodes.sinks.pop(self._name, None)


class Nodes:
    """An `Endpoint` and `ServiceEndpoint` of one encoding. What is in `refusals` is raised for a name."""

    exhausted = False

    def __init__(self, encoding: Encoding) -> None:
        self.encoding: Encoding | None = encoding
        self.published: dict[TopicName, Open] = {}
        self.served: dict[TopicName, Open] = {}
        self.sinks: dict[TopicName, Taken] = {}
        self.interests: dict[TopicName, bool] = {}
        self.refusals: dict[str, Exception] = {}
        self.events: TopicEvents | None = None
        self.known: set[TopicName] = set()
        self.held = Held()

    async def start(self, events: TopicEvents) -> None:
        self.events = events

    async def stop(self) -> None:
        assert not self.published and not self.served and not self.sinks, "nothing of ours is left"

    def add(self, info: TopicInfo) -> None:
        assert self.events is not None
        self.known.add(info.name)
        self.events.topic_added(info)

    def remove(self, name: TopicName) -> None:
        assert self.events is not None
        self.known.discard(name)
        self.events.topic_removed(name)

    def subscribe(self, name: TopicName, sink: Sink) -> Taken:
        if name not in self.known:
            raise UsageError(f"{name}: no such topic")
        return Taken(self, name, sink)

    def advertise(self, info: TopicInfo) -> Publisher:
        if info.name in self.refusals:
            raise self.refusals[info.name]
        assert info.encoding is self.encoding and info.name not in self.published
        return Open(info, self.published)

    def interest(self, name: TopicName, wanted: bool) -> None:
        self.interests[name] = wanted

    def validate(self, held: Held) -> list[Difference]:
        self.held = held
        return []

    def watch_services(self, events: ServiceEvents) -> None:
        del events

    async def call(self, name: TopicName, request: bytes, *, timeout_s: float) -> bytes:
        del timeout_s
        return name.encode() + request

    def serve(self, info: ServiceInfo, handler: ServiceHandler) -> ServiceServer:
        if info.name in self.refusals:
            raise self.refusals[info.name]
        assert info.encoding is self.encoding and info.name not in self.served
        return Open(info, self.served, handler)


class Site:
    """`endpoint` between the nodes and the bridge, whose place the test takes: `events` is what it is told."""

    def __init__(self, encoding: Encoding, place: Path, *, namespace: str = "/", **actions: str) -> None:
        self.nodes = Nodes(encoding)
        self.events = Events()
        known = files(place, **(actions or {"count__Count": FIBONACCI}))
        rules = [Rule(compile_pattern("/robot1/.*"), 10.0)]
        self.endpoint = ActionEndpoint(self.nodes, self.nodes, encoding, rules, namespace=namespace, files=known)
        self.given: dict[TopicName, list[bytes]] = {}
        """What nodes here have given to the link, by topic."""
        self.accepts = True

    async def start(self) -> "Site":
        await self.endpoint.start(self.events)
        return self

    def take(self, name: str) -> Any:
        """Subscribe as the bridge does."""
        bodies = self.given.setdefault(TopicName(name), [])

        def sink(body: bytes, stamp_ns: int) -> bool:
            assert stamp_ns > 10**18
            bodies.append(body)
            return self.accepts

        return self.endpoint.subscribe(TopicName(name), sink)

    def call(self, part: str) -> Callable[[bytes], Awaitable[bytes]]:
        """A service of the action as nodes of ROS 2 have it."""
        handler = self.nodes.served[TopicName(f"{ACTION}/_action/{part}")].handler
        assert handler is not None
        return handler


def publish(publisher: Publisher, body: bytes) -> None:
    publisher.publish(body, time.time_ns())


def ros1_topic(part: str, type_name: str, text: ros_types.TypeText | None = None) -> TopicInfo:
    if text is None:
        text = ros_types.describe(type_name, Encoding.ROS1)
        assert text is not None
    return TopicInfo(TopicName(f"{ACTION}/{part}"), type_name, Encoding.ROS1, text.type_hash, text.definition)


def refuse(nodes: Nodes, name: str, why: str) -> None:
    nodes.refusals[name] = ConfigError(why)
