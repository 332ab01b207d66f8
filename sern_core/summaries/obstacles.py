"""Which points of a cloud are in a robot's way: the part that `scan` and `mask` have in common.

The cloud's frame stands upright near the robot, z up. Heights are those above the ground, which is either a plane
`sensor_height_m` below the frame's origin or fitted to each cloud.

    height    what a point is
    > max     overhead: no matter
    min..max  an obstacle
    -drop..min  ground
    < -drop   a drop-off: the beam passed through the place where the ground should have been
"""

from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sern_core.summaries.clouds import Cloud, valid_rows
from sern_core.vocabulary.errors import BodyError

MAX_SLOPE: Final = 0.36
"""tan 20°: a steeper plane is no ground that a wheeled robot stands on, or the frame is not upright."""
_CELL_M: Final = 1.0
_FIT_STEPS: Final = ((5.0, 0.5), (10.0, 0.3), (20.0, 0.2), (20.0, 0.15))
"""(radius, tolerance), both in metres: from the flat patch around the robot outwards."""
_MIN_CELLS: Final = 8
_REUSED_PLANES: Final = 20
"""Clouds that may go by with the last plane found, when none can be fitted (a crowd, a narrow corridor)."""


@dataclass(frozen=True, slots=True)
class Band:
    """What counts as in the way. All in metres; defaults for a robot of a Jackal's size.

    `sensor_height_m`: height of the frame's origin above level ground (0 for a cloud in base_link); None: fit the
    ground. `drop_off_range_m`: how far off a point below the ground is believed; further out a slope looks the same.
    """

    min_height_m: float = 0.10
    max_height_m: float = 1.2
    drop_off_m: float = 0.2
    drop_off_range_m: float = 8.0
    sensor_height_m: float | None = None
    min_range_m: float = 0.4
    max_range_m: float = 30.0


class Plane(NamedTuple):
    """z = slope_x * x + slope_y * y + offset_m."""

    slope_x: float
    slope_y: float
    offset_m: float


class InTheWay(NamedTuple):
    """Points in the cloud's frame, all (n, 2) in metres. `drop_offs` are where beams went through the ground."""

    obstacles: NDArray[np.float64]
    drop_offs: NDArray[np.float64]
    ground: NDArray[np.float64]
    plane: Plane


def fit_ground(xyz: NDArray[np.float64]) -> Plane | None:
    """The plane of the lowest points around the origin of (n, 3) finite points; None where there is none.

    Of each cell of 1 m the lowest point counts, so that near points do not outvote the rest. Least squares from the
    origin outwards, each time with what lies near the plane found so far.
    """
    near = xyz[(np.abs(xyz[:, :2]) < _FIT_STEPS[-1][0]).all(axis=1)]
    if not len(near):
        return None
    span = int(2 * _FIT_STEPS[-1][0] / _CELL_M)
    cells = np.floor(near[:, :2] / _CELL_M).astype(np.intp) + span // 2
    keys = cells[:, 0] * span + cells[:, 1]
    order = np.lexsort((near[:, 2], keys))
    first = np.ones(len(order), np.bool_)
    first[1:] = keys[order[1:]] != keys[order[:-1]]
    low = near[order[first]]
    distance_m = np.hypot(low[:, 0], low[:, 1])
    plane: Plane | None = None
    for radius_m, tolerance_m in _FIT_STEPS:
        inside = low[distance_m < radius_m]
        if len(inside) < _MIN_CELLS:
            continue
        if plane is None:  # level with the lower part of what is around
            plane = Plane(0.0, 0.0, float(np.quantile(inside[:, 2], 0.25)))
        chosen = inside[np.abs(_heights(inside, plane)) < tolerance_m]
        if len(chosen) < _MIN_CELLS:
            return None
        terms = np.column_stack((chosen[:, :2], np.ones(len(chosen))))
        slope_x, slope_y, offset_m = np.linalg.lstsq(terms, chosen[:, 2], rcond=None)[0].tolist()
        plane = Plane(slope_x, slope_y, offset_m)
        if np.hypot(slope_x, slope_y) > MAX_SLOPE:
            return None
    if plane is None:
        return None
    heights = _heights(low, plane)
    on, below = (np.abs(heights) < tolerance_m).sum(), (heights < -tolerance_m).sum()
    return plane if on > 2 * below else None  # else it cuts through something that goes on below it


def _heights(xyz: NDArray[np.float64], plane: Plane) -> NDArray[np.float64]:
    heights: NDArray[np.float64] = xyz[:, 2] - (xyz[:, :2] @ np.array(plane[:2]) + plane.offset_m)
    return heights


class ObstacleFinder:
    """Sorts the points of one topic's clouds. It remembers the ground for clouds in which none is to be seen."""

    def __init__(self, band: Band) -> None:
        self.band = band
        self._plane: Plane | None = None
        self._reused = 0

    def _ground(self, xyz: NDArray[np.float64]) -> Plane:
        if self.band.sensor_height_m is not None:
            return Plane(0.0, 0.0, -self.band.sensor_height_m)
        plane = fit_ground(xyz)
        if plane is not None:
            self._plane, self._reused = plane, 0
            return plane
        if self._plane is None or self._reused >= _REUSED_PLANES:
            raise BodyError("no ground can be seen in the cloud; give sensor_height_m")
        self._reused += 1
        return self._plane

    def find(self, cloud: Cloud) -> InTheWay:
        """BodyError when the cloud has no coordinates, or its ground cannot be found. A cloud without valid points has
        nothing in the way."""
        band = self.band
        coordinates: NDArray[Any] = cloud.xyz()
        xyz = coordinates[valid_rows(coordinates)].astype(np.float64)
        if not len(xyz):
            nothing = np.empty((0, 2))
            return InTheWay(nothing, nothing, nothing, self._plane or Plane(0.0, 0.0, -(band.sensor_height_m or 0.0)))
        plane = self._ground(xyz)
        range_m = np.hypot(xyz[:, 0], xyz[:, 1])
        seen = (range_m >= band.min_range_m) & (range_m <= band.max_range_m)
        xyz, range_m = xyz[seen], range_m[seen]
        heights = _heights(xyz, plane)
        standing = (heights >= band.min_height_m) & (heights <= band.max_height_m)
        below = heights < -band.drop_off_m
        ground = xyz[~below & (heights < band.min_height_m), :2]
        below &= range_m <= band.drop_off_range_m
        # A beam from the origin met the ground's plane at this part of its way; there, no ground stopped it.
        origin_m = -plane.offset_m
        part = origin_m / (origin_m - heights[below]) if origin_m > 0 else np.ones(int(below.sum()))
        return InTheWay(xyz[standing, :2], xyz[below, :2] * part[:, None], ground, plane)
