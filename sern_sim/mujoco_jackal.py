"""A simulated Jackal in MuJoCo: four driven wheels that skid on hills, with the sensors that a real one carries.

It needs the extra `sim`. Nothing here has a clock, and MuJoCo draws no random numbers: the same seed and the same calls
give the same numbers on the same machine. Wheels touch a height field; rays meet a mesh of the same ground in its
place, because a ray through a height field takes a hundred times as long.

base_link is on the ground below the body's middle, x forward, y left, z up.
"""

import math
from random import Random
from types import ModuleType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sern_core.vocabulary.errors import ConfigError
from sern_sim.robot import (
    ACCEL_NOISE_MPS2,
    BATTERY_WH,
    GYRO_NOISE_RADPS,
    LIDAR_HEIGHT_M,
    LIDAR_RANGE_M,
    MAX_ACCEL_MPS2,
    MAX_SPEED_MPS,
    MAX_YAW_ACCEL_RADPS2,
    MAX_YAW_RATE_RADPS,
    RINGS_RAD,
    STEP_S,
    TRACK_M,
    WHEEL_NOISE,
    WHEEL_RADIUS_M,
    Inertial,
    Pose2,
    RobotState,
    approach,
    clamp,
)
from sern_sim.terrain import Block, Label, Terrain
from sern_sim.world import Floats

FINE_STEP_S: Final = 0.002
FINE_STEPS: Final = round(STEP_S / FINE_STEP_S)
YAW_SCALE: Final = 0.34
"""What the base makes of a turn on level ground: one over the effective track ratio, which is 2.5 to 3.2 by speed and
turn. The friction of the wheels gives it; that about the upright axis is the scrubbing of a broad tyre."""
MAX_AZIMUTHS: Final = 900
"""Above this many azimuths a cloud repeats neighbouring rays with fresh noise."""
RANGE_NOISE_M: Final = 0.01
NEAR_M: Final = 0.05
BLOCKED_SHARE: Final = 0.2
"""It is held where it moves by less than this share of what its wheels say."""
_CAMERA_M: Final = (0.2, 0.0, 0.3)
_MOST_PIXELS: Final = 4096  # of rays a picture; a larger one repeats them
_WHEELS: Final = ("fl", "fr", "rl", "rr")
_CONTACT, _MESH, _BLOCKS, _ROBOT = range(4)  # groups of geoms; rays look at the middle two
KV: Final = 30.0
"""The gain of a wheel's motor, N·m for each rad/s that it is off: stiff, so that it stands on a slope."""
_BASE_Z_M: Final = 0.13
_XML: Final = """
<mujoco model="jackal">
  <compiler angle="radian"/>
  <option timestep="{step}" cone="elliptic" impratio="5" integrator="implicitfast"/>
  <size nuser_geom="1"/>
  <worldbody>
    <body name="base" pos="0 0 {z}">
      <freejoint/>
      <inertial pos="0 0 0.12" mass="14" diaginertia="0.25 0.35 0.45"/>
      <geom type="box" size="0.25 0.155 0.08" pos="0 0 0.16" group="3" user="5" friction="0.3"/>
      {wheels}
    </body>
  </worldbody>
  <actuator>{motors}</actuator>
</mujoco>
"""
_WHEEL: Final = """
      <body name="{name}" pos="{x} {y} {radius}">
        <joint name="{name}" type="hinge" axis="0 1 0" damping="0.05" armature="0.02"/>
        <geom type="cylinder" size="{radius} 0.02" zaxis="0 1 0" mass="0.5" group="3" user="5"
              condim="6" friction="0.9 0.1 0.001" priority="1"/>
      </body>"""


def load_mujoco() -> ModuleType:
    """The package. ConfigError, one line, where the extra `sim` is not installed."""
    try:
        import mujoco
    except ImportError as error:
        raise ConfigError(
            f"plant mujoco needs the package mujoco, which cannot be imported ({error}): install sern[sim], "
            "or take plant unicycle"
        ) from None
    return mujoco  # type: ignore[no-any-return]


