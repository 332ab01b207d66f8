"""How the twin goes on while nothing is heard. One class a way, behind `Predictor`.

Steps are short (20 ms) and pure: the state at one time gives that at the next. `heard_s` is the time of what was heard
last; all times are of the one clock that stamps measurements.
"""

import math
from abc import ABC, abstractmethod
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

from sern_twin.motion import STILL, TAU, Motion, Twist
from sern_twin.slip import Slip
from sern_twin.trajectory import Trajectory

ACCELERATES_S: Final = 0.5
"""How long a measured acceleration is believed: in 10 s it would lead ten times as far off as none (paper readings)."""
RESPONSE_S: Final = 0.15
"""The time constant with which a base follows a command."""
CLOSES_S: Final = 1.0
"""The time constant with which a robot that follows a plan comes back to it."""
SOON_S: Final = 1e-9
"""What is left of a time below this is rounding."""
MOST_STEPS: Final = 3000
"""A minute of steps of 20 ms; a longer time is predicted in as many longer ones."""


class Predictor(ABC):
    @abstractmethod
    def advance(self, motion: Motion, start_s: float, step_s: float, *, heard_s: float) -> Motion:
        """The state at `start_s` + `step_s` of a robot that was heard last at `heard_s` and is at `motion` now."""

    def reach(self, motion: Motion, start_s: float, end_s: float, step_s: float, *, heard_s: float) -> Motion:
        """The state at `end_s`, in steps of at most `step_s`, or in `MOST_STEPS`."""
        step_s = max(step_s, (end_s - start_s) / MOST_STEPS)
        time_s = start_s
        while end_s - time_s > SOON_S:
            part_s = min(step_s, end_s - time_s)
            motion = self.advance(motion, time_s, part_s, heard_s=heard_s)
            time_s += part_s
        return motion


class ConstantTwist(Predictor):
    """It goes on as it goes."""

    def advance(self, motion: Motion, start_s: float, step_s: float, *, heard_s: float) -> Motion:
        return motion.moved(motion.twist, step_s, motion.twist)


class ConstantAcceleration(Predictor):
    """Eq. (prediction_step): it speeds up as it does until `ACCELERATES_S` after it was heard, then goes on so."""

    def advance(self, motion: Motion, start_s: float, step_s: float, *, heard_s: float) -> Motion:
        speeds_up_s = min(max(heard_s + ACCELERATES_S - start_s, 0.0), step_s)
        if speeds_up_s == 0:
            return motion.moved(motion.twist, step_s, motion.twist)
        then = Twist(
            motion.twist.forward_mps + motion.forward_mps2 * speeds_up_s,
            motion.twist.left_mps,
            motion.twist.yaw_radps + motion.yaw_radps2 * speeds_up_s,
        )
        mean = motion.twist.towards(then, 0.5)
        there = motion.moved(mean, speeds_up_s, then)
        return there.moved(then, step_s - speeds_up_s, then) if step_s > speeds_up_s else there


@dataclass(frozen=True, slots=True)
class Command:
    """What the robot was told from `time_s` on."""

    time_s: float
    twist: Twist


class CommandStream(Predictor):
    """It does what it was told at each time, after `response_s`, as far as its wheels hold (`slip`).

    `commands` are in the order of their times. Where they end, the last one goes on for `holds_s`; then it stands: a
    robot stops when its commands stop.
    """

    def __init__(
        self, commands: Sequence[Command], slip: Slip, *, holds_s: float = math.inf, response_s: float = RESPONSE_S
    ) -> None:
        self._commands = commands
        self._slip = slip
        self._holds_s = holds_s
        self._response_s = response_s

    def told(self, time_s: float) -> Twist | None:
        """The command of that time; None when there was none yet."""
        place = bisect_right(self._commands, time_s, key=_time_s) - 1
        if place < 0:
            return None
        command = self._commands[place]
        return command.twist if time_s < command.time_s + self._holds_s else STILL

    def advance(self, motion: Motion, start_s: float, step_s: float, *, heard_s: float) -> Motion:
        told = self.told(start_s)
        if told is None:
            return motion.moved(motion.twist, step_s, motion.twist)
        wanted = self._slip.twist(told)
        if self._response_s <= 0:
            return motion.moved(wanted, step_s, wanted)
        # The mean of wanted + (now - wanted) exp(-t / response) over the step, and its value at the end.
        left = math.exp(-step_s / self._response_s)
        mean_left = self._response_s / step_s * (1 - left) if step_s > 0 else 1.0
        return motion.moved(wanted.towards(motion.twist, mean_left), step_s, wanted.towards(motion.twist, left))


