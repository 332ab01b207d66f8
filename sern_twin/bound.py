"""How far the twin can be from the robot after a gap: the paper's eq. (gap_bound) and Proposition finite_horizon_gap.

A bound holds as long as what it assumes does. `GapReport` says after the gap what was assumed, what was found, and
whether the bound was kept; nothing here hides that it was not.
"""

import math
from collections import deque
from dataclasses import dataclass
from typing import Final

from sern_core.vocabulary.errors import UsageError

MISMATCHES: Final = 512
"""How many of the last mismatches the least bound of acceleration is taken from."""


def velocity_bound_mps(error_mps: float, mismatch_mps2: float, gap_s: float) -> float:
    """Eq. (gap_bound), first line: |e_v| after the gap."""
    return error_mps + mismatch_mps2 * gap_s


def position_bound_m(error_m: float, error_mps: float, mismatch_mps2: float, gap_s: float) -> float:
    """Eq. (gap_bound), second line: B(τ) = |e_p| + |e_v| τ + ½ ā τ²."""
    return error_m + error_mps * gap_s + mismatch_mps2 * gap_s**2 / 2


def reachable_bound_m(
    error_m: float, error_mps: float, mismatch_mps2: float, gap_s: float, max_speed_mps: float
) -> float:
    """B_eff(τ): B(τ), and no more than two robots of this top speed get apart; at 30 s B alone says nothing."""
    bound_m = position_bound_m(error_m, error_mps, mismatch_mps2, gap_s)
    return min(bound_m, error_m + 2 * max_speed_mps * gap_s)


def lipschitz_bound(
    error: float, state_constant: float, input_constant: float, input_mismatch: float, gap_s: float
) -> float:
    """Proposition finite_horizon_gap: e(t₀) e^{L_x τ} + (L_u / L_x)(e^{L_x τ} - 1) δ_max.

    `state_constant` is L_x [1/s]; at 0 it is the limit, e(t₀) + L_u τ δ_max. Infinite where that is more than a float.
    """
    try:
        grown = math.expm1(state_constant * gap_s)
    except OverflowError:
        return math.inf if error > 0 or input_constant * input_mismatch > 0 else 0.0
    time_s = grown / state_constant if state_constant > 0 else gap_s
    return error * (1 + grown) + input_constant * time_s * input_mismatch


class Mismatch:
    """ā: the 95th percentile of the last mismatches between predicted and found acceleration [m/s²].

    It is `least_mps2` at the least, which is all there is before anything was found.
    """

    def __init__(self, least_mps2: float) -> None:
        if not (math.isfinite(least_mps2) and least_mps2 >= 0):
            raise UsageError(f"the least mismatch is {least_mps2} m/s²: give a number from 0 up")
        self._least_mps2 = least_mps2
        self._found: deque[float] = deque(maxlen=MISMATCHES)
        self._bound_mps2: float | None = None

    def found(self, mismatch_mps2: float) -> None:
        """UsageError: not finite."""
        if not math.isfinite(mismatch_mps2):
            raise UsageError(f"a mismatch of {mismatch_mps2} m/s² is none")
        self._found.append(abs(mismatch_mps2))
        self._bound_mps2 = None

    @property
    def bound_mps2(self) -> float:
        if self._bound_mps2 is None:
            ordered = sorted(self._found)
            high = ordered[math.ceil(0.95 * len(ordered)) - 1] if ordered else 0.0
            self._bound_mps2 = max(self._least_mps2, high)
        return self._bound_mps2


@dataclass(frozen=True, slots=True, kw_only=True)
class GapReport:
    """One gap: what was known when it began, what was bounded, and what was found when it ended."""

    gap_s: float
    start_error_m: float
    start_error_mps: float
    mismatch_mps2: float
    max_speed_mps: float
    error_m: float
    """The estimate's, at the first message after the gap, against the twin's own past at its stamp."""
    end_error_m: float
    """How far off that message may be itself."""
    shown_error_m: float | None
    """The same of the twin as it was shown; None where that is no longer known."""

    @property
    def bound_m(self) -> float:
        """B(τ) of eq. (gap_bound)."""
        return position_bound_m(self.start_error_m, self.start_error_mps, self.mismatch_mps2, self.gap_s)

    @property
    def reachable_m(self) -> float:
        """B_eff(τ)."""
        return reachable_bound_m(
            self.start_error_m, self.start_error_mps, self.mismatch_mps2, self.gap_s, self.max_speed_mps
        )

    @property
    def ratio(self) -> float:
        """Found over bounded; infinite when nothing was allowed and something was found."""
        if self.reachable_m > 0:
            return self.error_m / self.reachable_m
        return math.inf if self.error_m > 0 else 0.0

    @property
    def violated(self) -> bool:
        """An assumption did not hold: the robot did something else than was predicted.

        What the message that ended the gap is off by itself is no part of what was predicted.
        """
        return self.error_m > self.reachable_m + self.end_error_m
