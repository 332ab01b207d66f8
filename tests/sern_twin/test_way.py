"""A path without times, and a robot that goes along it."""

import math

import numpy as np
import pytest

from sern_core.vocabulary.errors import BodyError
from sern_twin.motion import Motion, Twist
from sern_twin.predictors import ConstantAcceleration
from sern_twin.way import PathTracking, Way

CORNER = [(0.0, 0.0), (4.0, 0.0), (4.0, 3.0)]


def test_the_foot_of_a_robot_is_the_nearest_place() -> None:
    way = Way(CORNER)
    foot = way.foot(Motion(1.0, 0.2, 0.0, Twist(0.5)))
    assert foot == pytest.approx((1.0, 0.2, 0.0))
    assert way.foot(Motion(4.3, 2.0, math.pi / 2, Twist(0.5))) == pytest.approx((6.0, -0.3, math.pi / 2))
    assert way.at(-1.0) == (0.0, 0.0) and way.at(5.0) == (4.0, 1.0) and way.at(99.0) == (4.0, 3.0)
    assert way.length_m == 7.0


def test_where_a_way_crosses_itself_the_robot_is_on_the_part_that_goes_as_it_goes() -> None:
    way = Way([(-2.0, 0.0), (2.0, 0.0), (2.0, 2.0), (0.0, 2.0), (0.0, -2.0)])
    assert way.foot(Motion(0.05, 0.05, 0.0, Twist(0.5))).along_m == pytest.approx(2.05)
    assert way.foot(Motion(0.05, 0.05, -math.pi / 2, Twist(0.5))).along_m == pytest.approx(4 + 2 + 2 + 1.95)


def test_a_robot_that_drives_backwards_along_a_way_goes_on_so() -> None:
    way = Way(CORNER)
    reversing = Motion(1.0, 0.0, math.pi, Twist(-0.5))
    assert way.followed_by(reversing)
    there = PathTracking(way, 0.5).reach(reversing, 10.0, 14.0, 0.02, heard_s=8.0)
    assert (there.x_m, there.y_m) == pytest.approx((3.0, 0.0), abs=1e-6)
    assert abs(there.yaw_rad) == pytest.approx(math.pi) and there.twist.forward_mps == pytest.approx(-0.5)


def test_what_was_heard_just_now_is_believed_before_the_path_is() -> None:
    """A robot is faster than on average: for half a second it goes on so, as a twin without a plan."""
    fast = Motion(1.0, 0.1, 0.1, Twist(0.9, 0.0, 0.2), forward_mps2=0.4)
    tracking, alone = PathTracking(Way(CORNER), 0.5), ConstantAcceleration()
    for until_s in (10.1, 10.5):
        assert tracking.reach(fast, 10.0, until_s, 0.02, heard_s=10.0) == alone.reach(
            fast, 10.0, until_s, 0.02, heard_s=10.0
        )
    assert tracking.reach(fast, 10.0, 11.0, 0.02, heard_s=10.0) != alone.reach(fast, 10.0, 11.0, 0.02, heard_s=10.0)


def test_it_goes_along_the_way_comes_back_to_it_and_takes_on_its_speed() -> None:
    tracking = PathTracking(Way(CORNER), 0.5)
    beside = Motion(1.0, 0.2, 0.0, Twist(1.0))
    after = tracking.reach(beside, 10.0, 12.0, 0.02, heard_s=5.0)
    # The way under a speed that goes from 1 to 0.5 with a time constant of a second.
    assert after.x_m == pytest.approx(1 + 0.5 * 2 + 0.5 * (1 - math.exp(-2)), abs=2e-3)
    assert after.y_m == pytest.approx(0.2 * math.exp(-2), abs=1e-3)
    assert after.twist.forward_mps == pytest.approx(0.5 + 0.5 * math.exp(-2), abs=1e-3)
    round_the_corner = tracking.reach(beside, 10.0, 17.0, 0.02, heard_s=5.0)
    assert round_the_corner.x_m == pytest.approx(4.0, abs=0.02)
    assert round_the_corner.y_m == pytest.approx(1 + 3.5 + 0.5 - 4, abs=0.05)
    assert round_the_corner.yaw_rad == pytest.approx(math.pi / 2, abs=0.05)


def test_at_the_end_it_stands() -> None:
    there = PathTracking(Way(CORNER), 0.5).reach(Motion(1.0, 0.0, 0.0, Twist(0.5)), 10.0, 60.0, 0.02, heard_s=5.0)
    assert (there.x_m, there.y_m) == pytest.approx((4.0, 3.0), abs=1e-6)
    assert there.twist == Twist()


@pytest.mark.parametrize(
    ("place", "follows"),
    [
        (Motion(1.0, 0.4, 0.3, Twist(0.5)), True),
        (Motion(1.0, 0.6, 0.0, Twist(0.5)), False),
        (Motion(1.0, 0.0, 2.0, Twist(0.5)), False),
        (Motion(4.0, 3.0, math.pi / 2, Twist(0.5)), False),
    ],
    ids=["on it", "too far off", "another direction", "at its end"],
)
def test_who_follows_a_way(place: Motion, follows: bool) -> None:
    assert Way(CORNER).followed_by(place) is follows


@pytest.mark.parametrize(
    "places",
    [[], [(0.0, 0.0)], [(0.0, 0.0), (0.0, 1e-7)], [(0.0, 0.0), (math.nan, 0.0)], [(-1e308, 0.0), (1e308, 0.0)]],
    ids=["none", "one", "one place twice", "not finite", "too long"],
)
def test_what_is_no_way(places: list[tuple[float, float]]) -> None:
    with pytest.raises(BodyError):
        Way(places)


def test_a_way_that_turns_back_on_the_spot_has_a_direction_everywhere() -> None:
    way = Way([(0.0, 0.0), (1.0, 0.0), (0.0, 0.0)])
    assert all(math.isfinite(way.direction_rad(along_m)) for along_m in np.linspace(-1, 3, 41))
    assert way.direction_rad(1.0) == pytest.approx(math.pi)
