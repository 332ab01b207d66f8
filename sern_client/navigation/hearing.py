"""Bodies that a node of a robot hears, as the navigator reads them."""

import math
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sern_client.endpoints.twin.bodies import read_message, stamp_of
from sern_client.navigation.options import Mount
from sern_core.summaries.clouds import read_cloud
from sern_core.vocabulary.errors import BodyError, UsageError
from sern_core.vocabulary.types import Encoding
from sern_navigation.navigator import Goal
from sern_runtime.ros_geometry import angles_rad
from sern_twin.world.grid import Floats, Grid
from sern_twin.world.occupancy import Pose
from sern_twin.world.patches import Cells

CLOUD: Final = "sensor_msgs/msg/PointCloud2"
ODOMETRY: Final = "nav_msgs/msg/Odometry"
GRID: Final = "nav_msgs/msg/OccupancyGrid"
UPDATE: Final = "map_msgs/msg/OccupancyGridUpdate"
GOAL: Final = "geometry_msgs/msg/PoseStamped"
STATUS: Final = "diagnostic_msgs/msg/DiagnosticStatus"
MOST_CELLS: Final = 4_000_000
_LEVEL: Final = math.cos(math.radians(1.0))
"""A map that is turned by more than 2 degrees is not that of a grid."""


@dataclass(frozen=True, slots=True, eq=False)
class HeardCloud:
    """A cloud in the robot's frame, (n, 3) [m], z up from the ground."""

    stamp_ns: int
    frame_id: str
    points_m: Floats


class HeardOdometry(NamedTuple):
    stamp_ns: int
    frame_id: str
    pose: Pose
    roll_rad: float
    pitch_rad: float
    speed: tuple[float, float]
    """Forward [m/s], yaw rate [rad/s]."""


class HeardUpdate(NamedTuple):
    """Cells (rows, columns) of a map, and where they begin."""

    frame_id: str
    column: int
    row: int
    cells: Cells


def read_points(body: bytes, encoding: Encoding, mount: Mount) -> HeardCloud:
    """A sensor_msgs/PointCloud2 in the robot's frame. BodyError: it is none, or has no x, y, z."""
    cloud = read_cloud(body, encoding)
    found = cloud.xyz().astype(np.float64)
    if mount.roll_rad or mount.pitch_rad or mount.yaw_rad:
        found = found @ rotation(mount.roll_rad, mount.pitch_rad, mount.yaw_rad).T
    found = found + np.array((mount.x_m, mount.y_m, mount.z_m))
    return HeardCloud(cloud.header.stamp_ns, cloud.header.frame_id, found)


def read_odometry(body: bytes, encoding: Encoding) -> HeardOdometry:
    """A nav_msgs/Odometry. BodyError: it is none, or its orientation has no length."""
    message = read_message(body, ODOMETRY, encoding)
    place, twist = message.pose.pose.position, message.twist.twist
    roll_rad, pitch_rad, yaw_rad = angles_rad(message.pose.pose.orientation)
    return HeardOdometry(
        stamp_of(message.header.stamp),
        message.header.frame_id,
        (place.x, place.y, yaw_rad),
        roll_rad,
        pitch_rad,
        (twist.linear.x, twist.angular.z),
    )


def read_grid(body: bytes, encoding: Encoding) -> tuple[Grid, Cells]:
    """A nav_msgs/OccupancyGrid, south row first. BodyError: it is none, is turned, or has other cells than it says."""
    message = read_message(body, GRID, encoding)
    info = message.info
    if not 0 < info.width * info.height <= MOST_CELLS:
        raise BodyError(f"a map of {info.width} x {info.height} cells: 1 to {MOST_CELLS} are read")
    if len(message.data) != info.width * info.height:
        raise BodyError(f"a map of {info.width} x {info.height} cells with {len(message.data)} values")
    turn = info.origin.orientation
    if abs(turn.x) + abs(turn.y) > 1e-3 or abs(turn.w) < _LEVEL * math.sqrt(turn.w**2 + turn.z**2) or not turn.w:
        raise BodyError("a map whose origin is turned: publish it along its frame's axes")
    cell_m = round(float(info.resolution), 6)  # it is a float32
    try:
        grid = Grid(
            round(info.origin.position.x, 6), round(info.origin.position.y, 6), cell_m, info.width, info.height,
            frame_id=message.header.frame_id,
        )  # fmt: skip
    except UsageError as error:
        raise BodyError(str(error)) from error
    return grid, np.asarray(message.data, np.int8).reshape(info.height, info.width)


def read_update(body: bytes, encoding: Encoding) -> HeardUpdate:
    """A map_msgs/OccupancyGridUpdate. BodyError: it is none, or has other cells than it says."""
    message = read_message(body, UPDATE, encoding)
    if not 0 < message.width * message.height <= MOST_CELLS or len(message.data) != message.width * message.height:
        raise BodyError(f"an update of {message.width} x {message.height} cells with {len(message.data)} values")
    cells = np.asarray(message.data, np.int8).reshape(message.height, message.width)
    return HeardUpdate(message.header.frame_id, int(message.x), int(message.y), cells)


def read_goal(body: bytes, encoding: Encoding) -> Goal:
    """A geometry_msgs/PoseStamped. BodyError: it is none."""
    return goal_of(read_message(body, GOAL, encoding))


def goal_of(message: Any) -> Goal:
    """The goal of a PoseStamped. An orientation of all zeros looks no way in particular."""
    pose, header = message.pose, message.header
    turn = pose.orientation
    numbers = (turn.x, turn.y, turn.z, turn.w)
    yaw_rad = None if not any(numbers) else angles_rad(turn)[2]
    return Goal(pose.position.x, pose.position.y, yaw_rad, header.frame_id)


def read_connected(body: bytes, encoding: Encoding) -> bool:
    """Whether a diagnostic_msgs/DiagnosticStatus says that a link is there. BodyError: it is none."""
    level = read_message(body, STATUS, encoding).level
    return int.from_bytes(level, "little") == 0 if isinstance(level, bytes) else int(level) == 0


def rotation(roll_rad: float, pitch_rad: float, yaw_rad: float) -> NDArray[np.float64]:
    """Rz(yaw) Ry(pitch) Rx(roll), (3, 3)."""
    (sr, cr), (sp, cp), (sy, cy) = ((math.sin(angle), math.cos(angle)) for angle in (roll_rad, pitch_rad, yaw_rad))
    return np.array(
        [
            (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
            (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
            (-sp, cp * sr, cp * cr),
        ]
    )
