"""Plans in a process of their own: one takes longer than a control cycle has, and holds the interpreter meanwhile.

Requests and plans are pickled, each behind its length, over pipes that nobody else has. The process ends when its input
does, so it never outlives this one, however that ends.
"""

import asyncio
import logging
import pickle
import signal
import struct
import sys
from contextlib import suppress
from typing import BinaryIO, Final, Protocol

from sern_client.endpoints.common.saying import say_failure
from sern_navigation.global_plan import Plan, PlanRequest, plan_for
from sern_navigation.navigator import Navigator

ANSWER_S: Final = 30.0
"""A process that answers nothing for so long stands still; also a machine that is busy starts one by then."""
_LENGTH: Final = struct.Struct("<Q")
_COMMAND: Final = (sys.executable, "-P", "-m", "sern_client.navigation.planning")
_log: Final = logging.getLogger(__name__)


class Planner(Protocol):
    """Who makes the plans that a navigator asks for."""

    @property
    def failures(self) -> int: ...

    async def warm(self) -> None:
        """Return when plans can be made."""
        ...

    def look(self) -> None:
        """Have the plan made that the navigator wants, if it wants one. After each of its steps."""
        ...

    async def close(self) -> None: ...


class PlannerProcess:
    """Answers what a navigator asks for. `close` ends the process."""

    def __init__(self, navigator: Navigator) -> None:
        self._navigator = navigator
        self._process: asyncio.subprocess.Process | None = None
        self._request: PlanRequest | None = None
        self._task: asyncio.Task[None] | None = None
        self._wanted = asyncio.Event()
        self.failures = 0
        """How often the process ended, and was started again."""

    @property
    def pid(self) -> int | None:
        """The process; None: there is none now."""
        return None if self._process is None else self._process.pid

    async def warm(self) -> None:
        """Return when the process runs: it imports scipy, which takes a second."""
        await self._ask(None)
        self._task = asyncio.create_task(self._run(), name="plans")
        self._task.add_done_callback(say_failure)

    def look(self) -> None:
        """Have the plan made that the navigator wants: of several, the last one. After each of its steps."""
        request = self._navigator.request()
        if request is not None:
            self._request = request
            self._wanted.set()

    async def _run(self) -> None:
        while True:
            await self._wanted.wait()
            self._wanted.clear()
            request, self._request = self._request, None
            plan = await self._ask(request)
            if plan is not None and request is not None:
                self._navigator.planned(request, plan)

    async def _ask(self, request: PlanRequest | None) -> Plan | None:
        """The answer; None: the process has ended. The navigator gives up waiting then, and asks again."""
        try:
            async with asyncio.timeout(ANSWER_S):
                return await self._answered(request)
        except (OSError, EOFError, TimeoutError) as error:  # IncompleteReadError is an EOFError
            self.failures += 1
            _log.error("the process that plans does not answer (%s); it is started again", type(error).__name__)
            await self._end()
            return None

    async def _answered(self, request: PlanRequest | None) -> Plan | None:
        process = self._process
        if process is None:
            process = self._process = await asyncio.create_subprocess_exec(
                *_COMMAND, stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE, start_new_session=True
            )
        assert process.stdin is not None and process.stdout is not None
        body = pickle.dumps(request, pickle.HIGHEST_PROTOCOL)
        process.stdin.write(_LENGTH.pack(len(body)) + body)
        await process.stdin.drain()
        (length,) = _LENGTH.unpack(await process.stdout.readexactly(_LENGTH.size))
        answer: Plan | None = pickle.loads(await process.stdout.readexactly(length))
        return answer

    async def close(self) -> None:
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)
        await self._end()

    async def _end(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            with suppress(ProcessLookupError):
                process.kill()
            await process.wait()


def _read(pipe: BinaryIO) -> bytes | None:
    """None at its end."""
    head = pipe.read(_LENGTH.size)
    return pipe.read(_LENGTH.unpack(head)[0]) if len(head) == _LENGTH.size else None


def main() -> None:
    """Answer requests on standard input until it ends. Ctrl-C is for the process that owns this one."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    while (body := _read(sys.stdin.buffer)) is not None:
        request: PlanRequest | None = pickle.loads(body)
        answer = pickle.dumps(None if request is None else plan_for(request), pickle.HIGHEST_PROTOCOL)
        sys.stdout.buffer.write(_LENGTH.pack(len(answer)) + answer)
        sys.stdout.buffer.flush()


if __name__ == "__main__":
    main()
