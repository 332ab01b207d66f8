"""What the paper prints and arithmetic does not bear out: each with the sum that says so."""

from collections.abc import Callable, Iterator, Mapping
from math import exp, pi, radians, sin, sqrt
from typing import Final, NamedTuple

from benchmarks.navigation.statistics import wilson
from benchmarks.paper.published import BREAKDOWN, MODES, RUNS, Cost

ROUNDED: Final = 0.005
"""A figure of two decimals may be off by so much."""
WGS84_A_M: Final = 6_378_137.0
WGS84_E2: Final = 6.694379990e-3
SPHERE_M: Final = 6_371_000.0
SITE_LATITUDE_DEG: Final = 39.25
WEIGHTS: Final[Mapping[str, tuple[float, float, float, float]]] = {
    "teleoperation": (0.45, 0.30, 0.10, 0.15),
    "mapping": (0.10, 0.30, 0.15, 0.45),
}
"""SERN's (w_l, w_r, w_c, w_b)."""


class Erratum(NamedTuple):
    """What is printed where, what follows from it, and what was made of it."""

    label: str
    printed: str
    follows: str
    taken: str


Told = tuple[str, str, str]
"""What an erratum says beside where."""


def terms(cost: Cost) -> tuple[float, float, float, float]:
    """What the weights of a profile multiply: latency, 1 - R, compute, bandwidth."""
    return cost.latency, 1.0 - cost.reliability, cost.compute, cost.bandwidth


def least_weight(profile: str, index: int) -> float | None:
    """The least that a weight of the profile can be for its three printed totals, rounding included; None: no weights
    of 0 or more that add up to 1 give them."""
    from scipy.optimize import linprog

    bounds, above = [], []
    for cost in BREAKDOWN[profile].values():
        row = terms(cost)
        slack = ROUNDED * 2  # of the total, and of the terms: their weights add up to 1
        bounds += [list(row), [-each for each in row]]
        above += [cost.total + slack, slack - cost.total]
    wanted = [float(at == index) for at in range(4)]
    found = linprog(wanted, A_ub=bounds, b_ub=above, A_eq=[[1.0] * 4], b_eq=[1.0], bounds=[(0.0, 1.0)] * 4)
    return float(found.fun) if found.success else None


def totals(profile: str) -> dict[str, float]:
    """The costs of the printed terms with SERN's weights."""
    weights = WEIGHTS[profile]
    return {
        policy: sum(weight * term for weight, term in zip(weights, terms(cost), strict=True))
        for policy, cost in BREAKDOWN[profile].items()
    }


def fisher(one: str, other: str) -> float:
    """How likely two modes of tab:baselines differ so much or more if both are as good (Fisher, exact, two-sided)."""
    from scipy.stats import fisher_exact

    met = [round(MODES[name].success_percent / 100 * RUNS) for name in (one, other)]
    return float(fisher_exact([[each, RUNS - each] for each in met]).pvalue)


def wilson_percent(mode: str) -> tuple[float, float]:
    """The 95 % interval of a mode's success, in %."""
    low, high = wilson(round(MODES[mode].success_percent / 100 * RUNS), RUNS)
    return 100 * low, 100 * high


def tangent_error_percent(latitude_deg: float = SITE_LATITUDE_DEG) -> tuple[float, float]:
    """The error of the spherical tangent of eq:enu against the radii of WGS-84, north and east, in %."""
    flat = 1.0 - WGS84_E2 * sin(radians(latitude_deg)) ** 2
    meridian_m, normal_m = WGS84_A_M * (1.0 - WGS84_E2) / flat**1.5, WGS84_A_M / sqrt(flat)
    return 100 * (SPHERE_M / meridian_m - 1.0), 100 * (SPHERE_M / normal_m - 1.0)


def damping(decay_p: float, decay_d: float, tau_s: float, *, kp: float = 9.0, kd: float = 6.0) -> float:
    """The damping ratio that eq:adaptive_gains leaves after an outage, with no floors."""
    return kd * exp(-decay_d * tau_s) / (2.0 * sqrt(kp * exp(-decay_p * tau_s)))


def overshoot_percent(ratio: float) -> float:
    """How far a second-order system of that damping ratio goes past its goal; 0 from 1 on."""
    return 100 * exp(-pi * ratio / sqrt(1.0 - ratio**2)) if ratio < 1.0 else 0.0


