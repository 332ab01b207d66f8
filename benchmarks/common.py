"""What every benchmark shares: arguments, the table, the JSON, the exit code, and fair measuring.

`python -m benchmarks.NAME [--quick] [--json FILE]` prints a table and, with --json, writes

    {"benchmark": NAME, "commit": HASH, "compiled": whether the core was,
     "rows":  [{"case": ..., "system": ..., "<metric>_<unit>": number, ...}, ...],
     "reach": [{"name": ..., "value": number, "limit": number, "at_least": bool, "ok": bool}, ...],
     "notes": [...], "details": [...]}

`benchmarks.document` puts such a file into docs/performance.md. A reach is a figure the project set out to keep.
Missing one is printed plainly and is not an error: the exit code is non-zero only if the benchmark could not run.
"""

import argparse
import importlib
import json
import os
import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import BrokenExecutor
from dataclasses import dataclass, field
from itertools import groupby
from math import inf, sqrt
from pathlib import Path
from statistics import median, stdev
from typing import Any, Final, TypeVar

from rich.console import Console
from rich.table import Table

from sern_core.vocabulary.errors import ConfigError, SernError
from sern_runtime.version import compiled
from sern_tools.checkout import commit

REALTIME_PRIORITY = 10

T = TypeVar("T")


class MissingError(SernError):
    """What part of a benchmark needs is not installed; the rest can be measured without it."""


@dataclass(frozen=True)
class Row:
    """One measured system in one case; the metrics' names end in their unit, e.g. `decision_us`."""

    case: str
    system: str
    metrics: Mapping[str, float]


@dataclass(frozen=True)
class Reach:
    """A figure against its limit; `at_least` when larger is better."""

    name: str
    value: float
    limit: float
    at_least: bool = False

    @property
    def ok(self) -> bool:
        return self.value >= self.limit if self.at_least else self.value <= self.limit


@dataclass
class Report:
    """What a benchmark found, in the order it found it. `notes` say under which conditions; `details` are printed and
    stay out of the documents."""

    benchmark: str
    rows: list[Row] = field(default_factory=list)
    reaches: list[Reach] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    details: list[str] = field(default_factory=list)

    def row(self, case: str, system: str, **metrics: float) -> None:
        self.rows.append(Row(case, system, metrics))

    def reach(self, name: str, value: float, limit: float, *, at_least: bool = False) -> None:
        self.reaches.append(Reach(name, value, limit, at_least))

    def note(self, text: str) -> None:
        self.notes.append(text)

    def detail(self, text: str) -> None:
        self.details.append(text)

    def value(self, case: str, system: str, metric: str) -> float:
        """A metric measured before. Raises KeyError if there is none."""
        for row in self.rows:
            if (row.case, row.system) == (case, system) and metric in row.metrics:
                return row.metrics[metric]
        raise KeyError((case, system, metric))

    def as_json(self) -> dict[str, object]:
        return {
            "benchmark": self.benchmark,
            "commit": commit(),
            "compiled": compiled(),
            "rows": [{"case": row.case, "system": row.system, **row.metrics} for row in self.rows],
            "reach": [
                {"name": r.name, "value": r.value, "limit": r.limit, "at_least": r.at_least, "ok": r.ok}
                for r in self.reaches
            ],
            "notes": self.notes,
            "details": self.details,
        }

    def print(self, console: Console) -> None:
        """A table for each run of cases that have the same metrics, then notes and reaches."""
        title: str | None = f"{self.benchmark} ({commit()})"
        for metrics, rows in self._tables():
            self._print_table(console, title, metrics, rows)
            title = None
        for text in (*self.notes, *self.details):
            console.print(text, markup=False, highlight=False)
        for r in self.reaches:
            verdict = "reached" if r.ok else "MISSED "
            wanted = f"{'≥' if r.at_least else '≤'} {_number(r.limit)}"
            console.print(f"{verdict}  {r.name}: {_number(r.value)} (wanted {wanted})", markup=False, highlight=False)

    def _tables(self) -> list[tuple[list[str], list[Row]]]:
        found: list[tuple[list[str], list[Row]]] = []
        for _, group in groupby(self.rows, key=lambda row: row.case):
            rows = list(group)
            metrics = list(dict.fromkeys(name for row in rows for name in row.metrics))
            if found and set(found[-1][0]) == set(metrics):
                found[-1][1].extend(rows)
            else:
                found.append((metrics, rows))
        return found

    @staticmethod
    def _print_table(console: Console, title: str | None, metrics: Sequence[str], rows: Sequence[Row]) -> None:
        table = Table(title=title, title_justify="left")
        table.add_column("case")
        table.add_column("system", no_wrap=True)
        for name in metrics:
            quantity, _, unit = name.rpartition("_")
            heading = f"{quantity.replace('_', ' ')} [{'%' if unit == 'percent' else unit}]"
            table.add_column(heading, justify="right", header_style="bold", overflow="fold")
        previous = None
        for row in rows:
            case = "" if row.case == previous else row.case
            previous = row.case
            table.add_row(case, row.system, *(_number(row.metrics.get(name)) for name in metrics))
        console.print(table, markup=False)


