"""The layers together, as nav2_costmap_2d lays them: map, then real obstacles, then inflation; the twin beside them."""

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from sern_navigation.costmap.costs import NO_INFORMATION, Costmap, Costs, Mask, Window, around, whole
from sern_navigation.costmap.inflation import InflationOptions, inflate
from sern_navigation.costmap.obstacles import ObstacleLayer, ObstacleOptions
from sern_navigation.costmap.static import StaticLayer, StaticOptions
from sern_navigation.costmap.twin import TwinLayer, TwinOptions, softened
from sern_twin.world.grid import Grid


@dataclass(frozen=True, slots=True)
class CostmapOptions:
    static: StaticOptions = field(default_factory=StaticOptions)
    obstacles: ObstacleOptions = field(default_factory=ObstacleOptions)
    inflation: InflationOptions = field(default_factory=InflationOptions)
    twin: TwinOptions = field(default_factory=TwinOptions)


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """What all layers said at a moment, before inflation: nothing that is observed later changes it.

    `real` and `twin` (rows, columns): the costs of map and real obstacles, and where the twin says that something
    stands; None: it is stale. It is quickly made, and may go to another thread or process, which makes the costmap.
    """

    grid: Grid
    real: Costs
    twin: Mask | None
    table: Costs
    twin_table: Costs
    inflate_unknown: bool

    def costmap(self) -> Costmap:
        """The costmap of that moment."""
        costs = inflate(self.real, self.table, inflate_unknown=self.inflate_unknown)
        soft = np.zeros(self.grid.shape, np.uint8) if self.twin is None else softened(self.twin, self.twin_table)
        return Costmap(self.grid, costs, soft)


class LayeredCostmap:
    """One grid for global and local plans: the local costmap is a window of it. What nobody knows is NO_INFORMATION."""

    def __init__(self, grid: Grid, options: CostmapOptions | None = None) -> None:
        options = options or CostmapOptions()
        self.grid: Final = grid
        self.static: Final = StaticLayer(grid, options.static)
        self.obstacles: Final = ObstacleLayer(
            grid, options.obstacles, robot_radius_m=options.inflation.inscribed_radius
        )
        self.twin: Final = TwinLayer(grid, options.inflation, options.twin)
        self._inflation = options.inflation
        self._table = options.inflation.table(grid.cell_m)
        self._reach = options.inflation.reach_cells(grid.cell_m)

    def everywhere(self, now_s: float) -> Costmap:
        """All of it, for a global plan."""
        return self.snapshot(now_s).costmap()

    def snapshot(self, now_s: float) -> Snapshot:
        """All of it, to make a costmap of elsewhere or later."""
        everything = whole(self.grid)
        return Snapshot(
            self.grid,
            _with_max(self.static.costs, self.obstacles.costs(everything)),
            self.twin.unseen(now_s, everything, self.obstacles.seen_free),
            self._table,
            self.twin.table,
            self._inflation.inflate_unknown,
        )

    def local(self, now_s: float, x_m: float, y_m: float, radius_m: float) -> Costmap | None:
        """A square around the robot, for the next command; None where no cell is on the grid."""
        window = around(self.grid, x_m, y_m, radius_m)
        return None if window.empty else self._of(window, window.grid_of(self.grid), now_s)

    def _of(self, window: Window, grid: Grid, now_s: float) -> Costmap:
        larger = window.grown(self._reach, self.grid)
        real = _with_max(self.static.costs[larger.slices], self.obstacles.costs(larger))
        costs = inflate(real, self._table, inflate_unknown=self._inflation.inflate_unknown)[window.within(larger)]
        return Costmap(grid, costs, self.twin.soft(now_s, window, self.obstacles.seen_free))


def _with_max(below: Costs, above: Costs) -> Costs:
    """CostmapLayer::updateWithMax: the larger cost, where both know one; else the one that is known."""
    found = np.maximum(below, above)
    found = np.where(below == NO_INFORMATION, above, found)
    return np.where(above == NO_INFORMATION, below, found)
