"""The `rclpy` endpoint: what a ROS 2 domain publishes and serves goes to the link, and the other way round."""

import asyncio
import logging
from collections import Counter

from sern_client.endpoints.base import (
    Difference,
    Held,
    ServiceEvents,
    ServiceHandler,
    ServiceInfo,
    ServiceServer,
    Sink,
    TopicEvents,
)
from sern_client.endpoints.common.first_messages import LEARN_S, MAX_FIRST_MESSAGES, FirstMessages
from sern_client.endpoints.common.interest import Subscriptions
from sern_client.endpoints.common.saying import SayOnce
from sern_client.endpoints.common.stream import Stream, Streams
from sern_client.endpoints.rclpy import qos
from sern_client.endpoints.rclpy.domain import Domain
from sern_client.endpoints.rclpy.echoes import Echoes
from sern_client.endpoints.rclpy.graph import Graph, Publisher
from sern_client.endpoints.rclpy.interfaces import Interfaces
from sern_client.endpoints.rclpy.options import RclpyOptions
from sern_client.endpoints.rclpy.qos import Offer
from sern_client.endpoints.rclpy.services import Services
from sern_client.endpoints.rclpy.topics import Reader, Writer
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import DropReason, Encoding, TopicName
from sern_runtime import ros_types
from sern_runtime.entry import end_tasks

_log = logging.getLogger(__name__)


