"""The cheapest way over a costmap: A* on the eight neighbours of each cell, with the costs of Nav2's SmacPlanner2D.

The search is scipy's Dijkstra on edges from which the heuristic is taken off, so that it expands what A* would, up to a
bound that grows until the goal is within it. The heuristic is the shortest way without any cost, so ways are optimal.
"""

import math
import sys
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from sern_core.vocabulary.errors import UsageError
from sern_navigation.costmap.costs import LETHAL_OBSTACLE, MAX_NON_OBSTACLE, NO_INFORMATION, Costmap, Mask
from sern_navigation.costmap.layered import Snapshot
from sern_twin.world.grid import NOWHERE, Floats, Indices

Point = tuple[float, float]

_STEPS: Final = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))
_SQRT2: Final = math.sqrt(2)
_LEAST: Final = 1e-9
"""An edge of a graph weighs something, or it is none."""
_MORE: Final = 1.2
"""The first bound is so much more than the straight way would cost; each way of cells is up to 8 % longer."""
_MORE_SLACK: Final = 2.0
_NO_LIMIT: Final = sys.float_info.max
_SMOOTHINGS: Final = 20


class PlanCode(StrEnum):
    """Why there is a plan, or none; the names are those of nav2_msgs/action/ComputePathToPose."""

    NONE = "none"
    """No error."""
    START_OUTSIDE_MAP = "start_outside_map"
    GOAL_OUTSIDE_MAP = "goal_outside_map"
    START_OCCUPIED = "start_occupied"
    GOAL_OCCUPIED = "goal_occupied"
    NO_VALID_PATH = "no_valid_path"
    TIMEOUT = "timeout"
    """Nobody answered within `max_planning_time`."""


@dataclass(frozen=True, slots=True)
class PlannerOptions:
    """UsageError: a number that is negative or not finite."""

    tolerance: float = 0.25
    """[m]: how far from the goal a way may end that does not reach it."""
    allow_unknown: bool = True
    cost_travel_multiplier: float = 2.0
    """A cell's length counts 1 + so much of its cost, of 252."""
    twin_travel_multiplier: float = 15.0
    """The same for what the twin says stands there: a wall that only the twin has is worth a detour of some 15 metres
    over ground that is known, and of five over ground that is not, which is three times as dear; with Nav2's weight
    the way would lead into each dead end that the twin knows of. It never closes a way."""
    start_tolerance: float = 0.35
    """[m]: how far away a robot that touches an obstacle may begin its way. Nav2 has none: such a start is occupied."""
    max_planning_time: float = 2.0
    """[s]: how long a navigator that does not plan itself waits for a plan."""

    def __post_init__(self) -> None:
        for name in (
            "tolerance", "cost_travel_multiplier", "twin_travel_multiplier", "start_tolerance", "max_planning_time",
        ):  # fmt: skip
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise UsageError(f"a planner with {name} {value}: give a number of 0 or more")


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """`code` NONE: `path_m` (n, 2) from the start on, and its `cost` in cells' lengths. Else `message` says why."""

    code: PlanCode
    message: str
    path_m: Floats
    cost: float = math.inf

    @property
    def found(self) -> bool:
        return self.code is PlanCode.NONE

    @property
    def length_m(self) -> float:
        return float(np.hypot(*np.diff(self.path_m, axis=0).T).sum())


@dataclass(frozen=True, slots=True, eq=False)
class PlanRequest:
    """A plan that is wanted, with all that it takes: it may be made in another thread or process (`plan_for`)."""

    number: int
    stamp_s: float
    snapshot: Snapshot
    start_m: Point
    goal_m: Point
    options: PlannerOptions


def plan_for(request: PlanRequest) -> Plan:
    """The plan that was asked for. Nothing is raised."""
    return plan(request.snapshot.costmap(), request.start_m, request.goal_m, request.options)