class MujocoJackal:
    """A `Plant` on a `Terrain`. Motion and sensors draw apart: what is looked at does not change where it goes."""

    yaw_scale_known = YAW_SCALE

    def __init__(self, random: Random, *, world: Terrain | None = None, start: Pose2 | None = None) -> None:
        """ConfigError without the extra `sim`."""
        self._mujoco = mujoco = load_mujoco()
        self.world = world or Terrain.hills(random)
        start = start or Pose2()
        self.state = RobotState(pose=start, odometry=start)
        self.command = (0.0, 0.0)  # speed m/s, yaw rate rad/s: as asked, unlimited
        self.commanded = False
        self._model = _model(mujoco, self.world)
        self._data = mujoco.MjData(self._model)
        self._labels = self._model.geom_user[:, 0].astype(np.uint16)
        self._seen = np.array([group in (_MESH, _BLOCKS) for group in range(6)], dtype=np.uint8)
        self._base = self._model.body("base").id
        self._wheel_at = [self._model.joint(name).qposadr[0] for name in _WHEELS]
        self._odometry_yaw_scale = YAW_SCALE * random.uniform(0.97, 1.03)
        self._odometry_speed_scale = random.uniform(0.99, 1.01)
        self._gyro_bias_radps = [random.gauss(0.0, 0.002) for _ in range(3)]
        self._accel_bias_mps2 = [random.gauss(0.0, 0.02) for _ in range(3)]
        self._specific_mps2 = (0.0, 0.0, 0.0)
        self._wheels_told = (0.0, 0.0)
        self._steps = 0
        self._random = random
        self._sensor_random = Random(random.getrandbits(64))
        self._noise = np.random.default_rng(random.getrandbits(64))
        self.stand(start)

    def drive(self, speed_mps: float, yaw_rate_radps: float) -> None:
        """A velocity command, in force until the next. Not a finite number: ValueError."""
        if not (math.isfinite(speed_mps) and math.isfinite(yaw_rate_radps)):
            raise ValueError("a velocity command must be finite")
        self.command = (speed_mps, yaw_rate_radps)
        self.commanded = True

    def step(self) -> RobotState:
        """One step of `STEP_S`. ArithmeticError: the simulation has become unstable."""
        data, before = self._data, self.state
        self._steps += 1
        speed = approach(self._wheels_told[0], clamp(self.command[0], MAX_SPEED_MPS), MAX_ACCEL_MPS2)
        turn = approach(self._wheels_told[1], clamp(self.command[1], MAX_YAW_RATE_RADPS), MAX_YAW_ACCEL_RADPS2)
        self._wheels_told = (speed, turn)
        left, right = (speed - turn * TRACK_M / 2) / WHEEL_RADIUS_M, (speed + turn * TRACK_M / 2) / WHEEL_RADIUS_M
        data.ctrl[:] = (left, right, left, right)
        earlier = np.array(data.qvel[:3])
        self._mujoco.mj_step(self._model, data, FINE_STEPS)
        self._check()
        self._specific_mps2 = self._felt(earlier)
        self.state = self._read(before)
        return self.state

    @property
    def touches(self) -> bool:
        """Whether its body or a wheel touches what stands on the ground; to drive on a bridge is no touching."""
        groups, labels = self._model.geom_group, self._labels
        return any(
            {int(groups[one]), int(groups[other])} == {_BLOCKS, _ROBOT}
            and Label.BRIDGE not in (int(labels[one]), int(labels[other]))
            for one, other in self._data.contact.geom[: self._data.ncon]
        )

    # Sensors: each reads the present state; their noise is seeded too, in the order of the calls

    def imu(self) -> Inertial:
        """Gyroscope and accelerometer, with bias and noise. The accelerometer feels gravity, also on a slope."""
        gauss = self._sensor_random.gauss
        turn = [
            float(rate) + bias + gauss(0.0, GYRO_NOISE_RADPS)
            for rate, bias in zip(self._data.qvel[3:6], self._gyro_bias_radps, strict=True)
        ]
        felt = [
            value + bias + gauss(0.0, ACCEL_NOISE_MPS2)
            for value, bias in zip(self._specific_mps2, self._accel_bias_mps2, strict=True)
        ]
        return Inertial(turn[2], felt[0], felt[1], felt[2], turn[0], turn[1])

    def scan(self, beams: int = 720, span_rad: float = 1.5 * math.pi) -> NDArray[np.float32]:
        """Planar LiDAR: (beams,) ranges in metres from -span/2 to +span/2, inf where nothing is in range."""
        bearings = np.linspace(-span_rad / 2, span_rad / 2, beams)
        rays = np.stack([np.cos(bearings), np.sin(bearings), np.zeros(beams)], axis=1)
        ranges, _ = self.cast((0.0, 0.0, LIDAR_HEIGHT_M), rays)
        ranges = ranges + self._noise.normal(0.0, RANGE_NOISE_M, beams)
        return np.where(ranges <= LIDAR_RANGE_M, np.maximum(ranges, NEAR_M), np.inf).astype(np.float32)

    def cloud(self, points: int) -> NDArray[np.float32]:
        """16-ring LiDAR: (points, 5) x, y, z, intensity and `Label` in the sensor frame; a missing return is NaN."""
        azimuths = max(1, -(-points // len(RINGS_RAD)))
        cast = min(azimuths, MAX_AZIMUTHS)
        bearings = np.linspace(-math.pi, math.pi, cast, endpoint=False)[:, None]
        rays = np.empty((cast, len(RINGS_RAD), 3))
        rays[..., 0] = np.cos(bearings) * np.cos(RINGS_RAD)
        rays[..., 1] = np.sin(bearings) * np.cos(RINGS_RAD)
        rays[..., 2] = np.sin(RINGS_RAD)
        ranges, labels = self.cast((0.0, 0.0, LIDAR_HEIGHT_M), rays.reshape(-1, 3))
        pick = (np.arange(azimuths) * cast) // azimuths
        ranges, labels = ranges.reshape(cast, -1)[pick], labels.reshape(cast, -1)[pick]
        ranges = ranges + self._noise.normal(0.0, RANGE_NOISE_M, ranges.shape)
        there = ranges <= LIDAR_RANGE_M
        ranges = np.where(there, np.maximum(ranges, NEAR_M), np.nan)
        out = np.empty((azimuths, len(RINGS_RAD), 5), dtype=np.float32)
        out[..., :3] = rays[pick] * ranges[..., None]
        out[..., 3] = np.where(there, 100.0 / (1.0 + np.nan_to_num(ranges)), 0.0)
        out[..., 4] = np.where(there, labels, Label.NOTHING)
        return out.reshape(-1, 5)[:points]

    def image(self, width: int, height: int) -> NDArray[np.uint8]:
        """(height, width, 3) RGB: sky, ground and bodies in the colours of their labels, darker with distance."""
        coarse = max(1, math.ceil(math.sqrt(width * height / _MOST_PIXELS)))
        columns, rows = -(-width // coarse), -(-height // coarse)
        left, up = np.meshgrid(np.linspace(0.6, -0.6, columns), np.linspace(0.45, -0.45, rows))
        rays = np.stack([np.ones_like(left), left, up], axis=-1).reshape(-1, 3)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        ranges, labels = self.cast(_CAMERA_M, rays)
        shade = np.where(ranges <= LIDAR_RANGE_M, 1.0 / (1.0 + ranges / 15.0), 1.0)
        frame = (_COLOURS[np.where(ranges <= LIDAR_RANGE_M, labels, 0)] * shade[:, None]).reshape(rows, columns, 3)
        frame = np.repeat(np.repeat(frame, coarse, axis=0), coarse, axis=1)[:height, :width]
        frame = frame + self._noise.normal(0.0, 3.0, frame.shape)
        clipped: NDArray[np.uint8] = np.clip(frame, 0, 255).astype(np.uint8)
        return clipped

    def cast(self, at_m: tuple[float, float, float], rays: Floats) -> tuple[Floats, NDArray[np.uint16]]:
        """Unit `rays` (n, 3) in the axes of the body, from a place of it, and without noise: ranges [m] (n,), inf where
        nothing is, and the `Label` of each."""
        turned = self._turned()
        origin = np.array(self._data.qpos[:3]) + turned @ np.array(at_m)
        directions = np.ascontiguousarray(rays @ turned.T).reshape(-1)
        met, ranges = np.full(len(rays), -1, dtype=np.int32), np.full(len(rays), -1.0)
        # Beyond the range nothing is looked for; the noise may take back what is just beyond.
        self._mujoco.mj_multiRay(
            self._model, self._data, origin, directions, self._seen, 1, -1, met, ranges, None, len(rays),
            LIDAR_RANGE_M + 1.0,
        )  # fmt: skip
        return np.where(met < 0, np.inf, ranges), np.where(met < 0, 0, self._labels[met]).astype(np.uint16)

    def stand(self, start: Pose2) -> None:
        """Let it down on the ground there, and wait until it stands still; what it has counted begins anew."""
        data = self._data
        highest = max(
            self.world.height_m(start.x_m + x, start.y_m + y) for x in (-0.3, 0.0, 0.3) for y in (-0.3, 0.0, 0.3)
        )
        data.qpos[:3] = start.x_m, start.y_m, highest + 0.02
        data.qpos[3:7] = math.cos(start.yaw_rad / 2), 0.0, 0.0, math.sin(start.yaw_rad / 2)
        self._mujoco.mj_step(self._model, data, round(0.6 / FINE_STEP_S))
        self._check()
        self._specific_mps2 = self._felt(np.array(data.qvel[:3]))
        x, y, z, roll, pitch, yaw = self._where()
        here = Pose2(x, y, yaw)
        self._wheel_from = [float(data.qpos[at]) for at in self._wheel_at]
        self.state = RobotState(pose=here, odometry=here, z_m=z, roll_rad=roll, pitch_rad=pitch)

    # Parts

    def _check(self) -> None:
        warnings = self._mujoco.mjtWarning
        for kind in (warnings.mjWARN_BADQPOS, warnings.mjWARN_BADQVEL, warnings.mjWARN_BADQACC):
            if self._data.warning[int(kind)].number:
                raise ArithmeticError(
                    f"the simulated robot became unstable {self._steps * STEP_S:.2f} s after its start"
                )

    def _turned(self) -> Floats:
        """(3, 3): what turns the body's axes into those of the world."""
        turned: Floats = np.array(self._data.xmat[self._base]).reshape(3, 3)
        return turned

    def _where(self) -> tuple[float, float, float, float, float, float]:
        x, y, z = (float(value) for value in self._data.qpos[:3])
        w, i, j, k = (float(value) for value in self._data.qpos[3:7])
        roll = math.atan2(2 * (w * i + j * k), 1 - 2 * (i * i + j * j))
        pitch = math.asin(clamp(2 * (w * j - k * i), 1.0))
        return x, y, z, roll, pitch, math.atan2(2 * (w * k + i * j), 1 - 2 * (j * j + k * k))

    def _felt(self, earlier_mps: Floats) -> tuple[float, float, float]:
        """The mean specific force of the step, m/s² in the body's axes."""
        gained = (self._data.qvel[:3] - earlier_mps) / STEP_S - self._model.opt.gravity
        forward, left, up = self._turned().T @ gained
        return float(forward), float(left), float(up)

    def _read(self, before: RobotState) -> RobotState:
        data = self._data
        x, y, z, roll, pitch, yaw = self._where()
        speed = float((self._turned().T @ data.qvel[:3])[0])
        wheels = [float(data.qpos[at]) - since for at, since in zip(self._wheel_at, self._wheel_from, strict=True)]
        left, right = (wheels[0] + wheels[2]) / 2, (wheels[1] + wheels[3]) / 2
        gauss = self._random.gauss
        rolled = [
            (now - earlier) * WHEEL_RADIUS_M * (1 + gauss(0.0, WHEEL_NOISE))
            for now, earlier in ((left, before.wheel_left_rad), (right, before.wheel_right_rad))
        ]
        wheel_mps, wheel_radps = sum(rolled) / 2 / STEP_S, (rolled[1] - rolled[0]) / TRACK_M / STEP_S
        moved_m = math.dist((x, y), (before.pose.x_m, before.pose.y_m))
        power_w = 25.0 + 80.0 * abs(wheel_mps) + 20.0 * abs(wheel_radps)
        return RobotState(
            time_s=self._steps * STEP_S,
            pose=Pose2(x, y, yaw),
            speed_mps=speed,
            yaw_rate_radps=math.remainder(yaw - before.pose.yaw_rad, 2 * math.pi) / STEP_S,
            accel_mps2=(speed - before.speed_mps) / STEP_S,
            odometry=before.odometry.moved(
                wheel_mps * self._odometry_speed_scale * STEP_S, wheel_radps * self._odometry_yaw_scale * STEP_S
            ),
            wheel_left_rad=left,
            wheel_right_rad=right,
            charge=max(0.0, before.charge - power_w * STEP_S / (BATTERY_WH * 3600.0)),
            travelled_m=before.travelled_m + moved_m,
            blocked=abs(wheel_mps) > 0.1 and abs(speed) < BLOCKED_SHARE * abs(wheel_mps),
            z_m=z,
            roll_rad=roll,
            pitch_rad=pitch,
        )


_COLOURS: Final = np.array(
    [(150, 190, 235), (110, 130, 70), (170, 30, 30), (140, 140, 150), (110, 70, 40), (180, 180, 170)], dtype=np.float64
)  # by label; what is nothing is sky


def _model(mujoco: Any, world: Terrain) -> Any:
    wheels = [
        _WHEEL.format(name=name, x=x, y=y, radius=WHEEL_RADIUS_M)
        for name, (x, y) in zip(
            _WHEELS, ((x, y) for x in (0.131, -0.131) for y in (TRACK_M / 2, -TRACK_M / 2)), strict=True
        )
    ]
    motors = [f'<velocity joint="{name}" kv="{KV:g}" forcerange="-12 12"/>' for name in _WHEELS]
    text = _XML.format(step=FINE_STEP_S, z=_BASE_Z_M, wheels="".join(wheels), motors="".join(motors))
    spec = mujoco.MjSpec.from_string(text)
    _ground(mujoco, spec, world)
    for block in world.blocks:
        _stands(mujoco, spec, block)
    return spec.compile()


def _ground(mujoco: Any, spec: Any, world: Terrain) -> None:
    heights, half_m = world.heights_m, world.half_size_m
    lowest, rise = float(heights.min()), max(float(np.ptp(heights)), 1e-3)
    cells = len(heights)
    spec.add_hfield(
        name="ground",
        nrow=cells,
        ncol=cells,
        size=[half_m, half_m, rise, 1.0],
        userdata=((heights - lowest) / rise).astype(np.float32).reshape(-1),
    )
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_HFIELD,
        hfieldname="ground",
        pos=[0, 0, lowest],
        group=_CONTACT,
        userdata=[Label.GROUND],
    )
    axis = np.linspace(-half_m, half_m, cells)
    x, y = np.meshgrid(axis, axis)
    corner = (np.arange(cells - 1)[:, None] * cells + np.arange(cells - 1)[None, :]).reshape(-1)
    east, north, both = corner + 1, corner + cells, corner + cells + 1
    faces = np.concatenate([np.stack([corner, east, both], axis=1), np.stack([corner, both, north], axis=1)])
    spec.add_mesh(
        name="seen",
        uservert=np.stack([x, y, heights], axis=-1).reshape(-1),
        userface=faces.reshape(-1).astype(np.int32),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_MESH,
        meshname="seen",
        contype=0,
        conaffinity=0,
        group=_MESH,
        userdata=[Label.GROUND],
    )


def _stands(mujoco: Any, spec: Any, block: Block) -> None:
    half_yaw = block.yaw_rad / 2
    turned = np.array([math.cos(half_yaw), 0.0, 0.0, math.sin(half_yaw)])
    kind, size = mujoco.mjtGeom.mjGEOM_BOX, list(block.half_m)
    if block.radius_m is not None:  # its axis is z, and is laid along x
        kind, size = mujoco.mjtGeom.mjGEOM_CYLINDER, [block.radius_m, block.half_m[0], 0.0]
        laid, out = np.array([math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0]), np.zeros(4)
        mujoco.mju_mulQuat(out, turned, laid)
        turned = out
    spec.worldbody.add_geom(
        type=kind,
        size=size,
        pos=[block.x_m, block.y_m, block.z_m],
        quat=turned,
        group=_BLOCKS,
        friction=[0.9 if block.label in (Label.BRIDGE, Label.LOG) else 0.2, 0.02, 0.001],
        priority=2,  # above that of the wheels, which would climb a wall with what they have on the ground
        userdata=[block.label],
    )
