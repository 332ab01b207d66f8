"""Whether a robot follows a plan, and how late: learned while it is heard, for when it is not."""

from collections import deque
from statistics import median
from typing import Final

from sern_twin.motion import Motion
from sern_twin.trajectory import Trajectory

SAMPLES: Final = 100
FEWEST: Final = 5
"""Measurements after which something is known."""
MOVES_MPS: Final = 0.05
"""Where the plan stands nearly still, nothing tells how late the robot is."""
STILL_FOR: Final = 2
"""Measurements in a row: one alone may be noise."""
STANDS: Final = 0.25
"""A robot that has less than this share of the plan's speed does not do what the plan says: it stands, or nearly."""


class Following:
    """`heard` at each measurement. `follows_m`: how far from the plan a robot may be that follows it; `latest_s`: how
    late. One that came further off, or later, in the median of the last measurements does something else, and so does
    one that stands while the plan moves, until it moves again."""

    def __init__(self, plan: Trajectory, *, follows_m: float = 0.5, latest_s: float = 2.0) -> None:
        self.plan = plan
        self._follows_m = follows_m
        self._latest_s = latest_s
        self._delays_s: deque[float] = deque(maxlen=SAMPLES)
        self._off_m: deque[float] = deque(maxlen=SAMPLES)
        self._stands = 0
        """Measurements in a row of a robot that stands where the plan moves."""

    def heard(self, stamp_s: float, found: Motion) -> None:
        """The robot was there then. Stamps before the plan and after it teach nothing."""
        if not self.plan.start_s <= stamp_s < self.plan.end_s:
            return
        planned = self.plan.at(stamp_s)
        x_mps, y_mps = planned.velocity_mps()
        x_m, y_m = found.x_m - planned.x_m, found.y_m - planned.y_m
        delay_s = 0.0
        if planned.speed_mps > MOVES_MPS:
            delay_s = -(x_m * x_mps + y_m * y_mps) / planned.speed_mps**2
            delay_s = min(max(delay_s, -2 * self._latest_s), 2 * self._latest_s)
            self._delays_s.append(delay_s)
            late = self.plan.at(stamp_s - delay_s)
            stands = found.speed_mps < STANDS * min(planned.speed_mps, late.speed_mps)
            self._stands = self._stands + 1 if stands else 0
        self._off_m.append(self.plan.at(stamp_s - delay_s).distance_m(found))

    @property
    def delay_s(self) -> float:
        """How late it is against the plan's times, in the median; below 0: early."""
        return median(self._delays_s) if self._delays_s else 0.0

    @property
    def follows(self) -> bool:
        if len(self._off_m) < FEWEST or self._stands >= STILL_FOR:
            return False
        return median(self._off_m) <= self._follows_m and abs(self.delay_s) <= self._latest_s
