"""Plans: they pass through their waypoints, smoothly, and what is no plan is refused by its waypoint."""

import math

import pytest

from sern_core.vocabulary.errors import BodyError
from sern_twin.motion import STILL
from sern_twin.trajectory import Trajectory, Waypoint


def circle(points: int, *, yaw: bool, radius_m: float = 2.0, duration_s: float = 10.0) -> Trajectory:
    """Once around, counter-clockwise."""
    found = []
    for number in range(points):
        angle = 2 * math.pi * number / (points - 1)
        heading = angle + math.pi / 2 if yaw else None
        found.append(
            Waypoint(
                duration_s * number / (points - 1), radius_m * math.cos(angle), radius_m * math.sin(angle), heading
            )
        )
    return Trajectory(found)


@pytest.mark.parametrize("yaw", [True, False])
def test_a_circle_of_waypoints_every_half_second(yaw: bool) -> None:
    """At 1.3 m/s: within 1 cm of the circle, where straight lines would cut 2.5 cm, and 1 % of its speed."""
    plan = circle(21, yaw=yaw)
    assert (plan.start_s, plan.end_s) == (0.0, 10.0)
    for step in range(5, 96):
        motion = plan.at(step / 10)
        angle = 2 * math.pi * step / 100
        assert math.hypot(motion.x_m, motion.y_m) == pytest.approx(2.0, abs=0.01)
        assert motion.speed_mps == pytest.approx(2 * math.pi * 2.0 / 10, rel=0.03)
        assert math.remainder(motion.yaw_rad - angle - math.pi / 2, 2 * math.pi) == pytest.approx(0.0, abs=0.05)
        assert motion.twist.yaw_radps == pytest.approx(2 * math.pi / 10, rel=0.1)


def test_speeds_are_those_of_the_places() -> None:
    plan = circle(21, yaw=False)
    for step in range(1, 99):
        before, motion, after = (plan.at(step / 10 + change) for change in (-1e-5, 0.0, 1e-5))
        x_mps, y_mps = motion.velocity_mps()
        assert [x_mps, y_mps] == pytest.approx(
            [(after.x_m - before.x_m) / 2e-5, (after.y_m - before.y_m) / 2e-5], abs=1e-3
        )
        assert motion.twist.yaw_radps == pytest.approx(before.turn_rad(after) / 2e-5, abs=1e-3)


def test_it_passes_through_its_waypoints_and_stands_before_and_after() -> None:
    points = [Waypoint(1.0, 0.0, 0.0), Waypoint(2.0, 1.0, 0.5), Waypoint(4.0, 1.5, 3.0, 2.0), Waypoint(4.5, 0.0, 0.0)]
    plan = Trajectory(points)
    for point in points:
        motion = plan.at(point.time_s)
        assert [motion.x_m, motion.y_m] == pytest.approx([point.x_m, point.y_m])
    assert plan.at(4.0).yaw_rad == pytest.approx(2.0)
    for time_s, place in ((-5.0, points[0]), (4.5, points[-1]), (1e9, points[-1])):
        assert plan.at(time_s).twist == STILL
        assert (plan.at(time_s).x_m, plan.at(time_s).y_m) == (place.x_m, place.y_m)


def test_it_rests_where_two_waypoints_are_one_place() -> None:
    """No swing past it, and the yaw stays what it was."""
    plan = Trajectory(
        [Waypoint(0.0, 0.0, 0.0), Waypoint(1.0, 1.0, 1.0), Waypoint(3.0, 1.0, 1.0), Waypoint(4.0, 0.0, 2.0)]
    )
    for step in range(21):
        motion = plan.at(1.0 + step / 10)
        assert [motion.x_m, motion.y_m, motion.speed_mps] == pytest.approx([1.0, 1.0, 0.0])
    assert plan.at(1.0).yaw_rad == pytest.approx(math.pi / 4)
    turned = Trajectory([Waypoint(0.0, 0.0, 0.0, 3.0), Waypoint(1.0, 0.0, 0.0, -3.0)])
    assert turned.at(0.5).yaw_rad in (pytest.approx(math.pi), pytest.approx(-math.pi)), "on the spot, the short way"
    nowhere = Trajectory([Waypoint(0.0, 0.0, 0.0), Waypoint(1.0, 0.0, 0.0)])
    assert nowhere.at(0.5).yaw_rad == 0.0


def test_two_waypoints_are_a_line() -> None:
    motion = Trajectory([Waypoint(0.0, 0.0, 0.0), Waypoint(2.0, 2.0, 2.0)]).at(0.5)
    assert [motion.x_m, motion.y_m, motion.yaw_rad] == pytest.approx([0.5, 0.5, math.pi / 4])
    assert [motion.twist.forward_mps, motion.twist.left_mps] == pytest.approx([math.sqrt(2), 0.0])


@pytest.mark.parametrize(
    ("points", "said"),
    [
        ([], "a trajectory of 0 waypoints"),
        ([Waypoint(0.0, 0.0, 0.0)], "a trajectory of 1 waypoints"),
        ([Waypoint(0.0, 0.0, 0.0), Waypoint(1.0, math.nan, 0.0)], "waypoint 1 of the trajectory is not finite"),
        ([Waypoint(0.0, 0.0, 0.0, math.inf), Waypoint(1.0, 0.0, 0.0)], "waypoint 0 of the trajectory is not finite"),
        (
            [Waypoint(0.0, 0.0, 0.0), Waypoint(0.0, 1.0, 0.0)],
            "waypoint 1 of the trajectory is not after the one before",
        ),
        ([Waypoint(0.0, 0.0, 0.0), Waypoint(-1.0, 1.0, 0.0)], "waypoint 1 of the trajectory is not after"),
        ([Waypoint(float(number), 0.0, 0.0) for number in range(100_001)], "a trajectory of 100001 waypoints"),
    ],
    ids=["none", "one", "no place", "no yaw", "twice the same time", "back in time", "too many"],
)
def test_what_is_no_trajectory(points: list[Waypoint], said: str) -> None:
    with pytest.raises(BodyError, match=said):
        Trajectory(points)
