"""A plan that robot and twin both have: where the robot is to be at which time (nav_msgs/Path with stamps, or
trajectory_msgs)."""

import math
from bisect import bisect_right
from collections.abc import Sequence
from typing import Final, NamedTuple

from sern_core.vocabulary.errors import BodyError
from sern_twin.motion import TAU, Motion, Twist

MOST_POINTS: Final = 100_000
"""More are of no plan: a robot that sends them would fill the twin's memory."""
_SAME_M: Final = 1e-3


class Waypoint(NamedTuple):
    """Time in seconds of whatever clock the plan has; yaw None: the direction of the way."""

    time_s: float
    x_m: float
    y_m: float
    yaw_rad: float | None = None


class Trajectory:
    """Waypoints joined by cubic Hermite curves (three-point slopes), at rest where two waypoints are the same place.

    Before the first the robot stands there, and after the last there. BodyError: fewer than two waypoints, too many,
    times that do not rise, or a number that is not finite; the message names the waypoint.
    """

    def __init__(self, waypoints: Sequence[Waypoint]) -> None:
        if not 2 <= len(waypoints) <= MOST_POINTS:
            raise BodyError(f"a trajectory of {len(waypoints)} waypoints: it takes 2 to {MOST_POINTS}")
        for number, point in enumerate(waypoints):
            if not all(math.isfinite(value) for value in point if value is not None):
                raise BodyError(f"waypoint {number} of the trajectory is not finite: {tuple(point)}")
            if number and point.time_s <= waypoints[number - 1].time_s:
                raise BodyError(f"waypoint {number} of the trajectory is not after the one before: {point.time_s} s")
        self._times_s = [point.time_s for point in waypoints]
        self._x_m = [point.x_m for point in waypoints]
        self._y_m = [point.y_m for point in waypoints]
        rests = [
            number
            for number in range(len(waypoints) - 1)
            if math.dist((self._x_m[number], self._y_m[number]), (self._x_m[number + 1], self._y_m[number + 1]))
            < _SAME_M
        ]
        still = {*rests, *(number + 1 for number in rests)}
        self._x_mps = _slopes(self._times_s, self._x_m, still)
        self._y_mps = _slopes(self._times_s, self._y_m, still)
        self._yaw_rad = _unwrapped(self._headings(waypoints))
        self._yaw_radps = _slopes(self._times_s, self._yaw_rad, set())

    @property
    def start_s(self) -> float:
        return self._times_s[0]

    @property
    def end_s(self) -> float:
        return self._times_s[-1]

    def at(self, time_s: float) -> Motion:
        """Where the robot is to be then, and how fast."""
        if time_s < self.start_s or time_s >= self.end_s:
            place = 0 if time_s < self.start_s else -1
            return Motion(self._x_m[place], self._y_m[place], math.remainder(self._yaw_rad[place], TAU))
        part = bisect_right(self._times_s, time_s) - 1
        length_s = self._times_s[part + 1] - self._times_s[part]
        share = (time_s - self._times_s[part]) / length_s
        x_m, x_mps = _hermite(self._x_m, self._x_mps, part, share, length_s)
        y_m, y_mps = _hermite(self._y_m, self._y_mps, part, share, length_s)
        yaw_rad, yaw_radps = _hermite(self._yaw_rad, self._yaw_radps, part, share, length_s)
        cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
        twist = Twist(cos * x_mps + sin * y_mps, cos * y_mps - sin * x_mps, yaw_radps)
        return Motion(x_m, y_m, math.remainder(yaw_rad, TAU), twist)

    def _headings(self, waypoints: Sequence[Waypoint]) -> list[float]:
        """Yaw at each waypoint: as given, else the direction of the way, and at rest the one before."""
        found: list[float | None] = []
        for number, point in enumerate(waypoints):
            x_mps, y_mps = self._x_mps[number], self._y_mps[number]
            if (x_mps, y_mps) == (0.0, 0.0):
                x_mps, y_mps = self._chord(number)
            heading = math.atan2(y_mps, x_mps) if (x_mps, y_mps) != (0.0, 0.0) else None
            found.append(heading if point.yaw_rad is None else point.yaw_rad)
        first = next((heading for heading in found if heading is not None), 0.0)
        headings: list[float] = []
        for heading in found:
            headings.append(heading if heading is not None else headings[-1] if headings else first)
        return headings

    def _chord(self, number: int) -> tuple[float, float]:
        """To the next waypoint, at the last from the one before; nothing at rest."""
        start = min(number, len(self._x_m) - 2)
        x_m, y_m = self._x_m[start + 1] - self._x_m[start], self._y_m[start + 1] - self._y_m[start]
        return (x_m, y_m) if math.hypot(x_m, y_m) >= _SAME_M else (0.0, 0.0)


def _slopes(times_s: Sequence[float], values: Sequence[float], still: set[int]) -> list[float]:
    """Slopes of the parabola through three neighbours, at the ends of the nearest; of the line through two points."""
    if len(values) == 2:
        slope = 0.0 if still else (values[1] - values[0]) / (times_s[1] - times_s[0])
        return [slope, slope]
    chords = [(values[n + 1] - values[n]) / (times_s[n + 1] - times_s[n]) for n in range(len(values) - 1)]
    found = []
    for number in range(len(values)):
        middle = min(max(number, 1), len(values) - 2)
        before_s = times_s[middle] - times_s[middle - 1]
        after_s = times_s[middle + 1] - times_s[middle]
        before, after = chords[middle - 1], chords[middle]
        slope = (before * after_s + after * before_s) / (before_s + after_s)
        if number != middle:
            slope = 2 * (before if number < middle else after) - slope
        found.append(0.0 if number in still else slope)
    return found


def _hermite(
    values: Sequence[float], slopes: Sequence[float], part: int, share: float, length_s: float
) -> tuple[float, float]:
    """Value and slope at this share of the part."""
    start, end = values[part], values[part + 1]
    first, last = slopes[part] * length_s, slopes[part + 1] * length_s
    chord = end - start
    bend = first + last - 2 * chord
    rise = 3 * chord - 2 * first - last
    value = start + share * (first + share * (rise + share * bend))
    slope = (first + share * (2 * rise + share * 3 * bend)) / length_s
    return value, slope


def _unwrapped(angles_rad: Sequence[float]) -> list[float]:
    """Each the short way from the one before."""
    found = [angles_rad[0]]
    for angle in angles_rad[1:]:
        found.append(found[-1] + math.remainder(angle - found[-1], TAU))
    return found
