"""Threads that encode and decode large bodies beside the event loop. Both libraries release the interpreter lock."""

import asyncio
import os
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from heapq import heappop, heappush
from typing import Final

from sern_core.bodies.codecs import Coder, Work
from sern_core.vocabulary.params import LinkParams
from sern_runtime import clock
from sern_runtime.optional import OptionalParts

WORKERS: Final = 2
"""One body being decoded does not keep another from being encoded."""
NICE: Final = 5
"""The loop's own thread goes first when there are fewer cores than work."""

PART: Final = "codecs"


def _step_back() -> None:
    with suppress(OSError):  # then they run beside the loop's thread, not behind it
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICE)


class CodecPool:
    """Runs work of a `Coder` in threads, the more urgent class first, and finishes it on the loop.

    `after` is called when something was finished: a link may have something to send. Make it and `close` it on the
    loop; work that has not begun by then is forgotten.
    """

    def __init__(
        self, *, after: Callable[[], None], workers: int = WORKERS, parts: OptionalParts | None = None
    ) -> None:
        self._parts = parts or OptionalParts(PART)
        self._after = after
        self._workers = workers
        self._loop = asyncio.get_running_loop()
        self._executor = self._new_executor()
        self._waiting: list[tuple[int, int, Work]] = []
        self._count = 0
        self._running = 0
        self._closed = False

    def fault(self, error: Exception) -> None:
        """A codec raised what it must not; in any thread."""
        self._parts.failed(PART, error)

    def _new_executor(self) -> ThreadPoolExecutor:
        return ThreadPoolExecutor(self._workers, thread_name_prefix="codec", initializer=_step_back)

    def take(self, work: Work) -> None:
        """What `Coder.offload` calls."""
        self._count += 1
        heappush(self._waiting, (work.priority, self._count, work))
        self._start()

    def close(self) -> None:
        """Wait for what is under way, at most a few bodies. Idempotent."""
        self._closed = True
        self._waiting.clear()
        self._executor.shutdown(wait=True)

    def _start(self) -> None:
        while self._running < self._workers and self._waiting and not self._closed:
            self._running += 1
            work = heappop(self._waiting)[2]
            try:
                self._executor.submit(self._run, work)
            except RuntimeError as error:  # its threads are dead, or there is no room for them
                self._parts.failed(PART, error)
                self._executor.shutdown(wait=False)
                self._executor = self._new_executor()
                self._loop.call_soon(self._run, work)  # here, this once

    def _run(self, work: Work) -> None:
        """Runs in a thread. Whatever goes wrong there, the message must not wait for ever."""
        problem: Exception | None = None
        try:
            work.run()
        except Exception as error:  # noqa: BLE001  (a fault of one body; the daemon goes on)
            problem = error
        finally:
            self._loop.call_soon_threadsafe(self._done, work, problem)

    def _done(self, work: Work, problem: Exception | None) -> None:
        self._running -= 1
        if problem is not None:
            self._parts.failed(PART, problem)
        if self._closed:
            return
        self._start()
        try:
            work.done(now=clock.now())
        except Exception as error:  # noqa: BLE001  (of one body; the loop goes on)
            self.fault(error)
        self._after()


def make_coder(link: LinkParams, pool: CodecPool) -> Coder:
    """The coder of a daemon: with a stopwatch, and with threads for what is large."""
    coder = Coder(max_bytes=link.max_message_bytes, clock=time.perf_counter, offload=pool.take)
    coder.on_fault = pool.fault
    return coder
