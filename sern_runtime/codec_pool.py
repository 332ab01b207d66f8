"""Threads that encode and decode large bodies beside the event loop. Both libraries release the interpreter lock."""

import asyncio
import logging
import os
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from heapq import heappop, heappush
from typing import Final

from sern_core.codecs import Coder, Work
from sern_core.params import LinkParams
from sern_runtime import clock

WORKERS: Final = 2
"""One body being decoded does not keep another from being encoded."""
NICE: Final = 5
"""The loop's own thread goes first when there are fewer cores than work."""

_log = logging.getLogger(__name__)


def _step_back() -> None:
    os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICE)


class CodecPool:
    """Runs work of a `Coder` in threads, the more urgent class first, and finishes it on the loop.

    `after` is called when something was finished: a link may have something to send. Make it and `close` it on the
    loop; work that has not begun by then is forgotten.
    """

    def __init__(self, *, after: Callable[[], None], workers: int = WORKERS) -> None:
        self._after = after
        self._workers = workers
        self._loop = asyncio.get_running_loop()
        self._executor = ThreadPoolExecutor(workers, thread_name_prefix="codec", initializer=_step_back)
        self._waiting: list[tuple[int, int, Work]] = []
        self._count = 0
        self._running = 0
        self._closed = False

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
            self._executor.submit(self._run, heappop(self._waiting)[2])

    def _run(self, work: Work) -> None:
        """In a thread. Whatever goes wrong there, the message must not wait for ever."""
        try:
            work.run()
        except Exception:  # noqa: BLE001  (a fault of one body; the daemon goes on)
            _log.exception("a body could not be worked on")
        finally:
            self._loop.call_soon_threadsafe(self._done, work)

    def _done(self, work: Work) -> None:
        self._running -= 1
        if self._closed:
            return
        self._start()
        work.done(now=clock.now())
        self._after()


def make_coder(link: LinkParams, pool: CodecPool) -> Coder:
    """The coder of a daemon: with a stopwatch, and with threads for what is large."""
    return Coder(max_bytes=link.max_message_bytes, clock=time.perf_counter, offload=pool.take)
