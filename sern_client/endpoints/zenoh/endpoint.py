"""ROS 2 through zenoh, as rmw_zenoh does it: no ROS installation, bodies pass through as they are.

The graph is what liveliness tokens say (`names`). A topic exists here while some other session has a publisher of it;
services likewise. Our own session's entities are left out, so that what is published here does not come back, and those
of other SERN endpoints, because what they have came over a link; `accept_bridged` takes these.
Publishers whose type or hash differs from the topic's first one are left out, with one line that names both.
"""

import asyncio
import logging
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final

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
from sern_client.endpoints.common.interest import OnDemand, Subscriptions
from sern_client.endpoints.common.saying import SayOnce
from sern_client.endpoints.common.stream import Stream, Streams
from sern_client.endpoints.zenoh import names
from sern_client.endpoints.zenoh.entities import Writer, receive
from sern_client.endpoints.zenoh.names import Entity, Kind, Qos
from sern_client.endpoints.zenoh.node import Node
from sern_client.endpoints.zenoh.options import ZenohOptions
from sern_client.endpoints.zenoh.services import Services
from sern_client.endpoints.zenoh.session import MAX_WAITING_BYTES, ZenohSession
from sern_core.vocabulary.errors import ConfigError, UsageError, WireError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import DropReason, Encoding, TopicName
from sern_runtime import clock, ros_types
from sern_runtime.outages import Outages
from sern_runtime.ros_files import installed_files

ROUTER_WAIT_S: Final = 3.0
"""After so long without a router and without a peer we say so."""
LOOK_S: Final = 1.0
"""How often it is looked whether there is one."""
MAX_COMPLAINTS: Final = 256

_log = logging.getLogger(__name__)


@dataclass(slots=True, eq=False)
class _Topic:
    """A topic of others: publishers by their key in the graph, the first one's type holds."""

    dds_type: str
    type_hash: str
    publishers: dict[str, Qos] = field(default_factory=dict)
    info: TopicInfo | None = None


