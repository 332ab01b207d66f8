"""What `sern demo-navigation` found: how each of the three ways went, the promises judged, and a picture from above."""

import html
import io
import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from rich.console import Console
from rich.table import Table

from sern_core.vocabulary.errors import SernError
from sern_tools import demo_promises
from sern_tools.demo_promises import Verdict

if TYPE_CHECKING:
    from sern_tools.demo_campus import Campus

SUCCEEDED: Final = "succeeded"
NEAR_M: Final = 0.6
"""The robot truly is so near the goal when it says that it is there: its tolerance, its size and what it is off."""
COLOURS: Final = {"Real Only": "#bc4c00", "Sim Only": "#8250df", "SERN": "#1a7f37"}
DPI: Final = 130


class Place(NamedTuple):
    """The true place of the robot, and what it was doing."""

    at_s: float
    x_m: float
    y_m: float
    state: str


class Ended(NamedTuple):
    """How the goal ended, as its client at the site was told."""

    how: str
    why: str


@dataclass(frozen=True)
class Drive:
    """`touched`: how often the robot ran into something. `flagged`: discrepancies that the twin showed, with when."""

    mode: str
    ended: Ended
    took_s: float
    places: tuple[Place, ...]
    touched: int
    travelled_m: float
    recoveries: int
    cycle_p99_ms: float | None
    flagged: tuple[dict[str, Any], ...]

    @property
    def succeeded(self) -> bool:
        return self.ended.how == SUCCEEDED

    @property
    def words(self) -> str:
        why = f" ({self.ended.why})" if self.ended.why else ""
        return f"{self.ended.how}{why} after {self.took_s:.0f} s and {self.travelled_m:.0f} m"


@dataclass(frozen=True)
class NavigationReport:
    drives: tuple[Drive, ...]
    place: "Campus"
    blackouts: tuple[tuple[float, float], ...]
    command: str
    verdicts: tuple[Verdict, ...]

    @property
    def ok(self) -> bool:
        return all(verdict.kept for verdict in self.verdicts)


def judged(
    drives: tuple[Drive, ...], place: "Campus", blackouts: tuple[tuple[float, float], ...], command: str
) -> NavigationReport:
    """SernError: no drive was seen."""
    from sern_tools.demo_campus import GOAL_M

    if not drives or not all(each.places for each in drives):
        raise SernError("nothing was seen of the robot; --keep keeps the logs")
    verdicts = [
        Verdict(f"{each.mode}: things that were run into", str(each.touched), "0", not each.touched) for each in drives
    ]
    by_mode = {each.mode: each for each in drives}
    sern, real = by_mode.get("SERN"), by_mode.get("Real Only")
    if sern is not None:
        last = sern.places[-1]
        away_m = math.dist((last.x_m, last.y_m), GOAL_M)
        verdicts.append(Verdict("SERN: the goal, as its client was told", sern.ended.how, SUCCEEDED, sern.succeeded))
        verdicts.append(Verdict("SERN: away from it, truly", f"{away_m:.2f} m", f"≤ {NEAR_M} m", away_m <= NEAR_M))
        phantoms = sum(each["kind"] == "phantom" for each in sern.flagged)
        verdicts.append(Verdict("SERN: logs that are not there, flagged", str(phantoms), "≥ 1", phantoms >= 1))
        moved_m = _moved_m(sern, blackouts)
        verdicts.append(Verdict("SERN: driven while the link was gone", f"{moved_m:.1f} m", "> 1 m", moved_m > 1.0))
        if real is not None and real.succeeded:
            faster = sern.took_s < real.took_s
            verdicts.append(Verdict("SERN: time to the goal", f"{sern.took_s:.0f} s", f"< {real.took_s:.0f} s", faster))
    return NavigationReport(drives, place, blackouts, command, tuple(verdicts))


def _moved_m(drive: Drive, blackouts: tuple[tuple[float, float], ...]) -> float:
    moved_m = 0.0
    for before, after in zip(drive.places, drive.places[1:], strict=False):
        if any(start_s <= before.at_s and after.at_s <= end_s for start_s, end_s in blackouts):
            moved_m += math.dist(before[1:3], after[1:3])
    return moved_m


