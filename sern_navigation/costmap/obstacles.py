"""The layer of what real scans see: obstacles are marked, and cleared where a ray passes low enough to have met them.

Nav2's obstacle and voxel layers in 2.5 dimensions: a mark has a height, and a ray that passes above it says nothing of
it. What is too near to be seen below the lowest ray stays as it was seen from further away. An edge of the ground is
cleared where ground is seen in its place, and by nothing else.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sern_core.vocabulary.errors import UsageError
from sern_navigation.costmap.costs import FREE_SPACE, LETHAL_OBSTACLE, NO_INFORMATION, Costs, Mask, Window, around
from sern_navigation.scan import ObstacleScan, turned
from sern_twin.world.grid import NOWHERE, Floats, Grid
from sern_twin.world.occupancy import Pose

_NEAR_M: Final = 1.5
"""Where the lowest ray of the simulated robot's scanner meets level ground."""
_CLEARLY_M: Final = 0.02
"""So much lower than a mark's top a ray must pass: both tremble."""


@dataclass(frozen=True, slots=True)
class ObstacleOptions:
    """UsageError: a range that is not above 0."""

    obstacle_max_range: float = 2.5
    """[m]: what is further away is not marked."""
    obstacle_min_range: float = 0.0
    raytrace_max_range: float = 3.0
    """[m]: what is further away is not cleared."""
    raytrace_min_range: float = 0.0
    footprint_clearing_enabled: bool = True
    """Nothing is where the robot is."""
    seen_below_m: float = 0.3
    """What no ray was below so much above the ground is not known to be free, if nothing is marked there."""

    def __post_init__(self) -> None:
        if not (0 <= self.obstacle_min_range < self.obstacle_max_range < math.inf):
            raise UsageError(f"obstacles from {self.obstacle_min_range} m to {self.obstacle_max_range} m are none")
        if not (0 <= self.raytrace_min_range < self.raytrace_max_range < math.inf):
            raise UsageError(f"rays from {self.raytrace_min_range} m to {self.raytrace_max_range} m are none")

    @property
    def reach_m(self) -> float:
        """How far away a scan changes anything."""
        return max(self.obstacle_max_range, self.raytrace_max_range)


