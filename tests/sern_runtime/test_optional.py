"""Parts that a daemon can do without: counted, said once, restarted, and nobody else's business."""

import asyncio
import logging

import pytest
from prometheus_client import CollectorRegistry

from sern_core.bodies.codecs import Work
from sern_runtime import optional
from sern_runtime.codec_pool import CodecPool
from sern_runtime.metrics import Metrics
from sern_runtime.optional import OptionalParts
from tests.support import until


def fail(parts: OptionalParts, error: Exception) -> None:
    with parts.survive("feed"):
        raise error


def test_a_failure_is_counted_and_its_traceback_said_once(caplog: pytest.LogCaptureFixture) -> None:
    parts = OptionalParts("feed", "objects")
    for error in (KeyError("gone"), KeyError("gone"), KeyError("gone"), ValueError("another")):
        fail(parts, error)
    assert parts.failures == {"feed": 4, "objects": 0}
    assert [record.exc_info is not None for record in caplog.records] == [True, False, False, True]
    registry = CollectorRegistry()
    parts.register(Metrics(registry, process=False))
    assert registry.get_sample_value("sern_optional_failures_total", {"part": "feed"}) == 4.0
    assert registry.get_sample_value("sern_optional_failures_total", {"part": "objects"}) == 0.0


async def test_a_part_is_reset_and_started_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(optional, "BACKOFF_S", (0.001, 0.004))
    parts = OptionalParts("adaptation")
    runs = resets = 0

    async def run() -> None:
        nonlocal runs
        runs += 1
        if runs < 5:
            raise RuntimeError(f"number {runs}")
        await asyncio.Event().wait()

    def reset() -> None:
        nonlocal resets
        resets += 1
        raise ValueError("also broken")

    task = asyncio.create_task(parts.keep("adaptation", run, reset=reset))
    await until(lambda: runs == 5)
    assert resets == 4 and parts.failures["adaptation"] == 8 and not task.done()
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task


class Job(Work):
    def __init__(self, *, fails: bool = False, done_fails: bool = False) -> None:
        self.fails, self.done_fails = fails, done_fails
        self.ran = self.finished = False

    def run(self) -> None:
        self.ran = True
        if self.fails:
            raise KeyError("in the thread")

    def done(self, *, now: float) -> None:
        self.finished = True
        if self.done_fails:
            raise KeyError("on the loop")


async def test_codecs_survive_faults_and_dead_threads(caplog: pytest.LogCaptureFixture) -> None:
    parts = OptionalParts("codecs")
    pool = CodecPool(after=lambda: None, parts=parts)
    first = [Job(fails=True), Job(done_fails=True), Job()]
    for job in first:
        pool.take(job)
    await until(lambda: all(job.finished for job in first))
    assert parts.failures["codecs"] == 2
    pool._executor.shutdown()  # its threads are gone
    second = [Job() for _ in range(5)]
    for job in second:
        pool.take(job)
    await until(lambda: all(job.ran and job.finished for job in second))
    assert parts.failures["codecs"] >= 3
    pool.close()
    assert all(record.levelno >= logging.WARNING for record in caplog.records)
