"""Messages that a robot's graph has, as bodies."""

import math
from typing import Any

import numpy as np

from sern_client.endpoints.clouds import cloud_body
from sern_client.navigation.action import ACTION, Types
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_types
from sern_twin.world.grid import Grid

CDR = Encoding.CDR


def new(type_name: str, **fields: Any) -> Any:
    return ros_types.new(type_name, CDR, **fields)


def body(type_name: str, **fields: Any) -> bytes:
    return ros_types.serialise(new(type_name, **fields), type_name, CDR)


def pose(x_m: float, y_m: float, yaw_rad: float | None = 0.0) -> Any:
    turn = {} if yaw_rad is None else {"z": math.sin(yaw_rad / 2), "w": math.cos(yaw_rad / 2)}
    return new(
        "geometry_msgs/msg/Pose",
        position=new("geometry_msgs/msg/Point", x=x_m, y=y_m),
        orientation=new("geometry_msgs/msg/Quaternion", **turn),
    )


def odometry(
    stamp_ns: int, x_m: float, y_m: float, yaw_rad: float, *, frame_id: str = "map", speed: float = 0.0
) -> bytes:
    twist = new("geometry_msgs/msg/Twist", linear=new("geometry_msgs/msg/Vector3", x=speed))
    return body(
        "nav_msgs/msg/Odometry",
        header=ros_types.header(stamp_ns, frame_id, CDR),
        pose=new("geometry_msgs/msg/PoseWithCovariance", pose=pose(x_m, y_m, yaw_rad)),
        twist=new("geometry_msgs/msg/TwistWithCovariance", twist=twist),
    )


def cloud(stamp_ns: int, points: Any, frame_id: str = "velodyne") -> bytes:
    return cloud_body(np.asarray(points, np.float32), stamp_ns, frame_id, CDR, 1)


def grid_map(grid: Grid, cells: Any, *, origin: Any = None) -> bytes:
    info = new(
        "nav_msgs/msg/MapMetaData", resolution=grid.cell_m, width=grid.columns, height=grid.rows,
        origin=pose(grid.west_m, grid.south_m) if origin is None else origin,
    )  # fmt: skip
    header = ros_types.header(0, grid.frame_id, CDR)
    return body("nav_msgs/msg/OccupancyGrid", header=header, info=info, data=np.asarray(cells, np.int8).reshape(-1))


def update(column: int, row: int, cells: Any, *, frame_id: str = "map") -> bytes:
    values = np.asarray(cells, np.int8)
    return body(
        "map_msgs/msg/OccupancyGridUpdate", header=ros_types.header(0, frame_id, CDR), x=column, y=row,
        width=values.shape[1], height=values.shape[0], data=values.reshape(-1),
    )  # fmt: skip


def goal(x_m: float, y_m: float, yaw_rad: float | None = None, *, frame_id: str = "map") -> Any:
    return new("geometry_msgs/msg/PoseStamped", header=ros_types.header(0, frame_id, CDR), pose=pose(x_m, y_m, yaw_rad))


def goal_body(x_m: float, y_m: float, *, frame_id: str = "map") -> bytes:
    return ros_types.serialise(goal(x_m, y_m, frame_id=frame_id), "geometry_msgs/msg/PoseStamped", CDR)


def link(connected: bool) -> bytes:
    return body("diagnostic_msgs/msg/DiagnosticStatus", level=0 if connected else 2)


def goal_request(types: Types, uuid: bytes, x_m: float, y_m: float) -> Any:
    """A request of NavigateToPose's send_goal, as a message."""
    kind = types.send_goal.request
    ident = ros_types.new_in(kind.store, "unique_identifier_msgs/msg/UUID", uuid=np.frombuffer(uuid, np.uint8))
    return ros_types.new_in(
        kind.store, kind.name, goal_id=ident, goal=ros_types.new_in(kind.store, f"{ACTION}_Goal", pose=goal(x_m, y_m))
    )


def no_points(stamp_ns: int) -> bytes:
    """A cloud without any."""
    name = "sensor_msgs/msg/PointCloud2"
    return body(name, header=ros_types.header(stamp_ns, "velodyne", CDR), height=1, point_step=16)
