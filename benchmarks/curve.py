"""What encryption and keys cost: the same messages with CURVE and without, in interleaved rounds.

    sern          sern-relay between two clients, over TCP, with keys as installed
    sern-plain    the same without keys (`insecure: true`)
    proxy-curve   zmq.proxy in C with CURVE: what libzmq alone pays, the easier case
    proxy         the same without

The processes and the closed loop are those of `benchmarks.relay`.
"""

import argparse
import statistics
import sys
from functools import partial
from typing import Final

from benchmarks import common
from benchmarks.relay import SIZES, SYSTEMS, Sample, measure

PAIRS: Final = (("sern", "sern-plain"), ("proxy-curve", "proxy"))
LIMITS: Final = {("sern", "1 kB"): 0.6}
"""(system, case): messages a second, at least this share of what goes without keys."""


def bench(options: argparse.Namespace, report: common.Report) -> None:
    rounds, duration_s = common.repetitions(options, (5, 3.0), quick=(2, 0.8))
    systems = {system.name: system for system in SYSTEMS}
    for case in options.cases:
        runs = {name: partial(measure, systems[name], SIZES[case], duration_s) for pair in PAIRS for name in pair}
        samples = common.interleaved(runs, rounds)
        for secured, plain in PAIRS:
            share = _ratio(samples, secured, plain, "messages_hz")
            report.row(
                case,
                secured,
                messages_hz=statistics.median(sample.messages_hz for sample in samples[secured]),
                messages_without_hz=statistics.median(sample.messages_hz for sample in samples[plain]),
                kept_share=share,
                relay_cpu_times=_ratio(samples, secured, plain, "relay_cpu_us"),
            )
            if (secured, case) in LIMITS:
                name = f"{secured}: messages a second with CURVE, share of those without, {case}"
                report.reach(name, share, LIMITS[secured, case], at_least=True)
    report.note(f"medians of {rounds} interleaved rounds of {duration_s:g} s; ratios within a round")


def _ratio(samples: dict[str, list[Sample]], ours: str, theirs: str, metric: str) -> float:
    pairs = zip(samples[ours], samples[theirs], strict=True)
    shares = [float(getattr(one, metric)) / max(float(getattr(other, metric)), 1e-3) for one, other in pairs]
    return statistics.median(shares)


def _arguments(parser: argparse.ArgumentParser) -> None:
    usual = ["100 B", "1 kB", "64 kB"]
    parser.add_argument("--cases", nargs="+", choices=SIZES, default=usual, help="these sizes alone")
    common.repetition_arguments(parser)


def main() -> int:
    return common.main("curve", bench, description=__doc__, arguments=_arguments)


if __name__ == "__main__":
    sys.exit(main())
