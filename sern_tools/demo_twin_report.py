"""What `sern demo-twin` found: the promises of the twin judged, as a table, a page with plots, and JSON."""

import io
import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

from rich.console import Console

from sern_core.vocabulary.errors import SernError
from sern_tools import demo_promises
from sern_tools.demo_promises import Verdict

STEADY_M: Final = 0.05
RETURN_MEDIAN_M: Final = 0.05
RETURN_P95_M: Final = 0.07
RETURN_S: Final = 2.0
"""The end of a blackout that is looked at for the two above."""
BACK_S: Final = 3.0
HEARD_SHARE: Final = 0.05
"""While poses come the bound is of the 95th percentile of what they were off lately."""
GAP_S: Final = 0.5
"""Silence from here on is a gap, as sern-twin has it."""
COLOURS: Final = {"shown": "#1a7f37", "bound": "#0969da", "heard": "#bc4c00"}
BLACKOUT_COLOUR: Final = "#d0d7de"
DPI: Final = 130

Place = tuple[float, float, float]


class Sample(NamedTuple):
    """Where the robot was, where it thought it was, and where its twin showed it (x, y, yaw), and what the twin said of
    itself, at one moment."""

    at_s: float
    truth: Place
    thought: Place
    shown: Place
    age_s: float
    bound_m: float
    snaps: int
    violated: int
    goes_by: str
    says: str

    @property
    def off_m(self) -> float:
        return math.dist(self.truth[:2], self.shown[:2])

    @property
    def off_thought_m(self) -> float:
        """Its distance from where the robot thinks it is, which is all that it can say: localisation is off on top."""
        return math.dist(self.thought[:2], self.shown[:2])

    @property
    def off_deg(self) -> float:
        return abs(math.degrees(math.remainder(self.truth[2] - self.shown[2], math.tau)))


@dataclass(frozen=True)
class TwinReport:
    samples: tuple[Sample, ...]
    blackouts: tuple[tuple[float, float], ...]
    duration_s: float
    command: str
    verdicts: tuple[Verdict, ...]
    unhelped_m: tuple[float, ...]
    """How far off what was heard last is, at each sample: what there is to be seen without a twin."""

    @property
    def ok(self) -> bool:
        return all(verdict.kept for verdict in self.verdicts)


def judged(
    samples: Sequence[Sample], blackouts: tuple[tuple[float, float], ...], duration_s: float, command: str
) -> TwinReport:
    """SernError: nothing was seen."""
    if not samples:
        raise SernError("neither robot nor twin said where the robot is; --keep keeps their logs")
    unhelped_m = tuple(math.dist(each.truth[:2], _was(samples, each.at_s - each.age_s)[:2]) for each in samples)
    verdicts = [
        _steady(samples, blackouts),
        *(verdict for start_s, end_s in blackouts for verdict in _gap(samples, start_s, end_s)),
        *_within(samples),
        Verdict("snaps", str(samples[-1].snaps - samples[0].snaps), "0", samples[-1].snaps == samples[0].snaps),
    ]
    return TwinReport(tuple(samples), blackouts, duration_s, command, tuple(verdicts), unhelped_m)


def _was(samples: Sequence[Sample], at_s: float) -> Place:
    """Where the robot was then, as it was seen."""
    index = bisect_left([each.at_s for each in samples], at_s)
    if index in (0, len(samples)):
        return samples[min(index, len(samples) - 1)].truth
    before, after = samples[index - 1], samples[index]
    share = (at_s - before.at_s) / (after.at_s - before.at_s)
    return (
        before.truth[0] + share * (after.truth[0] - before.truth[0]),
        before.truth[1] + share * (after.truth[1] - before.truth[1]),
        before.truth[2],
    )


def _steady(samples: Sequence[Sample], blackouts: Sequence[tuple[float, float]]) -> Verdict:
    away = [(start_s, end_s + BACK_S) for start_s, end_s in blackouts]
    off_m = [each.off_m for each in samples if not any(start_s <= each.at_s <= end_s for start_s, end_s in away)]
    found_m = percentile(off_m, 0.95)
    return _below("while the link is there, p95", found_m, STEADY_M)


def _below(name: str, found_m: float, most_m: float) -> Verdict:
    return Verdict(name, _cm(found_m), f"≤ {_cm(most_m)}", found_m <= most_m)


def _gap(samples: Sequence[Sample], start_s: float, end_s: float) -> list[Verdict]:
    last = [each.off_m for each in samples if end_s - RETURN_S <= each.at_s < end_s]
    after = [each for each in samples if each.at_s >= end_s]
    back_s = next((each.at_s - end_s for each in after if each.off_m <= STEADY_M and each.age_s < 1.0), math.inf)
    median_m, p95_m = percentile(last, 0.5), percentile(last, 0.95)
    gone_s = end_s - start_s
    oldest_s = max((each.age_s for each in samples if start_s <= each.at_s < end_s), default=0.0)
    heard = oldest_s >= 0.8 * gone_s
    return [
        Verdict(f"gone for {gone_s:g} s: nothing was heard for", f"{oldest_s:.1f} s", f"≥ {0.8 * gone_s:.0f} s", heard),
        _below(f"after {gone_s:g} s: off, median", median_m, RETURN_MEDIAN_M),
        _below(f"after {gone_s:g} s: off, p95", p95_m, RETURN_P95_M),
        Verdict("back within 5 cm after the return", f"{back_s:.1f} s", f"≤ {BACK_S:g} s", back_s <= BACK_S),
    ]  # fmt: skip


