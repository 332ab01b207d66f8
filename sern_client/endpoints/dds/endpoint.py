"""The `dds` endpoint: what a ROS 2 domain publishes goes to the link, what comes from the link is published there.

What another SERN endpoint publishes in the same domain came over a link already and is not offered again, so that two
of them beside each other make no loop; they know each other by the USER_DATA of their participants. `heed_sern` turns
that off, for a chain of two links with a domain in the middle.
"""

import asyncio
import logging
from collections import Counter
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Final, TypeVar
from uuid import UUID
from weakref import WeakValueDictionary

from cyclonedds.core import DDSException, Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter, Publisher
from cyclonedds.sub import DataReader, Subscriber
from cyclonedds.topic import Topic

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
from sern_client.endpoints.common.first import LEARN_S, FirstMessages
from sern_client.endpoints.common.interest import Subscriptions
from sern_client.endpoints.common.saying import SayOnce
from sern_client.endpoints.common.stream import Stream, Streams
from sern_client.endpoints.dds import names, node_info
from sern_client.endpoints.dds.counters import DdsCounters
from sern_client.endpoints.dds.definitions import Definitions
from sern_client.endpoints.dds.domain import DomainOptions, close_domain, open_domain
from sern_client.endpoints.dds.entities import Reader, Subscription, Writer
from sern_client.endpoints.dds.graph import Graph, Local, Participant, Remote
from sern_client.endpoints.dds.idl import TypeMaker
from sern_client.endpoints.dds.names import DISCOVERY_TOPIC, SERN_KEY, RosName, user_data
from sern_client.endpoints.dds.qos import (
    EndpointQos,
    mismatches,
    reader_for,
    to_policies,
    within_reach,
    writer_for,
)
from sern_client.endpoints.dds.raw import INFINITE_NS
from sern_client.endpoints.dds.services import DdsServices
from sern_client.endpoints.dds.worker import Inbox, Sample, Worker
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import DropReason, Encoding, TopicName
from sern_runtime import ros_types
from sern_runtime.ros_types import ResolvedType

_INFO_QOS: Final = EndpointQos(reliable=True, durability=1)
_INFO_DEPTH: Final = 64
RELIABLE_DEPTH: Final = 10
"""How many messages a writer keeps for its slow readers where the stream names no depth, as ROS 2 does."""

_log = logging.getLogger(__name__)

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class DdsOptions:
    """`queue_depth`: messages of one topic that may wait for the event loop; `max_buffer_bytes`: of all together.
    `offer_lifespan`: readers drop what is older than the stream's lifespan, by their own clocks."""

    domain: DomainOptions = field(default_factory=DomainOptions)
    node_name: str = "sern"
    type_paths: tuple[Path, ...] = ()
    queue_depth: int = 100
    max_buffer_bytes: int = 64 * 2**20
    offer_lifespan: bool = False
    heed_sern: bool = False


@dataclass(slots=True)
class _Joined:
    """What there is while the endpoint is in its domain."""

    participant: DomainParticipant
    publisher: Publisher
    subscriber: Subscriber
    worker: Worker


