"""Child processes that never outlive their parent's work: started together, watched, stopped in order.

Each child is a session of its own, so that Ctrl-C in the terminal reaches only the parent, which then stops the
children the way a supervisor does: SIGTERM, time to drain, SIGKILL.
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
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Self

from sern_core.vocabulary.errors import SernError
from sern_tools.harness import launcher
from sern_tools.harness import sweeper as sweeping

DRAIN_S: Final = 45.0
"""How long a child may take to end after SIGTERM when all is well: a daemon drains first."""
ABORT_S: Final = 5.0
"""The same when the whole is being given up."""
TAIL_LINES: Final = 4
LINE_BYTES: Final = 2**20
_PLAIN_PYTHON: Final = (sys.executable, "-I", "-S")
"""The Python command for helpers that import nothing that is installed."""


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

    async def read_object(self) -> dict[str, Any]:
        """The next line of its output as JSON. SernError when it ended instead."""
        assert self.process.stdout is not None
        line = await self.process.stdout.readline()
        if not line:
            await self.process.wait()
            raise self.failure()
        answer: dict[str, Any] = json.loads(line)
        return answer

    async def ask(self, word: str) -> dict[str, Any]:
        """Send one line to its input and return the line it answers."""
        assert self.process.stdin is not None
        if not self.process.stdin.is_closing():  # else it has ended, and uvloop raises RuntimeError for a write
            with contextlib.suppress(ConnectionError):  # it has ended; the missing answer says so
                self.process.stdin.write(word.encode() + b"\n")
                await self.process.stdin.drain()
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

    def check(self) -> None:
        """Raises SernError when a child ended that nobody told to."""
        for child in self.children:
            if not child.running and not child.stopping:
                raise child.failure()

    async def stop(self, children: Iterable[Child], *, within_s: float = DRAIN_S) -> None:
        """SIGTERM to all of them and the end of their input; SIGKILL for who is still there after `within_s`."""
        leaving = list(children)
        for child in leaving:
            child.stopping = True
            if child.process.stdin is not None:
                child.process.stdin.close()
            child.signal(signal.SIGTERM)
        waits = [asyncio.ensure_future(child.process.wait()) for child in leaving]
        if waits:
            _, late = await asyncio.wait(waits, timeout=within_s)
            if late:
                self.kill()
                await asyncio.wait(waits)

    def kill(self) -> None:
        for child in self.children:
            child.signal(signal.SIGKILL)


def program(name: str) -> list[str]:
    """The command of an installed SERN program. SernError when it is not installed beside this Python."""
    path = Path(sys.executable).with_name(name)
    if not path.exists():
        raise SernError(f"{name} is not installed beside {sys.executable}: install SERN there")
    return [str(path)]
