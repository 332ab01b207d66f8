"""Streams that come in, on their way to the readers of a middleware where first messages wait for those."""

from collections import Counter
from math import inf
from typing import Generic, Protocol, TypeVar

from sern_client.endpoints.common.first_messages import FirstMessages
from sern_core.vocabulary.types import DropReason, TopicName


class Writer(Protocol):
    """What a stream is written with."""

    def publish(self, body: bytes, stamp_ns: int) -> None: ...

    def close(self) -> None: ...


W = TypeVar("W", bound=Writer)


class Stream(Generic[W]):
    """The `AgingPublisher` of a stream: a writer, and what waits for its first readers, if anything does."""

    def __init__(self, name: TopicName, writer: W, first_messages: FirstMessages | None, owner: "Streams[W]") -> None:
        self.name = name
        self.writer = writer
        self.closed = False
        """It takes no more; its writer lasts until the first messages are written."""
        self._first_messages = first_messages
        self._owner = owner

    @property
    def waits(self) -> bool:
        """Whether its first messages wait."""
        return self._first_messages is not None and not self._first_messages.over

    def publish(self, body: bytes, stamp_ns: int) -> None:
        self.publish_within(body, stamp_ns, inf)

    def publish_within(self, body: bytes, stamp_ns: int, left_s: float) -> None:
        if self.closed:
            self._owner.drop(DropReason.DISCONNECTED)
        elif self._first_messages is None or self._first_messages.over:
            self.writer.publish(body, stamp_ns)
        else:
            self._first_messages.publish(body, stamp_ns, left_s)

    def close(self) -> None:
        """What was published before is still written: the last of it may be a stop command."""
        if not self.closed:
            self.closed = True
            if self._first_messages is None:
                self._end()
            else:
                self._first_messages.end(self._end)

    def _end(self) -> None:
        self.writer.close()
        self._owner.ended(self)

    def hurry(self) -> None:
        """Write the first messages now."""
        if self._first_messages is not None:
            self._first_messages.close()


class Streams(Generic[W]):
    """Those of an endpoint whose writers are open."""

    def __init__(self) -> None:
        self.dropped: Counter[DropReason] = Counter()
        """First messages that nobody got, and messages that came to a stream after its end."""
        self._open: list[Stream[W]] = []

    def open(self, name: TopicName, writer: W, first_messages: FirstMessages | None) -> Stream[W]:
        stream = Stream(name, writer, first_messages, self)
        self._open.append(stream)
        return stream

    def ended(self, stream: Stream[W]) -> None:
        """The writer of a stream is closed."""
        self._open.remove(stream)

    def drop(self, why: DropReason) -> None:
        self.dropped[why] += 1

    @property
    def names(self) -> Counter[TopicName]:
        """How many take messages, by topic."""
        return Counter(stream.name for stream in self._open if not stream.closed)

    def close(self) -> None:
        """Close all, and wait for no reader."""
        for stream in list(self._open):
            stream.close()
            stream.hurry()
