"""Replay of latched state: the last `depth` messages of each transient_local publisher, for whoever joins later."""

from collections import OrderedDict, deque
from typing import Final

from sern_core.message import Message

UNBOUNDED_BYTES: Final = 2**62


class LatchedCache:
    """Bounded by the stream's depth and by `max_bytes` (the oldest go first; the newest is always kept)."""

    __slots__ = ("_bytes", "_max_bytes", "_messages")

    def __init__(self, depth: int, max_bytes: int) -> None:
        self._messages: deque[Message] = deque(maxlen=depth)
        self._max_bytes = max_bytes
        self._bytes = 0

    def add(self, message: Message) -> None:
        """Keep `message`; tombstones have nothing to replay."""
        if message.tombstone:
            return
        messages = self._messages
        if len(messages) == messages.maxlen:
            self._bytes -= len(messages[0].body)
        messages.append(message)
        self._bytes += len(message.body)
        while self._bytes > self._max_bytes and len(messages) > 1:
            self.drop_oldest()

    def drop_oldest(self) -> int:
        """Let go of the oldest message; returns its bytes. There must be one."""
        size = len(self._messages.popleft().body)
        self._bytes -= size
        return size

    @property
    def depth(self) -> int:
        return self._messages.maxlen or 0

    @property
    def empty(self) -> bool:
        return not self._messages

    @property
    def held_bytes(self) -> int:
        return self._bytes

    def replay(self) -> list[Message]:
        """Copies marked as replay, oldest first."""
        return [
            Message(
                message.stream,
                message.seq,
                message.body,
                message.stamp_ns,
                message.born_s,
                0,
                True,
                message.error_s,
                message.codec,
            )
            for message in self._messages
        ]


class ReplayStore:
    """The latched messages of all streams together, at most `max_bytes`.

    Beyond that the streams that were longest neither written nor replayed lose their oldest messages, one stream after
    the other; `evicted` counts them. A message that is larger than the whole bound is not kept at all.
    """

    def __init__(self, max_bytes: int) -> None:
        self.max_bytes = max_bytes
        self.held_bytes = 0
        self.evicted = 0
        self._by_use: OrderedDict[LatchedCache, None] = OrderedDict()  # least recently used first

    def open(self, depth: int) -> LatchedCache:
        """A cache for one more stream. Write and read it through this store, and `close` it once."""
        cache = LatchedCache(depth, UNBOUNDED_BYTES)
        self._by_use[cache] = None
        return cache

    def close(self, cache: LatchedCache) -> None:
        del self._by_use[cache]
        self.held_bytes -= cache.held_bytes

    def add(self, cache: LatchedCache, message: Message) -> None:
        """Keep `message` in its stream's cache."""
        self._by_use.move_to_end(cache)
        if len(message.body) > self.max_bytes:
            self.evicted += 1
            self._shrink(cache, -1)  # replayed as the latest, what came before it would be wrong
            return
        before_bytes = cache.held_bytes
        cache.add(message)
        self.held_bytes += cache.held_bytes - before_bytes
        for least_used in self._by_use:
            if self.held_bytes <= self.max_bytes:
                break
            self._shrink(least_used, least_used.held_bytes - (self.held_bytes - self.max_bytes))

    def replay(self, cache: LatchedCache) -> list[Message]:
        """What a late joiner of the stream gets, oldest first."""
        self._by_use.move_to_end(cache)
        return cache.replay()

    def _shrink(self, cache: LatchedCache, to_bytes: int) -> None:
        while not cache.empty and cache.held_bytes > to_bytes:
            self.held_bytes -= cache.drop_oldest()
            self.evicted += 1

    def validate(self) -> None:
        """Internal consistency, for tests."""
        assert self.held_bytes == sum(cache.held_bytes for cache in self._by_use) <= self.max_bytes, "replay bytes"
