"""What stands at the site as boxes: cells of a scene that are occupied, with the age of the block they are in."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from sern_client.endpoints.twin.view.frames import Box
from sern_twin.world.grid import Grid
from sern_twin.world.patches import OCCUPIED, Cells

MOST_BOXES: Final = 20_000
"""A browser draws so many without trouble. Of more cells each two by two are one, and again."""
HEIGHT_M: Final = 0.5
Floats = NDArray[np.float64]


def boxes(grid: Grid, cells: Cells, ages_s: Floats) -> list[Box]:
    """Occupied cells, (rows, columns), as boxes of one size; `ages_s`: (blocks,), of each block of the grid.

    Joined cells have the age of the youngest of their blocks.
    """
    rows, columns = np.nonzero(cells >= OCCUPIED)
    ages = ages_s[grid.block_of(rows, columns)] if len(rows) else np.zeros(0)
    size = 1
    while len(rows) > MOST_BOXES:
        size *= 2
        rows, columns, ages = _joined(rows // 2, columns // 2, ages)
    # The middle of cell n of `size` cells is that of cells n * size and (n + 1) * size - 1.
    middle = (size - 1) / 2
    centres = grid.centres(rows * size + middle, columns * size + middle)
    size_m = grid.cell_m * size
    return [
        Box(float(x_m), float(y_m), size_m, HEIGHT_M, float(age_s))
        for (x_m, y_m), age_s in zip(centres, ages, strict=True)
    ]


def _joined(
    rows: NDArray[np.int64], columns: NDArray[np.int64], ages: Floats
) -> tuple[NDArray[np.int64], NDArray[np.int64], Floats]:
    width = int(columns.max()) + 1
    cells, which = np.unique(rows * width + columns, return_inverse=True)
    youngest = np.full(len(cells), np.nan)
    np.fmin.at(youngest, which, ages)
    return cells // width, cells % width, youngest
