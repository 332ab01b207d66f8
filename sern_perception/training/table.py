"""The study's figures as a table: means over seeds, with 95 % intervals, and ratios paired by seed. Needs no torch."""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean, stdev
from typing import Any, Final, NamedTuple

from scipy.stats import t as student

from sern_core.vocabulary.errors import ConfigError

NONE: Final = "none"
"""The variant that the others are compared with."""
OWN: Final = "none, on the scanner of the labels"
TARGET: Final = "labels of the other scanner"
CLASSES: Final = ("ground", "car", "bridge", "log", "other")


class Tried(NamedTuple):
    """One network on the test scans: intersection over union by class, 0 to 1."""

    seed: int
    name: str
    ious: dict[str, float]

    @property
    def miou(self) -> float:
        return fmean(self.ious.values())


class Study(NamedTuple):
    """What was tried, with which code and budget."""

    commit: str
    budget: dict[str, int]
    tried: list[Tried]

    def as_json(self) -> str:
        """A line for each network, so that a file can be compared with an earlier one."""
        head = json.dumps({"commit": self.commit, "budget": self.budget})[:-1]
        lines = ",\n  ".join(json.dumps(each._asdict()) for each in self.tried)
        return f'{head}, "tried": [\n  {lines}\n]}}\n'


def read(path: Path) -> Study:
    """What `Study.as_json` wrote. ConfigError, one line: no such file, or another thing."""
    try:
        found: Any = json.loads(path.read_text())
        tried = [Tried(int(each["seed"]), str(each["name"]), dict(each["ious"])) for each in found["tried"]]
        return Study(str(found["commit"]), dict(found["budget"]), tried)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None
    except (ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"{path} is no study's file ({error!r}): `study --out` writes one") from None


def joined(studies: Sequence[Study]) -> Study:
    """One of several that did different seeds. ConfigError: they differ in code or budget, or did the same seed."""
    seeds = [seed for study in studies for seed in {each.seed for each in study.tried}]
    if len({(study.commit, tuple(study.budget.items())) for study in studies}) != 1 or len(set(seeds)) != len(seeds):
        raise ConfigError("studies of other code, of another budget or of the same seed are not one: give fewer files")
    tried = sorted((each for study in studies for each in study.tried), key=lambda each: each.seed)
    return studies[0]._replace(tried=tried)


def interval(values: Sequence[float]) -> tuple[float, float]:
    """Mean and half of the width of its 95 % interval (Student's t); NaN for one value."""
    if len(values) < 2:
        return fmean(values), math.nan
    return fmean(values), float(student.ppf(0.975, len(values) - 1)) * stdev(values) / math.sqrt(len(values))


def ratios(tried: Sequence[Tried], name: str, to: str = NONE) -> list[float]:
    """mIoU of a variant over that of another one, for each seed that has both."""
    base = {each.seed: each.miou for each in tried if each.name == to}
    return [each.miou / base[each.seed] for each in tried if each.name == name and each.seed in base]


def table(study: Study) -> str:
    """Markdown: a row for each variant, in the order in which they were tried."""
    seeds = sorted({each.seed for each in study.tried})
    lines = [
        "| adaptation | mIoU, % | times none | " + " | ".join(CLASSES) + " |",
        "|---|---|---|" + "---|" * len(CLASSES),
    ]
    for name in dict.fromkeys(each.name for each in study.tried):
        rows = [each for each in study.tried if each.name == name]
        mean, half = interval([each.miou for each in rows])
        times = "" if name == NONE else _plusminus(*interval(ratios(study.tried, name)), 2)
        by_class = " | ".join(_mean([each.ious[kind] for each in rows if kind in each.ious]) for kind in CLASSES)
        lines.append(f"| {name} | {_plusminus(100 * mean, 100 * half, 1)} | {times} | {by_class} |")
    said = ", ".join(f"{name} {value}" for name, value in study.budget.items())
    lines += ["", f"Code of `{study.commit}`, seeds {seeds[0]} to {seeds[-1]}, {said}. ± is the 95 % interval."]
    return "\n".join(lines)


def _plusminus(mean: float, half: float, digits: int) -> str:
    return f"{mean:.{digits}f}" + ("" if math.isnan(half) else f" ± {half:.{digits}f}")


def _mean(values: Sequence[float]) -> str:
    return f"{100 * fmean(values):.0f}" if values else ""