def plan(costmap: Costmap, start_m: Point, goal_m: Point, options: PlannerOptions) -> Plan:
    """The way from start to goal. Nothing is raised: whatever the numbers are, there is a code."""
    grid = costmap.grid
    start, goal = int(grid.flat(np.array(start_m))), int(grid.flat(np.array(goal_m)))
    if start == NOWHERE:
        return _none(PlanCode.START_OUTSIDE_MAP, f"the start {_said(start_m)} is not on the map: drive back onto it")
    if goal == NOWHERE:
        return _none(PlanCode.GOAL_OUTSIDE_MAP, f"the goal {_said(goal_m)} is not on the map: give one that is")
    free = ~costmap.blocked()
    if not options.allow_unknown:
        free &= costmap.costs != NO_INFORMATION
    begin = start
    if not free.reshape(-1)[start]:
        lethal = costmap.costs.reshape(-1)[start] == LETHAL_OBSTACLE
        found = None if lethal else _nearest(costmap, free, start_m, options.start_tolerance)
        if found is None:
            return _none(PlanCode.START_OCCUPIED, f"the start {_said(start_m)} is in an obstacle: move the robot")
        begin = found
    ends = _within(costmap, goal_m, options.tolerance)
    ends = ends[free.reshape(-1)[ends]]
    if not free.reshape(-1)[goal] and not len(ends):
        return _none(
            PlanCode.GOAL_OCCUPIED,
            f"the goal {_said(goal_m)} is in an obstacle, as is all within {options.tolerance:g} m: give another",
        )
    search = _Search(costmap, free, begin, goal, options)
    if search.cost(goal) == math.inf:
        reached = [end for end in ends.tolist() if search.cost(end) < math.inf]
        if not reached:
            return _none(
                PlanCode.NO_VALID_PATH,
                f"no way leads from {_said(start_m)} to {_said(goal_m)}: something closes it off",
            )
        goal = reached[0]
    cells = search.way(goal)
    path = grid.centres(*np.divmod(cells, grid.columns))
    if begin != start:
        path = np.concatenate(([start_m], path))
    path[0] = start_m
    if goal == int(grid.flat(np.array(goal_m))):
        path[-1] = goal_m
    return Plan(PlanCode.NONE, "", _smooth(path, costmap, free), search.cost(goal))


def _none(code: PlanCode, message: str) -> Plan:
    return Plan(code, message, np.empty((0, 2)))


def _said(point: Point) -> str:
    return f"({point[0]:.2f}, {point[1]:.2f})"


def _within(costmap: Costmap, place_m: Point, radius_m: float) -> Indices:
    """The cells whose middles are so near to a place, the nearest first."""
    grid = costmap.grid
    reach = math.ceil(radius_m / grid.cell_m) + 1
    row, column = (int(number) for number in grid.index(np.array(place_m)))
    rows = np.arange(max(row - reach, 0), min(row + reach + 1, grid.rows))
    columns = np.arange(max(column - reach, 0), min(column + reach + 1, grid.columns))
    away = np.hypot(*np.moveaxis(grid.centres(rows[:, None], columns) - place_m, -1, 0)).reshape(-1)
    numbers = (rows[:, None] * grid.columns + columns).reshape(-1)
    order = np.argsort(away, kind="stable")
    found: Indices = numbers[order[away[order] <= radius_m]]
    return found


def _nearest(costmap: Costmap, free: Mask, place_m: Point, radius_m: float) -> int | None:
    cells = _within(costmap, place_m, radius_m)
    cells = cells[free.reshape(-1)[cells]]
    return int(cells[0]) if len(cells) else None


class _Search:
    """A search from one cell, by A* to the goal; to all cells if that is not reached.

    Its own cells have a border around them that nothing enters, so that each has eight neighbours.
    """

    def __init__(self, costmap: Costmap, free: Mask, begin: int, goal: int, options: PlannerOptions) -> None:
        grid = costmap.grid
        self._columns = grid.columns
        values = np.arange(256, dtype=np.float64) / MAX_NON_OBSTACLE
        factors = 1 + options.cost_travel_multiplier * values[costmap.costs]
        factors += (options.twin_travel_multiplier * values)[costmap.soft]
        goal_row, goal_column = divmod(goal, grid.columns)
        across = np.abs(np.arange(grid.columns) - goal_column)[None, :]
        along = np.abs(np.arange(grid.rows) - goal_row)[:, None]
        left = np.maximum(across, along) + (_SQRT2 - 1) * np.minimum(across, along)
        self._left = _bordered(left, 0.0)
        self._begin = self._own(begin)
        graph = _edges(_bordered(np.where(free, factors, np.inf), np.inf), self._left, grid.rows, grid.columns)
        dearest = float(factors[free].max(initial=1.0))
        straight = _straight(np.where(free, factors, dearest), divmod(begin, grid.columns), (goal_row, goal_column))
        slack = max(_MORE * straight - float(self._left[self._begin]), 1.0)
        most = float(self._left[self._begin]) * dearest + left.size
        self._reduced, self._before = self._run(graph, slack)
        reached = np.count_nonzero(np.isfinite(self._reduced))
        while not math.isfinite(self._reduced[self._own(goal)]) and slack < _NO_LIMIT:
            # Where a bound that is higher by more than any step reaches nothing more, nothing more can be reached.
            tells = slack * (_MORE_SLACK - 1) > _SQRT2 * (dearest + 1)
            slack = slack * _MORE_SLACK if slack < most else _NO_LIMIT
            self._reduced, self._before = self._run(graph, slack)
            before, reached = reached, np.count_nonzero(np.isfinite(self._reduced))
            if tells and reached == before:
                break

    def _own(self, cell: int) -> int:
        row, column = divmod(cell, self._columns)
        return (row + 1) * (self._columns + 2) + column + 1

    def _run(self, graph: csr_matrix, limit: float) -> tuple[Floats, NDArray[np.int32]]:
        found, before = dijkstra(graph, indices=self._begin, return_predecessors=True, limit=limit)
        return found, before

    def cost(self, cell: int) -> float:
        """What the way to a cell costs, in cells' lengths; inf where none was found."""
        own = self._own(cell)
        return float(self._reduced[own] + self._left[self._begin] - self._left[own])

    def way(self, cell: int) -> Indices:
        """The cells from the first to this one."""
        found = [self._own(cell)]
        while found[-1] != self._begin:
            found.append(int(self._before[found[-1]]))
        rows, columns = np.divmod(np.array(found[::-1], np.int64), self._columns + 2)
        cells: Indices = (rows - 1) * self._columns + columns - 1
        return cells


