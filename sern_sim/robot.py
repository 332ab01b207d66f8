"""A simulated Clearpath Jackal: skid-steer with slip, in a `World`, with the sensors that a real one carries.

Pure and stepped: `step()` advances exactly `STEP_S`; the same seed and the same commands give the same numbers.
Body frame: x forward, y left, z up; angles in radians, counter-clockwise positive.

A skid-steered base turns less than its wheels say: the true yaw rate is `yaw_scale` times the commanded one, and the
true speed `speed_scale` times; wheel odometry is calibrated for the mean slip and drifts by what is left.
"""

import math
from dataclasses import dataclass
from random import Random
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sern_sim.world import Floats, World

STEP_S: Final = 0.02
MAX_SPEED_MPS: Final = 2.0
MAX_YAW_RATE_RADPS: Final = 4.0
MAX_ACCEL_MPS2: Final = 3.0
MAX_YAW_ACCEL_RADPS2: Final = 12.0
WHEEL_RADIUS_M: Final = 0.098
TRACK_M: Final = 0.3765
BODY_RADIUS_M: Final = 0.33
LIDAR_HEIGHT_M: Final = 0.4
LIDAR_RANGE_M: Final = 30.0
RINGS_RAD: Final = np.deg2rad(np.linspace(-15.0, 15.0, 16))
"""Elevations of a 16-ring scanner."""
_RING_SLOPES: Final = np.tan(RINGS_RAD)
BATTERY_WH: Final = 270.0
GRAVITY_MPS2: Final = 9.80665
GYRO_NOISE_RADPS: Final = 0.003
ACCEL_NOISE_MPS2: Final = 0.05
WHEEL_NOISE: Final = 0.01  # of the speed, one sigma per step
MAX_CAST_RAYS: Final = 1024
"""Above this many azimuths a cloud repeats neighbouring casts with fresh noise."""


@dataclass(frozen=True, slots=True)
class Pose2:
    x_m: float = 0.0
    y_m: float = 0.0
    yaw_rad: float = 0.0

    def moved(self, distance_m: float, turn_rad: float) -> "Pose2":
        """Along the chord of an arc, turned by `turn_rad` in all."""
        heading = self.yaw_rad + turn_rad / 2
        return Pose2(
            self.x_m + distance_m * math.cos(heading),
            self.y_m + distance_m * math.sin(heading),
            math.remainder(self.yaw_rad + turn_rad, 2 * math.pi),
        )


@dataclass(frozen=True, slots=True)
class RobotState:
    """The truth at `time_s` since the start; velocities in the body frame."""

    time_s: float = 0.0
    pose: Pose2 = Pose2()
    speed_mps: float = 0.0
    yaw_rate_radps: float = 0.0
    accel_mps2: float = 0.0
    odometry: Pose2 = Pose2()  # where the wheels say it is
    wheel_left_rad: float = 0.0
    wheel_right_rad: float = 0.0
    charge: float = 1.0  # of the battery, 0 to 1
    travelled_m: float = 0.0
    blocked: bool = False  # held by an obstacle in this step
    z_m: float = 0.0
    roll_rad: float = 0.0
    pitch_rad: float = 0.0  # nose down positive, as in REP 103


class Inertial(NamedTuple):
    """What an inertial unit measures, in the body's axes: rates in rad/s, specific force in m/s²."""

    yaw_radps: float
    forward_mps2: float
    left_mps2: float
    up_mps2: float = GRAVITY_MPS2
    roll_radps: float = 0.0
    pitch_radps: float = 0.0


