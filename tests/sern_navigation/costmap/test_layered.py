"""The twin's layer, and all layers together."""

import math
from dataclasses import replace

import numpy as np
import pytest

from sern_core.vocabulary.errors import UsageError
from sern_navigation.costmap.costs import NO_INFORMATION, whole
from sern_navigation.costmap.inflation import InflationOptions
from sern_navigation.costmap.layered import CostmapOptions, LayeredCostmap
from sern_navigation.costmap.obstacles import ObstacleOptions
from sern_navigation.costmap.static import MapOutcome
from sern_navigation.costmap.twin import TwinLayer, TwinOptions, TwinView
from sern_navigation.scan import Cloud, ObstacleScan, ScanOptions, obstacle_scan
from sern_twin.world.grid import Grid
from tests.exploring import seeds
from tests.sern_navigation.worlds import empty_map, filled, level, looking_at

GRID = Grid(-6.0, -6.0, 0.1, 120, 120)
NOWHERE_FREE = np.zeros(GRID.shape, np.bool_)


def layer_of(*areas: tuple[float, float, float, float], stamp_s: float = 0.0) -> TwinLayer:
    layer = TwinLayer(GRID, InflationOptions())
    assert layer.take(TwinView(GRID, filled(GRID, *areas), stamp_s)) is MapOutcome.TAKEN
    return layer


def seeing(*, pose: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> LayeredCostmap:
    costmap = LayeredCostmap(GRID, CostmapOptions(obstacles=ObstacleOptions(5.0, 0.0, 5.5)))
    scan = obstacle_scan(Cloud(looking_at(level), 0.0), ScanOptions())
    assert isinstance(scan, ObstacleScan)
    costmap.obstacles.observe(pose, scan)
    return costmap


def test_the_twin_makes_ways_dearer_and_blocks_none() -> None:
    soft = layer_of((1.0, 1.0, 2.0, 2.0)).soft(0.0, whole(GRID), NOWHERE_FREE)
    row = GRID.index(np.array([1.5, 1.5]))[0]
    assert soft.max() == 150 and soft[row, 60 + 15] == 150 and soft[row, 60 + 23] > soft[row, 60 + 25] > 0
    assert soft[row, 60 - 5] == 0


def test_what_is_stale_or_early_counts_nothing() -> None:
    layer = layer_of((1.0, 1.0, 2.0, 2.0), stamp_s=10.0)
    for now_s, counts in ((10.0, True), (11.9, True), (12.1, False), (8.1, True), (7.0, False)):
        assert layer.fresh(now_s) == counts
        assert bool(layer.soft(now_s, whole(GRID), NOWHERE_FREE).any()) == counts
    assert not TwinLayer(GRID, InflationOptions()).fresh(0.0), "nothing was ever heard"
    layer.take(TwinView(GRID, filled(GRID, (1.0, 1.0, 2.0, 2.0)), math.nan))
    assert not layer.fresh(10.0)


def test_a_view_that_does_not_fit_changes_nothing() -> None:
    layer = layer_of((1.0, 1.0, 2.0, 2.0))
    before = layer.soft(0.0, whole(GRID), NOWHERE_FREE)
    assert layer.take(TwinView(replace(GRID, cell_m=0.2), empty_map(GRID), 0.0)) is MapOutcome.OTHER_RESOLUTION
    assert layer.take(TwinView(GRID, empty_map(GRID)[1:], 0.0)) is MapOutcome.CELLS
    assert (layer.soft(0.0, whole(GRID), NOWHERE_FREE) == before).all()
    assert layer.counts[MapOutcome.TAKEN] == 1 and layer.counts[MapOutcome.CELLS] == 1


def test_a_phantom_that_real_scans_have_cleared_counts_nothing() -> None:
    costmap = seeing()
    costmap.twin.take(TwinView(GRID, filled(GRID, (2.0, -0.5, 2.6, 0.5)), 0.0))
    assert not costmap.everywhere(0.0).soft.any()
    unseen = LayeredCostmap(GRID)
    unseen.twin.take(TwinView(GRID, filled(GRID, (2.0, -0.5, 2.6, 0.5)), 0.0))
    assert unseen.everywhere(0.0).soft.any()


@pytest.mark.parametrize("seed", seeds(10))
def test_real_costs_are_the_same_whatever_the_twin_says(seed: int) -> None:
    random = np.random.default_rng(seed)
    with_twin, without = seeing(), seeing()
    cells = np.where(random.random(GRID.shape) < 0.02, 100, 0).astype(np.int8)
    for costmap in (with_twin, without):
        assert costmap.static.take(GRID, cells) is MapOutcome.TAKEN
    with_twin.twin.take(TwinView(GRID, random.integers(-1, 101, GRID.shape).astype(np.int8), 0.0))
    one, other = with_twin.everywhere(0.0), without.everywhere(0.0)
    assert (one.costs == other.costs).all() and (one.blocked() == other.blocked()).all()
    assert one.soft.any() and not other.soft.any()


@pytest.mark.parametrize("seed", seeds(10))
def test_a_window_is_cut_out_of_the_whole(seed: int) -> None:
    random = np.random.default_rng(seed)
    costmap = seeing(pose=(1.0, 1.0, 0.5))
    costmap.static.take(GRID, np.where(random.random(GRID.shape) < 0.01, 100, -1).astype(np.int8))
    costmap.twin.take(TwinView(GRID, np.where(random.random(GRID.shape) < 0.01, 100, 0).astype(np.int8), 0.0))
    all_of_it = costmap.everywhere(0.0)
    x_m, y_m = random.uniform(-7, 7, 2)
    local = costmap.local(0.0, float(x_m), float(y_m), 2.0)
    if local is None:
        assert max(abs(x_m), abs(y_m)) > 6.0
        return
    rows, columns = GRID.index(local.grid.all_centres())
    assert (local.costs == all_of_it.costs[rows, columns]).all() and (local.soft == all_of_it.soft[rows, columns]).all()


def test_map_and_scans_together() -> None:
    """As updateWithMax: the map's walls stay, whatever scans see; what only one of them knows is known."""
    costmap = seeing()
    cells = filled(GRID, (2.0, -0.5, 2.6, 0.5))
    cells[:20] = -1
    costmap.static.take(GRID, cells)
    found = costmap.everywhere(0.0)
    assert found.at(np.array([2.3, 0.0])) == 254 and found.at(np.array([-5.9, 0.0])) == 0
    assert found.at(np.array([5.9, -5.9])) == NO_INFORMATION
    assert costmap.local(0.0, 100.0, 0.0, 2.0) is None


@pytest.mark.parametrize("change", [{"cost": 253}, {"cost": -1}, {"staleness_s": math.nan}, {"occupied": 0}])
def test_options_that_could_block_are_refused(change: dict[str, float]) -> None:
    with pytest.raises(UsageError, match="the twin's"):
        TwinOptions(**change)  # type: ignore[arg-type]
