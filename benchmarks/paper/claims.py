"""What the paper claims, and whether our runs bear it out."""

from collections.abc import Callable, Iterator, Sequence
from enum import StrEnum
from typing import Any, Final, NamedTuple

from benchmarks.paper import published
from benchmarks.paper.published import (
    DETECTED_S,
    FORWARDED_S,
    MODES,
    MOST_LATENCY,
    MOST_LOAD,
    OFFSET_CM,
    PATCHES_HZ,
    REMOVED_S,
    RUNS,
)
from benchmarks.paper.running import Result

SYNC_MODERATE: Final = "100 ms, 5 % loss, jitter 20 ms"
SYNC_BLACKOUT: Final = "blackout 30 s"
PLANNED: Final = "shared trajectory"
STOPPED: Final = "stop in the gap"
SMOOTH_MPS: Final = 0.5
"""What a correction may add to the twin's speed: SERN's default."""
ROUNDED: Final = 1.0 + 1e-9
"""A speed that is limited is off by what its last digit is rounded."""
BACK_1: Final = 0.1
"""How far off a load may be that is as before."""
UNPREDICTED: Final = "fixed gains, no prediction"
RECONFIGURED: Final = "a third stream comes and goes"
PATCHES: Final = "scene patches: 256 kbit/s, 0 % loss, poses at 20 Hz"


class Holds(StrEnum):
    """What can be said of a claim."""

    YES = "holds"
    NO = "does not hold"
    UNKNOWN = "cannot be told"


class Claim(NamedTuple):
    """A claim, where it is made, and what our runs say of it."""

    text: str
    where: str
    holds: Holds
    why: str


class Figures:
    """The figures of all steps."""

    def __init__(self, results: Sequence[Result]) -> None:
        self._results: dict[str, list[Result]] = {}
        for result in results:
            self._results.setdefault(result.step.name, []).append(result)

    def rows(self, step: str) -> list[dict[str, Any]]:
        """Those of a benchmark; empty where it was left out or failed."""
        return [
            row for result in self._results.get(step, ()) if result.found is not None for row in result.found["rows"]
        ]

    def row(self, step: str, case: str, system: str) -> dict[str, Any]:
        """The first whose case begins so. Raises MissingFigure."""
        for row in self.rows(step):
            if row["case"].startswith(case) and row["system"] == system:
                return row
        raise MissingFigure(self.why(step))

    def why(self, step: str) -> str:
        """Why a benchmark has no figure that is asked for."""
        results = self._results.get(step)
        if results is None:
            return f"{step} was not run"
        reasons = [result.why for result in results if result.why]
        return reasons[0] if reasons else f"{results[0].step.title}: no such figure"


class MissingFigure(Exception):  # noqa: N818  it is no error: a claim cannot be told
    """Why a figure is not there."""


def _steady(figures: Figures) -> tuple[bool, str]:
    row = figures.row("sync", SYNC_MODERATE, PLANNED)
    text = f"p95 {row['p95_cm']:.1f} cm and {row['p95_deg']:.1f}° at 100 ms with 5 % lost"
    return row["p95_cm"] < 5.0 and row["p95_deg"] < 2.0, text


def _lab(figures: Figures) -> tuple[bool, str]:
    rows = [row for row in figures.rows("sync_lab") if row["system"] == "with the robot's plan"]
    if not rows:
        raise MissingFigure(figures.why("sync_lab"))
    worst = max(rows, key=lambda row: float(row["p95_cm"]))
    name = worst["case"].rpartition(": ")[2]
    return worst["p95_cm"] < 5.0, f"p95 at the most {worst['p95_cm']:.1f} cm, over {name}, of {len(rows)} links"


def _gap(figures: Figures) -> tuple[bool, str]:
    ours, last = (figures.row("sync", SYNC_BLACKOUT, name) for name in (PLANNED, "last command"))
    return last["median_cm"] <= 10.0, (
        f"with the last control inputs {last['median_cm'] / 100:.0f} m in the median; {ours['median_cm']:.1f} cm where "
        "robot and twin follow one trajectory over time"
    )


