"""Whether acknowledgements show a link that is full, and what follows."""

import pytest

from sern_core.path.congestion.company import Drain
from sern_core.path.congestion.mode import COMPETE, DRAIN, STARTUP, STEADY, VARIABLE, Mode
from sern_core.path.congestion.params import DEFAULT_HYBRID
from sern_core.path.congestion.swings import Swings
from tests.sern_core.path.congestion.acknowledged import Path

PARAMS = DEFAULT_HYBRID
RATES = (500e3, 100e3, 500e3, 100e3)


class Swinging:
    """A full link whose rate changes."""

    def __init__(self) -> None:
        self.path = Path().settled()
        self.drain = Drain(PARAMS)
        self.it = Swings(PARAMS, self.path.model, self.drain)

    def full(self, *rates: float, mode: Mode = STEADY, queue_s: float = 0.05, app_limited: bool = False) -> bool:
        """Whether it swings after half a second of each rate."""
        for rate in rates:
            self.path.rate = rate
            until_s = self.path.now + 0.5
            while self.path.now < until_s:
                sample = self.path.packet(queue_s, app_limited=app_limited)
                self.path.model.rate.arrived.note(sample.receiver_s, sample.cum_bytes)
                self.it.note(sample, queue_s, mode)
        return self.it.seen(self.path.now)


def test_a_full_link_whose_rate_goes_up_and_down_swings() -> None:
    link = Swinging()
    assert not link.full(RATES[0], RATES[0])
    assert link.full(*RATES)


def test_a_link_of_one_rate_does_not() -> None:
    assert not Swinging().full(*[500e3] * 6)


@pytest.mark.parametrize("mode", [STARTUP, DRAIN, COMPETE])
def test_what_arrives_tells_only_while_the_window_is_steady(mode: Mode) -> None:
    assert not Swinging().full(*RATES, mode=mode)


@pytest.mark.parametrize("change", [{"queue_s": 0.0}, {"app_limited": True}])
def test_a_link_that_is_not_full_tells_nothing(change: dict[str, float]) -> None:
    assert not Swinging().full(*RATES, **change)  # type: ignore[arg-type]


def test_what_was_sent_while_making_way_tells_nothing() -> None:
    link = Swinging()
    link.drain.drained_s = link.path.now + 10.0
    assert not link.full(*RATES)


def test_a_link_that_faded_swings_and_one_that_keeps_its_rate_does_no_longer() -> None:
    link = Swinging()
    link.it.faded(link.path.now)
    assert link.it.seen(link.path.now)
    link.it.begin()
    assert link.it.close_epoch(link.path.now, link.path.epoch())
    link.path.now += PARAMS.variable_memory_s
    assert not link.it.close_epoch(link.path.now, link.path.epoch())


def test_the_window_follows_what_was_acknowledged() -> None:
    link = Swinging()
    window, windows = 20_000.0, []
    for _ in range(40):
        window = link.it.steer(window, 0.0, link.path.packet())
        windows.append(window)
    assert windows == sorted(windows) and windows[-1] > windows[0], "nothing queues, so it grows"
    for _ in range(40):
        window = link.it.steer(window, 0.2, link.path.packet(0.2))
    assert window < windows[-1]


def test_measured_anew_it_still_swings() -> None:
    link = Swinging()
    assert link.full(*RATES)
    link.it.measure_anew()
    assert link.it.seen(link.path.now) and link.full(500e3, mode=VARIABLE)
