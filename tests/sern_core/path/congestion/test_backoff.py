"""The window backs off from a queue that is too long."""

import pytest

from sern_core.path.congestion.backoff import Backoff
from sern_core.path.congestion.growth import Growth
from sern_core.path.congestion.losses import Losses
from sern_core.path.congestion.params import DEFAULT_HYBRID
from tests.sern_core.path.congestion.acknowledged import FRAGMENT_BYTES, RTT_S, Path

PARAMS = DEFAULT_HYBRID
LEAST = PARAMS.min_window_fragments * FRAGMENT_BYTES
WINDOW = 60_000.0


def backing_off(path: Path) -> Backoff:
    model = path.model
    return Backoff(PARAMS, model, Growth(PARAMS, model.view, model.delay, Losses(PARAMS)))


def test_a_moment_of_a_long_queue_is_not_urgent() -> None:
    backoff = backing_off(Path().settled())
    assert not backoff.urgent(100.0, 7.0)
    assert not backoff.urgent(100.0, 7.0 + 0.9 * PARAMS.emergency_s)
    assert backoff.urgent(100.0, 7.0 + PARAMS.emergency_s)
    backoff.far_since_s = None  # it went
    assert not backoff.urgent(100.0, 8.0)


def test_a_cut_goes_to_what_arrives_and_the_next_one_waits_for_its_effect() -> None:
    path = Path().settled()
    backoff = backing_off(path)
    window = backoff.cut(path.now, WINDOW, 500e3, RTT_S, epochs=1)
    assert window == pytest.approx(PARAMS.cut * 500e3 * RTT_S + FRAGMENT_BYTES, rel=0.02)
    assert backoff.cut(path.now + RTT_S / 2, WINDOW, 500e3, RTT_S, epochs=2) == WINDOW
    assert backoff.cut(path.now + RTT_S, WINDOW, 500e3, RTT_S, epochs=2) < WINDOW
    assert backoff.cut(path.now + 2 * RTT_S, LEAST, 500e3, RTT_S, epochs=3) == LEAST, "it never grows"


def test_an_epoch_of_a_long_queue_does_not_change_the_rate_and_two_do() -> None:
    path = Path().settled()
    path.rate = 100e3
    path.epoch(0.05)
    before = path.model.rate.value
    backoff = backing_off(path)
    backoff.cut(path.now, WINDOW, 500e3, RTT_S, epochs=1)
    assert path.model.rate.value == before
    backoff.cut(path.now + RTT_S, WINDOW, 500e3, RTT_S, epochs=2)
    assert path.model.rate.value is not None and before is not None and path.model.rate.value < before


def test_a_far_longer_queue_cuts_at_once() -> None:
    path = Path().settled()
    path.rate = 100e3
    for _ in range(4):
        path.epoch(0.1)
    backoff = backing_off(path)
    window = backoff.cut_at_once(path.now, WINDOW, LEAST, 0.1)
    assert window == pytest.approx(PARAMS.emergency_cut * 100e3 * RTT_S, rel=0.05)
    assert backoff.hold_until_s >= path.now + 0.1
    assert not backoff.urgent(path.now + 0.05, 1e9), "that has to reach the path first"


def test_nothing_is_cut_on_a_path_that_is_not_known() -> None:
    assert backing_off(Path()).cut_at_once(100.0, WINDOW, LEAST, 1.0) is None


def test_a_slower_link_is_told_by_what_passes_a_queue_that_stays() -> None:
    path = Path().settled()
    backoff = backing_off(path)
    path.rate = 100e3
    found = [rate for _ in range(30) if (rate := backoff.look_for_slower_link(path.packet(0.05))) is not None]
    assert found and path.model.rate.value == found[-1] == pytest.approx(100e3, rel=0.05)
