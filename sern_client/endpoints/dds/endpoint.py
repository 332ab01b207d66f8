"""The `dds` endpoint: what a ROS 2 domain publishes goes to the link, what comes from the link is published there.

What another SERN endpoint publishes in the same domain came over a link already and is not offered again, so that two
of them beside each other make no loop; they know each other by the USER_DATA of their participants. `accept_bridged`
turns that off, for a chain of two links with a domain in the middle.
"""

import asyncio
import logging
from collections import Counter
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Final
from uuid import UUID

from sern_client.endpoints.base import (
    GUARD_SUFFIX,
    Difference,
    Held,
    ServiceEvents,
    ServiceHandler,
    ServiceInfo,
    Sink,
    TopicEvents,
)
from sern_client.endpoints.common.first_messages import LEARN_S, MAX_FIRST_MESSAGES, FirstMessages
from sern_client.endpoints.common.interest import Subscriptions
from sern_client.endpoints.common.saying import SayOnce
from sern_client.endpoints.common.stream import Stream, Streams
from sern_client.endpoints.dds import names
from sern_client.endpoints.dds.counters import DdsCounters
from sern_client.endpoints.dds.definitions import Definitions
from sern_client.endpoints.dds.domain import DomainOptions
from sern_client.endpoints.dds.entities import Entities, Writer
from sern_client.endpoints.dds.graph import Graph, Remote
from sern_client.endpoints.dds.names import RosName
from sern_client.endpoints.dds.qos import (
    EndpointQos,
    mismatches,
    reader_for,
    within_reach,
    writer_for,
)
from sern_client.endpoints.dds.raw import INFINITE_NS
from sern_client.endpoints.dds.services import DdsServices
from sern_client.endpoints.dds.subscription import Subscription
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import DropReason, Encoding, TopicName
from sern_runtime import ros_types
from sern_runtime.ros_types import ResolvedType

