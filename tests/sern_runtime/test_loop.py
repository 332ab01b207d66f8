"""The loop, its timers and its signals."""

import asyncio
import os
import platform
import signal
import subprocess
import sys
import threading
from collections.abc import Callable

import pytest
import uvloop

from sern_runtime import clock
from sern_runtime.loop import BlockDetector, Shutdown, Timer, run
from tests.support import DEADLINE_S, Patience, child, until


class FakeHandle:
    def __init__(self, callback: Callable[[], object]) -> None:
        self.callback = callback
        self.cancelled = False

    def cancel(self) -> None:
        self.cancelled = True


class FakeLoop:
    """Records what a timer asks of its loop; `fire` plays the loop's part."""

    def __init__(self) -> None:
        self.delays_s: list[float] = []
        self.handle: FakeHandle | None = None

    def call_soon(self, callback: Callable[[], object], /) -> FakeHandle:
        return self.call_later(0.0, callback)

    def call_later(self, delay: float, callback: Callable[[], object], /) -> FakeHandle:
        self.delays_s.append(delay)
        self.handle = FakeHandle(callback)
        return self.handle

    def fire(self) -> None:
        assert self.handle is not None
        handle, self.handle = self.handle, None
        handle.callback()


class Clock:
    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def timer() -> tuple[Timer, FakeLoop, Clock, list[float]]:
    loop, clock = FakeLoop(), Clock()
    fired: list[float] = []
    return Timer(lambda: fired.append(clock.now_s), loop=loop, clock=clock), loop, clock, fired


def test_delays_are_rounded_up_to_whole_milliseconds() -> None:
    made, loop, _, _ = timer()
    made.arm(100.00012)
    made.arm(100.0001)
    assert loop.delays_s == [0.001, 0.001]
    made.cancel()
    made.arm(100.0031)
    assert loop.delays_s[-1] == 0.004


def test_an_early_wake_up_waits_for_the_rest() -> None:
    made, loop, clock, fired = timer()
    made.arm(100.010)
    clock.now_s = 100.008
    loop.fire()
    assert fired == []
    assert made.deadline_s == 100.010
    clock.now_s = 100.011
    loop.fire()
    assert fired == [100.011]
    assert made.deadline_s is None


def test_a_later_deadline_keeps_the_wake_up_and_an_earlier_one_moves_it() -> None:
    made, loop, clock, fired = timer()
    made.arm(100.010)
    first = loop.handle
    made.arm(100.050)
    assert loop.handle is first
    clock.now_s = 100.011
    loop.fire()
    assert fired == []
    second = loop.handle
    made.arm(100.020)
    assert second is not None and second.cancelled
    clock.now_s = 100.020
    loop.fire()
    assert fired == [100.020]


def test_what_is_due_runs_in_the_next_round_and_not_inside_arm() -> None:
    made, loop, _, fired = timer()
    made.arm(99.0)
    assert fired == []
    assert loop.delays_s == [0.0]
    loop.fire()
    assert fired == [100.0]


def test_disarming() -> None:
    made, loop, clock, fired = timer()
    made.arm(100.010)
    handle = loop.handle
    made.arm(None)
    assert handle is not None and handle.cancelled
    made.cancel()
    clock.now_s = 101.0
    handle.callback()
    assert fired == []


async def test_a_real_timer_never_fires_early() -> None:
    """uvloop fires delays under half a millisecond at once, and others early."""
    late_s: list[float] = []
    done = asyncio.Event()
    deadlines_s = iter([clock.now() + n * 0.0007 for n in range(1, 60)])
    due_s = next(deadlines_s)

    def fire() -> None:
        nonlocal due_s
        late_s.append(clock.now() - due_s)
        following = next(deadlines_s, None)
        if following is None:
            done.set()
        else:
            due_s = following
            made.arm(due_s)

    made = Timer(fire)
    made.arm(due_s)
    async with asyncio.timeout(DEADLINE_S):
        await done.wait()
    assert len(late_s) == 59
    assert min(late_s) >= 0


async def test_a_callback_that_blocks_is_reported_with_its_place() -> None:
    async with BlockDetector(0.05) as detector:
        hold, patience = threading.Event(), Patience()

        def a_blocking_call(known: int) -> None:
            held = Patience(1.0)
            while len(detector.reports) == known and not held.over():
                hold.wait(0.01)

        # A machine that stood still just before has its report already, and there is one for each pulse of the loop.
        while not any("a_blocking_call" in report for report in detector.reports):
            assert not patience.over(), detector.reports
            pulse_s = detector._pulse_s
            await until(lambda pulse_s=pulse_s: detector._pulse_s != pulse_s)  # type: ignore[misc]
            a_blocking_call(len(detector.reports))


async def test_an_idle_loop_is_not_reported() -> None:
    async with BlockDetector(5.0) as detector:
        await asyncio.sleep(0)
    assert detector.reports == []


def test_run_gives_the_exit_code_and_leaves_no_handlers(default_signals: None) -> None:
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)}
    seen: list[str] = []

    async def main(shutdown: Shutdown) -> int:
        assert isinstance(asyncio.get_running_loop(), uvloop.Loop)
        shutdown.on_reload = lambda: seen.append("reload")
        signal.raise_signal(signal.SIGHUP)
        await until(lambda: seen)
        signal.raise_signal(signal.SIGTERM)
        await shutdown.wait()
        assert shutdown.signal_name == "SIGTERM"
        return 3

    assert run(main) == 3
    assert seen == ["reload"]
    assert {number: signal.getsignal(number) for number in before} == before


def test_run_takes_none_for_success() -> None:
    async def main(shutdown: Shutdown) -> None:
        shutdown.request()
        await shutdown.wait()

    assert run(main) == 0


PROGRAM = """
import asyncio
from sern_runtime.loop import run

async def main(shutdown):
    print("started", flush=True)
    await shutdown.wait()
    print("draining", flush=True)
    await asyncio.Event().wait()

raise SystemExit(run(main))
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_the_second_signal_ends_a_stuck_drain(number: signal.Signals) -> None:
    with child([sys.executable, "-c", PROGRAM], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"started\n"
        process.send_signal(number)
        assert process.stdout.readline() == b"draining\n"
        process.send_signal(number)
        assert process.wait(DEADLINE_S) == 128 + number


_FAULTS = """
import resource, sys
from sern_runtime.loop import keep_freed_memory
if sys.argv[1] == "keep":
    keep_freed_memory()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(3000):
    del [bytes(100_000) for _ in range(3)][:]
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc gives memory back at every message")
def test_freed_memory_is_kept_for_the_next_message() -> None:
    def faults(how: str, **environment: str) -> int:
        command = [sys.executable, "-c", _FAULTS, how]
        done = subprocess.run(command, check=True, capture_output=True, text=True, env={**os.environ, **environment})
        return int(done.stdout)

    # Set by hand it stays: else what was freed while importing may have raised it already.
    assert faults("keep") < faults("give", MALLOC_TRIM_THRESHOLD_="131072") / 10
