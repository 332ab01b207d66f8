"""A topic on its way to the link, and the readers and writers in use."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Protocol
from uuid import UUID

from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader

from sern_client.endpoints.base import Sink
from sern_client.endpoints.common.first import Readers
from sern_client.endpoints.dds import names, raw
from sern_client.endpoints.dds.counters import DdsCounters
from sern_client.endpoints.dds.graph import Graph
from sern_client.endpoints.dds.qos import EndpointQos, mismatches, reader_for, within_reach
from sern_client.endpoints.dds.worker import Inbox, Sample
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_types


class EntityOwner(Protocol):
    """What readers and writers need of the endpoint that has them."""

    graph: Graph
    counters: DdsCounters

    def open_reader(
        self,
        topic: str,
        resolved: ros_types.ResolvedType,
        qos: EndpointQos,
        deliver: Callable[[Sample], None],
        *,
        before: "Reader | None" = None,
    ) -> "Reader":
        """`before` is closed as soon as there is the new one. ConfigError where DDS gives none."""

    def forget(self, subscription: "Subscription") -> None: ...

    def close_reader(self, reader: "Reader", number: int) -> None: ...

    def close_writer(self, writer: "Writer", kept: list[DataWriter[Any]]) -> None: ...


class Subscription:
    """One topic on its way to the link. The reader is made anew when writers appear that it would not match."""

    def __init__(self, endpoint: EntityOwner, info: TopicInfo, dds_topic: str, sink: Sink) -> None:
        self._endpoint = endpoint
        self.name = info.name
        self.info = info
        self.dds_topic = dds_topic
        self._sink = sink
        self._reader: Reader | None = None
        self.closed = False
        self.wanted = True

    def refresh(self) -> None:
        """Have a reader that matches all writers there are now that it can, or none while nobody wants the topic.

        What the reader before it has received is delivered, once. ConfigError where DDS gives no other: that one stays.
        """
        if self.closed:
            return
        if not self.wanted and not self.info.latched:
            self._drop(rest=True)
            return
        type_name = names.type_to_dds(self.info.type_name)
        offers = [
            writer.qos for writer in self._endpoint.graph.writers(self.dds_topic) if writer.type_name == type_name
        ]
        writers = within_reach(offers)
        if self._reader is not None and not any(mismatches(offer, self._reader.qos) for offer in writers):
            return
        asked = replace(reader_for(writers), type_hash=self.info.type_hash)
        resolved = ros_types.resolve(self.info.type_name, self.info.definition, Encoding.CDR)
        self._reader = self._endpoint.open_reader(self.dds_topic, resolved, asked, self._deliver, before=self._reader)

    @property
    def lacking(self) -> bool:
        """Whether it is to have a reader and has none."""
        return self._reader is None and (self.wanted or self.info.latched)

    @property
    def matched(self) -> int:
        """How many writers it is connected with."""
        return 0 if self._reader is None else self._reader.matched

    def _deliver(self, sample: Sample) -> None:
        if self.closed:
            return  # the rest of a reader before the last one: nobody is there to take it
        self._endpoint.counters.received += 1
        if not self._sink(sample.body, sample.stamp_ns):
            self._endpoint.counters.refused += 1

    def _drop(self, *, rest: bool) -> None:
        if self._reader is not None:
            self._reader.close(rest=rest)
            self._reader = None

    def close(self) -> None:
        if not self.closed:
            self.closed = True
            self._drop(rest=False)
            self._endpoint.forget(self)


class Reader:
    """A reader in use: its samples come to `deliver` on the event loop until it is closed."""

    def __init__(
        self, endpoint: EntityOwner, entity: DataReader[Any], qos: EndpointQos, inbox: Inbox, number: int
    ) -> None:
        self._endpoint = endpoint
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
        """With `rest`, what it has received is still delivered."""
        self.inbox.closed = not rest
        self._entity = None  # the worker is the last to hold it, and lets go on its own thread
        self._endpoint.close_reader(self, self._number)


class Writer:
    """A writer in use."""

    def __init__(self, endpoint: EntityOwner, writer: DataWriter[Any], guid: UUID, *, stamped: bool) -> None:
        self._endpoint = endpoint
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
            self._endpoint.counters.late()
            return
        # A lifespan is judged by the time stamp: only one of this host says how old a sample is here.
        result = raw.write(self._writer, body, stamp_ns if self._stamped else None)
        if result == raw.RETCODE_TIMEOUT:
            self._endpoint.counters.blocked += 1
        elif result < 0:
            raise OSError(f"Cyclone DDS did not take a message of {len(body)} bytes (return code {result})")
        else:
            self._endpoint.counters.written += 1

    def close(self) -> None:
        if self._writer is not None:
            kept = [self._writer]  # no name for it: whoever is the last to hold it deletes it
            self._writer = None
            self._endpoint.close_writer(self, kept)
