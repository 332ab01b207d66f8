"""Which cells a ray goes through: those of its start and of each crossing of a grid line (Amanatides and Woo, 1987).

Without their walk from cell to cell, since the crossings of all rays are computed at once.
"""

from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sern_twin.world.grid import Floats, Grid, Indices

_MOST_AT_ONCE: Final = 2_000_000
"""Cells, so that many rays over a large grid take bounded memory."""


def crossed(grid: Grid, origin_m: Floats, ends_m: Floats) -> NDArray[np.bool_]:
    """Where the rays from the origin (2,) to the ends (n, 2) [m] go: (rows, columns), with their first and last cells.

    Only the part on the grid counts; the origin may lie outside. All is finite.
    """
    found = np.zeros(grid.rows * grid.columns, np.bool_)
    corner = np.array([grid.west_m, grid.south_m])
    origin, ends = (origin_m - corner) / grid.cell_m, (ends_m - corner) / grid.cell_m
    size = max(1, _MOST_AT_ONCE // (grid.rows + grid.columns))
    for first in range(0, len(ends), size):
        starts, stops = _clipped(origin, ends[first : first + size], np.array([grid.columns, grid.rows], np.float64))
        for cells in _cells(grid, starts, stops):
            found[cells] = True
    return found.reshape(grid.shape)


def _clipped(origin: Floats, ends: Floats, size: Floats) -> tuple[Floats, Floats]:
    """Where the rays are on the grid, from and to, in cells (m, 2), of those that are (Liang and Barsky, 1984)."""
    along = ends - origin
    with np.errstate(divide="ignore", invalid="ignore"):
        to_low, to_high = -origin / along, (size - origin) / along
    still = along == 0
    inside = (origin >= 0) & (origin <= size)
    enters = np.where(still, np.where(inside, -np.inf, np.inf), np.minimum(to_low, to_high))
    leaves = np.where(still, np.inf, np.maximum(to_low, to_high))
    begin, end = np.maximum(enters.max(axis=1), 0.0), np.minimum(leaves.min(axis=1), 1.0)
    on_grid = begin <= end
    along, begin, end = along[on_grid], begin[on_grid, None], end[on_grid, None]
    return np.clip(origin + begin * along, 0, size), np.clip(origin + end * along, 0, size)


def _cells(grid: Grid, starts: Floats, stops: Floats) -> Iterator[Indices]:
    """Numbers of the cells, many of them more than once: the first ones, then those that are entered over each axis."""
    last = np.array([grid.columns - 1, grid.rows - 1])
    first = np.minimum(starts.astype(np.int64), last)
    yield first[:, 1] * grid.columns + first[:, 0]
    steps = stops - starts
    for axis, other in ((0, 1), (1, 0)):
        low = np.floor(np.minimum(starts[:, axis], stops[:, axis])).astype(np.int64) + 1
        high = np.ceil(np.maximum(starts[:, axis], stops[:, axis])).astype(np.int64) - 1
        counts = np.maximum(high - low + 1, 0)
        ray = np.repeat(np.arange(len(starts)), counts)
        lines = np.arange(len(ray)) - np.repeat(np.cumsum(counts) - counts - low, counts)
        rate = np.divide(steps[:, other], steps[:, axis], out=np.zeros(len(steps)), where=counts > 0)
        across = starts[ray, other] + (lines - starts[ray, axis]) * rate[ray]
        entered = np.where(steps[ray, axis] > 0, lines, lines - 1)
        beside = np.clip(across.astype(np.int64), 0, last[other])
        rows, columns = (beside, entered) if axis == 0 else (entered, beside)
        yield rows * grid.columns + columns
