"""Child processes that never outlive their parent's work: started together, watched, stopped in order.

Each child is a session of its own, so that Ctrl-C in the terminal reaches only the parent, which then stops the
children the way a supervisor does: SIGTERM, time to drain, SIGKILL. What a child writes on standard error is kept, and
the last of it is in the error that tells of its end.
"""

import asyncio
import contextlib
import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Self, TypeVar

from sern_core.vocabulary.errors import SernError
from sern_tools.harness import launcher
from sern_tools.harness import sweeper as sweeping

DRAIN_S: Final = 45.0
"""How long a child may take to end after SIGTERM when all is well: a daemon drains first."""
ABORT_S: Final = 5.0
"""The same when the whole is being given up."""
LOOK_S: Final = 0.2
"""How soon who waits notices that a child has ended."""
TAIL_LINES: Final = 4
LINE_BYTES: Final = 2**20
_PLAIN_PYTHON: Final = (sys.executable, "-I", "-S")
"""The Python command for helpers that import nothing that is installed."""

T = TypeVar("T")


def python(*arguments: str) -> list[str]:
    """A command of this interpreter, e.g. `python("-m", "sern_tools.proxy")`.

    `-P`: the folder it is started in does not say what is imported.
    """
    return [sys.executable, "-P", *arguments]


def daemon(program: str, config: Path) -> list[str]:
    """The command of a daemon of this interpreter; `program`: relay or client."""
    return python("-m", f"sern_{program}.cli", "--config", str(config))


def cpu_s(*pids: int) -> float:
    """CPU time of these processes, all threads, those that have ended as well; also of who was not waited for yet.
    OSError when one is no more.

    The clock is that of clock_getcpuclockid(3): nanoseconds, where /proc/PID/stat has ticks of 10 ms.
    """
    return sum(time.clock_gettime((~pid << 3) | 2) for pid in pids)


def bound(command: Sequence[str]) -> list[str]:
    """`command` as one that gets SIGKILL when this process ends, even by kill -9. FileNotFoundError."""
    found = shutil.which(command[0])
    if found is None:
        raise FileNotFoundError(errno.ENOENT, "no such program", command[0])
    return [*_PLAIN_PYTHON, launcher.__file__, str(os.getpid()), found, *command[1:]]


@contextlib.contextmanager
def swept(directory: Path) -> Iterator[Path]:
    """Remove `directory` at the end of the block, or of this process if that comes first, even by kill -9."""
    sweeper = subprocess.Popen(
        [*_PLAIN_PYTHON, sweeping.__file__, str(directory)], stdin=subprocess.PIPE, start_new_session=True
    )
    try:
        yield directory
    finally:
        assert sweeper.stdin is not None
        sweeper.stdin.close()
        sweeper.wait()


def last_words(log: Path, *, from_traceback: bool = False) -> str:
    """The last lines of a log as one, without the frames of tracebacks. Empty with no log, or with nothing in it.

    `from_traceback`: of a log with tracebacks what the last of them comes to, and what follows.
    """
    try:
        lines = log.read_text(errors="replace").splitlines()
    except OSError:
        return ""
    kept: list[str] = []
    inside_traceback = False
    for line in lines:
        begins = line.startswith("Traceback (")
        if begins and from_traceback:
            kept.clear()
        inside_traceback = begins or (inside_traceback and line[:1].isspace())
        if line.strip() and not inside_traceback:
            kept.append(line.strip())
    return " | ".join(kept[-TAIL_LINES:])


def failure(name: str, code: int | None, log: Path) -> SernError:
    """One line about a process that ended: who, how, and its last words from `log`, its standard error.

    `code`: its exit status, negative a signal's number, None while it runs.
    """
    outcome = "output closed"
    if code is not None:
        outcome = f"exit status {code}" if code >= 0 else f"signal {signal.Signals(-code).name}"
    words = last_words(log, from_traceback=True)
    return SernError(f"{name} ended ({outcome}){f': {words}' if words else ' and said nothing'}")


@dataclass(eq=False)
class Child:
    """One process. Its standard error goes to `log`; its standard output, unless `lines`, too."""

    name: str
    process: asyncio.subprocess.Process
    log: Path
    stopping: bool = False

    @property
    def running(self) -> bool:
        return self.process.returncode is None

    async def read_line(self) -> bytes:
        """The next line of its output. SernError when it ended instead."""
        assert self.process.stdout is not None
        line = await self.process.stdout.readline()
        if not line:
            await self.process.wait()
            raise self.failure()
        return line

    async def read_object(self) -> dict[str, Any]:
        """The next line of its output as JSON. SernError when it ended instead."""
        answer: dict[str, Any] = json.loads(await self.read_line())
        return answer

    async def say(self, word: str) -> None:
        """Send one line to its input. Nothing happens when it has ended: what it does not answer says so."""
        assert self.process.stdin is not None
        if not self.process.stdin.is_closing():  # else it has ended, and uvloop raises RuntimeError for a write
            with contextlib.suppress(ConnectionError):
                self.process.stdin.write(word.encode() + b"\n")
                await self.process.stdin.drain()

    async def ask(self, word: str) -> dict[str, Any]:
        """Send one line to its input and return the line it answers."""
        await self.say(word)
        return await self.read_object()

    def signal(self, number: int) -> None:
        if self.running:
            # asyncio's own send_signal first asks whether it has ended, and then nobody learns its exit status.
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.process.pid, number)

    def failure(self) -> SernError:
        """One line: who ended, how, and its last words."""
        return failure(self.name, self.process.returncode, self.log)


