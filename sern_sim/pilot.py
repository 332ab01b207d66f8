"""A robot that drives by a plan, and knows where it is only by its localisation: a closed loop.

What the localisation is off stays about the same for a while (a Gauss-Markov process of first order) and trembles
beside that, as that of a filter does which corrects wheels by a scanner.
"""

import math
from collections import deque
from collections.abc import Callable, Sequence
from random import Random
from typing import Final, NamedTuple

from sern_sim.follower import Follower, FollowerOptions, Reference
from sern_sim.plant import Plant
from sern_sim.robot import STEP_S, Pose2

TAU: Final = 2 * math.pi
OFF_M: Final = 0.01
OFF_S: Final = 2.0
"""What the localisation is off in each axis (one sigma), and how long it stays so (time constant)."""
OFF_RAD_PER_M: Final = math.radians(0.3) / OFF_M
"""What it is off in yaw, for what it is off in each axis."""
NOISE_SHARE: Final = 0.3
"""What a pose trembles, as a share of that."""
NOISE_MPS: Final = 0.01
NOISE_RADPS: Final = 0.01


class Found(NamedTuple):
    """Where a robot thinks it is, and how fast it measures itself to be."""

    time_s: float
    pose: Pose2
    speed_mps: float
    yaw_rate_radps: float


class Pilot:
    """`reference(time_s)` says where the plan has the robot. Call `step` in place of the robot's."""

    def __init__(
        self,
        random: Random,
        robot: Plant,
        reference: Callable[[float], Reference],
        *,
        off_m: float = OFF_M,
        follower: FollowerOptions | None = None,
    ) -> None:
        self._random = random
        self._robot = robot
        self._reference = reference
        self._off_m = off_m
        self._follower = Follower(robot.yaw_scale_known, follower)
        self._off = [random.gauss(0.0, sigma) for sigma in self._sigmas()]
        self.held = False
        """Somebody else commands the robot."""
        self.told = (0.0, 0.0)
        """The last command of the plan: speed and yaw rate of the wheels."""
        self.found = Found(0.0, robot.state.pose, 0.0, 0.0)

    def _sigmas(self) -> tuple[float, float, float]:
        return self._off_m, self._off_m, self._off_m * OFF_RAD_PER_M

    def step(self, *, stands: bool = False) -> Found:
        """Look where the robot is, tell it where to go, and have it go for `STEP_S`. `stands`: it is told to stand."""
        random, before = self._random, self._robot.state
        kept = math.exp(-STEP_S / OFF_S)
        new = math.sqrt(1 - kept**2)
        for axis, sigma in enumerate(self._sigmas()):
            self._off[axis] = kept * self._off[axis] + new * random.gauss(0.0, sigma)
        off_x_m, off_y_m, off_rad = self._off
        pose, noise_m = before.pose, NOISE_SHARE * self._off_m
        found = Pose2(
            pose.x_m + off_x_m + random.gauss(0.0, noise_m),
            pose.y_m + off_y_m + random.gauss(0.0, noise_m),
            math.remainder(pose.yaw_rad + off_rad, TAU),
        )
        turning_radps = before.yaw_rate_radps + random.gauss(0.0, NOISE_RADPS)
        if not self.held:
            command = self._follower.command(self._reference(before.time_s), found, turning_radps)
            self.told = (0.0, 0.0) if stands else command
            self._robot.drive(*self.told)
        self._robot.step()
        self.found = Found(
            before.time_s,
            found,
            before.speed_mps + random.gauss(0.0, NOISE_MPS),
            before.yaw_rate_radps + random.gauss(0.0, NOISE_RADPS),
        )
        return self.found


LOOK_AHEAD_M: Final = 0.8
SIZE_M: Final = 3.0
"""Half the width of the figure of eight. The yard is free to 4.5 m around its middle, and the body takes 0.33 m."""
SPEED_MPS: Final = 0.7
ACCEL_MPS2: Final = 0.5
MOST_TURN_RADPS: Final = 0.8
TURN_ACCEL_RADPS2: Final = 1.5
BACK_AHEAD_M: Final = 0.5
BACK_MPS: Final = 0.45
"""On the way back to the middle, which may be narrow."""
TURNED_RAD: Final = 0.3
AHEAD_S: Final = 90.0
"""How far the plan reaches."""
PART_S: Final = 0.5
"""Between the waypoints of the plan that others are told."""


