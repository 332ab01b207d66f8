"""A robot that only its satellite receiver places."""

import math
from random import Random

import pytest

from sern_twin.fixes import Fix, Fixes
from sern_twin.geodesy import TangentPlane

PLANE = TangentPlane.from_degrees(39.25, -76.71, 60.0)


def fix(x_m: float, y_m: float, up_m: float = 0.0) -> Fix:
    latitude, longitude, height_m = PLANE.to_geodetic((x_m, y_m, up_m)).tolist()
    return Fix(math.degrees(latitude), math.degrees(longitude), height_m, valid=True)


def test_fixes_on_a_way_have_its_speed_and_heading() -> None:
    fixes = Fixes(PLANE)
    for step in range(20):
        at_s = 0.2 * step
        motion, z_m = fixes.motion(at_s, fix(10.0 + 0.6 * at_s, -5.0 + 0.8 * at_s, 1.5))
        fixes.took(at_s, motion, anew=False)
    assert (motion.x_m, motion.y_m) == pytest.approx((10.0 + 0.6 * 3.8, -5.0 + 0.8 * 3.8), abs=1e-6)
    assert z_m == pytest.approx(1.5)
    assert motion.twist.forward_mps == pytest.approx(1.0) and motion.yaw_rad == pytest.approx(math.atan2(0.8, 0.6))


def test_noise_of_a_robot_that_stands_turns_it_nowhere() -> None:
    fixes, random = Fixes(PLANE), Random(4)
    for step in range(200):
        motion, _z_m = fixes.motion(0.2 * step, fix(random.gauss(0, 0.1), random.gauss(0, 0.1)))
        fixes.took(0.2 * step, motion, anew=False)
        assert (motion.yaw_rad, motion.twist.forward_mps) == (0.0, 0.0)


def test_a_robot_that_stops_keeps_its_heading() -> None:
    fixes = Fixes(PLANE)
    for step in range(60):
        at_s = 0.2 * step
        motion, _z_m = fixes.motion(at_s, fix(0.0, min(at_s, 4.0)))
        fixes.took(at_s, motion, anew=False)
    assert motion.twist.forward_mps == 0.0 and motion.yaw_rad == pytest.approx(math.pi / 2)


def test_a_fix_that_jumps_has_the_speed_of_those_before_and_after_it_was_believed_none() -> None:
    fixes = Fixes(PLANE)
    for step in range(20):
        motion, _z_m = fixes.motion(0.2 * step, fix(0.2 * step, 0.0))
        fixes.took(0.2 * step, motion, anew=False)
    jump, _z_m = fixes.motion(4.0, fix(80.0, 0.0))
    assert jump.x_m == pytest.approx(80.0) and jump.speed_mps == pytest.approx(1.0)
    fixes.took(4.0, jump, anew=True)
    after, _z_m = fixes.motion(4.2, fix(80.2, 0.0))
    assert after.speed_mps == 0.0, "two fixes make no way"


@pytest.mark.parametrize(
    ("latitude_deg", "longitude_deg"), [(math.nan, 0.0), (0.0, math.inf), (91.0, 0.0), (0.0, 361.0)]
)
def test_what_is_no_place_on_the_earth_is_not_finite(latitude_deg: float, longitude_deg: float) -> None:
    motion, z_m = Fixes(PLANE).motion(0.0, Fix(latitude_deg, longitude_deg, 1.0, valid=True))
    assert not motion.finite and z_m == 0.0


def test_a_height_that_is_none_is_that_of_the_site() -> None:
    motion, z_m = Fixes(PLANE).motion(0.0, Fix(39.25, -76.71, math.nan, valid=True))
    assert (motion.x_m, motion.y_m, z_m) == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)
