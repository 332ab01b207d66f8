"""A goal, and the command of each cycle until it is reached or given up: Nav2's navigate to pose, as a state machine.

```
            go                 reached
   IDLE ────────> FOLLOWING ───────────> SUCCEEDED
                  │  ^    │  cannot be
             stuck│  │done└────────────> ABORTED      (and from RECOVERING, when nothing is left to try)
                  v  │
                RECOVERING                            cancel, from both: CANCELLED
```

It has no clock: `step` is told the time. Nothing that comes from outside makes it raise; whatever cannot be used is
counted and said in `status`, and the command is zero where it matters. What the twin says adds costs and is never an
obstacle; without fresh real data the robot stands.

A plan takes longer than a cycle has. Nav2 has a server of its own for it, and here somebody else may make it as well:

```python
navigator = Navigator(grid, generator, plans_itself=False)
command = navigator.step(now_s, pose, cloud)  # each cycle: follows the path that there is, or stands
request = navigator.request()  # None: no plan is due
navigator.planned(request, plan_for(request))  # in another thread, or when its future is done
```
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final

import numpy as np

from sern_core.vocabulary.errors import UsageError
from sern_navigation.collision_monitor import STOPPED, Action, CollisionMonitor, MonitorOptions, Speed, Verdict
from sern_navigation.costmap.costs import Costmap
from sern_navigation.costmap.layered import CostmapOptions, LayeredCostmap
from sern_navigation.costmap.static import MapOutcome
from sern_navigation.costmap.twin import TwinView
from sern_navigation.global_plan import Plan, PlanCode, PlannerOptions, PlanRequest, plan_for
from sern_navigation.mppi import ControlCode, Mppi, MppiOptions, pruned
from sern_navigation.recovery import Behaviour, Progress, Recovery, RecoveryOptions
from sern_navigation.scan import Cloud, ObstacleScan, Refused, ScanOptions, obstacle_scan, turned
from sern_twin.motion import MOST_M
from sern_twin.world.grid import NOWHERE, Floats, Grid
from sern_twin.world.occupancy import MOST_RAD, Pose
from sern_twin.world.patches import Cells

_MARGIN_M: Final = 0.5
_MOST_SPEED: Final = 100.0
"""[m/s, rad/s]: no robot has more."""
_LEAST_BETWEEN_PLANS_S: Final = 0.3
"""A path that something comes to lie on is not planned anew more often."""


class State(StrEnum):
    IDLE = "idle"
    FOLLOWING = "following"
    RECOVERING = "recovering"
    SUCCEEDED = "succeeded"
    ABORTED = "aborted"
    CANCELLED = "cancelled"


class Code(StrEnum):
    """What is wrong, or was; those that Nav2's actions have are called as there."""

    NONE = "none"
    START_OUTSIDE_MAP = PlanCode.START_OUTSIDE_MAP.value
    GOAL_OUTSIDE_MAP = PlanCode.GOAL_OUTSIDE_MAP.value
    START_OCCUPIED = PlanCode.START_OCCUPIED.value
    GOAL_OCCUPIED = PlanCode.GOAL_OCCUPIED.value
    NO_VALID_PATH = PlanCode.NO_VALID_PATH.value
    TIMEOUT = PlanCode.TIMEOUT.value
    NO_VALID_CONTROL = ControlCode.NO_VALID_CONTROL.value
    FAILED_TO_MAKE_PROGRESS = "failed_to_make_progress"
    GOAL_INVALID = "goal_invalid"
    """Not finite, or in another frame than the map."""
    MAP_REFUSED = "map_refused"
    """The last map that was set does not fit the grid."""
    NO_POSE = "no_pose"
    """Where the robot is is not known, or not finite."""
    NO_PERCEPTION = "no_perception"
    """There is no real scan that is fresh."""
    CANCELLED = "cancelled"