def _fixed(figures: Figures) -> tuple[bool, str]:
    row = figures.row("sync", SYNC_BLACKOUT, UNPREDICTED)
    return row["median_cm"] > 20.0, f"{row['median_cm'] / 100:.1f} m in the median"


def _bound(metric: str) -> Callable[[Figures], tuple[bool, str]]:
    def told(figures: Figures) -> tuple[bool, str]:
        row = figures.row("sync", "bound", "ā holds")
        kept = row["tried_gaps"] - row[metric]
        return row[metric] == 0, f"kept in {kept:,.0f} of {row['tried_gaps']:,.0f} gaps whose assumptions hold"

    return told


def _state(figures: Figures) -> tuple[bool, str]:
    true, text = _bound("state_violated_gaps")(figures)
    looser = figures.row("sync", "bound", "ā holds")["state_over_position_bound"]
    return true, f"{text}, of 0.6 to 10 s; in the median it is {looser:,.0f} times the bound above, so it says little"


def _bounded(figures: Figures) -> tuple[bool, str]:
    """Whether gaps of half a minute keep to the bound, by the predictors that the twin may have."""
    systems = (PLANNED, "constant twist", "last command")
    rows = {system: figures.row("sync", SYNC_BLACKOUT, system) for system in systems}
    parts = [
        f"{system} {row['within_bound_percent']:.0f} % of gaps, bound {row['bound_m']:.3g} m, "
        f"error {row['median_cm'] / 100:.3g} m"
        for system, row in rows.items()
    ]
    return rows[PLANNED]["within_bound_percent"] == 100.0, f"in the median: {'; '.join(parts)}"


def _offset(figures: Figures) -> tuple[bool, str]:
    row = figures.row("sync", "scene patches: a new obstacle", "site to robot")
    median_cm, p95_cm = row["offset_median_cm"], row["offset_p95_cm"]
    text = f"{median_cm:.1f} cm in the median, {p95_cm:.1f} cm at p95 (paper: {OFFSET_CM} on average)"
    return median_cm <= OFFSET_CM, text


def _patches(figures: Figures) -> tuple[bool, str]:
    row = figures.row("sync", PATCHES, "robot to site")
    text = f"{row['told_hz']:.1f} of {row['moved_hz']:.1f} changes a second, over 256 kbit/s beside poses"
    return row["told_hz"] >= 0.95 * PATCHES_HZ, text


def _modes(figures: Figures) -> dict[str, dict[str, Any]]:
    """The row of each mode of navigation. Raises MissingFigure where there were fewer campuses than in the paper."""
    rows = {mode: figures.row("navigation", "", mode) for mode in MODES}
    campuses = int(rows["SERN"]["case"].split()[0])
    if campuses < RUNS:
        raise MissingFigure(f"it was measured on {campuses} campuses: a full run has more")
    return rows


def _success(figures: Figures) -> tuple[bool, str]:
    rows = _modes(figures)
    ours, others = rows["SERN"], [row for mode, row in rows.items() if mode != "SERN"]
    text = ", ".join(f"{mode} {row['success_percent']:.1f} %" for mode, row in rows.items())
    if all(ours["from_percent"] > row["to_percent"] for row in others):
        return True, text
    if any(ours["to_percent"] < row["from_percent"] for row in others):
        return False, text
    raise MissingFigure(f"{text}: their 95 % intervals overlap")


def _time(figures: Figures) -> tuple[bool, str]:
    rows = _modes(figures)
    times = {mode: row["time_median_s"] for mode, row in rows.items()}
    text = ", ".join(f"{mode} {time_s:.0f} s" for mode, time_s in times.items())
    for mode in MODES:
        case = f"where SERN and {mode} both reach the goal"
        both = [
            f"{row['system']} {row['time_median_s']:.1f} s" for row in figures.rows("navigation") if row["case"] == case
        ]
        text += f"; {case}: {', '.join(both)}" if both else ""
    return min(times, key=times.__getitem__) == "SERN", f"medians of drives that reach the goal: {text}"


