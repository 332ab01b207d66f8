"""The robot of the synchroniser's benchmark: the skid-steered plant with slip, which follows a plan in closed loop with
a localisation that is off, and says where it thinks it is."""

import math
from random import Random
from typing import Final, NamedTuple

import numpy as np

from sern_sim.follower import Reference
from sern_sim.pilot import Pilot
from sern_sim.robot import Pose2, SimulatedJackal
from sern_sim.world import World
from sern_twin.motion import TAU, Motion, Twist
from sern_twin.trajectory import Trajectory, Waypoint

EMPTY: Final = World(np.zeros((0, 5)), np.zeros((0, 4)), 1e6)
NOISE_MPS2: Final = 0.05
"""What the robot's measure of its acceleration is off; one sigma."""
WAYPOINT_S: Final = 0.5
RAMP_S: Final = 1.0
FINE_S: Final = 0.01


def plan(random: Random, length_s: float) -> Trajectory:
    """A smooth way at 0.45 to 0.95 m/s that turns left and right by up to 0.45 rad/s."""
    waves = [(random.uniform(0.03, 0.15), random.uniform(0, TAU)) for _ in range(4)]

    def wave(number: int, time_s: float) -> float:
        rate_hz, phase_rad = waves[number]
        return math.sin(TAU * rate_hz * time_s + phase_rad)

    x_m = y_m = yaw_rad = 0.0
    points = []
    per_point = round(WAYPOINT_S / FINE_S)
    for step in range(round(length_s / FINE_S) + 1):
        time_s = step * FINE_S
        if step % per_point == 0:
            points.append(Waypoint(time_s, x_m, y_m, yaw_rad))
        speed_mps = (0.7 + 0.15 * wave(0, time_s) + 0.1 * wave(1, time_s)) * min(1.0, time_s / RAMP_S)
        x_m += speed_mps * math.cos(yaw_rad) * FINE_S
        y_m += speed_mps * math.sin(yaw_rad) * FINE_S
        yaw_rad += (0.25 * wave(2, time_s) + 0.2 * wave(3, time_s)) * FINE_S
    return Trajectory(points)


class Said(NamedTuple):
    """`truth`: where it is. `found`: where it thinks it is. `told`: what its base was told, as it does it."""

    time_s: float
    truth: Motion
    found: Motion
    told: Twist


class Robot:
    """Stepped by `STEP_S`. It stands from `stops_s` on, whatever its plan says."""

    def __init__(self, random: Random, way: Trajectory, *, stops_s: float = math.inf) -> None:
        self._random = random
        self._way = way
        self._stops_s = stops_s
        self._plant = SimulatedJackal(random, world=EMPTY)
        self._pilot = Pilot(random, self._plant, self._planned)

    def _planned(self, time_s: float) -> Reference:
        planned = self._way.at(time_s)
        pose = Pose2(planned.x_m, planned.y_m, planned.yaw_rad)
        return Reference(pose, planned.twist.forward_mps, planned.twist.yaw_radps)

    def step(self) -> Said:
        before = self._plant.state
        found = self._pilot.step(stands=before.time_s >= self._stops_s)
        pose, command = before.pose, self._pilot.told
        twist = Twist(before.speed_mps, 0.0, before.yaw_rate_radps)
        measured = Twist(found.speed_mps, 0.0, found.yaw_rate_radps)
        accel_mps2 = before.accel_mps2 + self._random.gauss(0.0, NOISE_MPS2)
        return Said(
            before.time_s,
            Motion(pose.x_m, pose.y_m, pose.yaw_rad, twist),
            Motion(found.pose.x_m, found.pose.y_m, found.pose.yaw_rad, measured, accel_mps2),
            Twist(command[0], 0.0, command[1] * self._plant.yaw_scale_known),
        )
