"""Many drives at once, on all cores, paired by their seeds."""

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from statistics import median
from typing import Final, NamedTuple

from benchmarks.common import Report
from benchmarks.navigation.campus import campus
from benchmarks.navigation.episode import PROFILES, LinkProfile, Mode, Result, drive
from benchmarks.navigation.statistics import mcnemar, wilson

ACCURACY: Final = 0.9
ACCURACIES: Final = (0.0, 0.25, 0.5, 0.75, 1.0)
PAPER: Final = {Mode.REAL_ONLY: (85.0, 124.2), Mode.SIM_ONLY: (70.0, 109.7), Mode.SERN: (95.0, 98.5)}
"""Its table baselines: success of 20 trials in per cent, and seconds to the goal."""
ONE_THREAD: Final = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


class Drive(NamedTuple):
    seed: int
    mode: Mode
    accuracy: float = ACCURACY
    link: LinkProfile = PROFILES[0]


def driven(one: Drive) -> Result:
    return drive(one.seed, campus(one.seed), one.mode, accuracy=one.accuracy, link=one.link)


@contextmanager
def drivers(count: int | None = None) -> Iterator[ProcessPoolExecutor]:
    """Processes that have a core each: libraries of linear algebra would start threads of their own."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)
    try:
        with ProcessPoolExecutor(count or os.cpu_count()) as pool:
            yield pool
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def modes(seeds: int, report: Report, pool: ProcessPoolExecutor) -> None:
    """The three modes on the same campuses."""
    asked = [Drive(seed, mode) for seed in range(seeds) for mode in Mode]
    found = list(pool.map(driven, asked))
    by_mode = {mode: [each for each in found if each.mode is mode] for mode in Mode}
    case = f"{seeds} campuses, a twin that is right in 9 of 10 things"
    for mode, results in by_mode.items():
        _row(case, mode.value, results, report, **_paper(mode))
    sern = [each.reached for each in by_mode[Mode.SERN]]
    for mode in (Mode.REAL_ONLY, Mode.SIM_ONLY):
        other = [each.reached for each in by_mode[mode]]
        p = mcnemar(sern, other)
        better = sum(sern) > sum(other)
        report.reach(f"success of SERN above that of {mode}: p of McNemar's test", p if better else 1.0, 0.01)
        both = [
            (ours.time_s, theirs.time_s)
            for ours, theirs in zip(by_mode[Mode.SERN], by_mode[mode], strict=True)
            if ours.reached and theirs.reached
        ]
        if mode is Mode.REAL_ONLY and both:
            ratio = median(ours for ours, _ in both) / median(theirs for _, theirs in both)
            report.reach(f"time to the goal where both reach it, SERN over {mode}", ratio, 1.0)
    report.reach("collisions in all drives", float(sum(each.collisions for each in found)), 0)


def accuracies(seeds: int, report: Report, pool: ProcessPoolExecutor) -> None:
    """SERN with a twin that is right to this share, against none."""
    real = list(pool.map(driven, [Drive(seed, Mode.REAL_ONLY) for seed in range(seeds)]))
    low, _high = wilson(sum(each.reached for each in real), seeds)
    _row("a twin that knows less", "none", real, report)
    asked = [Drive(seed, Mode.SERN, accuracy) for accuracy in ACCURACIES for seed in range(seeds)]
    found = list(pool.map(driven, asked))
    for number, accuracy in enumerate(ACCURACIES):
        results = found[number * seeds : (number + 1) * seeds]
        _row("a twin that knows less", f"{accuracy:.0%} right", results, report)
        share = sum(each.reached for each in results) / seeds
        what = f"twin {accuracy:.0%} right: success of SERN over the low end of Real Only's interval"
        report.reach(what, share - low, 0, at_least=True)


def links(seeds: int, report: Report, pool: ProcessPoolExecutor) -> None:
    """SERN over a link that brings the twin late, or not at all for a while."""
    real = list(pool.map(driven, [Drive(seed, Mode.REAL_ONLY) for seed in range(seeds)]))
    low, _high = wilson(sum(each.reached for each in real), seeds)
    asked = [Drive(seed, Mode.SERN, ACCURACY, link) for link in PROFILES for seed in range(seeds)]
    found = list(pool.map(driven, asked))
    for number, link in enumerate(PROFILES):
        results = found[number * seeds : (number + 1) * seeds]
        _row("SERN over a link", link.name, results, report)
        share = sum(each.reached for each in results) / seeds
        what = f"{link.name}: success of SERN over the low end of Real Only's interval"
        report.reach(what, share - low, 0, at_least=True)


def _row(case: str, system: str, results: Sequence[Result], report: Report, **more: float) -> None:
    reached = [each for each in results if each.reached]
    low, high = wilson(len(reached), len(results))
    report.row(
        case,
        system,
        success_percent=100 * len(reached) / len(results),
        from_percent=100 * low,
        to_percent=100 * high,
        time_median_s=median(each.time_s for each in reached) if reached else 0.0,
        spl_share=sum(each.spl for each in results) / len(results),
        interventions_run=sum(each.interventions for each in results) / len(results),
        collisions_all=float(sum(each.collisions for each in results)),
        **more,
    )


def _paper(mode: Mode) -> dict[str, float]:
    success, time_s = PAPER[mode]
    return {"paper_success_percent": success, "paper_time_s": time_s}
