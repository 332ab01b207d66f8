"""The robot of the synchroniser's benchmark: the skid-steered plant with slip, which follows a plan in closed loop with
a localisation that is off, and says where it thinks it is."""

import math
from random import Random
from typing import Final, NamedTuple

import numpy as np

from sern_sim.follower import Follower, Reference
from sern_sim.robot import STEP_S, Pose2, SimulatedJackal
from sern_sim.world import World
from sern_twin.motion import TAU, Motion, Twist
from sern_twin.trajectory import Trajectory, Waypoint

EMPTY: Final = World(np.zeros((0, 5)), np.zeros((0, 4)), 1e6)
OFF_M: Final = 0.01
OFF_RAD: Final = math.radians(0.3)
OFF_S: Final = 2.0
"""What the localisation is off in each axis, and how long it stays so: one sigma, and the time constant."""
NOISE_M: Final = 0.003
NOISE_MPS: Final = 0.01
NOISE_RADPS: Final = 0.01
NOISE_MPS2: Final = 0.05
"""What each pose is off beside that."""
YAW_SCALE: Final = 0.45
"""What the robot's maker thinks that its base makes of a turn. The plant's is between 0.35 and 0.55."""
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
        self._follower = Follower(YAW_SCALE)
        self._off = [random.gauss(0.0, OFF_M), random.gauss(0.0, OFF_M), random.gauss(0.0, OFF_RAD)]

    def step(self) -> Said:
        random, before = self._random, self._plant.state
        kept = math.exp(-STEP_S / OFF_S)
        new = math.sqrt(1 - kept**2)
        for axis, sigma in enumerate((OFF_M, OFF_M, OFF_RAD)):
            self._off[axis] = kept * self._off[axis] + new * random.gauss(0.0, sigma)
        off_x_m, off_y_m, off_rad = self._off
        pose = before.pose
        found = Pose2(
            pose.x_m + off_x_m + random.gauss(0.0, NOISE_M),
            pose.y_m + off_y_m + random.gauss(0.0, NOISE_M),
            math.remainder(pose.yaw_rad + off_rad, TAU),
        )
        planned = self._way.at(before.time_s)
        command = self._follower.command(
            Reference(
                Pose2(planned.x_m, planned.y_m, planned.yaw_rad), planned.twist.forward_mps, planned.twist.yaw_radps
            ),
            found,
            before.yaw_rate_radps + random.gauss(0.0, NOISE_RADPS),
        )
        if before.time_s >= self._stops_s:
            command = 0.0, 0.0
        self._plant.drive(*command)
        self._plant.step()
        twist = Twist(before.speed_mps, 0.0, before.yaw_rate_radps)
        measured = Twist(
            before.speed_mps + random.gauss(0.0, NOISE_MPS), 0.0, before.yaw_rate_radps + random.gauss(0.0, NOISE_RADPS)
        )
        return Said(
            before.time_s,
            Motion(pose.x_m, pose.y_m, pose.yaw_rad, twist),
            Motion(found.x_m, found.y_m, found.yaw_rad, measured, before.accel_mps2 + random.gauss(0.0, NOISE_MPS2)),
            Twist(command[0], 0.0, command[1] * YAW_SCALE),
        )
