"""Costs at places, windows of a grid, and the map's layer."""

import math
from dataclasses import replace

import numpy as np
import pytest

from sern_core.vocabulary.errors import UsageError
from sern_navigation.costmap.costs import LETHAL_OBSTACLE, NO_INFORMATION, Costmap, around, whole
from sern_navigation.costmap.static import MapOutcome, StaticLayer, StaticOptions
from sern_twin.world.grid import Grid

GRID = Grid(-5.0, -4.0, 0.25, 40, 32)


def test_costs_at_places() -> None:
    costs = np.arange(GRID.rows * GRID.columns).reshape(GRID.shape).astype(np.uint8)
    costmap = Costmap(GRID, costs, np.full(GRID.shape, 7, np.uint8))
    assert costmap.at(np.array([-4.9, -3.9])) == 0 and costmap.at(np.array([[-4.6, -3.9]])).tolist() == [1]
    outside = np.array([[9.0, 0.0], [math.nan, 0.0], [0.0, -math.inf]])
    assert costmap.at(outside).tolist() == [LETHAL_OBSTACLE] * 3
    assert np.count_nonzero(costmap.blocked()) == np.count_nonzero((costs == 253) | (costs == 254))
    assert costmap.weights().max() == 262, "the twin's costs are added"


@pytest.mark.parametrize(
    ("x_m", "y_m", "radius_m"), [(0.1, 0.1, 1.0), (-4.9, -3.9, 0.6), (4.9, 3.9, 2.0), (0.0, 0.0, 50.0)]
)
def test_a_window_has_the_cells_around_a_place(x_m: float, y_m: float, radius_m: float) -> None:
    window = around(GRID, x_m, y_m, radius_m)
    rows, columns = window.slices
    for (row, column), _ in np.ndenumerate(np.empty(GRID.shape)):
        east, north = GRID.centres(row, column)
        away = max(abs(east - x_m), abs(north - y_m))
        inside = rows.start <= row < rows.stop and columns.start <= column < columns.stop
        if abs(away - radius_m) > GRID.cell_m / 2 + 1e-9:
            assert inside == (away < radius_m), (row, column)
    small = window.grid_of(GRID)
    assert small.shape == (rows.stop - rows.start, columns.stop - columns.start)
    assert small.centres(0, 0) == pytest.approx(GRID.centres(rows.start, columns.start))


def test_a_window_far_off_is_empty_and_one_grows_within_the_grid() -> None:
    assert around(GRID, 50.0, 0.0, 1.0).empty and around(GRID, -50.0, 0.0, 1.0).empty
    larger = around(GRID, 4.9, 3.9, 0.3).grown(2, GRID)
    assert (larger.end_row, larger.end_column) == GRID.shape
    assert whole(GRID).grown(5, GRID) == whole(GRID)
    inner = around(GRID, 0.1, 0.1, 0.3)
    cells = np.arange(GRID.rows * GRID.columns).reshape(GRID.shape)
    larger = inner.grown(3, GRID)
    assert (cells[larger.slices][inner.within(larger)] == cells[inner.slices]).all()


def test_a_map_is_trinary_unless_asked_for_more() -> None:
    cells = np.zeros(GRID.shape, np.int8)
    cells[0, :5] = [-1, 0, 50, 99, 100]
    layer = StaticLayer(GRID)
    assert (layer.costs == NO_INFORMATION).all()
    assert layer.take(GRID, cells) is MapOutcome.TAKEN
    assert layer.costs[0, :5].tolist() == [255, 0, 0, 0, 254]
    scaled = StaticLayer(GRID, StaticOptions(lethal_cost_threshold=65, trinary_costmap=False))
    scaled.take(GRID, cells)
    assert scaled.costs[0, :5].tolist() == [255, 0, 195, 254, 254], "50 of 65 is 195 of 254"


def test_a_map_that_does_not_fit_says_why_and_changes_nothing() -> None:
    cells = np.zeros(GRID.shape, np.int8)
    layer = StaticLayer(GRID)
    layer.take(GRID, np.full(GRID.shape, 100, np.int8))
    wrong = cells.copy()
    wrong[3, 3] = 101
    cases = [
        (replace(GRID, cell_m=0.1), cells, MapOutcome.OTHER_RESOLUTION),
        (replace(GRID, frame_id="odom"), cells, MapOutcome.OTHER_FRAME),
        (replace(GRID, west_m=0.0), cells, MapOutcome.OTHER_PLACE),
        (replace(GRID, columns=39), np.zeros((32, 39), np.int8), MapOutcome.OTHER_PLACE),
        (GRID, cells[1:], MapOutcome.CELLS),
        (GRID, wrong, MapOutcome.CELLS),
        (GRID, wrong - 103, MapOutcome.CELLS),
        (GRID, cells.astype(np.float64), MapOutcome.CELLS),
    ]
    for grid, some, outcome in cases:
        assert layer.take(grid, some) is outcome  # type: ignore[arg-type]
    assert (layer.costs == LETHAL_OBSTACLE).all()
    assert sum(layer.counts.values()) == 9 and layer.counts[MapOutcome.CELLS] == 4


@pytest.mark.parametrize("threshold", [0, 101])
def test_a_threshold_that_is_none_is_refused(threshold: int) -> None:
    with pytest.raises(UsageError, match="lethal_cost_threshold"):
        StaticOptions(lethal_cost_threshold=threshold)
