"""The controller: it gets there, around things, within the robot's limits, and says when it cannot."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sern_core.vocabulary.errors import UsageError
from sern_navigation.costmap.costs import Costmap
from sern_navigation.costmap.layered import LayeredCostmap
from sern_navigation.mppi import Control, ControlCode, Mppi, MppiOptions, Speed, pruned
from sern_twin.world.grid import Floats, Grid
from sern_twin.world.occupancy import Pose
from tests.exploring import seeds
from tests.sern_navigation.worlds import filled

GRID = Grid(-5.0, -5.0, 0.1, 100, 100)
OPTIONS = MppiOptions(batch_size=400)
STRAIGHT = np.array([[0.0, 0.0], [4.0, 0.0]])
GOAL = (4.0, 0.0, None)


def costmap_of(*areas: tuple[float, float, float, float]) -> Costmap:
    layered = LayeredCostmap(GRID)
    layered.static.take(GRID, filled(GRID, *areas))
    return layered.everywhere(0.0)


def moved(pose: Pose, speed: Speed, step_s: float = 0.1) -> Pose:
    heading = pose[2] + speed[1] * step_s / 2
    return (
        pose[0] + speed[0] * step_s * math.cos(heading),
        pose[1] + speed[0] * step_s * math.sin(heading),
        pose[2] + speed[1] * step_s,
    )


def drive(
    mppi: Mppi, costmap: Costmap, path_m: Floats, pose: Pose, goal: tuple[float, float, float | None], steps: int = 300
) -> list[tuple[Pose, Control]]:
    """An ideal robot until it is 15 cm from the goal, at most."""
    speed: Speed = (0.0, 0.0)
    found = []
    for _ in range(steps):
        control = mppi.command(pose, speed, path_m, goal, costmap)
        speed = control.command
        pose = moved(pose, speed)
        found.append((pose, control))
        if math.dist(pose[:2], goal[:2]) < 0.15 and (
            goal[2] is None or abs(math.remainder(pose[2] - goal[2], math.tau)) < 0.2
        ):
            break
    return found


@pytest.mark.parametrize("yaw_rad", [0.0, 1.5, math.pi, -2.0])
def test_it_drives_to_the_goal_wherever_it_looks_first(yaw_rad: float) -> None:
    way = drive(Mppi(OPTIONS, np.random.default_rng(1)), costmap_of(), STRAIGHT, (0.0, 0.0, yaw_rad), GOAL)
    assert math.dist(way[-1][0][:2], (4.0, 0.0)) < 0.15
    assert all(abs(pose[1]) < 0.6 for pose, _control in way)
    assert len(way) < 200


def test_it_drives_around_what_has_come_to_lie_on_its_path() -> None:
    """Without a new plan, which it needs for what lies right across."""
    costmap = costmap_of((1.8, -0.1, 2.0, 0.3))
    way = drive(Mppi(OPTIONS, np.random.default_rng(1)), costmap, STRAIGHT, (0.0, 0.0, 0.0), GOAL)
    assert math.dist(way[-1][0][:2], (4.0, 0.0)) < 0.15
    assert not costmap.blocked().reshape(-1)[GRID.flat(np.array([pose[:2] for pose, _control in way]))].any()


def test_it_turns_as_the_goal_wants() -> None:
    way = drive(
        Mppi(OPTIONS, np.random.default_rng(1)),
        costmap_of(),
        np.array([[0.0, 0.0], [1.0, 0.0]]),
        (0.0, 0.0, 0.0),
        (1.0, 0.0, 1.57),
    )
    assert abs(math.remainder(way[-1][0][2] - 1.57, math.tau)) < 0.2


def test_commands_are_within_the_robots_limits() -> None:
    options = MppiOptions(batch_size=200, vx_max=0.4, wz_max=0.8, ax_max=0.6, ax_min=-0.8, az_max=1.0)
    way = drive(Mppi(options, np.random.default_rng(1)), costmap_of(), STRAIGHT, (0.0, 0.0, 2.5), GOAL, 120)
    speeds = np.array([(0.0, 0.0), *(control.command for _pose, control in way)])
    assert speeds[:, 0].max() <= 0.4 + 1e-9 and speeds[:, 0].min() >= -0.35 - 1e-9
    assert np.abs(speeds[:, 1]).max() <= 0.8 + 1e-9 and np.abs(speeds[:, 1]).max() > 0.7
    changes = np.diff(speeds, axis=0)
    assert changes[:, 0].max() <= 0.06 + 1e-9 and changes[:, 0].min() >= -0.08 - 1e-9
    assert np.abs(changes[:, 1]).max() <= 0.1 + 1e-9


@pytest.mark.parametrize("seed", seeds(30))
def test_no_command_begins_a_trajectory_into_something(seed: int) -> None:
    random = np.random.default_rng(seed)
    areas = []
    for _ in range(int(random.integers(1, 12))):
        x_m, y_m = random.uniform(-4, 4, 2).tolist()
        if math.hypot(x_m, y_m) > 0.8:
            areas.append((x_m - 0.2, y_m - 0.2, x_m + 0.2, y_m + 0.2))
    costmap = costmap_of(*areas)
    mppi = Mppi(MppiOptions(batch_size=100), random)
    pose, speed = (0.0, 0.0, float(random.uniform(-3, 3))), (float(random.uniform(-0.3, 0.5)), 0.0)
    for _ in range(15):
        control = mppi.command(pose, speed, STRAIGHT, GOAL, costmap)
        if control.code is ControlCode.NONE:
            assert not costmap.blocked().reshape(-1)[GRID.flat(control.trajectory[:, :2])].any()
            assert control.trajectory[0] == pytest.approx(moved(pose, control.command))
        else:
            assert control.command == (0.0, 0.0) and control.message
        speed = control.command
        pose = moved(pose, speed)


def test_a_robot_that_is_too_fast_is_told_no_more_than_the_limits() -> None:
    control = Mppi(OPTIONS, np.random.default_rng(1)).command(
        (0.0, 0.0, 0.0), (2.0, -4.0), STRAIGHT, GOAL, costmap_of()
    )
    assert control.code is ControlCode.NONE and control.command == (0.5, -1.9)


def test_where_all_is_in_the_way_there_is_no_command() -> None:
    """In a box that it would touch wherever it went, at a speed at which it cannot stop."""
    costmap = costmap_of((0.5, -1.0, 0.7, 1.0))
    control = Mppi(OPTIONS, np.random.default_rng(1)).command((0.1, 0.0, 0.0), (3.0, 0.0), STRAIGHT, GOAL, costmap)
    assert control.code is ControlCode.NO_VALID_CONTROL and control.command == (0.0, 0.0)
    assert control.trajectory.shape == (0, 3) and control.message


def test_a_robot_that_touches_something_gets_away() -> None:
    costmap = costmap_of((-0.6, -1.0, -0.2, 1.0))
    assert costmap.blocked()[GRID.index(np.array([0.0, 0.0]))]
    way = drive(Mppi(OPTIONS, np.random.default_rng(1)), costmap, STRAIGHT, (0.0, 0.0, 0.0), GOAL)
    assert math.dist(way[-1][0][:2], (4.0, 0.0)) < 0.15
    assert min(pose[0] for pose, _control in way) > -0.15


def test_the_same_seed_gives_the_same_commands() -> None:
    ways = [
        drive(Mppi(OPTIONS, np.random.default_rng(5)), costmap_of(), STRAIGHT, (0.0, 0.0, 1.0), GOAL, 20)
        for _ in range(2)
    ]
    assert [control.command for _pose, control in ways[0]] == [control.command for _pose, control in ways[1]]
    other = drive(Mppi(OPTIONS, np.random.default_rng(6)), costmap_of(), STRAIGHT, (0.0, 0.0, 1.0), GOAL, 20)
    assert other[-1][1].command != ways[0][-1][1].command


def test_it_is_the_same_far_from_the_origin() -> None:
    """Single precision knows whole metres at 10,000 km."""
    far = replace(GRID, west_m=9_000_000.0, south_m=-9_000_000.0)
    costmap = costmap_of((1.8, -0.3, 2.2, 0.3))
    shift = np.array([far.west_m - GRID.west_m, far.south_m - GRID.south_m])
    one = Mppi(OPTIONS, np.random.default_rng(1)).command((0.0, 0.0, 0.3), (0.2, 0.0), STRAIGHT, GOAL, costmap)
    other = Mppi(OPTIONS, np.random.default_rng(1)).command(
        (float(shift[0]), float(shift[1]), 0.3),
        (0.2, 0.0),
        STRAIGHT + shift,
        (4.0 + float(shift[0]), float(shift[1]), None),
        replace(costmap, grid=far),
    )
    assert other.command == pytest.approx(one.command, abs=1e-3)


def test_a_path_without_points_is_none_and_one_point_is_enough() -> None:
    mppi = Mppi(OPTIONS, np.random.default_rng(1))
    empty = mppi.command((0.0, 0.0, 0.0), (0.0, 0.0), np.empty((0, 2)), GOAL, costmap_of())
    assert empty.code is ControlCode.INVALID_PATH and empty.command == (0.0, 0.0)
    one = mppi.command((0.0, 0.0, 0.0), (0.0, 0.0), np.array([[1.0, 0.0]]), (1.0, 0.0, None), costmap_of())
    assert one.code is ControlCode.NONE


def test_a_path_is_pruned_to_what_lies_ahead() -> None:
    path = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [1.0, 3.0]])
    found = pruned(path, (0.9, 0.5, 0.0), 1.0)
    assert found[0] == pytest.approx((1.0, 0.5)) and found[-1] == pytest.approx((1.0, 1.5))
    assert np.hypot(*np.diff(found, axis=0).T)[:-1] == pytest.approx(0.05)
    assert pruned(path, (1.0, 2.9, 0.0), 5.0)[-1] == pytest.approx((1.0, 3.0))
    assert pruned(np.array([[2.0, 2.0], [2.0, 2.0]]), (0.0, 0.0, 0.0), 1.0) == pytest.approx(np.array([[2.0, 2.0]]))


def test_slower_periods_than_the_model_are_refused_and_faster_ones_are_not() -> None:
    with pytest.raises(UsageError, match="not longer than model_dt"):
        MppiOptions(controller_frequency=5.0)
    fast = Mppi(MppiOptions(batch_size=200, controller_frequency=20.0), np.random.default_rng(1))
    speed: Speed = (0.0, 0.0)
    for _ in range(10):
        speed = fast.command((0.0, 0.0, 0.0), speed, STRAIGHT, GOAL, costmap_of()).command
    assert speed[0] > 0.2


@pytest.mark.parametrize(
    "change",
    [
        {"batch_size": 3}, {"time_steps": 1}, {"iteration_count": 0}, {"model_dt": 0.0}, {"temperature": math.nan},
        {"vx_max": -1.0}, {"vx_min": 0.1}, {"ax_min": 0.0}, {"az_max": 0.0}, {"gamma": -1.0}, {"prune_distance": 0.0},
        {"retry_attempt_limit": -1}, {"wz_std": math.inf},
    ],
)  # fmt: skip
def test_options_that_are_none_are_refused(change: dict[str, Any]) -> None:
    with pytest.raises(UsageError, match="mppi"):
        MppiOptions(**change)
