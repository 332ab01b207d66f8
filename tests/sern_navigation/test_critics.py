"""Each critic by itself: what it is for scores better than what it is against."""

import math
from typing import Any

import numpy as np
import pytest

from sern_core.vocabulary.errors import UsageError
from sern_navigation.costmap.costs import Costmap
from sern_navigation.critics import (
    Batch,
    ConstraintCritic,
    CostCritic,
    Critics,
    GoalAngleCritic,
    GoalCritic,
    PathAlignCritic,
    PathAngleCritic,
    PathFollowCritic,
    PreferForwardCritic,
    Task,
    look_up,
)
from sern_twin.world.grid import Floats, Grid

GRID = Grid(-5.0, -5.0, 0.1, 100, 100)
STEPS = 20
DT = 0.1
PATH = np.stack((np.arange(0.0, 2.01, 0.05), np.zeros(41)), axis=1)


def driven(*speeds: tuple[float, float], yaw_rad: float = 0.0) -> Batch:
    """Trajectories from the middle at constant speeds."""
    vx = np.tile(np.array([speed for speed, _turn in speeds], np.float32), (STEPS, 1))
    wz = np.tile(np.array([turn for _speed, turn in speeds], np.float32), (STEPS, 1))
    yaw = np.cumsum(wz * DT, axis=0, dtype=np.float32) + np.float32(yaw_rad)
    x = np.cumsum(vx * np.cos(yaw) * DT, axis=0, dtype=np.float32)
    y = np.cumsum(vx * np.sin(yaw) * DT, axis=0, dtype=np.float32)
    return Batch(x, y, yaw, vx, wz)


def task(
    *,
    goal: tuple[float, float, float | None] = (4.0, 0.0, None),
    path_m: Floats = PATH,
    yaw_rad: float = 0.0,
    lethal: tuple[float, float] | None = None,
    soft: int = 0,
) -> Task:
    costs = np.zeros(GRID.shape, np.uint8)
    if lethal is not None:
        costs[GRID.index(np.array(lethal))] = 254
    return Task(
        (0.0, 0.0, yaw_rad), path_m, goal, Costmap(GRID, costs, np.full(GRID.shape, soft, np.uint8)), DT, -0.35, 0.5
    )


def test_speeds_that_the_robot_does_not_have_cost() -> None:
    found = ConstraintCritic().score(driven((0.5, 0.0), (0.7, 0.0), (-0.55, 0.0)), task())
    assert found == pytest.approx([0.0, 4 * 2 * 0.2, 4 * 2 * 0.2], abs=1e-5)


def test_a_trajectory_through_something_collides() -> None:
    critic, batch = CostCritic(), driven((0.5, 0.0), (0.5, 0.6), (0.2, 0.0))
    scores, collide = critic.score(batch, task(lethal=(0.75, -0.05)))
    assert collide.tolist() == [False, False, False], "beside it"
    scores, collide = critic.score(batch, task(lethal=(0.75, 0.01)))
    assert collide.tolist() == [True, False, False]
    assert scores == pytest.approx([3.81 * 1e6 / 254 / STEPS, 0, 0], rel=1e-5)


def test_the_edge_of_the_map_is_an_obstacle_and_the_unknown_is_only_dear() -> None:
    costs = np.zeros(GRID.shape, np.uint8)
    costs[:, 60:] = 255
    unknown = Costmap(GRID, costs, np.zeros(GRID.shape, np.uint8))
    scores, collide = CostCritic().score(
        driven((0.45, 0.0), (1.0, 0.0), (3.0, 0.0)), Task((0, 0, 0), PATH, (4, 0, None), unknown, DT, -1, 3)
    )
    assert collide.tolist() == [False, False, True]
    assert scores[0] == 0 and scores[1] == pytest.approx(3.81 * 300 / 254 * 10 / STEPS, rel=0.12)


def test_the_twin_is_dear_and_never_a_collision() -> None:
    scores, collide = CostCritic().score(driven((0.5, 0.0)), task(soft=150))
    assert not collide.any() and scores[0] == pytest.approx(3.81 * 150 / 254, rel=1e-5)
    both = Costmap(GRID, np.full(GRID.shape, 200, np.uint8), np.full(GRID.shape, 150, np.uint8))
    scores, collide = CostCritic().score(driven((0.5, 0.0)), Task((0, 0, 0), PATH, (4, 0, None), both, DT, -1, 1))
    assert not collide.any() and scores[0] == pytest.approx(3.81 * 252 / 254, rel=1e-5), (
        "no more than what is free costs"
    )


def test_near_the_goal_only_what_is_near_costs() -> None:
    scores, _collide = CostCritic().score(driven((0.2, 0.0)), task(goal=(0.4, 0.0, None), soft=100))
    assert scores[0] == 0