def _help(figures: Figures) -> tuple[bool, str]:
    helped = {mode: row["interventions_run"] for mode, row in _modes(figures).items()}
    text = ", ".join(f"{mode} {count:.3f}" for mode, count in helped.items())
    return all(helped["SERN"] < count for mode, count in helped.items() if mode != "SERN"), f"a drive: {text}"


def _policies(step: str) -> Callable[[Figures], tuple[bool, str]]:
    def told(figures: Figures) -> tuple[bool, str]:
        parts, lowest = [], True
        for profile in published.BREAKDOWN:
            costs = _costs(figures, step, profile)
            lowest = lowest and min(costs, key=costs.__getitem__) == "mmcf"
            parts.append(f"{profile}: " + ", ".join(f"{name} {cost:.3f}" for name, cost in costs.items()))
        return lowest, "; ".join(parts)

    return told


def _costs(figures: Figures, step: str, profile: str) -> dict[str, float]:
    """The mean cost of each of the paper's policies over all traces of a profile."""
    found: dict[str, list[float]] = {}
    for row in figures.rows(step):
        if row["case"].startswith(profile) and row["system"] in published.POLICIES.values():
            found.setdefault(row["system"], []).append(float(row["cost_1"]))
    if len(found) < len(published.POLICIES):
        raise MissingFigure(figures.why(step))
    return {name: sum(costs) / len(costs) for name, costs in found.items()}


def _saved(link: str, metric: str, limit: float) -> Callable[[Figures], tuple[bool, str]]:
    """Whether SERN takes at most this share of what TCPROS takes, at every load over such a link."""

    def told(figures: Figures) -> tuple[bool, str]:
        rows = [
            row for row in figures.rows("scaling") if row["system"] == "sern" and row["case"].endswith(f"{link} link")
        ]
        if not rows:
            raise MissingFigure(figures.why("scaling"))
        shares = {row["case"]: row[metric] / figures.row("scaling", row["case"], "tcpros")[metric] for row in rows}
        text = "; ".join(f"{case.rpartition(',')[0]}: {100 * (share - 1):+.0f} %" for case, share in shares.items())
        return all(share <= limit for share in shares.values()), f"against TCPROS: {text}"

    return told


def _gradual(metric: str, unit: str) -> Callable[[Figures], tuple[bool, str]]:
    """Whether SERN takes less more than TCPROS does, from the fewest robots to the most, over every link."""

    def told(figures: Figures) -> tuple[bool, str]:
        cases: dict[str, list[float]] = {row["case"].partition(", ")[2]: [] for row in figures.rows("scaling")}
        if not cases:
            raise MissingFigure(figures.why("scaling"))
        for load, rises in cases.items():
            for system in ("sern", "tcpros"):
                rows = [
                    row for row in figures.rows("scaling") if row["case"].endswith(load) and row["system"] == system
                ]
                robots = {int(row["case"].split()[0]): float(row[metric]) for row in rows}
                if len(robots) < 2:
                    raise MissingFigure("it was measured with one number of robots: a full run has more")
                rises.append(robots[max(robots)] - robots[min(robots)])
        text = "; ".join(f"{load}: {ours:+.3g} against {theirs:+.3g} {unit}" for load, (ours, theirs) in cases.items())
        return all(ours <= theirs for ours, theirs in cases.values()), f"from the fewest robots to the most, {text}"

    return told


def _smooth(figures: Figures) -> tuple[bool, str]:
    rows = [figures.row("sync", STOPPED, f"{before} s before its end") for before in ("0.5", "1", "2")]
    fastest = max(float(row["correction_mps"]) for row in rows)
    text = (
        f"after a stop that nobody foresaw, 2 s before the link returns, it is there again in "
        f"{rows[-1]['back_s']:.1f} s, corrected by {fastest:.2g} m/s at the most"
    )
    return not any(row["snapped_percent"] for row in rows) and fastest <= SMOOTH_MPS * ROUNDED, text


def _load_back(figures: Figures) -> tuple[bool, str]:
    row = figures.row("reconfiguration", RECONFIGURED, "SERN")
    return abs(row["load_after_1"] - 1.0) <= BACK_1, (
        f"{row['load_during_1']:.2f} of the load of two streams with the third, {row['load_after_1']:.2f} after it"
    )


