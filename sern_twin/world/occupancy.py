"""What scans and clouds say of each cell: occupancy as log-odds (Moravec and Elfes, ICRA 1985), and how high it is.

A scan makes the cells along its rays freer and those at their ends more occupied, each once, and an end counts more
than a ray that passes. Log-odds are clamped, so that a cell can change its mind (Hornung et al., OctoMap, 2013).
Nothing decays by itself.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sern_core.vocabulary.errors import UsageError
from sern_twin.motion import MOST_M
from sern_twin.world.grid import NOWHERE, Floats, Grid
from sern_twin.world.patches import OCCUPIED, Cells
from sern_twin.world.rays import crossed

Pose = tuple[float, float, float]
"""East, north [m] and yaw [rad] of the scanner in the grid's frame."""
MOST_BEAMS: Final = 100_000
MOST_RANGE_M: Final = 1e5
MOST_RAD: Final = 1e6
UNSURE_CELLS: Final = 1.5
"""How far before its end a ray clears cells no more."""


class Ignored(Enum):
    """Why a reading was not used."""

    POSE = "pose"
    """All of a scan: where the scanner was is not finite, or not near any site."""
    ANGLE = "angle"
    """Not finite, or more turns than there are."""
    NAN = "nan"
    NEGATIVE = "negative"
    """Minus infinity too: by REP 117 something is too near to be measured."""
    TOO_NEAR = "too_near"
    TOO_FAR = "too_far"
    """A finite range above the scanner's largest."""
    BELOW = "below"
    """A point that is deeper in the ground than it is uneven."""
    ABOVE = "above"
    """A point that is higher than the robot."""
    OUTSIDE = "outside"
    """A point that is not on the grid."""


class Sight(NamedTuple):
    """What one scan or cloud says: cells that it saw through, and cells that it saw something in, (rows, columns)."""

    free: NDArray[np.bool_]
    occupied: NDArray[np.bool_]

    @property
    def cells(self) -> int:
        """How many were seen."""
        return int(np.count_nonzero(self.free)) + int(np.count_nonzero(self.occupied))


@dataclass(frozen=True, slots=True)
class OccupancyOptions:
    """Clamps and hits are OctoMap's. A cell becomes occupied after three scans, and free after some 26 that pass:
    between the two lies what flickers at the edges of things, and each flicker would cross the link.

    UsageError: not 0 < least < miss < .5 < hit < most < 1, or not least < free < occupied < most.
    """

    hit: float = 0.7
    """How likely a cell is occupied in which a ray ends."""
    miss: float = 0.45
    least: float = 0.12
    most: float = 0.97
    free: float = 0.15
    occupied: float = 0.9
    """A cell becomes free, or occupied, at these; between it stays what it was."""

    def __post_init__(self) -> None:
        if not 0 < self.least < self.miss < 0.5 < self.hit < self.most < 1:
            raise UsageError(
                f"occupancy with least {self.least}, miss {self.miss}, hit {self.hit}, most {self.most}: "
                "0 < least < miss < 0.5 < hit < most < 1"
            )
        if not self.least < self.free < self.occupied < self.most:
            raise UsageError(
                f"occupancy with free {self.free}, occupied {self.occupied}: least < free < occupied < most"
            )


