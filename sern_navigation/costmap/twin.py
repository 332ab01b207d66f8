"""The layer of the twin: what it says stands somewhere makes the way there dearer, and never blocks it.

It counts while it is fresh, and where no real scan has seen that nothing is there.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from sern_core.vocabulary.errors import UsageError
from sern_navigation.costmap.costs import MAX_NON_OBSTACLE, Costs, Mask, Window
from sern_navigation.costmap.inflation import InflationOptions, around_obstacles
from sern_navigation.costmap.static import MapOutcome, fits
from sern_twin.world.grid import Grid
from sern_twin.world.patches import Cells


@dataclass(frozen=True, slots=True, eq=False)
class TwinView:
    """What the twin says of the site: cells (rows, columns) as in nav_msgs/OccupancyGrid, and when that was so [s]."""

    grid: Grid
    cells: Cells
    stamp_s: float


@dataclass(frozen=True, slots=True)
class TwinOptions:
    """UsageError: a cost that could block, or a bound that is none."""

    cost: int = 150
    """Of a place where the robot would touch what the twin says is there."""
    staleness_s: float = 2.0
    """What is older counts nothing, and so does what is so much too early."""
    occupied: int = 65
    """From here on a cell is occupied, of 100."""

    def __post_init__(self) -> None:
        if not 0 <= self.cost <= MAX_NON_OBSTACLE:
            raise UsageError(f"the twin's cost is {self.cost}: give 0 to {MAX_NON_OBSTACLE}, so that it never blocks")
        if not (math.isfinite(self.staleness_s) and self.staleness_s >= 0):
            raise UsageError(f"the twin's staleness_s is {self.staleness_s}: give 0 or more")
        if not 1 <= self.occupied <= 100:
            raise UsageError(f"the twin's occupied is {self.occupied}: give 1 to 100")


class TwinLayer:
    """`take` what the twin says; `soft` is what it costs."""

    def __init__(self, grid: Grid, inflation: InflationOptions, options: TwinOptions | None = None) -> None:
        self.grid: Final = grid
        self.options: Final = options or TwinOptions()
        self.counts: Final = dict.fromkeys(MapOutcome, 0)
        self._stamp_s = -math.inf
        self._occupied: Mask = np.zeros(grid.shape, np.bool_)
        self._reach = inflation.reach_cells(grid.cell_m)
        real = inflation.table(grid.cell_m).astype(np.int64)
        self.table: Final[Costs] = (np.minimum(real, MAX_NON_OBSTACLE) * self.options.cost // MAX_NON_OBSTACLE).astype(
            np.uint8
        )

    def take(self, view: TwinView) -> MapOutcome:
        """The latest of the twin. One that does not fit leaves the layer as it was, and is counted."""
        outcome = fits(self.grid, view.grid, view.cells)
        self.counts[outcome] += 1
        if outcome is MapOutcome.TAKEN:
            self._stamp_s = view.stamp_s
            self._occupied = view.cells >= self.options.occupied
        return outcome

    def fresh(self, now_s: float) -> bool:
        """Whether what it says counts now."""
        return abs(now_s - self._stamp_s) <= self.options.staleness_s

    def unseen(self, now_s: float, window: Window, seen_free: Mask) -> Mask | None:
        """Cells where it says that something stands and no real scan saw that nothing does, in the window's shape;
        None: it is stale. `seen_free` (rows, columns): where real scans saw nothing."""
        return self._occupied[window.slices] & ~seen_free[window.slices] if self.fresh(now_s) else None

    def soft(self, now_s: float, window: Window, seen_free: Mask) -> Costs:
        """What it costs, in the window's shape. `seen_free` (rows, columns): where real scans saw nothing."""
        larger = window.grown(self._reach, self.grid)
        unseen = self.unseen(now_s, larger, seen_free)
        if unseen is None:
            return np.zeros((window.end_row - window.first_row, window.end_column - window.first_column), np.uint8)
        return softened(unseen, self.table)[window.within(larger)]


def softened(occupied: Mask, table: Costs) -> Costs:
    """What cells (rows, columns) cost by their distance to the occupied ones. `table`: by its square, in cells."""
    found = around_obstacles(occupied, table)
    return np.zeros(occupied.shape, np.uint8) if found is None else found
