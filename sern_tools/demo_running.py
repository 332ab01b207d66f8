"""What the demos have in common: where they run, how they end, and what they ask daemons."""

import asyncio
import signal
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any, Final

import aiohttp

from sern_tools.harness.processes import swept

START_S: Final = 120.0
"""Time for the daemons to be ready and for the first message to arrive, also where the machine is small and busy."""


async def get_json(session: aiohttp.ClientSession, url: str) -> Any:
    """The JSON there, or None while the daemon does not answer (it may be busy, or not there yet)."""
    try:
        async with session.get(url) as response:
            return await response.json() if response.status == 200 else None
    except (aiohttp.ClientError, TimeoutError, ValueError):
        return None


async def is_ready(session: aiohttp.ClientSession, url: str) -> bool:
    try:
        async with session.get(f"{url}/readyz") as response:
            return response.status == 200
    except (aiohttp.ClientError, TimeoutError):
        return False


@contextmanager
def working_directory(out: Path, name: str, *, keep: bool) -> Iterator[Path]:
    """A new folder for a run: in `out` where it is kept, else one that is gone afterwards."""
    if keep:
        path = out / f"{name}-{datetime.now().strftime('%Y%m%d-%H%M%S')}"
        path.mkdir(parents=True)
        yield path
        return
    with swept(Path(tempfile.mkdtemp(prefix="sern-demo-"))) as path:
        yield path


def cancelled_by_signals() -> None:
    """Have Ctrl-C, SIGTERM and SIGHUP cancel the task that runs now."""
    task = asyncio.current_task()
    assert task is not None
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        loop.add_signal_handler(number, task.cancel)
