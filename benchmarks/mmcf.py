"""The multi-metric cost function against fixed policies and an oracle, on links that change.

Each trace is run with several seeds for two mission profiles. A policy decides every second from what a controller can
measure (arrivals, sizes, test compressions, a late and noisy capacity); what its choice comes to is counted in an
independent model of the link, fragment by fragment (`benchmarks.mmcf_queue`).

    fixed_throughput, fixed_reliability   the paper's baselines (section "MMCF Evaluation")
    best_fixed                            of all candidates the one that is cheapest on this trace, known afterwards
    luckiest_fixed                        the same, chosen again for each seed
    fixed_range                           MMCF as printed: bandwidth over 8 Mbit/s on every link, no floors
    oracle                                tries every candidate every second on a copy of the queues, future included

All are priced alike: bandwidth is a share of what the link could carry in the interval, whatever a policy believed.
The profile's floors bind MMCF. So the oracle keeps them where anything does, and the best and the luckiest fixed ones
are chosen among those that are below a floor, where some candidate keeps it, in no more intervals than MMCF is.
"""

import argparse
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from statistics import fmean, median
from time import thread_time

from benchmarks.common import Report, half_width_95, main
from benchmarks.mmcf_queue import Queues
from benchmarks.mmcf_run import INTERVAL_S, Observer, Run, controlled, fixed, oracle, run
from benchmarks.mmcf_traces import CODECS, GRID, Trace, traces
from benchmarks.reference import reach_forwarding
from sern_core.adaptation.cost import Ranges, cost, profile, profile_floors
from sern_core.adaptation.model import Configuration, Measurement, Terms
from sern_core.adaptation.policy import FLOOR_KEPT, Decision, Mmcf, fixed_reliability, fixed_throughput
from sern_core.adaptation.predict import Grid

PROFILES = ("teleoperation", "mapping")
POLICIES = ("fixed_throughput", "fixed_reliability", "luckiest_fixed", "best_fixed", "fixed_range", "mmcf", "oracle")
RANGES = Ranges()
AS_PRINTED = Ranges(share_of_capacity=False)
SAME = 1.002
"""Two policies that chose the same configuration all along differ by nothing; this close they count as equal."""
SETTLED = 0.1
"""A share of the final level: traffic that differs by no more has settled."""
SETTLED_INTERVALS = 3
"""Averaged, for clouds are few a second."""
FINAL_INTERVALS = 6
"""At the end of a step, whose mean is its final level."""
DECISION_LIMIT = 400.0
"""CPU of a decision, by that of forwarding one datagram: as much as the data of a second at 4 Mbit/s."""
REGRET_LIMITS = {"step": 0.15, "wave": 0.15, "fades": 0.35}


@dataclass(frozen=True)
class Result:
    """All policies on one trace with one seed, for one profile."""

    trace: str
    profile: str
    seed: int
    runs: dict[str, Run]
    fixed: dict[Configuration, Run]
    settled: dict[str, dict[bool, float]]
    """Seconds until delivered traffic settled, by policy and whether the link rises."""
    keepable: list[bool]
    """Whether some candidate keeps the floors, by interval."""

    def below_floor(self, one: Run) -> float:
        """Share of the intervals in which a class is below its floor though some candidate keeps all."""
        floors = profile_floors(self.profile)
        missed = [can and not keeps(i.measurement, floors) for can, i in zip(self.keepable, one.intervals, strict=True)]
        return sum(missed) / len(missed)


def keeps(measurement: Measurement, floors: Sequence[float]) -> bool:
    """Whether every class's floor arrived in time, as sharply as the policy can foresee."""
    return not any(o.on_time < FLOOR_KEPT * floors[o.priority] * o.offered for o in measurement.classes)


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
        weights, floors = profile(profile_name), profile_floors(profile_name)
        costed = {
            configuration: Run(name, "fixed", [replace(i, cost=cost(weights, i.terms)) for i in result.intervals])
            for configuration, result in every.items()
        }
        chosen = {
            "fixed_throughput": fixed(fixed_throughput(CODECS)),
            "fixed_reliability": fixed(fixed_reliability(CODECS)),
            "fixed_range": controlled(Mmcf(GRID, weights=weights, ranges=AS_PRINTED), trace, seed=seed),
            "mmcf": controlled(Mmcf(GRID, weights=weights, ranges=RANGES, floors=floors), trace, seed=seed),
            "oracle": oracle(GRID.configurations, ranges=RANGES, weights=weights, keeps=partial(keeps, floors=floors)),
        }
        runs = {
            policy: run(trace, policy, choose, seed=seed, ranges=RANGES, weights=weights)
            for policy, choose in chosen.items()
        }
        count = len(runs["mmcf"].intervals)
        keepable = [any(keeps(one.intervals[i].measurement, floors) for one in costed.values()) for i in range(count)]
        times = {
            policy: {rises: settled_s(one, trace, rises=rises) for rises in {rises for _, rises in trace.steps}}
            for policy, one in runs.items()
        }
        result = Result(name, profile_name, seed, runs, costed, times, keepable)
        runs["luckiest_fixed"] = costed[_cheapest([result])]
        found.append(result)
    return found


