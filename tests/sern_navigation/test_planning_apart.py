"""Plans that somebody else makes: what the robot does meanwhile, and what answers count nothing."""

import math
import pickle
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from sern_navigation.costmap.layered import LayeredCostmap
from sern_navigation.costmap.twin import TwinView
from sern_navigation.global_plan import PlannerOptions, PlanRequest, plan, plan_for
from sern_navigation.mppi import MppiOptions
from sern_navigation.navigator import Code, Command, Goal, Navigator, NavigatorOptions, State, Unused
from sern_navigation.scan import Cloud
from sern_sim.robot import BODY_RADIUS_M, STEP_S, SimulatedJackal
from sern_sim.world import World
from sern_twin.world.grid import Grid
from sern_twin.world.occupancy import Pose
from tests.exploring import seeds
from tests.sern_navigation.worlds import (
    PERIOD_S,
    Wall,
    box,
    empty_map,
    filled,
    jackal,
    level,
    looking_at,
    seen,
    world_of,
)

GRID = Grid(-6.0, -6.0, 0.1, 120, 120)
OPTIONS = NavigatorOptions(controller=MppiOptions(batch_size=100))
GROUND = looking_at(level)
HERE: Pose = (0.0, 0.0, 0.0)


AHEAD = Goal(3.0, 0.0)


def navigator(goal: Goal = AHEAD, options: NavigatorOptions = OPTIONS, **given: bool) -> Navigator:
    one = Navigator(GRID, np.random.default_rng(1), options, **({"plans_itself": False} | given))
    one.go(goal)
    return one


def step(one: Navigator, now_s: float, pose: Pose = HERE) -> Command:
    return one.step(now_s, pose, Cloud(GROUND, now_s))


def asked(one: Navigator, now_s: float = 0.0) -> PlanRequest:
    step(one, now_s)
    request = one.request()
    assert request is not None
    return request


def driven(robot: SimulatedJackal, one: Navigator, late: int, seconds: float) -> Command:
    """Drive until the goal is reached or given up. An answer comes so many cycles after it was asked for."""
    wait: list[PlanRequest] = []
    for number in range(round(seconds / PERIOD_S)):
        pose = robot.state.pose
        command = one.step(robot.state.time_s, (pose.x_m, pose.y_m, pose.yaw_rad), seen(robot, 5_760))
        if command.status.state not in (State.FOLLOWING, State.RECOVERING):
            break
        if request := one.request():
            wait.append(request)
        if wait and number % (late + 1) == late:
            one.planned(wait[0], plan_for(wait.pop(0)))
        robot.drive(command.speed[0], command.speed[1] / robot.yaw_scale_known)
        for _ in range(round(PERIOD_S / STEP_S)):
            here = robot.step().pose
            assert robot.world.clearance_m(here.x_m, here.y_m) > BODY_RADIUS_M
    return command


def test_until_there_is_a_plan_the_robot_stands_and_then_it_drives() -> None:
    one = navigator()
    request = asked(one)
    assert request.start_m == (0.0, 0.0) and request.goal_m == (3.0, 0.0) and request.stamp_s == 0.0
    waiting = step(one, 0.1)
    assert waiting.speed == (0.0, 0.0) and waiting.status.state is State.FOLLOWING
    assert waiting.status.code is Code.NONE and "plan" in waiting.status.message
    assert one.request() is None, "it was asked for"
    assert one.planned(request, plan_for(request))
    for number in range(2, 12):
        command = step(one, number / 10)
    assert command.speed[0] > 0.3 and command.status.message == ""


def test_commands_are_those_of_a_navigator_that_plans_itself_a_cycle_later() -> None:
    """The first of them plans in the cycle; of the other the plan is there before the next."""
    one, other = navigator(plans_itself=True), navigator()
    request = asked(other)
    other.planned(request, plan_for(request))
    for number in range(1, 9):
        mine, theirs = step(one, number / 10), step(other, number / 10)
        assert mine.speed == theirs.speed and (mine.trajectory == theirs.trajectory).all()
    assert one.request() is None and one.unused[Unused.PLAN] == 0


def test_while_a_plan_is_made_it_follows_the_one_before() -> None:
    one = navigator()
    request = asked(one)
    one.planned(request, plan_for(request))
    before = one.path_m
    for number in range(1, 11):
        step(one, number / 10)
    again = one.request()
    assert again is not None and again.stamp_s == 1.0, "planner_frequency is 1"
    for number in range(11, 25):
        command = step(one, number / 10)
        assert one.path_m is before and command.speed[0] > 0.2 and one.request() is None
    one.planned(again, plan_for(again))
    assert one.path_m is not before


def test_where_nobody_asks_the_request_is_of_the_last_step() -> None:
    one = navigator()
    for number in range(5):
        step(one, number / 10, (0.1 * number, 0.0, 0.0))
    request = one.request()
    assert request is not None and request.start_m == (0.4, 0.0) and request.stamp_s == 0.4


@pytest.mark.parametrize("asks", [True, False], ids=["no answer", "nobody asks"])
def test_when_no_plan_comes_it_says_so_and_gives_up_after_all_was_tried(asks: bool) -> None:
    one = navigator()
    requests: list[PlanRequest] = []
    for number in range(600):
        command = step(one, number / 10)
        if asks and (request := one.request()):
            requests.append(request)
        if number == 21:
            assert (command.status.state, command.status.code) == (State.RECOVERING, Code.TIMEOUT)
        if command.status.state is State.ABORTED:
            break
    assert command.status.code is Code.TIMEOUT and "within 2 s" in command.status.message
    assert command.status.recoveries == 6 and len(requests) == (7 if asks else 0)
    assert not any(one.planned(request, plan_for(request)) for request in requests), "nobody waits any more"
    assert one.unused[Unused.PLAN] == len(requests)


