"""Goals, codes and messages; what comes from outside and cannot be used; and when the robot stands."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sern_core.vocabulary.errors import UsageError
from sern_navigation.collision_monitor import Action
from sern_navigation.costmap.layered import CostmapOptions
from sern_navigation.costmap.obstacles import ObstacleOptions
from sern_navigation.costmap.static import MapOutcome
from sern_navigation.costmap.twin import TwinView
from sern_navigation.mppi import MppiOptions
from sern_navigation.navigator import Code, Command, Goal, Navigator, NavigatorOptions, State, Unused
from sern_navigation.scan import Cloud, ObstacleScan, obstacle_scan
from sern_twin.world.grid import Grid
from sern_twin.world.occupancy import Pose
from tests.exploring import seeds
from tests.sern_navigation.worlds import empty_map, filled, level, looking_at

GRID = Grid(-6.0, -6.0, 0.1, 120, 120)
OPTIONS = NavigatorOptions(controller=MppiOptions(batch_size=100))
GROUND = looking_at(level)
HERE: Pose = (0.0, 0.0, 0.0)


def navigator(seed: int = 1, options: NavigatorOptions = OPTIONS) -> Navigator:
    return Navigator(GRID, np.random.default_rng(seed), options)


def cloud(now_s: float, frame_id: str = "base_link") -> Cloud:
    return Cloud(GROUND, now_s, frame_id)


def stands(command: Command, state: State, code: Code) -> None:
    assert command.speed == (0.0, 0.0) and command.wanted == (0.0, 0.0)
    assert (command.status.state, command.status.code) == (state, code)
    assert command.status.message and "\n" not in command.status.message


def run(one: Navigator, seconds: float, pose: Pose | None = HERE, start_s: float = 0.0, **given: Any) -> Command:
    """A robot that stays where it is, whatever it is told, and sees level ground."""
    for number in range(round(seconds * 10) + 1):
        now_s = start_s + number / 10
        scan = given.get("scan", cloud)
        command = one.step(now_s, pose, scan and scan(now_s), given.get("twin"))
    return command


def test_without_a_goal_it_stands() -> None:
    one = navigator()
    command = one.step(0.0, HERE, cloud(0.0))
    assert command.speed == (0.0, 0.0) and command.status.state is State.IDLE and command.status.code is Code.NONE


def test_it_drives_to_its_goal() -> None:
    one = navigator()
    one.go(Goal(3.0, 0.0))
    for number in range(10):
        command = one.step(number / 10, HERE, cloud(number / 10))
    assert command.speed[0] > 0.3 and command.status.state is State.FOLLOWING and command.status.code is Code.NONE
    assert command.status.distance_remaining_m == pytest.approx(3.0)
    assert len(one.path_m) > 10 and command.trajectory.shape == (30, 3)


def test_at_the_goal_it_has_succeeded_and_looks_where_it_is_to() -> None:
    one = navigator()
    one.go(Goal(0.1, 0.1, 2.0))
    turning = one.step(0.0, HERE, cloud(0.0))
    assert turning.status.state is State.FOLLOWING, "it is there, and looks elsewhere"
    done = one.step(0.1, (0.1, 0.1, 1.9), cloud(0.1))
    assert done.status.state is State.SUCCEEDED and done.speed == (0.0, 0.0)
    assert one.step(0.2, (0.1, 0.1, 1.9), cloud(0.2)).status.state is State.SUCCEEDED


def test_a_goal_in_an_obstacle_is_refused_at_once() -> None:
    one = navigator()
    assert one.set_map(GRID, filled(GRID, (2.0, -1.0, 4.0, 1.0))) is MapOutcome.TAKEN
    one.go(Goal(3.0, 0.0))
    command = one.step(0.0, HERE, cloud(0.0))
    stands(command, State.ABORTED, Code.GOAL_OCCUPIED)
    assert command.status.recoveries == 0 and "(3.00, 0.00)" in command.status.message


def test_a_goal_that_cannot_be_reached_is_given_up_after_all_was_tried() -> None:
    one = navigator()
    one.set_map(GRID, filled(GRID, (2.0, -6.0, 2.3, 6.0)))
    one.go(Goal(4.0, 0.0))
    seen: list[str] = []
    for number in range(600):
        command = one.step(number / 10, HERE, cloud(number / 10))
        if command.status.behaviour is not None and (not seen or seen[-1] != command.status.behaviour.value):
            seen.append(command.status.behaviour.value)
        if command.status.state is State.ABORTED:
            break
    stands(command, State.ABORTED, Code.NO_VALID_PATH)
    assert seen == ["clear_costmap", "spin", "wait", "back_up", "clear_costmap", "spin"]


@pytest.mark.parametrize(
    ("goal", "code", "says"),
    [
        (Goal(math.nan, 0.0), Code.GOAL_INVALID, "not finite"),
        (Goal(0.0, 0.0, math.inf), Code.GOAL_INVALID, "not finite"),
        (Goal(1.0, 0.0, None, "odom"), Code.GOAL_INVALID, "'odom'"),
        (Goal(60.0, 0.0), Code.GOAL_OUTSIDE_MAP, "not on the map"),
    ],
)
def test_a_goal_that_is_none_is_refused_at_once(goal: Goal, code: Code, says: str) -> None:
    one = navigator()
    one.go(goal)
    command = one.step(0.0, HERE, cloud(0.0))
    stands(command, State.ABORTED, code)
    assert says in command.status.message


def test_a_map_of_another_resolution_is_refused_and_no_goal_pursued() -> None:
    one = navigator()
    other = Grid(-6.0, -6.0, 0.05, 240, 240)
    assert one.set_map(other, empty_map(other)) is MapOutcome.OTHER_RESOLUTION
    one.go(Goal(3.0, 0.0))
    command = one.step(0.0, HERE, cloud(0.0))
    stands(command, State.ABORTED, Code.MAP_REFUSED)
    assert "other_resolution" in command.status.message and "0.1 m" in command.status.message
    one.set_map(GRID, empty_map(GRID))
    one.go(Goal(3.0, 0.0))
    assert run(one, 1.0).speed[0] > 0.2


def test_a_cloud_of_another_frame_is_none() -> None:
    one = navigator()
    one.go(Goal(3.0, 0.0))
    command = run(one, 1.0, scan=lambda now_s: cloud(now_s, "velodyne"))
    stands(command, State.FOLLOWING, Code.NO_PERCEPTION)
    assert "'velodyne'" in command.status.message and command.verdict.action is Action.NO_DATA
    assert one.unused[Unused.SCAN] == 11 and one.scan_refusals == {"other_frame": 11}
    later = run(one, 11.0, start_s=1.1, scan=lambda now_s: cloud(now_s, "velodyne"))
    stands(later, State.ABORTED, Code.NO_PERCEPTION)


@pytest.mark.parametrize(
    ("points", "reason"),
    [
        (np.empty((0, 3)), "empty"),
        (np.full((9, 3), np.nan), "not_finite"),
        (np.zeros((9, 2)), "shape"),
        (np.zeros((999, 3)), "too_few"),
    ],
)
def test_clouds_that_are_none_are_counted_and_it_stands(points: np.ndarray[Any, Any], reason: str) -> None:
    one = navigator()
    one.go(Goal(3.0, 0.0))
    stands(run(one, 1.0, scan=lambda now_s: Cloud(points, now_s)), State.FOLLOWING, Code.NO_PERCEPTION)
    assert one.scan_refusals == {reason: 11}


def test_when_its_eyes_fail_it_stands_within_the_time_and_goes_on_when_they_see_again() -> None:
    one = navigator()
    one.go(Goal(3.0, 0.0))
    assert run(one, 1.0).speed[0] > 0.2
    blind = [one.step(1.0 + number / 10, HERE, None) for number in range(1, 30)]
    assert blind[8].speed[0] > 0.2 and blind[9].status.code is Code.NONE, "a second is allowed"
    stands(blind[-1], State.FOLLOWING, Code.NO_PERCEPTION)
    assert all(command.speed == (0.0, 0.0) for command in blind[10:])
    assert run(one, 1.0, start_s=4.0).speed[0] > 0.2


def test_a_scan_of_a_moment_ago_is_seen_from_where_the_robot_is_now() -> None:
    """A pillar 1.2 m ahead, and no scan while the robot drives 0.7 m towards it and turns: it is at its left then."""
    one = navigator(options=replace(OPTIONS, costmap=CostmapOptions(obstacles=ObstacleOptions(obstacle_max_range=0.5))))
    one.go(Goal(3.0, 0.0))
    pillar = looking_at(lambda x, y: np.where(np.hypot(x - 1.2, y) < 0.1, 1.0, 0.0))
    one.step(0.0, HERE, Cloud(pillar, 0.0))
    assert not one.costmap.obstacles.lethal.any(), "it is not marked, so that the scan alone can show it"
    ahead = one.step(0.5, (0.8, 0.0, 0.0))
    assert ahead.wanted[0] > 0.2 and ahead.verdict.action is Action.STOP and ahead.verdict.polygon == "PolygonStop"
    beside = one.step(0.6, (0.8, 0.0, -math.pi / 2))
    assert beside.verdict.polygon != "PolygonStop"


def test_scans_that_come_late_are_not_believed() -> None:
    one = navigator()
    one.go(Goal(3.0, 0.0))
    for stamp_s in (3.0, 7.0):
        stands(one.step(5.0, HERE, cloud(stamp_s)), State.FOLLOWING, Code.NO_PERCEPTION)
    assert one.unused[Unused.SCAN_LATE] == 2 and not one.costmap.obstacles.seen_free.any()


@pytest.mark.parametrize(
    "pose", [None, (math.nan, 0.0, 0.0), (0.0, math.inf, 0.0), (0.0, 0.0, math.nan), (1e300, 0, 0)]
)
def test_without_a_place_it_stands(pose: Pose | None) -> None:
    one = navigator()
    one.go(Goal(3.0, 0.0))
    stands(run(one, 1.0, pose), State.FOLLOWING, Code.NO_POSE)
    stands(run(one, 11.0, pose, 1.1), State.ABORTED, Code.NO_POSE)
    assert one.unused[Unused.POSE] == (0 if pose is None else 122)


def test_a_robot_off_the_map_is_told_so() -> None:
    one = navigator()
    one.go(Goal(3.0, 0.0))
    stands(one.step(0.0, (50.0, 0.0, 0.0), cloud(0.0)), State.ABORTED, Code.START_OUTSIDE_MAP)


def test_a_robot_that_does_not_move_is_stuck() -> None:
    one = navigator()
    one.go(Goal(3.0, 0.0))
    run(one, 9.9)
    command = run(one, 0.3, start_s=10.0)
    assert command.status.recoveries == 1
    command = run(one, 120.0, start_s=10.4)
    stands(command, State.ABORTED, Code.FAILED_TO_MAKE_PROGRESS)


def test_a_goal_can_be_cancelled_and_another_pursued() -> None:
    one = navigator()
    one.cancel()
    assert one.status.state is State.IDLE, "there was none"
    one.go(Goal(3.0, 0.0))
    run(one, 1.0)
    one.cancel()
    stands(one.step(1.1, HERE, cloud(1.1)), State.CANCELLED, Code.CANCELLED)
    one.go(Goal(-3.0, 0.0))
    turning = run(one, 1.0, start_s=1.2)
    assert turning.status.state is State.FOLLOWING and abs(turning.speed[1]) > 0.3


def test_time_that_goes_back_or_is_none_is_counted_and_it_stands() -> None:
    one = navigator()
    one.go(Goal(3.0, 0.0))
    run(one, 1.0)
    for now_s in (0.5, math.nan, math.inf):
        assert one.step(now_s, HERE, cloud(1.0)).speed == (0.0, 0.0)
    assert one.unused[Unused.TIME] == 3
    assert one.step(1.1, HERE, cloud(1.1)).status.state is State.FOLLOWING


def test_speeds_that_are_none_are_counted() -> None:
    one = navigator()
    one.go(Goal(3.0, 0.0))
    for number, speed in enumerate([(math.nan, 0.0), (0.0, -math.inf), (1e300, 0.0), (0.0, 101.0)]):
        command = one.step(number / 10, HERE, cloud(number / 10), speed=speed)
        assert one.unused[Unused.SPEED] == number + 1
        assert abs(command.speed[0]) <= 0.5 and abs(command.speed[1]) <= 1.9


def test_a_twin_of_another_grid_counts_nothing_and_is_counted() -> None:
    one, other = navigator(), navigator()
    strange = TwinView(replace(GRID, cell_m=0.2), empty_map(GRID), 0.0)
    for single in (one, other):
        single.go(Goal(3.0, 0.0))
    commands = [run(one, 1.0, twin=strange), run(other, 1.0)]
    assert commands[0].speed == commands[1].speed and one.unused[Unused.TWIN] == 11


def test_scans_may_be_made_elsewhere() -> None:
    one, other = navigator(), navigator()
    for single in (one, other):
        single.go(Goal(3.0, 0.0))
    for number in range(5):
        now_s = number / 10
        made = obstacle_scan(cloud(now_s), OPTIONS.scan)
        assert isinstance(made, ObstacleScan)
        assert one.step(now_s, HERE, cloud(now_s)).speed == other.step(now_s, HERE, made).speed


@pytest.mark.parametrize("seed", seeds(15))
def test_whatever_comes_nothing_is_raised(seed: int) -> None:
    random = np.random.default_rng(seed)
    one = navigator(seed, NavigatorOptions(controller=MppiOptions(batch_size=20, time_steps=8)))
    odd = [math.nan, math.inf, -math.inf, 1e300, -1e300, 0.0, 5.9]

    def number() -> float:
        return float(random.choice(odd)) if random.random() < 0.1 else float(random.uniform(-5, 5))

    now_s = 0.0
    for _ in range(40):
        now_s = now_s + 0.1 if random.random() < 0.9 else number()
        if random.random() < 0.2:
            one.go(Goal(number(), number(), number() if random.random() < 0.5 else None))
        if random.random() < 0.1:
            one.set_map(GRID, random.integers(-3, 104, GRID.shape).astype(np.int8))
        if random.random() < 0.05:
            one.cancel()
        points = random.normal(0, 3, (50, 3))
        points[random.random((50, 3)) < 0.05] = random.choice(odd)
        frame_id = "base_link" if random.random() < 0.9 else "odom"
        twin = TwinView(GRID, random.integers(-1, 101, GRID.shape).astype(np.int8), number())
        command = one.step(
            now_s, (number(), number(), number()), Cloud(points, now_s, frame_id), twin, speed=(number(), number())
        )
        assert -0.35 <= command.speed[0] <= 0.5 and abs(command.speed[1]) <= 1.9
        if command.status.state not in (State.FOLLOWING, State.RECOVERING):
            assert command.speed == (0.0, 0.0)


@pytest.mark.parametrize("change", [{"planner_frequency": -1.0}, {"xy_goal_tolerance": math.nan}])
def test_options_that_are_none_are_refused(change: dict[str, float]) -> None:
    with pytest.raises(UsageError, match="a navigator"):
        NavigatorOptions(**change)  # type: ignore[arg-type]
