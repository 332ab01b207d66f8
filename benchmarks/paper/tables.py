"""The paper's tables and figures, ours beside what it prints."""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from statistics import fmean, median
from typing import Any, Final, NamedTuple

from benchmarks.navigation.statistics import wilson
from benchmarks.paper import published
from benchmarks.paper.claims import (
    PLANNED,
    RECONFIGURED,
    SYNC_BLACKOUT,
    SYNC_MODERATE,
    UNPREDICTED,
    Figures,
    MissingFigure,
)
from benchmarks.paper.published import BREAKDOWN, GAPS, MODES, POLICIES, RUNS
from benchmarks.paper.steps import drives as kept_drives

Rows = list[tuple[str, ...]]
SYSTEMS: Final = {"sern": "SERN", "tcpros": "ROS 1 (TCPROS)", "zmq": "plain ZMQ"}


class Section(NamedTuple):
    """A table of the paper. `why`: it could not be filled."""

    title: str
    label: str
    headings: tuple[str, ...] = ()
    rows: Sequence[tuple[str, ...]] = ()
    text: str = ""
    why: str = ""


def scalability(figures: Figures, _folder: Path) -> Section:
    """fig:aurora_comparison_agents."""
    rows: Rows = []
    for row in figures.rows("scaling"):
        half = f" ± {row['latency_half_ms']:.1f}" if "latency_half_ms" in row else ""
        theirs = figures.row("scaling", row["case"], "tcpros")
        less = [100 * (1 - row[metric] / theirs[metric]) for metric in ("latency_ms", "far_percent")]
        rows.append(
            (row["case"], SYSTEMS.get(row["system"], row["system"]), f"{row['latency_ms']:.1f}{half}",
             f"{row['p99_ms']:.1f}", f"{row['came_percent']:.0f}", f"{row['far_percent']:.1f}",
             f"{row['far_MB']:.0f}", f"{row['power_W']:.2f}", *(f"{each:+.0f}" for each in less))
        )  # fmt: skip
    if not rows:
        raise MissingFigure(figures.why("scaling"))
    low, high = published.LATENCY_SAVED_PERCENT
    return Section(
        "Scalability under replayed point clouds",
        "fig:aurora_comparison_agents",
        ("load", "system", "latency, ms", "p99, ms", "came, %", "CPU behind the link, %", "memory, MB", "power, W",
         "latency saved, %", "CPU saved, %"),
        rows,
        f"Saved: against a standard ROS setup (rospy over TCPROS). The paper: {low:g} to {high:g} % of latency and "
        f"about {published.LOAD_SAVED_PERCENT:g} % of load, on a link that it does not describe further. CPU, memory "
        "and power are of all processes behind the link, the subscriber among them. SERN encrypts, the others do not.",
    )  # fmt: skip


def synchronisation(figures: Figures, _folder: Path) -> Section:
    """tab:sync_summary."""
    settings = [
        (SYNC_MODERATE, PLANNED, "p95"),
        (SYNC_BLACKOUT, UNPREDICTED, "median"),
        (SYNC_BLACKOUT, PLANNED, "median"),
    ]
    rows: Rows = []
    for gap, (case, system, which) in zip(GAPS, settings, strict=True):
        row = figures.row("sync", case, system)
        ours = (f"{_cm(row[f'{which}_cm'])} ({which})", f"{row['p95_deg']:.1f}° (p95)")
        rows.append((gap.setting, gap.method, gap.position, ours[0], gap.rotation, ours[1]))
    last = figures.row("sync", SYNC_BLACKOUT, "last command")
    rows.append(
        ("blackout 30 s", "last control inputs, as the text has it", "≈ 5 cm",
         f"{_cm(last['median_cm'])} (median)", "< 3°", f"{last['p95_deg']:.0f}° (p95)")
    )  # fmt: skip
    for each in figures.rows("sync_lab"):
        if each["system"] == "with the robot's plan":
            name = each["case"].rpartition(": ")[2]
            rows.append(
                (
                    f"lab: {name}",
                    "SERN",
                    "< 5 cm",
                    f"{_cm(each['p95_cm'])} (p95)",
                    "< 2°",
                    f"{each['p95_deg']:.1f}° (p95)",
                )
            )
    return Section(
        "Synchronization under constrained communication",
        "tab:sync_summary",
        ("setting", "method", "paper: position", "ours", "paper: rotation", "ours"),
        rows,
        "SERN: robot and twin follow one trajectory over time, and the robot closes its loop on it. Rows of the lab "
        "are the installed daemons with keys over tc netem.",
    )


