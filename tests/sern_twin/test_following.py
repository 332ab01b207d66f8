"""Whether a robot follows its plan, and how late."""

import math
from random import Random

import pytest

from sern_twin.following import FEWEST, Following
from sern_twin.motion import Motion, Twist
from sern_twin.trajectory import Trajectory, Waypoint

EAST = Trajectory([Waypoint(float(second), float(second), 0.0) for second in range(100)])
"""At 1 m/s along x."""


def at(x_m: float, y_m: float = 0.0, speed_mps: float = 1.0) -> Motion:
    return Motion(x_m, y_m, 0.0, Twist(speed_mps))


@pytest.mark.parametrize("late_s", [-0.4, 0.0, 0.3, 1.5])
def test_how_late_it_is_is_learned(late_s: float) -> None:
    random, following = Random(1), Following(EAST)
    for step in range(200):
        stamp_s = 5 + step * 0.02
        following.heard(stamp_s, at(stamp_s - late_s + random.gauss(0, 0.01), random.gauss(0, 0.01)))
    assert following.follows
    assert following.delay_s == pytest.approx(late_s, abs=0.01)


@pytest.mark.parametrize("place", [at(10.0, 0.8), at(4.0), at(18.0)], ids=["beside it", "far behind", "far ahead"])
def test_one_that_is_elsewhere_follows_nothing(place: Motion) -> None:
    following = Following(EAST)
    for step in range(50):
        following.heard(10 + step * 0.02, Motion(place.x_m + step * 0.02, place.y_m, 0.0, place.twist))
    assert not following.follows


def test_a_few_are_needed() -> None:
    following = Following(EAST)
    for step in range(FEWEST):
        assert not following.follows
        following.heard(10 + step * 0.02, at(10 + step * 0.02))
    assert following.follows


def test_one_that_stands_follows_no_more_until_it_moves() -> None:
    """On the second message: its plan would lead the twin away from a robot that stands."""
    following = Following(EAST)
    for step in range(100):
        following.heard(10 + step * 0.02, at(10 + step * 0.02))
    said = []
    for stamp_s, speed_mps in ((12.02, 0.0), (12.04, 0.0), (12.06, 0.9)):
        following.heard(stamp_s, at(12.0, speed_mps=speed_mps))
        said.append(following.follows)
    assert said == [True, False, True], "one message alone may be noise"


def test_one_that_stands_where_the_plan_stands_follows_it() -> None:
    plan = Trajectory(
        [Waypoint(0.0, 0.0, 0.0), Waypoint(2.0, 2.0, 0.0), Waypoint(10.0, 2.0, 0.0), Waypoint(12.0, 4.0, 0.0)]
    )
    following = Following(plan)
    for step in range(20):
        following.heard(5 + step * 0.02, at(2.0, speed_mps=0.0))
    assert following.follows and following.delay_s == 0.0


def test_stamps_outside_of_the_plan_teach_nothing() -> None:
    following = Following(EAST)
    for stamp_s in (-5.0, 99.0, 1e9, -math.inf):
        for _ in range(FEWEST):
            following.heard(stamp_s, at(0.0))
    assert not following.follows
