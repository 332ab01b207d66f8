"""What a link is taken to carry after it seems to have got faster, until traffic has shown it.

An estimate of the capacity grows only with traffic: what a thin link was thinned to fills no better one, so nobody
would ever see that it is one. So where there is reason to think that it got better, it is taken to be as good as it was
at its best, and what then is sent proves it, or finds the estimate grown to what there is. Reasons are packets that
take less time than they can on the known link (`CapacityEstimator.eased_s`) and an estimate that grew, both at once;
and time: where messages are left out, a link of TIMED_GAIN times the estimate is tried for TRIED intervals of every
TIMED_INTERVALS, so that trials have a tenth.
"""

from collections import deque
from typing import Final

from sern_core.adaptation.model import ClassOutcome

TRIED: Final = 2
"""Intervals until a trial is judged: in the first the estimate grows."""
RISES: Final = 1.2
"""An estimate that has become so many times what it was an interval ago is on its way: the trial is judged later. On
long round trips it takes several intervals."""
REST_INTERVALS: Final = (5, 40)
"""After a trial that failed, unless the estimate grows: twice as many each time, so that over the minutes trials have
less than a tenth of the time, and so of the link."""
TIMED_INTERVALS: Final = 20
TIMED_GAIN: Final = 2.0
GREW: Final = 1.5
"""An estimate that is so many times the least of the last GREW_INTERVALS has been held down by what was sent."""
GREW_INTERVALS: Final = 3
POOR: Final = 0.8
"""A share of what a class was let in: where less arrives in time, the link does not carry it."""
ENOUGH: Final = 0.9
"""A share of what is assumed: an estimate that has come so far needs no help."""
FELL: Final = 0.75
"""A share of its greatest value in a trial: an estimate below that has seen the link get slower."""


class CapacityTrial:
    """The trial of one hop; `read` it for every reading of the capacity, `judge` it once an interval."""

    def __init__(self, interval_s: float, *, assumed_min_bps: float) -> None:
        """`assumed_min_bps`: what is assumed of a link that was never better."""
        self._interval_s = interval_s
        self._best_bps = assumed_min_bps
        self._assumed_bps: float | None = None
        self._greatest_bps = 0.0  # estimate during the trial
        self._judged_bps = 0.0  # the same when the last interval was over
        self._intervals = 0
        self._timed = False
        self._eased_s: float | None = None  # what was acted upon
        self._rest_until_s = 0.0
        self._rest_intervals = REST_INTERVALS[0]
        self._due_s: float | None = None
        self._estimates_bps: deque[float] = deque(maxlen=GREW_INTERVALS)

    @property
    def assumed_bps(self) -> float | None:
        """What the link is taken to carry; None: what the estimate says."""
        return self._assumed_bps

    def read(self, estimate_bps: float | None) -> float | None:
        """The capacity to go by. None: nothing comes through; then there is nothing to assume either."""
        if estimate_bps is None:
            self._assumed_bps = None
            return None
        self._best_bps = max(self._best_bps, estimate_bps)
        if self._assumed_bps is None:
            return estimate_bps
        self._greatest_bps = max(self._greatest_bps, estimate_bps)
        if estimate_bps < FELL * self._greatest_bps or estimate_bps >= ENOUGH * self._assumed_bps:
            self._assumed_bps = None
            return estimate_bps
        return self._assumed_bps

    def judge(
        self,
        estimate_bps: float | None,
        eased_s: float,
        outcomes: tuple[ClassOutcome, ...],
        *,
        thinned: bool,
        summarised: bool,
        now: float,
    ) -> None:
        """An interval has passed: end a trial, or begin one. `thinned`: messages are left out; `summarised`: summaries
        go in their place, and `levels.RawProbe` looks after the time."""
        eased = self._eased_s is not None and eased_s > self._eased_s
        self._eased_s = eased_s
        if estimate_bps is None:
            self._due_s = None
            self._estimates_bps.clear()
            return
        grew = bool(self._estimates_bps) and estimate_bps > GREW * min(self._estimates_bps)
        self._estimates_bps.append(estimate_bps)
        grew, eased = grew and (thinned or summarised), eased and (thinned or summarised)
        if self._assumed_bps is not None:
            self._intervals += 1
            rises = self._greatest_bps > RISES * self._judged_bps
            self._judged_bps = self._greatest_bps
            if self._intervals >= TRIED and not rises:
                self._end(outcomes, now)
            return
        if not thinned or summarised:
            self._due_s = None
        elif self._due_s is None:
            self._due_s = now + TIMED_INTERVALS * self._interval_s
        due = self._due_s is not None and now >= self._due_s
        if grew or (now >= self._rest_until_s and (eased or due)):
            timed = not (grew or eased)
            self._begin(TIMED_GAIN * estimate_bps if timed else self._best_bps, estimate_bps, timed=timed)

    def _begin(self, assumed_bps: float, estimate_bps: float, *, timed: bool) -> None:
        self._due_s = None
        if estimate_bps < ENOUGH * assumed_bps:
            self._assumed_bps, self._intervals = assumed_bps, 0
            self._greatest_bps = self._judged_bps = estimate_bps
            self._timed = timed

    def _end(self, outcomes: tuple[ClassOutcome, ...], now: float) -> None:
        assert self._assumed_bps is not None
        if any(outcome.on_time < POOR * outcome.admitted for outcome in outcomes):
            self._assumed_bps = None
            self._rest_until_s = now + self._rest_intervals * self._interval_s
            self._rest_intervals = min(2 * self._rest_intervals, REST_INTERVALS[1])
            return
        self._rest_intervals = REST_INTERVALS[0]
        if self._timed:
            self._assumed_bps *= TIMED_GAIN
            self._intervals = 0
