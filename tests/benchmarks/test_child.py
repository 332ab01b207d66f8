"""Children of benchmarks: they find the benchmarks from anywhere, and their own words reach the user."""

import argparse
import asyncio
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from multiprocessing import Pipe, resource_tracker
from multiprocessing.connection import Connection
from pathlib import Path

import pytest

from benchmarks import child, common
from benchmarks.child import Worker, await_workers
from sern_core.vocabulary.errors import SernError
from sern_tools.harness.processes import Children, python
from tests.support import DEADLINE_S

IMPORTS = "import json, benchmarks as a, sern_core as b; print(json.dumps({m.__name__: m.__file__ for m in (a, b)}))"


def refuses() -> None:
    raise SernError("no such link")


def goes_on() -> None:
    threading.Event().wait()


def answers(end: Connection, factor: int) -> None:
    end.send(factor * end.recv())


def ended_by_a_signal(report_to: Connection, number: int) -> None:
    """A benchmark whose worker goes on for ever; it gets the signal in the middle."""

    def bench(_options: argparse.Namespace, _report: common.Report) -> None:
        worker = Worker("the publisher", goes_on)
        worker.start()
        report_to.send(worker.pid)
        os.kill(os.getpid(), number)
        goes_on()

    sys.argv = ["relay"]
    sys.exit(common.main("relay", bench))


@pytest.fixture
def spawning() -> Iterator[None]:
    """Python keeps a process that looks after what its spawned ones share; it would be left over."""
    yield
    resource_tracker._resource_tracker._stop()  # type: ignore[attr-defined]


@pytest.fixture
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Another folder is the current one, and only what is installed can be imported."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PYTHONPATH", raising=False)
    return tmp_path


@pytest.mark.usefixtures("elsewhere")
def test_the_benchmarks_are_not_installed() -> None:
    command = python("-c", IMPORTS)
    done = subprocess.run(command, capture_output=True, text=True, timeout=DEADLINE_S, check=False)
    assert done.returncode == 1 and "No module named 'benchmarks'" in done.stderr


@pytest.mark.parametrize("safe", ["", "1"])
async def test_a_child_finds_this_checkout_from_anywhere(
    elsewhere: Path, monkeypatch: pytest.MonkeyPatch, safe: str
) -> None:
    monkeypatch.setenv("PYTHONSAFEPATH", safe)
    (elsewhere / "benchmarks.py").write_text("raise SystemExit('the wrong one')")
    async with Children(elsewhere) as children:
        process = await children.start("child", python("-c", IMPORTS), talks=True, environment=child.environment())
        found = await process.read_object()
    assert found == {name: str(child.ROOT / name / "__init__.py") for name in ("benchmarks", "sern_core")}


def test_what_was_to_be_found_before_still_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", "/one:/two")
    assert child.environment() == {"PYTHONPATH": f"{child.ROOT}:/one:/two"}


def test_the_words_of_a_child_reach_the_user_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    async def work(children: Children) -> None:
        process = await children.start(
            "source",
            python("-m", "benchmarks.endpoints.ros1_roles", "nothing"),
            talks=True,
            environment=child.environment(),
        )
        await process.read_object()

    async def part() -> None:
        async with Children(tmp_path) as children:
            await children.beside(work(children))

    def bench(_options: argparse.Namespace, _report: common.Report) -> None:
        asyncio.run(part())

    monkeypatch.setattr(sys, "argv", ["endpoints"])
    assert common.main("endpoints", bench) == 1
    said = capfd.readouterr()
    assert said.out == ""
    assert said.err == "benchmarks.endpoints: source ended (exit status 1): no role nothing with 0 arguments\n"


@pytest.mark.usefixtures("spawning")
def test_of_a_worker_the_error_remains(capfd: pytest.CaptureFixture[str]) -> None:
    worker = Worker("the relay", refuses)
    try:
        worker.start()
        with pytest.raises(SernError) as caught:
            await_workers(lambda: False, [worker], "nothing happened", DEADLINE_S)
    finally:
        worker.end(patient=True)
    assert str(caught.value) == "the relay ended (exit status 1): sern_core.vocabulary.errors.SernError: no such link"
    assert capfd.readouterr().err == ""


def test_a_worker_that_was_not_started_is_no_error() -> None:
    worker = Worker("the relay", refuses)
    worker.check()
    worker.end(patient=True)


def test_who_waits_for_workers_in_vain_says_so() -> None:
    with pytest.raises(SernError, match=r"^nothing happened within 0 s$"):
        await_workers(lambda: False, [], "nothing happened", 0.0)
    await_workers(lambda: True, [], "nothing happened", 0.0)


@pytest.mark.usefixtures("spawning")
def test_a_worker_answers_and_one_that_ends_instead_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(child, "PATIENCE_S", DEADLINE_S)  # an interpreter ends some time after its connection
    ours, theirs = Pipe()
    worker = Worker("the server", answers, theirs, 7)
    with ours:
        try:
            worker.start()
            theirs.close()
            assert worker.ask(ours, 6) == 42
            with pytest.raises(SernError, match=r"the server ended \(exit status 0\) and said nothing"):
                worker.ask(ours, 6)
        finally:
            worker.end(patient=True)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.usefixtures("spawning")
def test_a_benchmark_that_is_ended_leaves_no_worker(number: int, capfd: pytest.CaptureFixture[str]) -> None:
    ours, theirs = Pipe()
    process = multiprocessing.get_context("spawn").Process(target=ended_by_a_signal, args=(theirs, number))
    process.start()
    theirs.close()
    with ours:
        pid = ours.recv()
    process.join(DEADLINE_S)
    assert process.exitcode == 130
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)
    assert capfd.readouterr().err == "benchmarks.relay: interrupted\n"
