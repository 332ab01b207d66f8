"""An obstacle mask: which cells around the robot are in its way, as a nav_msgs/OccupancyGrid of a cloud.

A cell with an obstacle or a drop-off in it is 100, one where only ground was seen is 0, any other is -1 (unknown).
"""

from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sern_core.summaries.clouds import read_cloud
from sern_core.summaries.grids import Grid, GridFrame, write_grid
from sern_core.summaries.obstacles import Band, ObstacleFinder
from sern_core.vocabulary.errors import UsageError
from sern_core.vocabulary.types import Encoding

OCCUPIED: Final = 100
FREE: Final = 0
UNKNOWN: Final = -1
MAX_CELLS: Final = 2**22


@dataclass(frozen=True, slots=True)
class MaskParams:
    """A square of `size_m`, centred on the origin of the cloud's frame, in cells of `resolution_m`."""

    band: Band = field(default_factory=Band)
    size_m: float = 20.0
    resolution_m: float = 0.1

    @property
    def side(self) -> int:
        """Cells along one side: an even number, so that the robot stands on a corner of four."""
        return 2 * max(round(self.size_m / self.resolution_m / 2), 1)


class MaskMaker:
    """Makes the masks of one topic's clouds."""

    def __init__(self, params: MaskParams) -> None:
        """UsageError for a mask of no size or of more than 2^22 cells."""
        if not (params.size_m > 0 and params.resolution_m > 0 and params.side**2 <= MAX_CELLS):
            raise UsageError(f"a mask of {params.size_m} m in cells of {params.resolution_m} m is not made")
        self.params = params
        self._finder = ObstacleFinder(params.band)

    def _set(self, cells: NDArray[np.int8], points: NDArray[np.float64], value: int) -> None:
        half, side = self.params.side // 2, self.params.side
        at = np.floor(points / self.params.resolution_m).astype(np.intp) + half
        at = at[((at >= 0) & (at < side)).all(axis=1)]
        cells[at[:, 1], at[:, 0]] = value

    def mask(self, body: bytes, encoding: Encoding) -> bytes:
        """An OccupancyGrid body of a PointCloud2 body, with its stamp and frame. BodyError."""
        cloud = read_cloud(body, encoding)
        found = self._finder.find(cloud)
        side, resolution_m = self.params.side, self.params.resolution_m
        cells = np.full((side, side), UNKNOWN, np.int8)
        self._set(cells, found.ground, FREE)
        self._set(cells, found.obstacles, OCCUPIED)
        self._set(cells, found.drop_offs, OCCUPIED)
        corner_m = -side // 2 * resolution_m
        frame = GridFrame(resolution_m, side, side, (corner_m, corner_m, found.plane.offset_m), (0.0, 0.0, 0.0, 1.0))
        # A mask is made anew each time: it was loaded when the cloud was taken.
        load_time = (cloud.header.sec, cloud.header.nanosec)
        return write_grid(Grid(cloud.header, load_time, frame, cells), encoding)
