"""Messages about robots and their twins: from bodies to motions and plans, and back."""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, Final, NamedTuple

import numpy as np

from sern_core.vocabulary.errors import BodyError, ConfigError
from sern_core.vocabulary.names import plain_type
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_types
from sern_runtime.ros_geometry import angles_rad, pose
from sern_twin.fixes import Fix
from sern_twin.geodesy import UNITY_FROM_ENU
from sern_twin.motion import Motion, Twist

ODOMETRY: Final = "nav_msgs/msg/Odometry"
FIX: Final = "sensor_msgs/msg/NavSatFix"
PATH: Final = "nav_msgs/msg/Path"
TRAJECTORY: Final = "trajectory_msgs/msg/MultiDOFJointTrajectory"
POSE: Final = "geometry_msgs/msg/PoseStamped"
FLOAT: Final = "std_msgs/msg/Float32"
DIAGNOSTICS: Final = "diagnostic_msgs/msg/DiagnosticArray"
MOST_PLAN_BYTES: Final = 512 * 1024
"""About 7000 poses, which take 50 ms to read. All twins wait for it."""
UNBOUNDED_M2: Final = 1e6
"""The variance of what is passed on as it came: height, roll, pitch."""


class Pose(NamedTuple):
    """`stamp_ns`: of the robot's clock."""

    stamp_ns: int
    frame_id: str
    child_frame_id: str
    motion: Motion
    z_m: float


class Planned(NamedTuple):
    """Places of a plan in order; `times_ns` of the robot's clock, None where the plan has none."""

    frame_id: str
    places: tuple[tuple[float, float], ...]
    times_ns: tuple[int, ...] | None


def read_pose(body: bytes, encoding: Encoding) -> Pose:
    """A nav_msgs/Odometry. BodyError: it is none."""
    message = read_message(body, ODOMETRY, encoding)
    pose, twist = message.pose.pose, message.twist.twist
    motion = Motion(
        pose.position.x, pose.position.y, angles_rad(pose.orientation)[2],
        Twist(twist.linear.x, twist.linear.y, twist.angular.z),
    )  # fmt: skip
    return Pose(
        stamp_of(message.header.stamp), message.header.frame_id, message.child_frame_id, motion, pose.position.z
    )


class Said(NamedTuple):
    """A fix of a satellite receiver. `stamp_ns`: of the robot's clock."""

    stamp_ns: int
    frame_id: str
    fix: Fix


def read_fix(body: bytes, encoding: Encoding) -> Said:
    """A sensor_msgs/NavSatFix. BodyError: it is none."""
    message = read_message(body, FIX, encoding)
    fix = Fix(message.latitude, message.longitude, message.altitude, message.status.status >= 0)
    return Said(stamp_of(message.header.stamp), message.header.frame_id, fix)


def read_plan(body: bytes, type_name: str, encoding: Encoding, *, taken_ns: int) -> Planned:
    """A nav_msgs/Path, of which one whose stamps do not all rise has no times, or a MultiDOFJointTrajectory, which
    begins when it was taken if it says no other time. BodyError: it is none, or too large."""
    if len(body) > MOST_PLAN_BYTES:
        raise BodyError(f"a plan of {len(body)} bytes: {MOST_PLAN_BYTES} at most, so publish fewer of its poses")
    if plain_type(type_name) == plain_type(TRAJECTORY):
        return _read_trajectory(read_message(body, TRAJECTORY, encoding), taken_ns)
    message = read_message(body, PATH, encoding)
    places = tuple((each.pose.position.x, each.pose.position.y) for each in message.poses)
    times_ns = tuple(stamp_of(each.header.stamp) for each in message.poses)
    timed = len(times_ns) > 1 and times_ns[0] > 0 and all(a < b for a, b in pairwise(times_ns))
    return Planned(message.header.frame_id, places, times_ns if timed else None)


def _read_trajectory(message: Any, taken_ns: int) -> Planned:
    """The places of the first joint: that of the base in the world."""
    begin_ns = stamp_of(message.header.stamp) or taken_ns
    if not all(point.transforms for point in message.points):
        raise BodyError("a trajectory with a point that has no transform")
    places = [point.transforms[0].translation for point in message.points]
    times_ns = tuple(begin_ns + stamp_of(point.time_from_start) for point in message.points)
    return Planned(message.header.frame_id, tuple((place.x, place.y) for place in places), times_ns)


