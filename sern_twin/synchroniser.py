"""The twin of one robot: takes what is heard of it, goes on without, and is led back smoothly (the paper's section
"Physics Aware Synchronization").

The estimate is set by each measurement at its stamp and predicted from there to now; the shown twin is the estimate
and an offset that is led to nothing (sern_twin/correction.py). Both are kept for `HISTORY_S`: a measurement is compared
with the twin as it was at its stamp, and not as it is now. Every measurement has an outcome, and all are counted.
All times, stamps too, are seconds of one clock; whoever hears the robot has corrected its stamps.
"""

import math
from bisect import bisect_right
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Final

from sern_core.vocabulary.errors import UsageError
from sern_twin.bound import GapReport, Mismatch, reachable_bound_m
from sern_twin.correction import CorrectionOptions, Offset, Outage
from sern_twin.motion import MOST_M, TAU, Motion
from sern_twin.predictors import MOST_STEPS, SOON_S, Limited, Predictor

HISTORY_S: Final = 2.0
TRIAL_S: Final = 0.5
"""How far ahead each prediction is tried while the robot is heard, to learn how wrong it gets."""
JUMP_M: Final = 0.5
TOO_MUCH: Final = 1.5
"""Times its limit: what is measured is noisy. More is a fault, and would lead the twin away at that speed."""
MOST_S: Final = 1e10
"""Nothing that is told now is of 300 years ago."""


class Outcome(Enum):
    """What became of a measurement."""

    TAKEN = "taken"
    RELOCATED = "relocated"
    """Taken: several in a row said the same other place, so the robot is there."""
    RESTARTED = "restarted"
    """Taken: for `restart_s` all stamps were older than what is known, and rose: the robot's clock was set back."""
    OLD = "old"
    """Not newer than what is known."""
    NOT_FINITE = "not_finite"
    IMPLAUSIBLE = "implausible"
    """Faster than the robot can be, further away than there are places, or longer ago than there are robots."""
    FUTURE = "future"
    JUMP = "jump"
    """Further away than the robot can have gone."""


TAKEN: Final = frozenset({Outcome.TAKEN, Outcome.RELOCATED, Outcome.RESTARTED})
"""Those of measurements that are what is known now."""


@dataclass(frozen=True, slots=True)
class SynchroniserOptions:
    """UsageError: a number that is not above 0, or not finite."""

    max_speed_mps: float = 2.0
    """The robot's top speed; it is not measured to be more than `TOO_MUCH` times as fast."""
    max_yaw_rate_radps: float = 6.0
    max_accel_mps2: float = 10.0
    max_yaw_accel_radps2: float = 40.0
    error_m: float = 0.02
    error_mps: float = 0.05
    """How far off a measurement may be: e_p and e_v at the start of each gap."""
    least_mismatch_mps2: float = 0.05
    """ā at the least, before anything was learned of the robot."""
    gap_s: float = 0.5
    """Silence from here on is a gap, which is reported when it ends."""
    future_s: float = 0.25
    """Stamps may be so far ahead: what the two clocks are off."""
    jump_m: float = JUMP_M
    """A measurement may be so much further away than the robot can have gone."""
    agreeing: int = 3
    """The robot is where so many measurements in a row say it is that were too far away and agree."""
    restart_s: float = 2.0
    """After so long of stamps that are older than what is known, they are believed."""
    moving_mps: float = 0.1
    """A robot that is slower than half of this stands."""
    correction: CorrectionOptions = field(default_factory=CorrectionOptions)

    def __post_init__(self) -> None:
        for name in self.__slots__:
            value = getattr(self, name)
            if name != "correction" and not (math.isfinite(value) and value > 0):
                raise UsageError(f"synchroniser: {name} is {value}: give a number above 0")


@dataclass(frozen=True, slots=True)
class Twin:
    """What is known of a robot at a moment, with how old and how wrong it may be: all that shows it shows these."""

    shown: Motion
    """What to show: it never jumps."""
    estimate: Motion
    """What is known: it may."""
    age_s: float
    """Since the stamp of the last measurement."""
    error_m: float
    """How far the shown twin can be from the robot: the estimate's bound, and what is shown beside it."""
    outside: bool
    """A gap ended further off than its bound, and what is shown is not back yet: what was assumed of the robot did not
    hold."""


@dataclass(frozen=True, slots=True)
class Gap:
    """A gap that has ended. `stopped`: the robot was to move and stands."""

    report: GapReport
    stopped: bool


@dataclass(slots=True)
class _Moment:
    time_s: float
    estimate: Motion
    shown: Motion


