"""The topics of the simulated robot and of its operator: names, types, rates, and how each body is made.

| topic | type | Hz | offered (ROS 2) |
|---|---|---|---|
| /odometry/filtered | nav_msgs/Odometry | pose_rate_hz | reliable |
| /jackal_velocity_controller/odom | nav_msgs/Odometry, drifting | pose_rate_hz | reliable |
| /imu/data | sensor_msgs/Imu | 50 | best effort |
| /tf | tf2_msgs/TFMessage | pose_rate_hz | reliable |
| /tf_static | tf2_msgs/TFMessage | once | reliable, latched |
| /scan | sensor_msgs/LaserScan | 10 | best effort |
| /points | sensor_msgs/PointCloud2, of plant mujoco with a label | cloud_rate_hz, bulk | best effort |
| /map | nav_msgs/OccupancyGrid | map_rate_hz, bulk | reliable, latched |
| /map_updates | map_msgs/OccupancyGridUpdate | 1, bulk | reliable |
| /camera/image_raw | sensor_msgs/Image | 5, bulk | best effort |
| /joint_states | sensor_msgs/JointState | 50 | reliable |
| /status | geometry_msgs/TwistStamped, the command in force | 10 | reliable |
| /battery | sensor_msgs/BatteryState | 1 | reliable |
| /diagnostics | diagnostic_msgs/DiagnosticArray | 1 | reliable |
| /pose | geometry_msgs/PoseStamped, the truth | pose_rate_hz | reliable |
| /navsat/fix | sensor_msgs/NavSatFix | 5 | best effort |
| /imu/mag | sensor_msgs/MagneticField | 20 | best effort |
| /path | nav_msgs/Path, the last 100 s | 1, bulk | reliable |
| /temperature | sensor_msgs/Temperature | 1 | best effort |
| /e_stop | std_msgs/Bool | once | reliable, latched |
| /plan | nav_msgs/Path with times, the next 90 s; only of a robot that follows one | 1/30 | reliable, latched |
| /ground_truth | nav_msgs/Odometry, the truth; only of a robot that follows a plan | pose_rate_hz | reliable |

In ROS 1 a publisher does not say whether it is reliable, so there `reliable` is None. Frames: map = odom, base_link,
imu_link, velodyne, camera.
"""

import math
from collections import deque
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from random import Random
from typing import Any, Final

import numpy as np

from sern_client.endpoints.clouds import CLOUD_TYPE, CloudSource, cloud_body
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_geometry, ros_types
from sern_sim.follower import ON_HILLS, Reference
from sern_sim.pilot import OFF_M, FigureOfEight, Pilot
from sern_sim.plant import Plant
from sern_sim.robot import GYRO_NOISE_RADPS, STEP_S, Pose2, SimulatedJackal
from sern_sim.way_back import way_back

ORIGIN_DEG: Final = (48.135, 10.068)
"""Latitude and longitude of the yard's centre."""
_METRES_PER_DEGREE: Final = 111_320.0
_PATH_POSES: Final = 100


@dataclass(frozen=True, slots=True)
class Plan:
    """One topic: `rate_hz` 0 means only when somebody subscribes (latched)."""

    name: str
    type_name: str
    rate_hz: float
    reliable: bool
    latched: bool = False
    bulk: bool = False
    pose: bool = False  # follows pose_rate_hz


