"""Global plans: the cheapest way, against plain Dijkstra; codes; goals that are taken; what the twin costs."""

import heapq
import math
from typing import Any

import numpy as np
import pytest

from sern_core.vocabulary.errors import UsageError
from sern_navigation.costmap.costs import Costmap
from sern_navigation.costmap.layered import LayeredCostmap
from sern_navigation.costmap.static import MapOutcome
from sern_navigation.costmap.twin import TwinView
from sern_navigation.global_plan import PlanCode, PlannerOptions, plan
from sern_twin.world.grid import Grid
from sern_twin.world.patches import Cells
from tests.exploring import seeds
from tests.sern_navigation.worlds import empty_map, filled

GRID = Grid(-3.0, -3.0, 0.1, 60, 60)
OPTIONS = PlannerOptions()
WALL = (-0.2, -3.0, 0.2, 1.0)
"""From the south up to 1 m north of the middle."""


def costmap_of(cells: Cells) -> Costmap:
    layered = LayeredCostmap(GRID)
    assert layered.static.take(GRID, cells) is MapOutcome.TAKEN
    return layered.everywhere(0.0)


def by_dijkstra(costmap: Costmap, start: int, goal: int, options: PlannerOptions) -> float:
    """The cost of the cheapest way, by a heap and nothing else."""
    grid, blocked, weights = costmap.grid, costmap.blocked(), costmap.weights()
    best, queue = {start: 0.0}, [(0.0, start)]
    while queue:
        cost, cell = heapq.heappop(queue)
        if cell == goal:
            return cost
        if cost > best[cell]:
            continue
        row, column = divmod(cell, grid.columns)
        for up in (-1, 0, 1):
            for right in (-1, 0, 1):
                there = row + up, column + right
                if (up, right) == (0, 0) or not (0 <= there[0] < grid.rows and 0 <= there[1] < grid.columns):
                    continue
                if blocked[there] or (costmap.costs[there] == 255 and not options.allow_unknown):
                    continue
                step = math.hypot(up, right) * (1 + options.cost_travel_multiplier * weights[there] / 252)
                number = there[0] * grid.columns + there[1]
                if cost + step < best.get(number, math.inf):
                    best[number] = cost + step
                    heapq.heappush(queue, (cost + step, number))
    return math.inf


@pytest.mark.parametrize("seed", seeds(12))
def test_the_way_is_the_cheapest(seed: int) -> None:
    random = np.random.default_rng(seed)
    cells = np.where(random.random(GRID.shape) < 0.006, 100, 0).astype(np.int8)
    cells[random.random(GRID.shape) < 0.05] = -1
    costmap = costmap_of(cells)
    options = PlannerOptions(allow_unknown=bool(seed % 2), tolerance=0.0)
    for _ in range(4):
        x_m, y_m, goal_x_m, goal_y_m = random.uniform(-2.9, 2.9, 4).tolist()
        start, goal = (x_m, y_m), (goal_x_m, goal_y_m)
        found = plan(costmap, start, goal, options)
        numbers = [int(GRID.flat(np.array(place))) for place in (start, goal)]
        free = ~costmap.blocked() if options.allow_unknown else ~costmap.blocked() & (costmap.costs != 255)
        if not free.reshape(-1)[numbers].all():
            assert found.code in (
                PlanCode.GOAL_OCCUPIED,
                PlanCode.START_OCCUPIED,
                PlanCode.NONE,
                PlanCode.NO_VALID_PATH,
            )
            continue
        wanted = by_dijkstra(costmap, numbers[0], numbers[1], options)
        assert found.found == math.isfinite(wanted)
        if found.found:
            assert found.cost == pytest.approx(wanted, rel=1e-5)


def test_a_way_leads_around_a_wall_and_keeps_away_from_it() -> None:
    costmap = costmap_of(filled(GRID, WALL))
    found = plan(costmap, (-2.0, -2.0), (2.0, -2.0), OPTIONS)
    assert found.found and found.message == ""
    assert found.path_m[0] == pytest.approx((-2.0, -2.0)) and found.path_m[-1] == pytest.approx((2.0, -2.0))
    assert not costmap.blocked().reshape(-1)[GRID.flat(found.path_m)].any()
    crossing = found.path_m[np.abs(found.path_m[:, 0]) < 0.1]
    assert (crossing[:, 1] > 1.33).all(), "a robot's radius north of its end"
    assert (np.hypot(*np.diff(found.path_m, axis=0).T) < 0.25).all(), "no jumps"
    assert 7.0 < found.length_m < 9.5


def test_corners_are_smoothed() -> None:
    found = plan(costmap_of(empty_map(GRID)), (-2.0, -2.0), (2.0, -1.0), OPTIONS)
    turns = np.diff(np.unwrap(np.arctan2(*np.diff(found.path_m, axis=0).T[::-1])))
    assert np.abs(turns).max() < 0.5, "the steps between cells alone turn by 0.79"


