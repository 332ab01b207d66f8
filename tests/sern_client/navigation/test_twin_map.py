"""The map of the twin as it comes: a whole one, then what changes."""

import numpy as np
import pytest

from sern_client.navigation.hearing import HeardUpdate
from sern_client.navigation.twin_map import TwinMap, UpdateOutcome
from sern_navigation.costmap.static import MapOutcome
from sern_twin.world.grid import Grid

GRID = Grid(0.0, 0.0, 0.1, 40, 20)
FREE = np.zeros((20, 40), np.int8)


def update(column: int, row: int, frame_id: str = "map", value: int = 100) -> HeardUpdate:
    return HeardUpdate(frame_id, column, row, np.full((2, 3), value, np.int8))


def test_updates_change_the_last_whole_map_and_make_it_one_of_now() -> None:
    twin = TwinMap(GRID)
    assert twin.whole(GRID, FREE, now_s=1.0) is MapOutcome.TAKEN
    first = twin.view()
    assert first is not None and twin.view() is None, "it is told once"
    assert twin.update(update(4, 5), now_s=2.5) is UpdateOutcome.TAKEN
    second = twin.view()
    assert second is not None and second.stamp_s == 2.5
    assert second.cells[5:7, 4:7].all() and np.count_nonzero(second.cells) == 6
    assert not first.cells.any(), "what was given away does not change"


@pytest.mark.parametrize(
    ("heard", "outcome"),
    [
        (update(38, 0), UpdateOutcome.OUTSIDE),
        (update(0, 19), UpdateOutcome.OUTSIDE),
        (update(-1, 0), UpdateOutcome.OUTSIDE),
        (update(0, 0, "odom"), UpdateOutcome.OTHER_FRAME),
        (update(0, 0, value=101), UpdateOutcome.VALUES),
        (update(0, 0, value=-2), UpdateOutcome.VALUES),
    ],
)
def test_an_update_that_does_not_fit_is_counted(heard: HeardUpdate, outcome: UpdateOutcome) -> None:
    twin = TwinMap(GRID)
    twin.whole(GRID, FREE, now_s=1.0)
    assert twin.update(heard, now_s=2.0) is outcome
    assert twin.outcomes == {"map_taken": 1, f"update_{outcome.value}": 1} and twin.stamp_s == 1.0


def test_an_update_before_any_map_and_a_map_of_another_grid() -> None:
    twin = TwinMap(GRID)
    assert twin.update(update(0, 0), now_s=1.0) is UpdateOutcome.NO_MAP
    assert twin.whole(Grid(0.0, 0.0, 0.2, 40, 20), FREE, now_s=1.0) is MapOutcome.OTHER_RESOLUTION
    assert "does not fit the grid (other_resolution)" in twin.problem and twin.view() is None
    twin.whole(GRID, FREE, now_s=1.0)
    assert not twin.problem
