"""The state of a ground robot, and how it moves on: SE(2) in the site's plane, speeds in the body's axes (x forward, y
left, REP 103), yaw counter-clockwise."""

import math
from dataclasses import dataclass
from typing import Final

TAU: Final = 2 * math.pi
MOST_M: Final = 1e7
"""No place of a site is further from its origin: a quarter of the way round the Earth."""
_STRAIGHT_RAD: Final = 1e-6
"""Below this turn the series is exact in a float."""


@dataclass(frozen=True, slots=True)
class Twist:
    """Speeds in the body's axes."""

    forward_mps: float = 0.0
    left_mps: float = 0.0
    yaw_radps: float = 0.0

    def towards(self, other: "Twist", share: float) -> "Twist":
        """The twist that lies by this share between this one and the other."""
        return Twist(
            self.forward_mps + (other.forward_mps - self.forward_mps) * share,
            self.left_mps + (other.left_mps - self.left_mps) * share,
            self.yaw_radps + (other.yaw_radps - self.yaw_radps) * share,
        )


STILL: Final = Twist()


@dataclass(frozen=True, slots=True)
class Motion:
    """Where a robot is, how fast, and how its speeds change."""

    x_m: float
    y_m: float
    yaw_rad: float
    twist: Twist = STILL
    forward_mps2: float = 0.0
    yaw_radps2: float = 0.0

    @property
    def finite(self) -> bool:
        """False for what no robot can be at: NaN or infinity anywhere."""
        twist = self.twist
        return math.isfinite(
            self.x_m + self.y_m + self.yaw_rad + twist.forward_mps + twist.left_mps + twist.yaw_radps
            + self.forward_mps2 + self.yaw_radps2
        )  # fmt: skip

    @property
    def speed_mps(self) -> float:
        return math.hypot(self.twist.forward_mps, self.twist.left_mps)

    def velocity_mps(self) -> tuple[float, float]:
        """Speeds in the site's axes, x and y."""
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        forward, left = self.twist.forward_mps, self.twist.left_mps
        return cos * forward - sin * left, sin * forward + cos * left

    def distance_m(self, other: "Motion") -> float:
        return math.hypot(self.x_m - other.x_m, self.y_m - other.y_m)

    def turn_rad(self, other: "Motion") -> float:
        """From this yaw to the other's, the short way round."""
        return math.remainder(other.yaw_rad - self.yaw_rad, TAU)

    def moved(self, mean: Twist, step_s: float, then: Twist) -> "Motion":
        """After `step_s` at the twist `mean`, which is `then` at its end: the exact arc, whatever the step."""
        turn = mean.yaw_radps * step_s
        if abs(turn) < _STRAIGHT_RAD:
            along, across = 1.0, turn / 2
        else:
            along, across = math.sin(turn) / turn, (1 - math.cos(turn)) / turn
        forward = (along * mean.forward_mps - across * mean.left_mps) * step_s
        left = (across * mean.forward_mps + along * mean.left_mps) * step_s
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return Motion(
            self.x_m + cos * forward - sin * left,
            self.y_m + sin * forward + cos * left,
            math.remainder(self.yaw_rad + turn, TAU),
            then,
            self.forward_mps2,
            self.yaw_radps2,
        )
