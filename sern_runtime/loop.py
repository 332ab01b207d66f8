"""The event loop of a daemon: uvloop, signals, timers to an absolute deadline, and a detector of blocking calls."""

import asyncio
import logging
import math
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Coroutine
from types import TracebackType
from typing import Any, Final, Protocol, Self

import uvloop

from sern_runtime.clock import now
from sern_runtime.open_files import raise_open_files

KEPT_BYTES: Final = 16 * 2**20
"""Freed memory that a process keeps at the top of a heap."""

_log = logging.getLogger(__name__)
_STOP_SIGNALS: Final = (signal.SIGTERM, signal.SIGINT)


class Shutdown:
    """Tells a daemon to stop. SIGTERM or SIGINT sets it; the second such signal ends the process at once.

    `wait()` returns when the daemon is to drain and end. `on_reload` is called on SIGHUP, on the loop's thread.
    """

    def __init__(self) -> None:
        self.on_reload: Callable[[], None] | None = None
        self.signal_name = ""
        """The signal that asked for the stop, empty when `request` was called by the program itself."""
        self._event = asyncio.Event()

    @property
    def requested(self) -> bool:
        return self._event.is_set()

    def request(self) -> None:
        self._event.set()

    async def wait(self) -> None:
        await self._event.wait()

    def _on_signal(self, number: signal.Signals) -> None:
        if self.requested:
            _log.warning("%s again: ending at once, without draining", number.name)
            logging.shutdown()
            os._exit(128 + number)
        self.signal_name = number.name
        _log.info("%s: stopping", number.name)
        self.request()

    def _on_hangup(self) -> None:
        if self.on_reload is None:
            _log.info("SIGHUP: nothing to reload")
        else:
            self.on_reload()


def keep_freed_memory() -> None:
    """Have the C library keep what large messages free, for the next ones.

    glibc gives more than 128 kB at the top of a heap back to the kernel at once and takes it again with the next
    message, a page fault for every 4 kB: a tenth of the CPU that messages of 64 kB cost (measured). Freeing one
    block that was mapped by itself raises that limit to twice the block's size (mallopt(3), M_MMAP_THRESHOLD).
    """
    block = bytes(KEPT_BYTES // 2)
    del block


def run(main: Callable[[Shutdown], Coroutine[Any, Any, int | None]]) -> int:
    """Run `main(shutdown)` in a new uvloop until it returns; its answer (None: 0) is the exit code.

    The signal handlers are in place before `main` starts and gone when `run` returns. Main thread only.
    """

    keep_freed_memory()
    raise_open_files()

    async def with_signals() -> int:
        loop = asyncio.get_running_loop()
        shutdown = Shutdown()
        for number in _STOP_SIGNALS:
            loop.add_signal_handler(number, shutdown._on_signal, number)
        loop.add_signal_handler(signal.SIGHUP, shutdown._on_hangup)
        try:
            return await main(shutdown) or 0
        finally:
            for number in (*_STOP_SIGNALS, signal.SIGHUP):
                loop.remove_signal_handler(number)

    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        return runner.run(with_signals())


class Cancellable(Protocol):
    def cancel(self) -> object: ...


class Wakeups(Protocol):
    """What a timer needs of an event loop."""

    def call_soon(self, callback: Callable[[], object], /) -> Cancellable: ...

    def call_later(self, delay: float, callback: Callable[[], object], /) -> Cancellable: ...


class Timer:
    """One callback at an absolute deadline, on `clock` (seconds, never stepped).

    uvloop fires delays under 0.5 ms at once, others may fire early, and its own time is cached. So: delays are
    rounded up to whole milliseconds, the clock is read again when the loop wakes us, and an early wake-up waits for
    the rest. The callback never runs before its deadline; it runs at most about 1 ms late on an idle loop.
    """

    __slots__ = ("_callback", "_clock", "_handle", "_loop", "_wake_s", "deadline_s")

    def __init__(
        self,
        callback: Callable[[], None],
        *,
        loop: Wakeups | None = None,
        clock: Callable[[], float] = now,
    ) -> None:
        self.deadline_s: float | None = None
        """When the callback is due; None while unarmed."""
        self._callback = callback
        self._clock = clock
        self._loop: Wakeups = loop or asyncio.get_running_loop()
        self._handle: Cancellable | None = None
        self._wake_s = math.inf  # when the loop will wake us, at the latest

    def arm(self, deadline_s: float | None) -> None:
        """Move the deadline; None disarms. Cheap when called again and again with later deadlines."""
        self.deadline_s = deadline_s
        if deadline_s is None:
            self.cancel()
        elif self._handle is None or deadline_s < self._wake_s:
            self._schedule(deadline_s)

    def cancel(self) -> None:
        """Disarm. Idempotent."""
        self.deadline_s = None
        self._wake_s = math.inf
        if self._handle is not None:
            self._handle.cancel()
            self._handle = None

    def close(self) -> None:
        """Disarm for good."""
        self.cancel()

    def _schedule(self, deadline_s: float) -> None:
        if self._handle is not None:
            self._handle.cancel()
        delay_s = deadline_s - self._clock()
        if delay_s <= 0:
            self._handle = self._loop.call_soon(self._wake)
        else:
            self._handle = self._loop.call_later(math.ceil(delay_s * 1000) / 1000, self._wake)
        self._wake_s = deadline_s

    def _wake(self) -> None:
        self._handle = None
        self._wake_s = math.inf
        deadline_s = self.deadline_s
        if deadline_s is None:
            return
        if self._clock() < deadline_s:
            self._schedule(deadline_s)
            return
        self.deadline_s = None
        self._callback()


class BlockDetector:
    """Reports callbacks that hold the loop's thread for longer than `threshold_s`, with the stack they were in.

    For tests: `async with BlockDetector(0.5) as detector: ...; assert not detector.reports`. A thread looks at the
    loop's pulse; so a report can also mean that the machine was busy: choose a generous threshold.
    """

    def __init__(self, threshold_s: float) -> None:
        self.reports: list[str] = []
        self._threshold_s = threshold_s
        self._pulse_s = 0.0
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._handle: asyncio.Handle | None = None

    async def __aenter__(self) -> Self:
        loop = asyncio.get_running_loop()
        self._beat(loop)
        self._thread = threading.Thread(
            target=self._watch, args=(threading.get_ident(),), name="block-detector", daemon=True
        )
        self._thread.start()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        self._stop.set()
        if self._handle is not None:
            self._handle.cancel()
        if self._thread is not None:
            self._thread.join()

    def _beat(self, loop: asyncio.AbstractEventLoop) -> None:
        self._pulse_s = time.monotonic()
        self._handle = loop.call_later(self._threshold_s / 4, self._beat, loop)

    def _watch(self, thread_id: int) -> None:
        reported_s = -1.0
        while not self._stop.wait(self._threshold_s / 4):
            pulse_s = self._pulse_s
            if time.monotonic() - pulse_s > self._threshold_s and reported_s != pulse_s:
                reported_s = pulse_s
                frame = sys._current_frames().get(thread_id)
                stack = "".join(traceback.format_stack(frame)) if frame is not None else "unknown"
                self.reports.append(f"the loop was held for more than {self._threshold_s:g} s:\n{stack}")
