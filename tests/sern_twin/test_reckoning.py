"""When a robot sends: when the twin would be wrong, and at least now and then."""

import math

import pytest

from sern_core.vocabulary.errors import UsageError
from sern_twin.motion import Motion, Twist
from sern_twin.predictors import ConstantTwist
from sern_twin.reckoning import Reckoner, ReckoningOptions

STEP_S = 0.02


def test_a_robot_that_does_what_is_expected_is_only_heard_now_and_then() -> None:
    """Ten times a seldom as at 50 Hz, on a circle too."""
    reckoner = Reckoner(ConstantTwist())
    sent = [
        step
        for step in range(501)
        if reckoner.due(
            Motion(math.sin(step * STEP_S), 1 - math.cos(step * STEP_S), step * STEP_S, Twist(1.0, 0.0, 1.0)),
            now=step * STEP_S,
        )
    ]
    assert sent == [*range(0, 501, 10)]


@pytest.mark.parametrize(
    "motion", [Motion(0.021, 0.0, 0.0), Motion(0.0, -0.021, 0.0), Motion(0.0, 0.0, math.radians(1.1))]
)
def test_one_that_does_something_else_says_so_at_once(motion: Motion) -> None:
    reckoner = Reckoner(ConstantTwist())
    assert reckoner.due(Motion(0.0, 0.0, 0.0), now=0.0)
    assert not reckoner.due(Motion(0.019, 0.0, math.radians(0.9)), now=0.02)
    assert reckoner.due(motion, now=0.04)
    assert not reckoner.due(motion, now=0.06), "the twin knows it now"


def test_the_twin_is_never_further_off_than_that() -> None:
    """A robot that speeds up and turns: whatever it does between, at 50 Hz the twin is within the limits or told."""
    reckoner, twin, sent = Reckoner(ConstantTwist()), Motion(0.0, 0.0, 0.0), 0
    robot = Motion(0.0, 0.0, 0.0)
    for step in range(1500):
        now = step * STEP_S
        twist = Twist(1.0 + math.sin(now), 0.0, math.sin(2.3 * now))
        if step:
            robot = robot.moved(twist, STEP_S, twist)
            twin = twin.moved(twin.twist, STEP_S, twin.twist)
        if reckoner.due(robot, now=now):
            sent += 1
            twin = robot
        assert twin.distance_m(robot) <= 0.02 + 1e-9
        assert abs(twin.turn_rad(robot)) <= math.radians(1) + 1e-9
    assert 150 < sent < 500


def test_a_clock_that_goes_back_and_what_is_not_finite() -> None:
    reckoner = Reckoner(ConstantTwist())
    assert not reckoner.due(Motion(math.nan, 0.0, 0.0), now=9.0)
    assert reckoner.due(Motion(0.0, 0.0, 0.0), now=10.0)
    assert reckoner.due(Motion(0.0, 0.0, 0.0), now=3.0)
    assert not reckoner.due(Motion(0.0, 0.0, 0.0), now=3.1)


@pytest.mark.parametrize("name", ReckoningOptions.__slots__)
def test_options_that_cannot_be(name: str) -> None:
    for wrong in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(UsageError, match=f"dead reckoning: {name}"):
            ReckoningOptions(**{name: wrong})
