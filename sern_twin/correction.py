"""How the shown twin is led back to the robot after a gap: eqs. error_state, pd_correction and adaptive_gains.

There are two states. The estimate takes what is heard at once. The twin that is shown is the estimate and an `Offset`,
which takes up each jump of the estimate and is led to nothing: by acceleration, as the paper has it, within limits of
speed and acceleration, so that the shown twin never jumps. Only an offset of more than `snap_m` is dropped and counted.
Frame: the site's plane; metres, radians, seconds.
"""

import math
from dataclasses import dataclass

from sern_core.vocabulary.errors import UsageError
from sern_twin.motion import TAU


@dataclass(frozen=True, slots=True)
class Gains:
    """Kp [1/s²] and Kd [1/s]."""

    proportional: float
    derivative: float


@dataclass(frozen=True, slots=True)
class CorrectionOptions:
    """Defaults keep the offset damped whatever the gap: Kd decays half as fast as Kp, and its least is twice the root
    of that of Kp. Were both rates the same, and no least, 30 s of silence would leave a damping ratio of .05.

    UsageError: a gain, limit or rate below 0, a least above its most, or gains that a step of `step_s` makes unstable:
    the update is stable if and only if Kp > 0 and Kp T / 2 < Kd < 2 / T.
    """

    proportional: float = 16.0
    proportional_min: float = 0.25
    proportional_decay_per_s: float = 0.2
    derivative: float = 8.0
    derivative_min: float = 1.0
    derivative_decay_per_s: float = 0.1
    """The first gains are the most, too: Kp⁰ = Kp^max."""
    max_speed_mps: float = 0.5
    max_accel_mps2: float = 2.0
    max_yaw_rate_radps: float = 1.0
    max_yaw_accel_radps2: float = 4.0
    snap_m: float = 3.0
    tolerance_m: float = 0.02
    tolerance_rad: float = math.radians(1.0)
    tolerance_growth: float = 0.05
    """How much of the way that the robot would go in a gap is tolerated: α_ε is this times its speed."""
    recovery_s: float = 0.3
    """How fast a gap is forgotten once the robot is heard again."""
    step_s: float = 0.02
    """The longest step that `Offset.step` takes; longer ones are cut into such."""

    def __post_init__(self) -> None:
        for name in self.__slots__:
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise UsageError(f"correction: {name} is {value}: give a number from 0 up")
        if not (0 < self.proportional_min <= self.proportional and 0 < self.derivative_min <= self.derivative):
            raise UsageError("correction: the least gains are above 0, and not above the first ones")
        if not (self.step_s > 0 and self.recovery_s > 0):
            raise UsageError("correction: step_s and recovery_s are above 0")
        for gap_s in self._bends():
            gains = self.gains(gap_s)
            if not gains.proportional * self.step_s / 2 < gains.derivative < 2 / self.step_s:
                raise UsageError(
                    f"correction: gains of {gains.proportional:.3g} and {gains.derivative:.3g} after {gap_s:.3g} s are "
                    f"unstable in steps of {self.step_s} s: Kp T / 2 < Kd < 2 / T"
                )

    def _bends(self) -> tuple[float, ...]:
        """The gaps between which the ratio of the gains only falls or only rises."""
        return 0.0, *(
            math.log(first / least) / decay_per_s
            for first, least, decay_per_s in (
                (self.proportional, self.proportional_min, self.proportional_decay_per_s),
                (self.derivative, self.derivative_min, self.derivative_decay_per_s),
            )
            if decay_per_s > 0
        )

    def gains(self, gap_s: float) -> Gains:
        """Eq. (adaptive_gains): the longer the gap, the softer."""
        return Gains(
            max(self.proportional_min, self.proportional * math.exp(-self.proportional_decay_per_s * gap_s)),
            max(self.derivative_min, self.derivative * math.exp(-self.derivative_decay_per_s * gap_s)),
        )

    def band_m(self, gap_s: float, speed_mps: float) -> float:
        """The offset that is left alone: ε(τ) = ε₀ + α_ε τ."""
        return self.tolerance_m + self.tolerance_growth * abs(speed_mps) * gap_s


class Outage:
    """For how long nothing was heard, τ, as the gains are to see it.

    With τ = 0 at the first message the soft gains of a long gap would never act. So τ is kept as it was then, and is
    forgotten from there: τ = max(silence now, last silence · exp(-t / recovery_s)).
    """

    def __init__(self, recovery_s: float, *, now: float) -> None:
        self._recovery_s = recovery_s
        self._heard_s = now
        self._kept_s = 0.0

    def heard(self, *, now: float) -> None:
        """Something reliable came. A clock that goes back counts as no silence."""
        self._kept_s = self.gap_s(now=now)
        self._heard_s = now

    def silence_s(self, *, now: float) -> float:
        """Since when nothing came."""
        return max(0.0, now - self._heard_s)

    def gap_s(self, *, now: float) -> float:
        """τ of eqs. (pd_correction) and (adaptive_gains)."""
        silence_s = self.silence_s(now=now)
        return max(silence_s, self._kept_s * math.exp(-silence_s / self._recovery_s))


