"""The acceleration of a robot that says how fast it is and not how its speeds change, as nav_msgs/Odometry has it."""

import math
from dataclasses import replace
from typing import Final

from sern_twin.motion import Motion

APART_S: Final = 0.5
"""Speeds further apart than this tell nothing of the acceleration now."""
SMOOTH_S: Final = 0.2
"""The time constant of the mean: what one pair of speeds says is mostly their noise."""


class Accelerations:
    """Robot and twin work it out of the same poses: of those that were sent, and taken."""

    def __init__(self) -> None:
        self._last: tuple[float, Motion] | None = None

    def of(self, stamp_s: float, motion: Motion) -> Motion:
        """`motion` with its accelerations; without, where there is nothing to tell them by."""
        if self._last is None or not motion.finite:
            return motion
        last_s, last = self._last
        length_s = stamp_s - last_s
        if not 0 < length_s <= APART_S:
            return motion
        new = 1 - math.exp(-length_s / SMOOTH_S)
        forward_mps2 = (motion.twist.forward_mps - last.twist.forward_mps) / length_s
        yaw_radps2 = (motion.twist.yaw_radps - last.twist.yaw_radps) / length_s
        return replace(
            motion,
            forward_mps2=last.forward_mps2 + new * (forward_mps2 - last.forward_mps2),
            yaw_radps2=last.yaw_radps2 + new * (yaw_radps2 - last.yaw_radps2),
        )

    def took(self, stamp_s: float, motion: Motion) -> None:
        """This one, as `of` gave it, was sent or taken."""
        self._last = stamp_s, motion
