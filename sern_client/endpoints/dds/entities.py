"""Our participant in a domain: its readers and writers, and what the others are told of them."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, TypeVar
from uuid import UUID
from weakref import WeakValueDictionary

from cyclonedds.core import DDSException, Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter, Publisher
from cyclonedds.sub import DataReader, Subscriber
from cyclonedds.topic import Topic

from sern_client.endpoints.common.first_messages import Readers
from sern_client.endpoints.dds import names, node_info, raw
from sern_client.endpoints.dds.counters import DdsCounters
from sern_client.endpoints.dds.domain import DomainOptions, close_domain, open_domain
from sern_client.endpoints.dds.graph import Graph, Local
from sern_client.endpoints.dds.idl import TypeMaker
from sern_client.endpoints.dds.names import DISCOVERY_TOPIC, SERN_ENCLAVE, SERN_KEY, user_data
from sern_client.endpoints.dds.qos import EndpointQos, to_policies
from sern_client.endpoints.dds.raw import INFINITE_NS
from sern_client.endpoints.dds.worker import Inbox, Sample, Worker
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_types
from sern_runtime.ros_types import ResolvedType

_INFO_QOS: Final = EndpointQos(reliable=True, durability=1)
_INFO_DEPTH: Final = 64

T = TypeVar("T")


class Reader:
    """A reader in use: its samples come to `deliver` on the event loop until it is closed."""

    def __init__(self, owner: "Entities", entity: DataReader[Any], qos: EndpointQos, inbox: Inbox, number: int) -> None:
        self._owner = owner
        self._entity: DataReader[Any] | None = entity
        self.guid: UUID = entity.guid
        self.qos = qos
        self.inbox = inbox
        self._number = number

    @property
    def matched(self) -> int:
        """How many writers it has."""
        return 0 if self._entity is None else len(raw.matched_writers(self._entity))

    @property
    def dropped(self) -> int:
        return self.inbox.dropped

    def close(self, *, rest: bool = False) -> None:
        """Take nothing more. `rest`: what it has received is still delivered."""
        self.inbox.closed = not rest
        self._entity = None  # the worker is the last to hold it, and lets go on its own thread
        self._owner.close_reader(self, self._number)


class Writer:
    """A writer in use."""

    def __init__(self, owner: "Entities", writer: DataWriter[Any], guid: UUID, *, stamped: bool) -> None:
        self._owner = owner
        self._writer: DataWriter[Any] | None = writer
        self.guid = guid
        self._stamped = stamped

    @property
    def matched(self) -> int:
        """How many readers it has."""
        return 0 if self._writer is None else len(raw.matched_readers(self._writer))

    def readers(self, known: set[int]) -> Readers:
        """How many of the `known` readers, by their handles, it has."""
        mine = () if self._writer is None else raw.matched_readers(self._writer)
        return Readers(len(known), len(known.intersection(mine)))

    def publish(self, body: bytes, stamp_ns: int) -> None:
        if self._writer is None:
            self._owner.counters.closed += 1
            return
        # A lifespan is judged by the time stamp: only one of this host says how old a sample is here.
        result = raw.write(self._writer, body, stamp_ns if self._stamped else None)
        if result == raw.RETCODE_TIMEOUT:
            self._owner.counters.blocked += 1
        elif result < 0:
            raise OSError(f"Cyclone DDS did not take a message of {len(body)} bytes (return code {result})")
        else:
            self._owner.counters.written += 1

    def close(self) -> None:
        if self._writer is not None:
            kept = [self._writer]  # no name for it: whoever is the last to hold it deletes it
            self._writer = None
            self._owner.close_writer(self, kept)


@dataclass(slots=True)
class _Joined:
    """What there is while the endpoint is in its domain."""

    participant: DomainParticipant
    publisher: Publisher
    subscriber: Subscriber
    worker: Worker


class Entities:
    """What our participant has, from `join` to `leave`. What others have is in the `graph`."""

    def __init__(
        self, graph: Graph, counters: DdsCounters, domain: DomainOptions, *, node_name: str, queue_depth: int,
        max_buffer_bytes: int, as_node: bool = False,
    ) -> None:  # fmt: skip
        self.graph = graph
        self.counters = counters
        self.leaving: dict[UUID, Reader] = {}
        """Readers that are closed and have not ended."""
        self._domain = domain
        self._node_name = node_name
        self._as_node = as_node
        self.queue_depth = queue_depth
        self._max_buffer_bytes = max_buffer_bytes
        self._maker = TypeMaker()
        self._joined: _Joined | None = None
        self._topics: WeakValueDictionary[str, Topic[Any]] = WeakValueDictionary()
        self._readers: dict[UUID, Reader] = {}
        self._writers: dict[UUID, Writer] = {}
        self._info_writer: Writer | None = None
        self._info_due = False

    def join(self, settle: Callable[[], bool]) -> None:
        """ConfigError when the domain cannot be joined with these settings."""
        domain = self._domain.domain
        open_domain(self._domain)
        try:
            sern = {"enclave": SERN_ENCLAVE, SERN_KEY: self._node_name}
            said = user_data(**({"enclave": "/"} if self._as_node else sern))
            participant = DomainParticipant(domain, Qos(Policy.EntityName(self._node_name), Policy.Userdata(said)))
        except DDSException as error:
            close_domain(domain)
            raise ConfigError(
                f"DDS domain {domain} cannot be joined ({error.msg}); "
                "too many participants on this host, or no such interface"
            ) from None
        self.graph.own = participant.guid
        self.graph.modern_seen = self._info_changed
        worker = Worker(participant, self.graph, settle, max_buffer_bytes=self._max_buffer_bytes)
        self._joined = _Joined(participant, Publisher(participant), Subscriber(participant), worker)
        info = ros_types.resolve(node_info.TYPE, "", Encoding.CDR)
        self.open_reader(DISCOVERY_TOPIC, info, _INFO_QOS, self.heed_nodes, depth=_INFO_DEPTH)
        self._info_writer = self.open_writer(DISCOVERY_TOPIC, info, _INFO_QOS, depth=1)
        self._tell_nodes()

    async def leave(self) -> None:
        """Close everything; no thread and no socket stays behind."""
        worker = self.worker
        self._info_writer = None
        for reader in list(self._readers.values()):
            reader.close()
        for writer in list(self._writers.values()):
            writer.close()
        await worker.stop()
        for guid in list(self.leaving):
            self._reader_ended(guid)
        self._topics.clear()
        # Leaving tells everybody, which may take a moment.
        self.counters.faults += worker.faults
        left = [self._joined]
        self._joined = None
        del worker
        await asyncio.get_running_loop().run_in_executor(None, left.clear)
        await asyncio.get_running_loop().run_in_executor(None, close_domain, self._domain.domain)

    @property
    def joined(self) -> bool:
        return self._joined is not None

    @property
    def worker(self) -> Worker:
        """The thread that waits for DDS. UsageError before `join` and after `leave`."""
        return self._alive().worker

    def open_reader(
        self, topic: str, resolved: ResolvedType, qos: EndpointQos, deliver: Callable[[Sample], None], *,
        depth: int | None = None, header: bool = False, id_key: str = "clientid", before: Reader | None = None,
    ) -> Reader:  # fmt: skip
        """Open a reader; with `header`, of requests or replies, which other SERN endpoints send as well.

        `before` is closed as soon as there is the new one; what either receives is delivered once. ConfigError when the
        topic is in use here with another type, or DDS cannot have the type; `before` stays open then.
        """
        joined = self._alive()
        ignores = self.graph.ignores

        def checked(sample: Sample) -> None:
            if header or not ignores(sample.handle):
                deliver(sample)

        inbox = Inbox(depth or self.queue_depth, checked, repeats=qos.transient_local)
        policies = to_policies(qos, depth=inbox.history, writer=False, id_key=id_key)
        if before is not None:
            before.inbox.record()
        try:
            entity = self.make(
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
        self, topic: str, resolved: ResolvedType, qos: EndpointQos, *, depth: int, header: bool = False,
        id_key: str = "clientid",
    ) -> Writer:  # fmt: skip
        """ConfigError as `open_reader`."""
        policies = to_policies(qos, depth=depth, writer=True, id_key=id_key)
        joined = self._alive()
        entity = self.make(
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
        self.leaving[reader.guid] = reader
        self.graph.local_removed(reader.guid)
        self._alive().worker.unwatch(number, partial(self._reader_ended, reader.guid))
        self._info_changed()

    def _reader_ended(self, guid: UUID) -> None:
        """All that it received is delivered or dropped."""
        self.counters.overrun += self.leaving.pop(guid).dropped

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

    def make(
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
    def faults(self) -> int:
        """What others announced and nobody could read, and readers that DDS would not give."""
        return self.counters.faults + (0 if self._joined is None else self._joined.worker.faults)

    def overruns(self) -> int:
        """Messages dropped because the event loop was too slow, of all readers there are and were."""
        return self.counters.overrun + sum(
            reader.dropped for readers in (self._readers, self.leaving) for reader in readers.values()
        )

    # Nodes

    def heed_nodes(self, sample: Sample) -> None:
        if len(sample.body) > node_info.MAX_BODY_BYTES:
            self.counters.unreadable += 1
            return
        found = node_info.decode(sample.body)
        if found is not None and found[0] != self.graph.own:
            self.graph.nodes_of(*found)

    def _info_changed(self) -> None:
        """Tell the others of our node's readers and writers, once for all that changed in this turn of the loop."""
        if self._info_writer is not None and not self._info_due:
            self._info_due = True
            asyncio.get_running_loop().call_soon(self._tell_nodes)

    def _tell_nodes(self) -> None:
        self._info_due = False
        if self._info_writer is None or not self.graph.modern:
            return
        hidden = {self._info_writer.guid}
        writers = [guid for guid in self._writers if guid not in hidden]
        readers = [local.guid for local in self.graph.locals.values() if not local.writer]
        body = node_info.encode(self.graph.own, self._node_name, readers, writers)
        self._info_writer.publish(body, 0)
