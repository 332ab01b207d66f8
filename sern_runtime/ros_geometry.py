"""Places and directions as parts of ROS messages, and back (REP 103: yaw, pitch, roll; nose down is positive)."""

import math
from typing import Any

from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_types


def quaternion(encoding: Encoding, yaw_rad: float, roll_rad: float = 0.0, pitch_rad: float = 0.0) -> Any:
    """A geometry_msgs/Quaternion."""
    (sr, cr), (sp, cp), (sy, cy) = (
        (math.sin(angle / 2), math.cos(angle / 2)) for angle in (roll_rad, pitch_rad, yaw_rad)
    )
    return ros_types.new(
        "geometry_msgs/msg/Quaternion",
        encoding,
        x=sr * cp * cy - cr * sp * sy,
        y=cr * sp * cy + sr * cp * sy,
        z=cr * cp * sy - sr * sp * cy,
        w=cr * cp * cy + sr * sp * sy,
    )


def pose(
    encoding: Encoding,
    x_m: float,
    y_m: float,
    z_m: float = 0.0,
    yaw_rad: float = 0.0,
    roll_rad: float = 0.0,
    pitch_rad: float = 0.0,
) -> Any:
    """A geometry_msgs/Pose."""
    return ros_types.new(
        "geometry_msgs/msg/Pose",
        encoding,
        position=ros_types.new("geometry_msgs/msg/Point", encoding, x=float(x_m), y=float(y_m), z=float(z_m)),
        orientation=quaternion(encoding, yaw_rad, roll_rad, pitch_rad),
    )


def angles_rad(orientation: Any) -> tuple[float, float, float]:
    """Roll, pitch and yaw of a geometry_msgs/Quaternion of any length; NaN where it has none."""
    x, y, z, w = (float(getattr(orientation, axis)) for axis in "xyzw")
    square = x * x + y * y + z * z + w * w
    if not 0 < square < math.inf:
        return math.nan, math.nan, math.nan
    roll_rad = math.atan2(2 * (w * x + y * z), square - 2 * (x * x + y * y))
    pitch_rad = math.asin(min(1.0, max(-1.0, 2 * (w * y - z * x) / square)))
    return roll_rad, pitch_rad, math.atan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)
