"""Costs around obstacles: nav2_costmap_2d's inflation layer, with the exact distance to the nearest obstacle's cell."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sern_core.vocabulary.errors import UsageError
from sern_navigation.costmap.costs import (
    FREE_SPACE,
    INSCRIBED_INFLATED_OBSTACLE,
    LETHAL_OBSTACLE,
    NO_INFORMATION,
    Costs,
    Mask,
)


@dataclass(frozen=True, slots=True)
class InflationOptions:
    """UsageError: a radius or factor that is negative or not finite."""

    inflation_radius: float = 0.70
    """[m]"""
    cost_scaling_factor: float = 3.0
    """[1/m]: how fast the cost falls with the distance."""
    inscribed_radius: float = 0.33
    """[m]: of the largest circle in the robot's footprint around its middle. Nav2 takes it from the footprint."""
    inflate_unknown: bool = False

    def __post_init__(self) -> None:
        for name in ("inflation_radius", "cost_scaling_factor", "inscribed_radius"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise UsageError(f"inflation with {name} {value}: give a number of 0 or more")

    def reach_cells(self, cell_m: float) -> int:
        """How many cells away an obstacle still costs something."""
        return math.ceil(self.inflation_radius / cell_m)

    def table(self, cell_m: float) -> Costs:
        """What a cell costs by the square of its distance from an obstacle, in cells: (reach² + 1,).

        Nav2's formula (InflationLayer::computeCost): 254 at the obstacle, 253 within the inscribed radius, then
        252 exp(-cost_scaling_factor (d - inscribed_radius)), cut to a whole number.
        """
        reach = self.reach_cells(cell_m)
        distances_m = np.sqrt(np.arange(reach * reach + 1)) * cell_m
        falling = np.exp(-self.cost_scaling_factor * (distances_m - self.inscribed_radius))
        costs = np.minimum((INSCRIBED_INFLATED_OBSTACLE - 1) * falling, INSCRIBED_INFLATED_OBSTACLE)
        costs = np.where(distances_m <= self.inscribed_radius, INSCRIBED_INFLATED_OBSTACLE, costs)
        costs[0] = LETHAL_OBSTACLE
        return costs.astype(np.uint8)


def squared_cells(obstacles: Mask) -> NDArray[np.int32] | None:
    """The square of the distance [cells] to the nearest obstacle, (rows, columns); None where there is no obstacle."""
    if not obstacles.any():
        return None
    rows, columns = ndimage.distance_transform_edt(~obstacles, return_distances=False, return_indices=True)
    rows -= np.arange(obstacles.shape[0], dtype=np.int32)[:, None]
    columns -= np.arange(obstacles.shape[1], dtype=np.int32)
    squares: NDArray[np.int32] = rows * rows + columns * columns
    return squares


def around_obstacles(obstacles: Mask, table: Costs) -> Costs | None:
    """What cells (rows, columns) cost by their distance to the nearest obstacle; None where there is no obstacle.
    `table`: by its square, in cells; beyond its end nothing."""
    squares = squared_cells(obstacles)
    return None if squares is None else np.append(table, np.uint8(0))[np.minimum(squares, len(table))]


def inflate(costs: Costs, table: Costs, *, inflate_unknown: bool = False) -> Costs:
    """The same costs with more around each LETHAL_OBSTACLE, never less. `table` is `InflationOptions.table`.

    What is unknown becomes known only where the cost is that of a touch, or with `inflate_unknown` any, as in Nav2.
    """
    added = around_obstacles(costs == LETHAL_OBSTACLE, table)
    if added is None:
        return costs.copy()
    unknown = costs == NO_INFORMATION
    least = FREE_SPACE + 1 if inflate_unknown else INSCRIBED_INFLATED_OBSTACLE
    return np.where(unknown, np.where(added >= least, added, costs), np.maximum(costs, added))
