"""Inflation: Nav2's numbers, never less than before, and what is unknown."""

import math

import numpy as np
import pytest

from sern_core.vocabulary.errors import UsageError
from sern_navigation.costmap.costs import (
    FREE_SPACE,
    INSCRIBED_INFLATED_OBSTACLE,
    LETHAL_OBSTACLE,
    NO_INFORMATION,
    Costs,
)
from sern_navigation.costmap.inflation import InflationOptions, inflate
from tests.exploring import seeds

CELL_M = 0.05


def by_hand(distance_m: float, options: InflationOptions) -> int:
    """InflationLayer::computeCost of nav2_costmap_2d, line by line."""
    if distance_m == 0:
        return LETHAL_OBSTACLE
    if distance_m <= options.inscribed_radius:
        return INSCRIBED_INFLATED_OBSTACLE
    factor = math.exp(-1.0 * options.cost_scaling_factor * (distance_m - options.inscribed_radius))
    return int((INSCRIBED_INFLATED_OBSTACLE - 1) * factor)


def one_obstacle(size: int = 41) -> Costs:
    costs = np.zeros((size, size), np.uint8)
    costs[size // 2, size // 2] = LETHAL_OBSTACLE
    return costs


@pytest.mark.parametrize(
    "options", [InflationOptions(), InflationOptions(0.55, 10.0, 0.2), InflationOptions(0.3, 0.0, 0.0)]
)
def test_costs_around_an_obstacle_are_those_of_nav2(options: InflationOptions) -> None:
    found = inflate(one_obstacle(), options.table(CELL_M))
    reach = math.ceil(options.inflation_radius / CELL_M)
    for (row, column), cost in np.ndenumerate(found):
        cells = math.hypot(row - 20, column - 20)
        assert cost == (by_hand(cells * CELL_M, options) if cells <= reach else FREE_SPACE), (row, column)


def test_the_default_costs() -> None:
    """0.70 m and 3.0 with a radius of 0.33 m: the numbers of a row away from an obstacle, cells of 10 cm."""
    costs = np.zeros((1, 12), np.uint8)
    costs[0, 0] = LETHAL_OBSTACLE
    assert inflate(costs, InflationOptions().table(0.1))[0].tolist() == [
        254, 253, 253, 253, 204, 151, 112, 83, 0, 0, 0, 0,
    ]  # fmt: skip


@pytest.mark.parametrize("seed", seeds(10))
def test_nothing_costs_less_than_before(seed: int) -> None:
    random = np.random.default_rng(seed)
    costs = random.integers(0, 256, (30, 40)).astype(np.uint8)
    found = inflate(costs, InflationOptions().table(0.1))
    known = costs != NO_INFORMATION
    assert (found[known] >= costs[known]).all()
    assert ((found == LETHAL_OBSTACLE) == (costs == LETHAL_OBSTACLE)).all(), "an obstacle stays, and none is made"


def test_what_is_unknown_is_known_where_the_robot_would_touch() -> None:
    costs = np.full((1, 12), NO_INFORMATION, np.uint8)
    costs[0, 0] = LETHAL_OBSTACLE
    table = InflationOptions().table(0.1)
    assert inflate(costs, table)[0, :6].tolist() == [254, 253, 253, 253, 255, 255]
    assert inflate(costs, table, inflate_unknown=True)[0, :9].tolist() == [254, 253, 253, 253, 204, 151, 112, 83, 255]


def test_without_obstacles_nothing_changes() -> None:
    costs = np.array([[0, 100, 255]], np.uint8)
    found = inflate(costs, InflationOptions().table(0.1))
    assert (found == costs).all() and found is not costs


@pytest.mark.parametrize("wrong", [-0.1, math.nan, math.inf])
def test_options_that_are_none_are_refused(wrong: float) -> None:
    for name in ("inflation_radius", "cost_scaling_factor", "inscribed_radius"):
        with pytest.raises(UsageError, match=name):
            InflationOptions(**{name: wrong})  # type: ignore[arg-type]
