"""The pictures of the report, as PNG bytes. Needs matplotlib (the extra `report`)."""

import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sern_core.vocabulary.types import CLASS_LABELS
from sern_sim.profiles import LinkProfile
from sern_tools.shaping import RateSchedule
from sern_tools.summary import Floats, Result

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS: Final = {"control": "#1a7f37", "state": "#0969da", "bulk": "#8250df"}
SYSTEM_COLOURS: Final = ("#1a7f37", "#bc4c00", "#57606a")
BLACKOUT_COLOUR: Final = "#d0d7de"
DPI: Final = 130
WIDTH_IN: Final = 9.6
GOODPUT_WINDOW_S: Final = 1.0
LOWEST_LATENCY_S: Final = 0.01


def latency(results: Sequence[Result]) -> bytes:
    """Latency of every delivered message over the time of its arrival, one panel a system, logarithmic."""
    figure, panels = _figure(3.6, len(results))
    for axes, result in zip(panels, results, strict=True):
        for label in reversed(CLASS_LABELS):  # the urgent ones on top
            times, seconds = result.arrivals(label)
            axes.scatter(times, np.maximum(seconds, 1e-4), s=4, c=COLOURS[label], label=label, linewidths=0)
        floor_s = max(result.facts.floor_s.values(), default=0.0)
        if floor_s > 0:
            axes.axhline(floor_s, color="black", linewidth=0.8, linestyle=":", label="idle link")
        axes.set_yscale("log")
        axes.set_title(result.system)
        _time_axis(axes, result)
    panels[0].set_ylabel("latency, s")
    lowest = min(floor for result in results for floor in (*result.facts.floor_s.values(), LOWEST_LATENCY_S))
    panels[0].set_ylim(bottom=lowest * 0.8)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=4, frameon=False, markerscale=4)
    return _png(figure)


def pose_age(results: Sequence[Result]) -> bytes:
    """How old the newest pose is that the far side has, over time: what an operator sees of the robot."""
    figure, (axes,) = _figure(2.6, 1)
    for result, colour in zip(results, SYSTEM_COLOURS, strict=False):
        times, ages = result.pose_age()
        axes.plot(times, ages, color=colour, linewidth=1.2, label=result.system)
    axes.set_yscale("log")
    axes.set_ylabel("age, s")
    _time_axis(axes, results[0])
    figure.legend(loc="outside upper center", ncols=len(results), frameon=False)
    return _png(figure)


def goodput(results: Sequence[Result], carried: Mapping[str, tuple[float, Sequence[int]]], link: LinkProfile) -> bytes:
    """What the link could carry, and what each system carried: (bucket in s, bytes per bucket) by system."""
    figure, (axes,) = _figure(2.6, 1)
    duration_s = results[0].facts.duration_s
    steps = [step for step in RateSchedule.of(link.up, until_s=duration_s).steps if step[0] < duration_s]
    starts = [start for start, _ in steps] + [duration_s]
    rates = [rate / 1e6 for _, rate in steps]
    axes.step(starts, [*rates, rates[-1]], where="post", color="black", linewidth=1.0, label="capacity")
    for result, colour in zip(results, SYSTEM_COLOURS, strict=False):
        bucket_s, buckets = carried.get(result.system, (1.0, ()))
        times, bits = _smooth(bucket_s, buckets)
        axes.plot(times, bits / 1e6, color=colour, linewidth=1.2, label=f"{result.system}, robot to site")
    axes.set_ylabel("Mbit/s")
    axes.set_ylim(bottom=0)
    _time_axis(axes, results[0])
    figure.legend(loc="outside upper center", ncols=3, frameon=False)
    return _png(figure)


def drops(results: Sequence[Result]) -> bytes:
    """Share of what was offered: delivered, dropped by reason, and never accounted for; one bar a class and system."""
    figure, (axes,) = _figure(0.5 + 0.36 * 3 * len(results), 1)
    names, shares = [], []
    for label in reversed(CLASS_LABELS):
        for result in reversed(results):
            statistics = result.classes[label]
            names.append(f"{label}, {result.system}")
            shares.append(fates(result, label) if statistics.offered else {})
    order = ["delivered", *sorted({name for share in shares for name in share} - {"delivered"})]
    palette = ["#2da44e", "#bf8700", "#cf222e", "#8250df", "#0969da", "#57606a", "#e85aad", "#6e7781"]
    left = np.zeros(len(names))
    for index, fate in enumerate(order):
        widths = np.array([100 * share.get(fate, 0.0) for share in shares])
        axes.barh(names, widths, left=left, color=palette[index % len(palette)], label=fate, height=0.7)
        left += widths
    axes.set_xlim(0, 100)
    axes.set_xlabel("% of what was offered")
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside upper center", ncols=4, frameon=False)
    return _png(figure)


def fates(result: Result, label: str) -> dict[str, float]:
    """What became of the messages of a class, as shares that add up to 1."""
    statistics = result.classes[label]
    counts: dict[str, float] = {"delivered": statistics.delivered, "refused": statistics.refused, **statistics.dropped}
    counts |= {"under way at the end": statistics.under_way, "never seen again": statistics.unseen}
    total = sum(counts.values())
    return {name: count / total for name, count in counts.items() if count}


def _smooth(bucket_s: float, buckets: Sequence[int]) -> tuple[Floats, Floats]:
    """(time, bits per second), a running mean over `GOODPUT_WINDOW_S`."""
    if not buckets:
        return np.empty(0), np.empty(0)
    width = max(1, round(GOODPUT_WINDOW_S / bucket_s))
    kernel = np.ones(width) / width
    bits = np.convolve(np.asarray(buckets, dtype=np.float64) * 8 / bucket_s, kernel, mode="valid")
    return (np.arange(len(bits), dtype=np.float64) + width / 2) * bucket_s, bits


def _figure(height_in: float, columns: int) -> "tuple[Figure, list[Axes]]":
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH_IN, height_in), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    panels: Any = figure.subplots(1, columns, sharey=True, squeeze=False)
    return figure, list(panels[0])


def _time_axis(axes: "Axes", result: Result) -> None:
    for start, end in result.facts.blackouts:
        axes.axvspan(start, end, color=BLACKOUT_COLOUR, linewidth=0, zorder=0)
    axes.set_xlim(0, result.facts.duration_s)
    axes.set_xlabel("time, s")
    axes.grid(visible=True, axis="y", linewidth=0.4, alpha=0.6)
    axes.spines[["top", "right"]].set_visible(False)


def _png(figure: "Figure") -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()
