"""The map that a robot makes while it drives, and its place on it."""

import math

import numpy as np
import pytest

from sern_core.vocabulary.errors import UsageError
from sern_navigation.mapping import Mapper, MapperOptions, Placed
from sern_navigation.matching import MatchOptions, NoMatch
from sern_navigation.scan import ObstacleScan, ScanOptions, obstacle_scan
from sern_sim.robot import Pose2, SimulatedJackal
from sern_sim.world import World
from sern_twin.world.grid import Grid
from sern_twin.world.occupancy import Ignored, Pose
from tests.sern_navigation.worlds import box, jackal, seen, world_of

GRID = Grid(-10.0, -10.0, 0.1, 200, 200)
OPTIONS = ScanOptions(range_max_m=15.0)


def scan_of(robot: SimulatedJackal) -> ObstacleScan:
    found = obstacle_scan(seen(robot, 5760), OPTIONS)
    assert isinstance(found, ObstacleScan)
    return found


def after(pose: Pose, before: Pose2, now: Pose2) -> Pose:
    """A pose that was moved by what the wheels say, which is 10 % too much of a turn."""
    turn = pose[2] - before.yaw_rad
    x_m, y_m = now.x_m - before.x_m, now.y_m - before.y_m
    return (
        pose[0] + math.cos(turn) * x_m - math.sin(turn) * y_m,
        pose[1] + math.sin(turn) * x_m + math.cos(turn) * y_m,
        pose[2] + 1.1 * math.remainder(now.yaw_rad - before.yaw_rad, math.tau),
    )


def walls_off_m(mapper: Mapper, world: World) -> float:
    """How far what is occupied on a map is from the nearest wall, in the mean."""
    places = GRID.all_centres()[mapper.occupancy.classes() == 100]
    nearest = np.full(len(places), np.inf)
    for x0, y0, x1, y1, _height in world.walls:
        along = np.array([x1 - x0, y1 - y0])
        share = np.clip((places - (x0, y0)) @ along / (along @ along), 0, 1)
        nearest = np.minimum(nearest, np.hypot(*(places - (x0, y0) - share[:, None] * along).T))
    return float(nearest.mean())


def test_a_robot_that_drives_knows_where_it_is_and_by_wheels_alone_it_is_lost() -> None:
    """Drive in circles, by wheels that are wrong about turns. The same scans make two maps: one where they fit on it,
    and one where the wheels say that they are."""
    robot = jackal(world_of([*box(3.0, -1.0, 4.0, 1.0), *box(-5.0, 3.0, -4.0, 6.0), *box(-2.0, -6.0, 0.0, -5.0)], 9.0))
    mapper, alone = Mapper(GRID), Mapper(GRID, MapperOptions(matching=MatchOptions(min_points=1_000_000)))
    wheels, place, drifted = robot.state.odometry, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    off_m = []
    robot.drive(0.6, 0.9)
    for _ in range(30):
        now = robot.state.odometry
        place, drifted = after(place, wheels, now), after(drifted, wheels, now)
        wheels, scan = now, scan_of(robot)
        mapped = mapper.add(place, scan)
        place = mapped.pose
        assert alone.add(drifted, scan).placed is Placed.PREDICTED
        truly = robot.state.pose
        off_m.append(math.dist(place[:2], (truly.x_m, truly.y_m)))
        for _ in range(25):
            robot.step()
    assert max(off_m) < 0.12 and off_m[-1] < 0.08
    assert math.dist(drifted[:2], (truly.x_m, truly.y_m)) > 0.5
    assert mapper.counts[Placed.MATCHED] == 29 and mapper.counts[Placed.REFUSED] == 0
    assert mapped.match is not None and mapped.reason is None
    assert walls_off_m(mapper, robot.world) < 0.08, "most of it the cells' size"
    assert walls_off_m(alone, robot.world) > 2.5 * walls_off_m(mapper, robot.world)
    classes = mapper.occupancy.classes()
    assert classes[GRID.index(np.array([2.0, 0.0]))] == 0
    near_car = classes[GRID.index(np.array([3.0, 0.0]))[0], 128:134]
    assert (near_car == 100).any()


def test_a_scan_that_does_not_fit_is_not_laid_down() -> None:
    robot = jackal(world_of([*box(3.0, -1.0, 4.0, 1.0), *box(-5.0, 3.0, -4.0, 6.0)], 9.0))
    mapper = Mapper(GRID)
    for _ in range(6):
        assert mapper.add((0.0, 0.0, 0.0), scan_of(robot)).placed is not Placed.REFUSED
    before = mapper.occupancy.cells()
    other = jackal(world_of([*box(-2.0, 1.0, -1.0, 3.0), *box(1.0, -4.0, 2.0, -1.0)], 5.0))
    found = mapper.add((0.0, 0.0, 0.0), scan_of(other))
    assert found.placed is Placed.REFUSED and found.match is None and found.pose == (0.0, 0.0, 0.0)
    assert found.reason in (NoMatch.LOW_SCORE, NoMatch.RAN_AWAY)
    assert (mapper.occupancy.cells() == before).all()
    assert mapper.counts[Placed.REFUSED] == 1 and sum(mapper.reasons.values()) == 1 + mapper.reasons[NoMatch.EMPTY_MAP]


def test_the_first_scans_are_laid_where_the_robot_is_thought_to_be() -> None:
    robot = jackal(world_of([*box(3.0, -1.0, 4.0, 1.0)], 9.0))
    mapper = Mapper(GRID)
    first = mapper.add((0.0, 0.0, 0.0), scan_of(robot))
    assert (first.pose, first.placed, first.reason) == ((0.0, 0.0, 0.0), Placed.PREDICTED, NoMatch.EMPTY_MAP)
    assert (mapper.occupancy.cells() >= 0).any()


def test_a_pose_that_is_none_is_no_error() -> None:
    robot = jackal(world_of([], 9.0))
    mapper = Mapper(GRID)
    for pose in ((math.nan, 0.0, 0.0), (0.0, 0.0, math.inf), (500.0, 0.0, 0.0)):
        found = mapper.add(pose, scan_of(robot))
        assert found.placed is Placed.REFUSED and found.reason is NoMatch.POSE
    assert (mapper.occupancy.cells() == -1).all() and mapper.occupancy.ignored[Ignored.POSE] == 0


@pytest.mark.parametrize("wrong", [0.0, math.nan, 1000.0])
def test_options_that_are_none_are_refused(wrong: float) -> None:
    with pytest.raises(UsageError, match="free_m"):
        MapperOptions(free_m=wrong)
