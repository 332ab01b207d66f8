"""Occupied cells as boxes, with the ages of their blocks."""

import math

import numpy as np
import pytest

from sern_client.endpoints.twin.view.blocks import HEIGHT_M, MOST_BOXES, boxes
from sern_twin.world.grid import Grid
from sern_twin.world.patches import OCCUPIED

GRID = Grid(-8.0, -4.0, 0.5, 64, 32, block_cells=16)


def test_an_occupied_cell_is_a_box_as_old_as_its_block() -> None:
    cells = np.full(GRID.shape, -1, np.int8)
    cells[0, 0], cells[20, 40], cells[5, 5] = OCCUPIED, 100, OCCUPIED - 1
    ages_s = np.full(GRID.blocks, np.nan)
    ages_s[int(GRID.block_of(20, 40))] = 7.0
    first, second = boxes(GRID, cells, ages_s)
    assert first[:4] == (-7.75, -3.75, 0.5, HEIGHT_M) and math.isnan(first.age_s)
    assert second == (12.25, 6.25, 0.5, HEIGHT_M, 7.0)


def test_nothing_that_is_occupied_is_no_box() -> None:
    assert boxes(GRID, np.zeros(GRID.shape, np.int8), np.zeros(GRID.blocks)) == []


def test_more_cells_than_a_browser_draws_are_joined_and_none_is_lost() -> None:
    grid = Grid(0.0, 0.0, 0.1, 400, 301, block_cells=50)
    cells = np.full(grid.shape, OCCUPIED, np.int8)
    ages_s = np.arange(grid.blocks, dtype=np.float64)
    ages_s[0] = np.nan
    found = boxes(grid, cells, ages_s)
    assert 0 < len(found) <= MOST_BOXES and len(found) == 100 * 76
    assert {box.size_m for box in found} == {4 * 0.1}
    assert found[0][:2] == pytest.approx((0.2, 0.2)) and math.isnan(found[0].age_s)
    east = [box.x_m + box.size_m / 2 for box in found]
    north = [box.y_m + box.size_m / 2 for box in found]
    assert max(east) == pytest.approx(40.0) and max(north) == pytest.approx(30.4)
    at_edge = next(box for box in found if box.x_m == pytest.approx(5.0) and box.y_m == pytest.approx(0.2))
    assert at_edge.age_s == 1.0, "of a box over two blocks that of the younger counts: the other has none"
