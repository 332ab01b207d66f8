"""The map that a robot makes while it drives, and its place on it."""

import math

import numpy as np
import pytest

from sern_core.vocabulary.errors import UsageError
from sern_navigation.mapping import Mapper, MapperOptions, Placed
from sern_navigation.matching import NoMatch
from sern_navigation.scan import ObstacleScan, ScanOptions, obstacle_scan
from sern_sim.robot import Pose2, SimulatedJackal
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


def test_a_robot_that_drives_knows_where_it_is() -> None:
    """In circles, by wheels that are wrong about turns: they end far off, and the map keeps the robot on its way."""
    robot = jackal(world_of([*box(3.0, -1.0, 4.0, 1.0), *box(-5.0, 3.0, -4.0, 6.0), *box(-2.0, -6.0, 0.0, -5.0)], 9.0))
    mapper, wheels, off_m = Mapper(GRID), robot.state.odometry, []
    drifted: Pose = (0.0, 0.0, 0.0)
    mapped = mapper.add(drifted, scan_of(robot))
    robot.drive(0.6, 0.9)
    for _ in range(80):
        for _ in range(10):
            robot.step()
        now = robot.state.odometry
        drifted = after(drifted, wheels, now)
        mapped = mapper.add(after(mapped.pose, wheels, now), scan_of(robot))
        wheels = now
        off_m.append(math.dist(mapped.pose[:2], (robot.state.pose.x_m, robot.state.pose.y_m)))
    assert max(off_m) < 0.12
    assert math.dist(drifted[:2], (robot.state.pose.x_m, robot.state.pose.y_m)) > 0.5
    assert mapper.counts[Placed.MATCHED] > 70 and mapper.counts[Placed.REFUSED] == 0
    assert mapped.match is not None and mapped.reason is None
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
