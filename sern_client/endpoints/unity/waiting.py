"""What waits for one scene: answers first, then a message of each topic in turn.

Of a topic that is best effort the newest message is kept, of a reliable one all while there is room.
"""

from collections import Counter, deque
from typing import Final

from sern_client.endpoints.common.queue import BoundedQueue
from sern_core.vocabulary.types import DropReason, TopicName

MAX_ANSWER_BYTES: Final = 16 * 2**20
"""Answers that a scene may leave unread; one message always may wait."""


class Waiting:
    """`max_bytes`: of all topics together, as long as each has one message."""

    def __init__(self, max_bytes: int) -> None:
        self.dropped: Counter[DropReason] = Counter()
        self._max_bytes = max_bytes
        self._answers: deque[bytes] = deque()
        self._answer_bytes = 0
        self._topics: dict[TopicName, BoundedQueue[bytes]] = {}
        self._turns: deque[TopicName] = deque()
        self._nbytes = 0

    def __len__(self) -> int:
        """How many frames wait."""
        return len(self._answers) + sum(map(len, self._topics.values()))

    @property
    def nbytes(self) -> int:
        return self._answer_bytes + self._nbytes

    def answer(self, frames: bytes) -> bool:
        """Frames that go before all messages, together. False: so many wait that the scene reads none."""
        if self._answers and self._answer_bytes + len(frames) > MAX_ANSWER_BYTES:
            return False
        self._answers.append(frames)
        self._answer_bytes += len(frames)
        return True

    def message(self, name: TopicName, frames: bytes, *, reliable: bool) -> None:
        queue = self._topics.get(name)
        if queue is None:
            queue = self._topics[name] = BoundedQueue(max_bytes=self._max_bytes)
        before = queue.nbytes
        if not queue:
            self._turns.append(name)
        queue.max_items = float("inf") if reliable else 1
        gone = queue.put(frames, len(frames))
        self.dropped[DropReason.QUEUE_FULL if reliable else DropReason.SUPERSEDED] += len(gone)
        self._nbytes += queue.nbytes - before
        while self._nbytes > self._max_bytes and self._make_room():
            pass

    def _make_room(self) -> bool:
        """Drop the oldest message of the topic that holds most, unless it has no other."""
        longest = max((queue for queue in self._topics.values() if len(queue) > 1), key=_nbytes, default=None)
        if longest is None:
            return False
        self._nbytes -= len(longest.pop())
        self.dropped[DropReason.QUEUE_FULL] += 1
        return True

    def next(self) -> bytes | None:
        """What is sent next; None: nothing waits."""
        if self._answers:
            frames = self._answers.popleft()
            self._answer_bytes -= len(frames)
            return frames
        if not self._turns:
            return None
        name = self._turns.popleft()
        queue = self._topics[name]
        frames = queue.pop()
        self._nbytes -= len(frames)
        if queue:
            self._turns.append(name)
        return frames

    def forget(self, name: TopicName) -> None:
        """The scene has this topic no more."""
        queue = self._topics.pop(name, None)
        if queue:
            self._nbytes -= queue.nbytes
            self._turns.remove(name)

    def close(self) -> None:
        """Nothing more is sent; what waits is lost."""
        self.dropped[DropReason.DISCONNECTED] += sum(map(len, self._topics.values()))
        self._topics.clear()
        self._turns.clear()
        self._answers.clear()
        self._nbytes = self._answer_bytes = 0


def _nbytes(queue: BoundedQueue[bytes]) -> int:
    return queue.nbytes