DEPTH: Final = 10
"""How many messages a writer keeps for its slow readers where the stream names no depth, as ROS 2 does."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class DdsOptions:
    """`queue_depth`: messages of one topic that may wait for the event loop; `max_buffer_bytes`: of all together.
    `offer_lifespan`: readers drop what is older than the stream's lifespan, by their own clocks. `as_node`: for SERN
    endpoints it is a node as others have, whose topics are of this site."""

    domain: DomainOptions = field(default_factory=DomainOptions)
    node_name: str = "sern"
    type_paths: tuple[Path, ...] = ()
    queue_depth: int = 100
    max_buffer_bytes: int = 64 * 2**20
    offer_lifespan: bool = False
    accept_bridged: bool = False
    as_node: bool = False


class DdsEndpoint:
    """An `Endpoint` and `ServiceEndpoint` for one DDS domain."""

    def __init__(self, options: DdsOptions) -> None:
        self.options = options
        self.counters = DdsCounters()
        self.graph = Graph(UUID(int=0), self, accept_bridged=options.accept_bridged)
        self.graph.own_guard = options.node_name + GUARD_SUFFIX
        self.types = Definitions(options.type_paths)
        self.entities = Entities(
            self.graph, self.counters, options.domain, node_name=options.node_name, queue_depth=options.queue_depth,
            max_buffer_bytes=options.max_buffer_bytes, as_node=options.as_node,
        )  # fmt: skip
        self.say_once = SayOnce(_log, logging.ERROR)
        self.services = DdsServices(self.entities, self.types, self.say_once)
        self.subscriptions: Subscriptions[Subscription] = Subscriptions(self.say_once)
        self._events: TopicEvents | None = None
        self._announced: dict[TopicName, TopicInfo] = {}
        self._streams: Streams[Writer] = Streams()
        self._started_s = 0.0
        self._changed: dict[Hashable, Callable[[], None]] = {}
        """What is to be done for topics and services that are not as they were."""

    # Life cycle

    async def start(self, events: TopicEvents) -> None:
        """ConfigError when the domain cannot be joined with these settings."""
        self.entities.join(self.settle)
        self._events = events
        loop = asyncio.get_running_loop()
        self.graph.later = loop.call_later
        self._started_s = loop.time()

    async def stop(self) -> None:
        """Leaves the domain; no thread and no socket stays behind."""
        if not self.entities.joined:
            return
        await self.services.stop()
        self.subscriptions.close()
        self._streams.close()
        self._events = None
        self.graph.end()
        await self.entities.leave()

    @property
    def encoding(self) -> Encoding:
        return Encoding.CDR

    @property
    def exhausted(self) -> bool:
        """Always false: a domain never has nothing more to say."""
        return False

    # Topics

    def subscribe(self, name: TopicName, sink: Sink) -> Subscription:
        info = self._announced.get(name)
        if info is None:
            raise UsageError(f"{name}: no such topic was announced")
        return self.subscriptions.add(
            Subscription(self.entities, info, names.to_dds(name), sink, self.subscriptions.remove)
        )

    def advertise(self, info: TopicInfo) -> Stream[Writer]:
        """ConfigError for another encoding than CDR, a type nobody defines, or one with another hash than here."""
        resolved = self._resolve(info)
        offered = replace(writer_for(info, lifespan=self.options.offer_lifespan), type_hash=resolved.text.type_hash)
        depth = info.depth or DEPTH
        best_effort = info.reliable is False and not info.latched
        topic = names.to_dds(info.name)
        writer = self.entities.open_writer(topic, resolved, offered, depth=depth)
        first_messages = FirstMessages(
            info.name,
            readers=lambda: writer.readers(self._waiting_readers(topic, names.type_to_dds(resolved.name), offered)),
            write=writer.publish,
            dropped=self._streams.drop,
            max_messages=info.depth or 1 if best_effort else max(depth, MAX_FIRST_MESSAGES),
            max_bytes=self.options.max_buffer_bytes,
            overflow=DropReason.SUPERSEDED if best_effort else DropReason.QUEUE_FULL,
            learning_s=self._started_s + LEARN_S - asyncio.get_running_loop().time(),
        )
        return self._streams.open(info.name, writer, first_messages)

    def _waiting_readers(self, topic: str, type_name: str, offered: EndpointQos) -> set[int]:
        """The readers of others that will match such a writer and get nothing that was written before, by handle."""
        return {
            reader.handle
            for reader in self.graph.readers(topic)
            if reader.type_name == type_name
            and not (offered.transient_local and reader.qos.transient_local)
            and not mismatches(offered, reader.qos)
        }

    def _resolve(self, info: TopicInfo) -> ResolvedType:
        if info.encoding is not Encoding.CDR:
            raise ConfigError(f"{info.name}: {info.encoding} bodies cannot be published in ROS 2")
        type_name = ros_types.canonical(info.type_name)
        definition = info.definition or self.types.message(type_name, info.type_hash).definition
        resolved = ros_types.resolve(type_name, definition, Encoding.CDR)
        if info.type_hash and info.type_hash != resolved.text.type_hash:
            raise ConfigError(
                f"{info.name}: {type_name} came with hash {info.type_hash}, but its definition has "
                f"{resolved.text.type_hash}; both sides need the same version of the type"
            )
        return resolved

    def validate(self, held: Held) -> list[Difference]:
        """A wanted topic without a reader differs too. Without the thread that waits for DDS nothing is received: that
        is a difference of every topic."""
        found = held.differences(Held(self._streams.names, self.subscriptions.names))
        found += self.subscriptions.differences()
        if self.entities.joined and not self.entities.worker.alive:
            found.append(Difference(TopicName(""), "the thread that waits for DDS has ended; start the client again"))
        return found

    def interest(self, name: TopicName, wanted: bool) -> None:
        """Nobody wants it: nothing is received either, unless the topic is latched."""
        self.subscriptions.interest(name, wanted)

    # Services

    def watch_services(self, events: ServiceEvents) -> None:
        self.services.watch(events)

    def service_definition(self, type_name: str, encoding: Encoding) -> str | None:
        """The type of a service, as `KnowsServiceTypes` has it."""
        return self.types.service_in(type_name, encoding)

    async def call(self, name: TopicName, request: bytes, *, timeout_s: float) -> bytes:
        return await self.services.call(name, request, timeout_s=timeout_s)

    def serve(self, info: ServiceInfo, handler: ServiceHandler) -> Any:
        return self.services.serve(info, handler)

    @property
    def drops(self) -> dict[DropReason, int]:
        """Messages dropped between this domain's nodes and us, by reason."""
        counted = {
            DropReason.QUEUE_FULL: self.entities.overruns() + self.counters.blocked + self.counters.calls,
            DropReason.UNDECODABLE: self.counters.unreadable + self.entities.faults,
            DropReason.DISCONNECTED: self.counters.closed,
        }
        return {reason: count for reason, count in (Counter(counted) + self._streams.dropped).items() if count}

    # Discovery: told by the graph

    def writers_changed(self, name: RosName, topic: str) -> None:
        self._changed[topic] = partial(self._heed_writers, name, topic)
        if not self.graph.writers(topic):  # at once: one that comes back in the same turn may say something else
            self._changed.pop(topic)()

    def services_changed(self, name: TopicName) -> None:
        self._changed["service", name] = partial(self.services.changed, name)

    def settle(self) -> bool:
        """Heed one topic or service that changed, however often it did. Whether there is another."""
        if self._changed:
            self._changed.pop(next(iter(self._changed)))()
        return bool(self._changed)

    def _heed_writers(self, name: RosName, topic: str) -> None:
        if self._events is None:
            return
        writers = self.graph.writers(topic)
        known = self._announced.get(name.name)
        types = {writer.type_name for writer in writers}
        if known is not None and not any(names.type_from_dds(one) == known.type_name for one in types):
            del self._announced[name.name]
            self._events.topic_removed(name.name)
            known = None
        if known is None:
            info = self._describe(name.name, writers)
            if info is not None:
                self._announced[name.name] = info
                self._events.topic_added(info)
            return
        self.subscriptions.refresh(name.name)

    def _describe(self, name: TopicName, writers: list[Remote]) -> TopicInfo | None:
        """The topic as the first of its writers has it whose type is known here."""
        kinds: dict[tuple[str, str], Remote] = {}
        for writer in writers:
            kinds.setdefault((writer.type_name, writer.qos.type_hash), writer)
        for kind, writer in kinds.items():
            type_name = names.type_from_dds(writer.type_name)
            if type_name is None:
                self.say_once(
                    f"{name} has the type {names.cut(writer.type_name)}, which is not of ROS 2; it is left alone",
                    name,
                    writer.type_name,
                )
                continue
            try:
                text = self.types.message(type_name, writer.qos.type_hash)
            except ConfigError as error:
                why = names.cut(str(error), 600)
                line = partial(self._left_alone, name, writer, why)
                self.graph.when_named(writer, partial(self.say_once, line, name, kind), name, kind)
                continue
            every = [other.qos for other in writers if other.type_name == writer.type_name]
            offered = within_reach(every) or every
            common = reader_for(offered)
            lifespan_ns = max(offer.lifespan_ns for offer in offered)
            deadline_ns = max(offer.deadline_ns for offer in offered)
            return TopicInfo(
                name,
                type_name,
                Encoding.CDR,
                text.type_hash,
                text.definition,
                latched=common.transient_local,
                reliable=common.reliable,
                lifespan_s=None if lifespan_ns >= INFINITE_NS else lifespan_ns / 1e9,
                deadline_s=None if deadline_ns >= INFINITE_NS else deadline_ns / 1e9,
            )
        return None

    def _left_alone(self, name: TopicName, writer: Remote, why: str) -> str:
        return f"{name} of {self.graph.owner(writer)} is left alone: {why}"
