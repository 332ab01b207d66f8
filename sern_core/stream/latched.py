"""Replay of latched state: the last `depth` messages of each transient_local publisher, for whoever joins later."""

from collections import OrderedDict, deque
from collections.abc import Iterable, Sequence
from itertools import takewhile
from typing import Final

from sern_core.stream.prices import CLIENT_OVERHEAD_BYTES, MESSAGE_OVERHEAD_BYTES
from sern_core.vocabulary.message import Message

UNBOUNDED_BYTES: Final = 2**62
MAX_REPLAY_MESSAGES: Final = 1000
"""Messages of one stream that a relay keeps for late joiners, whatever its depth: each of those gets all at once."""


def kept_bytes(message: Message) -> int:
    """What a kept message counts for: its body and what its objects take."""
    return len(message.body) + MESSAGE_OVERHEAD_BYTES


def waiting_bytes(message: Message) -> int:
    """What it will count for in the bound of a client that it waits for."""
    return len(message.body) + CLIENT_OVERHEAD_BYTES


def newest_that_fit(messages: Sequence[Message], room_bytes: int) -> int:
    """How many of the messages, counted from the newest and last, fit into the room that a client's bound leaves."""
    count = 0
    for message in reversed(messages):
        room_bytes -= waiting_bytes(message)
        if room_bytes < 0:
            break
        count += 1
    return count


def as_replays(messages: Iterable[Message]) -> list[Message]:
    """Copies marked as replay."""
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
        for message in messages
    ]


class LatchedCache:
    """Bounded by the stream's depth and by `max_bytes` (the oldest go first; the newest is always kept)."""

    __slots__ = ("_bytes", "_max_bytes", "_messages", "cut")

    def __init__(self, depth: int, max_bytes: int) -> None:
        self._messages: deque[Message] = deque(maxlen=depth)
        self._max_bytes = max_bytes
        self._bytes = 0
        self.cut = False
        """Whether the stream has more depth than is kept."""

    def add(self, message: Message) -> None:
        """Keep `message`; drop markers have nothing to replay."""
        if message.drop_marker:
            return
        messages = self._messages
        if len(messages) == messages.maxlen:
            self._bytes -= kept_bytes(messages[0])
        messages.append(message)
        self._bytes += kept_bytes(message)
        while self._bytes > self._max_bytes and len(messages) > 1:
            self.drop_oldest()

    def drop_oldest(self) -> int:
        """Let go of the oldest message; returns its bytes. There must be one."""
        size = kept_bytes(self._messages.popleft())
        self._bytes -= size
        return size

    @property
    def depth(self) -> int:
        return self._messages.maxlen or 0

    @property
    def empty(self) -> bool:
        return not self._messages

    @property
    def count(self) -> int:
        return len(self._messages)

    @property
    def full(self) -> bool:
        return len(self._messages) == self._messages.maxlen

    @property
    def held_bytes(self) -> int:
        return self._bytes

    def replay(self) -> list[Message]:
        """Copies marked as replay, oldest first."""
        return as_replays(self._messages)

    def below(self, seq: int) -> list[Message]:
        """The messages below `seq`, oldest first."""
        return list(takewhile(lambda message: message.seq < seq, self._messages))


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
        """A cache for one more stream, of `MAX_REPLAY_MESSAGES` at most: a full one of a deeper stream counts what it
        loses as evicted. Write and read it through this store, and `close` it once."""
        cache = LatchedCache(min(depth, MAX_REPLAY_MESSAGES), UNBOUNDED_BYTES)
        cache.cut = depth > MAX_REPLAY_MESSAGES
        self._by_use[cache] = None
        return cache

    def close(self, cache: LatchedCache) -> None:
        del self._by_use[cache]
        self.held_bytes -= cache.held_bytes

    def add(self, cache: LatchedCache, message: Message) -> None:
        """Keep `message` in its stream's cache."""
        self._by_use.move_to_end(cache)
        if kept_bytes(message) > self.max_bytes:
            self.evicted += 1
            self._shrink(cache, -1)  # replayed as the latest, what came before it would be wrong
            return
        before_bytes = cache.held_bytes
        self.evicted += cache.cut and cache.full and not message.drop_marker
        cache.add(message)
        self.held_bytes += cache.held_bytes - before_bytes
        for least_used in self._by_use:
            if self.held_bytes <= self.max_bytes:
                break
            self._shrink(least_used, least_used.held_bytes - (self.held_bytes - self.max_bytes))

    def below(self, cache: LatchedCache, seq: int) -> list[Message]:
        """What a late joiner of the stream gets if it has room, oldest first: what comes before its first message."""
        self._by_use.move_to_end(cache)
        return cache.below(seq)

    def _shrink(self, cache: LatchedCache, to_bytes: int) -> None:
        while not cache.empty and cache.held_bytes > to_bytes:
            self.held_bytes -= cache.drop_oldest()
            self.evicted += 1

    def validate(self) -> None:
        """Internal consistency, for tests."""
        assert self.held_bytes == sum(cache.held_bytes for cache in self._by_use) <= self.max_bytes, "replay bytes"