class LastCommand(CommandStream):
    """It goes on doing what it was told last before it was silent."""

    def __init__(self, command: Command, slip: Slip, *, response_s: float = RESPONSE_S) -> None:
        super().__init__((command,), slip, response_s=response_s)


class PlanTracking(Predictor):
    """It follows a plan that both sides have, and comes back to it by itself: what it is off by shrinks with
    `closes_s`. `delay_s`: how far it is behind the plan's times, as it was found while it was heard."""

    def __init__(self, plan: Trajectory, *, delay_s: float = 0.0, closes_s: float = CLOSES_S) -> None:
        self._plan = plan
        self._delay_s = delay_s
        self._closes_s = closes_s

    def advance(self, motion: Motion, start_s: float, step_s: float, *, heard_s: float) -> Motion:
        now = self._plan.at(start_s - self._delay_s)
        then = self._plan.at(start_s + step_s - self._delay_s)
        left = math.exp(-step_s / self._closes_s)
        return replace(
            then,
            x_m=then.x_m + (motion.x_m - now.x_m) * left,
            y_m=then.y_m + (motion.y_m - now.y_m) * left,
            yaw_rad=math.remainder(then.yaw_rad + now.turn_rad(motion) * left, TAU),
        )


class Limited(Predictor):
    """What another says, as far as the robot can have done it: a plan that jumps, or an acceleration that was measured
    wrong, leads nobody away faster than at these speeds."""

    def __init__(self, predictor: Predictor, max_speed_mps: float, max_yaw_rate_radps: float) -> None:
        self._predictor = predictor
        self._max_speed_mps = max_speed_mps
        self._max_yaw_rate_radps = max_yaw_rate_radps

    def advance(self, motion: Motion, start_s: float, step_s: float, *, heard_s: float) -> Motion:
        then = self._predictor.advance(motion, start_s, step_s, heard_s=heard_s)
        if not then.finite:
            return replace(motion, twist=STILL)
        way_m, most_m = motion.distance_m(then), self._max_speed_mps * step_s
        turn, most_rad = motion.turn_rad(then), self._max_yaw_rate_radps * step_s
        too_fast = then.speed_mps > self._max_speed_mps or abs(then.twist.yaw_radps) > self._max_yaw_rate_radps
        if way_m <= most_m and abs(turn) <= most_rad and not too_fast:
            return then
        share = min(1.0, most_m / way_m) if way_m > 0 else 1.0
        slower = min(1.0, self._max_speed_mps / then.speed_mps) if then.speed_mps > 0 else 1.0
        twist = then.twist
        rate = min(max(twist.yaw_radps, -self._max_yaw_rate_radps), self._max_yaw_rate_radps)
        return replace(
            then,
            x_m=motion.x_m + (then.x_m - motion.x_m) * share,
            y_m=motion.y_m + (then.y_m - motion.y_m) * share,
            yaw_rad=math.remainder(motion.yaw_rad + min(max(turn, -most_rad), most_rad), TAU),
            twist=Twist(twist.forward_mps * slower, twist.left_mps * slower, rate),
        )


def _time_s(command: Command) -> float:
    return command.time_s
