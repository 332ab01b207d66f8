"""The map that scans make, and the robot's place on it: a scan is matched, then laid down where it fits.

To publish it, give `mapper.occupancy.classes()` to `sern_twin.world.map_updates.MapUpdates`, and what is due to
`sern_runtime.map_bodies.MapWriter`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final

import numpy as np

from sern_core.vocabulary.errors import UsageError
from sern_navigation.matching import Match, MatchOptions, NoMatch, match
from sern_navigation.scan import ObstacleScan, turned
from sern_twin.world.grid import Floats, Grid
from sern_twin.world.occupancy import Occupancy, OccupancyOptions, Pose
from sern_twin.world.patches import UNKNOWN


class Placed(StrEnum):
    """How the place of a scan was found."""

    MATCHED = "matched"
    PREDICTED = "predicted"
    """There was nothing to match it with: it is laid down where the robot is thought to be."""
    REFUSED = "refused"
    """It does not fit the map: it is not laid down, or it would smear it."""


@dataclass(frozen=True, slots=True)
class MapperOptions:
    """UsageError: a range that is not above 0."""

    matching: MatchOptions = field(default_factory=MatchOptions)
    occupancy: OccupancyOptions = field(default_factory=OccupancyOptions)
    free_m: float = 6.0
    """How far a bearing is free without an obstacle, if ground was seen up to there."""

    def __post_init__(self) -> None:
        if not 0 < self.free_m <= 100:
            raise UsageError(f"a mapper with free_m {self.free_m}: give a number above 0, up to 100")


@dataclass(frozen=True, slots=True, eq=False)
class Mapped:
    """Where the robot was at a scan. `match` has the covariance; without one, `reason` says why."""

    pose: Pose
    placed: Placed
    match: Match | None = None
    reason: NoMatch | None = None


_TOO_LITTLE: Final = frozenset({NoMatch.FEW_POINTS, NoMatch.EMPTY_MAP, NoMatch.LITTLE_OVERLAP})

_OCCUPIED: Final = 65
"""Per cent: so a cell is occupied for the next scan once one has ended in it. A scene waits for more."""


class Mapper:
    """One map, all unknown at first."""

    def __init__(self, grid: Grid, options: MapperOptions | None = None) -> None:
        self.grid: Final = grid
        self._options = options or MapperOptions()
        self.occupancy: Final = Occupancy(grid, self._options.occupancy)
        self._counts = dict.fromkeys(Placed, 0)
        self._reasons = dict.fromkeys(NoMatch, 0)

    @property
    def counts(self) -> Mapping[Placed, int]:
        """How many scans were placed how."""
        return self._counts

    @property
    def reasons(self) -> Mapping[NoMatch, int]:
        """How many were not matched, and why."""
        return self._reasons

    def add(self, prediction: Pose, scan: ObstacleScan) -> Mapped:
        """Take a scan of a robot that is thought to be there. Nothing is raised, whatever the numbers are."""
        cells = self.occupancy.cells()
        found = match(self.grid, cells >= _OCCUPIED, cells != UNKNOWN, prediction, ends_m(scan), self._options.matching)
        if isinstance(found, Match):
            mapped = Mapped(found.pose, Placed.MATCHED, found)
        else:
            self._reasons[found] += 1
            mapped = Mapped(prediction, Placed.PREDICTED if found in _TOO_LITTLE else Placed.REFUSED, None, found)
        self._counts[mapped.placed] += 1
        if mapped.placed is not Placed.REFUSED:
            self._lay(mapped.pose, scan)
        return mapped

    def _lay(self, pose: Pose, scan: ObstacleScan) -> None:
        forward_m, left_m = turned(np.array(scan.origin_m), pose[2]).tolist()
        scanner = pose[0] + forward_m, pose[1] + left_m, pose[2]
        furthest_m = float(scan.bins_m[-1])
        stands = np.isfinite(scan.ranges_m) & ~scan.drops
        if stands.any():
            self.occupancy.fuse(scanner, scan.bearings_rad[stands], scan.ranges_m[stands], furthest_m + 1)
        open_m = min(self._options.free_m, furthest_m)
        free = ~np.isfinite(scan.ranges_m) & (scan.ground_m[:, 1] >= open_m)
        if free.any():
            self.occupancy.fuse(scanner, scan.bearings_rad[free], np.full(int(free.sum()), np.inf), open_m)


def ends_m(scan: ObstacleScan) -> Floats:
    """Where S_2D ends on something that stands, (n, 2) in the robot's frame. Edges look another way from elsewhere."""
    stands = np.isfinite(scan.ranges_m) & ~scan.drops
    bearings = scan.bearings_rad[stands]
    found: Floats = scan.ranges_m[stands, None] * np.stack((np.cos(bearings), np.sin(bearings)), axis=1) + scan.origin_m
    return found
