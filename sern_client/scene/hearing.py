"""What a site's own topics say of the scene: where its scanners are, what they see, what people add."""

import math
from collections import Counter, deque
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from sern_client.endpoints.twin.bodies import Pose as Said
from sern_client.endpoints.twin.bodies import read_pose
from sern_client.scene.bodies import Marker, Scan, read_marker, read_scan
from sern_client.scene.options import ScannerOptions
from sern_core.vocabulary.types import Encoding
from sern_twin.world.grid import Grid

POSES: Final = 200
"""Poses of a robot that are kept: 4 s at 50 Hz."""
APART_S: Final = 0.2
"""How far a scan may be from the poses that it lies between."""
MOST_MARKERS: Final = 200


class Unused(StrEnum):
    """Why something that was heard is not in the scene."""

    FRAME = "frame"
    """It is in another frame than the grid."""
    NO_POSE = "no_pose"
    """Where the scanner was then is not known."""
    SUPERSEDED = "superseded"
    """A scan before the last one of a turn."""
    FULL = "full"
    """There are too many obstacles, or discrepancies of other sites."""
    UNREADABLE = "unreadable"


@dataclass(frozen=True, slots=True)
class Placed:
    """A scan and where its scanner was: east, north, yaw."""

    pose: tuple[float, float, float]
    scan: Scan


class Scanner:
    """One scanner: poses and scans in, the last scan with its place out."""

    def __init__(self, options: ScannerOptions, grid: Grid, unused: Counter[Unused]) -> None:
        self.options = options
        self._grid = grid
        self._unused = unused
        self._poses: deque[Said] = deque(maxlen=POSES)
        self._scan: Scan | None = None
        self.place_m: tuple[float, float] | None = None
        """Where it was when it scanned last."""

    def pose(self, body: bytes, encoding: Encoding) -> None:
        """BodyError: it is none."""
        said = read_pose(body, encoding)
        if said.frame_id != self._grid.frame_id:
            self._unused[Unused.FRAME] += 1
            return
        if self._poses and said.stamp_ns <= self._poses[-1].stamp_ns:
            self._poses.clear()  # its clock was set back
        self._poses.append(said)

    def scan(self, body: bytes, encoding: Encoding) -> None:
        """BodyError: it is none."""
        scan = read_scan(body, encoding)
        if self._scan is not None:
            self._unused[Unused.SUPERSEDED] += 1
        self._scan = scan

    def take(self) -> Placed | None:
        """The last scan since the last call, once there is a pose after it."""
        scan = self._scan
        if scan is None:
            return None
        if self._poses and self._poses[-1].stamp_ns < scan.stamp_ns - APART_S * 1e9:
            return None  # its pose is under way
        self._scan = None
        where = self._at(scan.stamp_ns)
        if where is None:
            self._unused[Unused.NO_POSE] += 1
            return None
        self.place_m = where[:2]
        return Placed(where, scan)

    def _at(self, stamp_ns: int) -> tuple[float, float, float] | None:
        near = sorted(self._poses, key=lambda said: abs(said.stamp_ns - stamp_ns))[:2]
        if not near or abs(near[0].stamp_ns - stamp_ns) > APART_S * 1e9:
            return None
        first = near[0].motion
        x_m, y_m, yaw_rad = first.x_m, first.y_m, first.yaw_rad
        if len(near) == 2 and near[0].stamp_ns != near[1].stamp_ns:
            other = near[1].motion
            share = (stamp_ns - near[0].stamp_ns) / (near[1].stamp_ns - near[0].stamp_ns)
            share = min(max(share, -1.0), 1.0)
            x_m += share * (other.x_m - first.x_m)
            y_m += share * (other.y_m - first.y_m)
            yaw_rad += share * math.remainder(other.yaw_rad - first.yaw_rad, math.tau)
        options = self.options
        cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
        return (
            x_m + cos * options.x_m - sin * options.y_m,
            y_m + sin * options.x_m + cos * options.y_m,
            yaw_rad + options.yaw_rad,
        )


class Obstacles:
    """What people add: markers by their namespace and number."""

    def __init__(self, grid: Grid, unused: Counter[Unused]) -> None:
        self._grid = grid
        self._unused = unused
        self.markers: dict[tuple[str, int], Marker] = {}
        self.changed = False

    def heard(self, body: bytes, encoding: Encoding) -> None:
        """BodyError: it is no marker that is understood."""
        marker = read_marker(body, encoding)
        if marker.key is None:
            self.changed = self.changed or bool(self.markers)
            self.markers.clear()
        elif marker.outline is None:
            self.changed = self.markers.pop(marker.key, None) is not None or self.changed
        elif marker.frame_id != self._grid.frame_id:
            self._unused[Unused.FRAME] += 1
        elif marker.key not in self.markers and len(self.markers) >= MOST_MARKERS:
            self._unused[Unused.FULL] += 1
        else:
            self.markers[marker.key] = marker
            self.changed = True