def _within(samples: Sequence[Sample]) -> list[Verdict]:
    """Judge the bound: a promise in a gap, and while poses come one for 95 in 100 of them (`HEARD_SHARE`)."""
    gap = [each for each in samples if each.age_s >= GAP_S]
    heard = [each for each in samples if each.age_s < GAP_S]
    in_gap, in_gap_said = _over(gap)
    while_heard, while_heard_said = _over(heard)
    broken = in_gap + samples[-1].violated - samples[0].violated
    return [
        Verdict("unheard, further off than it said", in_gap_said, "0", not broken),
        Verdict("heard, further off than it said", while_heard_said, "≤ 5 %", while_heard <= HEARD_SHARE * len(heard)),
    ]


def _over(samples: Sequence[Sample]) -> tuple[int, str]:
    """How many were further off than was said, from where the robot thought it was, and that in words."""
    over = [each for each in samples if each.off_thought_m > each.bound_m]
    found = f"{len(over)} of {len(samples)}" + (
        f", worst {_cm(max(each.off_thought_m for each in over))}" if over else ""
    )
    return len(over), found


def percentile(values: Sequence[float], share: float) -> float:
    """Infinite where there is none."""
    ordered = sorted(values)
    return ordered[min(int(share * len(ordered)), len(ordered) - 1)] if ordered else math.inf


def _cm(metres: float) -> str:
    return f"{100 * metres:.1f} cm" if math.isfinite(metres) else "nothing seen"


# What is shown of it -------------------------------------------------------------------------------------------------


def show(report: TwinReport, console: Console) -> None:
    demo_promises.show(report.verdicts, console)
    worst_m = max(report.unhelped_m)
    console.print(f"what was heard last was up to {worst_m:.2f} m from the robot", highlight=False)


def write(report: TwinReport, out: Path) -> list[Path]:
    """JSON, and a page with plots where matplotlib is."""
    return demo_promises.write(out, "twin", as_json(report), partial(plots, report), partial(as_html, report))


def as_json(report: TwinReport) -> dict[str, Any]:
    return {
        "command": report.command,
        "blackouts_s": [list(each) for each in report.blackouts],
        "promises": [verdict._asdict() for verdict in report.verdicts],
        "samples": [
            {**each._asdict(), "off_m": each.off_m, "off_deg": each.off_deg, "heard_last_off_m": unhelped_m}
            for each, unhelped_m in zip(report.samples, report.unhelped_m, strict=True)
        ],
    }


def as_html(report: TwinReport, plotted: bytes | None) -> str:
    return demo_promises.page(
        "The twin through a blackout", report.command, report.verdicts, plotted, shows="error, bound and way"
    )


def plots(report: TwinReport) -> bytes:
    """Error and bound over time, and the way of robot and twin in the last blackout."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.6, 6.4), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    over: Any
    way: Any
    over, way = figure.subplots(2, 1, height_ratios=[3, 2])
    times = [each.at_s for each in report.samples]
    for start_s, end_s in report.blackouts:
        over.axvspan(start_s, end_s, color=BLACKOUT_COLOUR, linewidth=0, zorder=0)
    lines = (
        ("it may be off by (said)", "bound", [each.bound_m for each in report.samples]),
        ("heard last, off by", "heard", report.unhelped_m),
        ("twin, truly off by", "shown", [each.off_m for each in report.samples]),
    )
    for label, colour, values in lines:
        over.plot(times, [max(value, 1e-3) for value in values], label=label, color=COLOURS[colour], linewidth=1.3)
    over.set_yscale("log")
    over.set_ylabel("metres")
    over.set_xlabel("time, s (grey: the link is gone)")
    over.set_xlim(0, report.duration_s)
    over.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, frameon=False)
    start_s, end_s = report.blackouts[-1] if report.blackouts else (0.0, report.duration_s)
    gap = [each for each in report.samples if start_s <= each.at_s <= end_s] or list(report.samples)
    way.plot([e.truth[0] for e in gap], [e.truth[1] for e in gap], color="black", linewidth=2.5, label="robot, truly")
    way.plot([e.shown[0] for e in gap], [e.shown[1] for e in gap], color=COLOURS["shown"], linewidth=1.2, label="twin")
    way.plot([gap[0].truth[0]], [gap[0].truth[1]], "o", color=COLOURS["heard"], label="heard last")
    way.set_aspect("equal", adjustable="datalim")
    way.set_xlabel("metres, while the link is gone")
    way.legend(loc="upper right", frameon=False)
    for axes in (over, way):
        axes.grid(visible=True, linewidth=0.4, alpha=0.6)
        axes.spines[["top", "right"]].set_visible(False)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()
