"""What waits for somebody who may be slow: bounded in count and bytes, the freshest is kept."""

from collections import deque
from collections.abc import Iterator, Sequence
from math import inf
from typing import Generic, TypeVar

T = TypeVar("T")


class BoundedQueue(Generic[T]):
    """Items in the order they came, with the bytes that each keeps in memory.

    Beyond `max_items` or `max_bytes` the oldest go, and whoever puts counts them. The newest never goes.
    """

    def __init__(self, *, max_bytes: int, max_items: float = inf) -> None:
        self.max_bytes = max_bytes
        self.max_items = max_items
        self.nbytes = 0
        self._items: deque[tuple[T, int]] = deque()

    def __len__(self) -> int:
        return len(self._items)

    def __iter__(self) -> Iterator[T]:
        return (item for item, _ in self._items)

    @property
    def first(self) -> T:
        """The oldest; only where there is one."""
        return self._items[0][0]

    def put(self, item: T, nbytes: int) -> Sequence[T]:
        """Append an item. Returns those that went for it, the oldest first."""
        self._items.append((item, nbytes))
        self.nbytes += nbytes
        dropped: list[T] = []
        while (self.nbytes > self.max_bytes or len(self._items) > self.max_items) and len(self._items) > 1:
            dropped.append(self.pop())
        return dropped

    def pop(self) -> T:
        """The oldest, which waits no more."""
        item, nbytes = self._items.popleft()
        self.nbytes -= nbytes
        return item

    def clear(self) -> None:
        self._items.clear()
        self.nbytes = 0
