"""A robot that only its satellite receiver places: fixes in, motions in the plane of the site out.

A fix has no heading and no speed. Both are those of the way that the last fixes made, by least squares; a robot that is
too slow for that keeps its heading, and one that drives backwards is taken for one that drives forwards.
"""

import math
from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np

from sern_twin.geodesy import TangentPlane
from sern_twin.motion import Motion, Twist

WINDOW_S: Final = 2.0
"""The way is that of the fixes of so long."""
FEWEST: Final = 4
SHORTEST_S: Final = 0.5
"""Fewer fixes, or those of a shorter time, make no way."""
HEADING_MPS: Final = 0.3
"""The heading of a slower robot is noise."""
SURE: Final = 4.0
"""A way is so many times as fast as its fixes may make it by what they are off it (one sigma)."""


@dataclass(frozen=True, slots=True)
class Fix:
    """What sensor_msgs/NavSatFix says. `valid`: the receiver has a fix."""

    latitude_deg: float
    longitude_deg: float
    height_m: float
    valid: bool


class Fixes:
    """`motion` of each valid fix, and `took` of each motion that was believed."""

    def __init__(self, plane: TangentPlane) -> None:
        self._plane = plane
        self._taken: deque[tuple[float, float, float]] = deque()
        self._yaw_rad = 0.0

    def motion(self, stamp_s: float, fix: Fix) -> tuple[Motion, float]:
        """Where that is in the plane, how fast, and its height [m], 0 where there is none. The motion is not finite
        for what is no place on the Earth."""
        if not (abs(fix.latitude_deg) <= 90 and abs(fix.longitude_deg) <= 360):  # NaN too
            return Motion(math.nan, math.nan, 0.0), 0.0
        height_m = fix.height_m if math.isfinite(fix.height_m) else self._plane.height_m
        place = (math.radians(fix.latitude_deg), math.radians(fix.longitude_deg), height_m)
        x_m, y_m, z_m = self._plane.to_local(place).tolist()
        x_mps, y_mps = self._velocity_mps(stamp_s)
        speed_mps = math.hypot(x_mps, y_mps)
        if speed_mps < HEADING_MPS:
            return Motion(x_m, y_m, self._yaw_rad), z_m
        return Motion(x_m, y_m, math.atan2(y_mps, x_mps), Twist(speed_mps)), z_m

    def took(self, stamp_s: float, motion: Motion, *, anew: bool) -> None:
        """`anew`: the robot is somewhere else than the fixes before said."""
        if anew:
            self._taken.clear()
        self._taken.append((stamp_s, motion.x_m, motion.y_m))
        self._yaw_rad = motion.yaw_rad

    def _velocity_mps(self, stamp_s: float) -> tuple[float, float]:
        """The velocity of the fixes before this one, which may be a jump itself."""
        while self._taken and self._taken[0][0] < stamp_s - WINDOW_S:
            self._taken.popleft()
        if len(self._taken) < FEWEST or self._taken[-1][0] - self._taken[0][0] < SHORTEST_S:
            return 0.0, 0.0
        times_s, x_m, y_m = np.array(self._taken).T
        off_s = times_s - times_s.mean()
        squares = float((off_s**2).sum())
        x_mps, y_mps = (float((off_s * places_m).sum()) / squares for places_m in (x_m, y_m))
        off_m2 = float(((x_m - x_m.mean() - x_mps * off_s) ** 2 + (y_m - y_m.mean() - y_mps * off_s) ** 2).sum())
        unsure_mps = math.sqrt(off_m2 / (2 * len(times_s) - 4) / squares)
        return (x_mps, y_mps) if math.hypot(x_mps, y_mps) >= SURE * unsure_mps else (0.0, 0.0)
