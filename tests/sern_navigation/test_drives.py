"""The whole loop with the simulated robot, its slip and its scanner: around a car, through a gap, to the goal."""

import math
from random import Random

import numpy as np
import pytest

from sern_navigation.collision_monitor import Action
from sern_navigation.costmap.twin import TwinView
from sern_navigation.navigator import Code, Goal, Navigator, State
from sern_navigation.scan import Cloud
from sern_sim.mujoco_jackal import MujocoJackal
from sern_sim.robot import LIDAR_HEIGHT_M
from sern_sim.terrain import Label
from sern_twin.world.grid import Grid
from tests.exploring import seeds
from tests.sern_navigation.worlds import box, drive, filled, jackal, world_of

GRID = Grid(-12.8, -12.8, 0.1, 256, 256)
CAR = box(1.5, -0.9, 5.5, 0.9, 1.4)
GAP_M = 1.2
WALL = [(8.0, -12.0, 8.0, -GAP_M / 2, 2.0), (8.0, GAP_M / 2, 8.0, 12.0, 2.0)]
GOAL = Goal(10.5, 0.0, 0.0)


@pytest.mark.parametrize("seed", seeds(3))
def test_it_drives_around_a_parked_car_and_through_a_gap(seed: int) -> None:
    """Nothing is known beforehand; each seed is a robot that slips otherwise."""
    robot = jackal(world_of([*CAR, *WALL]), seed)
    navigator = Navigator(GRID, np.random.default_rng(seed))
    navigator.go(GOAL)
    commands = drive(navigator, robot)
    assert commands[-1].status.state is State.SUCCEEDED, commands[-1].status
    pose = robot.state.pose
    assert math.dist((pose.x_m, pose.y_m), (10.5, 0.0)) < 0.3 and abs(pose.yaw_rad) < 0.3
    assert robot.state.time_s < 45 and commands[-1].speed == (0.0, 0.0)


def test_on_hills_it_drives_around_a_parked_car_too() -> None:
    """In MuJoCo: slopes that are no obstacles, a body that tilts, wheels that skid."""
    pytest.importorskip("mujoco", reason="the extra sim is not installed")
    robot = MujocoJackal(Random(3))
    navigator = Navigator(Grid(-20.0, -20.0, 0.1, 400, 400), np.random.default_rng(0))
    navigator.go(Goal(12.0, 0.0))
    car = [block for block in robot.world.blocks if block.label is Label.CAR]
    for _ in range(450):
        state = robot.state
        points = robot.cloud(5_760)[:, :3].astype(np.float64) + np.array([0.0, 0.0, LIDAR_HEIGHT_M])
        cloud = Cloud(points, state.time_s, roll_rad=state.roll_rad, pitch_rad=state.pitch_rad)
        command = navigator.step(state.time_s, (state.pose.x_m, state.pose.y_m, state.pose.yaw_rad), cloud)
        if command.status.state is not State.FOLLOWING:
            break
        robot.drive(command.speed[0], command.speed[1] / robot.yaw_scale_known)
        for _ in range(5):
            pose = robot.step().pose
            for block in car:
                cos, sin = math.cos(block.yaw_rad), math.sin(block.yaw_rad)
                east_m, north_m = pose.x_m - block.x_m, pose.y_m - block.y_m
                along_m = max(abs(cos * east_m + sin * north_m) - block.half_m[0], 0.0)
                beside_m = max(abs(cos * north_m - sin * east_m) - block.half_m[1], 0.0)
                assert math.hypot(along_m, beside_m) > 0.25
    assert command.status.state is State.SUCCEEDED and command.status.recoveries == 0, command.status


def test_a_twin_that_knows_of_the_car_shows_the_way_around_it() -> None:
    """The robot itself marks with Nav2's 2.5 m, and is told of a car that is 5 m ahead."""
    twin = TwinView(GRID, filled(GRID, (4.5, -1.5, 7.5, 0.8)), 0.0)
    furthest_m, travelled_m = [], []
    for view in (None, twin):
        robot = jackal(world_of(box(4.5, -1.5, 7.5, 0.8, 1.4)), 2)
        navigator = Navigator(GRID, np.random.default_rng(0))
        navigator.go(Goal(10.0, 0.0))
        drive(navigator, robot, view, seconds=0.5)
        furthest_m.append(float(np.abs(navigator.path_m[:, 1]).max()))
        commands = drive(navigator, robot, view)
        assert commands[-1].status.state is State.SUCCEEDED
        travelled_m.append(robot.state.travelled_m)
    assert furthest_m[0] < 0.3 and furthest_m[1] > 1.1, "the first plan leads around it"
    assert travelled_m[1] < travelled_m[0] + 0.1


def test_a_phantom_of_the_twin_does_not_stop_it() -> None:
    """The twin has a wall across the whole yard; there is none."""
    robot = jackal(world_of([]), 1)
    navigator = Navigator(GRID, np.random.default_rng(0))
    navigator.go(Goal(6.0, 0.0))
    commands = drive(navigator, robot, TwinView(GRID, filled(GRID, (2.9, -12.8, 3.1, 12.8)), 0.0))
    assert commands[-1].status.state is State.SUCCEEDED and commands[-1].status.recoveries == 0
    assert robot.state.time_s < 25


def test_a_room_without_a_way_out_is_said_to_be_one() -> None:
    """It learns so by driving around in it; it tries what there is to try, and gives up."""
    robot = jackal(world_of(box(-2.0, -2.0, 2.0, 2.0)), 1)
    navigator = Navigator(GRID, np.random.default_rng(0))
    navigator.go(Goal(6.0, 0.0))
    commands = drive(navigator, robot, seconds=90.0)
    last = commands[-1]
    assert last.status.state is State.ABORTED and last.status.code is Code.NO_VALID_PATH
    assert last.status.recoveries == 6 and "no way leads" in last.status.message
    assert last.speed == (0.0, 0.0)


def test_something_that_jumps_before_it_is_not_hit() -> None:
    """A wall appears 0.9 m ahead while it drives at full speed, behind the plan's back."""
    robot = jackal(world_of([]), 1)
    navigator = Navigator(GRID, np.random.default_rng(0))
    navigator.go(Goal(6.0, 0.0))
    assert drive(navigator, robot, seconds=4.0)[-1].status.state is State.FOLLOWING
    x_m = robot.state.pose.x_m + 0.9
    robot.world = world_of([(x_m, -1.5, x_m, 1.5, 1.5)])
    commands = drive(navigator, robot)
    assert commands[-1].status.state is State.SUCCEEDED
    assert {command.verdict.action for command in commands[:10]} - {Action.DO_NOT_PROCESS}, "it was slowed down"