class FigureOfEight:
    """A plan without an end around the middle of the yard: an ideal robot drives it `AHEAD_S` ahead of the real one, by
    pure pursuit (Coulter 1992), with speeds and turns that a Jackal can follow."""

    def __init__(self, random: Random, start: Pose2, start_s: float, back: Sequence[tuple[float, float]] = ()) -> None:
        """`back`: places that it goes by first, in metres (`way_back`); it turns to the first of them on the spot."""
        self._back = deque(back)
        self._turns = bool(back)
        self._waves = [(random.uniform(0.03, 0.1), random.uniform(0.0, TAU)) for _ in range(2)]
        self._begin_s = start_s
        self._first = 0  # step of the oldest reference that is kept
        self._steps: deque[Reference] = deque()
        self._pose, self._speed_mps, self._turn_radps = start, 0.0, 0.0
        self._angle_rad = self._nearest(start)
        self.at(start_s)

    def at(self, time_s: float) -> Reference:
        """Where the robot is to be. Times go on; what lies more than a second back is forgotten."""
        wanted = round((time_s - self._begin_s) / STEP_S)
        while self._first + len(self._steps) <= wanted + round(AHEAD_S / STEP_S):
            self._drive()
        while self._first < wanted - round(1.0 / STEP_S):
            self._steps.popleft()
            self._first += 1
        return self._steps[max(wanted - self._first, 0)]

    def waypoints(self) -> list[tuple[float, Pose2]]:
        """Time and place, from now to the end of what is planned."""
        every = round(PART_S / STEP_S)
        return [
            (self._begin_s + (self._first + number) * STEP_S, reference.pose)
            for number, reference in enumerate(self._steps)
            if (self._first + number) % every == 0
        ]

    def _place(self, angle_rad: float) -> tuple[float, float]:
        """The lemniscate of Gerono."""
        return SIZE_M * math.sin(angle_rad), SIZE_M * math.sin(angle_rad) * math.cos(angle_rad)

    def _nearest(self, pose: Pose2) -> float:
        angles = (TAU * number / 200 for number in range(200))
        return min(angles, key=lambda angle: math.dist(self._place(angle), (pose.x_m, pose.y_m)))

    def _drive(self) -> None:
        pose = self._pose
        self._steps.append(Reference(pose, self._speed_mps, self._turn_radps))
        x_m, y_m = self._goal(pose)
        ahead_x_m, ahead_y_m = x_m - pose.x_m, y_m - pose.y_m
        left_m = math.cos(pose.yaw_rad) * ahead_y_m - math.sin(pose.yaw_rad) * ahead_x_m
        front_m = math.cos(pose.yaw_rad) * ahead_x_m + math.sin(pose.yaw_rad) * ahead_y_m
        time_s = (self._first + len(self._steps)) * STEP_S
        wave = sum(math.sin(TAU * rate_hz * time_s + phase_rad) for rate_hz, phase_rad in self._waves)
        speed_mps, curvature_per_m = SPEED_MPS + 0.1 * wave, 2 * left_m / max(left_m**2 + front_m**2, 1e-6)
        turn_radps = curvature_per_m * self._speed_mps
        if front_m < 0:
            turn_radps = math.copysign(MOST_TURN_RADPS, left_m)
        self._turns = self._turns and abs(math.atan2(left_m, front_m)) > TURNED_RAD
        if self._turns:
            speed_mps, turn_radps = 0.0, math.copysign(MOST_TURN_RADPS, left_m)
        elif self._back:
            speed_mps = min(BACK_MPS, 0.8 * MOST_TURN_RADPS / max(abs(curvature_per_m), 1e-6))
        limit = TURN_ACCEL_RADPS2 * STEP_S
        turn_radps = min(max(turn_radps, -MOST_TURN_RADPS), MOST_TURN_RADPS)
        self._turn_radps += min(max(turn_radps - self._turn_radps, -limit), limit)
        faster = ACCEL_MPS2 * STEP_S
        self._speed_mps += min(max(speed_mps - self._speed_mps, -faster), faster)
        self._pose = pose.moved(self._speed_mps * STEP_S, self._turn_radps * STEP_S)

    def _goal(self, pose: Pose2) -> tuple[float, float]:
        """The place that it makes for: a little ahead on the way back, and then on the figure."""
        while self._back:
            if math.dist(self._back[0], (pose.x_m, pose.y_m)) >= BACK_AHEAD_M:
                return self._back[0]
            self._back.popleft()
            if not self._back:
                self._angle_rad = self._nearest(pose)
        for _ in range(400):
            x_m, y_m = self._place(self._angle_rad)
            if math.dist((x_m, y_m), (pose.x_m, pose.y_m)) >= LOOK_AHEAD_M:
                break
            self._angle_rad += 0.01
        return x_m, y_m
