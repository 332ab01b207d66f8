"""The map of the twin, as it comes over the link: a whole grid, then blocks of it that change."""

from enum import StrEnum
from typing import Final

from sern_client.navigation.hearing import HeardUpdate
from sern_navigation.costmap.static import MapOutcome, fits
from sern_navigation.costmap.twin import TwinView
from sern_twin.world.grid import Grid
from sern_twin.world.patches import UNKNOWN, Cells


class UpdateOutcome(StrEnum):
    """What became of an update."""

    TAKEN = "taken"
    NO_MAP = "no_map"
    """It came before any map."""
    OTHER_FRAME = "other_frame"
    OUTSIDE = "outside"
    VALUES = "values"
    """They are none of -1 to 100."""


class TwinMap:
    """What the twin has, and when something last came of it."""

    def __init__(self, grid: Grid) -> None:
        self.grid: Final = grid
        self.outcomes: dict[str, int] = {}
        """How many maps and updates came, by what became of them."""
        self.problem = ""
        """Why the last map was not taken."""
        self.stamp_s: float | None = None
        self._cells: Cells | None = None
        self._view: TwinView | None = None

    def whole(self, grid: Grid, cells: Cells, *, now_s: float) -> MapOutcome:
        """A whole map. One that does not fit leaves what was there."""
        outcome = fits(self.grid, grid, cells)
        self._count(f"map_{outcome.value}")
        if outcome is MapOutcome.TAKEN:
            self._cells, self.stamp_s, self._view, self.problem = cells.copy(), now_s, None, ""
        else:
            self.problem = f"the twin's map does not fit the grid ({outcome.value})"
        return outcome

    def update(self, update: HeardUpdate, *, now_s: float) -> UpdateOutcome:
        """Some cells of it."""
        outcome = self._fits(update)
        self._count(f"update_{outcome.value}")
        if outcome is UpdateOutcome.TAKEN and self._cells is not None:
            rows, columns = update.cells.shape
            self._cells = self._cells.copy()  # the one before is with the navigator
            self._cells[update.row : update.row + rows, update.column : update.column + columns] = update.cells
            self.stamp_s, self._view = now_s, None
        return outcome

    def view(self) -> TwinView | None:
        """What is new since the last call; None: nothing."""
        if self._cells is None or self.stamp_s is None or self._view is not None:
            return None
        self._view = TwinView(self.grid, self._cells, self.stamp_s)
        return self._view

    def _fits(self, update: HeardUpdate) -> UpdateOutcome:
        if self._cells is None:
            return UpdateOutcome.NO_MAP
        if update.frame_id != self.grid.frame_id:
            return UpdateOutcome.OTHER_FRAME
        rows, columns = update.cells.shape
        if min(update.row, update.column) < 0 or (
            update.row + rows > self.grid.rows or update.column + columns > self.grid.columns
        ):
            return UpdateOutcome.OUTSIDE
        if update.cells.min() < UNKNOWN or update.cells.max() > 100:
            return UpdateOutcome.VALUES
        return UpdateOutcome.TAKEN

    def _count(self, what: str) -> None:
        self.outcomes[what] = self.outcomes.get(what, 0) + 1
