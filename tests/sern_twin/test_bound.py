"""Bounds of the error after a gap: against integration, and what is said of one that was not kept."""

import math
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sern_core.vocabulary.errors import UsageError
from sern_twin.bound import (
    GapReport,
    Mismatch,
    lipschitz_bound,
    position_bound_m,
    reachable_bound_m,
    velocity_bound_mps,
)
from tests.exploring import cases

STEPS = 200
SMALL = st.floats(0.0, 2.0)


@settings(max_examples=cases(100))
@given(error_m=SMALL, error_mps=SMALL, mismatch_mps2=SMALL, gap_s=st.floats(0.1, 30.0), seed=st.integers(0, 2**32))
def test_no_motion_within_the_mismatch_gets_further(
    error_m: float, error_mps: float, mismatch_mps2: float, gap_s: float, seed: int
) -> None:
    """Whatever the robot does with an acceleration within ā of what was predicted, in two dimensions."""
    step_s = gap_s / STEPS
    x, y, speed_x, speed_y = error_m, 0.0, error_mps * math.cos(1.0), error_mps * math.sin(1.0)
    heading, choices = 0.0, Random(seed)
    for step in range(STEPS):
        if step % 20 == 0:
            heading = choices.uniform(0, 2 * math.pi)
        much = mismatch_mps2 * choices.uniform(0.5, 1.0)
        across, along = much * math.cos(heading), much * math.sin(heading)
        x += speed_x * step_s + across * step_s**2 / 2
        y += speed_y * step_s + along * step_s**2 / 2
        speed_x += across * step_s
        speed_y += along * step_s
    assert math.hypot(speed_x, speed_y) <= velocity_bound_mps(error_mps, mismatch_mps2, gap_s) + 1e-9
    assert math.hypot(x, y) <= position_bound_m(error_m, error_mps, mismatch_mps2, gap_s) + 1e-9


def test_the_bound_is_reached_by_the_worst() -> None:
    """Straight away, with all the mismatch there is: it could not be less."""
    assert position_bound_m(0.1, 0.2, 0.5, 4.0) == pytest.approx(0.1 + 0.2 * 4 + 0.5 * 0.5 * 16)
    assert velocity_bound_mps(0.2, 0.5, 4.0) == pytest.approx(2.2)


def test_two_robots_get_no_further_apart_than_they_can_drive() -> None:
    assert position_bound_m(0.0, 0.0, 1.0, 30.0) == 450.0
    assert reachable_bound_m(0.02, 0.0, 1.0, 30.0, max_speed_mps=1.0) == 60.02
    assert reachable_bound_m(0.02, 0.0, 1.0, 0.5, max_speed_mps=1.0) == pytest.approx(0.145)


@pytest.mark.parametrize("gap_s", [0.5, 2.0, 10.0])
def test_the_proposition_bounds_a_system_that_obeys_it(gap_s: float) -> None:
    """dx/dt = L_x x + L_u u is the worst there is: the bound is its solution."""
    state, other, steps = 1.3, 1.1, 20_000
    for _ in range(steps):
        state += gap_s / steps * (0.4 * state + 0.7 * 0.25)
        other += gap_s / steps * (0.4 * other + 0.7 * 0.0)
    bound = lipschitz_bound(0.2, 0.4, 0.7, 0.25, gap_s)
    assert state - other == pytest.approx(bound, rel=1e-3)
    assert state - other <= bound


def test_the_proposition_at_its_limits() -> None:
    assert lipschitz_bound(0.2, 0.0, 0.7, 0.5, 10.0) == pytest.approx(0.2 + 0.7 * 0.5 * 10)
    assert lipschitz_bound(0.2, 1e-12, 0.7, 0.5, 10.0) == pytest.approx(3.7)
    assert lipschitz_bound(0.2, 1.0, 0.7, 0.5, 1e6) == math.inf
    assert lipschitz_bound(0.0, 1.0, 0.7, 0.0, 1e6) == 0.0


def test_the_mismatch_is_the_95th_of_a_hundred() -> None:
    mismatch = Mismatch(0.05)
    assert mismatch.bound_mps2 == 0.05
    for number in range(1, 101):
        mismatch.found(-number / 100)
    assert mismatch.bound_mps2 == 0.95
    for _ in range(512):
        mismatch.found(0.001)
    assert mismatch.bound_mps2 == 0.05, "the old ones are forgotten, and there is a least"


@pytest.mark.parametrize("wrong", [math.nan, math.inf])
def test_a_mismatch_that_is_none(wrong: float) -> None:
    with pytest.raises(UsageError, match="mismatch"):
        Mismatch(0.1).found(wrong)
    with pytest.raises(UsageError, match="mismatch"):
        Mismatch(wrong)


@pytest.mark.parametrize(
    ("error_m", "violated"), [(0.0, False), (0.05, False), (0.279, False), (0.281, True), (0.5, True)]
)
def test_a_gap_is_reported(error_m: float, violated: bool) -> None:
    report = GapReport(
        gap_s=1.0, start_error_m=0.02, start_error_mps=0.2, mismatch_mps2=0.1, max_speed_mps=1.0, error_m=error_m,
        end_error_m=0.01, shown_error_m=0.4,
    )  # fmt: skip
    assert [report.bound_m, report.reachable_m] == pytest.approx([0.27, 0.27])
    assert report.violated is violated
    assert report.ratio == pytest.approx(error_m / 0.27)
    assert report.shown_error_m == 0.4, "what was shown is reported, and is no part of the bound"


def test_a_gap_where_nothing_was_allowed() -> None:
    certain = {
        "start_error_m": 0.0,
        "start_error_mps": 0.0,
        "mismatch_mps2": 0.0,
        "end_error_m": 0.0,
        "shown_error_m": 0.0,
    }
    assert GapReport(gap_s=1.0, max_speed_mps=1.0, error_m=0.0, **certain).ratio == 0.0
    report = GapReport(gap_s=1.0, max_speed_mps=1.0, error_m=0.1, **certain)
    assert (report.ratio, report.violated) == (math.inf, True)
