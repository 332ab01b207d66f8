"""The way back after a gap: stable, damped, within its limits, and without a jump."""

import math
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sern_core.vocabulary.errors import UsageError
from sern_twin.correction import CorrectionOptions, Gains, Offset, Outage
from tests.exploring import cases

STEP_S = 0.02
OPTIONS = CorrectionOptions()
UNBOUNDED = CorrectionOptions(
    max_speed_mps=1e6, max_accel_mps2=1e6, max_yaw_rate_radps=1e6, max_yaw_accel_radps2=1e6, snap_m=1e6,
    tolerance_m=0.0, tolerance_rad=0.0, tolerance_growth=0.0,
)  # fmt: skip


def led(offset: Offset, gap_s: float, duration_s: float) -> list[float]:
    """The distance after each step."""
    found = []
    for _ in range(round(duration_s / STEP_S)):
        offset.step(STEP_S, gap_s)
        found.append(offset.distance_m)
    return found


def test_gains_fall_with_the_gap_and_stay_within_their_limits() -> None:
    assert OPTIONS.gains(0.0) == Gains(16.0, 8.0)
    softer = OPTIONS.gains(5.0)
    assert [softer.proportional, softer.derivative] == pytest.approx([16 / math.e, 8 * math.exp(-0.5)])
    assert OPTIONS.gains(1000.0) == Gains(0.25, 1.0)


@pytest.mark.parametrize("gap_s", [0.0, 0.5, 2.0, 5.0, 10.0, 20.0, 30.0, 300.0])
def test_it_is_damped_whatever_the_gap(gap_s: float) -> None:
    """The damping ratio Kd / 2√Kp is 1 at the least, so the twin comes back without going past the robot."""
    gains = OPTIONS.gains(gap_s)
    assert gains.derivative / (2 * math.sqrt(gains.proportional)) >= 1 - 1e-9
    offset = Offset(UNBOUNDED)
    offset.jumped(1.0, 0.0, 0.0)
    assert offset.x_m == -1.0
    led(offset, gap_s, 60.0)
    assert -0.001 < offset.x_m < 0.001
    offset.jumped(1.0, 0.0, 0.0)
    assert all(offset.x_m < 0.001 for _ in led(offset, gap_s, 60.0))


def test_equal_decay_would_overshoot() -> None:
    """Why Kd decays half as fast as Kp, and why there is a least: the twin would swing about the robot."""
    equal = replace(UNBOUNDED, proportional_min=1e-9, derivative_min=1e-9, derivative_decay_per_s=0.2)
    gains = equal.gains(30.0)
    assert gains.derivative / (2 * math.sqrt(gains.proportional)) == pytest.approx(0.05, abs=0.001)
    offset = Offset(equal)
    offset.jumped(1.0, 0.0, 0.0)
    highest_m = -1.0
    for _ in range(2000):
        offset.step(STEP_S, 30.0)
        highest_m = max(highest_m, offset.x_m)
    assert highest_m > 0.8


@settings(max_examples=cases(60))
@given(
    x_m=st.floats(-2.0, 2.0), y_m=st.floats(-2.0, 2.0), yaw_rad=st.floats(-3.0, 3.0), x_mps=st.floats(-3.0, 3.0),
    gap_s=st.floats(0.0, 60.0), step_s=st.floats(0.001, 0.5),
)  # fmt: skip
def test_it_keeps_its_limits(x_m: float, y_m: float, yaw_rad: float, x_mps: float, gap_s: float, step_s: float) -> None:
    """No step moves the shown twin faster against the estimate than the limits, whatever jumped."""
    offset = Offset(OPTIONS)
    offset.jumped(x_m, y_m, yaw_rad, x_mps)
    for _ in range(200):
        before = offset.x_m, offset.y_m, offset.yaw_rad
        offset.step(step_s, gap_s)
        moved_m = math.dist(before[:2], (offset.x_m, offset.y_m))
        turned_rad = abs(math.remainder(offset.yaw_rad - before[2], 2 * math.pi))
        assert moved_m <= OPTIONS.max_speed_mps * step_s + 1e-9
        assert turned_rad <= OPTIONS.max_yaw_rate_radps * step_s + 1e-9
    assert offset.snaps == 0


