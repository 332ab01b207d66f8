"""The way from threads of a middleware to the event loop: bounded, in order, one wake-up for many items."""

import asyncio
from collections import deque
from collections.abc import Callable
from threading import Lock
from typing import Final

DEFAULT_MAX_BYTES: Final = 64 * 2**20


class Handover:
    """`put` from any thread; `deliver` items run on the loop in the order they were put.

    At most `max_bytes` wait; beyond, the oldest that may be dropped are, and counted in `dropped`: a loop that is
    behind serves what is fresh.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, *, max_bytes: int = DEFAULT_MAX_BYTES) -> None:
        self.dropped = 0
        self._loop = loop
        self._max_bytes = max_bytes
        self._lock = Lock()
        self._items: deque[tuple[Callable[[], None], int]] = deque()
        self._nbytes = 0
        self._scheduled = False
        self._closed = False

    def put(self, deliver: Callable[[], None], nbytes: int = 0) -> None:
        """`nbytes` 0: never dropped (news of the graph)."""
        with self._lock:
            if self._closed:
                return
            self._items.append((deliver, nbytes))
            self._nbytes += nbytes
            if self._nbytes > self._max_bytes:
                self._shed()
            if self._scheduled:
                return
            self._scheduled = True
        self._loop.call_soon_threadsafe(self._run)

    def close(self) -> None:
        """Nothing more is delivered."""
        with self._lock:
            self._closed = True
            self._items.clear()
            self._nbytes = 0

    def _shed(self) -> None:
        kept: deque[tuple[Callable[[], None], int]] = deque()
        while self._nbytes > self._max_bytes and len(self._items) > 1:
            item = self._items.popleft()
            if item[1]:
                self._nbytes -= item[1]
                self.dropped += 1
            else:
                kept.append(item)
        self._items.extendleft(reversed(kept))

    def _run(self) -> None:
        with self._lock:
            items, self._items = self._items, deque()
            self._nbytes = 0
            self._scheduled = False
        for deliver, _ in items:
            if self._closed:
                return
            try:
                deliver()
            except Exception as error:  # noqa: BLE001  (of one item: those behind it are not lost with it)
                message = "an item from another thread could not be delivered"
                self._loop.call_exception_handler({"message": message, "exception": error})
