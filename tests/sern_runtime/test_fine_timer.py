"""A timer to a fraction of a millisecond, on the real loop and the real clock: never early, and gone when closed."""

import asyncio
from functools import partial
from pathlib import Path

import pytest

from sern_runtime import clock, fine_timer
from sern_runtime.fine_timer import FineTimer
from sern_runtime.loop import Timer
from tests.support import until

pytestmark = pytest.mark.skipif(not fine_timer.AVAILABLE, reason="this system has no timerfd")


class Fired:
    """A timer that writes down when it ran."""

    def __init__(self) -> None:
        self.at_s: list[float] = []
        self.timer = FineTimer(lambda: self.at_s.append(clock.now()))

    def times(self, number: int) -> bool:
        return len(self.at_s) == number

    def __enter__(self) -> "Fired":
        return self

    def __exit__(self, *_: object) -> None:
        self.timer.close()


async def test_it_never_runs_early_and_once_a_deadline() -> None:
    with Fired() as fired:
        for number in range(1, 40):
            due_s = clock.now() + 0.0007 * (number % 5)
            fired.timer.arm(due_s)
            await until(partial(fired.times, number))
            assert fired.at_s[-1] >= due_s
            assert fired.timer.deadline_s is None


async def test_a_later_deadline_holds_it_back_and_an_earlier_one_wakes_it() -> None:
    with Fired() as fired:
        now = clock.now()
        fired.timer.arm(now + 0.005)
        fired.timer.arm(now + 0.030)
        await until(lambda: fired.at_s)
        assert fired.at_s[0] >= now + 0.030
        fired.timer.arm(clock.now() + 3600.0)
        fired.timer.arm(clock.now() + 0.002)
        await until(lambda: len(fired.at_s) == 2)


async def test_what_is_past_runs_at_once_but_not_inside_arm() -> None:
    with Fired() as fired:
        fired.timer.arm(clock.now() - 1.0)
        assert fired.at_s == []
        await until(lambda: fired.at_s)


async def test_disarmed_it_is_silent_and_does_not_keep_the_loop_busy() -> None:
    with Fired() as fired:
        now = clock.now()
        fired.timer.arm(now + 0.003)
        fired.timer.arm(None)
        other = asyncio.Event()
        late = Timer(other.set)
        late.arm(now + 0.020)
        await other.wait()
        assert fired.at_s == []
        fired.timer.arm(clock.now())
        await until(lambda: fired.at_s)


async def test_the_callback_may_arm_again_and_close() -> None:
    count = 0

    def fire() -> None:
        nonlocal count
        count += 1
        if count < 5:
            timer.arm(clock.now() + 0.0005)
        else:
            timer.close()

    before = set(Path("/proc/self/fd").iterdir())
    timer = FineTimer(fire)
    timer.arm(clock.now())
    await until(lambda: count == 5)
    timer.close()
    timer.arm(clock.now())
    assert timer._fd == -1
    assert len(set(Path("/proc/self/fd").iterdir()) - before) <= 1, "only the listing itself"