class Unused(StrEnum):
    """Why something that `step` or `planned` was given counted nothing."""

    SCAN = "scan"
    """A cloud that makes no scan: `scan_refusals` has why."""
    SCAN_LATE = "scan_late"
    """It is older than source_timeout, or from the future."""
    POSE = "pose"
    TWIN = "twin"
    """It does not fit the grid."""
    TIME = "time"
    """It is not finite, or before the last: all of that step."""
    SPEED = "speed"
    """It is not finite, or that of no robot."""
    PLAN = "plan"
    """It was made for another goal or map, or nobody waits for it any more."""


_HOPELESS: Final = frozenset({Code.START_OUTSIDE_MAP, Code.GOAL_OUTSIDE_MAP, Code.GOAL_OCCUPIED})
"""What no recovery changes."""


@dataclass(frozen=True, slots=True)
class Goal:
    """A place on the grid [m], and which way to look there [rad]; None: any."""

    x_m: float
    y_m: float
    yaw_rad: float | None = None
    frame_id: str = "map"


@dataclass(frozen=True, slots=True)
class NavigatorOptions:
    """UsageError: a tolerance or time that is negative or not finite."""

    scan: ScanOptions = field(default_factory=ScanOptions)
    costmap: CostmapOptions = field(default_factory=CostmapOptions)
    planner: PlannerOptions = field(default_factory=PlannerOptions)
    controller: MppiOptions = field(default_factory=MppiOptions)
    monitor: MonitorOptions = field(default_factory=MonitorOptions)
    recovery: RecoveryOptions = field(default_factory=RecoveryOptions)
    planner_frequency: float = 1.0
    """[Hz]: how often the path is planned anew. It is too when a real obstacle has come to lie on it."""
    xy_goal_tolerance: float = 0.25
    yaw_goal_tolerance: float = 0.25
    required_movement_radius: float = 0.5
    movement_time_allowance: float = 10.0
    failure_tolerance: float = 0.3
    """[s]: how long there may be no command before something else is tried."""
    perception_patience_s: float = 10.0
    """How long the robot stands without real scans before its goal is given up."""

    def __post_init__(self) -> None:
        for name in (
            "planner_frequency", "xy_goal_tolerance", "yaw_goal_tolerance", "required_movement_radius",
            "movement_time_allowance", "failure_tolerance", "perception_patience_s",
        ):  # fmt: skip
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise UsageError(f"a navigator with {name} {value}: give a number of 0 or more")

    @property
    def local_radius_m(self) -> float:
        """Half the side of the local costmap: as far as a trajectory reaches, a path counts, and scans change it."""
        controller = self.controller
        fastest = max(controller.vx_max, -controller.vx_min)
        reach = max(fastest * controller.model_dt * controller.time_steps, controller.prune_distance)
        return max(reach, self.costmap.obstacles.reach_m) + _MARGIN_M


@dataclass(frozen=True, slots=True)
class Status:
    """`code` and `message` say what is wrong, also while it goes on; `behaviour` is what is tried."""

    state: State = State.IDLE
    code: Code = Code.NONE
    message: str = ""
    behaviour: Behaviour | None = None
    recoveries: int = 0
    distance_remaining_m: float = math.inf


@dataclass(frozen=True, slots=True, eq=False)
class Command:
    """What the robot is told, forward [m/s] and yaw rate [rad/s] of its body, and how that came about.

    A base that slips turns less than it is told: whoever sends this divides by what it makes of a turn.
    `wanted` is the command before the monitor's `verdict`; `trajectory` (steps, 3) is what it begins.
    """

    speed: Speed
    wanted: Speed
    verdict: Verdict
    trajectory: Floats
    status: Status


_NOWHERE: Final = np.empty((0, 3))
_NO_PATH: Final = np.empty((0, 2))


