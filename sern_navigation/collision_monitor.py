"""The last word on a command, by real data alone: nav2_collision_monitor's stop, slowdown and approach.

It knows no map, no plan and no twin: points that the robot's sensors see now, or have seen where they cannot see now.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from sern_core.vocabulary.errors import UsageError
from sern_twin.world.grid import Floats

Speed = tuple[float, float]

STOPPED: Final = (0.0, 0.0)


class Action(StrEnum):
    """What was done to a command."""

    DO_NOT_PROCESS = "do_not_process"
    """Nothing: it is as it was."""
    STOP = "stop"
    SLOWDOWN = "slowdown"
    APPROACH = "approach"
    NO_DATA = "no_data"
    """Stopped, since the last data is older than source_timeout, or is from the future."""
    INVALID = "invalid"
    """Stopped, since the command was not finite."""


@dataclass(frozen=True, slots=True)
class Polygon:
    """A zone of the robot's frame, corners (x, y) [m] in order. It counts for commands with speeds within its limits.

    The limits are those of Nav2's velocity polygons: so a robot may back away from what it stands before.
    UsageError: fewer than three corners, a ratio that is none of 0 to 1, no point at all.
    """

    name: str
    points: tuple[tuple[float, float], ...]
    action_type: Literal["stop", "slowdown"]
    slowdown_ratio: float = 0.5
    min_points: int = 2
    """So many points in it count. A scan here has one point for each bearing, so these are fewer than Nav2's 4."""
    linear_min: float = -math.inf
    linear_max: float = math.inf
    theta_min: float = -math.inf
    theta_max: float = math.inf

    def __post_init__(self) -> None:
        if len(self.points) < 3 or not np.isfinite(self.points).all():
            raise UsageError(f"polygon {self.name} of {len(self.points)} corners: give three or more, all finite")
        if not 0 <= self.slowdown_ratio <= 1:
            raise UsageError(f"polygon {self.name} with slowdown_ratio {self.slowdown_ratio}: give 0 to 1")
        if self.min_points < 1:
            raise UsageError(f"polygon {self.name} with min_points {self.min_points}: give 1 or more")

    def counts_for(self, command: Speed) -> bool:
        return self.linear_min <= command[0] <= self.linear_max and self.theta_min <= command[1] <= self.theta_max


AHEAD: Final = Polygon("PolygonStop", ((0.0, -0.28), (0.42, -0.28), (0.42, 0.28), (0.0, 0.28)), "stop", linear_min=0.01)
BEHIND: Final = Polygon(
    "PolygonStopBehind", ((0.0, -0.28), (-0.42, -0.28), (-0.42, 0.28), (0.0, 0.28)), "stop", linear_max=-0.01
)
SLOW: Final = Polygon(
    "PolygonSlow", ((0.0, -0.38), (0.9, -0.38), (0.9, 0.38), (0.0, 0.38)), "slowdown", linear_min=0.01
)


@dataclass(frozen=True, slots=True)
class MonitorOptions:
    """The zones are those of the simulated Jackal. UsageError: numbers that do not fit together."""

    polygons: tuple[Polygon, ...] = (AHEAD, BEHIND, SLOW)
    radius: float = 0.33
    """[m]: of the circle that approaches."""
    time_before_collision: float = 1.2
    """[s]: a command is slowed down so that nothing is met before."""
    simulation_time_step: float = 0.1
    min_points: int = 1
    """So many points are met in a collision."""
    source_timeout: float = 1.0
    """[s]: what is older is no data."""

    def __post_init__(self) -> None:
        if not 0 < self.simulation_time_step <= self.time_before_collision < math.inf:
            raise UsageError(
                f"a monitor with simulation_time_step {self.simulation_time_step}, time_before_collision "
                f"{self.time_before_collision}: 0 < simulation_time_step <= time_before_collision"
            )
        if not (0 < self.radius < math.inf and 0 < self.source_timeout < math.inf and self.min_points >= 1):
            raise UsageError("a monitor: radius and source_timeout are above 0, min_points is 1 or more")


@dataclass(frozen=True, slots=True)
class Verdict:
    """The command that may be sent, what was done to it, and by which zone."""

    command: Speed
    action: Action
    polygon: str = ""


