"""What is good and bad about a trajectory: the critics of nav2_mppi_controller, with its names and defaults.

Each scores a batch of trajectories, (batch,), the lower the better. Distances are metres, angles radians.
"""

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sern_core.vocabulary.errors import UsageError
from sern_navigation.costmap.costs import (
    INSCRIBED_INFLATED_OBSTACLE,
    LETHAL_OBSTACLE,
    MAX_NON_OBSTACLE,
    NO_INFORMATION,
    Costmap,
    Costs,
    Mask,
)
from sern_twin.world.grid import Floats
from sern_twin.world.occupancy import Pose

Singles = NDArray[np.float32]

_TURN: Final = np.float32(2 * math.pi)


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """Trajectories in the costmap's frame, each (steps, batch): places, yaws, and the speeds that lead there."""

    x_m: Singles
    y_m: Singles
    yaw_rad: Singles
    vx: Singles
    wz: Singles

    def last(self) -> tuple[Singles, Singles, Singles]:
        return self.x_m[-1], self.y_m[-1], self.yaw_rad[-1]


@dataclass(frozen=True, eq=False)
class Task:
    """What a command is wanted for: where the robot is, the part of its path ahead (points, 2), its goal, the costs."""

    pose: Pose
    path_m: Floats
    goal: tuple[float, float, float | None]
    costmap: Costmap
    model_dt: float
    vx_min: float
    vx_max: float

    @cached_property
    def goal_distance_m(self) -> float:
        return math.dist(self.pose[:2], self.goal[:2])

    @cached_property
    def path_free(self) -> Mask:
        """Which points of the path no real obstacle has come to lie on, (points,)."""
        costs = self.costmap.at(self.path_m)
        found: Mask = (costs < INSCRIBED_INFLATED_OBSTACLE) | (costs == NO_INFORMATION)
        return found

    @cached_property
    def along_m(self) -> Floats:
        """How far along the path its points are, (points,)."""
        steps = np.hypot(*np.diff(self.path_m, axis=0).T)
        return np.concatenate(([0.0], np.cumsum(steps)))

    def furthest(self, batch: Batch) -> int:
        """The point of the path that is the furthest along of those nearest to the trajectories' ends."""
        x, y, _yaw = batch.last()
        path = self.path_m.astype(np.float32)
        squares = (path[:, 0, None] - x) ** 2 + (path[:, 1, None] - y) ** 2
        return int(squares.argmin(axis=0).max())


def collides(costs: Costs) -> Mask:
    """Where the middle of the robot cannot be. What is unknown is no collision."""
    found: Mask = (costs == LETHAL_OBSTACLE) | (costs == INSCRIBED_INFLATED_OBSTACLE)
    return found


def look_up(costmap: Costmap, x_m: Singles, y_m: Singles) -> tuple[Costs, Costs]:
    """Real and soft costs at places of any shape. LETHAL_OBSTACLE outside: nobody knows what is there."""
    grid = costmap.grid
    columns = ((x_m - np.float32(grid.west_m)) * np.float32(1 / grid.cell_m)).astype(np.int32)
    rows = ((y_m - np.float32(grid.south_m)) * np.float32(1 / grid.cell_m)).astype(np.int32)
    outside = (x_m < grid.west_m) | (y_m < grid.south_m) | (columns >= grid.columns) | (rows >= grid.rows)
    numbers = np.where(outside, 0, rows * grid.columns + columns)
    costs = np.where(outside, np.uint8(LETHAL_OBSTACLE), costmap.costs.reshape(-1)[numbers])
    return costs, costmap.soft.reshape(-1)[numbers]


def _turned(angles: Singles) -> Singles:
    """The angles the short way round, without a sign."""
    found: Singles = np.abs(angles - _TURN * np.round(angles / _TURN))
    return found


def _weighted(costs: Singles, weight: float, power: int) -> Singles:
    found: Singles = (costs * np.float32(weight)) ** power
    return found


@dataclass(frozen=True, slots=True)
class ConstraintCritic:
    """Costs of speeds that the robot does not have."""

    cost_weight: float = 4.0
    cost_power: int = 1

    def score(self, batch: Batch, task: Task) -> Singles:
        above = np.maximum(batch.vx - np.float32(task.vx_max), 0) + np.maximum(np.float32(task.vx_min) - batch.vx, 0)
        return _weighted(above.sum(axis=0) * np.float32(task.model_dt), self.cost_weight, self.cost_power)


