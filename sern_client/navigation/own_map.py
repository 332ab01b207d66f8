"""The map that the robot makes of its own scans: a whole grid for who comes late, and the blocks that change."""

from collections.abc import Callable
from typing import Final

from sern_core.vocabulary.types import Encoding
from sern_navigation.mapping import Mapped, Mapper, MapperOptions
from sern_navigation.scan import ObstacleScan
from sern_runtime.map_bodies import GRID, UPDATE, MapWriter
from sern_twin.world.grid import Grid
from sern_twin.world.map_updates import MapUpdates
from sern_twin.world.occupancy import Pose

Publish = Callable[[str, str, bytes, int], None]
"""Name, type, body and stamp of a message."""


class OwnMap:
    """`publish` says the map on `topic`, and what changes in it on `topic`_updates."""

    def __init__(self, grid: Grid, options: MapperOptions, encoding: Encoding, topic: str, publish: Publish) -> None:
        self.mapper: Final = Mapper(grid, options)
        self._writer = MapWriter(grid, encoding)
        self._updates = MapUpdates(grid)
        self._topic = topic
        self._publish = publish

    def add(self, pose: Pose, scan: ObstacleScan) -> Mapped:
        """Lay a scan down where it fits. Takes some milliseconds, in any one thread at a time."""
        return self.mapper.add(pose, scan)

    def tell(self, now_s: float, stamp_ns: int) -> None:
        """Publish what has changed since the last call."""
        due = self._updates.due(self.mapper.occupancy.classes(), now_s)
        if isinstance(due, tuple):
            for update in due:
                body = self._writer.update(update, stamp_ns=stamp_ns)
                self._publish(f"{self._topic}_updates", UPDATE, body, stamp_ns)
        else:
            self._publish(self._topic, GRID, self._writer.whole(due, stamp_ns=stamp_ns), stamp_ns)