class CollisionMonitor:
    """It keeps nothing but its counts: the same input gives the same verdict."""

    def __init__(self, options: MonitorOptions | None = None) -> None:
        self.options: Final = options or MonitorOptions()
        self._counts = dict.fromkeys(Action, 0)
        self._zones_m = max(
            (math.hypot(*corner) for zone in self.options.polygons for corner in zone.points), default=0.0
        )

    @property
    def counts(self) -> Mapping[Action, int]:
        """How many commands were treated how."""
        return self._counts

    def process(self, command: Speed, points_m: Floats, stamp_s: float | None, now_s: float) -> Verdict:
        """What becomes of a command. `points_m` (n, 2) in the robot's frame, as of `stamp_s`; None: there was no data.

        The most cautious of the zones decides.
        """
        verdict = self._decided(command, points_m, stamp_s, now_s)
        self._counts[verdict.action] += 1
        return verdict

    def _decided(self, command: Speed, points_m: Floats, stamp_s: float | None, now_s: float) -> Verdict:
        if not (math.isfinite(command[0]) and math.isfinite(command[1])):
            return Verdict(STOPPED, Action.INVALID)
        if stamp_s is None or not abs(now_s - stamp_s) <= self.options.source_timeout:  # and no NaN
            return Verdict(STOPPED, Action.NO_DATA)
        reach_m = max(self._zones_m, self.options.radius + abs(command[0]) * self.options.time_before_collision)
        # No zone and no circle on the way is further away; and no NaN.
        points = points_m[np.hypot(points_m[:, 0], points_m[:, 1]) <= reach_m]
        slowest, found = 1.0, Verdict(command, Action.DO_NOT_PROCESS)
        for polygon in self.options.polygons:
            if not polygon.counts_for(command):
                continue
            if np.count_nonzero(inside(polygon.points, points)) < polygon.min_points:
                continue
            if polygon.action_type == "stop":
                return Verdict(STOPPED, Action.STOP, polygon.name)
            if polygon.slowdown_ratio < slowest:
                slowest = polygon.slowdown_ratio
                found = Verdict(_times(command, slowest), Action.SLOWDOWN, polygon.name)
        meets_s = self._meets_s(command, points)
        if meets_s is not None and meets_s / self.options.time_before_collision < slowest:
            slowest = meets_s / self.options.time_before_collision
            found = Verdict(_times(command, slowest), Action.APPROACH, "FootprintApproach")
        return found

    def _meets_s(self, command: Speed, points: Floats) -> float | None:
        """When a command leads to a collision; None: not before `time_before_collision`.

        What is in the circle already is met only by coming nearer to it: so a robot that touches something gets away.
        """
        if command == STOPPED or not len(points):
            return None
        options = self.options
        steps = math.ceil(options.time_before_collision / options.simulation_time_step)
        times_s = np.minimum(np.arange(steps + 1) * options.simulation_time_step, options.time_before_collision)
        turned = command[1] * times_s
        half = turned / 2
        # The chord of an arc: sin(x)/x, with x half of what was turned.
        chord = command[0] * times_s * np.sinc(half / math.pi)
        places = np.stack((chord * np.cos(half), chord * np.sin(half)), axis=1)
        away = np.hypot(*(points[None, :, :] - places[:, None, :]).transpose(2, 0, 1))
        within = away[0] < options.radius
        nearer = np.minimum.accumulate(away, axis=0) < np.where(within, away[0] - 1e-3, options.radius)
        met = np.count_nonzero(nearer, axis=1) >= options.min_points
        return float(times_s[max(int(np.argmax(met)) - 1, 0)]) if met.any() else None


def inside(polygon: tuple[tuple[float, float], ...], points: Floats) -> NDArray[np.bool_]:
    """Which points (n, 2) lie in a polygon: those from which a ray crosses its sides an odd number of times."""
    corners = np.array(polygon)
    following = np.roll(corners, -1, axis=0)
    x, y = points[:, 0, None], points[:, 1, None]
    crosses = (corners[:, 1] > y) != (following[:, 1] > y)
    rise = np.where(following[:, 1] == corners[:, 1], 1.0, following[:, 1] - corners[:, 1])
    at = corners[:, 0] + (y - corners[:, 1]) * (following[:, 0] - corners[:, 0]) / rise
    found: NDArray[np.bool_] = np.count_nonzero(crosses & (x < at), axis=1) % 2 == 1
    return found


def _times(command: Speed, ratio: float) -> Speed:
    return command[0] * ratio, command[1] * ratio