class Synchroniser:
    """`twin(now)` is the robot as it is to be shown, None before it was heard. `counts` counts outcomes."""

    def __init__(self, predictor: Predictor, options: SynchroniserOptions | None = None) -> None:
        self._options = options or SynchroniserOptions()
        self._predictor = self._limited(predictor)
        self._offset = Offset(self._options.correction)
        self._outage: Outage | None = None
        self._mismatch = Mismatch(self._options.least_mismatch_mps2)
        self._heard_s = -math.inf
        """The stamp of the newest measurement."""
        self._heard: Motion | None = None
        self._now_s = -math.inf
        self._estimate: Motion | None = None
        self._history: deque[_Moment] = deque()
        self._strange: list[tuple[float, Motion]] = []
        """Measurements in a row that were too far away."""
        self._trial: tuple[float, Motion] | None = None
        self._old: tuple[float, float] | None = None
        """Since when nothing but old measurements came, and the stamp of the last one."""
        self._counts = dict.fromkeys(Outcome, 0)
        self._outside = False

    @property
    def counts(self) -> Mapping[Outcome, int]:
        return self._counts

    @property
    def snaps(self) -> int:
        """How often the shown twin was set to the estimate because it was too far from it."""
        return self._offset.snaps

    @property
    def correction_mps(self) -> float:
        """How fast what is shown is led beside what is known."""
        return self._offset.speed_mps

    def predict_with(self, predictor: Predictor, *, now: float) -> None:
        """Go on with another predictor from now: a plan came, or it is over. The shown twin does not jump."""
        self._advance(now)
        self._predictor = self._limited(predictor)
        self._trial = None

    def twin(self, *, now: float) -> Twin | None:
        """A clock that goes back gets what was shown last."""
        self._advance(now)
        if self._estimate is None or self._outage is None:
            return None
        age_s = max(0.0, self._now_s - self._heard_s)
        return Twin(
            self._shown(self._estimate), self._estimate, age_s, self._bound_m(age_s) + self._offset.distance_m,
            self._outside,
        )  # fmt: skip

    def measured(self, stamp_s: float, found: Motion, *, now: float) -> tuple[Outcome, Gap | None]:
        """The robot was at `found` at `stamp_s`. What became of it, and the gap that it ended, if it was one."""
        outcome = self._outcome(stamp_s, found, now)
        self._counts[outcome] += 1
        if outcome not in TAKEN:
            return outcome, None
        self._strange.clear()
        self._old = None
        self._advance(now)
        gap = None
        if outcome is Outcome.TAKEN:
            gap = self._gap(stamp_s, found, now)
            self._try_prediction(stamp_s, found)
        else:
            self._trial = None
        self._take(stamp_s, found, now)
        return outcome, gap

    # In here

    def _limited(self, predictor: Predictor) -> Limited:
        options = self._options
        return Limited(predictor, TOO_MUCH * options.max_speed_mps, TOO_MUCH * options.max_yaw_rate_radps)

    def _outcome(self, stamp_s: float, found: Motion, now: float) -> Outcome:
        if not (math.isfinite(stamp_s) and found.finite):
            return Outcome.NOT_FINITE
        if not self._plausible(found) or abs(now - stamp_s) > MOST_S:
            return Outcome.IMPLAUSIBLE
        if stamp_s > now + self._options.future_s:
            return Outcome.FUTURE
        if stamp_s <= self._heard_s:
            return self._outcome_of_old(stamp_s, now)
        if self._heard is None or not self._too_far(self._heard_s, self._heard, stamp_s, found):
            return Outcome.TAKEN
        if self._strange and self._too_far(*self._strange[-1], stamp_s, found):
            self._strange.clear()
        self._strange.append((stamp_s, found))
        return Outcome.RELOCATED if len(self._strange) >= self._options.agreeing else Outcome.JUMP

    def _plausible(self, found: Motion) -> bool:
        options, twist = self._options, found.twist
        return (
            max(abs(found.x_m), abs(found.y_m)) <= MOST_M
            and found.speed_mps <= TOO_MUCH * options.max_speed_mps
            and abs(twist.yaw_radps) <= TOO_MUCH * options.max_yaw_rate_radps
            and abs(found.forward_mps2) <= TOO_MUCH * options.max_accel_mps2
            and abs(found.yaw_radps2) <= TOO_MUCH * options.max_yaw_accel_radps2
        )

    def _outcome_of_old(self, stamp_s: float, now: float) -> Outcome:
        """What was overtaken comes beside what is newer. A clock that was set back gives nothing newer."""
        since_s = now if self._old is None or stamp_s <= self._old[1] else self._old[0]
        self._old = (since_s, stamp_s)
        return Outcome.RESTARTED if now - since_s >= self._options.restart_s else Outcome.OLD

    def _too_far(self, start_s: float, start: Motion, stamp_s: float, found: Motion) -> bool:
        can_m = self._options.max_speed_mps * abs(stamp_s - start_s) + self._options.jump_m
        return start.distance_m(found) > can_m

    def _bound_m(self, age_s: float) -> float:
        options = self._options
        return reachable_bound_m(
            options.error_m, options.error_mps, self._mismatch.bound_mps2, age_s, options.max_speed_mps
        )

    def _gap(self, stamp_s: float, found: Motion, now: float) -> Gap | None:
        """The gap that ends with this measurement, against the twin as it was at its stamp."""
        options = self._options
        if self._heard is None or self._outage is None or self._outage.silence_s(now=now) < options.gap_s:
            return None
        gap_s = stamp_s - self._heard_s
        # The first message after a gap may be an old one: then there is only what was predicted for its stamp.
        moment = self._moment(stamp_s)
        estimate = self._predicted(self._heard, self._heard_s, stamp_s) if moment is None else moment.estimate
        report = GapReport(
            gap_s=gap_s,
            start_error_m=options.error_m,
            start_error_mps=options.error_mps,
            mismatch_mps2=self._mismatch.bound_mps2,
            max_speed_mps=options.max_speed_mps,
            error_m=estimate.distance_m(found),
            end_error_m=options.error_m,
            shown_error_m=None if moment is None else moment.shown.distance_m(found),
        )
        self._outside = report.violated
        stopped = estimate.speed_mps > options.moving_mps and found.speed_mps < options.moving_mps / 2
        return Gap(report, stopped)

    def _try_prediction(self, stamp_s: float, found: Motion) -> None:
        """How wrong the predictor gets in `TRIAL_S`: the acceleration that would explain it is a sample of ā."""
        if self._trial is not None:
            start_s, start = self._trial
            length_s = stamp_s - start_s
            if length_s < TRIAL_S:
                return
            if length_s <= 2 * TRIAL_S:  # a gap tells of the gap, and not of what goes before one
                error_m = self._predicted(start, start_s, stamp_s).distance_m(found)
                explained_m = self._options.error_m + self._options.error_mps * length_s
                self._mismatch.found(2 * max(0.0, error_m - explained_m) / length_s**2)
        self._trial = (stamp_s, found)

    def _take(self, stamp_s: float, found: Motion, now: float) -> None:
        before = self._estimate
        self._heard_s, self._heard = stamp_s, found
        if self._outage is None:
            self._outage = Outage(self._options.correction.recovery_s, now=now)
            self._now_s = now
        self._outage.heard(now=now)
        # Predicted from its stamp to now; from one that is ahead of now it is as good as of now.
        self._estimate = self._predicted(found, stamp_s, self._now_s)
        if before is not None:
            x_mps, y_mps = self._estimate.velocity_mps()
            before_x_mps, before_y_mps = before.velocity_mps()
            self._offset.jumped(
                self._estimate.x_m - before.x_m,
                self._estimate.y_m - before.y_m,
                before.turn_rad(self._estimate),
                x_mps - before_x_mps,
                y_mps - before_y_mps,
            )
        self._remember()

    def _predicted(self, motion: Motion, start_s: float, end_s: float) -> Motion:
        """From a measurement on, in steps of the correction."""
        return self._predictor.reach(motion, start_s, end_s, self._options.correction.step_s, heard_s=start_s)

    def _advance(self, now: float) -> None:
        """Bring estimate and offset to this time, and remember them. The correction sees a minute of it at most."""
        if self._estimate is None or self._outage is None:
            return
        step_s = max(self._options.correction.step_s, (now - self._now_s) / MOST_STEPS)
        while now - self._now_s > SOON_S:
            part_s = min(step_s, now - self._now_s)
            self._estimate = self._predictor.advance(self._estimate, self._now_s, part_s, heard_s=self._heard_s)
            self._now_s += part_s
            gap_s = self._outage.gap_s(now=self._now_s)
            self._offset.step(min(part_s, self._options.correction.step_s), gap_s, self._estimate.speed_mps)
            if self._outside and self._offset.distance_m <= self._options.correction.tolerance_m:
                self._outside = False
            self._remember()

    def _shown(self, estimate: Motion) -> Motion:
        offset = self._offset
        return replace(
            estimate,
            x_m=estimate.x_m + offset.x_m,
            y_m=estimate.y_m + offset.y_m,
            yaw_rad=math.remainder(estimate.yaw_rad + offset.yaw_rad, TAU),
        )

    def _remember(self) -> None:
        assert self._estimate is not None
        history = self._history
        if history and history[-1].time_s >= self._now_s:
            history.pop()
        history.append(_Moment(self._now_s, self._estimate, self._shown(self._estimate)))
        while history[0].time_s < self._now_s - HISTORY_S:
            history.popleft()

    def _moment(self, time_s: float) -> _Moment | None:
        """The twin as it was then, between the two moments around; that of now for a later time. None: forgotten."""
        place = bisect_right(self._history, time_s, key=_time_s)
        if place == 0:
            return None
        if place == len(self._history):
            return self._history[-1]
        before, after = self._history[place - 1], self._history[place]
        share = (time_s - before.time_s) / (after.time_s - before.time_s)
        return _Moment(
            time_s, _between(before.estimate, after.estimate, share), _between(before.shown, after.shown, share)
        )


def _time_s(moment: _Moment) -> float:
    return moment.time_s


def _between(start: Motion, end: Motion, share: float) -> Motion:
    return replace(
        end,
        x_m=start.x_m + (end.x_m - start.x_m) * share,
        y_m=start.y_m + (end.y_m - start.y_m) * share,
        yaw_rad=math.remainder(start.yaw_rad + start.turn_rad(end) * share, TAU),
        twist=start.twist.towards(end.twist, share),
    )
