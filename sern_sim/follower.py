"""A robot that follows a plan: where it is to be now, where it thinks it is, and what it tells its wheels.

The law is that of Kanayama et al. (ICRA 1990). A skid-steered base turns less than its wheels say, so the wheels are
told the more; the integral of what its gyroscope misses takes up what is left of that.
"""

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

from sern_sim.robot import STEP_S, Pose2


class Reference(NamedTuple):
    """Where the plan has the robot now, and how fast; speeds in the body's axes."""

    pose: Pose2
    speed_mps: float
    yaw_rate_radps: float


@dataclass(frozen=True, slots=True)
class FollowerOptions:
    along_per_s: float = 1.5
    across_per_m2: float = 4.0
    heading_per_m: float = 4.0
    turn_per_s: float = 4.0
    """How fast the integral of the turn grows: what the base turns less than it is to."""
    most_turn_radps: float = 2.0
    """The integral at the most: a robot that is held must not spin when it is let go."""


ON_HILLS: Final = FollowerOptions(along_per_s=2.5, across_per_m2=8.0)
"""The gains for a base that slides down slopes while it turns."""


class Follower:
    """`command` is asked once a step. `yaw_scale`: what the base makes of a turn, as far as its maker knows."""

    def __init__(self, yaw_scale: float, options: FollowerOptions | None = None) -> None:
        self._yaw_scale = yaw_scale
        self._options = options or FollowerOptions()
        self._turn_radps = 0.0

    def command(self, reference: Reference, found: Pose2, turning_radps: float) -> tuple[float, float]:
        """Speed m/s and yaw rate rad/s for the wheels, of a robot that thinks it is at `found`, and turns so."""
        options = self._options
        x_m, y_m = reference.pose.x_m - found.x_m, reference.pose.y_m - found.y_m
        cos, sin = math.cos(found.yaw_rad), math.sin(found.yaw_rad)
        ahead_m, left_m = cos * x_m + sin * y_m, cos * y_m - sin * x_m
        turn_rad = math.remainder(reference.pose.yaw_rad - found.yaw_rad, 2 * math.pi)
        speed = reference.speed_mps * math.cos(turn_rad) + options.along_per_s * ahead_m
        lead = abs(reference.speed_mps) * (
            options.across_per_m2 * math.copysign(1.0, reference.speed_mps) * left_m
            + options.heading_per_m * math.sin(turn_rad)
        )
        wanted_radps = reference.yaw_rate_radps + lead
        grown = self._turn_radps + options.turn_per_s * (wanted_radps - turning_radps) * STEP_S
        self._turn_radps = min(max(grown, -options.most_turn_radps), options.most_turn_radps)
        return speed, (wanted_radps + self._turn_radps) / self._yaw_scale
