"""One drive across a campus: what the robot is told differs by mode, and nothing else does."""

import math
from dataclasses import dataclass, replace
from enum import StrEnum
from random import Random
from typing import Final

import numpy as np

from benchmarks.navigation.campus import GRID, Campus
from sern_navigation.costmap.layered import CostmapOptions
from sern_navigation.costmap.obstacles import ObstacleOptions
from sern_navigation.costmap.twin import TwinOptions, TwinView
from sern_navigation.navigator import Goal, Navigator, NavigatorOptions, State
from sern_navigation.scan import Cloud
from sern_sim.robot import BODY_RADIUS_M, LIDAR_HEIGHT_M, STEP_S, Pose2, SimulatedJackal

PERIOD_S: Final = 0.1
MOST_S: Final = 150.0
STUCK_S: Final = 20.0
STUCK_M: Final = 0.3
POINTS: Final = 5_760
NOISE_M: Final = 0.02
ENDS_S: Final = 1.0


class Mode(StrEnum):
    """`Sim Only` plans by the twin and takes it for the world; its collision monitor sees what is real, as everyone's.
    `Real Only` has no twin. `SERN` has both."""

    REAL_ONLY = "Real Only"
    SIM_ONLY = "Sim Only"
    SERN = "SERN"


@dataclass(frozen=True, slots=True)
class LinkProfile:
    """What the link does to the twin: how late it is, for how long it is gone in each so many seconds, and when it is
    gone for good."""

    name: str
    late_s: float
    gone_s: float = 0.0
    every_s: float = 60.0
    dies_s: float = math.inf

    def stamp_s(self, now_s: float) -> float:
        """The moment that the newest of the twin is of which has arrived by now."""
        into_s = now_s % self.every_s
        said_s = now_s if into_s >= self.gone_s else now_s - into_s
        return min(said_s, self.dies_s) - self.late_s

    @property
    def always_fresh(self) -> bool:
        """Whether the twin never becomes stale: of a place that stands still it is then as good as at once."""
        gap_s = self.gone_s + self.late_s
        return gap_s <= TwinOptions().staleness_s and self.dies_s + TwinOptions().staleness_s >= MOST_S + self.late_s


PROFILES: Final = (
    LinkProfile("wifi", 0.02),
    LinkProfile("satcom", 0.6),
    LinkProfile("gone 5 s in 20", 0.1, 5.0, 20.0),
    LinkProfile("gone 30 s in 60", 0.1, 30.0, 60.0),
    LinkProfile("gone after 20 s", 0.1, dies_s=20.0),
)


@dataclass(frozen=True, slots=True)
class Result:
    """`reached`: the goal, without help. `ended`: state and code of the navigator."""

    seed: int
    mode: Mode
    reached: bool
    time_s: float
    travelled_m: float
    shortest_m: float
    interventions: int
    collisions: int
    ended: str

    @property
    def spl(self) -> float:
        """Success weighted by path length (Anderson et al., 2018)."""
        return self.shortest_m / max(self.shortest_m, self.travelled_m) if self.reached else 0.0


def drive(seed: int, campus: Campus, mode: Mode, *, accuracy: float = 0.9, link: LinkProfile = PROFILES[0]) -> Result:
    """The same seed has the same robot, noise and draws of the controller in each mode."""
    robot = SimulatedJackal(Random(seed), world=campus.world())
    robot.state = replace(robot.state, pose=Pose2(*campus.start_m, 0.0), odometry=Pose2(*campus.start_m, 0.0))
    navigator = Navigator(GRID, np.random.default_rng(seed), _options(mode))
    noise = Random(seed + 1)
    cells = campus.twin(accuracy)
    if mode is Mode.SIM_ONLY:
        navigator.set_map(GRID, cells)
    goal = Goal(*campus.goal_m)
    navigator.go(goal)
    interventions = collisions = 0
    since_s, since_m = 0.0, campus.start_m
    touching = False
    status = navigator.status
    while robot.state.time_s < MOST_S:
        state = robot.state
        pose = state.pose
        said = (pose.x_m + noise.gauss(0, NOISE_M), pose.y_m + noise.gauss(0, NOISE_M), pose.yaw_rad)
        view = TwinView(GRID, cells, link.stamp_s(state.time_s)) if mode is Mode.SERN else None
        command = navigator.step(state.time_s, said, _cloud(robot), view)
        status = command.status
        if status.state is State.SUCCEEDED:
            break
        if math.dist(since_m, (pose.x_m, pose.y_m)) > STUCK_M:
            since_s, since_m = state.time_s, (pose.x_m, pose.y_m)
        if state.time_s - since_s > STUCK_S or status.state is State.ABORTED:
            interventions += 1  # somebody helps, and gives the goal again
            since_s = state.time_s
            navigator.go(goal)
        robot.drive(command.speed[0], command.speed[1] / robot.yaw_scale_known)
        for _ in range(round(PERIOD_S / STEP_S)):
            here = robot.step().pose
            touches = robot.world.touches(here.x_m, here.y_m, BODY_RADIUS_M)
            collisions += touches and not touching
            touching = touches
    there = status.state is State.SUCCEEDED
    return Result(
        seed, mode, there and not interventions, robot.state.time_s, robot.state.travelled_m, campus.shortest_m,
        interventions, collisions, f"{status.state} {status.code}",
    )  # fmt: skip


def _cloud(robot: SimulatedJackal) -> Cloud:
    found = robot.cloud(POINTS)[:, :3].astype(np.float64)
    found[:, 2] += LIDAR_HEIGHT_M
    return Cloud(found, robot.state.time_s)


def _options(mode: Mode) -> NavigatorOptions:
    if mode is not Mode.SIM_ONLY:
        return NavigatorOptions()
    blind = ObstacleOptions(obstacle_max_range=1e-6, raytrace_max_range=1e-6, footprint_clearing_enabled=False)
    return NavigatorOptions(costmap=CostmapOptions(obstacles=blind))