class Navigator:
    """One robot on one grid. The same seed and the same calls give the same commands.

    `plans_itself`: `step` makes the plans, and takes as long. Else whoever calls it asks for a `request` after each
    step, and gives the plan to `planned`, in the thread of `step`.
    """

    def __init__(
        self,
        grid: Grid,
        generator: np.random.Generator,
        options: NavigatorOptions | None = None,
        *,
        plans_itself: bool = True,
    ) -> None:
        self.options: Final = options or NavigatorOptions()
        self.grid: Final = grid
        self.costmap: Final = LayeredCostmap(grid, self.options.costmap)
        self.monitor: Final = CollisionMonitor(self.options.monitor)
        self.status = Status()
        self.path_m: Floats = _NO_PATH
        self._controller = Mppi(self.options.controller, generator)
        self._recovery = Recovery(self.options.recovery)
        self._unused = dict.fromkeys(Unused, 0)
        self._refusals: dict[str, int] = {}
        self._map = MapOutcome.TAKEN
        self._goal: Goal | None = None
        self._scan_s: float | None = None
        self._scan_points: Floats = _NO_PATH
        self._scan_pose: Pose | None = None
        self._complaint = ""
        self._now_s = -math.inf
        self._speed: Speed = STOPPED
        self._plans_itself = plans_itself
        self._requests = 0
        self._due_s: float | None = None
        self._due_from: Pose | None = None
        self._open: PlanRequest | None = None
        self._failed: Plan | None = None
        self._planned_s = -math.inf
        self._ever_planned = False
        self._reached_xy = False
        self._moved: tuple[float, Pose] | None = None
        self._controlled_s: float | None = None
        self._blind_since_s: float | None = None

    @property
    def unused(self) -> Mapping[Unused, int]:
        """How much of what came counted nothing, and why."""
        return self._unused

    @property
    def scan_refusals(self) -> Mapping[str, int]:
        """How many clouds made no scan, by `scan.Unusable`."""
        return self._refusals

    # What it is told

    def set_map(self, grid: Grid, cells: Cells) -> MapOutcome:
        """The map: -1 unknown, 0 to 100 occupied. While the last one did not fit, no goal is pursued."""
        self._map = self.costmap.static.take(grid, cells)
        self._forget_plans()
        return self._map

    def go(self, goal: Goal) -> None:
        """Pursue a goal, in place of the one before."""
        self._goal = goal
        self._recovery.reset()
        self._controller.reset()
        self.path_m = _NO_PATH
        self._forget_plans()
        self._ever_planned = self._reached_xy = False
        self._moved = self._controlled_s = self._blind_since_s = None
        self.status = Status(State.FOLLOWING)
        places = (goal.x_m, goal.y_m, goal.yaw_rad or 0.0)
        if not all(math.isfinite(place) for place in places):
            self._end(State.ABORTED, Code.GOAL_INVALID, f"the goal {places} is not finite: give another")
        elif goal.frame_id != self.grid.frame_id:
            self._end(
                State.ABORTED,
                Code.GOAL_INVALID,
                f"the goal is in frame {goal.frame_id!r}, the map in {self.grid.frame_id!r}: give it in that",
            )

    def cancel(self) -> None:
        """Give the goal up. Without one this does nothing."""
        if self.status.state in (State.FOLLOWING, State.RECOVERING):
            self._end(State.CANCELLED, Code.CANCELLED, "the goal was cancelled")

    def step(
        self,
        now_s: float,
        pose: Pose | None,
        scan: Cloud | ObstacleScan | None = None,
        twin: TwinView | None = None,
        *,
        speed: Speed | None = None,
    ) -> Command:
        """The command of this cycle. `speed`: what the robot measures of itself; None: what it was told last, as with
        Nav2's open_loop.

        The scan is of the robot where `pose` has it. It is given once; without one the last one ages. Time does not go
        back. If the navigator plans itself, a step with a plan takes as long as `global_plan.plan` more.
        """
        if not (math.isfinite(now_s) and now_s >= self._now_s):
            self._unused[Unused.TIME] += 1
            return self._command(STOPPED, _NOWHERE, Verdict(STOPPED, Action.NO_DATA))
        self._now_s = now_s
        if pose is not None and not _possible(pose):
            self._unused[Unused.POSE] += 1
            pose = None
        self._see(now_s, pose, scan)
        if twin is not None and self.costmap.twin.take(twin) is not MapOutcome.TAKEN:
            self._unused[Unused.TWIN] += 1
        if speed is not None and not (abs(speed[0]) <= _MOST_SPEED and abs(speed[1]) <= _MOST_SPEED):  # and no NaN
            self._unused[Unused.SPEED] += 1
            speed = None
        wanted, trajectory = self._wanted(now_s, pose, speed or self._speed)
        verdict = self.monitor.process(wanted, self._real_points(pose), self._scan_s, now_s)
        self._speed = verdict.command
        return self._command(wanted, trajectory, verdict)

    def request(self) -> PlanRequest | None:
        """The plan that is due, once: nothing more is due before it is `planned`, given up, or there is another goal.
        None: there is none."""
        if self._due_from is None:
            return None
        request = self._open = self._asked(self._due_from)
        self._due_from = None
        return request

    def planned(self, request: PlanRequest, plan: Plan) -> bool:
        """Whether a plan is taken: the next step goes by it. One that nobody waits for is counted in `unused`."""
        if self._open is None or request.number != self._open.number:
            self._unused[Unused.PLAN] += 1
            return False
        self._open = self._due_s = None
        if plan.found:
            self.path_m, self._ever_planned = plan.path_m, True
        else:
            self._failed = plan
        return True

    # What it sees

    def _see(self, now_s: float, pose: Pose | None, scan: Cloud | ObstacleScan | None) -> None:
        if scan is None:
            return
        found = obstacle_scan(scan, self.options.scan) if isinstance(scan, Cloud) else scan
        if isinstance(found, Refused):
            self._unused[Unused.SCAN] += 1
            self._refusals[found.reason.value] = self._refusals.get(found.reason.value, 0) + 1
            self._complaint = found.message
            return
        if not abs(now_s - found.stamp_s) <= self.options.monitor.source_timeout:
            self._unused[Unused.SCAN_LATE] += 1
            self._complaint = f"a scan of {now_s - found.stamp_s:.1f} s ago is too old, or from the future"
            return
        self._scan_s, self._scan_points, self._scan_pose = found.stamp_s, found.points_m, pose
        self._complaint = ""
        if pose is not None:
            self.costmap.obstacles.observe(pose, found)

    def _real_points(self, pose: Pose | None) -> Floats:
        """What real sensors have seen, (n, 2) in the robot's frame as it is now: the last scan and all marks."""
        if pose is None:
            return self._scan_points
        points = self._scan_points
        if self._scan_pose is not None and self._scan_pose != pose:
            x_m, y_m, yaw_rad = self._scan_pose
            to_x_m, to_y_m = turned(np.array([x_m - pose[0], y_m - pose[1]]), -pose[2]).tolist()
            points = turned(points, yaw_rad - pose[2]) + np.array([to_x_m, to_y_m])
        return np.concatenate((points, self.costmap.obstacles.marks_near(pose, self.options.local_radius_m)))

    def sees(self, now_s: float) -> bool:
        """Whether there is a real scan that is fresh."""
        return self._scan_s is not None and abs(now_s - self._scan_s) <= self.options.monitor.source_timeout

    # What it wants

    def _wanted(self, now_s: float, pose: Pose | None, speed: Speed) -> tuple[Speed, Floats]:
        if self._goal is None or self.status.state not in (State.FOLLOWING, State.RECOVERING):
            return STOPPED, _NOWHERE
        if self._map is not MapOutcome.TAKEN:
            self._end(
                State.ABORTED,
                Code.MAP_REFUSED,
                f"the map does not fit the grid ({self._map.value}): set one of {self.grid.cell_m:g} m cells, "
                f"{self.grid.columns} x {self.grid.rows}, in frame {self.grid.frame_id!r}",
            )
            return STOPPED, _NOWHERE
        if pose is None or not self.sees(now_s):
            return self._blind(now_s, pose)
        self._blind_since_s = None
        if self.status.state is State.RECOVERING:
            return self._recover(now_s, pose), _NOWHERE
        return self._follow(now_s, pose, speed)

    def _blind(self, now_s: float, pose: Pose | None) -> tuple[Speed, Floats]:
        """Stand, and give up after a while."""
        since = self._blind_since_s = now_s if self._blind_since_s is None else self._blind_since_s
        self._moved = self._controlled_s = None
        self._controller.reset()
        if pose is None:
            code, message = Code.NO_POSE, "where the robot is is not known: localise it"
        else:
            code, message = Code.NO_PERCEPTION, "no scan is fresh" + (f": {self._complaint}" if self._complaint else "")
        if now_s - since > self.options.perception_patience_s:
            self._end(State.ABORTED, code, message)
        else:
            self._say(self.status.state, code, message)
        return STOPPED, _NOWHERE

    def _follow(self, now_s: float, pose: Pose, speed: Speed) -> tuple[Speed, Floats]:
        local = self.costmap.local(now_s, pose[0], pose[1], self.options.local_radius_m)
        if local is None:
            self._end(State.ABORTED, Code.START_OUTSIDE_MAP, f"the robot at {_said(pose)} is not on the map")
            return STOPPED, _NOWHERE
        failed = self._without_plan(now_s, pose, local)
        if failed is not None:
            return self._stuck(now_s, pose, Code(failed.code.value), failed.message)
        if not len(self.path_m):
            self._moved = None
            self._say(State.FOLLOWING, Code.NONE, "a plan is being made")
            return STOPPED, _NOWHERE
        target = self._target()
        away_m = math.dist(pose[:2], target[:2])
        self._say(State.FOLLOWING, Code.NONE, "", away_m)
        self._reached_xy = self._reached_xy or away_m <= self.options.xy_goal_tolerance
        if self._reached_xy and self._looks(pose, target[2]):
            short_m = math.dist(target[:2], (self._pursued().x_m, self._pursued().y_m))
            self._end(State.SUCCEEDED, Code.NONE, f"{short_m:.2f} m before the goal, which is taken" if short_m else "")
            return STOPPED, _NOWHERE
        if self._stands_still(now_s, pose):
            return self._stuck(
                now_s,
                pose,
                Code.FAILED_TO_MAKE_PROGRESS,
                f"the robot moved less than {self.options.required_movement_radius:g} m "
                f"in {self.options.movement_time_allowance:g} s",
            )
        control = self._controller.command(pose, speed, self.path_m, target, local)
        if control.code is ControlCode.NONE:
            self._controlled_s = now_s
            return control.command, control.trajectory
        if self._controlled_s is None:
            self._controlled_s = now_s
        if now_s - self._controlled_s > self.options.failure_tolerance:
            return self._stuck(now_s, pose, Code.NO_VALID_CONTROL, control.message)
        self._say(State.FOLLOWING, Code.NO_VALID_CONTROL, control.message, away_m)
        return STOPPED, _NOWHERE

    def _without_plan(self, now_s: float, pose: Pose, local: Costmap) -> Plan | None:
        """Want a plan if one is due, or make it; the plan that was not found, if it was not."""
        failed, self._failed = self._failed, None
        if failed is not None:
            return failed
        if self._due_s is None:
            period_s = 1 / self.options.planner_frequency if self.options.planner_frequency else math.inf
            if len(self.path_m) and now_s - self._planned_s < period_s and not self._path_blocked(now_s, pose, local):
                return None
            self._planned_s = self._due_s = now_s
        if self._plans_itself:
            request = self._open = self._asked(pose)
            self.planned(request, plan_for(request))
            failed, self._failed = self._failed, None
            return failed
        if self._open is None:
            self._due_from = pose
        most_s = self.options.planner.max_planning_time
        if now_s - self._due_s > most_s:
            return Plan(PlanCode.TIMEOUT, f"nobody made a plan within {most_s:g} s: see to who makes them", _NO_PATH)
        return None

    def _asked(self, pose: Pose) -> PlanRequest:
        goal = self._pursued()
        self._requests += 1
        return PlanRequest(
            self._requests,
            self._now_s,
            self.costmap.snapshot(self._now_s),
            (pose[0], pose[1]),
            (goal.x_m, goal.y_m),
            self.options.planner,
        )

    def _forget_plans(self) -> None:
        """What is being planned is for another goal, map or place."""
        self._planned_s = -math.inf
        self._due_s = self._due_from = self._open = self._failed = None

    def _path_blocked(self, now_s: float, pose: Pose, local: Costmap) -> bool:
        """Whether something real has come to lie on the path ahead. What the robot touches already is no news."""
        if now_s - self._planned_s < _LEAST_BETWEEN_PLANS_S:
            return False
        ahead = pruned(self.path_m, pose, self.options.local_radius_m)
        ahead = ahead[np.hypot(*(ahead - pose[:2]).T) > self.options.planner.start_tolerance]
        cells = local.grid.flat(ahead)
        return bool(local.blocked().reshape(-1)[cells[cells != NOWHERE]].any())

    def _pursued(self) -> Goal:
        if self._goal is None:
            raise UsageError("the navigator has no goal: call go first")
        return self._goal

    def _target(self) -> tuple[float, float, float | None]:
        """Where the path ends, which is the goal or as near to it as is free; and the goal's yaw."""
        end = self.path_m[-1]
        return float(end[0]), float(end[1]), self._pursued().yaw_rad

    def _looks(self, pose: Pose, yaw_rad: float | None) -> bool:
        return yaw_rad is None or abs(math.remainder(pose[2] - yaw_rad, 2 * math.pi)) <= self.options.yaw_goal_tolerance

    def _stands_still(self, now_s: float, pose: Pose) -> bool:
        """Nav2's simple progress checker. To turn at the goal is no standing still."""
        options = self.options
        if (
            self._moved is None
            or self._reached_xy
            or math.dist(self._moved[1][:2], pose[:2]) >= options.required_movement_radius
        ):
            self._moved = now_s, pose
        return now_s - self._moved[0] > options.movement_time_allowance

    # What it does when it is stuck

    def _stuck(self, now_s: float, pose: Pose, code: Code, message: str) -> tuple[Speed, Floats]:
        """Try the next behaviour, or give up."""
        self._moved = self._controlled_s = None
        self._controller.reset()
        hopeless = code in _HOPELESS and not self._ever_planned
        if hopeless or self._recovery.exhausted:
            self._end(State.ABORTED, code, message)
            return STOPPED, _NOWHERE
        if self._recovery.begin(now_s, pose) is Behaviour.CLEAR_COSTMAP:
            self.costmap.obstacles.clear()
        self.path_m = _NO_PATH
        self._forget_plans()
        self._say(State.RECOVERING, code, message)
        return STOPPED, _NOWHERE

    def _recover(self, now_s: float, pose: Pose) -> Speed:
        local = self.costmap.local(now_s, pose[0], pose[1], self.options.local_radius_m)
        progress, command = self._recovery.step(now_s, pose, local)
        if progress is not Progress.RUNNING:
            self._say(State.FOLLOWING, self.status.code, self.status.message)
        return command

    # What it says

    def _say(self, state: State, code: Code, message: str, away_m: float | None = None) -> None:
        remaining = self.status.distance_remaining_m if away_m is None else away_m
        behaviour = self._recovery.behaviour if state is State.RECOVERING else None
        self.status = Status(state, code, message, behaviour, self._recovery.begun, remaining)

    def _end(self, state: State, code: Code, message: str) -> None:
        self._say(state, code, message)
        self._goal = None
        self.path_m = _NO_PATH
        self._forget_plans()
        self._controller.reset()

    def _command(self, wanted: Speed, trajectory: Floats, verdict: Verdict) -> Command:
        return Command(verdict.command, wanted, verdict, trajectory, self.status)


def _possible(pose: Pose) -> bool:
    x_m, y_m, yaw_rad = pose
    return abs(x_m) <= MOST_M and abs(y_m) <= MOST_M and abs(yaw_rad) <= MOST_RAD  # and no NaN


def _said(pose: Pose) -> str:
    return f"({pose[0]:.2f}, {pose[1]:.2f})"