@dataclass
class Children:
    """`async with Children(directory) as children:` every child that is left at the end is stopped."""

    directory: Path
    children: list[Child] = field(default_factory=list)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        # Whoever cancels must not be able to leave a child behind: the stop runs to its end in a task of its own.
        stop = asyncio.ensure_future(self.stop(self.children, within_s=ABORT_S))
        cancelled = False
        while not stop.done():
            try:
                await asyncio.shield(stop)
            except asyncio.CancelledError:
                cancelled = True
                self.kill()
        stop.result()
        if cancelled:
            raise asyncio.CancelledError

    async def start(
        self,
        name: str,
        command: Sequence[str],
        *,
        talks: bool = False,
        environment: Mapping[str, str | None] | None = None,
    ) -> Child:
        """`talks`: its input and output are pipes for `ask` and `read_object`. `environment` goes on top of this
        process's own; None takes a variable away. SernError when it cannot be run."""
        log = self.directory / f"{name}.log"
        pipe = asyncio.subprocess.PIPE if talks else None
        merged: dict[str, str | None] = {**os.environ, **(environment or {})}
        try:
            with log.open("wb") as stream:
                process = await asyncio.create_subprocess_exec(
                    *bound(command),
                    stdin=pipe or asyncio.subprocess.DEVNULL,
                    stdout=pipe or stream,
                    stderr=stream,
                    start_new_session=True,
                    env={key: value for key, value in merged.items() if value is not None},
                    limit=LINE_BYTES,
                )
        except OSError as error:
            raise SernError(f"cannot start {name}: {command[0]}: {error.strerror}") from error
        child = Child(name, process, log)
        self.children.append(child)
        return child

    def cpu_s(self) -> dict[str, float]:
        """CPU time by name; as the function."""
        return {child.name: cpu_s(child.process.pid) for child in self.children}

    def check(self) -> None:
        """Raises SernError when a child ended that nobody told to."""
        for child in self.children:
            if not child.running and not child.stopping:
                raise child.failure()

    def words(self) -> str:
        """The last words of all of them, as an addition to an error; empty where nobody has said anything."""
        told = [f"{child.name} said: {words}" for child in self.children if (words := last_words(child.log))]
        return f" ({'; '.join(told)})" if told else ""

    async def beside(self, work: Awaitable[T]) -> T:
        """What `work` comes to. As soon as a child ends that nobody told to, `work` is cancelled, and the SernError has
        the child's last words."""
        task = asyncio.ensure_future(work)
        try:
            while not (await asyncio.wait((task,), timeout=LOOK_S))[0]:
                self.check()
            if task.exception() is not None:
                self.check()  # which may be why
            return task.result()
        finally:
            task.cancel()
            await asyncio.wait((task,))

    async def within(self, work: Awaitable[T], seconds: float, problem: str) -> T:
        """Wait as `beside`; SernError of `problem`, with the last words of all, when it takes longer."""
        try:
            async with asyncio.timeout(seconds):
                return await self.beside(work)
        except TimeoutError:
            raise SernError(f"{problem} within {seconds:g} s{self.words()}") from None

    async def until(
        self, condition: Callable[[], Awaitable[object]], seconds: float, problem: str, *, every_s: float = 0.1
    ) -> None:
        """Ask until `condition` is met; as `within`."""

        async def met() -> None:
            while not await condition():  # noqa: ASYNC110  the condition is somebody else's state
                await asyncio.sleep(every_s)

        await self.within(met(), seconds, problem)

    async def stop(
        self, children: Iterable[Child], *, number: int | None = signal.SIGTERM, within_s: float = DRAIN_S
    ) -> list[Child]:
        """The end of their input to all of them, one after the other, and the signal `number`, if any; SIGKILL for who
        is still there after `within_s`. Who that was."""
        leaving = list(children)
        for child in leaving:
            child.stopping = True
            if child.process.stdin is not None:
                child.process.stdin.close()
            if number is not None:
                child.signal(number)
        waits = [asyncio.ensure_future(child.process.wait()) for child in leaving]
        if not waits:
            return []
        _, pending = await asyncio.wait(waits, timeout=within_s)
        late = [child for child, wait in zip(leaving, waits, strict=True) if wait in pending]
        if late:
            self.kill()
            await asyncio.wait(waits)
        return late

    async def end(self, *children: Child, number: int | None = signal.SIGTERM, within_s: float = DRAIN_S) -> None:
        """`stop` those that have done their work. SernError when one is late, or ends with a status other than 0."""
        for child in await self.stop(children, number=number, within_s=within_s):
            raise SernError(f"{child.name} does not end within {within_s:g} s{self.words()}")
        for child in children:
            if child.process.returncode != 0:
                raise child.failure()

    def kill(self) -> None:
        for child in self.children:
            child.signal(signal.SIGKILL)


@contextlib.asynccontextmanager
async def killed(directory: Path) -> AsyncIterator[Children]:
    """Children that have nothing more to do at the end of the block: who is left gets SIGKILL."""
    async with Children(directory) as children:
        try:
            yield children
        finally:
            children.kill()


def program(name: str) -> list[str]:
    """The command of an installed SERN program. SernError when it is not installed beside this Python."""
    path = Path(sys.executable).with_name(name)
    if not path.exists():
        raise SernError(f"{name} is not installed beside {sys.executable}: install SERN there")
    return [str(path)]
