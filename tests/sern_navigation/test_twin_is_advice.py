"""The twin advises, and no more: whatever it says, no trajectory enters what real sensors call lethal.

And what is stale is as if it had not been said.
"""

from dataclasses import replace

import numpy as np
import pytest

from sern_navigation.costmap.static import MapOutcome
from sern_navigation.costmap.twin import TwinView
from sern_navigation.global_plan import PlannerOptions, plan
from sern_navigation.mppi import MppiOptions
from sern_navigation.navigator import Command, Goal, Navigator, NavigatorOptions, State
from sern_sim.robot import BODY_RADIUS_M, STEP_S, SimulatedJackal
from sern_sim.world import World
from sern_twin.world.grid import Grid
from sern_twin.world.patches import Cells
from tests.exploring import seeds
from tests.sern_navigation.worlds import PERIOD_S, Wall, box, jackal, seen, world_of

GRID = Grid(-8.0, -8.0, 0.1, 160, 160)
OPTIONS = NavigatorOptions(controller=MppiOptions(batch_size=120))
KINDS = ("noise", "all but the obstacles", "all", "nothing", "displaced")
"""What the twin says: the second is as if the ways through obstacles were the only free ones."""


def random_world(random: np.random.Generator) -> World:
    walls: list[Wall] = []
    while len(walls) < 4 * 7:
        x_m, y_m = random.uniform(-6, 6, 2).tolist()
        wide_m, high_m = random.uniform(0.2, 1.0, 2).tolist()
        if max(abs(x_m) - wide_m, abs(y_m) - high_m) > 1.2:
            walls += box(x_m - wide_m, y_m - high_m, x_m + wide_m, y_m + high_m, float(random.uniform(0.3, 2.0)))
    return world_of(walls, 7.5)


def cells_of(world: World) -> Cells:
    cells = np.zeros(GRID.shape, np.int8)
    for x0, y0, x1, y1, _height in world.walls:
        rows, columns = GRID.index(np.linspace((x0, y0), (x1, y1), 400))
        cells[rows[rows >= 0], columns[rows >= 0]] = 100
    return cells


def twin_of(kind: str, world: World, random: np.random.Generator) -> Cells:
    real = cells_of(world)
    match kind:
        case "noise":
            return random.integers(-1, 101, GRID.shape).astype(np.int8)
        case "all but the obstacles":
            return (100 - real).astype(np.int8)
        case "all":
            return np.full(GRID.shape, 100, np.int8)
        case "nothing":
            return np.full(GRID.shape, -1, np.int8)
        case _:
            return np.roll(real, (6, -6), (0, 1))


def step(navigator: Navigator, robot: SimulatedJackal, twin: TwinView | None) -> Command:
    """One cycle: the command, and what the robot makes of it."""
    pose = robot.state.pose
    command = navigator.step(robot.state.time_s, (pose.x_m, pose.y_m, pose.yaw_rad), seen(robot, 5_760), twin)
    robot.drive(command.speed[0], command.speed[1] / robot.yaw_scale_known)
    for _ in range(round(PERIOD_S / STEP_S)):
        robot.step()
    return command


@pytest.mark.parametrize("seed", seeds(10))
def test_no_twin_leads_a_trajectory_into_what_real_sensors_call_lethal(seed: int) -> None:
    random = np.random.default_rng(seed)
    world = random_world(random)
    robot = jackal(world, seed)
    navigator = Navigator(GRID, np.random.default_rng(seed), OPTIONS)
    x_m, y_m = random.uniform(-6, 6, 2).tolist()
    navigator.go(Goal(x_m, y_m))
    cells = twin_of(KINDS[seed % len(KINDS)], world, random)
    driven = 0
    for _ in range(120):
        command = step(navigator, robot, TwinView(GRID, cells, robot.state.time_s))
        places = GRID.flat(command.trajectory[:, :2])
        assert (places >= 0).all() and not navigator.costmap.obstacles.lethal.reshape(-1)[places].any()
        pose = robot.state.pose
        assert world.clearance_m(pose.x_m, pose.y_m) > BODY_RADIUS_M
        driven += len(places) > 0
        if command.status.state is not State.FOLLOWING:
            break
    assert driven or command.status.state is not State.FOLLOWING


@pytest.mark.parametrize("seed", seeds(20))
def test_no_twin_leads_a_plan_into_what_real_sensors_call_lethal(seed: int) -> None:
    random = np.random.default_rng(seed)
    world = random_world(random)
    for kind in KINDS:
        navigator = Navigator(GRID, random, OPTIONS)
        costmap = navigator.costmap
        assert costmap.static.take(GRID, cells_of(world)) is MapOutcome.TAKEN
        costmap.twin.take(TwinView(GRID, twin_of(kind, world, random), 0.0))
        x_m, y_m = random.uniform(-6, 6, 2).tolist()
        with_twin = plan(costmap.everywhere(0.0), (0.0, 0.0), (x_m, y_m), PlannerOptions())
        without = plan(costmap.everywhere(9.0), (0.0, 0.0), (x_m, y_m), PlannerOptions())
        assert with_twin.code is without.code, "and it makes no place unreachable"
        if with_twin.found:
            blocked = costmap.everywhere(0.0).blocked()
            assert not blocked.reshape(-1)[GRID.flat(with_twin.path_m)].any()


@pytest.mark.parametrize("seed", seeds(5))
def test_what_is_stale_is_as_if_it_had_not_been_said(seed: int) -> None:
    """Command by command, of two robots that differ in nothing else."""
    random = np.random.default_rng(seed)
    world = random_world(random)
    goal = Goal(*random.uniform(-6, 6, 2).tolist())
    robots = [jackal(world, seed) for _ in range(2)]
    navigators = [Navigator(GRID, np.random.default_rng(seed), OPTIONS) for _ in range(2)]
    for navigator in navigators:
        navigator.go(goal)
    stale = TwinView(GRID, twin_of(KINDS[seed % 3], world, random), 0.0)
    for _ in range(40):
        age_s = OPTIONS.costmap.twin.staleness_s + float(random.uniform(0.001, 100.0))
        view = replace(stale, stamp_s=robots[0].state.time_s - age_s)
        commands = [step(navigators[0], robots[0], view), step(navigators[1], robots[1], None)]
        assert commands[0].speed == commands[1].speed and commands[0].wanted == commands[1].wanted
        assert (commands[0].trajectory == commands[1].trajectory).all()
    assert robots[0].state == robots[1].state
    assert robots[0].state.travelled_m > 0.1 or commands[0].status.state is State.ABORTED, "its goal may be in a thing"


def test_what_is_fresh_does_change_a_command() -> None:
    """Otherwise the test above says nothing."""
    world = world_of([], 7.5)
    robots = [jackal(world) for _ in range(2)]
    navigators = [Navigator(GRID, np.random.default_rng(1), OPTIONS) for _ in range(2)]
    for navigator in navigators:
        navigator.go(Goal(5.0, 0.0))
    cells = np.zeros(GRID.shape, np.int8)
    cells[70:95, 110:130] = 100
    commands = [
        [step(navigators[0], robots[0], TwinView(GRID, cells, robots[0].state.time_s)) for _ in range(15)],
        [step(navigators[1], robots[1], None) for _ in range(15)],
    ]
    assert commands[0][-1].speed != commands[1][-1].speed