class Occupancy:
    """The cells of a grid, all unknown at first."""

    def __init__(self, grid: Grid, options: OccupancyOptions | None = None) -> None:
        self.grid: Final = grid
        self._options = options or OccupancyOptions()
        self._odds = np.zeros(grid.shape, np.float32)
        self._seen = np.zeros(grid.shape, np.bool_)
        self._tops_m = np.full(grid.shape, np.nan, np.float32)
        self._classes: Cells = np.full(grid.shape, -1, np.int8)
        self._ignored = dict.fromkeys(Ignored, 0)

    @property
    def ignored(self) -> Mapping[Ignored, int]:
        """How many readings were not used, and why."""
        return self._ignored

    # What is seen

    def fuse(
        self, pose: Pose, angles_rad: ArrayLike, ranges_m: ArrayLike, range_max_m: float, *, range_min_m: float = 0.0
    ) -> Sight:
        """Take a planar scan, (n,) angles from the scanner's own axis and ranges as in sensor_msgs/LaserScan.

        Infinite: nothing is there up to `range_max_m`. NaN, negative and what is out of range says nothing and is
        counted. What it says of which cells. UsageError: shapes that differ, more than `MOST_BEAMS`, no range at all.
        """
        angles, ranges = np.asarray(angles_rad, np.float64), np.asarray(ranges_m, np.float64)
        if angles.ndim != 1 or angles.shape != ranges.shape or len(angles) > MOST_BEAMS:
            raise UsageError(
                f"a scan of {angles.shape} angles and {ranges.shape} ranges: give as many of each, at most {MOST_BEAMS}"
            )
        if not 0 <= range_min_m < range_max_m <= MOST_RANGE_M:
            raise UsageError(
                f"a scan from {range_min_m} m to {range_max_m} m: 0 <= range_min < range_max <= {MOST_RANGE_M:.0f}"
            )
        x_m, y_m, yaw_rad = pose
        if not (abs(x_m) <= MOST_M and abs(y_m) <= MOST_M and abs(yaw_rad) <= MOST_RAD):
            self._ignored[Ignored.POSE] += len(ranges)
            return Sight(np.zeros(self.grid.shape, np.bool_), np.zeros(self.grid.shape, np.bool_))
        used = self._usable(angles, ranges, range_min_m, range_max_m)
        angles, ranges = yaw_rad + angles[used], ranges[used]
        origin = np.array([x_m, y_m])
        directions = np.stack((np.cos(angles), np.sin(angles)), axis=1)
        ends = origin + np.minimum(ranges, range_max_m)[:, None] * directions
        # Just before its end a ray says nothing: what stands there is not so sharp, and nor is where the scanner is.
        sure_m = np.where(np.isfinite(ranges), np.maximum(ranges - UNSURE_CELLS * self.grid.cell_m, 0.0), range_max_m)
        free = crossed(self.grid, origin, origin + sure_m[:, None] * directions)
        ended = self.grid.flat(ends[np.isfinite(ranges)])
        occupied = np.zeros(self.grid.shape, np.bool_)
        occupied.reshape(-1)[ended[ended != NOWHERE]] = True
        return self._update(free, occupied)

    def fuse_points(
        self, points_m: ArrayLike, *, ground_m: ArrayLike = 0.0, low_m: float = 0.1, high_m: float = 2.0
    ) -> Sight:
        """Take a cloud, (n, 3) or more in the grid's frame, over the ground [m] below each point, or below all.

        What stands `low_m` to `high_m` above the ground is in the way. A cell where there is only ground, within
        `low_m` of it, is free. All else is counted. What it says of which cells. UsageError: another shape, no band.
        """
        points, ground = np.asarray(points_m, np.float64), np.asarray(ground_m, np.float64)
        if points.ndim != 2 or points.shape[1] < 3:
            raise UsageError(f"a cloud of {points.shape}: give a row of x, y, z for each point")
        if ground.shape not in ((), (len(points),)):
            raise UsageError(f"a ground of {ground.shape} below {len(points)} points: give one height, or one for each")
        if not 0 < low_m < high_m:
            raise UsageError(f"a band from {low_m} m to {high_m} m above the ground: 0 < low < high")
        with np.errstate(over="ignore", invalid="ignore"):
            heights = points[:, 2] - ground
        cells = self.grid.flat(points[:, :2])
        finite = np.isfinite(points[:, :3]).all(axis=1) & np.isfinite(heights)
        below, above = finite & (heights < -low_m), finite & (heights > high_m)
        on_grid = finite & (cells != NOWHERE)
        self._ignored[Ignored.NAN] += int(np.count_nonzero(~finite))
        self._ignored[Ignored.OUTSIDE] += int(np.count_nonzero(finite & ~on_grid))
        self._ignored[Ignored.BELOW] += int(np.count_nonzero(below & on_grid))
        self._ignored[Ignored.ABOVE] += int(np.count_nonzero(above & on_grid))

        band = on_grid & ~above & (heights >= low_m)
        ground = on_grid & ~below & (heights < low_m)
        free, occupied = np.zeros(self.grid.shape, np.bool_), np.zeros(self.grid.shape, np.bool_)
        free.reshape(-1)[cells[ground]] = True
        occupied.reshape(-1)[cells[band]] = True
        tops = np.full(self.grid.rows * self.grid.columns, -np.inf, np.float32)
        np.maximum.at(tops, cells[band], heights[band].astype(np.float32))
        self._tops_m[occupied] = tops.reshape(self.grid.shape)[occupied]
        return self._update(free, occupied)

    # What is known

    def probabilities(self) -> NDArray[np.float32]:
        """How likely each cell is occupied, (rows, columns); NaN where nothing was seen."""
        found: NDArray[np.float32] = np.where(self._seen, 1 / (1 + np.exp(-self._odds)), np.float32(np.nan))
        return found

    def cells(self) -> Cells:
        """The same in nav_msgs/OccupancyGrid's data: -1 unknown, 0 to 100 per cent."""
        percent = np.rint(100 / (1 + np.exp(-self._odds)))
        return np.where(self._seen, percent, -1).astype(np.int8)

    def classes(self) -> Cells:
        """-1 unknown, 0 free, 100 occupied: what a scene is set to, since it changes only when a cell does.

        A cell that is between free and occupied has the class it had.
        """
        options = self._options
        self._classes[self._odds >= _log_odds(options.occupied)] = OCCUPIED
        self._classes[self._odds <= _log_odds(options.free)] = 0
        return self._classes.copy()

    def tops_m(self) -> NDArray[np.float32]:
        """How high above the ground what is in each occupied cell was in the last cloud [m]; NaN where none said."""
        occupied = self._odds >= _log_odds(self._options.occupied)
        return np.where(occupied, self._tops_m, np.float32(np.nan))

    # In here

    def _usable(self, angles: Floats, ranges: Floats, least_m: float, most_m: float) -> NDArray[np.bool_]:
        left = np.ones(len(ranges), np.bool_)
        for reason, where in (
            (Ignored.ANGLE, ~(np.abs(angles) <= MOST_RAD)),
            (Ignored.NAN, np.isnan(ranges)),
            (Ignored.NEGATIVE, ranges < 0),
            (Ignored.TOO_NEAR, ranges < least_m),
            (Ignored.TOO_FAR, (ranges > most_m) & np.isfinite(ranges)),
        ):
            self._ignored[reason] += int(np.count_nonzero(left & where))
            left &= ~where
        return left

    def _update(self, free: NDArray[np.bool_], occupied: NDArray[np.bool_]) -> Sight:
        """Say once of each cell that it is free or, which counts more, occupied."""
        free &= ~occupied
        options = self._options
        seen = free | occupied
        odds = self._odds[seen]
        odds += np.where(occupied[seen], _log_odds(options.hit), _log_odds(options.miss)).astype(np.float32)
        self._odds[seen] = np.clip(odds, _log_odds(options.least), _log_odds(options.most))
        self._seen |= seen
        return Sight(free, occupied)


def _log_odds(probability: float) -> np.float32:
    return np.float32(math.log(probability / (1 - probability)))
