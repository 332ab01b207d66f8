"""Messages about a scene: scans and markers in, maps and discrepancies out."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final, NamedTuple

import numpy as np

from sern_client.endpoints.twin.bodies import ODOMETRY, read_message, stamp_of
from sern_core.vocabulary.errors import BodyError
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_types
from sern_runtime.map_bodies import GRID, UPDATE, MapWriter
from sern_twin.world.discrepancy import DiscrepancyKind, SeenDiscrepancy
from sern_twin.world.grid import Floats

SCAN: Final = "sensor_msgs/msg/LaserScan"
MARKER: Final = "visualization_msgs/msg/Marker"
MARKERS: Final = "visualization_msgs/msg/MarkerArray"
MOST_SCAN_BYTES: Final = 512 * 1024
CORNERS: Final = 16
"""A cylinder's outline has so many."""
COLOURS: Final = {DiscrepancyKind.PHANTOM: (0.58, 0.2, 0.83), DiscrepancyKind.UNKNOWN_OBSTACLE: (0.86, 0.15, 0.15)}
"""Red, green and blue of a discrepancy."""
HEIGHT_M: Final = 1.0
_CUBE, _SPHERE, _CYLINDER, _TEXT = 1, 2, 3, 9
_ADD, _DELETE, _DELETE_ALL = 0, 2, 3
__all__ = [
    "COLOURS",
    "GRID",
    "MARKER",
    "MARKERS",
    "ODOMETRY",
    "SCAN",
    "UPDATE",
    "Marker",
    "Scan",
    "Writer",
    "read_marker",
    "read_scan",
]


class Scan(NamedTuple):
    """Angles [rad] and ranges [m], (n,), at a stamp of the robot's clock."""

    stamp_ns: int
    angles_rad: Floats
    ranges_m: Floats
    least_m: float
    most_m: float


@dataclass(frozen=True, slots=True)
class Marker:
    """An obstacle that somebody adds (`outline` [m], (n, 2)), or deletes; `key` None: deletes all."""

    key: tuple[str, int] | None
    frame_id: str
    outline: Floats | None
    middle_m: tuple[float, float] = (0.0, 0.0)


def read_scan(body: bytes, encoding: Encoding) -> Scan:
    """A sensor_msgs/LaserScan. BodyError: it is none, or too large."""
    if len(body) > MOST_SCAN_BYTES:
        raise BodyError(f"a scan of {len(body)} bytes: {MOST_SCAN_BYTES} at most")
    message = read_message(body, SCAN, encoding)
    ranges = np.asarray(message.ranges, np.float64)
    angles = message.angle_min + message.angle_increment * np.arange(len(ranges))
    if not 0 <= message.range_min < message.range_max < math.inf:
        raise BodyError(f"a scan of ranges from {message.range_min} to {message.range_max} m")
    return Scan(stamp_of(message.header.stamp), angles, ranges, message.range_min, message.range_max)


def read_marker(body: bytes, encoding: Encoding) -> Marker:
    """A visualization_msgs/Marker that is a cube, sphere or cylinder. BodyError: it is none."""
    message = read_message(body, MARKER, encoding)
    if message.action == _DELETE_ALL:
        return Marker(None, message.header.frame_id, None)
    key = (str(message.ns), int(message.id))
    if message.action == _DELETE:
        return Marker(key, message.header.frame_id, None)
    if message.action != _ADD or message.type not in (_CUBE, _SPHERE, _CYLINDER):
        raise BodyError(f"a marker of type {message.type} and action {message.action}: add cubes, spheres, cylinders")
    place, turn, size = message.pose.position, message.pose.orientation, message.scale
    numbers = (place.x, place.y, turn.x, turn.y, turn.z, turn.w, size.x, size.y)
    if not (all(map(math.isfinite, numbers)) and size.x > 0 and size.y > 0):
        raise BodyError("a marker whose place or size is not finite, or is nothing")
    yaw_rad = math.atan2(2 * (turn.w * turn.z + turn.x * turn.y), 1 - 2 * (turn.y**2 + turn.z**2))
    if message.type == _CUBE:
        unit = np.array([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)])
    else:
        around = np.linspace(0.0, 2 * math.pi, CORNERS, endpoint=False)
        unit = 0.5 * np.stack((np.cos(around), np.sin(around)), axis=1)
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    outline = unit * (size.x, size.y) @ np.array([(cos, sin), (-sin, cos)]) + (place.x, place.y)
    return Marker(key, message.header.frame_id, outline, (place.x, place.y))


class Writer:
    """Discrepancies of a scene as messages, in the frame and encoding of its map."""

    def __init__(self, maps: MapWriter, encoding: Encoding) -> None:
        self._maps = maps
        self._encoding = encoding

    def discrepancies(self, found: Sequence[SeenDiscrepancy], *, stamp_ns: int) -> bytes:
        """A visualization_msgs/MarkerArray of all there are, which takes the place of the one before: of each a
        cylinder, whose namespace is its kind, and its words."""
        header = self._maps.header(stamp_ns)
        new = partial(ros_types.new, MARKER, self._encoding, header=header)
        markers = [new(action=_DELETE_ALL)]
        for number, thing in enumerate(found):
            red, green, blue = COLOURS[thing.kind]
            for shape, namespace, up_m, size, alpha, text in (
                (_CYLINDER, thing.kind.value, HEIGHT_M / 2, (2 * thing.radius_m, HEIGHT_M), 0.5, ""),
                (_TEXT, f"{thing.kind.value}_text", HEIGHT_M + 0.2, (0.0, 0.3), 1.0, thing.says),
            ):
                markers.append(
                    new(
                        ns=namespace,
                        id=number,
                        type=shape,
                        action=_ADD,
                        pose=self._maps.upright(thing.east_m, thing.north_m, up_m),
                        scale=ros_types.new(
                            "geometry_msgs/msg/Vector3", self._encoding, x=size[0], y=size[0], z=size[1]
                        ),
                        color=ros_types.new("std_msgs/msg/ColorRGBA", self._encoding, r=red, g=green, b=blue, a=alpha),
                        text=text,
                    )
                )
        return ros_types.serialise(ros_types.new(MARKERS, self._encoding, markers=markers), MARKERS, self._encoding)
