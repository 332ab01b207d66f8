"""What S_2D and mapping take on scans of a real scanner and of the simulated robot, and what mapping is good for: where
a second scan was taken, and a drive by wheels that slip, with matching and without."""

import math
import time
from collections.abc import Callable, Sequence
from random import Random
from typing import Final

import numpy as np
from numpy.typing import NDArray

from benchmarks import recordings
from benchmarks.common import Report, percentile
from benchmarks.navigation.campus import GRID, campus
from sern_navigation.mapping import Mapper, MapperOptions, Placed, ends_m
from sern_navigation.matching import Match, MatchOptions, match
from sern_navigation.scan import Cloud, ObstacleScan, ScanOptions, obstacle_scan
from sern_sim.robot import LIDAR_HEIGHT_M, STEP_S, Pose2, RobotState, SimulatedJackal
from sern_sim.world import World
from sern_twin.world.grid import Floats, Grid
from sern_twin.world.occupancy import Pose
from sern_twin.world.patches import OCCUPIED, UNKNOWN, Cells

CLOUD_POINTS: Final = 14_400
DRIVE_POINTS: Final = 5_760
PERIOD_S: Final = 0.1
DRIVE_S: Final = 60.0
REAL: Final = ScanOptions(
    origin_m=(0.0, 0.0, 2.0),
    ring_elevations_rad=tuple(math.radians(-30.67 + 4 / 3 * number) for number in range(32)),
)
"""The scanner of the recorded scans: 32 rings, 2 m above ground that its lowest rings see fall by 8 % ahead."""
REAL_PITCH_RAD: Final = -0.08
B_ON_A: Final[Pose] = (-0.487, -0.127, 0.0122)
"""The place of the second scan, as those who recorded them state it."""
S_2D_MS: Final = 5.0
MAPPED_MS: Final = 20.0
_OCCUPIED_PERCENT: Final = 65
_NOTHING_MATCHES: Final = MapperOptions(matching=MatchOptions(min_points=10_000_000))


def costs(report: Report, count: int) -> None:
    """S_2D of so many clouds, and the match and map of each, on one core."""
    clouds, options = _stand_in(count)
    _timed(report, f"the simulated robot, {CLOUD_POINTS} points", clouds, options)
    if recordings.absent():
        report.note("no costs of real scans: they are not beside the checkout")
        return
    real = _real_clouds()
    turns = [(B_ON_A if number % 2 else (0.0, 0.0, 0.0), real[number % 2]) for number in range(count)]
    _timed(report, f"a real scanner, {len(real[0].points_m)} points", turns, REAL)


def accuracy(report: Report, predictions: int, drives: int) -> None:
    """The place of the second real scan on the map of the first, from predictions up to 0.25 m and 0.15 rad off; and
    drives of `DRIVE_S` with wheel odometry alone."""
    if recordings.absent():
        report.note("the place of a second scan is not measured: the real scans are not beside the checkout")
    else:
        off_m, off_deg = _second_scan(predictions)
        report.row("mapping", "the second real scan on the map of the first", p50_cm=100 * percentile(off_m, 0.5),
                   most_cm=100 * off_m[-1], p50_deg=percentile(off_deg, 0.5), most_deg=off_deg[-1],
                   counted_refused=predictions - len(off_m))  # fmt: skip
    for name, options in (("wheels and matching", MapperOptions()), ("wheels alone", _NOTHING_MATCHES)):
        made = [drive(seed, options) for seed in range(drives)]
        pose_cm, map_cm = sorted(100 * each[0] for each in made), sorted(100 * each[1] for each in made)
        report.row(f"mapping, drives of {DRIVE_S:.0f} s", name, pose_off_p50_cm=percentile(pose_cm, 0.5),
                   pose_off_most_cm=pose_cm[-1], map_off_p50_cm=percentile(map_cm, 0.5), map_off_most_cm=map_cm[-1],
                   counted_refused=sum(each[2] for each in made))  # fmt: skip


def drive(seed: int, options: MapperOptions, seconds: float = DRIVE_S) -> tuple[float, float, int]:
    """A robot that drives rounds on a campus and knows where it began: how far off it takes itself to be at the end and
    how far off what is occupied on its map is in the mean [m], and how many scans did not fit."""
    found = campus(seed)
    random = Random(seed)
    world = found.world()
    while world.clearance_m(*(place_m := (random.uniform(-10, 10), random.uniform(-10, 10)))) < 2.0:
        pass
    start = Pose2(*place_m, 0.0)
    robot = SimulatedJackal(random, world=world, patrol=True)
    robot.state = RobotState(pose=start, odometry=start)
    mapper, wheels, pose = Mapper(GRID, options), start, (start.x_m, start.y_m, start.yaw_rad)
    scan_options = ScanOptions()
    while robot.state.time_s < seconds:
        now = robot.state.odometry
        pose, wheels = _moved(pose, wheels, now), now
        scan = obstacle_scan(_cloud(robot, DRIVE_POINTS), scan_options)
        assert isinstance(scan, ObstacleScan)
        mapped = mapper.add(pose, scan)
        pose = mapped.pose
        truly = robot.state.pose
        for _ in range(round(PERIOD_S / STEP_S)):
            robot.step()
    off_m = math.dist(pose[:2], (truly.x_m, truly.y_m))
    return off_m, map_off_m(GRID, mapper.occupancy.classes(), world), mapper.counts[Placed.REFUSED]


