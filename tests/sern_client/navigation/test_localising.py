"""The place of a robot between what its odometry says."""

import math

import pytest

from sern_client.navigation.hearing import HeardOdometry
from sern_client.navigation.localising import Localiser, inverse, placed
from sern_twin.world.occupancy import Pose

S = 10**9


def said(at_s: float, x_m: float, yaw_rad: float = 0.0, speed: tuple[float, float] = (1.0, 0.0)) -> HeardOdometry:
    return HeardOdometry(round(at_s * S), "odom", (x_m, 0.0, yaw_rad), 0.0, 0.0, speed)


def test_between_two_it_is_in_between_and_the_short_way_round() -> None:
    localiser = Localiser()
    assert localiser.heard(said(1.0, 0.0, math.pi - 0.1)) and localiser.heard(said(1.1, 1.0, 0.1 - math.pi))
    assert localiser.at(round(1.05 * S)) == pytest.approx((0.5, 0.0, math.pi))


def test_beyond_the_last_one_it_drives_on_for_a_moment() -> None:
    localiser = Localiser()
    localiser.heard(said(1.0, 0.0))
    assert localiser.at(round(1.2 * S)) == pytest.approx((0.2, 0.0, 0.0))
    assert localiser.at(round(1.4 * S)) is None, "nobody knows any more"
    assert localiser.at(round(0.9 * S)) is None, "nor before the first"


def test_a_gap_is_not_bridged() -> None:
    localiser = Localiser()
    localiser.heard(said(1.0, 0.0))
    localiser.heard(said(3.0, 2.0))
    assert localiser.at(2 * S) is None


@pytest.mark.parametrize("pose", [(math.nan, 0.0, 0.0), (0.0, math.inf, 0.0), (0.0, 0.0, math.nan), (1e12, 0.0, 0.0)])
def test_what_is_no_place_is_left_out(pose: Pose) -> None:
    localiser = Localiser()
    assert not localiser.heard(HeardOdometry(S, "odom", pose, 0.0, 0.0, (0.0, 0.0)))
    assert localiser.last is None


def test_speeds_that_are_none_move_nothing() -> None:
    localiser = Localiser()
    localiser.heard(said(1.0, 0.5, speed=(math.nan, 0.0)))
    assert localiser.at(round(1.1 * S)) == (0.5, 0.0, 0.0)


def test_what_is_a_moment_late_changes_nothing_and_a_clock_that_was_set_back_begins_anew() -> None:
    localiser = Localiser()
    localiser.heard(said(10.0, 1.0))
    assert localiser.heard(said(9.9, 0.0)) and localiser.at(10 * S) == (1.0, 0.0, 0.0)
    localiser.heard(said(2.0, 5.0))
    assert localiser.at(2 * S) == (5.0, 0.0, 0.0) and localiser.at(10 * S) is None


def test_a_scan_that_fits_places_the_frame_of_the_odometry() -> None:
    localiser = Localiser((1.0, 2.0, 0.0))
    localiser.heard(said(1.0, 3.0))
    assert localiser.at(S) == pytest.approx((4.0, 2.0, 0.0))
    localiser.fits((4.1, 2.2, 0.1), S)
    assert localiser.at(S) == pytest.approx((4.1, 2.2, 0.1))
    localiser.fits((0.0, 0.0, 0.0), 5 * S)
    assert localiser.at(S) == pytest.approx((4.1, 2.2, 0.1)), "where it was then is not known"


def test_the_inverse_of_a_pose_undoes_it() -> None:
    pose = (1.0, -2.0, 0.7)
    assert placed(pose, inverse(pose)) == pytest.approx((0.0, 0.0, 0.0), abs=1e-12)
    assert placed(inverse(pose), pose) == pytest.approx((0.0, 0.0, 0.0), abs=1e-12)
