"""The way back to the middle: past what stands in between, and none where there is none."""

import itertools
import math
from random import Random

import numpy as np
import pytest

from sern_sim.pilot import FigureOfEight, Pilot
from sern_sim.robot import BODY_RADIUS_M, STEP_S, Pose2, RobotState, SimulatedJackal
from sern_sim.terrain import DITCH_X_M, Label, Terrain
from sern_sim.way_back import HOME_M, way_back
from sern_sim.world import World
from tests.exploring import seeds


def wall(*segments: tuple[float, float, float, float]) -> World:
    return World(np.array([(*segment, 1.0) for segment in segments]), np.zeros((0, 4)), 10.0)


def clear_m(world: World, places: list[tuple[float, float]]) -> float:
    return min(world.clearance_m(x_m, y_m) for x_m, y_m in places)


def test_in_the_middle_it_needs_none() -> None:
    assert way_back(World.yard(Random(1)), Pose2(3.9, 0.0, 0.0)) == []


def test_it_goes_round_a_wall_with_room_for_the_body() -> None:
    world = wall((6.0, -5.0, 6.0, 7.0))
    places = way_back(world, Pose2(8.0, 0.0, 0.0))
    assert math.dist(places[0], (8.0, 0.0)) < 0.3 and math.hypot(*places[-1]) <= HOME_M
    assert min(y_m for _x_m, y_m in places) < -5.0 and clear_m(world, places) > BODY_RADIUS_M
    assert all(math.dist(a, b) < 0.36 for a, b in itertools.pairwise(places))


def test_where_it_is_shut_in_there_is_none() -> None:
    assert way_back(wall((6, -2, 6, 2), (6, 2, 9, 2), (9, 2, 9, -2), (9, -2, 6, -2)), Pose2(7.5, 0.0, 0.0)) == []


@pytest.mark.parametrize("at", [Pose2(1e9, -1e9, 0.0), Pose2(10.0, 10.0, 0.0), Pose2(6.0, 0.0, 0.0)])
def test_from_outside_and_from_within_an_obstacle_it_leads_to_the_middle(at: Pose2) -> None:
    places = way_back(wall((6.0, -5.0, 6.0, 5.0)), at)
    assert math.hypot(*places[-1]) <= HOME_M


@pytest.mark.parametrize("start_y_m", [-1.0, 1.0])
def test_over_the_ditch_it_takes_the_bridge(start_y_m: float) -> None:
    ground = Terrain.hills(Random(2))
    bridge = next(block for block in ground.blocks if block.label is Label.BRIDGE)
    places = way_back(ground, Pose2(DITCH_X_M - 3.0, start_y_m, 0.0))
    over = [y_m for x_m, y_m in places if abs(x_m - DITCH_X_M) < 0.8]
    assert len(over) > 4 and max(abs(y_m) for y_m in over) < bridge.half_m[1]


@pytest.mark.parametrize("seed", seeds(6))
def test_a_robot_that_was_left_anywhere_in_the_yard_comes_back(seed: int) -> None:
    """Whatever way it looks: it turns to its way on the spot, and nothing holds it."""
    random, world = Random(seed), World.yard(Random(seed))
    robot = SimulatedJackal(Random(seed), world=world)
    at = Pose2()
    while math.hypot(at.x_m, at.y_m) < 5.0 or world.clearance_m(at.x_m, at.y_m) < 0.6 or not way_back(world, at):
        at = Pose2(random.uniform(-9, 9), random.uniform(-9, 9), random.uniform(-3, 3))
    robot.state = RobotState(pose=at, odometry=at)
    way = FigureOfEight(Random(seed + 1), at, 0.0, way_back(world, at))
    pilot = Pilot(Random(seed + 2), robot, way.at)
    assert way.at(0.0).pose == at and way.at(0.0).speed_mps == 0.0
    for _ in range(round(60 / STEP_S)):
        pilot.step()
        assert not robot.state.blocked
    planned = way.at(robot.state.time_s).pose
    assert math.dist((planned.x_m, planned.y_m), (robot.state.pose.x_m, robot.state.pose.y_m)) < 0.1
    assert math.hypot(planned.x_m, planned.y_m) < 4.0