def read_message(body: bytes, type_name: str, encoding: Encoding) -> Any:
    """A body as a message. BodyError: it is none of that type."""
    try:
        return ros_types.deserialise(body, type_name, encoding)
    except ConfigError as error:
        raise BodyError(str(error)) from error


def stamp_of(stamp: Any) -> int:
    """A ROS time in nanoseconds."""
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


class Writer:
    """Bodies in one encoding."""

    def __init__(self, encoding: Encoding) -> None:
        self._encoding = encoding

    def odometry(
        self, motion: Motion, error_m: float, *, z_m: float, stamp_ns: int, frame_id: str, child_frame_id: str
    ) -> bytes:
        """`error_m`, a bound, is two sigmas of x and of y; the yaw is not bounded, and has a variance of π²."""
        covariance = np.zeros(36)
        covariance[[0, 7]] = (error_m / 2) ** 2
        covariance[[14, 21, 28]] = UNBOUNDED_M2
        covariance[35] = math.pi**2
        twist = motion.twist
        return self._body(
            ODOMETRY,
            header=self._header(stamp_ns, frame_id),
            child_frame_id=child_frame_id,
            pose=self._new("geometry_msgs/msg/PoseWithCovariance", pose=self._pose(motion, z_m), covariance=covariance),
            twist=self._new(
                "geometry_msgs/msg/TwistWithCovariance",
                twist=self._new(
                    "geometry_msgs/msg/Twist",
                    linear=self._vector(twist.forward_mps, twist.left_mps, 0.0),
                    angular=self._vector(0.0, 0.0, twist.yaw_radps),
                ),
                covariance=np.zeros(36),
            ),
        )

    def path(self, motions: Sequence[Motion], *, z_m: float, stamps_ns: Sequence[int], frame_id: str) -> bytes:
        poses = [
            self._new(
                "geometry_msgs/msg/PoseStamped", header=self._header(stamp_ns, frame_id), pose=self._pose(motion, z_m)
            )
            for motion, stamp_ns in zip(motions, stamps_ns, strict=True)
        ]
        return self._body(PATH, header=self._header(stamps_ns[0], frame_id), poses=poses)

    def unity(self, motion: Motion, *, z_m: float, stamp_ns: int, frame_id: str) -> bytes:
        """A PoseStamped in Unity's axes: x east, y up, z north. A body looks along z there, and turns clockwise."""
        x_m, y_m, north_m = (float(value) for value in UNITY_FROM_ENU.points((motion.x_m, motion.y_m, z_m)))
        half = (math.pi / 2 - motion.yaw_rad) / 2
        pose = self._new(
            "geometry_msgs/msg/Pose",
            position=self._new("geometry_msgs/msg/Point", x=x_m, y=y_m, z=north_m),
            orientation=self._new("geometry_msgs/msg/Quaternion", x=0.0, y=math.sin(half), z=0.0, w=math.cos(half)),
        )
        return self._body(POSE, header=self._header(stamp_ns, frame_id), pose=pose)

    def number(self, value: float) -> bytes:
        return self._body(FLOAT, data=value)

    def status(self, name: str, level: int, text: str, values: Sequence[tuple[str, str]], *, stamp_ns: int) -> bytes:
        """`level`: 0 OK, 1 warning, 2 error, 3 stale."""
        pairs = [self._new("diagnostic_msgs/msg/KeyValue", key=key, value=value) for key, value in values]
        status = self._new(
            "diagnostic_msgs/msg/DiagnosticStatus",
            level=level, name=f"twin: {name}", message=text, hardware_id=name, values=pairs,
        )  # fmt: skip
        return self._body(DIAGNOSTICS, header=self._header(stamp_ns, ""), status=[status])

    def _pose(self, motion: Motion, z_m: float) -> Any:
        return pose(self._encoding, motion.x_m, motion.y_m, z_m, motion.yaw_rad)

    def _vector(self, x: float, y: float, z: float) -> Any:
        return self._new("geometry_msgs/msg/Vector3", x=x, y=y, z=z)

    def _header(self, stamp_ns: int, frame_id: str) -> Any:
        return ros_types.header(stamp_ns, frame_id, self._encoding)

    def _new(self, type_name: str, **fields: Any) -> Any:
        return ros_types.new(type_name, self._encoding, **fields)

    def _body(self, type_name: str, **fields: Any) -> bytes:
        return ros_types.serialise(self._new(type_name, **fields), type_name, self._encoding)
