"""What both daemons do around their main coroutine: logging, one-line errors, exit codes."""

import asyncio
import logging
import sys
from collections.abc import Callable, Coroutine, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from sern_core.vocabulary.errors import ConfigError, SernError
from sern_runtime import logs
from sern_runtime.config.shared import LogSection
from sern_runtime.config.yaml import Loc, read_document
from sern_runtime.loop import Shutdown, run

EXIT_CONFIG: Final = 2
EXIT_FAILED: Final = 1
EXIT_INTERRUPTED: Final = 130


def run_daemon(
    program: str,
    read_log: Callable[[], LogSection],
    main: Callable[[Shutdown], Coroutine[Any, Any, int | None]],
    *,
    log_format: logs.LogFormat | None = None,
) -> int:
    """Run a daemon and say in one line what went wrong: exit code 2 for configuration, 1 for anything else.
    `log_format`: in place of `log.format` of the file."""
    try:
        section = read_log()
        logs.configure(log_format=log_format or section.format.value, level=section.level.value.upper())
        return run(main)
    except ConfigError as error:
        print(f"{program}: {error}", file=sys.stderr)
        return EXIT_CONFIG
    except SernError as error:
        print(f"{program}: {error}", file=sys.stderr)
        return EXIT_FAILED
    except KeyboardInterrupt:  # before the loop has its signal handlers, or after it
        return EXIT_INTERRUPTED


async def serve(shutdown: Shutdown, tasks: Sequence[asyncio.Task[None]]) -> None:
    """Wait for the order to stop. A background task that ends before it is a fault: its exception is raised."""
    stop = asyncio.create_task(shutdown.wait(), name="shutdown")
    try:
        await asyncio.wait([stop, *tasks], return_when=asyncio.FIRST_COMPLETED)
    finally:
        stop.cancel()
    for task in tasks:
        if task.done():
            task.result()


async def end_tasks(tasks: Sequence[asyncio.Task[None]]) -> None:
    """Cancel what still runs, and wait for its end. How it ended is the business of `serve`."""
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


@contextmanager
def blamed_on(path: Path, *loc: str | int) -> Iterator[None]:
    """A ConfigError that names no file comes from the setting at `loc` of the file at `path`: say so, with its line."""
    try:
        yield
    except ConfigError as error:
        if error.file is not None:
            raise
        place: Loc = loc
        raise read_document(path).error(place, error.problem) from error


def log_warnings(log: logging.Logger, warnings: Sequence[str]) -> None:
    """Each in words of its own, so that the limit on repeated warnings holds back none."""
    for warning in warnings:
        log.warning(warning.replace("%", "%%"))