class Offset:
    """What the shown twin differs from the estimate by: x, y, yaw, and how fast it changes.

    `snaps` counts how often it was more than `snap_m` and was dropped.
    """

    def __init__(self, options: CorrectionOptions) -> None:
        self._options = options
        self.x_m = 0.0
        self.y_m = 0.0
        self.yaw_rad = 0.0
        self._x_mps = 0.0
        self._y_mps = 0.0
        self._yaw_radps = 0.0
        self.snaps = 0

    @property
    def distance_m(self) -> float:
        return math.hypot(self.x_m, self.y_m)

    @property
    def speed_mps(self) -> float:
        """How fast the shown twin moves against the estimate."""
        return math.hypot(self._x_mps, self._y_mps)

    @property
    def yaw_rate_radps(self) -> float:
        return self._yaw_radps

    def jumped(self, x_m: float, y_m: float, yaw_rad: float, x_mps: float = 0.0, y_mps: float = 0.0) -> None:
        """The estimate jumped so far, and its velocity by so much: the shown twin stays where it is, and as fast.

        UsageError: not finite; whoever estimates counts that and has no estimate of it.
        """
        if not all(map(math.isfinite, (x_m, y_m, yaw_rad, x_mps, y_mps))):
            raise UsageError(f"the estimate jumped by {(x_m, y_m, yaw_rad, x_mps, y_mps)}, which is no motion")
        self.x_m -= x_m
        self.y_m -= y_m
        self.yaw_rad = math.remainder(self.yaw_rad - yaw_rad, TAU)
        self._x_mps -= x_mps
        self._y_mps -= y_mps
        self._limit_speed()
        if self.distance_m > self._options.snap_m:
            self.snaps += 1
            self.x_m = self.y_m = self.yaw_rad = 0.0
            self._x_mps = self._y_mps = self._yaw_radps = 0.0

    def step(self, step_s: float, gap_s: float, robot_speed_mps: float = 0.0) -> None:
        """Lead it on by `step_s`. Within the band of this gap and speed it only comes to rest."""
        left_s = max(0.0, step_s)
        gains = self._options.gains(gap_s)
        band_m = self._options.band_m(gap_s, robot_speed_mps)
        while left_s > 0:
            part_s = min(left_s, self._options.step_s)
            self._step(part_s, gains, band_m)
            left_s -= part_s

    def _step(self, step_s: float, gains: Gains, band_m: float) -> None:
        options = self._options
        pull = gains.proportional if self.distance_m > band_m else 0.0
        x_mps2 = -pull * self.x_m - gains.derivative * self._x_mps
        y_mps2 = -pull * self.y_m - gains.derivative * self._y_mps
        much = math.hypot(x_mps2, y_mps2)
        if much > options.max_accel_mps2:
            x_mps2, y_mps2 = x_mps2 * options.max_accel_mps2 / much, y_mps2 * options.max_accel_mps2 / much
        before_x_mps, before_y_mps = self._x_mps, self._y_mps
        self._x_mps += x_mps2 * step_s
        self._y_mps += y_mps2 * step_s
        self._limit_speed()
        # The mean of both speeds: eq. (prediction_step), and no faster than the limit.
        self.x_m += (before_x_mps + self._x_mps) / 2 * step_s
        self.y_m += (before_y_mps + self._y_mps) / 2 * step_s

        pull = gains.proportional if abs(self.yaw_rad) > options.tolerance_rad else 0.0
        turn = -pull * self.yaw_rad - gains.derivative * self._yaw_radps
        turn = min(max(turn, -options.max_yaw_accel_radps2), options.max_yaw_accel_radps2)
        before_radps = self._yaw_radps
        rate = before_radps + turn * step_s
        self._yaw_radps = min(max(rate, -options.max_yaw_rate_radps), options.max_yaw_rate_radps)
        self.yaw_rad = math.remainder(self.yaw_rad + (before_radps + self._yaw_radps) / 2 * step_s, TAU)

    def _limit_speed(self) -> None:
        speed_mps = self.speed_mps
        if speed_mps > self._options.max_speed_mps:
            self._x_mps *= self._options.max_speed_mps / speed_mps
            self._y_mps *= self._options.max_speed_mps / speed_mps
