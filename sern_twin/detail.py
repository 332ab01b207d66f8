"""Which blocks of a scene are kept how fine: the paper's eq. (lod) and Algorithm lod_hyst, with a dwell.

A block in the important region has level HIGH, near it MEDIUM, else LOW. Between `near_m` and `far_m` a block keeps
MEDIUM if it had more than LOW. A block gets finer at once, and coarser only when that was due for `dwell_s` without a
break: the edge of the region moves with the robot, and a block on it would change with every step.
"""

from dataclasses import dataclass
from enum import IntEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sern_core.vocabulary.errors import UsageError


class Level(IntEnum):
    LOW = 0
    MEDIUM = 1
    HIGH = 2


Levels = NDArray[np.int8]
DWELL_S: Final = 0.5


@dataclass(frozen=True, slots=True)
class DetailOptions:
    """`near_m` and `far_m` are the paper's ρ↓ and ρ↑. UsageError: not 0 < near < far, or a dwell below 0."""

    near_m: float
    far_m: float
    dwell_s: float = DWELL_S

    def __post_init__(self) -> None:
        if not (0 < self.near_m < self.far_m and self.dwell_s >= 0):
            raise UsageError(
                f"levels of detail with near {self.near_m} m, far {self.far_m} m, dwell {self.dwell_s} s: "
                "0 < near < far, and no dwell below 0"
            )


def proximity_m(important: NDArray[np.bool_], block_m: float) -> NDArray[np.float64]:
    """The distance [m] of each block's middle to that of the nearest important one; infinite where there is none."""
    if not important.any():
        return np.full(important.shape, np.inf)
    found: NDArray[np.float64] = ndimage.distance_transform_edt(~important, sampling=block_m)
    return found


class LevelOfDetail:
    """The levels of a grid of blocks, all LOW at first."""

    def __init__(self, shape: tuple[int, int], block_m: float, options: DetailOptions) -> None:
        if not block_m > 0:
            raise UsageError(f"blocks of {block_m} m: give a size above 0")
        self._block_m = block_m
        self._options = options
        self._levels: Levels = np.full(shape, Level.LOW, np.int8)
        self._due_since_s = np.full(shape, np.inf)
        """Since when each block ought to be coarser; infinite: it ought not."""

    @property
    def levels(self) -> Levels:
        """A copy, in the shape of the grid."""
        return self._levels.copy()

    def update(self, important: NDArray[np.bool_], *, now: float) -> NDArray[np.bool_]:
        """Take the important region of this moment. Where the level is another than before.

        A clock that goes back makes nothing coarser before its time. UsageError: another shape than the grid's.
        """
        if important.shape != self._levels.shape:
            raise UsageError(f"a region of {important.shape} blocks for a grid of {self._levels.shape}")
        distance_m = proximity_m(important, self._block_m)
        near = distance_m < self._options.near_m
        stays = (distance_m < self._options.far_m) & (self._levels != Level.LOW)
        wanted = np.where(important, Level.HIGH, np.where(near | stays, Level.MEDIUM, Level.LOW)).astype(np.int8)

        coarser = wanted < self._levels
        begins = coarser & ~(self._due_since_s <= now)
        self._due_since_s[~coarser] = np.inf
        self._due_since_s[begins] = now
        waits = coarser & (now - self._due_since_s < self._options.dwell_s)
        levels = np.where(waits, self._levels, wanted)
        changed: NDArray[np.bool_] = levels != self._levels
        self._due_since_s[changed] = np.inf
        self._levels = levels
        return changed