JACKAL: Final = (
    Plan("/odometry/filtered", "nav_msgs/msg/Odometry", 50.0, True, pose=True),
    Plan("/jackal_velocity_controller/odom", "nav_msgs/msg/Odometry", 50.0, True, pose=True),
    Plan("/imu/data", "sensor_msgs/msg/Imu", 50.0, False),
    Plan("/tf", "tf2_msgs/msg/TFMessage", 50.0, True, pose=True),
    Plan("/tf_static", "tf2_msgs/msg/TFMessage", 0.0, True, latched=True),
    Plan("/scan", "sensor_msgs/msg/LaserScan", 10.0, False),
    Plan("/points", CLOUD_TYPE, 10.0, False, bulk=True),
    Plan("/map", "nav_msgs/msg/OccupancyGrid", 0.2, True, latched=True, bulk=True),
    Plan("/map_updates", "map_msgs/msg/OccupancyGridUpdate", 1.0, True, bulk=True),
    Plan("/camera/image_raw", "sensor_msgs/msg/Image", 5.0, False, bulk=True),
    Plan("/joint_states", "sensor_msgs/msg/JointState", 50.0, True),
    Plan("/status", "geometry_msgs/msg/TwistStamped", 10.0, True),
    Plan("/battery", "sensor_msgs/msg/BatteryState", 1.0, True),
    Plan("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", 1.0, True),
    Plan("/pose", "geometry_msgs/msg/PoseStamped", 50.0, True, pose=True),
    Plan("/navsat/fix", "sensor_msgs/msg/NavSatFix", 5.0, False),
    Plan("/imu/mag", "sensor_msgs/msg/MagneticField", 20.0, False),
    Plan("/path", "nav_msgs/msg/Path", 1.0, True, bulk=True),
    Plan("/temperature", "sensor_msgs/msg/Temperature", 1.0, False),
    Plan("/e_stop", "std_msgs/msg/Bool", 0.0, True, latched=True),
)


PLAN: Final = Plan("/plan", "nav_msgs/msg/Path", 1 / 30, True, latched=True)
TRUTH: Final = Plan("/ground_truth", "nav_msgs/msg/Odometry", 50.0, True, pose=True)
"""What a robot that follows a plan has beside `JACKAL`: its localisation is off, so that the truth is told apart."""


@dataclass(frozen=True, slots=True)
class Sizes:
    """Bytes of the heavy bodies, each within one element of what is asked (16 per point, 18 with a label, 1 per cell,
    3 per pixel)."""

    cloud_bytes: int = 100_000
    map_bytes: int = 40_000
    image_bytes: int = 9_216


