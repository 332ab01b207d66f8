"""Bodies that a node of a robot says: commands, paths, maps, what it makes of its goal."""

import math
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from sern_core.vocabulary.types import Encoding
from sern_navigation.collision_monitor import Speed
from sern_navigation.costmap.costs import Costmap
from sern_navigation.scan import ObstacleScan
from sern_runtime import ros_geometry, ros_types
from sern_twin.world.grid import Floats
from sern_twin.world.occupancy import Pose

TWIST: Final = "geometry_msgs/msg/Twist"
TWIST_STAMPED: Final = "geometry_msgs/msg/TwistStamped"
PATH: Final = "nav_msgs/msg/Path"
GRID: Final = "nav_msgs/msg/OccupancyGrid"
DIAGNOSTICS: Final = "diagnostic_msgs/msg/DiagnosticArray"
TRANSFORMS: Final = "tf2_msgs/msg/TFMessage"
POSE: Final = "geometry_msgs/msg/PoseStamped"
SCAN: Final = "sensor_msgs/msg/LaserScan"
SCAN_M: Final = 6.0
"""How far it goes: further away the ground is seen in few places."""
_TRANSLATED: Final = np.concatenate(
    ([0], 1 + 97 * np.arange(252) // 251, [99, 100, -1])
).astype(np.int8)  # fmt: skip
"""Costs as nav2_costmap_2d publishes them: 0 free, 1 to 98, 99 inscribed, 100 lethal, -1 unknown."""


class Writer:
    """Bodies in one encoding, in one frame."""

    def __init__(self, encoding: Encoding, frame_id: str, base_frame: str) -> None:
        self._encoding = encoding
        self._frame_id = frame_id
        self._base_frame = base_frame

    def twist(self, speed: Speed, *, stamp_ns: int, stamped: bool) -> bytes:
        twist = self._new(
            TWIST, linear=self._vector(float(speed[0]), 0.0), angular=self._vector(0.0, 0.0, float(speed[1]))
        )
        if not stamped:
            return ros_types.serialise(twist, TWIST, self._encoding)
        return self._body(TWIST_STAMPED, header=self._header(stamp_ns, self._base_frame), twist=twist)

    def path(self, places: Floats, *, stamp_ns: int) -> bytes:
        """Places (n, 2) or, with a yaw, (n, 3)."""
        header = self._header(stamp_ns, self._frame_id)
        if places.shape[1] == 2 and len(places) > 1:
            steps = np.diff(places, axis=0, append=2 * places[-1:] - places[-2:-1])
            yaws = np.arctan2(steps[:, 1], steps[:, 0])
        else:
            yaws = places[:, 2] if places.shape[1] == 3 else np.zeros(len(places))
        poses = [
            self._new(POSE, header=header, pose=ros_geometry.pose(self._encoding, x, y, yaw_rad=yaw))
            for (x, y), yaw in zip(places[:, :2].tolist(), yaws.tolist(), strict=True)
        ]
        return self._body(PATH, header=header, poses=poses)

    def stamped_pose(self, pose: Pose, *, stamp_ns: int) -> Any:
        """A PoseStamped, as a part of other messages."""
        return self._new(
            POSE,
            header=self._header(stamp_ns, self._frame_id),
            pose=ros_geometry.pose(self._encoding, pose[0], pose[1], yaw_rad=pose[2]),
        )

    def scan(self, scan: ObstacleScan, *, stamp_ns: int) -> bytes:
        """S_2D as a sensor_msgs/LaserScan of the robot's own frame, whose middle is that of the scanner."""
        near = scan.ranges_m <= SCAN_M
        open_to_there = scan.ground_m[:, 1] >= SCAN_M
        ranges = np.where(near, scan.ranges_m, np.where(open_to_there, np.inf, np.nan))
        step_rad = 2 * math.pi / len(ranges)
        return self._body(
            SCAN,
            header=self._header(stamp_ns, self._base_frame),
            angle_min=float(scan.bearings_rad[0]),
            angle_max=float(scan.bearings_rad[-1]),
            angle_increment=step_rad,
            range_min=0.05,
            range_max=SCAN_M,
            ranges=ranges.astype(np.float32),
            intensities=np.empty(0, np.float32),
        )

    def costmap(self, costmap: Costmap, *, stamp_ns: int) -> bytes:
        """A nav_msgs/OccupancyGrid, as Nav2 publishes its costmaps; what the twin adds is in it."""
        grid, encoding = costmap.grid, self._encoding
        costs = np.where(costmap.costs <= 252, np.maximum(costmap.costs, costmap.soft), costmap.costs)
        info = self._new(
            "nav_msgs/msg/MapMetaData",
            map_load_time=ros_types.time_of(stamp_ns, encoding),
            resolution=grid.cell_m,
            width=grid.columns,
            height=grid.rows,
            origin=ros_geometry.pose(encoding, grid.west_m, grid.south_m),
        )
        header = self._header(stamp_ns, self._frame_id)
        return self._body(GRID, header=header, info=info, data=_TRANSLATED[costs].reshape(-1))

    def status(self, level: int, text: str, values: Mapping[str, str], *, stamp_ns: int) -> bytes:
        """`level`: 0 OK, 1 warning, 2 error, 3 stale."""
        pairs = [self._new("diagnostic_msgs/msg/KeyValue", key=key, value=value) for key, value in values.items()]
        status = self._new(
            "diagnostic_msgs/msg/DiagnosticStatus", level=level, name="sern navigation", message=text, values=pairs
        )
        return self._body(DIAGNOSTICS, header=self._header(stamp_ns, ""), status=[status])

    def transform(self, pose: Pose, child_frame: str, *, stamp_ns: int) -> bytes:
        """A tf2_msgs/TFMessage: where another frame's origin is."""
        transform = self._new(
            "geometry_msgs/msg/TransformStamped",
            header=self._header(stamp_ns, self._frame_id),
            child_frame_id=child_frame,
            transform=self._new(
                "geometry_msgs/msg/Transform",
                translation=self._vector(pose[0], pose[1]),
                rotation=ros_geometry.quaternion(self._encoding, pose[2]),
            ),
        )
        return self._body(TRANSFORMS, transforms=[transform])

    def _vector(self, x: float, y: float, z: float = 0.0) -> Any:
        return self._new("geometry_msgs/msg/Vector3", x=x, y=y, z=z)

    def _header(self, stamp_ns: int, frame_id: str) -> Any:
        return ros_types.header(stamp_ns, frame_id, self._encoding)

    def _new(self, type_name: str, **fields: Any) -> Any:
        return ros_types.new(type_name, self._encoding, **fields)

    def _body(self, type_name: str, **fields: Any) -> bytes:
        return ros_types.serialise(self._new(type_name, **fields), type_name, self._encoding)
