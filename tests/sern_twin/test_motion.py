"""How a robot moves on, against many small steps."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sern_twin.motion import Motion, Twist
from tests.exploring import cases

SPEED = st.floats(-3.0, 3.0)


def small_steps(motion: Motion, twist: Twist, duration_s: float, steps: int) -> Motion:
    """Euler's, at the middle of each step."""
    x_m, y_m, yaw_rad, step_s = motion.x_m, motion.y_m, motion.yaw_rad, duration_s / steps
    for _ in range(steps):
        middle = yaw_rad + twist.yaw_radps * step_s / 2
        x_m += (math.cos(middle) * twist.forward_mps - math.sin(middle) * twist.left_mps) * step_s
        y_m += (math.sin(middle) * twist.forward_mps + math.cos(middle) * twist.left_mps) * step_s
        yaw_rad += twist.yaw_radps * step_s
    return Motion(x_m, y_m, yaw_rad, twist)


@settings(max_examples=cases(60))
@given(
    forward_mps=SPEED, left_mps=SPEED, yaw_radps=st.one_of(SPEED, st.floats(-1e-6, 1e-6)),
    yaw_rad=st.floats(-3.0, 3.0), duration_s=st.floats(0.0, 3.0),
)  # fmt: skip
def test_an_arc_is_many_small_steps(
    forward_mps: float, left_mps: float, yaw_radps: float, yaw_rad: float, duration_s: float
) -> None:
    twist = Twist(forward_mps, left_mps, yaw_radps)
    start = Motion(1.0, -2.0, yaw_rad)
    there, wanted = start.moved(twist, duration_s, twist), small_steps(start, twist, duration_s, 400)
    assert there.distance_m(wanted) < 1e-3
    assert abs(there.turn_rad(wanted)) < 1e-9
    assert there.twist == twist
    assert abs(there.yaw_rad) <= math.pi
    back = there.moved(twist, -duration_s, twist)
    assert back.distance_m(start) < 1e-9


def test_a_quarter_of_a_circle() -> None:
    twist = Twist(math.pi / 2, 0.0, math.pi / 2)
    there = Motion(0.0, 0.0, 0.0, forward_mps2=0.3).moved(twist, 1.0, twist)
    assert [there.x_m, there.y_m, there.yaw_rad] == pytest.approx([1.0, 1.0, math.pi / 2])
    assert there.velocity_mps() == pytest.approx((0.0, math.pi / 2))
    assert there.forward_mps2 == 0.3


def test_between_two_of_them() -> None:
    one, other = Motion(0.0, 0.0, 3.0, Twist(3.0, 4.0, 0.0)), Motion(3.0, 4.0, -3.0)
    assert one.distance_m(other) == 5.0
    assert one.turn_rad(other) == pytest.approx(2 * math.pi - 6.0)
    assert one.speed_mps == 5.0


@pytest.mark.parametrize("wrong", [math.nan, math.inf, -math.inf])
def test_what_no_robot_can_be_at(wrong: float) -> None:
    assert Motion(0.0, 0.0, 0.0, Twist(1.0, 0.0, 1.0), 1.0, 1.0).finite
    for motion in (
        Motion(wrong, 0.0, 0.0), Motion(0.0, wrong, 0.0), Motion(0.0, 0.0, wrong), Motion(0.0, 0.0, 0.0, Twist(wrong)),
        Motion(0.0, 0.0, 0.0, Twist(0.0, wrong)), Motion(0.0, 0.0, 0.0, Twist(0.0, 0.0, wrong)),
        Motion(0.0, 0.0, 0.0, forward_mps2=wrong), Motion(0.0, 0.0, 0.0, yaw_radps2=wrong),
        Motion(wrong, -wrong, 0.0),
    ):  # fmt: skip
        assert not motion.finite
