"""The messages of three sensors, as ROS 2 serialises them, and what tells one of them from the next.

A camera's image comes through JPEG and a cloud through voxels, so pixels and points cannot say which message it is.
What survives is the header: its `frame_id` has the number of the message and when it was handed over.
"""

from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_types

WIDTH, HEIGHT = 640, 480
OFFSETS: Final = {"x": 0, "y": 4, "z": 8, "rgb": 16}
POINT: Final = np.dtype(
    {"names": [*OFFSETS], "formats": ["<f4"] * len(OFFSETS), "offsets": [*OFFSETS.values()], "itemsize": 24}
)
"""The layout of depth cameras; 7.4 MB in all."""
BEAMS: Final = 1080
NOISE: Final = 6.0
"""Standard deviation of a pixel, of 255: an image without any is too easily compressed."""
FRAMES: Final = 8
"""Images that differ in their noise: none can be remembered."""
_TAG_AT: Final = 16
"""After encapsulation, stamp, and length of the text."""
_TAG: Final = "{number:08d} {stamp_ns:020d}"
_TAG_BYTES: Final = 29


class Sensor(IntEnum):
    SCAN = 0
    CAMERA = 1
    CLOUD = 2


class Topic(NamedTuple):
    name: str
    type_name: str
    rate_hz: float


TOPICS: Final = {
    Sensor.SCAN: Topic("/scan", "sensor_msgs/msg/LaserScan", 8.0),
    Sensor.CAMERA: Topic("/camera/image_raw", "sensor_msgs/msg/Image", 11.9),
    Sensor.CLOUD: Topic("/points", "sensor_msgs/msg/PointCloud2", 12.0),
}


@dataclass(frozen=True)
class Tag:
    """Which message it is; 0 is a hello before the run."""

    number: int
    stamp_ns: int


def tagged(body: bytes, tag: Tag) -> bytes:
    """The same message with that tag."""
    text = _TAG.format(number=tag.number, stamp_ns=tag.stamp_ns).encode()
    return b"".join((body[:_TAG_AT], text, memoryview(body)[_TAG_AT + _TAG_BYTES :]))


def tag_of(body: bytes | memoryview) -> Tag:
    """ValueError when it has none."""
    number, _, stamp_ns = bytes(body[_TAG_AT : _TAG_AT + _TAG_BYTES]).partition(b" ")
    return Tag(int(number), int(stamp_ns))


def bodies(sensor: Sensor, seed: int = 1) -> list[bytes]:
    """Messages of a sensor in a room of 8 x 6 m, to be sent one after the other."""
    match sensor:
        case Sensor.SCAN:
            return [_scan()]
        case Sensor.CAMERA:
            return _images(np.random.default_rng(seed))
        case Sensor.CLOUD:
            return [_cloud(np.random.default_rng(seed))]


def _message(sensor: Sensor, **fields: Any) -> bytes:
    header = ros_types.header(0, _TAG.format(number=0, stamp_ns=0), Encoding.CDR, 0)
    type_name = TOPICS[sensor].type_name
    message = ros_types.new(type_name, Encoding.CDR, header=header, **fields)
    return ros_types.serialise(message, type_name, Encoding.CDR)


def _scan() -> bytes:
    bearings = np.linspace(-np.pi, np.pi, BEAMS, endpoint=False)
    ranges = np.minimum(
        4.0 / np.maximum(np.abs(np.cos(bearings)), 1e-6), 3.0 / np.maximum(np.abs(np.sin(bearings)), 1e-6)
    )
    return _message(
        Sensor.SCAN,
        angle_min=-np.pi,
        angle_max=np.pi,
        angle_increment=2 * np.pi / BEAMS,
        time_increment=0.0,
        scan_time=0.1,
        range_min=0.1,
        range_max=30.0,
        ranges=ranges.astype(np.float32),
        intensities=np.full(BEAMS, 100.0, np.float32),
    )


def _depths() -> NDArray[np.float64]:
    """Metres along the axis of a camera 1 m above the ground, by pixel: a room with boxes in it."""
    columns, rows = np.meshgrid((np.arange(WIDTH) - WIDTH / 2) / 525.0, (np.arange(HEIGHT) - HEIGHT / 2) / 525.0)
    depths = np.full((HEIGHT, WIDTH), 6.0)  # the wall in front
    with np.errstate(divide="ignore"):
        for surface in (1.0 / rows, -1.5 / rows, 4.0 / np.abs(columns)):  # floor, ceiling, walls at the sides
            depths = np.where(surface > 0, np.minimum(depths, surface), depths)
    for left_m, right_m, top_m, depth_m in ((-1.2, -0.4, 0.2, 3.0), (0.3, 1.0, -0.3, 4.2), (1.1, 1.6, 0.5, 2.2)):
        inside = (columns * depth_m > left_m) & (columns * depth_m < right_m) & (rows * depth_m > top_m)
        depths = np.where(inside, np.minimum(depths, depth_m), depths)
    return depths


def _images(chance: np.random.Generator) -> list[bytes]:
    depths = _depths()
    columns, rows = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    texture = 24.0 * np.sin(columns / 5.0) * np.sin(rows / 7.0) + 30.0 * ((columns // 16 + rows // 16) % 2)
    scene = np.stack([250.0 - 30.0 * depths, 220.0 - 25.0 * depths, 180.0 - 15.0 * depths], axis=-1)
    scene += texture[:, :, np.newaxis]
    frames = [scene + chance.normal(0.0, NOISE, scene.shape) for _ in range(FRAMES)]
    return [
        _message(
            Sensor.CAMERA,
            height=HEIGHT,
            width=WIDTH,
            encoding="rgb8",
            is_bigendian=0,
            step=3 * WIDTH,
            data=np.clip(frame, 0, 255).astype(np.uint8).reshape(-1),
        )
        for frame in frames
    ]


def _cloud(chance: np.random.Generator) -> bytes:
    depths = _depths()
    depths = depths * (1.0 + chance.normal(0.0, 0.003, depths.shape))
    columns, rows = np.meshgrid((np.arange(WIDTH) - WIDTH / 2) / 525.0, (np.arange(HEIGHT) - HEIGHT / 2) / 525.0)
    points = np.zeros(WIDTH * HEIGHT, POINT)
    points["x"], points["y"], points["z"] = (columns * depths).ravel(), (rows * depths).ravel(), depths.ravel()
    points["rgb"] = chance.integers(0, 2**24, WIDTH * HEIGHT).astype(np.uint32).view(np.float32)
    fields = [
        ros_types.new("sensor_msgs/msg/PointField", Encoding.CDR, name=name, offset=offset, datatype=7, count=1)
        for name, offset in OFFSETS.items()
    ]
    return _message(
        Sensor.CLOUD,
        height=HEIGHT,
        width=WIDTH,
        fields=fields,
        is_bigendian=False,
        point_step=POINT.itemsize,
        row_step=WIDTH * POINT.itemsize,
        data=np.frombuffer(points.tobytes(), np.uint8),
        is_dense=True,
    )
