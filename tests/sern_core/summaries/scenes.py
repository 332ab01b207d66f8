"""Clouds, scans and grids as ROS bodies, made by rosbags' serialisers: what the readers under test are held against."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_types

ENCODINGS = (Encoding.ROS1, Encoding.CDR)
STAMP_NS = 1_700_000_123_456_789_012
CLOUD, GRID = "sensor_msgs/msg/PointCloud2", "nav_msgs/msg/OccupancyGrid"
SCAN, UPDATE, TF = "sensor_msgs/msg/LaserScan", "map_msgs/msg/OccupancyGridUpdate", "tf2_msgs/msg/TFMessage"
DATATYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}


def read(body: bytes, type_name: str, encoding: Encoding) -> Any:
    """What rosbags reads."""
    return ros_types.deserialise(body, type_name, encoding)


def write(message: Any, type_name: str, encoding: Encoding) -> bytes:
    return ros_types.serialise(message, type_name, encoding)


def cloud_message(
    points: NDArray[Any],
    encoding: Encoding,
    *,
    frame_id: str = "velodyne",
    height: int = 1,
    row_padding: int = 0,
    bigendian: bool = False,
) -> Any:
    """A PointCloud2 message object of a structured array; its padding and offsets are the array's own."""
    names = points.dtype.names or ()
    fields = []
    for name in names:
        kind, offset = points.dtype.fields[name][:2]  # type: ignore[index]
        base, count = (kind.subdtype[0], kind.shape[0]) if kind.subdtype else (kind, 1)
        datatype = DATATYPES[base.str[1:]]
        fields.append(
            ros_types.new(
                "sensor_msgs/msg/PointField", encoding, name=name, offset=offset, datatype=datatype, count=count
            )
        )
    width = len(points) // height
    step = points.dtype.itemsize
    rows = np.frombuffer(points.tobytes(), np.uint8).reshape(height, width * step)
    data = np.pad(rows, ((0, 0), (0, row_padding)), constant_values=0xEE).reshape(-1)
    return ros_types.new(
        CLOUD,
        encoding,
        header=ros_types.header(STAMP_NS, frame_id, encoding, 7),
        height=height,
        width=width,
        fields=fields,
        is_bigendian=bigendian,
        point_step=step,
        row_step=width * step + row_padding,
        data=data,
        is_dense=False,
    )


def cloud_body(points: NDArray[Any], encoding: Encoding, **options: Any) -> bytes:
    return write(cloud_message(points, encoding, **options), CLOUD, encoding)


def structured(xyz: NDArray[Any], dtype: Any = None) -> NDArray[Any]:
    """Points with x, y, z, and a `number` that tells them apart."""
    points = np.zeros(len(xyz), dtype or [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("number", "<u4")])
    points["x"], points["y"], points["z"] = xyz[:, 0], xyz[:, 1], xyz[:, 2]
    points["number"] = np.arange(len(xyz))
    return points


def records(cloud: Any) -> NDArray[Any]:
    """The points of a PointCloud2 message without row padding, by its own fields and offsets."""
    kinds = {code: kind for kind, code in DATATYPES.items()}
    order = ">" if cloud.is_bigendian else "<"
    dtype = np.dtype(
        {
            "names": [field.name for field in cloud.fields],
            "formats": [
                order + kinds[field.datatype] if field.count == 1 else (order + kinds[field.datatype], (field.count,))
                for field in cloud.fields
            ],
            "offsets": [field.offset for field in cloud.fields],
            "itemsize": cloud.point_step,
        }
    )
    return np.frombuffer(cloud.data.tobytes(), dtype)


def xyz_of(points: NDArray[Any]) -> NDArray[np.float64]:
    return np.stack([points[name].astype(np.float64) for name in "xyz"], axis=1)
