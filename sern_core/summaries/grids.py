"""nav_msgs/OccupancyGrid and map_msgs/OccupancyGridUpdate bodies as numpy arrays over the same bytes.

    OccupancyGrid        header | map_load_time | resolution (float32) | width | height | origin (7 float64) | data[]
    OccupancyGridUpdate  header | x | y (int32) | width | height | data[]

Cells are int8, row by row from the origin: -1 unknown, 0 free, 100 occupied. `cells` is (height, width).
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sern_core.summaries.bodies import BodyReader, BodyWriter, Header
from sern_core.vocabulary.errors import BodyError
from sern_core.vocabulary.types import Encoding

GRID_TYPE: Final = "nav_msgs/msg/OccupancyGrid"
UPDATE_TYPE: Final = "map_msgs/msg/OccupancyGridUpdate"


@dataclass(frozen=True, slots=True)
class GridFrame:
    """nav_msgs/MapMetaData without its load time: two grids with equal frames have the same cells."""

    resolution_m: float
    width: int
    height: int
    position: tuple[float, ...]  # x, y, z of the first cell's corner, metres
    orientation: tuple[float, ...]  # x, y, z, w


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    header: Header
    load_time: tuple[int, int]
    frame: GridFrame
    cells: NDArray[np.int8]


@dataclass(frozen=True, slots=True, eq=False)
class GridUpdate:
    """Cells of a rectangle whose first is in column `x`, row `y` of the grid."""

    header: Header
    x: int
    y: int
    cells: NDArray[np.int8]


def _cells(data: memoryview, width: int, height: int) -> NDArray[np.int8]:
    if len(data) != width * height:
        raise BodyError(f"{len(data)} cells for a grid of {width} x {height}")
    return np.frombuffer(data, np.int8).reshape(height, width)


def read_grid(body: bytes, encoding: Encoding) -> Grid:
    """The grid in `body`, as a view of it. BodyError."""
    reader = BodyReader(body, encoding)
    header = reader.header()
    load_time = reader.time()
    resolution_m, width, height = reader.f32(), reader.u32(), reader.u32()
    position, orientation = reader.f64s(3), reader.f64s(4)
    cells = _cells(reader.array(1), width, height)
    reader.end()
    return Grid(header, load_time, GridFrame(resolution_m, width, height, position, orientation), cells)


def write_grid(grid: Grid, encoding: Encoding) -> bytes:
    writer = BodyWriter(encoding)
    writer.header(grid.header)
    writer.time(*grid.load_time)
    frame = grid.frame
    writer.f32(frame.resolution_m)
    writer.u32(frame.width)
    writer.u32(frame.height)
    writer.f64s(frame.position)
    writer.f64s(frame.orientation)
    writer.array(grid.cells.tobytes(), 1)
    return writer.body()


def read_update(body: bytes, encoding: Encoding) -> GridUpdate:
    """The update in `body`, as a view of it. BodyError."""
    reader = BodyReader(body, encoding)
    header = reader.header()
    x, y = reader.i32(), reader.i32()
    width, height = reader.u32(), reader.u32()
    cells = _cells(reader.array(1), width, height)
    reader.end()
    return GridUpdate(header, x, y, cells)


def write_update(update: GridUpdate, encoding: Encoding) -> bytes:
    writer = BodyWriter(encoding)
    writer.header(update.header)
    writer.i32(update.x)
    writer.i32(update.y)
    writer.u32(update.cells.shape[1])
    writer.u32(update.cells.shape[0])
    writer.array(update.cells.tobytes(), 1)
    return writer.body()
