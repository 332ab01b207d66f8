"""What one cycle, one plan and one scan take of one core (CPU time), and how soon the twin is found to be wrong."""

import time
from collections.abc import Callable
from random import Random
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from benchmarks.common import Report, percentile
from benchmarks.link.figures import NEVER_S
from benchmarks.navigation.campus import GRID, YARD, campus, cells_of
from benchmarks.navigation.episode import POINTS
from sern_navigation.costmap.costs import Costmap
from sern_navigation.costmap.layered import LayeredCostmap
from sern_navigation.costmap.twin import TwinView
from sern_navigation.global_plan import PlannerOptions, plan, plan_for
from sern_navigation.mapping import Mapper
from sern_navigation.navigator import Goal, Navigator
from sern_navigation.scan import Cloud, ObstacleScan, ScanOptions, obstacle_scan
from sern_sim.robot import LIDAR_HEIGHT_M, LIDAR_RANGE_M, STEP_S, Pose2, RobotState, SimulatedJackal
from sern_twin.world.discrepancy import LEAST_CELLS, RADIUS_CELLS, RANGE_M, Discrepancies, DiscrepancyKind
from sern_twin.world.grid import Grid
from sern_twin.world.occupancy import Occupancy
from sern_twin.world.patches import OCCUPIED

CLOUD_POINTS: Final = 14_400
PERIOD_S: Final = 0.1
WATCHED_S: Final = 20.0
STARTS: Final = 6
CLEAR_M: Final = 2.0
NOISE_M: Final = 0.02
NOISE_RAD: Final = 0.009
POSE_ERROR_M: Final = 0.05
SLACK_M: Final = 0.3
Mask = NDArray[np.bool_]


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


def scans(report: Report, count: int) -> None:
    """S_2D of a cloud of 14,400 points, and the map of it."""
    found = campus(2)
    robot = SimulatedJackal(Random(2), world=found.world())
    robot.state = _at(found.start_m)
    clouds = []
    robot.drive(0.4, 0.1)
    for _ in range(count):
        state = robot.state
        clouds.append(((state.pose.x_m, state.pose.y_m, state.pose.yaw_rad), _cloud(robot, CLOUD_POINTS)))
        for _ in range(round(PERIOD_S / STEP_S)):
            robot.step()
    made: list[ObstacleScan] = []

    def look(number: int) -> None:
        scan = obstacle_scan(clouds[number][1], ScanOptions())
        assert isinstance(scan, ObstacleScan)
        made.append(scan)

    mapper = Mapper(GRID)
    for what, each, most_ms in (
        (f"S_2D of a cloud of {CLOUD_POINTS:,} points", look, 5.0),
        ("a scan matched and mapped", lambda number: mapper.add(clouds[number][0], made[number]), 20.0),
    ):
        took_ms = _timed(count, each)
        _row(report, what, took_ms)
        report.reach(f"{what}, p50, ms", percentile(took_ms, 0.5), most_ms)


def discrepancies(seeds: int, report: Report) -> None:
    """A robot drives rounds at places of a campus whose twin is right in 8 of 10 things, with a localisation that is
    off by 2 cm and half a degree: how long after a thing was first seen it is told, and what is told that is not so."""
    late_s: dict[DiscrepancyKind, list[float]] = {kind: [] for kind in DiscrepancyKind}
    wrong, hours = 0, 0.0
    for seed, start in ((seed, start) for seed in range(seeds) for start in range(STARTS)):
        made, flags, driven_h = _watched(seed, start)
        for kind, times_s in made.items():
            late_s[kind] += times_s
        wrong, hours = wrong + flags, hours + driven_h
    for kind, times_s in late_s.items():
        ordered = sorted(min(time_s, NEVER_S) for time_s in times_s)
        if ordered:
            p95_s = percentile(ordered, 0.95)
            report.row("where the twin is wrong", kind.value, counted_things=len(ordered),
                       median_s=percentile(ordered, 0.5), p95_s=p95_s)  # fmt: skip
            report.reach(f"{kind}: told after it was first seen, p95, s", p95_s, 1.0)
    report.row("where the twin is wrong", "told, and not so", flags_hour=wrong / hours, driven_hours=hours)
    report.reach("discrepancies that are none, an hour", wrong / hours, 1.0)


