"""The multi-metric cost function against fixed policies and an oracle, on links that change.

Each trace is run with several seeds for two mission profiles. A policy decides every second from what a controller can
measure (arrivals, sizes, test compressions, a late and noisy capacity); what its choice comes to is counted in an
independent model of the link, fragment by fragment (`benchmarks.mmcf_queue`).

    fixed_throughput, fixed_reliability   the paper's baselines (section "MMCF Evaluation")
    best_fixed                            of all candidates the one that is cheapest on this trace, known afterwards
    luckiest_fixed                        the same, chosen again for each seed
    oracle                                tries every candidate every second on a copy of the queues, future included
"""

import argparse
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean, median
from time import perf_counter

from benchmarks.common import Report, main
from benchmarks.mmcf_queue import Queues
from benchmarks.mmcf_run import Observer, Run, controlled, fixed, oracle, run
from benchmarks.mmcf_traces import CODECS, GRID, Trace, traces
from sern_core.mmcf.cost import Ranges, cost, profile
from sern_core.mmcf.model import Configuration, Measurement, Terms
from sern_core.mmcf.policy import Decision, Mmcf, fixed_reliability, fixed_throughput
from sern_core.mmcf.predict import Grid

PROFILES = ("teleoperation", "mapping")
POLICIES = ("fixed_throughput", "fixed_reliability", "luckiest_fixed", "best_fixed", "mmcf", "oracle")
RANGES = Ranges()
SAME = 1.002
"""Two policies that chose the same configuration all along differ by nothing; this close they count as equal."""
REGRET_LIMITS = {"step": 0.15, "wave": 0.15, "fades": 0.35}


@dataclass(frozen=True)
class Result:
    """All policies on one trace with one seed, for one profile."""

    trace: str
    profile: str
    seed: int
    runs: dict[str, Run]
    fixed: dict[Configuration, Run]
    settled_down: float | None
    settled_up: float | None


def job(arguments: tuple[str, int]) -> list[Result]:
    """One trace with one seed."""
    name, seed = arguments
    trace = next(trace for trace in traces(seed) if trace.name == name)
    every = {
        configuration: run(trace, "fixed", fixed(configuration), seed=seed, ranges=RANGES, weights=profile("balanced"))
        for configuration in GRID.configurations
    }
    found = []
    for profile_name in PROFILES:
        weights = profile(profile_name)
        costed = {
            configuration: Run(name, "fixed", [replace(i, cost=cost(weights, i.terms)) for i in result.intervals])
            for configuration, result in every.items()
        }
        chosen = {
            "fixed_throughput": fixed(fixed_throughput(CODECS)),
            "fixed_reliability": fixed(fixed_reliability(CODECS)),
            "mmcf": controlled(Mmcf(GRID, weights=weights, ranges=RANGES), trace, seed=seed),
            "oracle": oracle(GRID.configurations, ranges=RANGES, weights=weights),
        }
        runs = {
            policy: run(trace, policy, choose, seed=seed, ranges=RANGES, weights=weights)
            for policy, choose in chosen.items()
        }
        down, up = (_settled(runs["mmcf"], trace, rises=rises) for rises in (False, True))
        runs["luckiest_fixed"] = min(costed.values(), key=lambda one: one.cost)
        found.append(Result(name, profile_name, seed, runs, costed, down, up))
    return found


def add_best_fixed(results: Sequence[Result]) -> Configuration:
    """To the runs of all seeds of a trace: the configuration that costs least in their mean.

    One that was chosen for each seed by itself owes a part of its lead to chance: which of the messages a share lets in
    meet the good moments.
    """
    best = min(results[0].fixed, key=lambda configuration: fmean(r.fixed[configuration].cost for r in results))
    for result in results:
        result.runs["best_fixed"] = result.fixed[best]
    return best


def _settled(result: Run, trace: Trace, *, rises: bool) -> float | None:
    """Intervals after a step until the configuration changes no more before the next; None without such a step."""
    found = None
    for at_s, rise in trace.steps:
        if rise is rises:
            end_s = min([later for later, _ in trace.steps if later > at_s], default=trace.duration_s)
            switched = [i.at_s + 1 - at_s for i in result.intervals if i.switched and at_s <= i.at_s < end_s]
            found = max([found or 0.0, *switched])
    return found


