"""What one cycle and one plan take of one core (CPU time)."""

import time
from collections.abc import Callable
from random import Random
from typing import Final

import numpy as np

from benchmarks.common import Report, percentile
from benchmarks.navigation.campus import GRID, campus
from benchmarks.navigation.episode import POINTS
from sern_navigation.costmap.costs import Costmap
from sern_navigation.costmap.layered import LayeredCostmap
from sern_navigation.costmap.twin import TwinView
from sern_navigation.global_plan import PlannerOptions, plan, plan_for
from sern_navigation.navigator import Goal, Navigator
from sern_navigation.scan import Cloud
from sern_sim.robot import LIDAR_HEIGHT_M, STEP_S, Pose2, RobotState, SimulatedJackal
from sern_twin.world.grid import Grid
from sern_twin.world.patches import OCCUPIED

PERIOD_S: Final = 0.1


def cycle(report: Report, cycles: int) -> None:
    """Commands of one drive with a twin, each with a scan, one core. Plans are made beside them, as by Nav2's planner
    server; what it takes to ask for one and to take it is in the cycle."""
    found = campus(1)
    robot = SimulatedJackal(Random(1), world=found.world())
    robot.state = _at(found.start_m)
    navigator = Navigator(GRID, np.random.default_rng(1), plans_itself=False)
    navigator.go(Goal(*found.goal_m))
    cells = found.twin(0.9)
    took_ms, planned_ms, late = [], [], None
    for _ in range(cycles):
        state = robot.state
        cloud = _cloud(robot, POINTS)
        view = TwinView(GRID, cells, state.time_s)
        pose = (state.pose.x_m, state.pose.y_m, state.pose.yaw_rad)
        begin_s = time.process_time()
        if late is not None:
            navigator.planned(*late)
        command = navigator.step(state.time_s, pose, cloud, view)
        request = navigator.request()
        took_ms.append(1e3 * (time.process_time() - begin_s))
        begin_s = time.process_time()
        late = None if request is None else (request, plan_for(request))
        if late is not None:
            planned_ms.append(1e3 * (time.process_time() - begin_s))
        robot.drive(command.speed[0], command.speed[1] / robot.yaw_scale_known)
        for _ in range(round(PERIOD_S / STEP_S)):
            robot.step()
    what = f"a control cycle with S_2D of {POINTS:,} points, its plans made elsewhere"
    p99_ms = _row(report, what, took_ms)
    _row(report, f"those plans, on {GRID.columns} x {GRID.rows} cells, with their costmaps", planned_ms)
    report.reach("a control cycle, p99, ms", p99_ms, 20)


def _row(report: Report, what: str, took_ms: list[float]) -> float:
    """Its p99."""
    ordered = sorted(took_ms)
    p99_ms = percentile(ordered, 0.99)
    report.row("one core", what, p50_ms=percentile(ordered, 0.5), p99_ms=p99_ms)
    return p99_ms


def plans(report: Report, count: int) -> None:
    """Plans from corner to corner of 400² cells in which a tenth is occupied, and a twin says as much."""
    grid = Grid(0.0, 0.0, 0.1, 400, 400)
    draw = np.random.default_rng(3)
    layers = LayeredCostmap(grid)
    cells = np.zeros(grid.shape, np.int8)
    for _ in range(60):
        row, column = draw.integers(20, 370, 2)
        cells[row : row + draw.integers(3, 25), column : column + draw.integers(3, 25)] = OCCUPIED
    layers.static.take(grid, cells)
    layers.twin.take(TwinView(grid, np.roll(cells, 7, axis=1), 0.0))
    costmap: Costmap = layers.everywhere(0.0)
    took_ms = _timed(count, lambda number: plan(costmap, (1.0, 1.0), (39.0, 39.0 - number * 0.1), PlannerOptions()))
    p99_ms = _row(report, "a global plan on 400² cells, from corner to corner", took_ms)
    report.reach("a global plan on 400² cells, p99, ms", p99_ms, 100)


def _at(place_m: tuple[float, float]) -> RobotState:
    pose = Pose2(*place_m, 0.0)
    return RobotState(pose=pose, odometry=pose)


def _cloud(robot: SimulatedJackal, points: int) -> Cloud:
    found = robot.cloud(points)[:, :3].astype(np.float64)
    found[:, 2] += LIDAR_HEIGHT_M
    return Cloud(found, robot.state.time_s)


def _timed(count: int, call: Callable[[int], object]) -> list[float]:
    """Milliseconds of each of so many calls, in order of their length."""
    took_ms = []
    for number in range(count):
        begin_s = time.process_time()
        call(number)
        took_ms.append(1e3 * (time.process_time() - begin_s))
    return sorted(took_ms)
