"""A robot that touches something gets away from it, and never any nearer."""

import numpy as np
import pytest

from sern_navigation.costmap.costs import Costmap
from sern_navigation.costmap.escape import escaping
from sern_navigation.costmap.layered import LayeredCostmap
from sern_twin.world.grid import Grid
from tests.exploring import seeds
from tests.sern_navigation.worlds import filled

GRID = Grid(-3.0, -3.0, 0.1, 60, 60)


def costmap_of(*areas: tuple[float, float, float, float]) -> Costmap:
    layered = LayeredCostmap(GRID)
    layered.static.take(GRID, filled(GRID, *areas))
    return layered.everywhere(0.0)


@pytest.mark.parametrize("pose", [(-2.0, 0.0, 0.0), (1.05, 0.05, 0.0), (9.0, 0.0, 0.0)])
def test_where_it_touches_nothing_all_is_as_it_was(pose: tuple[float, float, float]) -> None:
    """In free space, in what is lethal, and off the map."""
    costmap = costmap_of((1.0, 0.0, 1.1, 0.1))
    assert escaping(costmap, pose) is costmap


def test_a_way_out_is_free_and_a_way_in_is_not() -> None:
    costmap = costmap_of((1.0, -1.0, 1.5, 1.0))
    found = escaping(costmap, (0.8, 0.0, 0.0))
    assert costmap.at(np.array([0.8, 0.0])) == 253 and found.at(np.array([0.8, 0.0])) == 252
    assert found.at(np.array([0.7, 0.0])) == 252 and found.at(np.array([0.8, 0.5])) == 252, "away, and along it"
    assert found.at(np.array([0.92, 0.0])) == 253 and found.at(np.array([1.2, 0.0])) == 254


@pytest.mark.parametrize("seed", seeds(10))
def test_only_what_is_no_nearer_is_freed(seed: int) -> None:
    random = np.random.default_rng(seed)
    areas = [(x, y, x + 0.3, y + 0.3) for x, y in random.uniform(-2.5, 2.5, (12, 2)).tolist()]
    costmap = costmap_of(*areas)
    lethal = GRID.centres(*np.nonzero(costmap.costs == 254))
    touching = np.argwhere(costmap.costs == 253)
    row, column = touching[random.integers(len(touching))]
    x_m, y_m = GRID.centres(row, column).tolist()
    found = escaping(costmap, (x_m, y_m, 0.0))
    freed = GRID.centres(*np.nonzero(found.costs != costmap.costs))
    now_m = np.hypot(*(lethal - [x_m, y_m]).T).min()
    assert len(freed) and (found.costs == 254).sum() == (costmap.costs == 254).sum()
    for place in freed:
        assert np.hypot(*(lethal - place).T).min() >= now_m - 1e-9
