"""Where the twin and what a robot sees do not agree: things in the twin that are not there, and things that are.

A cell is occupied, or clear, once three of the last five scans around it said so, and stays that until three of five
say otherwise: one alone may be off. What they say, the twin may be a match radius off: the twin's place of a wall, the
cells' size and the robot's own pose are. Of what the twin has since then, scans before say nothing. A cell that differs
does so until the twin or the scans say otherwise, and one scan is too little for that. What is left is joined into
discrepancies, each with a number that it keeps while it lasts. The robot's own sensors are right, always: `correction`
is what the twin is to have there.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sern_core.vocabulary.errors import UsageError
from sern_twin.world.grid import Grid, need_cells
from sern_twin.world.patches import FREE, LASTING, OCCUPIED, UNKNOWN, Cells

SCANS: Final = 5
AGREEING: Final = 3
"""So many of the last `SCANS` decide. Not of those that saw a cell: behind a thin wall only those are that were off."""
RADIUS_CELLS: Final = 2
"""The match radius at the least."""
POSE_ERRORS: Final = 2.0
"""The match radius is so many times how far off the robot's pose may be."""
RANGE_M: Final = 8.0
"""What is further away from a scanner is not compared: half a degree is 7 cm there, and 18 cm at 20 m."""
RIM_M: Final = 0.5
"""Scans count so much further: else of a thing at the rim of what is compared the rest would not be known to be clear,
and it would be told when all of it is near."""
LEAST_CELLS: Final = 2
"""One cell alone is not said: it flickers at the edges of things."""
KEEPS_S: Final = 2.0
"""A thing that was gone for no longer has the number that it had."""
MOST: Final = 64
"""The largest are said where there are more."""
Mask = NDArray[np.bool_]
_ALL_AROUND: Final = np.ones((3, 3), np.bool_)
_LAST: Final = (1 << SCANS) - 1
_COUNTS: Final = np.array([number.bit_count() for number in range(_LAST + 1)], np.uint8)


class DiscrepancyKind(StrEnum):
    PHANTOM = "phantom"
    """The twin has something where scans see through."""
    UNKNOWN_OBSTACLE = "unknown_obstacle"
    """Scans see something where the twin says that it is free."""


@dataclass(frozen=True, slots=True)
class Discrepancy:
    """`number` is the same while it lasts. `east_m`, `north_m`: its middle; `radius_m`: of the circle around it, about
    the middle. `since_s`: when it was found, by the clock of `compare`."""

    number: int
    kind: DiscrepancyKind
    east_m: float
    north_m: float
    radius_m: float
    cells: int
    since_s: float


@dataclass(frozen=True, slots=True)
class SeenDiscrepancy:
    """A discrepancy as its owner, whose scanners found it, told all sites."""

    object_id: str
    owner: str
    kind: DiscrepancyKind
    east_m: float
    north_m: float
    radius_m: float
    cells: int
    corrected: bool = False
    """Its owner's patches correct it on the map."""

    @property
    def says(self) -> str:
        if self.kind is DiscrepancyKind.PHANTOM:
            return f"phantom: {self.owner} sees nothing there" + (", free on the map" if self.corrected else "")
        return f"unknown obstacle: {self.owner} sees it"


