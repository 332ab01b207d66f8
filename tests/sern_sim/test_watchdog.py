"""Too much at one instant is noticed, and the last of it told."""

import pytest

from sern_sim.events import SimulationStuck
from sern_sim.watchdog import REPORTED_EVENTS, Watchdog


def happens(watchdog: Watchdog, count: int) -> None:
    for _ in range(count):
        watchdog.count += 1
        if watchdog.count > watchdog.quiet:
            watchdog.note(1.5, f"event {watchdog.count}")


def test_at_the_limit_the_last_events_are_told() -> None:
    watchdog = Watchdog(100)
    happens(watchdog, 99)
    with pytest.raises(SimulationStuck, match=r"stuck at 1\.500000000 s after 100 events") as stuck:
        happens(watchdog, 1)
    assert stuck.value.events == [f"event {number}" for number in range(101 - REPORTED_EVENTS, 101)]


def test_when_time_goes_on_nothing_of_the_last_instant_counts() -> None:
    watchdog = Watchdog(100)
    happens(watchdog, 99)
    watchdog.forget()
    watchdog.count = 0
    happens(watchdog, 99)
    with pytest.raises(SimulationStuck) as stuck:
        happens(watchdog, 1)
    assert len(stuck.value.events) == REPORTED_EVENTS
