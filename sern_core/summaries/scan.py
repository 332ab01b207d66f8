"""A 2-D scan of a 3-D cloud: S_2D(r, θ) = min_z L_3D(r, θ, z) (paper, perception and planning).

As printed the minimum is taken over z, "the lowest point (highest obstruction)". What a planner needs is the nearest
thing in its way at each bearing, so: the ground is removed, a band of heights is kept (`obstacles.Band`), the nearest
range at each bearing is the answer, and a drop-off is as lethal as a wall.

    header | angle_min | angle_max | angle_increment | time_increment | scan_time | range_min | range_max (float32) |
    ranges[] | intensities[]
"""

import math
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sern_core.summaries.bodies import BodyWriter
from sern_core.summaries.clouds import read_cloud
from sern_core.summaries.obstacles import Band, ObstacleFinder
from sern_core.vocabulary.errors import UsageError
from sern_core.vocabulary.types import Encoding

SCAN_TYPE: Final = "sensor_msgs/msg/LaserScan"
MAX_BEAMS: Final = 7200


@dataclass(frozen=True, slots=True)
class ScanParams:
    """`beams` equal bearings around the origin, the first at -π; bearing i covers half a step to either side."""

    band: Band = field(default_factory=Band)
    beams: int = 720


def nearest_ranges(points: NDArray[np.float64], beams: int) -> NDArray[np.float32]:
    """(beams,) distance in metres of the nearest of (n, 2) points at each bearing; inf where none is (REP 117)."""
    ranges = np.full(beams, np.inf)
    bearings = np.arctan2(points[:, 1], points[:, 0])
    bins = np.floor((bearings + math.pi) * (beams / (2 * math.pi)) + 0.5).astype(np.intp) % beams
    np.minimum.at(ranges, bins, np.hypot(points[:, 0], points[:, 1]))
    return ranges.astype(np.float32)


class ScanMaker:
    """Makes the scans of one topic's clouds."""

    def __init__(self, params: ScanParams) -> None:
        """UsageError for a number of beams outside 4 to 7200."""
        if not 4 <= params.beams <= MAX_BEAMS:
            raise UsageError(f"{params.beams} beams; 4 to {MAX_BEAMS} make a scan")
        self.params = params
        self._finder = ObstacleFinder(params.band)

    def scan(self, body: bytes, encoding: Encoding) -> bytes:
        """A LaserScan body of a PointCloud2 body, with its stamp and frame. BodyError."""
        cloud = read_cloud(body, encoding)
        found = self._finder.find(cloud)
        beams = self.params.beams
        ranges = nearest_ranges(np.concatenate((found.obstacles, found.drop_offs)), beams)
        step_rad = 2 * math.pi / beams
        writer = BodyWriter(encoding)
        writer.header(cloud.header)
        writer.f32(-math.pi)
        writer.f32(-math.pi + (beams - 1) * step_rad)
        writer.f32(step_rad)
        writer.f32(0.0)  # the beams of a spinning LiDAR are of different times; the cloud does not say which
        writer.f32(0.0)
        # A drop-off is set before the point that showed it, so it may be nearer than any point that is taken.
        writer.f32(0.0)
        writer.f32(self.params.band.max_range_m)
        writer.array(ranges.astype("<f4").tobytes(), 4)
        writer.array(b"", 4)
        return writer.body()