@pytest.mark.parametrize(
    ("start", "goal", "code"),
    [
        ((-9.0, 0.0), (2.0, 0.0), PlanCode.START_OUTSIDE_MAP),
        ((math.nan, 0.0), (2.0, 0.0), PlanCode.START_OUTSIDE_MAP),
        ((-2.0, 0.0), (9.0, 0.0), PlanCode.GOAL_OUTSIDE_MAP),
        ((-2.0, 0.0), (math.inf, 0.0), PlanCode.GOAL_OUTSIDE_MAP),
        ((0.05, -2.0), (2.0, 0.0), PlanCode.START_OCCUPIED),
        ((-2.0, 0.0), (0.05, -2.0), PlanCode.GOAL_OCCUPIED),
        ((-2.0, 0.0), (2.0, -2.0), PlanCode.NO_VALID_PATH),
    ],
)
def test_there_is_a_code_for_each_way_that_is_none(
    start: tuple[float, float], goal: tuple[float, float], code: PlanCode
) -> None:
    through = (-0.2, -3.0, 0.2, 3.0)
    found = plan(costmap_of(filled(GRID, through)), start, goal, OPTIONS)
    assert found.code is code and not found.found and found.path_m.shape == (0, 2) and found.cost == math.inf
    assert found.message and "\n" not in found.message


def test_a_goal_that_is_taken_is_approached_within_the_tolerance() -> None:
    costmap = costmap_of(filled(GRID, (1.9, -0.1, 2.1, 0.1)))
    goal = (2.0, 0.0)
    assert plan(costmap, (-2.0, 0.0), goal, PlannerOptions(tolerance=0.2)).code is PlanCode.GOAL_OCCUPIED
    found = plan(costmap, (-2.0, 0.0), goal, PlannerOptions(tolerance=0.6))
    assert found.found and 0.3 < math.dist(found.path_m[-1], goal) <= 0.6


def test_a_goal_that_is_walled_in_is_approached_within_the_tolerance() -> None:
    ring = filled(GRID, (1.0, -1.0, 2.8, 1.0)) - filled(GRID, (1.1, -0.9, 2.7, 0.9))
    costmap = costmap_of(ring.astype(np.int8))
    assert plan(costmap, (-2.0, 0.0), (1.6, 0.0), OPTIONS).code is PlanCode.NO_VALID_PATH
    found = plan(costmap, (-2.0, 0.0), (1.6, 0.0), PlannerOptions(tolerance=1.2))
    assert found.found and found.path_m[-1, 0] < 1.0


def test_a_robot_that_touches_something_gets_away() -> None:
    costmap = costmap_of(filled(GRID, WALL))
    found = plan(costmap, (-0.4, -2.0), (-2.0, -2.0), OPTIONS)
    assert found.found and found.path_m[0] == pytest.approx((-0.4, -2.0))
    strict = plan(costmap, (-0.4, -2.0), (-2.0, -2.0), PlannerOptions(start_tolerance=0.0))
    assert strict.code is PlanCode.START_OCCUPIED, "as in Nav2"


def test_the_unknown_is_crossed_if_that_is_allowed() -> None:
    cells = empty_map(GRID)
    cells[:, 25:35] = -1
    found = plan(costmap_of(cells), (-2.0, 0.0), (2.0, 0.0), OPTIONS)
    assert found.found
    without = plan(costmap_of(cells), (-2.0, 0.0), (2.0, 0.0), PlannerOptions(allow_unknown=False))
    assert without.code is PlanCode.NO_VALID_PATH


def test_start_and_goal_may_be_the_same_cell() -> None:
    found = plan(costmap_of(empty_map(GRID)), (0.02, 0.02), (0.08, 0.08), OPTIONS)
    assert found.found and found.cost == 0 and found.path_m[-1] == pytest.approx((0.08, 0.08))


def test_a_way_goes_around_what_the_twin_says_and_through_it_if_there_is_no_other() -> None:
    layered = LayeredCostmap(GRID)
    layered.static.take(GRID, empty_map(GRID))
    layered.twin.take(TwinView(GRID, filled(GRID, (-0.3, -1.0, 0.3, 1.0)), 0.0))
    around = plan(layered.everywhere(0.0), (-2.0, 0.0), (2.0, 0.0), OPTIONS)
    assert around.found and np.abs(around.path_m[:, 1]).max() > 1.0
    layered.twin.take(TwinView(GRID, filled(GRID, (-0.3, -3.0, 0.3, 3.0)), 0.0))
    through = plan(layered.everywhere(0.0), (-2.0, 0.0), (2.0, 0.0), OPTIONS)
    assert through.found and np.abs(through.path_m[:, 1]).max() < 0.3


@pytest.mark.parametrize(
    "change", [{"tolerance": -1.0}, {"cost_travel_multiplier": math.nan}, {"start_tolerance": math.inf}]
)
def test_options_that_are_none_are_refused(change: dict[str, Any]) -> None:
    with pytest.raises(UsageError):
        PlannerOptions(**change)


@pytest.mark.parametrize("twin_travel_multiplier", [0.0, 15.0, 1e4])
def test_a_way_that_costs_much_more_than_its_length_is_found(twin_travel_multiplier: float) -> None:
    """A robot in a room of which the twin says that all of it is taken: one step costs more than the first bound."""
    layered = LayeredCostmap(GRID)
    layered.static.take(GRID, empty_map(GRID))
    layered.twin.take(TwinView(GRID, filled(GRID, (-3.0, -3.0, -1.0, 3.0), (0.0, -3.0, 3.0, 3.0)), 0.0))
    options = PlannerOptions(twin_travel_multiplier=twin_travel_multiplier)
    for goal_m in ((-0.1, 0.0), (2.5, 2.5)):
        assert plan(layered.everywhere(0.0), (-0.5, 0.0), goal_m, options).found