def show(report: NavigationReport, console: Console) -> None:
    ways = Table("", "the goal", "after", "way", "recoveries", "run into", "flagged")
    for each in report.drives:
        ways.add_row(
            each.mode, each.ended.how, f"{each.took_s:.0f} s", f"{each.travelled_m:.0f} m", str(each.recoveries),
            str(each.touched), str(len(each.flagged)),
        )  # fmt: skip
    console.print(ways)
    demo_promises.show(report.verdicts, console)


def write(report: NavigationReport, out: Path) -> list[Path]:
    """JSON, and a page with the picture where matplotlib is."""
    return demo_promises.write(out, "navigation", as_json(report), partial(plot, report), partial(as_html, report))


def as_json(report: NavigationReport) -> dict[str, Any]:
    return {
        "command": report.command,
        "place": list(report.place.notes),
        "blackouts_s": [list(each) for each in report.blackouts],
        "promises": [verdict._asdict() for verdict in report.verdicts],
        "drives": [
            {
                "mode": each.mode,
                "ended": each.ended._asdict(),
                "took_s": each.took_s,
                "travelled_m": each.travelled_m,
                "touched": each.touched,
                "recoveries": each.recoveries,
                "cycle_p99_ms": each.cycle_p99_ms,
                "flagged": list(each.flagged),
                "places": [place._asdict() for place in each.places],
            }
            for each in report.drives
        ],
    }


def as_html(report: NavigationReport, plotted: bytes | None) -> str:
    ways = "".join(f"<li><b>{html.escape(each.mode)}</b>: {html.escape(each.words)}</li>" for each in report.drives)
    return demo_promises.page(
        "Three ways across a campus", report.command, report.verdicts, plotted, shows="the ways from above",
        more=f"<ul>{ways}</ul>",
    )  # fmt: skip


def plot(report: NavigationReport) -> bytes:
    """The place from above: what stands there, what only the twin has, and the ways; dashed while the link was gone."""
    import numpy as np
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    from sern_tools import demo_campus as course

    figure = Figure(figsize=(8.4, 8.0), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    axes: Any = figure.subplots()
    terrain, half_m = report.place.terrain, course.HALF_M
    extent = (-half_m, half_m, -half_m, half_m)
    axes.imshow(terrain.heights_m, origin="lower", extent=extent, cmap="Greens", alpha=0.35)
    occupied = np.ma.masked_equal(terrain.occupancy(400), 0)
    axes.imshow(occupied, origin="lower", extent=extent, cmap="Greys", vmin=0, vmax=140)
    for name, where, (length_m, width_m, _) in report.place.added():
        colour = "#cf222e" if name == "logs" else "#0969da"
        corner = (where.x_m - length_m / 2, where.y_m - width_m / 2)
        axes.add_patch(Rectangle(corner, length_m, width_m, fill=name == "logs", color=colour, linewidth=1.5, zorder=3))
        label = "logs: in the twin alone" if name == "logs" else "parked car"
        axes.annotate(
            label, (where.x_m, where.y_m), xytext=(6, 8), textcoords="offset points", color=colour, fontsize=8
        )
    for each in report.drives:
        colour = COLOURS.get(each.mode, "black")
        x, y = np.array([place.x_m for place in each.places]), np.array([place.y_m for place in each.places])
        gone = np.array([any(a <= place.at_s <= b for a, b in report.blackouts) for place in each.places])
        axes.plot(x, y, color=colour, linewidth=1.8, label=f"{each.mode}: {each.words}", zorder=4)
        axes.plot(
            np.where(gone, x, np.nan),
            np.where(gone, y, np.nan),
            color="white",
            linewidth=1.0,
            linestyle=(0, (2, 2)),
            zorder=5,
        )
        axes.plot(x[-1], y[-1], "o" if each.succeeded else "X", color=colour, markersize=9, zorder=6)
    axes.plot(course.START.x_m, course.START.y_m, "s", color="black", markersize=8, zorder=6)
    axes.plot(*course.GOAL_M, "*", color="black", markersize=14, zorder=6)
    axes.set_xlabel("metres to the east; white dashes: the link was gone")
    axes.set_ylabel("metres to the north")
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False, fontsize=8)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()
