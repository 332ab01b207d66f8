"""A topic on its way to the link."""

from collections.abc import Callable
from dataclasses import replace

from sern_client.endpoints.base import Sink
from sern_client.endpoints.dds import names
from sern_client.endpoints.dds.entities import Entities, Reader
from sern_client.endpoints.dds.qos import mismatches, reader_for, within_reach
from sern_client.endpoints.dds.worker import Sample
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_types


class Subscription:
    """One topic on its way to the link. The reader is made anew when writers appear that it would not match."""

    def __init__(
        self, entities: Entities, info: TopicInfo, dds_topic: str, sink: Sink,
        closed: "Callable[[Subscription], None]",
    ) -> None:  # fmt: skip
        self._entities = entities
        self._on_close = closed
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
            writer.qos for writer in self._entities.graph.writers(self.dds_topic) if writer.type_name == type_name
        ]
        writers = within_reach(offers)
        if self._reader is not None and not any(mismatches(offer, self._reader.qos) for offer in writers):
            return
        asked = replace(reader_for(writers), type_hash=self.info.type_hash)
        resolved = ros_types.resolve(self.info.type_name, self.info.definition, Encoding.CDR)
        self._reader = self._entities.open_reader(self.dds_topic, resolved, asked, self._deliver, before=self._reader)

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
        self._entities.counters.received += 1
        if not self._sink(sample.body, sample.stamp_ns):
            self._entities.counters.refused += 1

    def _drop(self, *, rest: bool) -> None:
        if self._reader is not None:
            self._reader.close(rest=rest)
            self._reader = None

    def close(self) -> None:
        if not self.closed:
            self.closed = True
            self._drop(rest=False)
            self._on_close(self)