def test_near_the_goal_one_drives_to_it() -> None:
    batch = driven((0.5, 0.0), (0.2, 0.0))
    assert GoalCritic().score(batch, task()) is None, "it is far"
    found = GoalCritic().score(batch, task(goal=(1.0, 0.0, None)))
    assert found is not None and found[0] < found[1]
    assert found[0] == pytest.approx(5 * np.abs(1.0 - 0.05 * np.arange(1, 21)).mean(), rel=1e-4)


def test_at_the_goal_one_looks_where_one_is_to() -> None:
    batch = driven((0.0, 0.5), (0.0, -0.5), (0.0, math.pi))
    assert GoalAngleCritic().score(batch, task(goal=(0.1, 0.0, None))) is None
    assert GoalAngleCritic().score(batch, task(goal=(1.0, 0.0, 1.0))) is None
    found = GoalAngleCritic().score(batch, task(goal=(0.1, 0.0, 1.0)))
    assert found is not None and found[0] < found[1]
    behind = GoalAngleCritic().score(driven((0.0, 0.1), (0.0, -0.1), yaw_rad=3.1), task(goal=(0.1, 0.0, -3.1)))
    assert behind is not None and behind[0] < behind[1], "the short way round"


def test_one_drives_along_the_path() -> None:
    batch = driven((0.8, 0.0), (0.8, 0.3), (0.8, -0.6))
    furthest = task().furthest(batch)
    assert furthest >= 30
    found = PathAlignCritic().score(batch, task(), furthest)
    assert found is not None and found[0] < found[1] < found[2]
    assert found[0] == pytest.approx(0, abs=0.3), "half of what the points of the path are apart"
    assert PathAlignCritic().score(batch, task(), 10) is None, "no trajectory gets far along the path"


def test_a_path_that_is_blocked_is_not_kept_to() -> None:
    batch = driven((0.8, 0.0), (0.8, 0.3))
    blocked = np.zeros(GRID.shape, np.uint8)
    blocked[:, 58:65] = 254
    closed = Task((0, 0, 0), PATH, (4, 0, None), Costmap(GRID, blocked, np.zeros_like(blocked)), DT, -1, 1)
    assert PathAlignCritic().score(batch, closed, 30) is None
    follow = PathFollowCritic().score(driven((0.4, 0.0), (0.2, 0.0)), closed, 12)
    assert follow is not None and follow[0] < follow[1]
    assert follow[0] == pytest.approx(5 * (1.5 - 0.8), abs=0.3), "towards the first free point behind it"


def test_one_goes_on_along_the_path() -> None:
    found = PathFollowCritic().score(driven((0.5, 0.0), (0.1, 0.0), (-0.3, 0.0)), task(), 20)
    assert found is not None and found[0] < found[1] < found[2]
    assert PathFollowCritic().score(driven((0.5, 0.0)), task(goal=(1.0, 0.0, None)), 20) is None


def test_one_turns_towards_the_path() -> None:
    away = task(yaw_rad=math.pi / 2)
    found = PathAngleCritic().score(driven((0.0, -0.7), (0.0, 0.0), (0.0, 0.7), yaw_rad=math.pi / 2), away, 5)
    assert found is not None and found[0] < found[1] < found[2]
    assert PathAngleCritic().score(driven((0.5, 0.0)), task(), 5) is None, "it looks there already"


def test_one_drives_forward() -> None:
    found = PreferForwardCritic().score(driven((0.3, 0.0), (-0.3, 0.0)), task())
    assert found == pytest.approx([0.0, 5 * 0.3 * 2.0], abs=1e-4)
    assert PreferForwardCritic().score(driven((-0.3, 0.0)), task(goal=(0.3, 0.0, None))) is None


def test_powers_and_weights() -> None:
    linear = PreferForwardCritic(cost_weight=2.0).score(driven((-0.3, 0.0)), task())
    squared = PreferForwardCritic(cost_weight=2.0, cost_power=2).score(driven((-0.3, 0.0)), task())
    assert linear is not None and squared is not None and squared[0] == pytest.approx(linear[0] ** 2)


def test_places_of_any_shape_are_looked_up() -> None:
    costs = np.arange(GRID.rows * GRID.columns).reshape(GRID.shape).astype(np.uint8)
    costmap = Costmap(GRID, costs, np.zeros(GRID.shape, np.uint8))
    random = np.random.default_rng(1)
    x, y = random.uniform(-6, 6, (2, 7, 9)).astype(np.float32)
    found, _soft = look_up(costmap, x, y)
    assert (found == costmap.at(np.stack((x, y), axis=-1))).all()


@pytest.mark.parametrize(
    "change",
    [
        {"goal": GoalCritic(cost_weight=-1.0)}, {"path_align": PathAlignCritic(trajectory_point_step=0)},
        {"cost": CostCritic(cost_power=0)}, {"path_angle": PathAngleCritic(max_angle_to_furthest=math.nan)},
    ],
)  # fmt: skip
def test_critics_that_are_none_are_refused(change: dict[str, Any]) -> None:
    with pytest.raises(UsageError, match=f"critic {next(iter(change))}"):
        Critics(**change)
