"""The way back to the middle of where a robot drives, past what stands in between: Dijkstra's on a grid."""

import heapq
import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sern_sim.plant import Area
from sern_sim.robot import BODY_RADIUS_M, Pose2
from sern_sim.world import Floats

CELL_M: Final = 0.25
MIDDLE_M: Final = 4.0
"""Nothing stands so near to the middle, in the yard or on the hills."""
HOME_M: Final = 2.5
"""The way ends there."""
ROOM_M: Final = 0.8
_TIGHT: Final = 30.0
_NEAR: Final = 4.0
"""What a metre costs where the body may touch something, and where it comes near."""
_STEPS: Final = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]


def way_back(area: Area, start: Pose2) -> list[tuple[float, float]]:
    """Places about `CELL_M` apart from `start` to the middle; empty where it is in the middle already, and also where
    no way leads there, so that the robot at least makes for it.
    """
    if math.hypot(start.x_m, start.y_m) <= MIDDLE_M:
        return []
    cells = max(2, round(2 * area.half_size_m / CELL_M))
    cost = _costs(area.occupancy(cells), 2 * area.half_size_m / cells)

    def cell_of(metres: float) -> int:
        return min(max(int((metres + area.half_size_m) / (2 * area.half_size_m) * cells), 0), cells - 1)

    def place(cell: tuple[int, int]) -> tuple[float, float]:
        row, column = ((number + 0.5) / cells * 2 * area.half_size_m - area.half_size_m for number in cell)
        return column, row

    first = cell_of(start.y_m), cell_of(start.x_m)
    cheapest, before = {first: 0.0}, dict[tuple[int, int], tuple[int, int]]()
    waiting = [(0.0, first)]
    while waiting:
        spent, cell = heapq.heappop(waiting)
        if math.hypot(*place(cell)) <= HOME_M:
            back = [cell]
            while back[-1] in before:
                back.append(before[back[-1]])
            return [place(each) for each in reversed(back)]
        if spent > cheapest[cell]:
            continue
        for up, right in _STEPS:
            row, column = cell[0] + up, cell[1] + right
            if not (0 <= row < cells and 0 <= column < cells):
                continue
            total = spent + math.hypot(up, right) * float(cost[row, column])
            if total < cheapest.get((row, column), math.inf):
                cheapest[row, column], before[row, column] = total, cell
                heapq.heappush(waiting, (total, (row, column)))
    return []


def _costs(grid: NDArray[np.int8], cell_m: float) -> Floats:
    """What a cell costs: (cells, cells), inf where something stands."""
    taken = grid > 0
    cost = np.ones(grid.shape)
    for radius_m, price in ((ROOM_M, _NEAR), (BODY_RADIUS_M + cell_m / 2, _TIGHT)):
        reach = int(radius_m / cell_m)
        for up in range(-reach, reach + 1):
            for right in range(-reach, reach + 1):
                if math.hypot(up, right) * cell_m <= radius_m:
                    cost[_shifted(taken, up, right)] = price
    return np.where(taken, np.inf, cost)


def _shifted(taken: NDArray[np.bool_], up: int, right: int) -> NDArray[np.bool_]:
    moved = np.zeros_like(taken)
    rows, columns = taken.shape
    moved[max(up, 0) : rows + min(up, 0), max(right, 0) : columns + min(right, 0)] = taken[
        max(-up, 0) : rows + min(-up, 0), max(-right, 0) : columns + min(-right, 0)
    ]
    return moved
