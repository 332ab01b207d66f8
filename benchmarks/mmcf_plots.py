"""Pictures of the adaptation benchmark."""

from collections.abc import Iterator, Mapping
from pathlib import Path

from benchmarks.common import pyplot, save
from benchmarks.mmcf_run import Run

COLOURS = {
    "fixed_throughput": "tab:orange",
    "fixed_reliability": "tab:red",
    "best_fixed": "tab:green",
    "mmcf": "tab:blue",
    "oracle": "0.6",
}


def draw(folder: Path, runs: Mapping[tuple[str, str], Mapping[str, Run]]) -> Iterator[Path]:
    """Cost, bulk rate and terms over time, one picture a trace; yields the files."""
    plt = pyplot("--plots")
    for (trace, profile), mine in runs.items():
        if profile != "teleoperation":
            continue
        figure, (costs, terms, rate) = plt.subplots(3, 1, figsize=(9, 7), sharex=True, layout="constrained")
        for policy, colour in COLOURS.items():
            run = mine[policy]
            times = [interval.at_s for interval in run.intervals]
            costs.plot(times, [i.cost for i in run.intervals], color=colour, label=policy.replace("_", " "), lw=1.3)
            if policy in ("mmcf", "oracle"):
                bulk = [i.configuration.rates[2] for i in run.intervals]
                rate.step(times, bulk, color=colour, where="post", label=policy)
        own = mine["mmcf"]
        times = [interval.at_s for interval in own.intervals]
        for name in ("latency", "unreliability", "compute", "bandwidth"):
            terms.plot(times, [getattr(i.terms, name) for i in own.intervals], label=name, lw=1.3)
        costs.set_ylabel("cost J")
        terms.set_ylabel("terms of mmcf")
        rate.set_ylabel("rate of class bulk")
        rate.set_xlabel("s")
        for axes in (costs, terms, rate):
            axes.grid(alpha=0.3)
            axes.legend(loc="upper right", fontsize=7, ncols=2)
        costs.set_title(f"{trace}, {profile}")
        path = folder / f"mmcf-{trace}.png"
        save(figure, path, dpi=110)
        yield path