def another_goal(one: Navigator, _request: PlanRequest) -> None:
    one.go(Goal(0.0, 3.0))


def no_goal(one: Navigator, _request: PlanRequest) -> None:
    one.cancel()


def another_map(one: Navigator, _request: PlanRequest) -> None:
    one.set_map(GRID, filled(GRID, (1.0, -2.0, 1.3, 2.0)))


def an_answer(one: Navigator, request: PlanRequest) -> None:
    assert one.planned(request, plan_for(request))
    one.path_m = np.empty((0, 2))


@pytest.mark.parametrize("what", [another_goal, no_goal, another_map, an_answer])
def test_a_plan_for_what_was_before_counts_nothing_and_is_counted(
    what: Callable[[Navigator, PlanRequest], None],
) -> None:
    one = navigator()
    request = asked(one)
    what(one, request)
    assert not one.planned(request, plan_for(request))
    assert one.unused[Unused.PLAN] == 1 and not len(one.path_m)


def test_a_plan_that_is_not_found_is_said_at_the_next_step() -> None:
    one = navigator()
    one.set_map(GRID, filled(GRID, (2.0, -1.0, 4.0, 1.0)))
    request = asked(one)
    assert one.planned(request, plan_for(request)), "that there is none is an answer"
    command = step(one, 0.1)
    assert (command.status.state, command.status.code) == (State.ABORTED, Code.GOAL_OCCUPIED)
    assert "(3.00, 0.00)" in command.status.message


def test_a_request_keeps_what_was_so_and_goes_to_another_process() -> None:
    one = navigator()
    request = pickle.loads(pickle.dumps(asked(one)))
    before = plan_for(request).path_m
    one.costmap.obstacles.lethal[:] = True
    one.costmap.twin.take(TwinView(GRID, filled(GRID, (1.0, -2.0, 1.3, 2.0)), 0.0))
    assert (plan_for(request).path_m == before).all() and len(before) > 10
    assert one.planned(request, plan_for(request))


@pytest.mark.parametrize("seed", seeds(10))
def test_a_snapshot_is_the_costmap_of_its_moment(seed: int) -> None:
    random = np.random.default_rng(seed)
    layers = LayeredCostmap(GRID)
    layers.static.take(GRID, np.where(random.random(GRID.shape) < 0.02, 100, empty_map(GRID)).astype(np.int8))
    layers.twin.take(TwinView(GRID, random.integers(-1, 101, GRID.shape).astype(np.int8), 0.0))
    layers.obstacles.lethal[random.random(GRID.shape) < 0.02] = True
    layers.obstacles.seen_free[random.random(GRID.shape) < 0.3] = True
    for now_s in (0.0, 9.0):
        whole, middle = layers.everywhere(now_s), layers.local(now_s, 0.0, 0.0, 2.0)
        assert middle is not None
        rows = columns = slice(40, 81)
        assert (middle.costs == whole.costs[rows, columns]).all()
        assert (middle.soft == whole.soft[rows, columns]).all() and bool(middle.soft.any()) is (now_s == 0.0)


def test_it_drives_to_its_goal_with_plans_of_elsewhere() -> None:
    """Around a car, with answers that come three cycles late."""
    walls = box(1.5, -0.9, 3.5, 0.9, 1.4)
    for plans_itself in (True, False):
        robot = jackal(world_of(walls, 5.8))
        one = navigator(Goal(4.8, 0.0), plans_itself=plans_itself)
        last = driven(robot, one, 3, 30.0)
        assert last.status.state is State.SUCCEEDED and last.status.recoveries == 0
        assert robot.state.time_s < 25


@pytest.mark.parametrize("seed", seeds(6))
def test_late_plans_lead_into_nothing(seed: int) -> None:
    """Worlds that nobody knows, with answers up to a second late."""
    random = np.random.default_rng(seed)
    walls: list[Wall] = []
    while len(walls) < 4 * 5:
        x_m, y_m = random.uniform(-4.5, 4.5, 2).tolist()
        wide_m, high_m = random.uniform(0.2, 0.9, 2).tolist()
        if max(abs(x_m) - wide_m, abs(y_m) - high_m) > 1.2:
            walls += box(x_m - wide_m, y_m - high_m, x_m + wide_m, y_m + high_m, float(random.uniform(0.3, 2.0)))
    world: World = world_of(walls, 5.8)
    robot = jackal(world, seed)
    one = navigator(Goal(*random.uniform(-4.5, 4.5, 2).tolist()))
    command = driven(robot, one, int(random.integers(0, 10)), 8.0)
    assert robot.state.travelled_m > 0.1 or command.status.state is not State.FOLLOWING


def test_a_plan_takes_its_options_along() -> None:
    options = replace(OPTIONS, planner=PlannerOptions(tolerance=1.0))
    one = navigator(Goal(3.0, 0.0), options)
    one.set_map(GRID, filled(GRID, (2.8, -0.2, 3.2, 0.2)))
    request = asked(one)
    made = plan_for(request)
    there = plan(one.costmap.everywhere(0.0), (0.0, 0.0), (3.0, 0.0), options.planner)
    assert made.found and (made.path_m == there.path_m).all() and 0 < math.dist(made.path_m[-1], (3.0, 0.0)) <= 1.0