def map_off_m(grid: Grid, cells: Cells, world: World) -> float:
    """How far the middles of occupied cells are from the nearest wall, in the mean."""
    places = grid.all_centres()[cells >= OCCUPIED]
    if not len(places):
        return math.inf
    nearest = np.full(len(places), np.inf)
    for x0, y0, x1, y1, _height_m in world.walls:
        along = np.array([x1 - x0, y1 - y0])
        share = np.clip(((places - (x0, y0)) @ along) / max(float(along @ along), 1e-12), 0, 1)
        nearest = np.minimum(nearest, np.hypot(*(places - (x0, y0) - share[:, None] * along).T))
    return float(nearest.mean())


def _stand_in(count: int) -> tuple[list[tuple[Pose, Cloud]], ScanOptions]:
    """A drive, each cloud with where the robot takes itself to be."""
    found = campus(2)
    start = Pose2(*found.start_m, 0.0)
    robot = SimulatedJackal(Random(2), world=found.world())
    robot.state = RobotState(pose=start, odometry=start)
    robot.drive(0.4, 0.1)
    clouds: list[tuple[Pose, Cloud]] = []
    for _ in range(count):
        pose = robot.state.odometry
        clouds.append(((pose.x_m, pose.y_m, pose.yaw_rad), _cloud(robot, CLOUD_POINTS)))
        for _ in range(round(PERIOD_S / STEP_S)):
            robot.step()
    return clouds, ScanOptions()


def _timed(report: Report, of: str, clouds: Sequence[tuple[Pose, Cloud]], options: ScanOptions) -> None:
    scans: list[ObstacleScan] = []

    def look(number: int) -> None:
        scan = obstacle_scan(clouds[number][1], options)
        assert isinstance(scan, ObstacleScan)
        scans.append(scan)

    mapper = Mapper(GRID)
    for what, call, most_ms in (
        ("S_2D", look, S_2D_MS),
        ("a scan matched and mapped", lambda number: mapper.add(clouds[number][0], scans[number]), MAPPED_MS),
    ):
        took_ms = _each_ms(len(clouds), call)
        p50_ms, p99_ms = percentile(took_ms, 0.5), percentile(took_ms, 0.99)
        report.row("one core", f"{what}, {of}", p50_ms=p50_ms, p99_ms=p99_ms)
        report.reach(f"{what}, {of}, p50, ms", p50_ms, most_ms)


def _second_scan(predictions: int) -> tuple[list[float], list[float]]:
    """How far off the scans that fitted are, in order [m, degrees]."""
    first, second = (obstacle_scan(cloud, REAL) for cloud in _real_clouds())
    assert isinstance(first, ObstacleScan) and isinstance(second, ObstacleScan)
    mapper, draw = Mapper(GRID), np.random.default_rng(1)
    mapper.add((0.0, 0.0, 0.0), first)
    cells, ends = mapper.occupancy.cells(), ends_m(second)
    off_m, off_deg = [], []
    for _ in range(predictions):
        east_m, north_m, yaw_rad = (draw.uniform(-1, 1, 3) * (0.25, 0.25, 0.15)).tolist()
        prediction = (B_ON_A[0] + east_m, B_ON_A[1] + north_m, B_ON_A[2] + yaw_rad)
        found = match(GRID, cells >= _OCCUPIED_PERCENT, cells != UNKNOWN, prediction, ends)
        if isinstance(found, Match):
            off_m.append(math.dist(found.pose[:2], B_ON_A[:2]))
            off_deg.append(math.degrees(abs(found.pose[2] - B_ON_A[2])))
    return sorted(off_m), sorted(off_deg)


def _real_clouds() -> list[Cloud]:
    """Points in the frame of the ground below the scanner."""
    made = []
    for points in recordings.scans():
        places: NDArray[np.float32] = points[:, :3] + np.array([0.0, 0.0, REAL.origin_m[2]], np.float32)
        made.append(Cloud(places, 0.0, pitch_rad=REAL_PITCH_RAD))
    return made


def _cloud(robot: SimulatedJackal, points: int) -> Cloud:
    found: Floats = robot.cloud(points)[:, :3].astype(np.float64)
    found[:, 2] += LIDAR_HEIGHT_M
    return Cloud(found, robot.state.time_s)


def _moved(pose: Pose, before: Pose2, now: Pose2) -> Pose:
    """A pose that was moved by what the wheels say."""
    turn = pose[2] - before.yaw_rad
    x_m, y_m = now.x_m - before.x_m, now.y_m - before.y_m
    return (
        pose[0] + math.cos(turn) * x_m - math.sin(turn) * y_m,
        pose[1] + math.sin(turn) * x_m + math.cos(turn) * y_m,
        pose[2] + math.remainder(now.yaw_rad - before.yaw_rad, math.tau),
    )


def _each_ms(count: int, call: Callable[[int], object]) -> list[float]:
    """Milliseconds of a core that each of so many calls takes, in order; what else runs there is not counted."""
    took_ms = []
    for number in range(count):
        begin_s = time.thread_time()
        call(number)
        took_ms.append(1e3 * (time.thread_time() - begin_s))
    return sorted(took_ms)