class ObstacleLayer:
    """The cells of a grid, all unknown at first. `robot_radius_m`: of what `footprint_clearing_enabled` clears."""

    def __init__(self, grid: Grid, options: ObstacleOptions | None = None, *, robot_radius_m: float = 0.33) -> None:
        self.grid: Final = grid
        self.options: Final = options or ObstacleOptions()
        self._radius_m = robot_radius_m
        self._marked = np.zeros(grid.shape, np.bool_)
        self._free = np.zeros(grid.shape, np.bool_)
        self._edges = np.zeros(grid.shape, np.bool_)
        self._tops_m = np.zeros(grid.shape, np.float32)
        self._hidden = np.zeros(grid.shape, np.bool_)
        """Near the robot, and so low that no ray of the last scan would have met it."""

    @property
    def lethal(self) -> Mask:
        """Where real sensors say that something stands, (rows, columns)."""
        return self._marked

    @property
    def seen_free(self) -> Mask:
        """Where real sensors say that nothing stands, (rows, columns)."""
        return self._free

    def observe(self, pose: Pose, scan: ObstacleScan) -> None:
        """Take a scan from where the robot is: clear, then mark. All of the pose is finite."""
        x_m, y_m, yaw_rad = pose
        forward_m, left_m = turned(np.array(scan.origin_m), yaw_rad).tolist()
        self._clear(x_m + forward_m, y_m + left_m, yaw_rad, scan)
        self._mark(pose, scan)
        if self.options.footprint_clearing_enabled:
            window = around(self.grid, x_m, y_m, self._radius_m)
            if not window.empty:
                away_m = np.hypot(*self._offsets(window, x_m, y_m))
                here = away_m <= self._radius_m
                # But an edge may well be where a part of it is; not where its middle is, or it would have fallen.
                edges = self._edges[window.slices]
                edges &= away_m > self._radius_m / 2
                self._marked[window.slices] &= ~here | edges
                self._free[window.slices] |= here & ~self._marked[window.slices]

    def costs(self, window: Window) -> Costs:
        """LETHAL_OBSTACLE, FREE_SPACE or NO_INFORMATION, in the window's shape."""
        known = np.where(self._free[window.slices], np.uint8(FREE_SPACE), np.uint8(NO_INFORMATION))
        return np.where(self._marked[window.slices], np.uint8(LETHAL_OBSTACLE), known)

    def marks_near(self, pose: Pose, radius_m: float) -> Floats:
        """The middles of marked cells within a square around the robot, (n, 2) in its own frame [m]."""
        x_m, y_m, yaw_rad = pose
        window = around(self.grid, x_m, y_m, radius_m)
        rows, columns = np.nonzero(self._marked[window.slices])
        places = self.grid.centres(rows + window.first_row, columns + window.first_column) - [x_m, y_m]
        return turned(places, -yaw_rad)

    def clear(self) -> None:
        """Forget all that the next scan would show: Nav2's clearing of the costmap, but for what is near and below
        all rays. Nothing would show that again, such as the edge of a ditch that the robot stands before.
        """
        kept = self._marked & self._hidden
        self._marked[:] = kept
        self._edges &= kept
        self._free[:] = False

    def _offsets(self, window: Window, x_m: float, y_m: float) -> tuple[Floats, Floats]:
        rows, columns = window.slices
        cell_m = self.grid.cell_m
        east = self.grid.west_m + (np.arange(columns.start, columns.stop) + 0.5) * cell_m - x_m
        north = self.grid.south_m + (np.arange(rows.start, rows.stop) + 0.5) * cell_m - y_m
        return east[None, :], north[:, None]

    def _clear(self, x_m: float, y_m: float, yaw_rad: float, scan: ObstacleScan) -> None:
        options = self.options
        window = around(self.grid, x_m, y_m, options.raytrace_max_range)
        if window.empty:
            return
        east, north = self._offsets(window, x_m, y_m)
        ranges = np.hypot(east, north)
        sectors = len(scan.ranges_m)
        bearings = np.arctan2(north, east) - yaw_rad + math.pi
        sector = np.floor(bearings * (sectors / (2 * math.pi))).astype(np.int64) % sectors
        number = np.minimum(np.searchsorted(scan.bins_m[1:-1], ranges, side="right"), len(scan.lowest_m) - 1)
        passed = scan.lowest_m[number, sector]
        passed = np.where(
            (ranges <= min(options.raytrace_max_range, float(scan.bins_m[-1])))
            & (ranges >= options.raytrace_min_range),
            passed,
            np.float32(np.inf),
        )
        marked, free = self._marked[window.slices], self._free[window.slices]
        ground = _on_all_sides(scan.ground_m)[sector]
        is_ground = (ranges >= ground[..., 0]) & (ranges <= ground[..., 1]) & np.isfinite(passed)
        through = np.where(np.isfinite(passed), _beside(scan.lowest_m)[number, sector], passed)
        met = through <= self._tops_m[window.slices] - np.float32(_CLEARLY_M)
        met = np.where(self._edges[window.slices], is_ground, met)
        marked &= ~met
        self._edges[window.slices] &= marked
        self._hidden[:] = False
        self._hidden[window.slices] = ~met & (ranges <= _NEAR_M)
        free |= passed <= options.seen_below_m
        free &= ~marked

    def _mark(self, pose: Pose, scan: ObstacleScan) -> None:
        options = self.options
        ranges = np.hypot(*(scan.points_m - scan.origin_m).T)
        near = (ranges >= options.obstacle_min_range) & (ranges <= options.obstacle_max_range)
        x_m, y_m, yaw_rad = pose
        cells = self.grid.flat(turned(scan.points_m[near], yaw_rad) + np.array([x_m, y_m]))
        on_grid = cells != NOWHERE
        cells = cells[on_grid]
        tops, found_m = self._tops_m.reshape(-1), scan.tops_m[near][on_grid].astype(np.float32)
        tops[cells[~self._marked.reshape(-1)[cells]]] = 0.0
        np.maximum.at(tops, cells, found_m)
        self._edges.reshape(-1)[cells[found_m == 0]] = True
        self._marked.reshape(-1)[cells] = True
        self._free.reshape(-1)[cells] = False


def _beside(lowest_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """How low rays passed also beside each place and behind it, (bins, sectors).

    A ray that grazes a wall passes through the near half of its cells. What a mark is cleared by is to pass on all
    sides of it: else a robot that drives along a wall forgets it.
    """
    wide = np.maximum(lowest_m, np.maximum(np.roll(lowest_m, 1, axis=1), np.roll(lowest_m, -1, axis=1)))
    wide[:-1] = np.maximum(wide[:-1], wide[1:])
    return wide


def _on_all_sides(ground_m: Floats) -> Floats:
    """Ground that was seen at a bearing and at both beside it, from where to where, (sectors, 2)."""
    beside = np.stack((ground_m, np.roll(ground_m, 1, axis=0), np.roll(ground_m, -1, axis=0)))
    return np.stack((beside[..., 0].max(axis=0), beside[..., 1].min(axis=0)), axis=1)