def _cm(offset_cm: float) -> str:
    """Tenths tell nothing of metres."""
    return f"{offset_cm:.1f} cm" if offset_cm < 100.0 else f"{offset_cm:,.0f} cm"


def _drives(path: Path) -> dict[str, list[dict[str, Any]]]:
    """The first drives of each mode, as many as the paper has trials, of the campuses of the headline."""
    from benchmarks.navigation.drives import Drive
    from benchmarks.navigation.episode import Mode

    usual = Drive(0, Mode.SERN)
    found: dict[str, dict[int, dict[str, Any]]] = {mode: {} for mode in MODES}
    for line in path.read_text(encoding="utf-8").splitlines():
        told = json.loads(line)
        if told["seed"] < RUNS and (told["accuracy"], told["link"]) == (usual.accuracy, usual.link.name):
            found[told["mode"]][told["seed"]] = told
    return {mode: list(drives.values()) for mode, drives in found.items()}


def navigation(figures: Figures, folder: Path) -> Section:
    """tab:baselines."""
    first = figures.row("navigation", "", "SERN")
    rows: Rows = []
    for mode, printed in MODES.items():
        rows.append(
            (mode, f"paper, n = {RUNS}",
             f"{printed.success_percent:g} ({printed.low_percent} to {printed.high_percent})",
             f"{printed.time_s:g} ± {printed.time_deviation_s:g}", f"{printed.interventions:g}")
        )  # fmt: skip
        row = figures.row("navigation", "", mode)
        rows.append(
            (mode, row["case"].split(",")[0],
             f"{row['success_percent']:.1f} ({row['from_percent']:.1f} to {row['to_percent']:.1f})",
             f"{row['time_median_s']:.1f}", f"{row['interventions_run']:.2f}")
        )  # fmt: skip
    path = kept_drives(folder)
    if path.exists():
        rows += [_small(mode, drives) for mode, drives in _drives(path).items() if len(drives) == RUNS]
    return Section(
        "Navigation: Real Only, Sim Only, SERN",
        "tab:baselines",
        ("mode", "of", "success, % (95 %)", "time to the goal, s", "interventions a drive"),
        rows,
        f"Ours: {first['case']}, simulated; intervals are Wilson's, times medians of the drives that reach the goal.",
    )


