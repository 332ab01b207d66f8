"""Processes that a benchmark starts, and how their own words reach its user.

The benchmarks are not installed: a child finds them, and the code of this checkout, by PYTHONPATH, wherever it is
started and whatever is installed beside its interpreter. What a child writes on standard error is kept; when it fails,
the last of it is in the benchmark's own error, in one line.
"""

import multiprocessing
import os
import tempfile
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

from sern_core.vocabulary.errors import SernError
from sern_runtime import clock
from sern_tools.harness.processes import failure

ROOT: Final = Path(__file__).absolute().parents[1]
PATIENCE_S: Final = 2.0
"""How long a worker may take to end by itself, and after SIGTERM."""


def environment() -> dict[str, str]:
    """Variables for a child of this interpreter, on top of our own. Programs of another Python must not get them."""
    others = os.environ.get("PYTHONPATH")
    return {"PYTHONPATH": os.pathsep.join([str(ROOT), others] if others else [str(ROOT)])}


class Worker:
    """`target(*arguments)` in a spawned process, whose standard error is kept. To be ended with `end`."""

    def __init__(self, name: str, target: Callable[..., None], *arguments: Any) -> None:
        self.name = name
        descriptor, path = tempfile.mkstemp(prefix="sern-bench-", suffix=".log")
        os.close(descriptor)
        self._log = Path(path)
        self._process = multiprocessing.get_context("spawn").Process(
            target=_work, args=(path, target, arguments), daemon=True
        )

    def start(self) -> None:
        self._process.start()

    @property
    def pid(self) -> int:
        """Its process id; it must have been started."""
        assert self._process.pid is not None
        return self._process.pid

    def check(self) -> None:
        """Raises SernError with its last words when it was started and has ended."""
        if self._process.pid is not None and not self._process.is_alive():
            raise failure(self.name, self._process.exitcode, self._log)

    def hear(self, connection: Connection) -> Any:
        """What it says next on `connection`, whose other end it alone has. SernError with its last words if it ends."""
        try:
            return connection.recv()
        except (EOFError, ConnectionError):
            self._process.join(PATIENCE_S)
            self.check()
            raise SernError(f"{self.name} says nothing any more") from None

    def ask(self, connection: Connection, word: object) -> Any:
        """What it answers to `word`; as `hear`."""
        with suppress(ConnectionError):  # the missing answer says so
            connection.send(word)
        return self.hear(connection)

    def end(self, *, patient: bool) -> None:
        """Started or not. `patient`: it may end by itself."""
        process = self._process
        if process.pid is not None:
            if patient:
                process.join(PATIENCE_S)
            if process.is_alive():
                process.terminate()
                process.join(PATIENCE_S)
            if process.is_alive():
                process.kill()
            process.join()
        process.close()
        self._log.unlink()


def await_workers(condition: Callable[[], bool], workers: Iterable[Worker], problem: str, within_s: float) -> None:
    """Raises SernError with the last words of a worker that ends before `condition` is met, and of `problem` in the
    end."""
    workers = tuple(workers)
    give_up_s = clock.now() + within_s
    while not condition():
        for worker in workers:
            worker.check()
        if clock.now() > give_up_s:
            raise SernError(f"{problem} within {within_s:g} s")
        time.sleep(0.01)


def _work(log: str, target: Callable[..., None], arguments: tuple[Any, ...]) -> None:
    with Path(log).open("ab") as stream:
        os.dup2(stream.fileno(), 2)
    target(*arguments)
