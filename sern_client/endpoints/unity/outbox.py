"""What waits for one scene, and what leaves next. No I/O.

Commands and services leave first, then the streams take turns. Each stream has a queue of its own, so that a heavy one
delays the others by one message at most, and a scene that is slow sees the newest there is.
"""

from collections import Counter, deque
from collections.abc import Hashable
from math import inf
from typing import Final, NamedTuple

from sern_client.endpoints.common.handover import ITEM_BYTES
from sern_client.endpoints.common.queue import BoundedQueue
from sern_core.vocabulary.types import DropReason

MAX_SAID_BYTES: Final = 64 * 1024
"""Texts that may wait for a scene; beyond, the oldest go."""

Pieces = tuple[bytes, ...]
"""The bytes of a frame, or of some that belong together, one after another."""


class Keep(NamedTuple):
    """How much of a stream waits. Beyond, the oldest are dropped, for the reason `why`."""

    max_items: float
    why: DropReason


NEWEST: Final = Keep(1, DropReason.SUPERSEDED)
SOME: Final = Keep(100, DropReason.SUPERSEDED)
ALL: Final = Keep(inf, DropReason.QUEUE_FULL)
"""Every message is kept that fits into what may wait for the scene."""


class Outbox:
    """`max_bytes` of messages may wait. `drops` counts those that never leave."""

    def __init__(self, max_bytes: int, drops: Counter[DropReason]) -> None:
        self.nbytes = 0
        """Bytes of messages of streams and services; each counts as ITEM_BYTES more than it has."""
        self._max_bytes = max_bytes
        self._drops = drops
        self._said: BoundedQueue[bytes] = BoundedQueue(max_bytes=MAX_SAID_BYTES)
        self._list: bytes | None = None
        self._services: deque[Pieces] = deque()
        self._streams: dict[Hashable, BoundedQueue[Pieces]] = {}
        self._turns: deque[Hashable] = deque()

    def __len__(self) -> int:
        """Messages that wait."""
        return len(self._services) + sum(len(queue) for queue in self._streams.values())

    def say(self, command: bytes) -> None:
        """A text for its console."""
        self._said.put(command, len(command) + ITEM_BYTES)

    def answer_list(self, command: bytes) -> None:
        """The list of topics; only the newest counts."""
        self._list = command

    def service(self, pieces: Pieces) -> bool:
        """A request or response with the command before it. False: too much waits, and it is not sent."""
        nbytes = _size(pieces)
        if self.nbytes + nbytes > self._max_bytes and self.nbytes:
            return False
        self._services.append(pieces)
        self.nbytes += nbytes
        return True

    def put(self, stream: Hashable, pieces: Pieces, keep: Keep) -> None:
        """A message of a stream."""
        queue = self._streams.get(stream)
        if queue is None:
            queue = self._streams[stream] = BoundedQueue(max_bytes=self._max_bytes, max_items=keep.max_items)
            self._turns.append(stream)
        nbytes = _size(pieces)
        before = queue.nbytes
        dropped = queue.put(pieces, nbytes)
        self.nbytes += queue.nbytes - before
        if dropped:
            self._drops[keep.why] += len(dropped)
        while self.nbytes > self._max_bytes and len(self) > 1:
            self._make_room(stream)

    def pop(self) -> Pieces | None:
        """What leaves next; None: nothing waits."""
        if len(self._said):
            return (self._said.pop(),)
        if self._list is not None:
            command, self._list = self._list, None
            return (command,)
        if self._services:
            pieces = self._services.popleft()
            self.nbytes -= _size(pieces)
            return pieces
        if not self._turns:
            return None
        stream = self._turns.popleft()
        pieces = self._taken(stream)
        if stream in self._streams:
            self._turns.append(stream)
        return pieces

    def forget(self, stream: Hashable, why: DropReason) -> None:
        """What waits of a stream is not sent."""
        queue = self._streams.pop(stream, None)
        if queue is not None:
            self._turns.remove(stream)
            self.nbytes -= queue.nbytes
            self._drops[why] += len(queue)

    def clear(self, why: DropReason) -> None:
        """Nothing leaves any more."""
        waiting = len(self)
        if waiting:
            self._drops[why] += waiting
        self._said.clear()
        self._list = None
        self._services.clear()
        self._streams.clear()
        self._turns.clear()
        self.nbytes = 0

    def _make_room(self, newest: Hashable) -> None:
        """Drop the oldest message of the stream of which most waits; one that has only just come last."""
        others = [stream for stream, queue in self._streams.items() if stream != newest or len(queue) > 1]
        if not others:
            self.forget(newest, DropReason.QUEUE_FULL)  # services alone fill it
            return
        most = max(others, key=lambda stream: self._streams[stream].nbytes)
        self._taken(most)
        if most not in self._streams:
            self._turns.remove(most)
        self._drops[DropReason.QUEUE_FULL] += 1

    def _taken(self, stream: Hashable) -> Pieces:
        queue = self._streams[stream]
        before = queue.nbytes
        pieces = queue.pop()
        self.nbytes += queue.nbytes - before
        if not len(queue):
            del self._streams[stream]
        return pieces


def _size(pieces: Pieces) -> int:
    return sum(map(len, pieces)) + ITEM_BYTES