class ZenohEndpoint:
    """An `Endpoint` and a `ServiceEndpoint`."""

    def __init__(self, options: ZenohOptions) -> None:
        self.options = options
        self.types = installed_files(options.type_paths)[0]
        self.session = ZenohSession(options.session)
        self.node = Node(self.session, options.domain, options.node_name, options.enclave)
        self.services = Services(self.node, self.types)
        self.say_once = SayOnce(_log, most=MAX_COMPLAINTS)
        self.subscriptions: Subscriptions[OnDemand] = Subscriptions(self.say_once)
        self._events: TopicEvents | None = None
        self._topics: dict[TopicName, _Topic] = {}
        self._left_out: dict[TopicName, dict[str, Entity]] = {}  # publishers of another type, by their key
        self._subscribers: dict[TopicName, dict[str, tuple[str, str]]] = {}  # of others: their types by their keys
        self._started_s = 0.0
        self._streams: Streams[Writer] = Streams()
        self._look_again: asyncio.TimerHandle | None = None
        self._outages = Outages(_log, logging.WARNING, after_s=ROUTER_WAIT_S)

    @property
    def encoding(self) -> Encoding | None:
        return Encoding.CDR

    @property
    def exhausted(self) -> bool:
        return False

    @property
    def drops(self) -> dict[DropReason, int]:
        """Messages dropped between zenoh and us: one side was behind the other, or the session had ended."""
        counted = {
            DropReason.QUEUE_FULL: self.session.put_dropped + (self.session.handover.dropped if self._events else 0),
            DropReason.DISCONNECTED: self.session.put_failed,
        }
        return {reason: count for reason, count in (Counter(counted) + self._streams.dropped).items() if count}

    async def start(self, events: TopicEvents) -> None:
        """ConfigError when zenoh does not take the settings. A router that is not there yet is waited for."""
        await self.session.open()
        self._events = events
        self._loop = asyncio.get_running_loop()
        self._started_s = self._loop.time()
        try:
            self._join()
        except self.session.zenoh.ZError as error:
            await self.session.close()
            raise ConfigError(f"zenoh: {ros_types.one_line(error)}") from None
        self._look_for_others()

    def _join(self) -> None:
        self.node.join()
        # `history`: what is there already is told first.
        self._graph = self.session.opened.liveliness().declare_subscriber(self.node.others, self._token, history=True)

    def _look_for_others(self) -> None:
        """Say that nobody is there, and when somebody is again."""
        info, there = self.session.opened.info, ", ".join(self.session.connect) or "the locators we listen on"
        self._outages.look(
            there, lost=not info.routers_zid() and not info.peers_zid(), now=clock.now(),
            gone=f"nobody answers at {there}; is the router (rmw_zenohd) running there? Trying again until it works",
            back=f"somebody answers at {there} now",
        )  # fmt: skip
        self._look_again = self._loop.call_later(LOOK_S, self._look_for_others)

    async def stop(self) -> None:
        if self._look_again is not None:
            self._look_again.cancel()
        self.subscriptions.close()
        self._streams.close()
        await self.services.stop()
        await self.session.close()

    # --- topics of others -------------------------------------------------------------------------------------------

    def subscribe(self, name: TopicName, sink: Sink) -> OnDemand:
        topic = self._topics.get(name)
        if topic is None or topic.info is None:
            raise UsageError(f"{name}: no such topic was announced")
        return self.subscriptions.add(OnDemand(topic.info, sink, self._receive, self.subscriptions.remove))

    def _receive(self, info: TopicInfo, arrived: Callable[[bytes, int], None]) -> Callable[[], None]:
        return receive(
            self.node, info, self._asked(info.name), self.say_once, arrived, accept_bridged=self.options.accept_bridged
        )

    def _asked(self, name: TopicName) -> Qos:
        """What to ask for: what any of the publishers offers."""
        topic = self._topics.get(name)
        offers = () if topic is None else topic.publishers.values()
        return Qos(
            any(qos.reliable for qos in offers),
            any(qos.transient_local for qos in offers),
            max((qos.depth for qos in offers), default=names.DEFAULT_DEPTH),
        )

    def interest(self, name: TopicName, wanted: bool) -> None:
        """Nobody wants it: no subscriber of ours is in the session, unless the topic is latched."""
        self.subscriptions.interest(name, wanted)

    def advertise(self, info: TopicInfo) -> Stream[Writer]:
        dds_name = names.dds_type(ros_types.canonical(info.type_name))
        type_hash = info.type_hash or self._hash_of(info)
        known = self._topics.get(info.name)
        if known is not None and (known.dds_type, known.type_hash) != (dds_name, type_hash):
            raise ConfigError(
                f"{info.name}: what comes is {info.type_name} {type_hash}, "
                f"nodes here publish {names.ros_type(known.dds_type)} {known.type_hash}"
            )
        writer = Writer(self.node, info, type_hash, lambda: self.readers(info.name, dds_name, type_hash))
        best_effort = info.reliable is False
        first_messages: FirstMessages | None = None
        if not info.latched:  # else whoever comes later gets what it has missed from a cache
            first_messages = FirstMessages(
                info.name,
                readers=writer.readers,
                write=writer.publish,
                dropped=self._streams.drop,
                max_messages=(info.depth or 1) if best_effort else MAX_FIRST_MESSAGES,
                max_bytes=MAX_WAITING_BYTES,
                overflow=DropReason.SUPERSEDED if best_effort else DropReason.QUEUE_FULL,
                learning_s=max(0.0, self._started_s + LEARN_S - self._loop.time()),
            )
        return self._streams.open(info.name, writer, first_messages)

    def readers(self, name: TopicName, dds_name: str, type_hash: str) -> int:
        """How many subscribers of others the graph knows."""
        return sum(kind == (dds_name, type_hash) for kind in self._subscribers.get(name, {}).values())

    def validate(self, held: Held) -> list[Difference]:
        """What differs from `held`. A thread that does not write publishes nothing: a difference of every topic."""
        found = held.differences(Held(self._streams.names, self.subscriptions.names))
        found += self.subscriptions.differences()
        if (problem := self.session.problem) is not None:
            found.append(Difference(TopicName(""), problem))
        return found

    def _hash_of(self, info: TopicInfo) -> str:
        definition = info.definition or self.types.message(info.type_name)
        if not definition:
            raise ConfigError(
                f"{info.name}: neither hash nor definition of {info.type_name} is known; "
                "add the directory of its .msg file to type_paths"
            )
        return ros_types.hash_of(info.type_name, definition, Encoding.CDR)

    # --- the graph --------------------------------------------------------------------------------------------------

    def _token(self, sample: Any) -> None:
        """Runs in a thread of zenoh's."""
        key, alive = str(sample.key_expr), sample.kind == self.session.zenoh.SampleKind.PUT
        self.session.handover.news(lambda: self._token_changed(key, alive))

    def _token_changed(self, key: str, alive: bool) -> None:
        try:
            entity = names.parse_token(key)
            if self.node.owns(entity) or (entity.bridged and not self.options.accept_bridged):
                return
            if entity.kind is Kind.PUBLISHER:
                if alive:
                    self._publisher_appeared(entity)
                else:
                    self._publisher_went(entity)
            elif entity.kind is Kind.SUBSCRIPTION:
                there = self._subscribers.setdefault(entity.name, {})
                there.pop(entity.key, None)
                if alive:
                    there[entity.key] = entity.dds_type, entity.type_hash
                elif not there:
                    del self._subscribers[entity.name]
            elif entity.kind is Kind.SERVER:
                self.services.server_changed(entity, alive)
        except (WireError, ConfigError) as error:
            self.say_once(str(error))

    def _publisher_appeared(self, entity: Entity) -> None:
        assert self._events is not None
        qos = Qos.decode(entity.qos)
        type_name = names.ros_type(entity.dds_type)
        topic = self._topics.get(entity.name)
        if topic is None:
            topic = self._topics[entity.name] = _Topic(entity.dds_type, entity.type_hash)
        elif (topic.dds_type, topic.type_hash) != (entity.dds_type, entity.type_hash):
            self._left_out.setdefault(entity.name, {})[entity.key] = entity
            raise ConfigError(
                f"{entity.name}: {entity.node} publishes {type_name} {entity.type_hash}, others "
                f"{names.ros_type(topic.dds_type)} {topic.type_hash}; {entity.node} is left out"
            )
        first = not topic.publishers
        topic.publishers[entity.key] = qos
        if first:
            topic.info = TopicInfo(
                entity.name, type_name, Encoding.CDR, entity.type_hash, self._definition(entity, type_name),
                qos.transient_local, qos.reliable,
            )  # fmt: skip
            self._events.topic_added(topic.info)

    def _publisher_went(self, entity: Entity) -> None:
        assert self._events is not None
        left_out = self._left_out.get(entity.name, {})
        left_out.pop(entity.key, None)
        if not left_out:
            self._left_out.pop(entity.name, None)
        topic = self._topics.get(entity.name)
        if topic is None or topic.publishers.pop(entity.key, None) is None or topic.publishers:
            return
        del self._topics[entity.name]
        self._events.topic_removed(entity.name)
        for other in self._left_out.pop(entity.name, {}).values():  # now it is their turn
            try:
                self._publisher_appeared(other)
            except ConfigError as error:
                self.say_once(str(error))

    def _definition(self, entity: Entity, type_name: str) -> str:
        """Empty where unknown: bytes pass through all the same, only conversion needs it."""
        definition = self.types.message(type_name)
        if definition is None:
            self.say_once(
                f"{type_name}: its definition is not known; {entity.name} passes as it is and cannot be converted or "
                "recorded; add the directory of its .msg file to type_paths"
            )
            return ""
        mine = ros_types.hash_of(type_name, definition, Encoding.CDR)
        if entity.type_hash.startswith("RIHS01_") and entity.type_hash != mine:
            known = ros_types.describe(type_name, Encoding.CDR)
            if known is not None and known.type_hash == entity.type_hash:
                return known.definition  # what is installed here is of another distribution than the robot
            self.say_once(
                f"{entity.name}: {entity.node} has {type_name} with hash {entity.type_hash}, here it is {mine}; "
                "its definition is left out"
            )
            return ""
        return definition

    # --- services ---------------------------------------------------------------------------------------------------

    def watch_services(self, events: ServiceEvents) -> None:
        self.services.watch(events)

    def service_definition(self, type_name: str, encoding: Encoding) -> str | None:
        """The type of a service, as `KnowsServiceTypes` has it."""
        return self.types.service(type_name, encoding)

    async def call(self, name: TopicName, request: bytes, *, timeout_s: float) -> bytes:
        return await self.services.call(name, request, timeout_s=timeout_s)

    def serve(self, info: ServiceInfo, handler: ServiceHandler) -> ServiceServer:
        return self.services.serve(info, handler)
