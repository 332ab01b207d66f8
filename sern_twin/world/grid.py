"""Where the cells and blocks of a site lie: rows from south to north, columns from west to east, as in nav_msgs."""

import math
import struct
from dataclasses import dataclass
from functools import cached_property
from hashlib import sha256
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sern_core.vocabulary.errors import UsageError
from sern_twin.geodesy import TangentPlane
from sern_twin.motion import MOST_M

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

MOST_CELLS: Final = 4_000_000
MOST_SIDE: Final = 65_535
"""Rows, columns: a patch has 16 bits for each."""
MOST_BLOCKS: Final = 65_536
BLOCK_CELLS: Final = range(4, 65)
"""Cells along the side of a block. The patch of the largest block has 4 kB at the most."""
MOST_NAME: Final = 256
NOWHERE: Final = -1
"""The row, column or number of what is not on the grid."""
_ID_BYTES: Final = 8


@dataclass(frozen=True)
class Grid:
    """A rectangle of square cells in the plane of a site. Its south-west corner lies at `west_m`, `south_m`.

    `plane` says where that is on the Earth, where it is known; `frame_id` is the ROS frame of its east and north. Two
    grids that are equal but for the plane have the same `grid_id`. Blocks are squares of `block_cells` cells, cut at
    the north and east.

    UsageError: a size that is none, or more than `MOST_CELLS`, `MOST_SIDE` or `MOST_BLOCKS`.
    """

    west_m: float
    south_m: float
    cell_m: float
    columns: int
    rows: int
    block_cells: int = 16
    plane: TangentPlane | None = None
    frame_id: str = "map"

    def __post_init__(self) -> None:
        if not (math.isfinite(self.cell_m) and self.cell_m > 0):
            raise UsageError(f"a grid with cells of {self.cell_m} m: give a size above 0")
        if not (1 <= self.columns <= MOST_SIDE and 1 <= self.rows <= MOST_SIDE):
            raise UsageError(f"a grid of {self.columns} x {self.rows} cells: give 1 to {MOST_SIDE} for each")
        if self.columns * self.rows > MOST_CELLS:
            raise UsageError(
                f"a grid of {self.columns} x {self.rows} cells: {MOST_CELLS} are the most; take larger cells"
            )
        if self.block_cells not in BLOCK_CELLS:
            raise UsageError(f"blocks of {self.block_cells} cells: give {BLOCK_CELLS.start} to {BLOCK_CELLS.stop - 1}")
        if self.block_rows * self.block_columns > MOST_BLOCKS:
            raise UsageError(
                f"a grid of {self.block_columns} x {self.block_rows} blocks: {MOST_BLOCKS} are the most; "
                "give more block_cells"
            )
        corners = (self.west_m, self.south_m, self.east_m, self.north_m)
        if not all(abs(corner) <= MOST_M for corner in corners):  # and no NaN
            raise UsageError(f"a grid with its corners at {corners} m: they lie within {MOST_M:.0f} m of the origin")
        if len(self.frame_id) > MOST_NAME:
            raise UsageError(f"a frame_id of {len(self.frame_id)} characters: {MOST_NAME} are the most")

    @property
    def east_m(self) -> float:
        return self.west_m + self.columns * self.cell_m

    @property
    def north_m(self) -> float:
        return self.south_m + self.rows * self.cell_m

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns): that of every array of cells."""
        return self.rows, self.columns

    @property
    def block_rows(self) -> int:
        return -(-self.rows // self.block_cells)

    @property
    def block_columns(self) -> int:
        return -(-self.columns // self.block_cells)

    @property
    def blocks(self) -> int:
        """How many there are. They are numbered row by row, from the south-west."""
        return self.block_rows * self.block_columns

    @cached_property
    def grid_id(self) -> str:
        """16 hexadecimal digits that are the same wherever all of the above is but `plane`: a patch says which grid it
        is for. Where the frame is on the Earth a site with a map knows, and a robot need not."""
        words = [self.frame_id]
        places = [self.west_m, self.south_m, self.cell_m]
        numbers = struct.pack("<3I", self.columns, self.rows, self.block_cells)
        told = struct.pack(f"<{len(places)}d", *(place + 0.0 for place in places))  # -0.0 is 0.0
        return sha256(numbers + told + "\0".join(words).encode("utf-8", "surrogatepass")).hexdigest()[: 2 * _ID_BYTES]

    def index(self, points: ArrayLike) -> tuple[Indices, Indices]:
        """Rows and columns of points [m], (..., 2) or more: east and north come first.

        Both are `NOWHERE` for what is not on the grid or not finite. The west and south edges belong to a cell.
        """
        places = np.asarray(points, np.float64)
        with np.errstate(over="ignore"):  # infinite is outside, too
            across = (places[..., 0] - self.west_m) / self.cell_m
            along = (places[..., 1] - self.south_m) / self.cell_m
        inside = (across >= 0) & (across < self.columns) & (along >= 0) & (along < self.rows)
        columns = np.where(inside, across, NOWHERE).astype(np.int64)
        rows = np.where(inside, along, NOWHERE).astype(np.int64)
        return rows, columns

    def flat(self, points: ArrayLike) -> Indices:
        """Numbers of the cells at points [m], row by row, as `cells.ravel()` has them; `NOWHERE` as in `index`."""
        rows, columns = self.index(points)
        found: Indices = np.where(rows == NOWHERE, NOWHERE, rows * self.columns + columns)
        return found

    def centres(self, rows: ArrayLike, columns: ArrayLike) -> Floats:
        """East and north [m] of the middles of cells, (..., 2). Rows and columns may have fractions."""
        easts = self.west_m + (np.asarray(columns, np.float64) + 0.5) * self.cell_m
        norths = self.south_m + (np.asarray(rows, np.float64) + 0.5) * self.cell_m
        return np.stack(np.broadcast_arrays(easts, norths), axis=-1)

    def all_centres(self) -> Floats:
        """East and north [m] of the middles of all cells, (rows, columns, 2)."""
        return self.centres(np.arange(self.rows)[:, None], np.arange(self.columns))

    def block_of(self, rows: ArrayLike, columns: ArrayLike) -> Indices:
        """Numbers of the blocks of cells; `NOWHERE` where the cell is not on the grid."""
        across, along = np.asarray(columns, np.int64), np.asarray(rows, np.int64)
        inside = (across >= 0) & (across < self.columns) & (along >= 0) & (along < self.rows)
        numbers = along // self.block_cells * self.block_columns + across // self.block_cells
        found: Indices = np.where(inside, numbers, NOWHERE)
        return found

    def block_place(self, block: int) -> tuple[int, int]:
        """Its row and column among the blocks. UsageError: there is no such block."""
        if not 0 <= block < self.blocks:
            raise UsageError(f"block {block} of a grid that has {self.blocks}: give 0 to {self.blocks - 1}")
        return divmod(block, self.block_columns)

    def block_slices(self, block: int) -> tuple[slice, slice]:
        """Rows and columns of its cells. UsageError: there is no such block."""
        row, column = self.block_place(block)
        size = self.block_cells
        return (
            slice(row * size, min((row + 1) * size, self.rows)),
            slice(column * size, min((column + 1) * size, self.columns)),
        )

    def blocks_where(self, cells: NDArray[np.bool_]) -> Indices:
        """Numbers of the blocks with a cell that is true, rising. `cells` is (rows, columns)."""
        rows, columns = np.nonzero(cells)
        return np.unique(self.block_of(rows, columns))

    def to_geodetic(self, points: ArrayLike) -> Floats:
        """Latitude, longitude [rad] and height [m] of points at the site, (..., 3). UsageError: there is no plane."""
        return self._plane().to_geodetic(points)

    def to_local(self, points: ArrayLike) -> Floats:
        """East, north and up [m] of latitudes, longitudes [rad] and heights [m], (..., 3). UsageError as above."""
        return self._plane().to_local(points)

    def _plane(self) -> TangentPlane:
        if self.plane is None:
            raise UsageError("the grid does not say where on the Earth it is: give it a plane")
        return self.plane


def need_cells(cells: NDArray[np.int8], shape: tuple[int, int], what: str) -> None:
    """UsageError: cells that are not int8 of that shape, or not -1 (unknown) to 100, as in nav_msgs/OccupancyGrid."""
    if cells.shape != shape or cells.dtype != np.int8:
        raise UsageError(f"{what}: cells of {cells.shape} {cells.dtype}: give int8 of {shape}")
    if cells.size and (cells.min() < -1 or cells.max() > 100):
        raise UsageError(f"{what}: cells from {cells.min()} to {cells.max()}: give -1 (unknown) to 100 (occupied)")
