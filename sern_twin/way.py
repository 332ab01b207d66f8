"""A path without times, as Nav2 and move_base publish it, and a robot that goes along it.

Where on the path the robot is, only its own pose says: it is looked for anew in each step, so what is heard corrects
how far along it is, and nothing is compared with times that nobody gave.
"""

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from sern_core.vocabulary.errors import BodyError
from sern_twin.motion import MOST_M, TAU, Motion, Twist
from sern_twin.predictors import ACCELERATES_S, CLOSES_S, SOON_S, ConstantAcceleration, Predictor

SMOOTH_M: Final = 0.15
"""The direction of the path is that over so much to either side: a robot cuts corners."""
TURNED_M: Final = 0.5
"""A place of the path that leads the other way counts as twice so far away: paths cross themselves, and come back."""
OFF_M: Final = 0.5
"""A robot further from the path does not follow it."""
OFF_RAD: Final = 1.2
"""Nor does one that goes in a direction so far from that of the path."""
_SAME_M: Final = 1e-3
_DIFFER_M: Final = 1e-6


class Foot(NamedTuple):
    """The place of a way where a robot is."""

    along_m: float
    """From the start of the way."""
    left_m: float
    """How far the robot is to the left of it."""
    yaw_rad: float
    """The direction of the way there."""


class Way:
    """Places joined by straight lines. BodyError: fewer than two that differ, or one that is at no site."""

    def __init__(self, places_m: Sequence[tuple[float, float]]) -> None:
        points = np.array(places_m, np.float64).reshape(-1, 2)
        if not (np.abs(points) <= MOST_M).all():
            raise BodyError(f"a path with a place that is not finite, or more than {MOST_M / 1000:.0f} km away")
        lengths_m = np.hypot(*np.diff(points, axis=0).T) if len(points) > 1 else np.zeros(0)
        points = np.concatenate([points[:1], points[1:][lengths_m >= _DIFFER_M]])
        if len(points) < 2:
            raise BodyError(f"a path of {len(places_m)} places, of which no two differ: it takes two")
        self._points = points
        self._steps = np.diff(points, axis=0)
        self._lengths_m = np.hypot(*self._steps.T)
        self._along_m = np.concatenate([[0.0], np.cumsum(self._lengths_m)])
        self._directions = self._steps / self._lengths_m[:, None]

    @property
    def length_m(self) -> float:
        return float(self._along_m[-1])

    def at(self, along_m: float) -> tuple[float, float]:
        """The place so far from the start; before it the start, after the end that."""
        x_m, y_m = (float(np.interp(along_m, self._along_m, self._points[:, axis])) for axis in (0, 1))
        return x_m, y_m

    def direction_rad(self, along_m: float) -> float:
        begin = self.at(max(0.0, min(along_m, self.length_m) - SMOOTH_M))
        end = self.at(min(self.length_m, max(along_m, 0.0) + SMOOTH_M))
        if math.dist(begin, end) < _SAME_M:  # it turns back right here
            part = min(int(np.searchsorted(self._along_m, along_m, side="right")) - 1, len(self._steps) - 1)
            return math.atan2(self._steps[part, 1], self._steps[part, 0])
        return math.atan2(end[1] - begin[1], end[0] - begin[0])

    def foot(self, motion: Motion) -> Foot:
        """The place of the way that is nearest to a robot which goes as it goes."""
        place = np.array([motion.x_m, motion.y_m])
        along = np.clip(((place - self._points[:-1]) * self._directions).sum(axis=1), 0.0, self._lengths_m)
        off_m = np.hypot(*(self._points[:-1] + along[:, None] * self._directions - place).T)
        goes_rad = _goes_rad(motion)
        same = self._directions @ (math.cos(goes_rad), math.sin(goes_rad))
        part = int(np.argmin(off_m**2 + (TURNED_M * (1 - same)) ** 2))
        along_m = float(self._along_m[part] + along[part])
        yaw_rad = self.direction_rad(along_m)
        x_m, y_m = self.at(along_m)
        left_m = math.cos(yaw_rad) * (motion.y_m - y_m) - math.sin(yaw_rad) * (motion.x_m - x_m)
        return Foot(along_m, left_m, yaw_rad)

    def followed_by(self, motion: Motion) -> bool:
        """Whether a robot that is there and goes so can be following it, and is not at its end."""
        foot = self.foot(motion)
        off_m = math.dist(self.at(foot.along_m), (motion.x_m, motion.y_m))
        turned = abs(math.remainder(_goes_rad(motion) - foot.yaw_rad, TAU))
        return off_m <= OFF_M and turned <= OFF_RAD and foot.along_m < self.length_m - _SAME_M


class PathTracking(Predictor):
    """It goes on as it went for `ACCELERATES_S`, in which that is known best; then along the way, where what it is off
    to the side shrinks with `closes_s` and its speed becomes `speed_mps`. At the end of the way it stands."""

    def __init__(self, way: Way, speed_mps: float, *, closes_s: float = CLOSES_S) -> None:
        self._way = way
        self._speed_mps = speed_mps
        self._closes_s = closes_s
        self._soon = ConstantAcceleration()

    def advance(self, motion: Motion, start_s: float, step_s: float, *, heard_s: float) -> Motion:
        soon_s = min(max(heard_s + ACCELERATES_S - start_s, 0.0), step_s)
        if soon_s > SOON_S:
            motion = self._soon.advance(motion, start_s, soon_s, heard_s=heard_s)
        return motion if step_s - soon_s <= SOON_S else self._along(motion, step_s - soon_s)

    def _along(self, motion: Motion, step_s: float) -> Motion:
        foot = self._way.foot(motion)
        left = math.exp(-step_s / self._closes_s)
        before_mps = motion.speed_mps
        after_mps = self._speed_mps + (before_mps - self._speed_mps) * left
        along_m = foot.along_m + (before_mps + after_mps) / 2 * step_s
        if along_m >= self._way.length_m:
            along_m, after_mps = self._way.length_m, 0.0
        x_m, y_m = self._way.at(along_m)
        yaw_rad = self._way.direction_rad(along_m)
        left_m = foot.left_m * left
        # A robot that drives backwards looks the other way.
        backwards = math.cos(motion.yaw_rad - foot.yaw_rad) < 0
        looks_rad = math.pi if backwards else 0.0
        off_rad = math.remainder(motion.yaw_rad - foot.yaw_rad - looks_rad, TAU)
        then_rad = math.remainder(yaw_rad + looks_rad + off_rad * left, TAU)
        turn_rad = math.remainder(then_rad - motion.yaw_rad, TAU)
        return Motion(
            x_m - math.sin(yaw_rad) * left_m,
            y_m + math.cos(yaw_rad) * left_m,
            then_rad,
            Twist(-after_mps if backwards else after_mps, 0.0, turn_rad / step_s if after_mps > 0 else 0.0),
        )


def _goes_rad(motion: Motion) -> float:
    """The direction in which it goes: backwards where it drives so."""
    return motion.yaw_rad + (math.pi if motion.twist.forward_mps < 0 else 0.0)