class DdsEndpoint:
    """An `Endpoint` and `ServiceEndpoint` for one DDS domain."""

    def __init__(self, options: DdsOptions) -> None:
        self.options = options
        self.counters = DdsCounters()
        self.graph = Graph(UUID(int=0), self, heed_sern=options.heed_sern)
        self.graph.own_guard = options.node_name + GUARD_SUFFIX
        self.types = Definitions(options.type_paths)
        self.services = DdsServices(self)
        self.say_once = SayOnce(_log, logging.ERROR)
        self.subscriptions: Subscriptions[Subscription] = Subscriptions(self.say_once)
        self._events: TopicEvents | None = None
        self._maker = TypeMaker()
        self._joined: _Joined | None = None
        self._topics: WeakValueDictionary[str, Topic[Any]] = WeakValueDictionary()
        self._announced: dict[TopicName, TopicInfo] = {}
        self._readers: dict[UUID, Reader] = {}
        self._leaving: dict[UUID, Reader] = {}
        """Readers that are closed and have not ended."""
        self._writers: dict[UUID, Writer] = {}
        self._streams: Streams[Writer] = Streams()
        self._first_dropped: Counter[DropReason] = Counter()
        self._started_s = 0.0
        self._info_writer: Writer | None = None
        self._info_due = False
        self._changed: dict[Hashable, Callable[[], None]] = {}
        """What is to be done for topics and services that are not as they were."""

    # Life cycle

    async def start(self, events: TopicEvents) -> None:
        """ConfigError when the domain cannot be joined with these settings."""
        options = self.options
        open_domain(options.domain)
        try:
            said = user_data(enclave="/", **{SERN_KEY: options.node_name})
            qos = Qos(Policy.EntityName(options.node_name), Policy.Userdata(said))
            participant = DomainParticipant(options.domain.domain, qos)
        except DDSException as error:
            close_domain(options.domain.domain)
            raise ConfigError(
                f"DDS domain {options.domain.domain} cannot be joined ({error.msg}); "
                "too many participants on this host, or no such interface"
            ) from None
        self._events = events
        self._started_s = asyncio.get_running_loop().time()
        self.graph.own = participant.guid
        worker = Worker(participant, self, self.settle, max_buffer_bytes=options.max_buffer_bytes)
        self._joined = _Joined(participant, Publisher(participant), Subscriber(participant), worker)
        info = ros_types.resolve(node_info.TYPE, "", Encoding.CDR)
        self.open_reader(DISCOVERY_TOPIC, info, _INFO_QOS, self._heed_nodes, depth=_INFO_DEPTH)
        self._info_writer = self.open_writer(DISCOVERY_TOPIC, info, _INFO_QOS, depth=1)
        self._tell_nodes()

    async def stop(self) -> None:
        """Leaves the domain; no thread and no socket stays behind."""
        if self._joined is None:
            return
        await self.services.stop()
        self.subscriptions.close()
        for reader in list(self._readers.values()):
            reader.close()
        self._streams.close()
        for writer in list(self._writers.values()):
            writer.close()
        self._events = None
        await self._joined.worker.stop()
        for guid in list(self._leaving):
            self._reader_ended(guid)
        self._info_writer = None
        self._topics.clear()
        # Leaving tells everybody, which may take a moment.
        self.counters.faults += self._joined.worker.faults
        left = [self._joined]
        self._joined = None
        await asyncio.get_running_loop().run_in_executor(None, left.clear)
        await asyncio.get_running_loop().run_in_executor(None, close_domain, self.options.domain.domain)

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
        return self.subscriptions.add(Subscription(self, info, names.to_dds(name), sink))

    def advertise(self, info: TopicInfo) -> Stream[Writer]:
        """ConfigError for another encoding than CDR, a type nobody defines, or one with another hash than here."""
        resolved = self._resolve(info)
        offered = replace(writer_for(info, lifespan=self.options.offer_lifespan), type_hash=resolved.text.type_hash)
        depth = info.depth or (RELIABLE_DEPTH if offered.reliable else 1)
        topic = names.to_dds(info.name)
        writer = self.open_writer(topic, resolved, offered, depth=depth)
        first = FirstMessages(
            info.name,
            readers=lambda: writer.readers(self._waiting_readers(topic, names.type_to_dds(resolved.name), offered)),
            write=writer.publish,
            dropped=self._drop_first,
            max_messages=max(depth, self.options.queue_depth) if offered.reliable else depth,
            max_bytes=self.options.max_buffer_bytes,
            overflow=DropReason.QUEUE_FULL if offered.reliable else DropReason.SUPERSEDED,
            learning_s=self._started_s + LEARN_S - asyncio.get_running_loop().time(),
        )
        return self._streams.open(info.name, writer, first, self.counters.late)

    def _drop_first(self, why: DropReason) -> None:
        self._first_dropped[why] += 1

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
        if self._joined is not None and not self._joined.worker.alive:
            found.append(Difference(TopicName(""), "the thread that waits for DDS has ended; start the client again"))
        return found

    def interest(self, name: TopicName, wanted: bool) -> None:
        """Nobody wants it: nothing is received either, unless the topic is latched."""
        self.subscriptions.interest(name, wanted)

    def forget(self, subscription: Subscription) -> None:
        self.subscriptions.remove(subscription)

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

    # Readers and writers, for the parts of this package

    def open_reader(
        self,
        topic: str,
        resolved: ResolvedType,
        qos: EndpointQos,
        deliver: Callable[[Sample], None],
        *,
        depth: int | None = None,
        header: bool = False,
        id_key: str = "clientid",
        before: Reader | None = None,
    ) -> Reader:
        """Open a reader; with `header`, of requests or replies, which other SERN endpoints send as well.

        `before` is closed as soon as there is the new one; what either receives is delivered once. ConfigError when the
        topic is in use here with another type, or DDS cannot have the type; `before` stays open then.
        """
        joined = self._alive()
        ignores = self.graph.ignores

        def checked(sample: Sample) -> None:
            if header or not ignores(sample.handle):
                deliver(sample)

        inbox = Inbox(depth or self.options.queue_depth, checked, repeats=qos.transient_local)
        policies = to_policies(qos, depth=inbox.history, writer=False, id_key=id_key)
        if before is not None:
            before.inbox.record()
        try:
            entity = self._make(
                lambda of: DataReader(joined.subscriber, of, policies), "reader", topic, resolved, header=header
            )
        except ConfigError:
            if before is not None:
                before.inbox.record(on=False)
            raise
        if before is not None:
            before.close(rest=True)
        number = joined.worker.watch(entity, inbox, None if before is None else before.inbox)
        reader = Reader(self, entity, qos, inbox, number)
        self._readers[reader.guid] = reader
        self.graph.local_added(Local(reader.guid, False, topic, names.type_to_dds(resolved.name), qos))
        self._info_changed()
        return reader

    def open_writer(
        self,
        topic: str,
        resolved: ResolvedType,
        qos: EndpointQos,
        *,
        depth: int,
        header: bool = False,
        id_key: str = "clientid",
    ) -> Writer:
        """ConfigError as `open_reader`."""
        policies = to_policies(qos, depth=depth, writer=True, id_key=id_key)
        joined = self._alive()
        entity = self._make(
            lambda of: DataWriter(joined.publisher, of, policies), "writer", topic, resolved, header=header
        )
        writer = Writer(self, entity, entity.guid, stamped=qos.lifespan_ns >= INFINITE_NS)
        self._writers[writer.guid] = writer
        self.graph.local_added(Local(writer.guid, True, topic, names.type_to_dds(resolved.name), qos))
        self._info_changed()
        return writer

    def close_reader(self, reader: Reader, number: int) -> None:
        if self._readers.pop(reader.guid, None) is None:
            return
        self._leaving[reader.guid] = reader
        self.graph.local_removed(reader.guid)
        self._alive().worker.unwatch(number, partial(self._reader_ended, reader.guid))
        self._info_changed()

    def _reader_ended(self, guid: UUID) -> None:
        """All that it received is delivered or dropped."""
        self.counters.overrun += self._leaving.pop(guid).dropped

    def close_writer(self, writer: Writer, kept: list[DataWriter[Any]]) -> None:
        """`kept` holds its entity, which is deleted on the worker's thread."""
        if self._writers.pop(writer.guid, None) is None:
            return
        self.graph.local_removed(writer.guid)
        self._alive().worker.let_go(kept)
        self._info_changed()

    def _alive(self) -> "_Joined":
        if self._joined is None:
            raise UsageError("the dds endpoint is not running")
        return self._joined

    def _make(
        self, make: "Callable[[Topic[Any]], T]", what: str, topic: str, resolved: ResolvedType, *, header: bool
    ) -> T:
        """Make a reader or writer of a topic. ConfigError where DDS refuses it."""
        try:
            return make(self._topic(topic, resolved, header=header))
        except DDSException:
            # The worker may be deleting the topic with the last that used it, and it is still found here.
            self._topics.pop(topic, None)
        try:
            return make(self._topic(topic, resolved, header=header))
        except DDSException as error:
            raise ConfigError(f"{topic}: no {what} ({error.msg})") from None

    def _topic(self, name: str, resolved: ResolvedType, *, header: bool) -> "Topic[Any]":
        made = self._maker.make(resolved, header=header)
        known = self._topics.get(name)
        if known is not None:
            if known.data_type is made or known.data_type.__idl_typename__ == made.__idl_typename__:
                return known
            raise ConfigError(
                f"{name} is in use here with type {known.data_type.__idl_typename__}, so it cannot be "
                f"{made.__idl_typename__}; rename one of them (`remap`)"
            )
        try:
            topic: Topic[Any] = Topic(self._alive().participant, name, made)
        except DDSException as error:
            raise ConfigError(f"{name}: no topic of type {resolved.name} ({error.msg})") from None
        self._topics[name] = topic
        return topic

    @property
    def drops(self) -> dict[DropReason, int]:
        """Messages dropped between this domain's nodes and us, by reason."""
        counted = {
            DropReason.QUEUE_FULL: self.overruns() + self.counters.blocked + self.counters.calls,
            DropReason.UNDECODABLE: self.counters.unreadable + self.faults,
            DropReason.DISCONNECTED: self.counters.closed,
        }
        return {reason: count for reason, count in (Counter(counted) + self._first_dropped).items() if count}

    @property
    def faults(self) -> int:
        """What others announced and nobody could read, and readers that DDS would not give."""
        return self.counters.faults + (0 if self._joined is None else self._joined.worker.faults)

    def overruns(self) -> int:
        """Messages dropped because the event loop was too slow, of all readers there are and were."""
        return self.counters.overrun + sum(
            reader.dropped for readers in (self._readers, self._leaving) for reader in readers.values()
        )

    # Discovery: told by the worker

    def participant_added(self, participant: Participant) -> None:
        self.graph.participant_added(participant)

    def participant_removed(self, guid: UUID) -> None:
        self.graph.participant_removed(guid)

    def remote_added(self, remote: Remote) -> None:
        self.graph.remote_added(remote)

    def remote_removed(self, guid: UUID) -> None:
        self.graph.remote_removed(guid)

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
                self.say_once(partial(self._left_alone, name, writer, why), name, kind)
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

    # Nodes

    def _heed_nodes(self, sample: Sample) -> None:
        if len(sample.body) > node_info.MAX_BODY_BYTES:
            self.counters.unreadable += 1
            return
        found = node_info.decode(sample.body)
        if found is not None and found[0] != self.graph.own:
            self.graph.nodes_of(*found)

    def _info_changed(self) -> None:
        """Tell the others of our node's readers and writers, once for all that changed in this turn of the loop."""
        if self._info_writer is not None and not self._info_due and self._events is not None:
            self._info_due = True
            asyncio.get_running_loop().call_soon(self._tell_nodes)

    def _tell_nodes(self) -> None:
        self._info_due = False
        if self._info_writer is None or self._events is None:
            return
        hidden = {self._info_writer.guid}
        writers = [guid for guid in self._writers if guid not in hidden]
        readers = [local.guid for local in self.graph.locals.values() if not local.writer]
        body = node_info.encode(self.graph.own, self.options.node_name, readers, writers)
        self._info_writer.publish(body, 0)