class Discrepancies:
    """`saw` with each scan, `compare` with the twin as often as it is to be known. `left_out` counts those beyond
    `MOST` in the last comparison."""

    def __init__(self, grid: Grid) -> None:
        self._grid = grid
        self._ends: NDArray[np.uint8] = np.zeros(grid.shape, np.uint8)
        """A bit for each of the last scans around the cell: a ray ended in it. The newest is the lowest."""
        self._passes: NDArray[np.uint8] = np.zeros(grid.shape, np.uint8)
        """The same: a ray passed."""
        self._occupied: Mask = np.zeros(grid.shape, np.bool_)
        self._clear: Mask = np.zeros(grid.shape, np.bool_)
        self._had: Mask | None = None
        """Cells in which the twin had something in the last comparison."""
        self._compared: Mask = np.zeros(grid.shape, np.bool_)
        """Cells that were within `RANGE_M` of a scan."""
        self._found: dict[DiscrepancyKind, Mask] = {kind: np.zeros(grid.shape, np.bool_) for kind in DiscrepancyKind}
        self._known: list[tuple[Discrepancy, NDArray[np.int64], float]] = []
        """Those of the last moments, with their cells and when they were found last; the newest first."""
        self._told: tuple[tuple[DiscrepancyKind, NDArray[np.int64]], ...] = ()
        self._numbers = 0
        self.left_out = 0

    def saw(self, free: Mask, occupied: Mask, from_m: tuple[float, float] | None = None) -> None:
        """One scan: through which cells it saw, and in which it ended, (rows, columns) each. `from_m`: where its
        scanner was; what is further than `RANGE_M` and a rim from there says nothing. None: all counts.

        UsageError: another shape than the grid's.
        """
        if free.shape != self._grid.shape or occupied.shape != self._grid.shape:
            raise UsageError(f"a scan of {free.shape} and {occupied.shape} cells on a grid of {self._grid.shape}")
        rows, columns, around = self._around(from_m, RANGE_M)
        self._compared[rows, columns] |= around
        rows, columns, around = self._around(from_m, RANGE_M + RIM_M)
        ends, passes = self._ends[rows, columns], self._passes[rows, columns]
        ended, passed = occupied[rows, columns], free[rows, columns]
        for bits, said in ((ends, ended), (passes, passed & ~ended)):
            bits[around] = (bits[around] << 1 | said[around]) & _LAST
        ended, passed = _COUNTS[ends] >= AGREEING, _COUNTS[passes] >= AGREEING
        for state, begins, over in ((self._occupied, ended, passed), (self._clear, passed, ended)):
            state[rows, columns] = (state[rows, columns] | begins) & ~over

    def _around(self, place_m: tuple[float, float] | None, range_m: float) -> tuple[slice, slice, Mask]:
        """Cells that are so near to a place: a rectangle, and which of its cells."""
        grid = self._grid
        if place_m is None:
            return slice(0, grid.rows), slice(0, grid.columns), np.ones(grid.shape, np.bool_)
        across = grid.centres(0, np.arange(grid.columns))[:, 0] - place_m[0]
        along = grid.centres(np.arange(grid.rows), 0)[:, 1] - place_m[1]
        rows, columns = (slice(*np.searchsorted(apart_m, (-range_m, range_m)).tolist()) for apart_m in (along, across))
        near: Mask = along[rows, None] ** 2 + across[columns] ** 2 <= range_m**2
        return rows, columns, near

    @property
    def occupied(self) -> Mask:
        """Cells in which scans end."""
        return self._occupied.copy()

    @property
    def clear(self) -> Mask:
        """Cells through which scans see."""
        return self._clear.copy()

    def cells(self, kind: DiscrepancyKind) -> Mask:
        """Cells of all discrepancies of a kind, as of the last comparison, single ones too."""
        return self._found[kind].copy()

    def correction(self) -> Cells:
        """What the twin is to have by the last comparison, (rows, columns): free in phantoms that it gave, occupied in
        unknown obstacles, and unknown where it is not wrong."""
        found: Cells = np.full(self._grid.shape, UNKNOWN, np.int8)
        for kind, cells in self._told:
            found.reshape(-1)[cells] = FREE if kind is DiscrepancyKind.PHANTOM else OCCUPIED
        return found

    def unobserved(self, twin: Cells) -> Mask:
        """Cells that the twin has something in, and of which the scans say nothing."""
        need_cells(twin, self._grid.shape, "a twin")
        unseen: Mask = (twin >= OCCUPIED) & ~self._occupied & ~self._clear
        return unseen

    def compare(self, twin: Cells, *, now_s: float, pose_error_m: float = 0.0) -> tuple[Discrepancy, ...]:
        """What is not as the twin has it, (rows, columns); unknown and LASTING cells of the twin are no discrepancy.

        UsageError: cells that are not the grid's, a pose error that is below 0 or not finite.
        """
        need_cells(twin, self._grid.shape, "a twin")
        if not 0 <= pose_error_m < np.inf:
            raise UsageError(f"a pose error of {pose_error_m} m")
        has, occupied, compared = twin >= OCCUPIED, self._occupied, self._compared
        if self._had is not None:
            # It may have come since: what was seen through before is to be seen through again.
            new = has & ~self._had
            self._clear[new], self._passes[new] = False, 0
        self._had = has
        # Rays that graze a wall see through its outermost cells: a phantom is clear as deep as the twin may be off, and
        # one end in it speaks for it.
        anything = occupied | (self._ends > 0) | (has & ~self._clear)
        radius_cells = max(float(RADIUS_CELLS), POSE_ERRORS * pose_error_m / self._grid.cell_m)
        seen_through, not_known = has & self._clear & compared, (twin == FREE) & occupied & compared
        before = self._found[DiscrepancyKind.PHANTOM] & seen_through
        phantom = _beyond(seen_through, anything, radius_cells) | _beyond(before, occupied, radius_cells)
        self._found = {
            DiscrepancyKind.PHANTOM: phantom,
            DiscrepancyKind.UNKNOWN_OBSTACLE: _beyond(not_known, twin >= LASTING, radius_cells),
        }
        found = [each for kind, mask in self._found.items() for each in self._joined(kind, mask, now_s)]
        found.sort(key=lambda each: -each[0].cells)
        self.left_out = max(0, len(found) - MOST)
        self._told = tuple((thing.kind, cells) for thing, cells in found[:MOST])
        return self._numbered(found[:MOST], now_s)

    def _joined(self, kind: DiscrepancyKind, mask: Mask, now_s: float) -> list[tuple[Discrepancy, NDArray[np.int64]]]:
        """Cells that touch, or have two others between them at the most, are one thing."""
        if not mask.any():
            return []
        labels, count = ndimage.label(ndimage.binary_dilation(mask, _ALL_AROUND), _ALL_AROUND)
        labels[~mask] = 0
        found = []
        for label, window in enumerate(ndimage.find_objects(labels, count), start=1):
            assert window is not None
            rows, columns = np.nonzero(labels[window] == label)
            if len(rows) < LEAST_CELLS:
                continue
            rows, columns = rows + window[0].start, columns + window[1].start
            places = self._grid.centres(rows, columns)
            middle = places.mean(axis=0)
            radius_m = float(np.hypot(*(places - middle).T).max()) + self._grid.cell_m / 2
            thing = Discrepancy(0, kind, float(middle[0]), float(middle[1]), radius_m, len(rows), now_s)
            found.append((thing, rows * self._grid.columns + columns))
        return found

    def _numbered(
        self, found: Sequence[tuple[Discrepancy, NDArray[np.int64]]], now_s: float
    ) -> tuple[Discrepancy, ...]:
        """Each takes the number of the one before with which it has the most cells in common."""
        left = [known for known in self._known if now_s - known[2] <= KEEPS_S][: 2 * MOST]
        made = []
        for thing, cells in found:
            shared = [
                np.isin(cells, before, assume_unique=True).sum() if known.kind is thing.kind else 0
                for known, before, _last_s in left
            ]
            if shared and max(shared) > 0:
                known = left.pop(int(np.argmax(shared)))[0]
                made.append((replace(thing, number=known.number, since_s=known.since_s), cells, now_s))
            else:
                self._numbers += 1
                made.append((replace(thing, number=self._numbers), cells, now_s))
        self._known = made + left
        return tuple(thing for thing, _cells, _last_s in made)


def _beyond(cells: Mask, others: Mask, radius_cells: float) -> Mask:
    """Those cells that are further than the radius from all others."""
    if not cells.any() or not others.any():
        return cells
    rows, columns = (_window(np.flatnonzero(cells.any(axis=1 - axis)), radius_cells) for axis in (0, 1))
    near = others[rows, columns]
    found = np.zeros_like(cells)
    found[rows, columns] = cells[rows, columns]
    if near.any():
        found[rows, columns] &= ndimage.distance_transform_edt(~near) > radius_cells
    return found


def _window(places: NDArray[np.int64], radius_cells: float) -> slice:
    margin = int(radius_cells) + 1
    return slice(max(0, int(places[0]) - margin), int(places[-1]) + margin + 1)