@dataclass(frozen=True, slots=True)
class CostCritic:
    """Costs of what is near: real obstacles, and what the twin says as far as its soft costs go.

    What the twin says adds to the cost of a point and never makes it a collision.
    """

    cost_weight: float = 3.81
    cost_power: int = 1
    collision_cost: float = 1_000_000.0
    critical_cost: float = 300.0
    near_collision_cost: int = 253
    near_goal_distance: float = 0.5

    def score(self, batch: Batch, task: Task) -> tuple[Singles, Mask]:
        """The scores, and which trajectories collide."""
        costs, soft = look_up(task.costmap, batch.x_m, batch.y_m)
        collide: Mask = np.any(collides(costs), axis=0)
        values = np.where(costs >= self.near_collision_cost, np.float32(self.critical_cost), np.float32(0))
        if task.goal_distance_m > self.near_goal_distance:
            plain = np.minimum(costs.astype(np.float32) + soft, np.float32(MAX_NON_OBSTACLE))
            values = np.where(costs >= self.near_collision_cost, values, plain)
        sums = np.where(collide, np.float32(self.collision_cost), values.sum(axis=0)) / np.float32(254 * len(costs))
        return _weighted(sums.astype(np.float32), self.cost_weight, self.cost_power), collide


@dataclass(frozen=True, slots=True)
class GoalCritic:
    """Costs of being away from the goal, when it is near."""

    cost_weight: float = 5.0
    cost_power: int = 1
    threshold_to_consider: float = 1.4

    def score(self, batch: Batch, task: Task) -> Singles | None:
        if task.goal_distance_m > self.threshold_to_consider:
            return None
        away = np.hypot(batch.x_m - np.float32(task.goal[0]), batch.y_m - np.float32(task.goal[1]))
        return _weighted(away.mean(axis=0), self.cost_weight, self.cost_power)


@dataclass(frozen=True, slots=True)
class GoalAngleCritic:
    """Costs of looking another way than the goal's, when it is very near."""

    cost_weight: float = 3.0
    cost_power: int = 1
    threshold_to_consider: float = 0.5

    def score(self, batch: Batch, task: Task) -> Singles | None:
        yaw = task.goal[2]
        if yaw is None or task.goal_distance_m > self.threshold_to_consider:
            return None
        off = _turned(batch.yaw_rad - np.float32(yaw))
        return _weighted(off.mean(axis=0), self.cost_weight, self.cost_power)


@dataclass(frozen=True, slots=True)
class PathAlignCritic:
    """Along the path, as long as it is free: a point so far along a trajectory is to be so far along the path."""

    cost_weight: float = 10.0
    cost_power: int = 1
    threshold_to_consider: float = 0.5
    offset_from_furthest: int = 20
    trajectory_point_step: int = 4
    max_path_occupancy_ratio: float = 0.07

    def score(self, batch: Batch, task: Task, furthest: int) -> Singles | None:
        if task.goal_distance_m < self.threshold_to_consider or furthest < self.offset_from_furthest:
            return None
        blocked = np.count_nonzero(~task.path_free[:furthest])
        if blocked > 2 and blocked / furthest > self.max_path_occupancy_ratio:
            return None
        x, y = batch.x_m[:: self.trajectory_point_step], batch.y_m[:: self.trajectory_point_step]
        began = [np.full((1, x.shape[1]), place, np.float32) for place in task.pose[:2]]
        steps = np.diff(np.concatenate((began[0], x)), axis=0), np.diff(np.concatenate((began[1], y)), axis=0)
        driven = np.cumsum(np.hypot(*steps), axis=0)
        middles = ((task.along_m[1:] + task.along_m[:-1]) / 2).astype(np.float32)
        nearest = np.searchsorted(middles, driven)
        path = task.path_m.astype(np.float32)
        away = np.hypot(path[nearest, 0] - x, path[nearest, 1] - y)
        counted = task.path_free[nearest]
        sums = np.where(counted, away, 0).sum(axis=0) / np.maximum(counted.sum(axis=0), 1)
        return _weighted(sums.astype(np.float32), self.cost_weight, self.cost_power)


