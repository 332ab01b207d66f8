"""Pictures of runs: latency against time, and what a sender's link thought. matplotlib is an optional extra."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from benchmarks.common import pyplot, save
from benchmarks.link import figures
from benchmarks.link.load import Kind
from benchmarks.link.runs import Outcome
from benchmarks.link.sern import SAMPLE_COLUMNS

SIZE_INCHES: Final = (7.5, 3.6)
DPI: Final = 110
COLOURS: Final = {
    "sern-udp": "#0b6e4f",
    "sern-zmq": "#6bbf59",
    "zmq": "#c1292e",
    "zenoh": "#f1a208",
    "zenoh-multilink": "#3066be",
    "zenoh-multilink-bbr": "#8e6bbf",
    "tcpros": "#5c4742",
}


def latency(path: Path, title: str, outcomes: Sequence[Outcome], floor_s: float | None) -> None:
    """Each pose that arrived: when it was sent, and how long it took; the floor as a line."""
    figure, axes = pyplot("--plots").subplots(figsize=SIZE_INCHES)
    for outcome in reversed(outcomes):
        rows = outcome.arrived[outcome.arrived[:, figures.KIND] == Kind.POSE]
        at_s = (rows[:, figures.STAMP] - outcome.start_ns) / 1e9
        took_ms = (rows[:, figures.AT] - rows[:, figures.STAMP]) / 1e6
        axes.plot(at_s, took_ms, ".", markersize=2.5, label=outcome.system, color=COLOURS.get(outcome.system))
    if floor_s is not None:
        axes.axhline(1000 * floor_s, color="black", linewidth=0.8, linestyle=":", label="floor (idle link)")
    axes.set_yscale("log")
    axes.set_xlabel("time of sending [s]")
    axes.set_ylabel("latency of a pose [ms]")
    axes.set_title(title, fontsize=10)
    _mark(axes, outcomes[0])
    handles, labels = axes.get_legend_handles_labels()
    axes.legend(handles[::-1], labels[::-1], fontsize=7, markerscale=4, loc="center left", bbox_to_anchor=(1.0, 0.5))
    figure.tight_layout()
    save(figure, path, DPI)


def window(path: Path, title: str, outcome: Outcome) -> None:
    """Capacity, window and round trip as the sender's link saw them."""
    samples = figures.samples_of(outcome)
    if not len(samples):
        return
    columns = dict(zip(SAMPLE_COLUMNS, samples.T, strict=True))
    at_s = (columns["at_ns"] - outcome.start_ns) / 1e9
    figure, (above, below) = pyplot("--plots").subplots(2, 1, sharex=True, figsize=(SIZE_INCHES[0], 4.2))
    above.plot(at_s, columns["rate_bps"] / 1e6, label="capacity, estimated [Mbit/s]", color="#0b6e4f", linewidth=1)
    above.legend(fontsize=7, loc="upper right")
    above.set_ylim(bottom=0)
    above.set_title(title, fontsize=10)
    below.plot(at_s, columns["window_bytes"] / 1e3, label="window [kB]", color="#3066be", linewidth=1)
    below.plot(at_s, columns["inflight_bytes"] / 1e3, label="in flight [kB]", color="#f1a208", linewidth=0.7)
    below.plot(at_s, columns["srtt_s"] * 1e3, label="round trip [ms]", color="#c1292e", linewidth=1)
    below.set_ylim(bottom=0)
    below.legend(fontsize=7, loc="upper right")
    below.set_xlabel("time [s]")
    for axes in (above, below):
        _mark(axes, outcome)
    figure.tight_layout()
    save(figure, path, DPI)


def _mark(axes: Any, outcome: Outcome) -> None:
    """The script: a blackout as a grey span, any other event as a line."""
    at_s = {name: (asked_ns - outcome.start_ns) / 1e9 for name, (asked_ns, _done_ns) in outcome.events.items()}
    if {"gone", "back"} <= at_s.keys():
        axes.axvspan(at_s.pop("gone"), at_s.pop("back"), color="grey", alpha=0.25, linewidth=0, label="blackout")
    for time_s in at_s.values():
        axes.axvline(time_s, color="grey", linewidth=0.7, linestyle="--")
    axes.grid(alpha=0.3)