class SimulatedJackal:
    """The robot in its world. `patrol` drives a seeded figure of eight while no command is in force."""

    yaw_scale_known = 0.45
    """What its maker thinks that its base makes of a turn. What it does make is between 0.35 and 0.55."""

    def __init__(self, random: Random, *, world: World | None = None, patrol: bool = False) -> None:
        self.world = world or World.yard(random)
        self.state = RobotState()
        self.command = (0.0, 0.0)  # speed m/s, yaw rate rad/s: as asked, unlimited
        self.commanded = False
        self.speed_scale = random.uniform(0.94, 0.99)
        self.yaw_scale = random.uniform(0.35, 0.55)
        self._odometry_yaw_scale = self.yaw_scale * random.uniform(0.97, 1.03)
        self._odometry_speed_scale = self.speed_scale * random.uniform(0.99, 1.01)
        self._gyro_bias_radps = random.gauss(0.0, 0.002)
        self._patrol = patrol
        self._patrol_speed_mps = random.uniform(0.5, 0.8)
        self._patrol_period_s = random.uniform(22.0, 28.0)
        self._steps = 0
        self._driven_mps = 0.0  # what the wheels would give on free ground
        # Motion and sensors draw apart, so that what is looked at does not change where the robot goes.
        self._random = random
        self._sensor_random = Random(random.getrandbits(64))
        # numpy's generator, seeded from the one handed in: thousands of points need their noise at once.
        self._noise = np.random.default_rng(random.getrandbits(64))

    def drive(self, speed_mps: float, yaw_rate_radps: float) -> None:
        """A velocity command, in force until the next. Not a finite number: ValueError."""
        if not (math.isfinite(speed_mps) and math.isfinite(yaw_rate_radps)):
            raise ValueError("a velocity command must be finite")
        self.command = (speed_mps, yaw_rate_radps)
        self.commanded = True

    def step(self) -> RobotState:
        """One step of `STEP_S`."""
        before = self.state
        self._steps += 1
        speed_goal, turn_goal = self.command if self.commanded else self._wander(before.time_s)
        speed = approach(self._driven_mps, clamp(speed_goal, MAX_SPEED_MPS) * self.speed_scale, MAX_ACCEL_MPS2)
        self._driven_mps = speed
        turn_goal = clamp(turn_goal, MAX_YAW_RATE_RADPS) * (self.yaw_scale if self.commanded else 1.0)
        turn = approach(before.yaw_rate_radps, turn_goal, MAX_YAW_ACCEL_RADPS2)
        pose = before.pose.moved(speed * STEP_S, turn * STEP_S)
        blocked = self.world.touches(pose.x_m, pose.y_m, BODY_RADIUS_M) and (
            self.world.clearance_m(pose.x_m, pose.y_m) < self.world.clearance_m(before.pose.x_m, before.pose.y_m)
        )
        # Against an obstacle the body stands, but the wheels go on turning: the odometry is then wrong.
        moved = Pose2(before.pose.x_m, before.pose.y_m, pose.yaw_rad) if blocked else pose
        wheel_speed, wheel_turn = speed / self.speed_scale, turn / self.yaw_scale
        wheel_speed *= 1 + self._random.gauss(0.0, WHEEL_NOISE)
        wheel_turn *= 1 + self._random.gauss(0.0, WHEEL_NOISE)
        power_w = 25.0 + 80.0 * abs(wheel_speed) + 20.0 * abs(wheel_turn)
        self.state = RobotState(
            time_s=self._steps * STEP_S,
            pose=moved,
            speed_mps=0.0 if blocked else speed,
            yaw_rate_radps=turn,
            accel_mps2=((0.0 if blocked else speed) - before.speed_mps) / STEP_S,
            odometry=before.odometry.moved(
                wheel_speed * self._odometry_speed_scale * STEP_S, wheel_turn * self._odometry_yaw_scale * STEP_S
            ),
            wheel_left_rad=before.wheel_left_rad + (wheel_speed - wheel_turn * TRACK_M / 2) * STEP_S / WHEEL_RADIUS_M,
            wheel_right_rad=before.wheel_right_rad + (wheel_speed + wheel_turn * TRACK_M / 2) * STEP_S / WHEEL_RADIUS_M,
            charge=max(0.0, before.charge - power_w * STEP_S / (BATTERY_WH * 3600.0)),
            travelled_m=before.travelled_m + (0.0 if blocked else abs(speed) * STEP_S),
            blocked=blocked,
        )
        return self.state

    def _wander(self, time_s: float) -> tuple[float, float]:
        """A figure of eight inside the yard's free disc: one circle to the left, one to the right."""
        if not self._patrol:
            return 0.0, 0.0
        side = 1.0 if (time_s % self._patrol_period_s) < self._patrol_period_s / 2 else -1.0
        return self._patrol_speed_mps, side * 4 * math.pi / self._patrol_period_s

    # Sensors: each reads the present state; their noise is seeded too, in the order of the calls

    def imu(self) -> Inertial:
        """Yaw rate, forward and leftward acceleration, with bias and noise; the ground is level."""
        state = self.state
        gauss = self._sensor_random.gauss
        return Inertial(
            state.yaw_rate_radps + self._gyro_bias_radps + gauss(0.0, GYRO_NOISE_RADPS),
            state.accel_mps2 + gauss(0.0, ACCEL_NOISE_MPS2),
            state.speed_mps * state.yaw_rate_radps + gauss(0.0, ACCEL_NOISE_MPS2),
        )

    def scan(self, beams: int = 720, span_rad: float = 1.5 * math.pi) -> NDArray[np.float32]:
        """Planar LiDAR: (beams,) ranges in metres from -span/2 to +span/2, inf where nothing is in range."""
        pose = self.state.pose
        bearings = pose.yaw_rad + np.linspace(-span_rad / 2, span_rad / 2, beams)
        ranges = self.world.cast(pose.x_m, pose.y_m, bearings).range_m
        ranges = ranges + self._noise.normal(0.0, 0.01, beams)
        return np.where(ranges <= LIDAR_RANGE_M, np.maximum(ranges, 0.05), np.inf).astype(np.float32)

    def cloud(self, points: int) -> NDArray[np.float32]:
        """16-ring LiDAR: (points, 4) x, y, z, intensity in the sensor frame; a missing return is NaN, as in drivers."""
        azimuths = max(1, -(-points // len(RINGS_RAD)))
        rays = min(azimuths, MAX_CAST_RAYS)
        pose = self.state.pose
        bearings = np.linspace(-math.pi, math.pi, rays, endpoint=False)
        hit = self.world.cast(pose.x_m, pose.y_m, pose.yaw_rad + bearings)
        pick = (np.arange(azimuths) * rays) // azimuths
        bearing = np.linspace(-math.pi, math.pi, azimuths, endpoint=False)
        flat, height = hit.range_m[pick][:, None], hit.height_m[pick][:, None]
        slope = _RING_SLOPES[None, :]
        with np.errstate(divide="ignore", invalid="ignore"):
            ground = np.where(slope < 0, LIDAR_HEIGHT_M / -slope, np.inf)
            on_obstacle = flat * slope + LIDAR_HEIGHT_M <= height
        flat = np.minimum(np.where(on_obstacle, flat, np.inf), ground)
        flat = flat + self._noise.normal(0.0, 0.01, flat.shape)
        flat = np.where(flat <= LIDAR_RANGE_M, flat, np.nan)
        out = np.empty((azimuths, len(RINGS_RAD), 4), dtype=np.float32)
        out[..., 0] = flat * np.cos(bearing)[:, None]
        out[..., 1] = flat * np.sin(bearing)[:, None]
        out[..., 2] = flat * slope
        out[..., 3] = np.where(np.isnan(flat), 0.0, 100.0 / (1.0 + np.nan_to_num(flat)))
        return out.reshape(-1, 4)[:points]

    def image(self, width: int, height: int) -> NDArray[np.uint8]:
        """(height, width, 3) RGB: sky, ground, and walls darker with distance; what a forward camera would show."""
        pose = self.state.pose
        bearings = np.linspace(0.6, -0.6, width)
        ranges = np.minimum(self.world.cast(pose.x_m, pose.y_m, pose.yaw_rad + bearings).range_m, LIDAR_RANGE_M)
        rows = np.abs(np.arange(height)[:, None] - height / 2) / max(height, 1)
        shade = (220.0 - 6.0 * ranges)[None, :]
        frame = np.where(rows < 0.8 / np.maximum(ranges, 0.5)[None, :], shade, 90.0 + 60.0 * rows)
        frame = frame + self._noise.normal(0.0, 3.0, frame.shape)
        grey = np.clip(frame, 0, 255).astype(np.uint8)
        return np.repeat(grey[:, :, None], 3, axis=2)


def approach(value: float, goal: float, rate: float) -> float:
    """`value` moved towards `goal` by at most `rate` times one step."""
    return value + min(max(goal - value, -rate * STEP_S), rate * STEP_S)


def clamp(value: float, limit: float) -> float:
    """`value` between -limit and limit."""
    return min(max(value, -limit), limit)


__all__ = ["STEP_S", "Floats", "Inertial", "Pose2", "RobotState", "SimulatedJackal", "approach", "clamp"]