class JackalSource:
    """Makes the bodies of `JACKAL` from a simulated robot. The same seed, calls and stamps give the same bytes."""

    def __init__(
        self,
        random: Random,
        encoding: Encoding,
        sizes: Sizes,
        *,
        patrol: bool,
        cloud_files: tuple[Path, ...] = (),
        follow: bool = False,
        localisation_noise_m: float = OFF_M,
        plant: str = "unicycle",
    ) -> None:
        """`follow`: it drives by a plan, and its odometry is where a localisation thinks it is. ConfigError: `plant`
        is mujoco, and that is not installed, or `patrol` is asked of it.
        """
        if not 0 <= localisation_noise_m < math.inf:
            raise ConfigError(f"localisation_noise_m must be 0 or more metres, not {localisation_noise_m}")
        self.robot: Plant = _plant(random, plant, patrol=patrol)
        self._random = Random(random.getrandbits(64))
        self._way: FigureOfEight | None = None
        self._pilot: Pilot | None = None
        if follow:
            self._way = FigureOfEight(self._random, self.robot.state.pose, 0.0)
            law = ON_HILLS if plant == "mujoco" else None
            self._pilot = Pilot(self._random, self.robot, self._planned, off_m=localisation_noise_m, follower=law)
        self._sizes = sizes
        self._clouds = CloudSource(cloud_files, encoding) if cloud_files else None
        self._new = partial(_make, encoding)
        self._encoding = encoding
        self._seq: dict[str, int] = {}
        self._now_s = 0.0
        self._path: deque[tuple[int, Pose2]] = deque(maxlen=_PATH_POSES)
        self._point_bytes = 18 if plant == "mujoco" else 16  # with a label, or without
        cells = max(1, math.isqrt(sizes.map_bytes))
        self._grid = self.robot.world.occupancy(cells)
        self._build = {
            "/odometry/filtered": self._odometry_found,
            "/jackal_velocity_controller/odom": self._odometry_wheels,
            "/imu/data": self._imu,
            "/tf": self._tf,
            "/tf_static": self._tf_static,
            "/scan": self._scan,
            "/map": self._map,
            "/map_updates": self._map_update,
            "/camera/image_raw": self._image,
            "/joint_states": self._joints,
            "/status": self._status,
            "/battery": self._battery,
            "/diagnostics": self._diagnostics,
            "/pose": self._pose,
            "/navsat/fix": self._fix,
            "/imu/mag": self._mag,
            "/path": self._path_message,
            "/temperature": self._temperature,
            "/e_stop": self._e_stop,
            "/plan": self._plan_message,
            "/ground_truth": self._odometry_ground_truth,
        }

    def advance(self, to_s: float) -> None:
        """Run the robot to `to_s` seconds after its start."""
        self._now_s = to_s
        while self.robot.state.time_s + STEP_S <= to_s + 1e-9:
            if self._pilot is None:
                self.robot.step()
            else:
                self._pilot.step()

    def _planned(self, time_s: float) -> Reference:
        assert self._way is not None
        return self._way.at(time_s)

    def drive(self, speed_mps: float, yaw_rate_radps: float) -> None:
        """A velocity command, in force until the next, or until `release`. Not a finite number: ValueError."""
        self.robot.drive(speed_mps, yaw_rate_radps)
        if self._pilot is not None:
            self._pilot.held = True

    def release(self) -> bool:
        """Commands have ceased: it stands, or makes a new plan from where it is. Whether there is a new plan."""
        self.robot.drive(0.0, 0.0)
        if self._pilot is None or not self._pilot.held:
            return False
        self._pilot.held = False
        found = self._pilot.found.pose
        back = way_back(self.robot.world, found)
        self._way = FigureOfEight(self._random, found, self.robot.state.time_s, back)
        return True

    def _where(self) -> tuple[Pose2, float, float]:
        """Where it thinks it is: pose, speed and yaw rate."""
        if self._pilot is None:
            state = self.robot.state
            return state.pose, state.speed_mps, state.yaw_rate_radps
        found = self._pilot.found
        return found.pose, found.speed_mps, found.yaw_rate_radps

    def thinks(self) -> Pose2:
        """Where it thinks it is now: what it found last, moved on."""
        if self._pilot is None:
            return self.robot.state.pose
        found = self._pilot.found
        since_s = self.robot.state.time_s - found.time_s
        return found.pose.moved(found.speed_mps * since_s, found.yaw_rate_radps * since_s)

    def ready(self, plan: Plan) -> bool:
        """Whether the topic has a message now: there is no plan while somebody commands the robot."""
        return plan.name != PLAN.name or (self._pilot is not None and not self._pilot.held)

    def body(self, plan: Plan, stamp_ns: int) -> bytes:
        """The message of a topic as of now; `stamp_ns` goes into its header: the time of the last `advance`."""
        seq = self._seq[plan.name] = self._seq.get(plan.name, 0) + 1
        if plan.name == "/points":
            if self._clouds is not None:
                return self._clouds.next_body(stamp_ns)
            points = self.robot.cloud(max(1, self._sizes.cloud_bytes // self._point_bytes))
            return cloud_body(points, stamp_ns, "velodyne", self._encoding, seq)
        message = self._build[plan.name](stamp_ns, seq)
        return ros_types.serialise(message, plan.type_name, self._encoding)

    # Parts

    def _header(self, stamp_ns: int, frame_id: str, seq: int = 0) -> Any:
        return ros_types.header(stamp_ns, frame_id, self._encoding, seq)

    def _vector(self, x: float = 0.0, y: float = 0.0, z: float = 0.0, kind: str = "Vector3") -> Any:
        return self._new(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)

    def _pose_of(self, pose: Pose2) -> Any:
        return ros_geometry.pose(self._encoding, pose.x_m, pose.y_m, yaw_rad=pose.yaw_rad)

    def _pose_on_ground(self, pose: Pose2) -> Any:
        """A pose message with the height and the tilt that the robot has now."""
        state = self.robot.state
        return ros_geometry.pose(
            self._encoding, pose.x_m, pose.y_m, state.z_m, pose.yaw_rad, state.roll_rad, state.pitch_rad
        )

    def _twist(self, speed_mps: float, yaw_rate_radps: float) -> Any:
        return self._new(
            "geometry_msgs/msg/Twist", linear=self._vector(speed_mps), angular=self._vector(z=yaw_rate_radps)
        )

    def _stamped_pose(self, stamp_ns: int, seq: int, pose: Pose2) -> Any:
        header = self._header(stamp_ns, "odom", seq)
        return self._new("geometry_msgs/msg/PoseStamped", header=header, pose=self._pose_of(pose))

    def _transform(self, stamp_ns: int, child: str, pose: Pose2, z_m: float = 0.0, parent: str = "base_link") -> Any:
        transform = self._new(
            "geometry_msgs/msg/Transform",
            translation=self._vector(pose.x_m, pose.y_m, z_m),
            rotation=ros_geometry.quaternion(self._encoding, pose.yaw_rad),
        )
        header = self._header(stamp_ns, parent)
        name = "geometry_msgs/msg/TransformStamped"
        return self._new(name, header=header, child_frame_id=child, transform=transform)

    # Topics

    def _odometry(self, stamp_ns: int, seq: int, pose: Pose2, sigma: float, twist: tuple[float, float]) -> Any:
        covariance = np.diag([sigma, sigma, 1e6, 1e6, 1e6, sigma]).reshape(-1)
        where, moving = "geometry_msgs/msg/PoseWithCovariance", "geometry_msgs/msg/TwistWithCovariance"
        return self._new(
            "nav_msgs/msg/Odometry",
            header=self._header(stamp_ns, "odom", seq),
            child_frame_id="base_link",
            pose=self._new(where, pose=self._pose_on_ground(pose), covariance=covariance),
            twist=self._new(moving, twist=self._twist(*twist), covariance=covariance),
        )

    def _odometry_found(self, stamp_ns: int, seq: int) -> Any:
        pose, *twist = self._where()
        return self._odometry(stamp_ns, seq, pose, 1e-4, (twist[0], twist[1]))

    def _odometry_ground_truth(self, stamp_ns: int, seq: int) -> Any:
        state = self.robot.state
        return self._odometry(stamp_ns, seq, state.pose, 0.0, (state.speed_mps, state.yaw_rate_radps))

    def _odometry_wheels(self, stamp_ns: int, seq: int) -> Any:
        state = self.robot.state
        return self._odometry(stamp_ns, seq, state.odometry, 1e-2, (state.speed_mps, state.yaw_rate_radps))

    def _imu(self, stamp_ns: int, seq: int) -> Any:
        felt, state = self.robot.imu(), self.robot.state
        return self._new(
            "sensor_msgs/msg/Imu",
            header=self._header(stamp_ns, "imu_link", seq),
            orientation=ros_geometry.quaternion(self._encoding, state.pose.yaw_rad, state.roll_rad, state.pitch_rad),
            angular_velocity=self._vector(felt.roll_radps, felt.pitch_radps, felt.yaw_radps),
            angular_velocity_covariance=np.diag([GYRO_NOISE_RADPS**2] * 3).reshape(-1),
            linear_acceleration=self._vector(felt.forward_mps2, felt.left_mps2, felt.up_mps2),
        )

    def _tf(self, stamp_ns: int, seq: int) -> Any:
        del seq
        state = self.robot.state
        moved = self._transform(stamp_ns, "base_link", self._where()[0], state.z_m, parent="odom")
        moved.transform.rotation = ros_geometry.quaternion(
            self._encoding, self._where()[0].yaw_rad, state.roll_rad, state.pitch_rad
        )
        return self._new("tf2_msgs/msg/TFMessage", transforms=[moved])

    def _tf_static(self, stamp_ns: int, seq: int) -> Any:
        del seq
        fixed = [
            self._transform(stamp_ns, "odom", Pose2(), parent="map"),
            self._transform(stamp_ns, "imu_link", Pose2(), 0.1),
            self._transform(stamp_ns, "velodyne", Pose2(), 0.4),
            self._transform(stamp_ns, "camera", Pose2(0.2), 0.3),
        ]
        return self._new("tf2_msgs/msg/TFMessage", transforms=fixed)

    def _scan(self, stamp_ns: int, seq: int) -> Any:
        ranges = self.robot.scan()
        span = 1.5 * math.pi
        return self._new(
            "sensor_msgs/msg/LaserScan",
            header=self._header(stamp_ns, "velodyne", seq),
            angle_min=-span / 2,
            angle_max=span / 2,
            angle_increment=span / (len(ranges) - 1),
            scan_time=0.1,
            range_min=0.05,
            range_max=30.0,
            ranges=ranges,
        )

    def _map(self, stamp_ns: int, seq: int) -> Any:
        cells, half_m = len(self._grid), self.robot.world.half_size_m
        info = self._new(
            "nav_msgs/msg/MapMetaData",
            map_load_time=ros_types.time_of(stamp_ns, self._encoding),
            resolution=2 * half_m / cells,
            width=cells,
            height=cells,
            origin=self._pose_of(Pose2(-half_m, -half_m)),
        )
        header = self._header(stamp_ns, "map", seq)
        return self._new("nav_msgs/msg/OccupancyGrid", header=header, info=info, data=self._grid.reshape(-1))

    def _map_update(self, stamp_ns: int, seq: int) -> Any:
        """The fifth of the map around the robot."""
        cells, half_m, pose = len(self._grid), self.robot.world.half_size_m, self.robot.state.pose
        side = max(1, cells // 5)
        column, row = (
            min(max(int((at + half_m) / (2 * half_m) * cells) - side // 2, 0), cells - side)
            for at in (pose.x_m, pose.y_m)
        )
        patch = np.ascontiguousarray(self._grid[row : row + side, column : column + side]).reshape(-1)
        return self._new(
            "map_msgs/msg/OccupancyGridUpdate",
            header=self._header(stamp_ns, "map", seq),
            x=column,
            y=row,
            width=side,
            height=side,
            data=patch,
        )

    def _image(self, stamp_ns: int, seq: int) -> Any:
        pixels = max(1, self._sizes.image_bytes // 3)
        height = max(1, math.isqrt(pixels * 3 // 4))
        width = max(1, pixels // height)
        return self._new(
            "sensor_msgs/msg/Image",
            header=self._header(stamp_ns, "camera", seq),
            height=height,
            width=width,
            encoding="rgb8",
            step=3 * width,
            data=self.robot.image(width, height).reshape(-1),
        )

    def _joints(self, stamp_ns: int, seq: int) -> Any:
        state = self.robot.state
        left, right = state.wheel_left_rad, state.wheel_right_rad
        return self._new(
            "sensor_msgs/msg/JointState",
            header=self._header(stamp_ns, "", seq),
            name=["front_left_wheel", "front_right_wheel", "rear_left_wheel", "rear_right_wheel"],
            position=np.array([left, right, left, right]),
        )

    def _status(self, stamp_ns: int, seq: int) -> Any:
        header = self._header(stamp_ns, "base_link", seq)
        return self._new("geometry_msgs/msg/TwistStamped", header=header, twist=self._twist(*self.robot.command))

    def _battery(self, stamp_ns: int, seq: int) -> Any:
        charge = self.robot.state.charge
        return self._new(
            "sensor_msgs/msg/BatteryState",
            header=self._header(stamp_ns, "", seq),
            voltage=24.0 + 5.0 * charge,
            percentage=charge,
            design_capacity=10.0,
            present=True,
        )

    def _diagnostics(self, stamp_ns: int, seq: int) -> Any:
        state = self.robot.state
        values = [
            self._new("diagnostic_msgs/msg/KeyValue", key=key, value=value)
            for key, value in (("charge", f"{state.charge:.4f}"), ("travelled_m", f"{state.travelled_m:.2f}"))
        ]
        status = self._new(
            "diagnostic_msgs/msg/DiagnosticStatus",
            level=1 if state.blocked else 0,
            name="jackal_base: motion",
            message="blocked by an obstacle" if state.blocked else "ok",
            hardware_id="simulated",
            values=values,
        )
        header = self._header(stamp_ns, "", seq)
        return self._new("diagnostic_msgs/msg/DiagnosticArray", header=header, status=[status])

    def _pose(self, stamp_ns: int, seq: int) -> Any:
        header = self._header(stamp_ns, "odom", seq)
        pose = self._pose_on_ground(self.robot.state.pose)
        return self._new("geometry_msgs/msg/PoseStamped", header=header, pose=pose)

    def _fix(self, stamp_ns: int, seq: int) -> Any:
        pose, (latitude, longitude) = self.robot.state.pose, ORIGIN_DEG
        east = _METRES_PER_DEGREE * math.cos(math.radians(latitude))
        return self._new(
            "sensor_msgs/msg/NavSatFix",
            header=self._header(stamp_ns, "base_link", seq),
            latitude=latitude + (pose.y_m + self._random.gauss(0.0, 0.5)) / _METRES_PER_DEGREE,
            longitude=longitude + (pose.x_m + self._random.gauss(0.0, 0.5)) / east,
            altitude=560.0 + self._random.gauss(0.0, 1.0),
        )

    def _mag(self, stamp_ns: int, seq: int) -> Any:
        yaw = self.robot.state.pose.yaw_rad
        field = self._vector(2.1e-5 * math.sin(yaw), 2.1e-5 * math.cos(yaw), -4.3e-5)  # tesla, in the body frame
        header = self._header(stamp_ns, "imu_link", seq)
        return self._new("sensor_msgs/msg/MagneticField", header=header, magnetic_field=field)

    def _path_message(self, stamp_ns: int, seq: int) -> Any:
        self._path.append((stamp_ns, self.robot.state.pose))
        poses = [self._stamped_pose(at_ns, 0, pose) for at_ns, pose in self._path]
        return self._new("nav_msgs/msg/Path", header=self._header(stamp_ns, "odom", seq), poses=poses)

    def _plan_message(self, stamp_ns: int, seq: int) -> Any:
        assert self._way is not None
        poses = [
            self._stamped_pose(stamp_ns + round((time_s - self._now_s) * 1e9), 0, pose)
            for time_s, pose in self._way.waypoints()
        ]
        return self._new("nav_msgs/msg/Path", header=self._header(stamp_ns, "odom", seq), poses=poses)

    def _temperature(self, stamp_ns: int, seq: int) -> Any:
        header = self._header(stamp_ns, "base_link", seq)
        return self._new("sensor_msgs/msg/Temperature", header=header, temperature=25.0 + self._random.gauss(0.0, 0.2))

    def _e_stop(self, stamp_ns: int, seq: int) -> Any:
        del stamp_ns, seq
        return self._new("std_msgs/msg/Bool", data=False)


def _plant(random: Random, kind: str, *, patrol: bool) -> Plant:
    if kind == "unicycle":
        return SimulatedJackal(random, patrol=patrol)
    if kind != "mujoco":
        raise ConfigError(f"plant {kind!r} is not known; accepted: unicycle, mujoco")
    if patrol:
        raise ConfigError("plant mujoco has no patrol; let it follow a plan (follow: true)")
    from sern_sim.mujoco_jackal import MujocoJackal

    return MujocoJackal(random)


class OperatorSource:
    """Makes an operator's commands (a seeded weaving figure) and goals. Commands: Twist, or TwistStamped."""

    def __init__(self, random: Random, encoding: Encoding) -> None:
        self._random = random
        self._new = partial(_make, encoding)
        self._encoding = encoding
        self._speed_mps = random.uniform(0.4, 0.7)
        self._period_s = random.uniform(8.0, 12.0)
        self._phase = random.uniform(0.0, 1.0)
        self._time_s = 0.0
        self._seq = 0

    def advance(self, to_s: float) -> None:
        self._time_s = to_s

    def body(self, plan: Plan, stamp_ns: int) -> bytes:
        self._seq += 1
        header = ros_types.header(stamp_ns, "odom", self._encoding, self._seq)
        if plan.type_name.endswith("PoseStamped"):
            point = self._new(
                "geometry_msgs/msg/Point", x=self._random.uniform(-4.0, 4.0), y=self._random.uniform(-4.0, 4.0)
            )
            pose = self._new("geometry_msgs/msg/Pose", position=point)
            pose.orientation.w = 1.0
            message = self._new(plan.type_name, header=header, pose=pose)
        else:
            turn = 1.2 * math.sin(2 * math.pi * (self._time_s / self._period_s + self._phase))
            message = self._new(
                "geometry_msgs/msg/Twist",
                linear=self._new("geometry_msgs/msg/Vector3", x=self._speed_mps),
                angular=self._new("geometry_msgs/msg/Vector3", z=turn),
            )
            if plan.type_name.endswith("TwistStamped"):
                message = self._new(plan.type_name, header=header, twist=message)
        return ros_types.serialise(message, plan.type_name, self._encoding)


def _make(encoding: Encoding, type_name: str, /, **fields: Any) -> Any:
    return ros_types.new(type_name, encoding, **fields)