@dataclass(frozen=True, slots=True)
class PathFollowCritic:
    """Costs of staying behind: the robot is to go on towards a free point of the path, a little further than any
    trajectory comes."""

    cost_weight: float = 5.0
    cost_power: int = 1
    threshold_to_consider: float = 1.4
    offset_from_furthest: int = 6

    def score(self, batch: Batch, task: Task, furthest: int) -> Singles | None:
        if task.goal_distance_m < self.threshold_to_consider or len(task.path_m) < 2:
            return None
        last = len(task.path_m) - 1
        wanted = min(furthest + self.offset_from_furthest, last)
        while wanted < last and not task.path_free[wanted]:
            wanted += 1
        x, y, _yaw = batch.last()
        point = task.path_m[wanted].astype(np.float32)
        return _weighted(np.hypot(x - point[0], y - point[1]), self.cost_weight, self.cost_power)


@dataclass(frozen=True, slots=True)
class PathAngleCritic:
    """Towards the path, when the robot looks elsewhere (mode forward preference)."""

    cost_weight: float = 2.2
    cost_power: int = 1
    threshold_to_consider: float = 0.5
    offset_from_furthest: int = 4
    max_angle_to_furthest: float = 0.785398

    def score(self, batch: Batch, task: Task, furthest: int) -> Singles | None:
        if task.goal_distance_m < self.threshold_to_consider:
            return None
        point = task.path_m[min(furthest + self.offset_from_furthest, len(task.path_m) - 1)]
        x_m, y_m, yaw_rad = task.pose
        ahead = math.atan2(point[1] - y_m, point[0] - x_m) - yaw_rad
        if abs(math.remainder(ahead, 2 * math.pi)) < self.max_angle_to_furthest:
            return None
        x, y, yaw = batch.last()
        off = _turned(np.arctan2(np.float32(point[1]) - y, np.float32(point[0]) - x) - yaw)
        return _weighted(off, self.cost_weight, self.cost_power)


@dataclass(frozen=True, slots=True)
class PreferForwardCritic:
    """Costs of driving backwards, where the goal is not near."""

    cost_weight: float = 5.0
    cost_power: int = 1
    threshold_to_consider: float = 0.5

    def score(self, batch: Batch, task: Task) -> Singles | None:
        if task.goal_distance_m < self.threshold_to_consider:
            return None
        back = np.maximum(-batch.vx, 0).sum(axis=0) * np.float32(task.model_dt)
        return _weighted(back, self.cost_weight, self.cost_power)


@dataclass(frozen=True, slots=True)
class Critics:
    """All of them; a cost_weight of 0 is as none. UsageError: a weight or threshold below 0, a power below 1."""

    constraint: ConstraintCritic = field(default_factory=ConstraintCritic)
    cost: CostCritic = field(default_factory=CostCritic)
    goal: GoalCritic = field(default_factory=GoalCritic)
    goal_angle: GoalAngleCritic = field(default_factory=GoalAngleCritic)
    path_align: PathAlignCritic = field(default_factory=PathAlignCritic)
    path_follow: PathFollowCritic = field(default_factory=PathFollowCritic)
    path_angle: PathAngleCritic = field(default_factory=PathAngleCritic)
    prefer_forward: PreferForwardCritic = field(default_factory=PreferForwardCritic)

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            critic = getattr(self, name)
            for option in critic.__dataclass_fields__:
                value, least = getattr(critic, option), 1 if option in ("cost_power", "trajectory_point_step") else 0
                if not (math.isfinite(value) and value >= least):
                    raise UsageError(f"critic {name} with {option} {value}: give a number of {least} or more")

    def score(self, batch: Batch, task: Task) -> tuple[Singles, Mask]:
        """The sum of all scores, (batch,), and which trajectories collide. The path has a point at least."""
        furthest = task.furthest(batch)
        total, collide = self.cost.score(batch, task)
        for score in (
            self.constraint.score(batch, task),
            self.goal.score(batch, task),
            self.goal_angle.score(batch, task),
            self.path_align.score(batch, task, furthest),
            self.path_follow.score(batch, task, furthest),
            self.path_angle.score(batch, task, furthest),
            self.prefer_forward.score(batch, task),
        ):
            if score is not None:
                total = total + score
        return total, collide
