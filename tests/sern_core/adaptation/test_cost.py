"""The cost of a configuration: weights, ranges, terms, and what was measured."""

import pytest

from sern_core.adaptation.cost import PROFILES, Ranges, Weights, cost, measure, profile
from sern_core.adaptation.model import (
    ClassDemand,
    ClassOutcome,
    Measurement,
)
from sern_core.adaptation.playback import CapacityPath
from sern_core.adaptation.predict import PLANNED_SHARE, Predictor
from sern_core.vocabulary.errors import ConfigError
from tests.sern_core.adaptation.situations import BULK, CONTROL, GRID, RANGES, situation


def test_profiles_are_the_documented_ones() -> None:
    assert tuple(PROFILES["teleoperation"]) == (0.45, 0.30, 0.10, 0.15)
    assert tuple(PROFILES["mapping"]) == (0.10, 0.30, 0.15, 0.45)
    assert all(sum(weights) == pytest.approx(1.0) for weights in PROFILES.values())


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        ((0.5, 0.5, 0.5, 0.0), "weights: the weights add up to 1.5: change them so that the sum is 1"),
        ((-0.1, 0.6, 0.3, 0.2), "w_latency: w_latency is -0.1: a weight is a number from 0 to 1"),
        ((0.2, 0.2, 0.2, float("nan")), "w_bandwidth: w_bandwidth is nan: a weight is a number from 0 to 1"),
    ],
)
def test_wrong_weights_are_one_clear_line(weights: tuple[float, float, float, float], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        Weights(*weights)
    assert str(caught.value) == message


def test_unknown_profile_names_the_known_ones() -> None:
    with pytest.raises(ConfigError, match="unknown profile 'fast': use one of teleoperation, mapping, balanced"):
        profile("fast")


def test_wrong_ranges_are_refused() -> None:
    with pytest.raises(ConfigError, match="latency_max_s is 0: it must be above latency_min_s"):
        Ranges(latency_max_s=0.0)
    with pytest.raises(ConfigError, match="compute_max is 0: it must be above 0"):
        Ranges(compute_max=0.0)


def test_terms_are_clipped_to_their_ranges_and_weighted() -> None:
    ranges = Ranges(latency_min_s=0.1, latency_max_s=0.5, compute_max=0.25, bandwidth_max_bps=8e6)
    terms = ranges.terms(latency_s=0.3, unreliability=0.2, compute=0.5, bandwidth_bps=2e6, capacity_bps=None)
    assert terms == pytest.approx((0.5, 0.2, 1.0, 0.25))
    assert cost(Weights(0.4, 0.3, 0.2, 0.1), terms) == pytest.approx(0.2 + 0.06 + 0.2 + 0.025)
    none = ranges.terms(latency_s=0.0, unreliability=0.0, compute=0.0, bandwidth_bps=0.0, capacity_bps=1e6)
    assert none == (0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("capacity_bps", "share_of_capacity", "full_bps"),
    [(40e6, True, 40e6), (0.3e6, True, 0.3e6), (None, True, 8e6), (40e6, False, 8e6), (0.0, True, 1e3)],
)
def test_bandwidth_is_a_share_of_what_the_link_can_carry(
    *, capacity_bps: float | None, share_of_capacity: bool, full_bps: float
) -> None:
    ranges = Ranges(share_of_capacity=share_of_capacity)
    assert ranges.bandwidth_full_bps(capacity_bps) == full_bps
    terms = ranges.terms(
        latency_s=0.0, unreliability=0.0, compute=0.0, bandwidth_bps=0.25 * full_bps, capacity_bps=capacity_bps
    )
    assert terms.bandwidth == pytest.approx(0.25)


def test_predictions_are_priced_as_measurements_are() -> None:
    """Steady, and over a path whose mean is the capacity."""
    predictor = Predictor(GRID, weights=profile("mapping"), ranges=RANGES)
    for capacity_bps in (0.6e6, 4e6, 40e6):
        path = CapacityPath.of(6.0, [PLANNED_SHARE * capacity_bps] * 60, 6)
        for found in (
            predictor.predict(situation(capacity_bps)),
            predictor.predict(situation(capacity_bps), None, path),
        ):
            one = found.prediction(5)
            terms = RANGES.terms(
                latency_s=one.latency_s,
                unreliability=one.unreliability,
                compute=one.compute,
                bandwidth_bps=one.bandwidth_bps,
                capacity_bps=capacity_bps,
            )
            assert one.terms == pytest.approx(terms)


def test_reliability_is_of_what_was_needed_not_of_what_was_sent() -> None:
    """Half of a class that needs 40 % is full reliability; a tenth is a quarter of it, however perfectly delivered."""
    demands = [ClassDemand(BULK, 10.0, 1000.0, 1.0, needed=0.4)]

    def unreliability(on_time: int) -> float:
        outcome = ClassOutcome(BULK, 10, on_time, on_time, on_time, 0.1 * on_time)
        return measure(demands, [outcome], interval_s=1.0, cpu_s=0.0, saturated=False, ranges=RANGES).unreliability

    assert unreliability(5) == 0.0
    assert unreliability(1) == pytest.approx(0.75)
    assert unreliability(0) == 1.0


def test_classes_without_traffic_do_not_count() -> None:
    demands = [ClassDemand(CONTROL, 10.0, 100.0, 0.2), ClassDemand(BULK, 0.0, 1000.0, 1.0)]
    outcomes = [ClassOutcome(CONTROL, 10, 10, 10, 10, 0.5), ClassOutcome(BULK, 0, 0, 0, 0, 0.0)]
    got = measure(demands, outcomes, interval_s=1.0, cpu_s=0.01, saturated=False, ranges=RANGES)
    assert got.unreliability == 0.0
    assert got.latency_s == pytest.approx(0.05)
    assert got.compute == pytest.approx(0.01)


def test_a_class_of_which_nothing_arrives_has_the_largest_latency_and_one_thinned_to_nothing_keeps_its_last() -> None:
    demands = [ClassDemand(BULK, 10.0, 1000.0, 1.0)]

    def latency_s(outcome: ClassOutcome, previous: Measurement | None = None) -> Measurement:
        return measure(demands, [outcome], interval_s=1.0, cpu_s=0.0, saturated=False, ranges=RANGES, previous=previous)

    lost = latency_s(ClassOutcome(BULK, 10, 10, 0, 0, 0.0))
    assert lost.latency_s == RANGES.latency_max_s
    before = latency_s(ClassOutcome(BULK, 10, 1, 1, 1, 0.12))
    assert latency_s(ClassOutcome(BULK, 10, 0, 0, 0, 0.0), before).latency_s == pytest.approx(0.12)
