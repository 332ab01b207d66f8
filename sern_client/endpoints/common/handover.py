"""The way from threads of a middleware to the event loop: bounded, in order, one wake-up for many items."""

import asyncio
from collections import deque
from collections.abc import Callable
from threading import Lock
from typing import Final, NamedTuple

from sern_client.endpoints.common.queue import BoundedQueue
from sern_runtime import clock

DEFAULT_MAX_BYTES: Final = 64 * 2**20
ITEM_BYTES: Final = 100
"""What a message counts for beside its bytes: an empty one is kept in memory, too."""
TURN_S: Final = 0.005
"""How long the loop serves items before it looks at its sockets and timers again."""


class _News(NamedTuple):
    number: int
    deliver: Callable[[], None]


class _Message(NamedTuple):
    number: int
    deliver: Callable[[], None]
    shed: Callable[[], None] | None


class Handover:
    """`put` and `news` from any thread; `deliver` items run on the loop in the order they came.

    At most `max_bytes` of messages wait; beyond, the oldest are dropped, and counted in `dropped`: a loop that is
    behind serves what is fresh. The newest message is never dropped. `rest` is called in the thread that has just woken
    the loop.
    """

    def __init__(
        self, loop: asyncio.AbstractEventLoop, *, max_bytes: int = DEFAULT_MAX_BYTES,
        rest: Callable[[], None] = lambda: None,
    ) -> None:  # fmt: skip
        self.dropped = 0
        """Messages, because more than `max_bytes` waited (queue_full)."""
        self._loop = loop
        self._rest = rest
        self._lock = Lock()
        self._count = 0
        self._news: deque[_News] = deque()
        self.messages: BoundedQueue[_Message] = BoundedQueue(max_bytes=max_bytes)
        """Those that wait; to be changed in here alone."""
        self._scheduled = False
        self._closed = False

    def news(self, deliver: Callable[[], None]) -> None:
        """What is said once and must arrive, and only then: changes of the graph, the end of a call."""
        with self._lock:
            if self._closed:
                return
            self._count += 1
            self._news.append(_News(self._count, deliver))
            wake = self._wakes()
        if wake:
            self._loop.call_soon_threadsafe(self._run)
            self._rest()

    def put(self, deliver: Callable[[], None], nbytes: int, shed: Callable[[], None] | None = None) -> None:
        """A message that keeps `nbytes` in memory. `shed` is called in its place when it is dropped, in whatever thread
        put the message that took its place."""
        with self._lock:
            if self._closed:
                return
            self._count += 1
            dropped = self.messages.put(_Message(self._count, deliver, shed), nbytes + ITEM_BYTES)
            self.dropped += len(dropped)
            wake = self._wakes()
        if wake:
            self._loop.call_soon_threadsafe(self._run)
            self._rest()
        for message in dropped:
            if message.shed is not None:
                message.shed()

    def close(self) -> None:
        """Nothing more is delivered."""
        with self._lock:
            self._closed = True
            self._news.clear()
            self.messages.clear()

    def _wakes(self) -> bool:
        """Whether the loop is to be woken: it is not while it has items to serve."""
        wake, self._scheduled = not self._scheduled, True
        return wake

    def _next(self) -> Callable[[], None] | None:
        """The oldest item; None where there is no more, and the next one wakes the loop."""
        with self._lock:
            if self.messages and not (self._news and self._news[0].number < self.messages.first.number):
                return self.messages.pop().deliver
            if self._news:
                return self._news.popleft().deliver
            self._scheduled = False
            return None

    def _run(self) -> None:
        until_s = clock.now() + TURN_S
        while (deliver := self._next()) is not None:
            try:
                deliver()
            except Exception as error:  # noqa: BLE001  (of one item: those behind it are not lost with it)
                message = "an item from another thread could not be delivered"
                self._loop.call_exception_handler({"message": message, "exception": error})
            if clock.now() >= until_s:
                self._loop.call_soon(self._run)
                return