def largest_mismatch(error_m: float, gap_s: float) -> float:
    """The acceleration mismatch, m/s², with which eq:gap_bound comes to this error, from none at the start."""
    return 2.0 * error_m / gap_s**2


def _totals() -> Told:
    least = least_weight("teleoperation", 2)
    ours = {profile: totals(profile) for profile in WEIGHTS}
    kept = all(min(costs, key=costs.__getitem__) == "MMCF" for costs in ours.values())
    printed = ", ".join(f"{cost.total:.2f}" for cost in BREAKDOWN["teleoperation"].values())
    got = ", ".join(f"{total:.2f}" for total in ours["teleoperation"].values())
    say = "no weights give these totals" if least is None else f"compute has to weigh {least:.2f} or more"
    return (
        f"Teleoperation puts more weight on latency; its totals are {printed}.",
        f"With the printed terms {say} for these totals.",
        f"Weights by the text (latency .45): the printed terms come to {got}. MMCF is "
        f"{'still the lowest in both profiles' if kept else 'no longer the lowest'}.",
    )


def _significance() -> Told:
    low, high = wilson_percent("Real Only")
    mode = MODES["Real Only"]
    return (
        f"95, 85 and 70 % of {RUNS} trials; 95 % interval of Real Only {mode.low_percent} to {mode.high_percent} %.",
        f"Fisher's exact test: SERN over Real Only p = {fisher('SERN', 'Real Only'):.2f}, over Sim Only "
        f"p = {fisher('SERN', 'Sim Only'):.2f}. Wilson's interval of Real Only is {low:.0f} to {high:.0f} %.",
        "400 paired campuses and McNemar's test, beside the paper's 20.",
    )


def _tangent() -> Told:
    north, east = tangent_error_percent()
    return (
        "A tangent on a sphere gives local coordinates.",
        f"At {SITE_LATITUDE_DEG}° it is off by {north:+.3f} % north and {east:+.3f} % east: 5 cm after "
        f"{0.05 / (abs(north) / 100):.0f} m north, and after {0.05 / (abs(east) / 100):.0f} m east.",
        "Radii of WGS-84; the paper's equation is kept as `paper`.",
    )


def _gains() -> Told:
    equal, half = damping(0.1, 0.1, 30.0), damping(0.2, 0.1, 30.0)
    return (
        "Both gains decay with the outage; nothing is said of how fast each does.",
        f"With equal rates of 0.1/s the damping ratio is {equal:.2f} after 30 s: the twin overshoots by "
        f"{overshoot_percent(equal):.0f} %. As an acceleration the correction is stable only while "
        "Kp·T/2 < Kd < 2/T.",
        f"Kd decays half as fast as Kp, which leaves the ratio at {half:.0f}; gains that are not stable are refused.",
    )


def _bound() -> Told:
    return (
        "A gap of 30 s ends with an error of about 5 cm while the twin follows the last control inputs.",
        f"The bound comes to 5 cm only with a mismatch of {largest_mismatch(0.05, 30.0):.1e} m/s² or less; recorded "
        "robots are off by metres.",
        "Robot and twin follow one trajectory over time (`plan_tracking`); the others are reported beside it.",
    )


def _reliability() -> Told:
    return (
        "Reliability is the share of what was sent that was on time.",
        "Whoever sends nothing has the best of it: the cheapest policy is then to send almost nothing.",
        "R is the share of what was offered, as far as it is needed.",
    )


ALL: Final[Mapping[str, Callable[[], Told]]] = {
    "tab:mmcf_eval, tab:mmcf_breakdown": _totals,
    "tab:baselines": _significance,
    "eq:enu": _tangent,
    "eq:adaptive_gains": _gains,
    "eq:gap_bound": _bound,
    "R = N_on-time / N_sent": _reliability,
}


def errata() -> Iterator[Erratum]:
    """All of them, in the order of the paper's results; of those that need scipy what to install, without it."""
    for label, told in ALL.items():
        try:
            yield Erratum(label, *told())
        except ImportError as error:
            yield Erratum(label, "", f"Left out: it needs {error.name}: pip install 'sern[twin]'", "")
