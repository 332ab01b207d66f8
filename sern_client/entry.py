"""Takes the messages of one topic from its endpoint. They may be held here while the topic is being changed."""

from collections import deque
from typing import Final, NamedTuple

from sern_client.endpoints.base import Sink
from sern_client.summaries.topic_summary import Send
from sern_core.stream.out_channel import OutChannel
from sern_runtime import clock

OVERHEAD_BYTES: Final = 768
"""What a message that waits counts for beside its body, as in a reliable queue."""


class Waiting(NamedTuple):
    """A message that came while its topic was being changed."""

    body: bytes
    stamp_ns: int
    born_s: float


class Entry:
    """`take` is what the endpoint calls, for as long as it is subscribed. What is held goes to `send`, which is told
    when it was born, or to `sink` where there is none; `channel` counts what is refused."""

    __slots__ = ("_channel", "_max_bytes", "_send", "_sink", "_waiting", "_waiting_bytes")

    def __init__(self, sink: Sink, channel: OutChannel, send: Send | None) -> None:
        self._sink = sink
        self._channel = channel
        self._send = send
        self._max_bytes: int | None = None
        self._waiting: deque[Waiting] = deque()
        self._waiting_bytes = 0

    def take(self, body: bytes, stamp_ns: int) -> bool:
        """False: there is no room for it; offer it again later, or count it lost."""
        if self._max_bytes is None:
            return self._sink(body, stamp_ns)
        size_bytes = len(body) + OVERHEAD_BYTES
        if self._waiting_bytes + size_bytes > self._max_bytes:
            self._channel.counters.refuse(len(body))
            return False
        self._waiting.append(Waiting(body, stamp_ns, clock.now()))
        self._waiting_bytes += size_bytes
        return True

    def hold(self, max_bytes: int) -> None:
        """Keep what comes from now on, up to so many bytes."""
        self._max_bytes = max_bytes

    def open(self) -> None:
        """Hold nothing any more: what waits goes where it would have gone."""
        self.replay(self.take_waiting())

    def take_waiting(self) -> list[Waiting]:
        """Hold nothing any more; returns what waited, the oldest first."""
        waiting = list(self._waiting)
        self._waiting.clear()
        self._waiting_bytes, self._max_bytes = 0, None
        return waiting

    def replay(self, waiting: list[Waiting]) -> None:
        """Hand over what had waited."""
        for message in waiting:
            if self._send is None:
                self._sink(message.body, message.stamp_ns)
            else:
                self._send(message.body, message.stamp_ns, message.born_s)

    def become(self, other: "Entry") -> None:
        """Hand over from now on what comes as another entry would."""
        self._sink, self._channel, self._send = other._sink, other._channel, other._send
