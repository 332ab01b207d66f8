"""A robot that drives by a plan: how near it stays, where it goes, and what it says of itself."""

import itertools
import math
from random import Random

import pytest

from sern_sim.pilot import AHEAD_S, OFF_M, OFF_RAD_PER_M, PART_S, FigureOfEight, Pilot
from sern_sim.robot import MAX_SPEED_MPS, STEP_S, Pose2, SimulatedJackal


def off_m(a: Pose2, b: Pose2) -> float:
    return math.dist((a.x_m, a.y_m), (b.x_m, b.y_m))


def start(seed: int, at: Pose2 | None = None, noise_m: float = OFF_M) -> tuple[SimulatedJackal, FigureOfEight, Pilot]:
    robot = SimulatedJackal(Random(seed))
    way = FigureOfEight(Random(seed + 1), at or robot.state.pose, 0.0)
    return robot, way, Pilot(Random(seed + 2), robot, way.at, off_m=noise_m)


@pytest.mark.parametrize("seed", range(3))
def test_it_stays_within_centimetres_of_its_plan_whatever_its_base_makes_of_a_turn(seed: int) -> None:
    robot, way, pilot = start(seed)
    errors_m, found_m, turned_rad = [], [], []
    for _ in range(round(60 / STEP_S)):
        before = robot.state.pose
        found = pilot.step()
        errors_m.append(off_m(way.at(robot.state.time_s).pose, robot.state.pose))
        found_m.append(found.pose.x_m - before.x_m)
        turned_rad.append(math.remainder(found.pose.yaw_rad - before.yaw_rad, math.tau))
        assert math.hypot(robot.state.pose.x_m, robot.state.pose.y_m) < 4.0
        assert not robot.state.blocked
    errors_m.sort()
    assert errors_m[int(len(errors_m) * 0.95)] < 0.1
    assert robot.state.travelled_m > 30
    spread_m = math.sqrt(sum(each**2 for each in found_m) / len(found_m))
    assert 0.4 * OFF_M < spread_m < 2 * OFF_M
    spread_rad = math.sqrt(sum(each**2 for each in turned_rad) / len(turned_rad))
    assert 0.4 * OFF_M * OFF_RAD_PER_M < spread_rad < 2 * OFF_M * OFF_RAD_PER_M


def test_without_noise_it_says_where_it_is() -> None:
    robot, _way, pilot = start(5, noise_m=0.0)
    for _ in range(100):
        before = robot.state.pose
        assert off_m(pilot.step().pose, before) == 0.0


def test_the_plan_reaches_ahead_and_goes_on_where_it_was() -> None:
    robot, way, pilot = start(7)
    first = dict(way.waypoints())
    assert max(first) == pytest.approx(AHEAD_S, abs=PART_S)
    for _ in range(round(30 / STEP_S)):
        pilot.step()
    second = dict(way.waypoints())
    assert max(second) == pytest.approx(30 + AHEAD_S, abs=PART_S)
    assert min(second) >= robot.state.time_s - 1.0 - PART_S
    common = first.keys() & second.keys()
    assert len(common) > 100 and all(first[time_s] == second[time_s] for time_s in common)
    times = sorted(second)
    for earlier, later in itertools.pairwise(times):
        assert later - earlier == pytest.approx(PART_S)
        assert off_m(second[earlier], second[later]) <= MAX_SPEED_MPS * PART_S


@pytest.mark.parametrize("at", [Pose2(3.5, 0.0, 0.0), Pose2(-3.0, 2.0, 2.0), Pose2(0.0, -3.9, -1.6)])
def test_a_plan_from_anywhere_comes_back_to_the_middle_without_leaving_the_free_ground(at: Pose2) -> None:
    way = FigureOfEight(Random(1), at, 100.0)
    assert off_m(way.at(100.0).pose, at) == 0.0 and way.at(100.0).speed_mps == 0.0
    places = [pose for _time_s, pose in way.waypoints()]
    assert max(math.hypot(pose.x_m, pose.y_m) for pose in places) < 5.0
    assert max(math.hypot(pose.x_m, pose.y_m) for pose in places[40:]) < 3.6


def test_while_somebody_commands_it_the_plan_does_not() -> None:
    robot, _way, pilot = start(3)
    pilot.held = True
    robot.drive(0.0, 1.0)
    for _ in range(50):
        pilot.step()
    assert robot.state.travelled_m == 0.0 and robot.state.yaw_rate_radps > 0.2
