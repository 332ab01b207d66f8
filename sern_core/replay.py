"""Replay of latched state: the last `depth` messages of each transient_local publisher, for whoever joins later."""

from collections import deque

from sern_core.message import Message


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
            self._bytes -= len(messages.popleft().body)

    @property
    def held_bytes(self) -> int:
        return self._bytes

    def replay(self) -> list[Message]:
        """Copies marked as replay, oldest first."""
        return [
            Message(
                message.stream, message.seq, message.body, message.stamp_ns, message.born_s, 0, True, message.error_s
            )
            for message in self._messages
        ]
