"""Candidates played over the capacities of late, against what can be told without playing."""

import numpy as np
import pytest

from sern_core.adaptation.cost import Ranges, profile
from sern_core.adaptation.model import ClassDemand, Configuration, LinkState, Prediction, Situation
from sern_core.adaptation.playback import STEPS, CapacityPath
from sern_core.adaptation.predict import PLANNED_SHARE, Grid, Predictor
from sern_core.vocabulary.types import PriorityClass
from tests.sern_core.adaptation.situations import GRID, RANGES, situation

CONTROL, STATE, BULK = PriorityClass


def played(demand: ClassDemand, path: CapacityPath, *, capacity_bps: float = 1e6) -> Prediction:
    predictor = Predictor(Grid([Configuration()]), weights=profile("balanced"), ranges=Ranges(latency_max_s=10.0))
    return predictor.predict(Situation((demand,), LinkState(capacity_bps, 0.0)), None, path).prediction(0)


def test_readings_become_at_most_so_many_steps_and_keep_their_mean() -> None:
    readings = [float(i) for i in range(101)]
    path = CapacityPath.of(10.1, readings, 10)
    assert len(path.capacities_bps) == STEPS
    assert path.step_s * STEPS == pytest.approx(10.1)
    assert np.mean(path.capacities_bps) == pytest.approx(50.0, rel=0.01)
    assert CapacityPath.of(0.2, [1.0, 2.0], 5) == CapacityPath(0.1, (1.0, 2.0), 2)


def test_what_comes_while_nothing_is_carried_waits_for_the_next_good_moment() -> None:
    """One second on, one off: half of the messages wait for half a second in the mean."""
    path = CapacityPath.of(6.0, ([1e6] * 5 + [0.0] * 5) * 3, 1)
    got = played(ClassDemand(CONTROL, 1.0, 40.0, 5.0, topics=100), path)
    assert got.latency_s == pytest.approx(0.25, rel=0.05)
    assert got.unreliability == pytest.approx(0.0, abs=0.01)
    strict = played(ClassDemand(CONTROL, 1.0, 40.0, 0.4, topics=100), path)
    assert strict.unreliability == pytest.approx(0.3, abs=0.02)  # those that come in the first 0.6 s without


def test_a_message_begun_in_a_bad_moment_ends_in_the_next_good_one() -> None:
    """100 kB take 8 s at 0.1 Mbit/s; with 10 Mbit/s each other second none takes much longer than the bad one."""
    demand = ClassDemand(BULK, 0.05, 100_000.0, 5.0)
    swing = played(demand, CapacityPath.of(8.0, ([10e6] * 10 + [0.1e6] * 10) * 4, 1))
    slow = played(demand, CapacityPath.of(8.0, [0.1e6] * 80, 1))
    assert slow.unreliability > 0.9
    assert swing.unreliability < 0.01
    assert 0.2 < swing.latency_s < 0.7


def test_what_good_intervals_bring_too_much_does_not_make_up_for_bad_ones() -> None:
    demand = ClassDemand(BULK, 20.0, 10_000.0, 1.0, needed=0.5)
    halves = [4e6] * 20 + [1.0] * 20
    assert played(demand, CapacityPath.of(4.0, halves, 4)).unreliability == pytest.approx(0.5, abs=0.05)
    assert played(demand, CapacityPath.of(4.0, halves, 1)).unreliability < 0.1


def test_on_a_link_that_holds_still_the_formulas_say_the_same() -> None:
    predictor = Predictor(GRID, weights=profile("teleoperation"), ranges=RANGES)
    now = situation(4e6)
    steady = predictor.predict(now)
    path = predictor.predict(now, None, CapacityPath.of(10.0, [PLANNED_SHARE * 4e6] * 100, 10))
    light = steady.load < 0.7
    assert light.sum() > 20
    for one, other in zip(steady.terms, path.terms, strict=True):
        assert np.abs(one - other)[light].max() < 0.04
    best = int(np.argmin(path.cost))
    assert steady.cost[best] <= 1.05 * steady.cost.min()
    assert (path.obstacle == steady.obstacle).all()


@pytest.mark.parametrize("levels", [(0.0, 0.0), (1e3, 1e9), (4e6, 0.6e6), (5e4, 2e5)])
@pytest.mark.parametrize("loss", [0.0, 0.1, 1.0])
def test_everything_is_finite_and_in_range_on_any_path(levels: tuple[float, float], loss: float) -> None:
    predictor = Predictor(GRID, weights=profile("mapping"), ranges=RANGES)
    path = CapacityPath.of(7.3, [levels[i // 9 % 2] for i in range(73)], 7)
    got = predictor.predict(situation(1e6, loss=loss), None, path)
    for array in (got.latency_s, got.unreliability, got.compute, got.bandwidth_bps, got.cost, *got.terms):
        assert np.isfinite(array).all()
    assert ((got.cost >= 0.0) & (got.cost <= 1.0)).all()
    assert (got.bandwidth_bps <= 1.01 * max(float(np.mean(path.capacities_bps)), 30.0)).all()
    for part in got.classes:
        for array in (part.drop, part.late, part.on_time):
            assert ((array >= -1e-9) & (array <= 1.0 + 1e-9)).all()


def test_candidates_that_are_played_together_come_out_as_alone() -> None:
    """Variants share their play: each candidate of the grid must find its own."""
    path = CapacityPath.of(6.0, ([4e6] * 15 + [0.6e6] * 15) * 2, 6)
    weights = profile("teleoperation")
    whole = Predictor(GRID, weights=weights, ranges=RANGES).predict(situation(), None, path)
    for index in range(0, len(GRID), 7):
        alone = Predictor(Grid([GRID.configurations[index]]), weights=weights, ranges=RANGES)
        assert alone.predict(situation(), None, path).cost[0] == pytest.approx(float(whole.cost[index]))