class RclpyEndpoint:
    """An `Endpoint` and `ServiceEndpoint` for one domain. `start` raises ConfigError where rclpy is not to be had."""

    def __init__(self, options: RclpyOptions) -> None:
        self.options = options
        self.interfaces = Interfaces(options.type_paths)
        self._say_once = SayOnce(_log)
        self.domain = Domain(options, self._say_once, self._ended)
        self.graph = Graph(self.domain, node_name=options.node_name, accept_bridged=options.accept_bridged)
        self.services = Services(self.domain, self.graph, self.interfaces, self._say_once)
        self._echoes = Echoes()
        self._subscriptions: Subscriptions[Reader] = Subscriptions(self._say_once)
        self._streams: Streams[Writer] = Streams()
        self._events: TopicEvents | None = None
        self._announced: dict[TopicName, TopicInfo] = {}
        self._publishers: dict[TopicName, list[Publisher]] = {}
        """Those of this site on each announced topic, as they were last seen."""
        self._watching: asyncio.Task[None] | None = None
        self._started_s = 0.0

    # Life cycle

    async def start(self, events: TopicEvents) -> None:
        self.domain.join()
        self._events = events
        self._started_s = asyncio.get_running_loop().time()
        self._look()
        self._watching = asyncio.create_task(self._watch(), name="rclpy-graph")

    async def stop(self) -> None:
        if self._watching is None:
            return
        await end_tasks([self._watching])
        self._events = None
        self._subscriptions.close()
        self._streams.close()
        await self.services.stop()
        await self.domain.close()

    @property
    def encoding(self) -> Encoding:
        return Encoding.CDR

    @property
    def exhausted(self) -> bool:
        """Always false: a domain never has nothing more to say."""
        return False

    @property
    def drops(self) -> dict[DropReason, int]:
        """Messages and requests dropped because the event loop was behind, or nobody can be reached any more."""
        behind = {DropReason.QUEUE_FULL: self.domain.dropped + self.services.refused}
        return {reason: count for reason, count in (Counter(behind) + self._streams.dropped).items() if count}

    # Topics

    def interest(self, name: TopicName, wanted: bool) -> None:
        """Nobody wants it: the node has no subscription of it, unless the topic is latched."""
        self._subscriptions.interest(name, wanted)

    def subscribe(self, name: TopicName, sink: Sink) -> Reader:
        info = self._announced.get(name)
        if info is None:
            raise UsageError(f"{name}: no such topic was announced")
        return self._subscriptions.add(
            Reader(
                self.domain, self.interfaces, self._echoes, lambda: self._offers(name, info.type_name), info, sink,
                self._closed,
            )
        )  # fmt: skip

    def advertise(self, info: TopicInfo) -> Stream[Writer]:
        """ConfigError for another encoding than CDR, and a type that this installation has not, or in another
        version."""
        if self.options.services_only:
            raise ConfigError(f"{info.name}: this endpoint has services only (services_only)")
        if info.encoding is not Encoding.CDR:
            raise ConfigError(f"{info.name}: {info.encoding} bodies cannot be published in ROS 2")
        if not self.domain.alive:
            raise ConfigError(f"{info.name}: {self.domain.name}: {self.domain.problem}")
        self._check_version(info)
        writer = Writer(self.domain, self.interfaces, self._echoes, self.graph, info, self._streams.drop, self._forget)
        depth = writer.offered.depth or 1
        first_messages = FirstMessages(
            info.name,
            readers=writer.readers,
            write=writer.publish,
            dropped=self._streams.drop,
            max_messages=depth if info.reliable is False else max(depth, MAX_FIRST_MESSAGES),
            max_bytes=self.options.max_buffer_bytes,
            overflow=DropReason.SUPERSEDED if info.reliable is False else DropReason.QUEUE_FULL,
            learning_s=self._started_s + LEARN_S - asyncio.get_running_loop().time(),
        )
        return self._streams.open(info.name, writer, first_messages)

    def _check_version(self, info: TopicInfo) -> None:
        type_name = ros_types.canonical(info.type_name)
        self.interfaces.message(info.name, type_name)
        _, type_hash = self.interfaces.message_text(type_name)
        if info.type_hash and type_hash and info.type_hash != type_hash:
            raise ConfigError(
                f"{info.name}: {type_name} came with hash {info.type_hash}, but this installation has {type_hash}; "
                "both sides need the same version of the type"
            )

    def validate(self, held: Held) -> list[Difference]:
        """A wanted topic without a subscription differs too. Without the thread that executes callbacks nothing is
        received: that is a difference of every topic."""
        found = held.differences(Held(self._streams.names, self._subscriptions.names))
        if not self.domain.alive:
            problem = f"{self.domain.name}: {self.domain.problem}; start the client again"
            return [*found, Difference(TopicName(""), problem)]
        found += self._subscriptions.differences()
        if self._watching is not None and self._watching.done():
            found.append(Difference(TopicName(""), "nobody looks at the graph any more; start the client again"))
        return found

    def _offers(self, name: TopicName, type_name: str) -> list[Offer]:
        """What the publishers of now offer: those of the last look may be others."""
        here = self.graph.publishers(name).here or self._publishers.get(name, [])
        return [each.offer for each in here if each.type_name == type_name]

    def _closed(self, reader: Reader) -> None:
        self._subscriptions.remove(reader)
        self._forget(reader.name)

    def _forget(self, name: TopicName) -> None:
        """A reader or writer is closed: with the last of them, what we published there is of no interest any more."""
        if not self._subscriptions.of(name) and not self._streams.names[name]:
            self._echoes.forget(name)

    # Services

    def watch_services(self, events: ServiceEvents) -> None:
        self.services.watch(events)

    def service_definition(self, type_name: str, encoding: Encoding) -> str | None:
        """The type of a service, as `KnowsServiceTypes` has it."""
        return self.interfaces.files.service(type_name, encoding)

    async def call(self, name: TopicName, request: bytes, *, timeout_s: float) -> bytes:
        return await self.services.call(name, request, timeout_s=timeout_s)

    def serve(self, info: ServiceInfo, handler: ServiceHandler) -> ServiceServer:
        return self.services.serve(info, handler)

    # The graph

    async def _watch(self) -> None:
        while True:
            await asyncio.sleep(1 / self.options.poll_hz)
            if self.domain.alive:
                self._look()

    def _look(self) -> None:
        """Heed what came and went. What cannot be looked at stays as it was."""
        try:
            self.graph.look()
            if not self.options.services_only:
                self._look_at_topics()
            self.services.look()
        except Exception as error:  # noqa: BLE001  (of this look; the next may succeed)
            self._say_once(f"the graph could not be looked at: {ros_types.one_line(error)}", error=error)

    def _look_at_topics(self) -> None:
        found = self.graph.topics()
        for name in [name for name in self._announced if name not in found]:
            self._retract(name)
        for name in found:
            try:
                if self.graph.may_differ(name):
                    self._look_at(name)
            except Exception as error:  # noqa: BLE001  (a fault of one topic)
                self._say_once(f"{name} could not be looked at: {ros_types.one_line(error)}", error=error)

    def _look_at(self, name: TopicName) -> None:
        found = self.graph.publishers(name)
        if found.here and found.bridged:
            # Whose a message is, is not told: taking any of them might send what came over a link back.
            self._say_once(
                f"{name} is published by {found.here[0].node} and by the SERN endpoint {found.bridged[0]}, and rclpy "
                "does not tell their messages apart; it is left alone. An endpoint of kind dds tells them apart",
                name,
            )
            found.here.clear()
        if not found.here:
            if not found.unknown:
                self._retract(name)
            return
        known = self._announced.get(name)
        if known is not None and all(each.type_name != known.type_name for each in found.here):
            self._retract(name)  # with another type it is another topic
            known = None
        before = self._publishers.get(name)
        self._publishers[name] = found.here
        if known is None:
            self._announce(name, found.here)
        elif before != found.here:
            self._say_of_others(known, found.here)
            self._subscriptions.refresh(name)

    def _announce(self, name: TopicName, publishers: list[Publisher]) -> None:
        """A topic as the first of its publishers has it whose type is known here."""
        assert self._events is not None
        for type_name in dict.fromkeys(each.type_name for each in publishers):
            try:
                self.interfaces.message(name, type_name)
            except ConfigError as error:
                self._say_once(f"{error}; left out")
                continue
            mine = [each for each in publishers if each.type_name == type_name]
            info = self._announced[name] = self._describe(name, mine)
            self._say_of_others(info, publishers)
            self._events.topic_added(info)
            return

    def _describe(self, name: TopicName, publishers: list[Publisher]) -> TopicInfo:
        first = publishers[0]
        offers = [each.offer for each in publishers]
        common = qos.reader_for(offers)
        lifespans = [offer.lifespan_s for offer in offers]
        deadlines = [offer.deadline_s for offer in offers]
        definition, type_hash = self._text(name, first)
        return TopicInfo(
            name,
            first.type_name,
            Encoding.CDR,
            first.type_hash or type_hash,
            definition,
            latched=common.latched,
            reliable=common.reliable,
            depth=max((offer.depth for offer in offers if offer.depth is not None), default=None),
            lifespan_s=None if None in lifespans else max(each for each in lifespans if each is not None),
            deadline_s=None if None in deadlines else max(each for each in deadlines if each is not None),
        )

    def _text(self, name: TopicName, publisher: Publisher) -> tuple[str, str]:
        """Definition and hash of its type; empty where they are unknown: its bytes pass all the same."""
        type_name = publisher.type_name
        try:
            definition, type_hash = self.interfaces.message_text(type_name)
        except ConfigError as error:
            self._say_once(str(error))
            return "", ""
        if not definition:
            self._say_once(f"{type_name}: its definition is not known; add the directory of its file to type_paths")
        elif publisher.type_hash and type_hash != publisher.type_hash:
            self._say_once(
                f"{name}: {publisher.node} has {type_name} with hash {publisher.type_hash}, this installation has "
                f"{type_hash}; its definition is left out"
            )
            return "", ""
        return definition, type_hash

    def _say_of_others(self, info: TopicInfo, publishers: list[Publisher]) -> None:
        for each in publishers:
            if each.type_name != info.type_name:
                others = f"others {info.type_name}; {each.node} is left out"
                self._say_once(f"{info.name}: {each.node} publishes {each.type_name}, {others}")

    def _retract(self, name: TopicName) -> None:
        self._publishers.pop(name, None)
        if self._announced.pop(name, None) is not None and self._events is not None:
            self._events.topic_removed(name)

    def _ended(self) -> None:
        """The domain was shut down under us: nothing is here any more, the rest of the client goes on."""
        for name in list(self._announced):
            self._retract(name)
        self.services.domain_ended()