def _reconfigured(metric: str, limit_s: float) -> Callable[[Figures], tuple[bool, str]]:
    def told(figures: Figures) -> tuple[bool, str]:
        row = figures.row("reconfiguration", RECONFIGURED, "SERN")
        return row[metric] <= limit_s, f"{row[metric]:.2f} s (paper: about {limit_s:g})"

    return told


def _uninterrupted(figures: Figures) -> tuple[bool, str]:
    row = figures.row("reconfiguration", RECONFIGURED, "SERN")
    return row[
        "longest_s"
    ] <= 0.1, f"no pause of the others was longer than their period by more than {1e3 * row['longest_s']:.0f} ms"


SCALED: Final = "fig:aurora_comparison_agents"
CLAIMS: Final[tuple[tuple[str, str, Callable[[Figures], tuple[bool, str]]], ...]] = (
    (
        "Latency is 15 to 25 % less than ROS's, where the link is idle.",
        SCALED,
        _saved("idle", "latency_ms", MOST_LATENCY),
    ),
    ("The same where the link is full.", SCALED, _saved("full", "latency_ms", MOST_LATENCY)),
    ("Load is about 15 % less than ROS's, where the link is idle.", SCALED, _saved("idle", "far_percent", MOST_LOAD)),
    ("The same where the link is full.", SCALED, _saved("full", "far_percent", MOST_LOAD)),
    ("CPU rises more gradually with the number of robots.", SCALED, _gradual("far_percent", "% of a core")),
    ("So does memory.", SCALED, _gradual("far_MB", "MB")),
    ("In steady state the twin is within 5 cm and 2°.", "tab:sync_summary", _steady),
    ("The same over a real link.", "tab:sync_summary", _lab),
    (
        "After 30 s without a link, going on with the last control inputs, it is about 5 cm off.",
        "tab:sync_summary",
        _gap,
    ),
    ("Fixed gains without prediction are more than 20 cm off then.", "tab:sync_summary", _fixed),
    ("When updates resume, the twin is brought back smoothly.", "tab:sync_summary", _smooth),
    (
        "In a gap the position stays within the bound while the mismatch does.",
        "eq:gap_bound",
        _bound("violated_gaps"),
    ),
    ("So does the speed.", "eq:gap_bound", _bound("speed_violated_gaps")),
    ("So does the state, within a bound that grows exponentially.", "prop:finite_horizon_gap", _state),
    ("Gaps of 30 s are consistent with it.", "prop:finite_horizon_gap", _bounded),
    ("An added object is where it should be within 2.3 cm.", "Synchronization", _offset),
    ("Patches are applied at 10 Hz.", "Synchronization", _patches),
    ("SERN reaches the goal most often.", "tab:baselines", _success),
    ("SERN is the fastest there.", "tab:baselines", _time),
    ("SERN needs the least help.", "tab:baselines", _help),
    ("MMCF has the lowest cost in both profiles, in virtual time.", "tab:mmcf_eval", _policies("mmcf")),
    ("The same over the lab's link.", "tab:mmcf_eval", _policies("mmcf_lab")),
    ("A new stream is detected by itself.", "fig:runtime_reconfig_demo", _reconfigured("detected_s", DETECTED_S)),
    ("It is forwarded soon after.", "fig:runtime_reconfig_demo", _reconfigured("forwarded_s", FORWARDED_S)),
    ("It is removed when it ends.", "fig:runtime_reconfig_demo", _reconfigured("removed_s", REMOVED_S)),
    ("The load then goes back to what it was.", "fig:runtime_reconfig_demo", _load_back),
    ("Streams that go on are not interrupted.", "fig:runtime_reconfig_demo", _uninterrupted),
)


def claims(figures: Figures) -> Iterator[Claim]:
    """All of them, in the paper's order."""
    for text, where, judge in CLAIMS:
        try:
            true, why = judge(figures)
        except MissingFigure as missing:
            yield Claim(text, where, Holds.UNKNOWN, str(missing))
        else:
            yield Claim(text, where, Holds.YES if true else Holds.NO, why)
