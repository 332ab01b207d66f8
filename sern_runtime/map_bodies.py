"""Bodies of maps: nav_msgs/OccupancyGrid of all cells, map_msgs/OccupancyGridUpdate of some."""

from typing import Any, Final

from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_geometry, ros_types
from sern_twin.world.grid import Grid
from sern_twin.world.map_updates import MapUpdate
from sern_twin.world.patches import Cells

GRID: Final = "nav_msgs/msg/OccupancyGrid"
UPDATE: Final = "map_msgs/msg/OccupancyGridUpdate"


class MapWriter:
    """Maps of one grid, in the grid's frame and in one encoding."""

    def __init__(self, grid: Grid, encoding: Encoding) -> None:
        self._grid = grid
        self._encoding = encoding
        self._seq = 0

    def whole(self, cells: Cells, *, stamp_ns: int) -> bytes:
        """A nav_msgs/OccupancyGrid of all cells, (rows, columns)."""
        grid, encoding = self._grid, self._encoding
        info = ros_types.new(
            "nav_msgs/msg/MapMetaData",
            encoding,
            map_load_time=ros_types.time_of(stamp_ns, encoding),
            resolution=grid.cell_m,
            width=grid.columns,
            height=grid.rows,
            origin=self.upright(grid.west_m, grid.south_m, 0.0),
        )
        message = ros_types.new(GRID, encoding, header=self.header(stamp_ns), info=info, data=cells.reshape(-1))
        return ros_types.serialise(message, GRID, encoding)

    def update(self, update: MapUpdate, *, stamp_ns: int) -> bytes:
        """A map_msgs/OccupancyGridUpdate of a rectangle."""
        height, width = update.cells.shape
        message = ros_types.new(
            UPDATE,
            self._encoding,
            header=self.header(stamp_ns),
            x=update.column,
            y=update.row,
            width=width,
            height=height,
            data=update.cells.reshape(-1),
        )
        return ros_types.serialise(message, UPDATE, self._encoding)

    def upright(self, x_m: float, y_m: float, z_m: float) -> Any:
        """A geometry_msgs/Pose that is not turned."""
        return ros_geometry.pose(self._encoding, x_m, y_m, z_m)

    def header(self, stamp_ns: int) -> Any:
        """A std_msgs/Header of the next message; a ROS 1 header counts them."""
        self._seq = (self._seq + 1) & 0xFFFFFFFF
        return ros_types.header(stamp_ns, self._grid.frame_id, self._encoding, self._seq)
