"""What of a map is published when."""

from typing import Any

import numpy as np
import pytest

from sern_core.vocabulary.errors import UsageError
from sern_twin.world.grid import Grid
from sern_twin.world.map_updates import MapUpdate, MapUpdateOptions, MapUpdates
from sern_twin.world.patches import FREE, OCCUPIED, UNKNOWN, Cells

GRID = Grid(0.0, 0.0, 0.1, 40, 30)
"""A grid of 3 by 2 blocks, those at its ends smaller."""


def applied(cells: Cells, due: Cells | tuple[MapUpdate, ...]) -> Cells:
    """A map after what was published, as a costmap has it."""
    if not isinstance(due, tuple):
        return due.copy()
    for update in due:
        height, width = update.cells.shape
        cells[update.row : update.row + height, update.column : update.column + width] = update.cells
    return cells


def test_the_whole_map_comes_first_then_what_changes_and_the_whole_again() -> None:
    updates = MapUpdates(GRID, MapUpdateOptions(whole_s=5.0, update_s=0.5))
    cells = np.full(GRID.shape, UNKNOWN, np.int8)
    assert not updates.idle(0.0) and not isinstance(updates.due(cells, 0.0), tuple)
    assert updates.idle(60.0) and updates.due(cells, 60.0) == ()
    cells[3, 5] = OCCUPIED
    (only,) = updates.due(cells, 60.0)
    assert isinstance(only, MapUpdate) and (only.row, only.column, only.cells.shape) == (0, 0, (16, 16))
    assert only.cells[3, 5] == OCCUPIED and (only.cells == UNKNOWN).sum() == 255
    cells[29, 39] = FREE
    assert not updates.idle(60.1)
    whole = updates.due(cells, 60.1)
    assert not isinstance(whole, tuple) and np.array_equal(whole, cells), "for those who come late"
    cells[29, 39] = OCCUPIED
    assert updates.due(cells, 60.3) == (), "so soon after it"
    (corner,) = updates.due(cells, 60.6)
    assert isinstance(corner, MapUpdate) and (corner.row, corner.column, corner.cells.shape) == (16, 32, (14, 8))
    assert updates.due(cells, 64.0) == () and not isinstance(updates.due(cells, 65.2), tuple)


def test_a_cell_that_flickers_and_is_back_is_nothing() -> None:
    updates, cells = MapUpdates(GRID), np.full(GRID.shape, FREE, np.int8)
    updates.due(cells, 0.0)
    flickering = cells.copy()
    flickering[0, 0] = OCCUPIED
    assert updates.due(flickering, 0.05) == () and updates.due(cells, 1.0) == ()


def test_no_block_waits_for_ever_where_all_change_all_the_time() -> None:
    options = MapUpdateOptions(whole_s=1000.0, update_s=0.1, most_blocks=2)
    updates, cells = MapUpdates(GRID, options), np.full(GRID.shape, FREE, np.int8)
    updates.due(cells, 0.0)
    told: list[tuple[int, int]] = []
    for step in range(1, 10):
        cells[:] = step
        due = updates.due(cells, step)
        assert isinstance(due, tuple) and len(due) == 2 and updates.waiting == 4
        told += [(update.row, update.column) for update in due]
    assert {told.count(place) for place in told} == {3} and len(set(told)) == 6


def test_whoever_takes_what_is_published_has_the_map_in_the_end() -> None:
    draw = np.random.default_rng(4)
    for _ in range(20):
        options = MapUpdateOptions(float(draw.uniform(0, 3)), float(draw.uniform(0, 0.5)), int(draw.integers(1, 7)))
        updates, now_s = MapUpdates(GRID, options), 0.0
        cells, theirs = np.full(GRID.shape, UNKNOWN, np.int8), np.full(GRID.shape, UNKNOWN, np.int8)
        last_whole_s = -np.inf
        for step in range(60):
            now_s += 0.1
            if step < 40:
                row, column = int(draw.integers(0, 30)), int(draw.integers(0, 40))
                cells[row : row + 9, column : column + 9] = draw.integers(-1, 101)
            due = updates.due(cells, now_s)
            theirs = applied(theirs, due)
            if isinstance(due, tuple):
                assert len(due) <= options.most_blocks
            else:
                assert now_s - last_whole_s >= options.whole_s - 1e-9
                last_whole_s = now_s
        assert np.array_equal(theirs, cells) and updates.waiting == 0


@pytest.mark.parametrize("wrong", [{"whole_s": -1.0}, {"update_s": np.inf}, {"whole_s": np.nan}, {"most_blocks": 0}])
def test_options_that_are_none_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(UsageError):
        MapUpdateOptions(**wrong)


def test_a_map_of_another_grid_is_refused() -> None:
    with pytest.raises(UsageError):
        MapUpdates(GRID).due(np.zeros((3, 3), np.int8), 0.0)


def test_where_nothing_changes_each_block_comes_again_in_turn() -> None:
    grid = Grid(0.0, 0.0, 0.1, 8, 8, block_cells=4)
    updates = MapUpdates(grid, MapUpdateOptions(repeat_s=1.0))
    cells = np.zeros(grid.shape, np.int8)
    assert updates.idle(-5.0) is False and isinstance(updates.due(cells, 0.0), np.ndarray)
    assert updates.idle(0.9) and updates.due(cells, 0.9) == ()
    found = []
    for now_s in (1.0, 2.0, 3.0, 4.0, 5.0):
        assert not updates.idle(now_s)
        due = updates.due(cells, now_s)
        assert isinstance(due, tuple)
        found += [(each.column, each.row) for each in due]
    assert found == [(0, 0), (4, 0), (0, 4), (4, 4), (0, 0)]
    assert updates.idle(100.0) is False and MapUpdates(grid).idle(100.0) is False, "the first map is still to come"
