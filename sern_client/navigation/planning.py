"""Plans in a process of their own: one takes longer than a control cycle has, and holds the interpreter meanwhile."""

import asyncio
import logging
import signal
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from typing import Final

from sern_navigation.global_plan import Plan, PlanRequest, plan_for
from sern_navigation.navigator import Navigator

_log: Final = logging.getLogger(__name__)


class PlannerProcess:
    """Answers what a navigator asks for. `close` ends the process."""

    def __init__(self, navigator: Navigator) -> None:
        self._navigator = navigator
        self._pool = _pool()
        self._task: asyncio.Task[None] | None = None
        self.failures = 0
        """How often the process ended, and was started again."""

    async def warm(self) -> None:
        """Return when the process runs: it imports scipy, which takes a second."""
        await asyncio.get_running_loop().run_in_executor(self._pool, _nothing)

    def look(self) -> None:
        """Have the plan made that the navigator wants, if it wants one. After each of its steps."""
        request = self._navigator.request()
        if request is None:
            return
        if self._task is not None:
            self._task.cancel()  # its goal is another now
        self._task = asyncio.create_task(self._make(request), name="plan")

    async def _make(self, request: PlanRequest) -> None:
        try:
            plan = await asyncio.get_running_loop().run_in_executor(self._pool, _planned, request)
        except BrokenProcessPool:
            self.failures += 1
            _log.error("the process that plans has ended; it is started again")
            self._pool.shutdown(wait=False)
            self._pool = _pool()
            return  # the navigator gives up waiting, and asks again
        self._navigator.planned(request, plan)

    async def close(self) -> None:
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)
        await asyncio.to_thread(self._pool.shutdown, wait=True, cancel_futures=True)


def _pool() -> ProcessPoolExecutor:
    # Not a fork: this process has threads of its middleware.
    return ProcessPoolExecutor(1, get_context("spawn"), initializer=_quietly)


def _quietly() -> None:
    """Ctrl-C is for the process that owns this one, which ends it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _nothing() -> None:
    return None


def _planned(request: PlanRequest) -> Plan:
    return plan_for(request)