def _straight(factors: Floats, begin: tuple[int, int], end: tuple[int, int]) -> float:
    """What the straight way between two cells would cost, in cells' lengths: about what a good one does."""
    steps = max(abs(end[0] - begin[0]), abs(end[1] - begin[1]), 1)
    rows, columns = (np.rint(np.linspace(begin[axis], end[axis], steps + 1)).astype(np.intp) for axis in (0, 1))
    return float(factors[rows, columns].mean()) * math.dist(begin, end)


def _bordered(values: Floats, border: float) -> Floats:
    """Values (rows, columns) with one more on each side, flat."""
    rows, columns = values.shape
    found = np.full((rows + 2, columns + 2), border)
    found[1:-1, 1:-1] = values
    return found.reshape(-1)


@lru_cache(maxsize=4)
def _neighbours(rows: int, columns: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Which cells each cell of a grid with a border has beside it, as a sparse matrix has them: numbers, pointers.

    They are the same for all plans on a grid. Those of the border itself are any: nothing leads to them.
    """
    cells = rows * columns
    offsets = np.array([up * columns + right for up, right in _STEPS], np.int32)
    numbers = np.arange(cells, dtype=np.int32)[:, None] + offsets
    np.maximum(numbers, 0, out=numbers)
    np.minimum(numbers, cells - 1, out=numbers)
    found = numbers.reshape(-1), np.arange(0, len(_STEPS) * cells + 1, len(_STEPS), dtype=np.int32)
    for each in found:
        each.flags.writeable = False
    return found


def _edges(factors: Floats, left: Floats, rows: int, columns: int) -> csr_matrix:
    """What each step costs, less what it comes nearer to the goal: never below 0, and inf to what is not free."""
    wide, cells = columns + 2, len(factors)
    begin, end = wide + 1, cells - wide - 1
    straight, across = factors + left, _SQRT2 * factors + left
    weights = np.full((cells, len(_STEPS)), np.inf)
    for place, (up, right) in enumerate(_STEPS):
        ends = across if up and right else straight
        offset = up * wide + right
        np.subtract(ends[begin + offset : end + offset], left[begin:end], out=weights[begin:end, place])
    np.maximum(weights, _LEAST, out=weights)
    numbers, pointers = _neighbours(rows + 2, wide)
    return csr_matrix((weights.reshape(-1), numbers, pointers), shape=(cells, cells))


def _smooth(path: Floats, costmap: Costmap, free: Mask) -> Floats:
    """A path without the corners of its cells: each point goes towards its neighbours, if no dearer cell is there.

    Like nav2_smac_planner's smoother (w_smooth 0.3, w_data 0.2), but nothing moves where it costs more.
    """
    if len(path) < 3:
        return path
    grid, weights = costmap.grid, np.where(free, costmap.weights(), np.inf).reshape(-1)
    smooth, before = path.copy(), weights[grid.flat(path)]
    for _ in range(_SMOOTHINGS):
        middle = smooth[1:-1]
        moved = middle + 0.2 * (path[1:-1] - middle) + 0.3 * (smooth[2:] + smooth[:-2] - 2 * middle)
        allowed = weights[grid.flat(moved)] <= before[1:-1]
        smooth[1:-1] = np.where(allowed[:, None], moved, middle)
    return smooth