def _small(mode: str, drives: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
    """The row of as many trials as the paper has."""
    reached = [each["time_s"] for each in drives if each["reached"]]
    low, high = wilson(len(reached), len(drives))
    time_s = f"{median(reached):.1f}" if reached else "–"
    share = f"{100 * len(reached) / len(drives):.1f} ({100 * low:.1f} to {100 * high:.1f})"
    return (
        mode,
        f"the first {len(drives)} campuses",
        share,
        time_s,
        f"{fmean(each['interventions'] for each in drives):.2f}",
    )


def _mean(figures: Figures, step: str, profile: str, policy: str) -> dict[str, float]:
    """Terms and cost of a policy over all traces of a profile."""
    rows = [row for row in figures.rows(step) if row["case"].startswith(profile) and row["system"] == policy]
    if not rows:
        raise MissingFigure(figures.why(step))
    reliability = [row.get("reliability_1", 1.0 - row.get("unreliability_1", 0.0)) for row in rows]
    means = {name: fmean(row[f"{name}_1"] for row in rows) for name in ("cost", "latency", "compute", "bandwidth")}
    return {**means, "reliability": fmean(reliability), "plusminus": fmean(row.get("plusminus_1", 0.0) for row in rows)}


def _either(figures: Figures, step: str, profile: str, policy: str) -> dict[str, float] | None:
    try:
        return _mean(figures, step, profile, policy)
    except MissingFigure:
        return None


def costs(figures: Figures, _folder: Path) -> Section:
    """tab:mmcf_eval."""
    rows: Rows = []
    for profile, policies in BREAKDOWN.items():
        for policy, printed in policies.items():
            cells = [f"{printed.total:.2f}"]
            for step in ("mmcf_lab", "mmcf"):
                found = _either(figures, step, profile, POLICIES[policy])
                half = "" if found is None or not found["plusminus"] else f" ± {found['plusminus']:.3f}"
                cells.append("–" if found is None else f"{found['cost']:.3f}{half}")
            rows.append((profile, policy, *cells))
    if all(row[3:] == ("–", "–") for row in rows):
        raise MissingFigure(figures.why("mmcf"))
    return Section(
        "Cost of each policy",
        "tab:mmcf_eval",
        ("profile", "policy", "paper", "lab's link", "virtual time, all traces"),
        rows,
        "Lower is better. Weights and ranges are ours (see the errata): columns cannot be compared, rows can.",
    )


def breakdown(figures: Figures, _folder: Path) -> Section:
    """tab:mmcf_breakdown."""
    rows: Rows = []
    for profile, policies in BREAKDOWN.items():
        for policy, printed in policies.items():
            rows.append((profile, policy, "paper", *(f"{value:.2f}" for value in printed)))
            for step, name in (("mmcf_lab", "lab's link"), ("mmcf", "virtual time")):
                found = _either(figures, step, profile, POLICIES[policy])
                if found is not None:
                    terms = ("latency", "reliability", "compute", "bandwidth", "cost")
                    rows.append((profile, policy, name, *(f"{found[term]:.2f}" for term in terms)))
    if all(row[2] == "paper" for row in rows):
        raise MissingFigure(figures.why("mmcf"))
    return Section(
        "Terms of the cost",
        "tab:mmcf_breakdown",
        ("profile", "policy", "of", "latency", "reliability", "compute", "bandwidth", "cost"),
        rows,
    )


def reconfiguration(figures: Figures, _folder: Path) -> Section:
    """fig:runtime_reconfig_demo."""
    row = figures.row("reconfiguration", RECONFIGURED, "SERN")
    printed = (published.DETECTED_S, published.FORWARDED_S, published.REMOVED_S)
    names = ("detected", "forwarded", "removed")
    words = ("after it registers", "after it is detected", "after it ends")
    rows: Rows = [
        (f"{name} {word}", f"{limit_s:g} s", _time(row, name))
        for name, word, limit_s in zip(names, words, printed, strict=True)
    ]
    rows.append(("load with the third stream, two are 1", "moderately more", f"{row['load_during_1']:.2f}"))
    rows.append(("load after it", "as before", f"{row['load_after_1']:.2f}"))
    return Section(
        "A stream that comes and goes",
        "fig:runtime_reconfig_demo",
        ("figure", "paper", "ours"),
        rows,
        "Two real ROS masters, rospy nodes, the installed daemons with keys. Load: CPU of the bridge's processes.",
    )


def _time(row: Mapping[str, float], name: str) -> str:
    half = row.get(f"{name}_half_s")
    return f"{row[f'{name}_s']:.2f} s" + (f" ± {half:.2f}" if half else "")


ALL: Final[tuple[Callable[[Figures, Path], Section], ...]] = (
    scalability,
    synchronisation,
    navigation,
    costs,
    breakdown,
    reconfiguration,
)


def sections(figures: Figures, folder: Path) -> Iterator[Section]:
    """All of them, in the paper's order; `folder` is that of the results."""
    for make in ALL:
        try:
            yield make(figures, folder)
        except MissingFigure as missing:
            label = (make.__doc__ or "").rstrip(".")
            yield Section(make.__name__.capitalize(), label, why=str(missing))
