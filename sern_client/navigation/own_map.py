"""The map that the robot makes of its own scans: a whole grid for who comes late, and the blocks that change."""

from collections.abc import Callable
from typing import Final

import numpy as np

from sern_client.scene.bodies import GRID, UPDATE, Writer
from sern_core.vocabulary.types import Encoding
from sern_navigation.mapping import Mapped, Mapper, MapperOptions
from sern_navigation.scan import ObstacleScan
from sern_twin.world.grid import Grid
from sern_twin.world.occupancy import Pose
from sern_twin.world.patches import Cells

WHOLE_S: Final = 5.0
"""How often the whole map is published at most."""
MOST_UPDATES: Final = 64
"""Where more blocks change at once, the whole map is published."""
Publish = Callable[[str, str, bytes, int], None]
"""Name, type, body and stamp of a message."""


class OwnMap:
    """`publish` says the map on `topic`, and what changes in it on `topic`_updates."""

    def __init__(self, grid: Grid, options: MapperOptions, encoding: Encoding, topic: str, publish: Publish) -> None:
        self.mapper: Final = Mapper(grid, options)
        self._grid = grid
        self._writer = Writer(grid, encoding)
        self._topic = topic
        self._publish = publish
        self._told: Cells | None = None
        self._whole_due_s = 0.0
        self._stale = False

    def add(self, pose: Pose, scan: ObstacleScan) -> Mapped:
        """Lay a scan down where it fits. Takes some milliseconds, in any one thread at a time."""
        return self.mapper.add(pose, scan)

    def tell(self, now_s: float, stamp_ns: int) -> None:
        """Publish what has changed since the last call."""
        cells = self.mapper.occupancy.classes()
        changed = self._changed(cells)
        if self._told is None or len(changed) > MOST_UPDATES or (self._stale and now_s >= self._whole_due_s):
            self._whole_due_s, self._stale = now_s + WHOLE_S, False
            self._publish(self._topic, GRID, self._writer.whole(cells, stamp_ns=stamp_ns), stamp_ns)
        else:
            self._stale = self._stale or bool(changed)
            for block in changed:
                update = self._writer.update(cells, block, stamp_ns=stamp_ns)
                self._publish(f"{self._topic}_updates", UPDATE, update, stamp_ns)
        self._told = cells

    def _changed(self, cells: Cells) -> list[int]:
        if self._told is None:
            return []
        rows, columns = np.nonzero(cells != self._told)
        size, across = self._grid.block_cells, self._grid.block_columns
        return sorted(set((rows // size * across + columns // size).tolist()))