@pytest.mark.parametrize("jump_m", [0.1, 0.5, 1.0])
def test_back_in_three_seconds(jump_m: float) -> None:
    """After half a second of silence, at half a metre a second at the most: within the band by then, and it stays."""
    offset = Offset(OPTIONS)
    offset.jumped(jump_m, 0.0, 0.3)
    way = led(offset, 0.5, 6.0)
    band_m = OPTIONS.band_m(0.5, 0.0)
    assert way[0] == pytest.approx(jump_m, abs=0.01)
    assert max(way[150:]) <= band_m + 0.01
    assert max(way[250:]) <= band_m + 1e-6
    assert abs(offset.yaw_rad) <= OPTIONS.tolerance_rad + 1e-3


def test_the_band_grows_with_gap_and_speed_and_is_left_alone() -> None:
    assert OPTIONS.band_m(0.0, 1.0) == 0.02
    assert OPTIONS.band_m(2.0, -1.0) == pytest.approx(0.12)
    offset = Offset(OPTIONS)
    offset.jumped(0.1, 0.0, math.radians(0.5))
    offset.step(1.0, 2.0, robot_speed_mps=1.0)
    assert [offset.x_m, offset.yaw_rad] == pytest.approx([-0.1, -math.radians(0.5)])
    offset.step(1.0, 2.0, robot_speed_mps=0.0)
    assert offset.x_m > -0.1


def test_what_is_too_far_is_dropped_and_counted() -> None:
    offset = Offset(OPTIONS)
    offset.jumped(2.9, 0.0, 0.0)
    assert (offset.snaps, offset.distance_m) == (0, 2.9)
    offset.jumped(0.2, 0.0, 1.0)
    assert (offset.snaps, offset.distance_m, offset.speed_mps, offset.yaw_rad) == (1, 0.0, 0.0, 0.0)


def test_the_short_way_round() -> None:
    offset = Offset(OPTIONS)
    offset.jumped(0.0, 0.0, math.radians(350))
    assert offset.yaw_rad == pytest.approx(math.radians(10))


@pytest.mark.parametrize("jump", [(math.nan, 0.0, 0.0), (0.0, math.inf, 0.0), (0.0, 0.0, math.nan)])
def test_a_jump_that_is_none(jump: tuple[float, float, float]) -> None:
    offset = Offset(OPTIONS)
    with pytest.raises(UsageError, match="no motion"):
        offset.jumped(*jump)
    assert offset.distance_m == 0.0


def test_no_time_no_step() -> None:
    offset = Offset(OPTIONS)
    offset.jumped(1.0, 0.0, 0.0)
    offset.step(0.0, 1.0)
    offset.step(-1.0, 1.0)
    assert offset.x_m == -1.0


def test_a_gap_is_remembered() -> None:
    """With τ = 0 at the first message the soft gains would never act."""
    outage = Outage(1.0, now=0.0)
    assert outage.gap_s(now=30.0) == 30.0
    outage.heard(now=30.0)
    assert outage.silence_s(now=30.0) == 0.0
    assert outage.gap_s(now=30.0) == 30.0
    for step in range(1, 51):
        outage.heard(now=30.0 + step * 0.02)
    assert outage.gap_s(now=31.0) == pytest.approx(30 / math.e), "however often it is heard meanwhile"
    assert outage.gap_s(now=50.0) == pytest.approx(19.0)
    outage.heard(now=10.0)
    assert outage.silence_s(now=9.0) == 0.0, "a clock that goes back is no silence"


@pytest.mark.parametrize(
    "wrong",
    [{"proportional": -1.0}, {"derivative": math.nan}, {"snap_m": math.inf}, {"proportional_min": 0.0},
     {"proportional_min": 17.0}, {"derivative_min": 9.0}, {"step_s": 0.0}, {"recovery_s": 0.0}, {"step_s": 0.4},
     {"proportional": 900.0}],
)  # fmt: skip
def test_options_that_cannot_be(wrong: dict[str, float]) -> None:
    with pytest.raises(UsageError, match="correction"):
        CorrectionOptions(**wrong)
