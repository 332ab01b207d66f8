"""The layer of the map: what nav_msgs/OccupancyGrid says, by the rules of nav2_costmap_2d's static layer."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sern_core.vocabulary.errors import UsageError
from sern_navigation.costmap.costs import FREE_SPACE, LETHAL_OBSTACLE, NO_INFORMATION, Costs
from sern_twin.world.grid import Grid
from sern_twin.world.patches import UNKNOWN, Cells


class MapOutcome(StrEnum):
    """What became of a map."""

    TAKEN = "taken"
    OTHER_RESOLUTION = "other_resolution"
    OTHER_FRAME = "other_frame"
    OTHER_PLACE = "other_place"
    """It has other corners."""
    CELLS = "cells"
    """They have another shape or type, or values that are none of -1 to 100."""


@dataclass(frozen=True, slots=True)
class StaticOptions:
    """UsageError: a threshold that is not 1 to 100."""

    lethal_cost_threshold: int = 100
    trinary_costmap: bool = True
    """Below the threshold all is free; else it costs in proportion."""

    def __post_init__(self) -> None:
        if not 1 <= self.lethal_cost_threshold <= 100:
            raise UsageError(f"lethal_cost_threshold is {self.lethal_cost_threshold}: give 1 to 100")


class StaticLayer:
    """`take` a map; `costs` (rows, columns) are NO_INFORMATION before."""

    def __init__(self, grid: Grid, options: StaticOptions | None = None) -> None:
        self.grid: Final = grid
        self._options = options or StaticOptions()
        self.costs: Costs = np.full(grid.shape, NO_INFORMATION, np.uint8)
        self.counts: Final = dict.fromkeys(MapOutcome, 0)

    def take(self, grid: Grid, cells: Cells) -> MapOutcome:
        """A map, -1 unknown and 0 to 100 occupied. One that is not taken leaves the layer as it was."""
        outcome = fits(self.grid, grid, cells)
        self.counts[outcome] += 1
        if outcome is MapOutcome.TAKEN:
            threshold = self._options.lethal_cost_threshold
            values = cells.astype(np.int64)
            between = np.zeros_like(values) if self._options.trinary_costmap else LETHAL_OBSTACLE * values // threshold
            costs = np.where(values >= threshold, LETHAL_OBSTACLE, np.maximum(between, FREE_SPACE))
            self.costs = np.where(values == UNKNOWN, NO_INFORMATION, costs).astype(np.uint8)
        return outcome


def fits(own: Grid, grid: Grid, cells: NDArray[np.int8]) -> MapOutcome:
    """Whether cells (rows, columns) of another grid can be laid on one's own: TAKEN, or why not."""
    if grid.cell_m != own.cell_m:
        return MapOutcome.OTHER_RESOLUTION
    if grid.frame_id != own.frame_id:
        return MapOutcome.OTHER_FRAME
    if (grid.west_m, grid.south_m, *grid.shape) != (own.west_m, own.south_m, *own.shape):
        return MapOutcome.OTHER_PLACE
    if cells.shape != own.shape or cells.dtype != np.int8 or cells.min() < UNKNOWN or cells.max() > 100:
        return MapOutcome.CELLS
    return MapOutcome.TAKEN
