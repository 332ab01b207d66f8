"""What of a map is to be published when: the whole of it now and then, between them what has changed.

As nav_msgs/OccupancyGrid, latched, and map_msgs/OccupancyGridUpdate are used: who comes late gets the last whole map,
and each update after that. Both are bounded: so many blocks at once, so often; a block that waits is published as it is
when its turn comes. A map whose cells are percentages changes wherever it is seen: publish `Occupancy.classes`.
"""

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sern_core.vocabulary.errors import UsageError
from sern_twin.world.grid import Grid, need_cells
from sern_twin.world.patches import UNKNOWN, Cells


@dataclass(frozen=True, slots=True)
class MapUpdateOptions:
    """UsageError: periods that are below 0 or not finite, or no blocks."""

    whole_s: float = 5.0
    """How often the whole map is published at the most, if there were updates since, or too many are to come."""
    update_s: float = 0.1
    """How often updates are, at the most."""
    most_blocks: int = 64
    """The most blocks that are updated at once."""
    repeat_s: float = math.inf
    """One block is updated so long after the last message although it is as it was, in turn: who missed an update has
    it in the end, and hears that the map is of now. Infinite: never."""

    def __post_init__(self) -> None:
        periods = 0 <= self.whole_s < math.inf and 0 <= self.update_s < math.inf and self.repeat_s > 0
        if not (periods and self.most_blocks >= 1):
            raise UsageError(
                f"a map whole every {self.whole_s} s, updated every {self.update_s} s in {self.most_blocks} blocks: "
                "give periods of 0 or more, and 1 block or more"
            )


class MapUpdate(NamedTuple):
    """A rectangle of the map, (height, width) of int8, whose first cell lies at `column`, `row` from the south-west."""

    column: int
    row: int
    cells: Cells


class MapUpdates:
    """Ask `due` as often as the map may have changed."""

    def __init__(self, grid: Grid, options: MapUpdateOptions | None = None) -> None:
        self.grid: Final = grid
        self._options = options or MapUpdateOptions()
        self._published: Cells = np.full(grid.shape, UNKNOWN, np.int8)
        self._waits: NDArray[np.int64] = np.zeros(grid.blocks, np.int64)
        """How often a block has waited for its turn since it was published."""
        self._behind = True
        """The last whole map is not what was published since."""
        self._whole_due_s = -math.inf
        self._update_due_s = -math.inf
        self._repeat_due_s = math.inf
        self._repeated = -1

    @property
    def waiting(self) -> int:
        """How many blocks had to wait the last time."""
        return int(np.count_nonzero(self._waits))

    def idle(self, now_s: float) -> bool:
        """Whether `due` has nothing, if no cell has changed since it was asked last."""
        behind = self._behind and now_s >= self._whole_due_s
        return not self.waiting and not behind and now_s < self._repeat_due_s

    def due(self, cells: Cells, now_s: float) -> Cells | tuple[MapUpdate, ...]:
        """What is to be published of a map, (rows, columns): all of it, or updates of blocks, or none. What is returned
        counts as published.

        UsageError: cells that are not the grid's.
        """
        need_cells(cells, self.grid.shape, "a map")
        changed = self.grid.blocks_where(cells != self._published)
        # A change after a quiet time is told by itself: a whole map is large, and comes later.
        if now_s >= self._whole_due_s and (self._behind or len(changed) > self._options.most_blocks):
            self._whole_due_s, self._update_due_s = now_s + self._options.whole_s, now_s + self._options.update_s
            self._behind = False
            self._waits[:] = 0
            self._repeat_due_s = now_s + self._options.repeat_s
            self._published = cells.copy()
            return self._published.copy()
        if not len(changed) and now_s >= self._repeat_due_s:
            self._repeat_due_s = now_s + self._options.repeat_s
            self._repeated = (self._repeated + 1) % self.grid.blocks
            return (self._update(self._repeated),)
        if not len(changed) or now_s < self._update_due_s:
            return ()
        self._update_due_s = now_s + self._options.update_s
        self._repeat_due_s = now_s + self._options.repeat_s
        self._behind = True
        # Those that have waited longest come first, so that none waits for ever.
        self._waits[np.setdiff1d(np.flatnonzero(self._waits), changed)] = 0  # changed, and changed back
        order = changed[np.argsort(-self._waits[changed], kind="stable")]
        self._waits[order] += 1
        found = []
        for block in order[: self._options.most_blocks].tolist():
            rows, columns = self.grid.block_slices(block)
            self._published[rows, columns] = cells[rows, columns]
            self._waits[block] = 0
            found.append(self._update(block))
        return tuple(found)

    def _update(self, block: int) -> MapUpdate:
        rows, columns = self.grid.block_slices(block)
        return MapUpdate(columns.start, rows.start, np.ascontiguousarray(self._published[rows, columns]))
