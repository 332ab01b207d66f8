"""How far the twin that is shown is from the robot: over a bad link, in a blackout of 30 s and after it.

A skid-steered robot with slip follows its plan in closed loop; its localisation is off by 1 cm in each axis (one
sigma, for about 2 s) and by 0.3 degrees, and what is compared with is where the robot truly is. Its poses go over a
link through a relay to a site, all three the real core in virtual time. `shared trajectory`: the site has the robot's
plan with its times; `shared path`: the plan without them; `last command`, `constant twist` and `constant acceleration`
(the paper's) know no plan; `no prediction` is a correction alone. Real motion is of the recordings in `--data`.
"""

import argparse
import sys
from pathlib import Path
from typing import Final

from benchmarks.common import Report, main
from benchmarks.sync import bounds, cases
from benchmarks.sync.patches import patches

DATA: Final = Path(__file__).resolve().parents[3] / "shared" / "data"


def bench(options: argparse.Namespace, report: Report) -> None:
    seeds = options.seeds or (3 if options.quick else 40)
    cases.moderate(seeds, report)
    cases.blackout(seeds, report)
    cases.stop(max(1, seeds // 4), report)
    cases.recorded(options.data, report)
    bounds.bound(200 if options.quick else 10_000, report)
    cases.reckoning(max(1, seeds // 4), report)
    patches(max(1, seeds // 10), report)
    cases.cost(report)
    report.note(f"{seeds} seeds; stops and dead reckoning a quarter of them, patches a tenth")


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--data", type=Path, default=DATA, metavar="DIR", help="where the recordings are")
    parser.add_argument("--seeds", type=int, metavar="N", help="runs of each case")


if __name__ == "__main__":
    sys.exit(main("sync", bench, description=__doc__, arguments=arguments))
