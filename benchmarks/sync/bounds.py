"""The paper's bounds, and in how many gaps they are kept: eq. (gap_bound), Proposition finite_horizon_gap."""

import math
from random import Random
from statistics import median
from typing import Final, NamedTuple

from benchmarks.common import Report
from sern_sim.robot import STEP_S
from sern_twin.bound import lipschitz_bound, position_bound_m, velocity_bound_mps
from sern_twin.motion import Motion, Twist
from sern_twin.predictors import ConstantTwist
from sern_twin.synchroniser import Synchroniser, SynchroniserOptions

START_ERROR: Final = 0.001
"""How far off position [m] and speed [m/s] are known to be at most when a gap begins."""
STATE_CONSTANT, INPUT_CONSTANT = 1.0, 1.0
"""L_x [1/s] and L_u of a state of position and speed whose input is the acceleration."""
ONE_WAY_TIMES: Final = 3.0


class Gap(NamedTuple):
    """A gap: whether the twin reported it as violated, and its errors over what was bounded."""

    violated: bool
    position_ratio: float
    speed_ratio: float
    state_ratio: float
    looser_ratio: float
    """The proposition's bound over that of the equation."""


def bound(gaps: int, report: Report) -> None:
    """Robots that do anything within ā of the prediction, and robots that do three times that."""
    found = [_gap(Random(seed), 1.0, anyhow=True) for seed in range(gaps)]
    broken = sum(gap.violated for gap in found)
    report.row(
        "bound", "ā holds", tried_gaps=gaps, violated_gaps=broken,
        largest_over_bound=max(gap.position_ratio for gap in found),
        speed_violated_gaps=sum(gap.speed_ratio > 1.0 for gap in found),
        state_violated_gaps=sum(gap.state_ratio > 1.0 for gap in found),
        state_over_position_bound=median(gap.looser_ratio for gap in found),
    )  # fmt: skip
    wild = max(1, gaps // 10)
    told = sum(_gap(Random(seed), ONE_WAY_TIMES, anyhow=False).violated for seed in range(wild))
    report.row("bound", "three times ā, one way", tried_gaps=wild, violated_gaps=told)
    report.reach("bound violated where its assumptions hold, of all", float(broken), 0.0)
    report.reach("bound reported as violated where they do not, %", 100 * told / wild, 100, at_least=True)


def _gap(random: Random, times: float, *, anyhow: bool) -> Gap:
    """One gap of 0.6 to 10 s. `anyhow`: the acceleration turns every half second."""
    allowed_mps2 = random.uniform(0.05, 1.0)
    options = SynchroniserOptions(
        least_mismatch_mps2=allowed_mps2, max_speed_mps=50.0, error_m=START_ERROR, error_mps=START_ERROR
    )
    twin = Synchroniser(ConstantTwist(), options)
    start_s = 0.0
    x_m, y_m, x_mps, y_mps = 0.0, 0.0, 1.0, 0.0
    twin.measured(start_s, Motion(x_m, y_m, 0.0, Twist(1.0)), now=start_s)
    heading = random.uniform(0, 2 * math.pi)
    steps = random.randrange(30, 500)
    for step in range(steps):
        if anyhow and step % 25 == 0:
            heading = random.uniform(0, 2 * math.pi)
        x_mps2, y_mps2 = (times * allowed_mps2 * part for part in (math.cos(heading), math.sin(heading)))
        x_m += x_mps * STEP_S + x_mps2 * STEP_S**2 / 2
        y_m += y_mps * STEP_S + y_mps2 * STEP_S**2 / 2
        x_mps += x_mps2 * STEP_S
        y_mps += y_mps2 * STEP_S
    now = start_s + steps * STEP_S
    found = Motion(x_m, y_m, math.atan2(y_mps, x_mps), Twist(math.hypot(x_mps, y_mps)))
    _, gap = twin.measured(now, found, now=now)
    assert gap is not None
    error_m, error_mps = gap.report.error_m, math.hypot(x_mps - 1.0, y_mps)
    speed_mps = velocity_bound_mps(START_ERROR, allowed_mps2, now)
    state = lipschitz_bound(math.hypot(START_ERROR, START_ERROR), STATE_CONSTANT, INPUT_CONSTANT, allowed_mps2, now)
    looser = state / position_bound_m(START_ERROR, START_ERROR, allowed_mps2, now)
    return Gap(
        gap.report.violated, gap.report.ratio, error_mps / speed_mps, math.hypot(error_m, error_mps) / state, looser
    )