def _cheapest(results: Sequence[Result]) -> Configuration:
    """The cheapest of those below a floor in no more intervals than MMCF; of the least where none is so good."""
    misses = {c: fmean(r.below_floor(r.fixed[c]) for r in results) for c in results[0].fixed}
    limit = max(fmean(r.below_floor(r.runs["mmcf"]) for r in results), min(misses.values())) + 1e-9
    allowed = [configuration for configuration, missed in misses.items() if missed <= limit]
    return min(allowed, key=lambda configuration: fmean(r.fixed[configuration].cost for r in results))


def add_best_fixed(results: Sequence[Result]) -> Configuration:
    """Find the configuration that costs least in the mean of the runs of all seeds of a trace.

    One that was chosen for each seed by itself owes a part of its lead to chance: which of the messages a share lets in
    meet the good moments.
    """
    best = _cheapest(results)
    for result in results:
        result.runs["best_fixed"] = result.fixed[best]
    return best


def settled_s(result: Run, trace: Trace, *, rises: bool) -> float:
    """Seconds from a change of the link until delivered traffic is within SETTLED of its final level.

    The whole time until the next change where it never moved, though the link did: that is a failure. The worst of the
    steps that rise or fall. Duty: there is one.
    """
    worst_s = 0.0
    for at_s, rise in trace.steps:
        if rise is not rises:
            continue
        end_s = min([later for later, _ in trace.steps if later > at_s], default=trace.duration_s)
        level = {interval.at_s: interval.measurement.bandwidth_bps for interval in result.intervals}
        after = [level[t] for t in sorted(level) if at_s <= t < end_s]
        before = [level[t] for t in sorted(level) if t < at_s][-FINAL_INTERVALS:]
        final, initial = fmean(after[-FINAL_INTERVALS:]), fmean(before)
        if abs(final - initial) <= SETTLED * max(final, initial):
            return end_s - at_s
        means = [fmean(after[i : i + SETTLED_INTERVALS]) for i in range(len(after) - SETTLED_INTERVALS + 1)]
        first = next((i for i, mean in enumerate(means) if abs(mean - final) <= SETTLED * final), len(after))
        worst_s = max(worst_s, first * INTERVAL_S)
    return worst_s


def decision_ms() -> tuple[int, float]:
    """(candidates, the median CPU time of one decision in milliseconds) with residuals, and a link that swings."""
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
        started = thread_time()
        decision = policy.decide(situation, measurement, now=queues.now)
        times.append((thread_time() - started) * 1e3)
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
    report.note("terms: 1 is 0.5 s of latency, no reliability, a quarter of a core, all that the link carries")
    for profile_name in PROFILES:
        for name in names:
            mine = [r for r in results if (r.trace, r.profile) == (name, profile_name)]
            report.detail(f"{profile_name} {name}: the best fixed one is {add_best_fixed(mine)}")
            for policy in POLICIES:
                runs = [r.runs[policy] for r in mine]
                costs = [one.cost for one in runs]
                more = {} if len(runs) < 2 else {"plusminus_1": half_width_95(costs)}
                for rises, metric in ((False, "settled_down_s"), (True, "settled_up_s")):
                    times = [r.settled[policy][rises] for r in mine if rises in r.settled.get(policy, {})]
                    if times:
                        more[metric] = fmean(times)
                        if len(times) > 1:
                            more[f"{metric.removesuffix('_s')}_plusminus_s"] = half_width_95(times)
                terms = Terms(*(fmean(values) for values in zip(*(one.terms for one in runs), strict=True)))
                report.row(
                    f"{profile_name} {name}",
                    policy,
                    cost_1=fmean(costs),
                    latency_1=terms.latency,
                    unreliability_1=terms.unreliability,
                    compute_1=terms.compute,
                    bandwidth_1=terms.bandwidth,
                    regret_1=fmean(costs) / fmean(r.runs["oracle"].cost for r in mine) - 1.0,
                    overbest_1=fmean(costs) / fmean(r.runs["best_fixed"].cost for r in mine) - 1.0,
                    below_1=fmean(r.below_floor(r.runs[policy]) for r in mine),
                    switches_1=fmean(one.switches_per_minute for one in runs),
                    **more,
                )
    _reaches(report, results, names)
    reach_forwarding(report, f"CPU of a decision among {count} candidates", 1e3 * milliseconds, DECISION_LIMIT)
    if options.plots is not None:
        from benchmarks.mmcf_plots import draw

        for path in draw(options.plots, {(r.trace, r.profile): r.runs for r in reversed(results)}):
            report.detail(f"wrote {path}")


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
                for rises, what, limit_s in ((False, "drop", 3.0), (True, "rise", 5.0)):
                    worst_s = max(r.settled["mmcf"][rises] for r in mine)
                    report.reach(f"{profile_name}: seconds until traffic settles after a {what}", worst_s, limit_s)


if __name__ == "__main__":
    sys.exit(main("mmcf", measure, description=__doc__.splitlines()[0] if __doc__ else None, arguments=add_arguments))