def decision_ms() -> tuple[int, float]:
    """(candidates, the median time of one decision in milliseconds) with residuals, and a link that swings."""
    grid = Grid.of(
        rates=[(1.0,), (1.0, 0.5), (1.0, 0.6, 0.4, 0.25, 0.1)],
        queues=[(1,), (1, 3), (1, 3)],
        codecs=("none", *CODECS),
        redundancy=(0, 1),
    )
    trace = next(trace for trace in traces(1) if trace.name == "wave")
    policy = Mmcf(grid, weights=profile("teleoperation"), ranges=RANGES)
    observer = Observer(trace, seed=1)
    times = []

    def timed(queues: Queues, measurement: Measurement | None) -> tuple[Configuration, Decision | None]:
        situation = observer.situation(queues)
        started = perf_counter()
        decision = policy.decide(situation, measurement, now=queues.now)
        times.append((perf_counter() - started) * 1e3)
        return decision.chosen, decision

    run(trace, "timed", timed, seed=1, ranges=RANGES, weights=profile("teleoperation"))
    return len(grid), median(times)


def regret(results: Sequence[Result]) -> float:
    return fmean(r.runs["mmcf"].cost for r in results) / fmean(r.runs["oracle"].cost for r in results) - 1.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--plots", type=Path, metavar="DIR", help="draw the step and the fades into DIR")
    parser.add_argument("--seeds", type=int, default=0, metavar="N", help="seeds a trace (default 5, quick 1)")
    parser.add_argument("--first-seed", type=int, default=1, metavar="N", help="the first of them (default 1)")


def measure(options: argparse.Namespace, report: Report) -> None:
    first, seeds = options.first_seed, options.seeds or (1 if options.quick else 5)
    names = [trace.name for trace in traces(1)]
    count, milliseconds = decision_ms()
    with ProcessPoolExecutor() as pool:
        batches = pool.map(job, [(name, seed) for name in names for seed in range(first, first + seeds)])
        results = [result for batch in batches for result in batch]
    report.note(
        f"seeds {first} to {first + seeds - 1}, {len(GRID)} candidates; terms and costs are means over the intervals"
    )
    report.note("terms: 1 is 0.5 s of latency, no reliability, a quarter of a core, 8 Mbit/s")
    for profile_name in PROFILES:
        for name in names:
            mine = [r for r in results if (r.trace, r.profile) == (name, profile_name)]
            report.note(f"{profile_name} {name}: the best fixed one is {add_best_fixed(mine)}")
            for policy in POLICIES:
                runs = [r.runs[policy] for r in mine]
                terms = Terms(*(fmean(values) for values in zip(*(one.terms for one in runs), strict=True)))
                report.row(
                    f"{profile_name} {name}",
                    policy,
                    cost_1=fmean(one.cost for one in runs),
                    latency_1=terms.latency,
                    unreliability_1=terms.unreliability,
                    compute_1=terms.compute,
                    bandwidth_1=terms.bandwidth,
                    regret_1=fmean(one.cost for one in runs) / fmean(r.runs["oracle"].cost for r in mine) - 1.0,
                    switches_1=fmean(one.switches_per_minute for one in runs),
                )
    _reaches(report, results, names)
    report.reach(f"a decision among {count} candidates, ms", milliseconds, 5.0)
    if options.plots is not None:
        from benchmarks.mmcf_plots import draw

        options.plots.mkdir(parents=True, exist_ok=True)
        for path in draw(options.plots, {(r.trace, r.profile): r.runs for r in reversed(results)}):
            report.note(f"wrote {path}")


def _reaches(report: Report, results: Sequence[Result], names: Sequence[str]) -> None:
    for profile_name in PROFILES:
        for name in names:
            mine = [r for r in results if (r.trace, r.profile) == (name, profile_name)]
            costs = {
                policy: fmean(r.runs[policy].cost for r in mine)
                for policy in ("mmcf", "fixed_throughput", "fixed_reliability", "best_fixed")
            }
            others = min(value for policy, value in costs.items() if policy != "mmcf")
            report.reach(f"{profile_name} {name}: cost over the best other policy's", costs["mmcf"] / others, SAME)
            if name in REGRET_LIMITS:
                report.reach(f"{profile_name} {name}: regret", regret(mine), REGRET_LIMITS[name])
            if name == "wave":
                rate = max(r.runs["mmcf"].switches_per_minute for r in mine)
                report.reach(f"{profile_name} {name}: switches a minute", rate, 4.0)
            if name == "step":
                report.reach(f"{profile_name}: intervals to settle after a drop", _worst(mine, down=True), 3.0)
                report.reach(f"{profile_name}: intervals to settle after a rise", _worst(mine, down=False), 8.0)


def _worst(results: Sequence[Result], *, down: bool) -> float:
    values = [r.settled_down if down else r.settled_up for r in results]
    return max(value for value in values if value is not None)


if __name__ == "__main__":
    sys.exit(main("mmcf", measure, description=__doc__.splitlines()[0] if __doc__ else None, arguments=add_arguments))
