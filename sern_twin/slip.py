"""What a skid-steered robot makes of a command: how much of the speed, how much of the turn, and which way it pulls.

Its wheels slip sideways whenever it turns: an ideal differential drive in its place turns two to four times too fast.
So the twin learns three numbers while it hears the robot (least squares over the last `WINDOW_S`, old samples weighing
less and less) and uses them while it does not. Before there is something to learn from they are the ideal model's.
"""

import math
from typing import Final

from sern_core.vocabulary.errors import UsageError
from sern_twin.motion import Twist

WINDOW_S: Final = 120.0
LEAST: Final = 0.1
MOST: Final = 2.0
"""Scales outside of these are of no robot that drives."""
PRIOR_S: Final = 1.0
"""How many seconds of driving at one unit of command the ideal model counts for."""
MOST_BIAS_RADPS: Final = 0.2


class Slip:
    """`speed_scale`, `yaw_scale` and `yaw_bias_radps`: found is scale times command, and the bias while it moves."""

    def __init__(self) -> None:
        self.speed_scale = 1.0
        self.yaw_scale = 1.0
        self.yaw_bias_radps = 0.0
        self._speed_squared = 0.0
        self._speed_found = 0.0
        # Normal equations of found = scale · command + bias.
        self._yaw_squared = 0.0
        self._yaw_found = 0.0
        self._yaw_sum = 0.0
        self._time_s = 0.0
        self._found_sum = 0.0

    def twist(self, command: Twist) -> Twist:
        """What the robot will do of it in the end. One that is told to stand stands."""
        if command.forward_mps == 0 and command.yaw_radps == 0 and command.left_mps == 0:
            return command
        return Twist(
            self.speed_scale * command.forward_mps,
            self.speed_scale * command.left_mps,
            self.yaw_scale * command.yaw_radps + self.yaw_bias_radps,
        )

    def learn(self, command: Twist, found: Twist, duration_s: float) -> None:
        """A robot that was told `command` did `found` in the mean over `duration_s`.

        One that was told to stand teaches nothing. UsageError: not finite, or a duration that is not above 0.
        """
        numbers = command.forward_mps, command.yaw_radps, found.forward_mps, found.yaw_radps, duration_s
        if not (all(map(math.isfinite, numbers)) and duration_s > 0):
            raise UsageError(f"slip cannot be learned from {command} and {found} in {duration_s} s")
        if command.forward_mps == 0 and command.yaw_radps == 0:
            return
        kept = math.exp(-duration_s / WINDOW_S)
        self._speed_squared = self._speed_squared * kept + command.forward_mps**2 * duration_s
        self._speed_found = self._speed_found * kept + command.forward_mps * found.forward_mps * duration_s
        self._yaw_squared = self._yaw_squared * kept + command.yaw_radps**2 * duration_s
        self._yaw_found = self._yaw_found * kept + command.yaw_radps * found.yaw_radps * duration_s
        self._yaw_sum = self._yaw_sum * kept + command.yaw_radps * duration_s
        self._time_s = self._time_s * kept + duration_s
        self._found_sum = self._found_sum * kept + found.yaw_radps * duration_s
        self._solve()

    def _solve(self) -> None:
        """Least squares of what was found and of the ideal model, `PRIOR_S` of each scale and four times that of no
        bias: so there is always a solution."""
        speed_scale = (self._speed_found + PRIOR_S) / (self._speed_squared + PRIOR_S)
        self.speed_scale = min(max(speed_scale, LEAST), MOST)
        squared, found, time_s = self._yaw_squared + PRIOR_S, self._yaw_found + PRIOR_S, self._time_s + 4 * PRIOR_S
        yaw_scale = (found * time_s - self._yaw_sum * self._found_sum) / (squared * time_s - self._yaw_sum**2)
        self.yaw_scale = min(max(yaw_scale, LEAST), MOST)
        bias_radps = (self._found_sum - self.yaw_scale * self._yaw_sum) / time_s
        self.yaw_bias_radps = min(max(bias_radps, -MOST_BIAS_RADPS), MOST_BIAS_RADPS)
