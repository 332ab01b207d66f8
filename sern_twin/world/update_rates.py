"""How often each block of a scene is told: the paper's "Patch based update policy" (eq. lod, Algorithm lod_hyst).

Blocks near a robot and where somebody added something are important, and told as often as they change; those around
them less often, and all others seldom. What is told is the block as it is then, so nothing is wrong for longer.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sern_core.vocabulary.errors import UsageError
from sern_twin.detail import DetailOptions, LevelOfDetail
from sern_twin.world.grid import Grid

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class UpdateRateOptions:
    """Blocks whose middle is within `important_m` of a robot are important; `near_m` and `far_m` are the thresholds ρ↓
    and ρ↑ of the distance to those. UsageError: as `DetailOptions`, or a number that is below 0 or not finite."""

    important_m: float = 8.0
    near_m: float = 8.0
    far_m: float = 12.0
    medium_s: float = 0.5
    low_s: float = 2.0

    def __post_init__(self) -> None:
        for name in ("important_m", "medium_s", "low_s"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise UsageError(f"update rates: {name} is {value}: give a number from 0 up")
        DetailOptions(self.near_m, self.far_m)


class UpdateRates:
    """`look` at where robots are, from time to time; `due` before, and `told` after blocks are told."""

    def __init__(self, grid: Grid, options: UpdateRateOptions | None = None) -> None:
        self._options = options or UpdateRateOptions()
        self._shape = grid.block_rows, grid.block_columns
        block_m = grid.block_cells * grid.cell_m
        self._grid = grid
        rows, columns = np.indices(self._shape)
        self._middles_m = np.stack(
            (grid.west_m + (columns + 0.5) * block_m, grid.south_m + (rows + 0.5) * block_m), axis=-1
        )
        self._levels = LevelOfDetail(self._shape, block_m, DetailOptions(self._options.near_m, self._options.far_m))
        self._told_s: NDArray[np.float64] = np.full(grid.blocks, -np.inf)
        self._periods_s: Final = np.array([self._options.low_s, self._options.medium_s, 0.0])
        """By `Level`: LOW, MEDIUM, HIGH."""

    @property
    def levels(self) -> NDArray[np.int8]:
        """The `Level` of each block, (blocks,)."""
        return self._levels.levels.ravel()

    def look(self, robots_m: ArrayLike, landmarks: Mask, *, now: float) -> None:
        """`robots_m`: where robots are, (n, 2); `landmarks`: cells in which somebody added something."""
        important: Mask = np.zeros(self._shape, np.bool_)
        for place in np.asarray(robots_m, np.float64).reshape(-1, 2):
            important |= np.hypot(*np.moveaxis(self._middles_m - place, -1, 0)) <= self._options.important_m
        important.reshape(-1)[self._grid.blocks_where(landmarks)] = True
        self._levels.update(important, now=now)

    def due(self, now: float) -> Mask:
        """Which blocks may be told now, (blocks,)."""
        found: Mask = now - self._told_s >= self._periods_s[self.levels]
        return found

    def told(self, block: int, now: float) -> None:
        self._told_s[block] = now
