"""A simulated robot that follows a plan in closed loop."""

import math
from random import Random

import numpy as np
import pytest

from sern_sim.follower import Follower, FollowerOptions, Reference
from sern_sim.robot import STEP_S, Pose2, SimulatedJackal
from sern_sim.world import World

FREE = World(np.zeros((0, 5)), np.zeros((0, 4)), 1e6)
SPEED_MPS, TURN_RADPS = 0.7, 0.3
RADIUS_M = SPEED_MPS / TURN_RADPS


def circle(time_s: float) -> Reference:
    turned = TURN_RADPS * time_s
    pose = Pose2(RADIUS_M * math.sin(turned), RADIUS_M * (1 - math.cos(turned)), math.remainder(turned, 2 * math.pi))
    return Reference(pose, SPEED_MPS, TURN_RADPS)


@pytest.mark.parametrize("seed", range(5))
def test_it_stays_on_its_plan_whatever_its_base_makes_of_a_turn(seed: int) -> None:
    """The plant turns by 0.35 to 0.55 of what it is told; its follower thinks 0.45."""
    robot, follower = SimulatedJackal(Random(seed), world=FREE), Follower(0.45)
    off_m = []
    for _ in range(round(40 / STEP_S)):
        reference = circle(robot.state.time_s)
        off_m.append(math.dist((robot.state.pose.x_m, robot.state.pose.y_m), (reference.pose.x_m, reference.pose.y_m)))
        robot.drive(*follower.command(reference, robot.state.pose, robot.state.yaw_rate_radps))
        robot.step()
    assert max(off_m[-1000:]) < 0.05


def test_one_that_is_held_does_not_wind_itself_up() -> None:
    options = FollowerOptions()
    follower = Follower(1.0, options)
    for _ in range(10_000):
        follower.command(Reference(Pose2(1.0, 5.0, 1.0), 1.0, 0.0), Pose2(), 0.0)
    at_place = follower.command(Reference(Pose2(), 1.0, 0.0), Pose2(), 0.0)
    assert abs(at_place[1]) <= options.most_turn_radps


def test_one_that_is_where_it_is_to_be_does_what_the_plan_says() -> None:
    assert Follower(0.5).command(Reference(Pose2(1.0, 2.0, 0.5), 0.8, 0.2), Pose2(1.0, 2.0, 0.5), 0.2) == (
        pytest.approx((0.8, 0.4))
    )
