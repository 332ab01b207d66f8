"""The values of a costmap's cells, as in nav2_costmap_2d/cost_values.hpp, and a costmap to read."""

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sern_twin.world.grid import NOWHERE, Floats, Grid

Costs = NDArray[np.uint8]
Mask = NDArray[np.bool_]

FREE_SPACE: Final = 0
MAX_NON_OBSTACLE: Final = 252
INSCRIBED_INFLATED_OBSTACLE: Final = 253
"""A robot whose middle is here touches an obstacle."""
LETHAL_OBSTACLE: Final = 254
NO_INFORMATION: Final = 255


@dataclass(frozen=True, slots=True, eq=False)
class Costmap:
    """`costs` (rows, columns) of what is real, the values above; `soft` (rows, columns), 0 to 252, of the twin alone.

    The two are apart so that nothing of the twin can pass for an obstacle: `soft` is added to what a way costs, and
    whether a cell is blocked is asked of `costs` alone.
    """

    grid: Grid
    costs: Costs
    soft: Costs

    def at(self, points_m: ArrayLike) -> Costs:
        """What is real at points (..., 2); LETHAL_OBSTACLE outside the grid: no plan leads there."""
        cells = self.grid.flat(points_m)
        return np.where(cells == NOWHERE, np.uint8(LETHAL_OBSTACLE), self.costs.reshape(-1)[cells])

    def blocked(self) -> Mask:
        """Where the middle of the robot cannot be, (rows, columns). What is unknown is not blocked."""
        found: Mask = (self.costs == LETHAL_OBSTACLE) | (self.costs == INSCRIBED_INFLATED_OBSTACLE)
        return found

    def weights(self) -> Floats:
        """Real and soft cost together, (rows, columns), 0 to 507; unknown counts 255, as in nav2_smac_planner."""
        return self.costs.astype(np.float64) + self.soft


@dataclass(frozen=True, slots=True)
class Window:
    """A rectangle of cells: rows and columns from the first to before the last."""

    first_row: int
    end_row: int
    first_column: int
    end_column: int

    @property
    def slices(self) -> tuple[slice, slice]:
        return slice(self.first_row, self.end_row), slice(self.first_column, self.end_column)

    @property
    def empty(self) -> bool:
        return self.first_row >= self.end_row or self.first_column >= self.end_column

    def grown(self, cells: int, grid: Grid) -> "Window":
        """The same with so many cells more on each side, where the grid has them."""
        return Window(
            max(self.first_row - cells, 0),
            min(self.end_row + cells, grid.rows),
            max(self.first_column - cells, 0),
            min(self.end_column + cells, grid.columns),
        )

    def within(self, other: "Window") -> tuple[slice, slice]:
        """Where its cells lie in an array that has those of `other`, which contains it."""
        return (
            slice(self.first_row - other.first_row, self.end_row - other.first_row),
            slice(self.first_column - other.first_column, self.end_column - other.first_column),
        )

    def grid_of(self, grid: Grid) -> Grid:
        """The grid of these cells alone. UsageError: there are none."""
        return replace(
            grid,
            west_m=grid.west_m + self.first_column * grid.cell_m,
            south_m=grid.south_m + self.first_row * grid.cell_m,
            columns=self.end_column - self.first_column,
            rows=self.end_row - self.first_row,
        )


def whole(grid: Grid) -> Window:
    return Window(0, grid.rows, 0, grid.columns)


def around(grid: Grid, x_m: float, y_m: float, radius_m: float) -> Window:
    """The cells within a square around a place, as far as they are on the grid; none where the place is far off."""
    row, column, cells = (y_m - grid.south_m) / grid.cell_m, (x_m - grid.west_m) / grid.cell_m, radius_m / grid.cell_m
    rows, columns = (
        [min(max(math.floor(end), 0), size) for end in (middle - cells, middle + cells + 1)]
        for middle, size in ((row, grid.rows), (column, grid.columns))
    )
    return Window(rows[0], rows[1], columns[0], columns[1])