def _number(value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def pin_cpu(cpu: int | None = None) -> str:
    """Keep this process on one CPU (the last allowed one by default). A note for the report; never fails."""
    try:
        allowed = os.sched_getaffinity(0)
        chosen = max(allowed) if cpu is None else cpu
        os.sched_setaffinity(0, {chosen})
    except OSError as error:
        return f"not pinned to a CPU: {error.strerror}"
    return f"pinned to CPU {chosen}"


def try_realtime(priority: int = REALTIME_PRIORITY) -> str:
    """Ask for what `chrt -r` gives, so that other load does not count as latency. A note; never fails."""
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(priority))
    except OSError as error:
        return f"no real-time priority ({error.strerror}): other load on this machine is in the figures"
    return f"real-time priority {priority}"


def interleaved(systems: Mapping[str, Callable[[], T]], rounds: int) -> dict[str, list[T]]:
    """Measure each system once a round, back and forth (A B, B A, ...), so that drift falls on all alike."""
    results: dict[str, list[T]] = {name: [] for name in systems}
    order = list(systems)
    for _ in range(rounds):
        for name in order:
            results[name].append(systems[name]())
        order.reverse()
    return results


def medians(runs: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """The median of each metric that every run has."""
    return {name: median(run[name] for run in runs) for name in runs[0] if all(name in run for run in runs)}


def percentile(values: Sequence[float], share: float) -> float:
    """The value of sorted ones that this share of them is below; inf of none."""
    return values[min(len(values) - 1, int(share * len(values)))] if values else inf


def spread(values: Sequence[float]) -> float:
    """How far apart the least and the largest are."""
    return max(values) - min(values)


def pyplot(option: str) -> Any:
    """The drawing module of matplotlib, without a window. ConfigError, naming the `option` that wants it, where it is
    not installed."""
    try:
        import matplotlib
    except ImportError as error:
        raise ConfigError(f"{option} needs matplotlib: pip install matplotlib") from error
    matplotlib.use("Agg")
    return importlib.import_module("matplotlib.pyplot")


def save(figure: Any, path: Path, dpi: int) -> None:
    """Write a picture and forget it; its folder is made where there is none."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=dpi)
    importlib.import_module("matplotlib.pyplot").close(figure)


def positive(text: str) -> int:
    """A whole number of 1 or more, for arguments."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{value} is not 1 or more")
    return value


def seconds(text: str) -> float:
    """A time above 0, for arguments."""
    value = float(text)
    if not 0 < value < inf:
        raise argparse.ArgumentTypeError(f"{text} is not a time above 0")
    return value


def repetition_arguments(parser: argparse.ArgumentParser) -> None:
    """Options for who wants another precision than the usual and that of --quick; see `repetitions`."""
    parser.add_argument("--rounds", type=positive, metavar="N", help="measure everything so often")
    parser.add_argument("--seconds", type=seconds, metavar="S", help="measure so long each time")


def repetitions(options: argparse.Namespace, usual: tuple[int, float], quick: tuple[int, float]) -> tuple[int, float]:
    """(rounds, seconds of each) by --quick, --rounds and --seconds."""
    rounds, duration_s = quick if options.quick else usual
    return options.rounds or rounds, options.seconds or duration_s


T95: Final = (
    12.71,
    4.30,
    3.18,
    2.78,
    2.57,
    2.45,
    2.36,
    2.31,
    2.26,
    2.23,
    2.20,
    2.18,
    2.16,
    2.14,
    2.13,
    2.12,
    2.11,
    2.10,
)
"""The 97.5th percentile of Student's t distribution for 1 to 18 degrees of freedom."""


def half_width_95(values: Sequence[float]) -> float:
    """Half the width of the 95 % confidence interval of the mean of independent values; inf of fewer than two."""
    count = len(values)
    if count < 2:
        return inf
    t = T95[count - 2] if count - 2 < len(T95) else 1.96 + 2.5 / (count - 1)
    return t * stdev(values) / sqrt(count)


def main(
    benchmark: str,
    run: Callable[[argparse.Namespace, Report], None],
    *,
    description: str | None = None,
    arguments: Callable[[argparse.ArgumentParser], None] | None = None,
) -> int:
    """Parse the arguments, run, print, write; the exit code. `arguments` may add options of the benchmark's own.

    Ctrl-C and SIGTERM end what was started with it: without that, processes would go on and take the CPU of whatever
    is measured next."""
    parser = argparse.ArgumentParser(prog=f"python -m benchmarks.{benchmark}", description=description)
    parser.add_argument("--quick", action="store_true", help="fewer repetitions, for continuous integration")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the figures to FILE")
    if arguments is not None:
        arguments(parser)
    options = parser.parse_args()
    report = Report(benchmark)
    handlers = {number: signal.signal(number, signal.default_int_handler) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        if options.json is not None:  # before the work, not after it
            options.json.parent.mkdir(parents=True, exist_ok=True)
        run(options, report)
        report.print(Console(width=None if sys.stdout.isatty() else 140))
        if options.json is not None:
            options.json.write_text(json.dumps(report.as_json(), indent=2, allow_nan=False) + "\n")
    except (SernError, OSError, BrokenExecutor) as error:
        print(f"benchmarks.{benchmark}: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"benchmarks.{benchmark}: interrupted", file=sys.stderr)
        return 130
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    return 0
