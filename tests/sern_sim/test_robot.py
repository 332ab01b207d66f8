"""The simulated robot: motion, limits, slip, sensors, and that a seed decides everything."""

import math
from random import Random

import numpy as np
import pytest

from sern_sim.robot import (
    BODY_RADIUS_M,
    LIDAR_HEIGHT_M,
    MAX_ACCEL_MPS2,
    MAX_SPEED_MPS,
    STEP_S,
    RobotState,
    SimulatedJackal,
)
from sern_sim.world import World
from tests.exploring import seeds


def run(robot: SimulatedJackal, seconds: float) -> RobotState:
    for _ in range(round(seconds / STEP_S)):
        robot.step()
    return robot.state


def empty() -> World:
    return World(np.empty((0, 5)), np.empty((0, 4)), 10.0)


def test_stands_still_without_a_command() -> None:
    state = run(SimulatedJackal(Random(1)), 5.0)
    assert state.pose == RobotState().pose and state.travelled_m == 0.0
    assert state.time_s == pytest.approx(5.0)


def test_a_command_moves_it_within_its_limits() -> None:
    robot = SimulatedJackal(Random(1), world=empty())
    robot.drive(50.0, 0.0)
    first = robot.step()
    assert first.speed_mps == pytest.approx(MAX_ACCEL_MPS2 * STEP_S)
    state = run(robot, 5.0)
    assert state.speed_mps == pytest.approx(MAX_SPEED_MPS * robot.speed_scale)
    assert state.pose.x_m > 7.0 and abs(state.pose.y_m) < 1e-9
    robot.drive(0.0, 0.0)
    assert run(robot, 2.0).speed_mps == 0.0


def test_skid_steering_turns_less_than_its_wheels_say() -> None:
    robot = SimulatedJackal(Random(2), world=empty())
    robot.drive(0.0, 1.0)
    state = run(robot, 3.0)
    assert state.yaw_rate_radps == pytest.approx(robot.yaw_scale) and robot.yaw_scale < 0.6
    wheels = (state.wheel_right_rad - state.wheel_left_rad) * 0.098 / 0.3765
    assert wheels > 1.5 * state.pose.yaw_rad


def test_odometry_drifts_but_not_far() -> None:
    robot = SimulatedJackal(Random(3), patrol=True)
    state = run(robot, 60.0)
    error = math.hypot(state.odometry.x_m - state.pose.x_m, state.odometry.y_m - state.pose.y_m)
    assert state.travelled_m > 25.0
    assert 0.001 < error < 0.25 * state.travelled_m


@pytest.mark.parametrize("seed", seeds(8))
def test_patrol_stays_clear_of_obstacles(seed: int) -> None:
    robot = SimulatedJackal(Random(seed), patrol=True)
    for _ in range(3000):
        state = robot.step()
        assert not state.blocked
    assert state.travelled_m > 25.0


def test_a_wall_holds_it() -> None:
    robot = SimulatedJackal(Random(4), world=World(np.array([[2.0, -5.0, 2.0, 5.0, 1.0]]), np.empty((0, 4)), 10.0))
    robot.drive(1.0, 0.0)
    state = run(robot, 10.0)
    assert state.blocked and 2.0 - BODY_RADIUS_M - 0.05 < state.pose.x_m <= 2.0 - BODY_RADIUS_M + 0.001
    assert state.odometry.x_m > 5.0  # the wheels went on
    robot.drive(-1.0, 0.0)
    assert run(robot, 3.0).pose.x_m < 0.5


def test_a_seed_decides_everything() -> None:
    def story(seed: int) -> list[bytes | RobotState | tuple[float, ...]]:
        robot = SimulatedJackal(Random(seed), patrol=True)
        out: list[bytes | RobotState | tuple[float, ...]] = []
        for i in range(300):
            out.append(robot.step())
            if i % 100 == 50:
                robot.drive(0.5, 0.3)
            if i % 50 == 0:
                out += [robot.imu(), robot.scan().tobytes(), robot.cloud(1600).tobytes(), robot.image(16, 8).tobytes()]
        return out

    assert story(7) == story(7)
    assert story(7) != story(8)


def test_rays_meet_walls_and_pillars_where_they_are() -> None:
    world = World(np.array([[5.0, -5.0, 5.0, 5.0, 1.0]]), np.array([[-3.0, 0.0, 0.5, 2.0]]), 10.0)
    hit = world.cast(0.0, 0.0, np.array([0.0, math.pi / 4, math.pi, math.pi / 2]))
    assert hit.range_m == pytest.approx([5.0, 5.0 * math.sqrt(2), 2.5, math.inf])
    assert hit.height_m == pytest.approx([1.0, 1.0, 2.0, 0.0])
    assert world.clearance_m(0.0, 0.0) == pytest.approx(2.5)
    assert world.occupancy(40)[20, 30] == 100 and world.occupancy(40)[20, 20] == 0


def test_a_cloud_lies_on_walls_and_ground() -> None:
    robot = SimulatedJackal(Random(5))
    cloud = robot.cloud(6250)
    assert cloud.shape == (6250, 4)
    seen = cloud[~np.isnan(cloud[:, 0])]
    assert len(seen) > 2000
    assert float(seen[:, 2].min()) > -LIDAR_HEIGHT_M - 0.05 and float(seen[:, 2].max()) < 3.0
    ground = np.abs(seen[:, 2] + LIDAR_HEIGHT_M) < 0.02
    assert 0.05 < float(ground.mean()) < 0.95


def test_a_scan_sees_the_yard() -> None:
    scan = SimulatedJackal(Random(6)).scan()
    assert scan.shape == (720,) and scan.dtype == np.float32
    assert np.all(np.isfinite(scan)) and float(scan.min()) > 4.0 and float(scan.max()) < 15.0


def test_a_command_must_be_finite() -> None:
    with pytest.raises(ValueError, match="finite"):
        SimulatedJackal(Random(0)).drive(math.nan, 0.0)


def test_the_battery_drains() -> None:
    state = run(SimulatedJackal(Random(9), patrol=True), 60.0)
    assert 0.99 < state.charge < 1.0