def _watched(seed: int, start: int) -> tuple[dict[DiscrepancyKind, list[float]], int, float]:
    """Seconds from first seen to told of each thing, by kind; what was told and is not so; hours driven."""
    found = campus(seed)
    random = Random(seed * STARTS + start)
    robot = SimulatedJackal(random, world=found.world(), patrol=True)
    while robot.world.clearance_m(*(place_m := (random.uniform(-10, 10), random.uniform(-10, 10)))) < CLEAR_M:
        pass  # inside a building is clear too, and shows nothing of the campus
    robot.state = _at(place_m)
    real, twin = cells_of((*YARD, *found.real)) == OCCUPIED, found.twin(0.8)
    has = twin == OCCUPIED
    truly = {DiscrepancyKind.PHANTOM: has & ~real, DiscrepancyKind.UNKNOWN_OBSTACLE: ~has & real}
    things = {kind: _things(mask, real if kind is DiscrepancyKind.PHANTOM else has) for kind, mask in truly.items()}
    world, occupancy, noise = Discrepancies(GRID), Occupancy(GRID), Random(seed)
    bearings = np.linspace(-np.pi, np.pi, 720, endpoint=False)
    first_s: dict[tuple[DiscrepancyKind, int], float] = {}
    told_s: dict[tuple[DiscrepancyKind, int], float] = {}
    wrong: set[int] = set()
    known: set[int] = set()
    while robot.state.time_s < WATCHED_S:
        state = robot.state
        x_m, y_m, yaw_rad = state.pose.x_m, state.pose.y_m, state.pose.yaw_rad
        ranges_m = robot.world.cast(x_m, y_m, yaw_rad + bearings).range_m
        said = (x_m + noise.gauss(0, NOISE_M), y_m + noise.gauss(0, NOISE_M), yaw_rad + noise.gauss(0, NOISE_RAD))
        sight = occupancy.fuse(said, bearings, np.where(ranges_m <= LIDAR_RANGE_M, ranges_m, np.inf), LIDAR_RANGE_M)
        world.saw(sight.free, sight.occupied, said[:2])
        for each in world.compare(twin, now_s=state.time_s, pose_error_m=POSE_ERROR_M):
            if each.number not in known:
                known.add(each.number)
                if not _near(truly[each.kind], each.east_m, each.north_m, each.radius_m + SLACK_M):
                    wrong.add(each.number)
        for kind, masks in things.items():
            seen = sight.free if kind is DiscrepancyKind.PHANTOM else sight.occupied
            flagged = world.cells(kind)
            for number, mask in enumerate(masks):
                key = kind, number
                near = np.hypot(*(GRID.all_centres()[mask] - said[:2]).T) <= RANGE_M
                if key not in first_s and np.count_nonzero(seen[mask] & near) >= LEAST_CELLS:
                    first_s[key] = state.time_s
                if key in first_s and key not in told_s and np.count_nonzero(flagged & mask) >= LEAST_CELLS:
                    told_s[key] = state.time_s
        for _ in range(round(PERIOD_S / STEP_S)):
            robot.step()
    made: dict[DiscrepancyKind, list[float]] = {kind: [] for kind in DiscrepancyKind}
    for key, begin_s in first_s.items():
        made[key[0]].append(told_s.get(key, np.inf) - begin_s)
    return made, len(wrong), WATCHED_S / 3600


def _things(mask: Mask, others: Mask) -> list[Mask]:
    """Each thing of a mask, as far as it is further than the match radius from what it could be taken for."""
    beyond = mask & (ndimage.distance_transform_edt(~others) > RADIUS_CELLS + 1)
    labels, count = ndimage.label(beyond, np.ones((3, 3), np.bool_))
    return [labels == number for number in range(1, count + 1)]


def _near(mask: Mask, east_m: float, north_m: float, radius_m: float) -> bool:
    places = GRID.all_centres()[mask]
    return bool(len(places)) and float(np.hypot(*(places - (east_m, north_m)).T).min()) <= radius_m


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
