"""Calls of services: those that wait for their answers, and those that are being answered."""

import asyncio
from collections.abc import AsyncIterator, Coroutine, Iterator
from contextlib import asynccontextmanager, contextmanager
from typing import Any

from sern_core.vocabulary.errors import ServiceError


@asynccontextmanager
async def within(timeout_s: float, problem: str) -> AsyncIterator[None]:
    """ServiceError with this problem when what is inside takes longer."""
    try:
        async with asyncio.timeout(timeout_s):
            yield
    except TimeoutError:
        raise ServiceError(problem) from None


class PendingCalls:
    """Calls that wait for their answers, by number. What is said of another number changes nothing."""

    def __init__(self) -> None:
        self._waiting: dict[int, asyncio.Future[bytes]] = {}

    def __len__(self) -> int:
        return len(self._waiting)

    def __iter__(self) -> Iterator[int]:
        return iter(self._waiting)

    @contextmanager
    def call(self, number: int) -> Iterator[asyncio.Future[bytes]]:
        """The answer of a call that waits inside; it may raise ServiceError."""
        answer = self._waiting[number] = asyncio.get_running_loop().create_future()
        try:
            yield answer
        finally:
            del self._waiting[number]

    def answer(self, number: int, body: bytes) -> None:
        """A call is answered; the first answer holds."""
        answer = self._waiting.get(number)
        if answer is not None and not answer.done():
            answer.set_result(body)

    def fail(self, number: int, problem: str) -> None:
        """A call has failed, unless it was answered."""
        answer = self._waiting.get(number)
        if answer is not None and not answer.done():
            answer.set_exception(ServiceError(problem))

    def fail_all(self, problem: str) -> None:
        for number in self._waiting:
            self.fail(number, problem)


class Tasks:
    """What is being done for callers, at most `most` at a time."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._tasks: set[asyncio.Task[None]] = set()

    @property
    def full(self) -> bool:
        return len(self._tasks) >= self._most

    def begin(self, work: Coroutine[Any, Any, None], *, name: str | None = None) -> None:
        """Not when `full`: the caller looks first, and says so to whoever asks."""
        task = asyncio.create_task(work, name=name)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def cancel(self) -> None:
        for task in self._tasks:
            task.cancel()

    async def ended(self) -> None:
        """Return when nothing of what there is now goes on."""
        await asyncio.gather(*self._tasks, return_exceptions=True)
