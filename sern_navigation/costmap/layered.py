"""The layers together, as nav2_costmap_2d lays them: map, then real obstacles, then inflation; the twin beside them."""

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from sern_navigation.costmap.costs import NO_INFORMATION, Costmap, Costs, Window, around, whole
from sern_navigation.costmap.inflation import InflationOptions, inflate
from sern_navigation.costmap.obstacles import ObstacleLayer, ObstacleOptions
from sern_navigation.costmap.static import StaticLayer, StaticOptions
from sern_navigation.costmap.twin import TwinLayer, TwinOptions
from sern_twin.world.grid import Grid


@dataclass(frozen=True, slots=True)
class CostmapOptions:
    static: StaticOptions = field(default_factory=StaticOptions)
    obstacles: ObstacleOptions = field(default_factory=ObstacleOptions)
    inflation: InflationOptions = field(default_factory=InflationOptions)
    twin: TwinOptions = field(default_factory=TwinOptions)


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
        return self._of(whole(self.grid), self.grid, now_s)

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
