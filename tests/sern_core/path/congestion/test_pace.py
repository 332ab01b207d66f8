"""How fast packets leave, by what the window does."""

import pytest

from sern_core.path.congestion.growth import Growth
from sern_core.path.congestion.losses import Losses
from sern_core.path.congestion.mode import COMPETE, MODES, STARTUP, STEADY, VARIABLE, Mode
from sern_core.path.congestion.pace import Pace
from sern_core.path.congestion.params import DEFAULT_HYBRID
from tests.sern_core.path.congestion.acknowledged import RTT_S, Path

PARAMS = DEFAULT_HYBRID
INITIAL_BYTES = 12_600.0
WINDOW = 100_000.0


def pacing(path: Path) -> Pace:
    model = path.model
    losses = Losses(PARAMS)
    return Pace(PARAMS, model, Growth(PARAMS, model.view, model.delay, losses), losses, INITIAL_BYTES)


@pytest.mark.parametrize("mode", MODES)
def test_until_a_round_trip_is_known_all_leaves_at_once(mode: Mode) -> None:
    pace = pacing(Path())
    pace.set(mode, WINDOW)
    assert pace.value is None and not pace.capped


def test_the_first_train_leaves_at_once_and_the_next_rounds_are_spread() -> None:
    pace = pacing(Path().settled())
    pace.set(STARTUP, INITIAL_BYTES)
    assert pace.value is None
    pace.set(STARTUP, WINDOW)
    assert pace.value == pytest.approx(PARAMS.startup_pacing * WINDOW / RTT_S)


def test_beside_a_rival_and_on_a_link_that_swings_the_window_bounds() -> None:
    pace = pacing(Path().settled())
    for mode in (COMPETE, VARIABLE):
        pace.set(mode, WINDOW)
        assert pace.value is not None and pace.value > WINDOW / (RTT_S + (PARAMS.variable_queue_s or 0.0))
        assert not pace.capped


def test_while_something_queues_the_pace_is_below_the_capacity() -> None:
    path = Path().settled()
    pace = pacing(path)
    path.epoch(0.1)
    pace.set(STEADY, WINDOW)
    assert pace.capped and pace.value == pytest.approx(PARAMS.drain_pacing * 500e3, rel=0.02)


def test_an_empty_path_of_long_packets_is_tried_with_a_little_more() -> None:
    path = Path().settled()
    pace = pacing(path)
    path.epoch()
    pace.set(STEADY, WINDOW)
    assert path.model.view.gentle and pace.capped
    assert pace.value == pytest.approx(PARAMS.gentle_pacing[0] * 500e3, rel=0.02)


def test_start_up_may_end_with_a_rate_and_before_any_epoch_has_seen_one() -> None:
    """An epoch without a rate says that the path is calm; the first rate may come just before start-up ends."""
    path = Path()
    model = path.model
    model.rtt_s, model.rate.value, model.view.calm = 0.01, 1e5, True
    model.view.queue_s = model.view.target_s = 0.001
    assert model.rate.peak == 0.0
    pace = pacing(path)
    pace.set(STEADY, 10_000.0)
    assert pace.value is not None and 8 * pace.value > 8e6 and not pace.capped


def test_what_little_was_offered_is_no_rate_to_go_by() -> None:
    path = Path()
    path.epoch(0.1, app_limited=True)
    path.epoch(0.1, app_limited=True)
    assert path.model.rate.value is not None and not path.model.rate.shown
    pace = pacing(path)
    pace.set(STEADY, WINDOW)
    assert not pace.capped and pace.value == pytest.approx(PARAMS.pacing_gain * WINDOW / (path.model.rtt_s or 0.0))


def test_a_pace_above_what_bursts_showed_lets_them_show_more() -> None:
    path = Path()
    path.epoch(0.0, app_limited=True)
    path.model.rate.bursts = 1
    path.model.rate.show(path.now, 900e3, RTT_S)
    path.epoch(0.1, app_limited=True)
    pace = pacing(path)
    pace.set(STEADY, WINDOW)
    assert pace.value == pytest.approx(PARAMS.burst_pacing * 900e3)
