"""What a configuration would do, as queueing says."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from sern_core.adaptation.cost import Ranges, profile
from sern_core.adaptation.model import (
    ClassDemand,
    Configuration,
    LinkState,
    Prediction,
    Situation,
)
from sern_core.adaptation.predict import PLANNED_SHARE, Grid, Predictor
from sern_core.vocabulary.errors import UsageError
from tests.sern_core.adaptation.situations import (
    BULK,
    CONTROL,
    GRID,
    RANGES,
    situation,
)


def one(demand: ClassDemand, configuration: Configuration, link: LinkState) -> Prediction:
    predictor = Predictor(Grid([configuration]), weights=profile("balanced"), ranges=Ranges(latency_max_s=10.0))
    return predictor.predict(Situation((demand,), link)).prediction(0)


def test_an_unloaded_link_costs_serialisation_and_half_a_round_trip() -> None:
    demand = ClassDemand(CONTROL, 1.0, 940.0, 1.0)
    got = one(demand, Configuration(), LinkState(1e6, 0.1))
    serialised_s = 8 * (940 + 60) / (PLANNED_SHARE * 1e6)
    assert got.latency_s == pytest.approx(0.05 + serialised_s, rel=0.02)
    assert got.unreliability < 0.01
    assert got.bandwidth_bps == pytest.approx(8 * 1000, rel=0.01)


def test_the_wait_is_that_of_an_m_g_1_queue() -> None:
    """Poisson arrivals of one size at load 0.6, a queue that never overflows: W = ρX/(2(1−ρ)) (Pollaczek–Khinchine)."""
    x_s = 8 * 1000 / (PLANNED_SHARE * 1e6)
    demand = ClassDemand(CONTROL, 0.6 / x_s, 940.0, 10.0, topics=1000)
    got = one(demand, Configuration(), LinkState(1e6, 0.0))
    assert got.latency_s == pytest.approx(x_s + 0.6 * x_s / (2 * 0.4), rel=0.02)


def test_a_less_urgent_class_delays_by_a_fragment_not_by_a_message() -> None:
    control = ClassDemand(CONTROL, 10.0, 100.0, 0.5)
    predictor = Predictor(Grid([Configuration()]), weights=profile("balanced"), ranges=RANGES)

    def control_s(*more: ClassDemand) -> float:
        found = predictor.predict(Situation((control, *more), LinkState(1e6, 0.0)))
        return found.prediction(0).classes[0].latency_s

    fragment_s = 8 * 1231 / 0.9e6
    small = control_s(ClassDemand(BULK, 0.5, 100_000.0, 1.0))
    large = control_s(ClassDemand(BULK, 0.05, 1_000_000.0, 1.0))
    assert control_s() < small < control_s() + fragment_s
    assert large == pytest.approx(small, rel=0.02)


@pytest.mark.parametrize("capacity_bps", [1e4, 1e5, 1e6, 1e7, 1e9])
@pytest.mark.parametrize("loss", [0.0, 0.1, 1.0])
def test_predictions_are_finite_and_in_range_at_any_load(capacity_bps: float, loss: float) -> None:
    predictor = Predictor(GRID, weights=profile("mapping"), ranges=RANGES)
    got = predictor.predict(situation(capacity_bps, loss=loss))
    for array in (got.latency_s, got.unreliability, got.compute, got.bandwidth_bps, got.cost, *got.terms):
        assert np.isfinite(array).all()
    assert ((got.cost >= 0.0) & (got.cost <= 1.0)).all()
    assert (got.bandwidth_bps <= 1.001 * PLANNED_SHARE * capacity_bps).all()
    for part in got.classes:
        for array in (part.drop, part.late, part.on_time):
            assert ((array >= 0.0) & (array <= 1.0)).all()


def test_less_capacity_is_never_better() -> None:
    predictor = Predictor(GRID, weights=profile("teleoperation"), ranges=RANGES)
    scores = [predictor.predict(situation(c)) for c in (8e6, 4e6, 2e6, 1e6, 5e5, 2e5)]
    for more, less in itertools.pairwise(scores):
        assert (less.unreliability >= more.unreliability - 0.02).all()


def test_redundancy_squares_the_loss_of_protected_classes() -> None:
    demand = ClassDemand(CONTROL, 50.0, 100.0, 1.0, arrival_cv2=0.0, protected=True)
    link = LinkState(1e7, 0.05, 0.1)
    once = one(demand, Configuration(), link)
    twice = one(demand, Configuration(redundancy=1), link)
    assert once.unreliability == pytest.approx(0.1, abs=0.01)
    assert twice.unreliability == pytest.approx(0.01, abs=0.005)
    assert twice.bandwidth_bps == pytest.approx(2 * once.bandwidth_bps, rel=0.01)


def test_a_repaired_message_costs_time_instead_of_reliability() -> None:
    link = LinkState(1e7, 0.05, 0.1)
    large = ClassDemand(BULK, 1.0, 30_000.0, 1.0, arrival_cv2=0.0)
    repaired, bare = one(large, Configuration(), link), one(replace(large, repaired=False), Configuration(), link)
    assert repaired.unreliability < 0.01 < 0.9 < bare.unreliability
    assert repaired.latency_s > bare.latency_s + 0.05


def test_reliable_topics_are_not_thinned() -> None:
    demand = ClassDemand(BULK, 10.0, 1000.0, 1.0, thinnable=0.0)
    got = one(demand, Configuration(rates=(1.0, 1.0, 0.1)), LinkState(1e7, 0.0))
    assert got.unreliability < 0.01


def test_the_capacity_must_be_known() -> None:
    predictor = Predictor(GRID, weights=profile("balanced"), ranges=RANGES)
    with pytest.raises(UsageError, match="capacity"):
        predictor.predict(situation(None))
