"""A stream that comes in, on its way to the readers of a domain."""

from collections.abc import Callable
from math import inf
from typing import Protocol
from uuid import UUID

from sern_client.endpoints.common.first import FirstMessages
from sern_core.vocabulary.types import TopicName


class Writer(Protocol):
    """What a stream is written with."""

    @property
    def guid(self) -> UUID: ...

    @property
    def matched(self) -> int:
        """How many readers it has."""
        ...

    def publish(self, body: bytes, stamp_ns: int) -> None: ...

    def close(self) -> None: ...


class Stream:
    """The `AgingPublisher` of a stream that comes in: a writer, and what waits for its first readers."""

    def __init__(
        self, name: TopicName, writer: Writer, first: FirstMessages, closed: "Callable[[Stream], None]"
    ) -> None:
        self.name = name
        self.writer = writer
        self.first = first
        self.closed = False
        self._closed = closed

    @property
    def guid(self) -> UUID:
        return self.writer.guid

    @property
    def matched(self) -> int:
        """How many readers it has."""
        return self.writer.matched

    def publish(self, body: bytes, stamp_ns: int) -> None:
        self.publish_within(body, stamp_ns, inf)

    def publish_within(self, body: bytes, stamp_ns: int, left_s: float) -> None:
        if self.first.over or self.closed:
            self.writer.publish(body, stamp_ns)
        else:
            self.first.publish(body, stamp_ns, left_s)

    def close(self) -> None:
        """What was published before is still written: the last of it may be a stop command."""
        if not self.closed:
            self.closed = True
            self._closed(self)
            self.first.end(self.writer.close)
