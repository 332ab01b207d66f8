"""The paper's figures, drawn from our own runs."""

import base64
import io
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final

from benchmarks.common import pyplot
from benchmarks.paper.claims import Figures
from benchmarks.paper.published import BEGIN_S, END_S
from benchmarks.paper.tables import SYSTEMS

METRICS: Final = {
    "latency_ms": "latency, ms",
    "far_percent": "CPU, % of a core",
    "far_MB": "memory, MB",
    "power_W": "power, W",
}
COLOURS: Final = {"sern": "tab:blue", "tcpros": "tab:orange", "zmq": "tab:green", "zenoh": "0.5"}


def scalability(plt: Any, figures: Figures) -> Any:
    """Each metric by the number of robots, a row for each size of cloud and kind of link."""
    found = figures.rows("scaling")
    cases = list(dict.fromkeys(row["case"].partition(", ")[2] for row in found))
    figure, grid = plt.subplots(
        len(cases), len(METRICS), figsize=(10, 0.6 + 2 * len(cases)), layout="constrained", squeeze=False
    )
    for axes_of_case, case in zip(grid, cases, strict=True):
        for axes, (metric, name) in zip(axes_of_case, METRICS.items(), strict=True):
            for system, colour in COLOURS.items():
                rows = [row for row in found if row["case"].endswith(case) and row["system"] == system]
                points = sorted((int(row["case"].split()[0]), float(row[metric])) for row in rows)
                axes.plot(
                    *zip(*points, strict=True),
                    marker="o",
                    markersize=3,
                    color=colour,
                    label=SYSTEMS.get(system, system),
                )
            if metric == "latency_ms" and case.endswith("full link"):
                axes.set(yscale="log")
            else:
                axes.set(ylim=(0, None))
            axes.set(xticks=sorted({int(row["case"].split()[0]) for row in found}))
            axes.set_title(name, fontsize=9)
            axes.tick_params(labelsize=8)
        axes_of_case[0].set_ylabel(case, fontsize=9)
    figure.supxlabel("robots", fontsize=9)
    lines, names = grid[0][0].get_legend_handles_labels()
    figure.legend(lines, names, loc="outside upper center", ncols=len(COLOURS), frameon=False)
    return figure


def reconfiguration(plt: Any, figures: Figures) -> Any:
    """Load and active streams by time."""
    found = figures.rows("reconfiguration")
    points = [(float(each["system"].split()[0]), float(each["load_1"])) for each in found if "load_1" in each]
    figure, axes = plt.subplots(figsize=(8, 3), layout="constrained")
    axes.plot(*zip(*points, strict=True), color="tab:blue", label="load of the bridge, two streams are 1")
    streams = axes.twinx()
    at_s = [points[0][0], BEGIN_S, BEGIN_S, END_S, END_S, points[-1][0]]
    streams.plot(at_s, [2, 2, 3, 3, 2, 2], color="0.4", linestyle=":", label="active streams")
    streams.set(ylim=(0, 4), ylabel="active streams", yticks=range(5))
    axes.set(xlabel="s", ylabel="load", ylim=(0, None))
    figure.legend(loc="outside upper center", ncols=2, frameon=False)
    return figure


ALL: Final[Mapping[str, tuple[str, Callable[[Any, Figures], Any]]]] = {
    "fig:aurora_comparison_agents": ("scaling", scalability),
    "fig:runtime_reconfig_demo": ("reconfiguration", reconfiguration),
}
"""The step that a figure is drawn from, and how, by the paper's label."""


def pictures(figures: Figures) -> Iterator[tuple[str, str]]:
    """Labels with their pictures, as PNG in base64; none of what was not run. ConfigError without matplotlib."""
    plt = pyplot("the report")
    for label, (step, draw) in ALL.items():
        if figures.rows(step):
            figure = draw(plt, figures)
            out = io.BytesIO()
            figure.savefig(out, format="png", dpi=110)
            plt.close(figure)
            yield label, base64.b64encode(out.getvalue()).decode()
