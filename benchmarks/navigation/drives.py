"""Many drives at once, on all cores, paired by their seeds; each is driven once, also if several tables want it."""

import json
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import asdict, fields
from pathlib import Path
from statistics import median
from typing import Any, Final, NamedTuple

from benchmarks.common import Report
from benchmarks.navigation.campus import campus
from benchmarks.navigation.episode import PROFILES, LinkProfile, Mode, Result, drive
from benchmarks.navigation.statistics import mcnemar, wilson
from sern_core.vocabulary.errors import ConfigError
from sern_tools.checkout import commit

ACCURACY: Final = 0.9
ACCURACIES: Final = (0.0, 0.25, 0.5, 0.75, ACCURACY, 1.0)
PAPER: Final = {Mode.REAL_ONLY: (85.0, 124.2, 1.3), Mode.SIM_ONLY: (70.0, 109.7, 1.9), Mode.SERN: (95.0, 98.5, 0.4)}
"""Its table baselines: success of 20 trials in per cent, seconds to the goal, interventions."""
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


class Drives:
    """Results of drives. `kept`: a file of lines of JSON to which each is added as it comes, and which is read first,
    so that a run that was interrupted goes on. ConfigError: a line of it is none of ours."""

    def __init__(self, pool: ProcessPoolExecutor, kept: Path | None = None) -> None:
        self.commits: set[str] = set()
        """What the drives are of, beside those that are driven now."""
        self._commit = commit()
        self._pool = pool
        self._kept = kept
        self._found: dict[Drive, Result] = {}
        if kept is not None and kept.exists():
            for number, line in enumerate(kept.read_text(encoding="utf-8").splitlines(), 1):
                try:
                    one, result, of = _read(json.loads(line))
                except (ValueError, KeyError, TypeError) as error:
                    raise ConfigError(f"{kept}, line {number} is no drive ({error}): give another file") from error
                self._found[one] = result
                self.commits.add(of)

    def results(self, asked: Sequence[Drive]) -> list[Result]:
        """The results of these, in their order; those that are not known yet are driven."""
        missing = [one for one in dict.fromkeys(asked) if one not in self._found]
        coming = {self._pool.submit(driven, one): one for one in missing}
        try:
            for future in as_completed(coming):
                self._keep(coming[future], future.result())
        finally:
            for future in coming:
                future.cancel()
        return [self._found[one] for one in asked]

    def _keep(self, one: Drive, result: Result) -> None:
        self._found[one] = result
        self.commits.add(self._commit)
        if self._kept is not None:
            told = {"commit": self._commit, "accuracy": one.accuracy, "link": one.link.name, **asdict(result)}
            with self._kept.open("a", encoding="utf-8") as file:
                file.write(json.dumps(told) + "\n")


def _read(told: dict[str, Any]) -> tuple[Drive, Result, str]:
    links = {link.name: link for link in PROFILES}
    told["mode"] = Mode(told["mode"])
    result = Result(**{field.name: told[field.name] for field in fields(Result)})
    return Drive(result.seed, result.mode, told["accuracy"], links[told["link"]]), result, told["commit"]


def modes(seeds: int, report: Report, drives: Drives) -> None:
    """The three modes on the same campuses."""
    found = drives.results([Drive(seed, mode) for seed in range(seeds) for mode in Mode])
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
        if both:
            ours_s, theirs_s = median(ours for ours, _ in both), median(theirs for _, theirs in both)
            where = f"where SERN and {mode} both reach the goal"
            report.row(where, "SERN", counted_drives=len(both), time_median_s=ours_s)
            report.row(where, mode.value, counted_drives=len(both), time_median_s=theirs_s)
            if mode is Mode.REAL_ONLY:
                report.reach(f"time to the goal where both reach it, SERN over {mode}", ours_s / theirs_s, 1.0)
    _collisions(f"collisions in {len(found)} drives of three modes", found, report)


def accuracies(seeds: int, report: Report, drives: Drives) -> None:
    """SERN with a twin that is right to this share, against none."""
    case = f"{seeds} campuses, a twin that knows less"
    lines = {f"{accuracy:.0%} right": [Drive(seed, Mode.SERN, accuracy) for seed in range(seeds)]
             for accuracy in ACCURACIES}  # fmt: skip
    _against_real_only(case, lines, seeds, report, drives)


def links(seeds: int, report: Report, drives: Drives) -> None:
    """SERN over a link that brings the twin late, or not at all for a while."""
    case = f"{seeds} campuses, SERN over a link"
    lines = {}
    for link in PROFILES:
        alike = PROFILES[0] if link.always_fresh else link  # the site stands still: what is late says the same
        lines[link.name] = [Drive(seed, Mode.SERN, ACCURACY, alike) for seed in range(seeds)]
    _against_real_only(case, lines, seeds, report, drives)


def _against_real_only(case: str, lines: dict[str, list[Drive]], seeds: int, report: Report, drives: Drives) -> None:
    """A row for each of these lines of drives, the first of which is Real Only on the same campuses."""
    real = drives.results([Drive(seed, Mode.REAL_ONLY) for seed in range(seeds)])
    low, _high = wilson(sum(each.reached for each in real), seeds)
    _row(case, "Real Only", real, report)
    # One campus after the other: what is interrupted has some of each line.
    drives.results([one for group in zip(*lines.values(), strict=True) for one in group])
    everything = list(real)
    for name, asked in lines.items():
        results = drives.results(asked)
        everything += results
        _row(case, name, results, report)
        share = sum(each.reached for each in results) / seeds
        what = f"{case}, {name}: success of SERN over the low end of Real Only's interval"
        report.reach(what, share - low, 0, at_least=True)
    _collisions(f"{case}: collisions in {len(everything)} drives", everything, report)


def _collisions(what: str, results: Sequence[Result], report: Report) -> None:
    report.reach(what, float(sum(each.collisions for each in results)), 0)


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
        collisions_all=sum(each.collisions for each in results),
        **more,
    )


def _paper(mode: Mode) -> dict[str, float]:
    success, time_s, interventions = PAPER[mode]
    return {"paper_success_percent": success, "paper_time_s": time_s, "paper_interventions_run": interventions}
