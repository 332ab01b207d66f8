"""The client's end of its guard: when a guard that says nothing is given up. Processes that answer as a test wants."""

import asyncio
import sys
from asyncio.subprocess import Process
from collections.abc import Callable
from pathlib import Path

import pytest
import uvloop

from sern_client import guard
from sern_client.guard import Guard
from sern_runtime.config.shared import LogSection
from tests.support import until

ANSWERS = """
import json, sys
for line in sys.stdin:
    said = json.loads(line)
    if "ping" in said:
        print(json.dumps({"pong": said["ping"]}), json.dumps({"stopped": 1}), sep="\\n", flush=True)
"""
"""What it says has stopped counts its answers."""
SILENT = "import sys; sys.stdin.read()"


class Skipping(uvloop.Loop):
    """Its time may jump, as it does for a process that stood still."""

    skipped_s = 0.0

    def time(self) -> float:
        return super().time() + self.skipped_s


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[[str], Guard]:
    """A guard that is pinged often and whose process is a script."""
    monkeypatch.setattr(guard, "PING_S", 0.01)
    spawn = guard._spawn

    def made(script: str) -> Guard:
        async def spawned(*_: str) -> Process:
            return await spawn(sys.executable, "-c", script)

        monkeypatch.setattr(guard, "_spawn", spawned)
        return Guard([], tmp_path, LogSection())

    return made


def test_a_client_that_stood_still_keeps_its_guard(runs: Callable[[str], Guard]) -> None:
    async def stand_still() -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, Skipping)
        watched = runs(ANSWERS)
        watched.start()
        try:
            await until(lambda: watched.stopped >= 3)
            loop.skipped_s += 10 * guard.SILENT_S
            before = watched.stopped
            await until(lambda: watched.stopped >= before + 5 or watched.restarts)
            assert watched.restarts == 0
        finally:
            await watched.stop()

    with asyncio.Runner(loop_factory=Skipping) as runner:
        runner.run(stand_still())


async def test_a_guard_that_answers_no_ping_is_started_again(
    runs: Callable[[str], Guard], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(guard, "SILENT_S", 0.05)
    watched = runs(SILENT)
    watched.start()
    await until(lambda: watched.restarts == 1)
    await watched.stop()
    assert "has not answered for 0.05 s; it is killed" in caplog.text
    assert "has ended (exit code -9)" in caplog.text
