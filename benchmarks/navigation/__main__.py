"""Three ways across a campus: by a robot's own sensors, by the twin, and by both; what that costs; and how soon the
twin is found to be wrong.

Between start and goal are a wall with two narrow ways, of which a car may stand in one, two buildings that are dead
ends, cars and logs. A simulated robot with slip drives there with the library of navigation; scans, localisation (off
by 2 cm), planner, controller and seeds are the same in all modes. Success is the goal in 150 s without help.
"""

import argparse
import sys

from benchmarks.common import Report, main, positive
from benchmarks.navigation import costs, drives


def bench(options: argparse.Namespace, report: Report) -> None:
    seeds = options.seeds or (2 if options.quick else 400)
    some = max(2, seeds // 8)
    with drives.drivers(options.processes) as pool:
        drives.modes(seeds, report, pool)
        if not options.quick:
            drives.accuracies(some, report, pool)
            drives.links(some, report, pool)
    costs.discrepancies(2 if options.quick else 12, report)
    costs.cycle(report, 60 if options.quick else 400)
    costs.plans(report, 10 if options.quick else 100)
    costs.scans(report, 30 if options.quick else 200)
    report.note(f"{seeds} seeds a mode; twins that know less and links {some}")


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seeds", type=positive, metavar="N", help="campuses a mode")
    parser.add_argument("--processes", type=positive, metavar="N", help="drives at once; all cores")


if __name__ == "__main__":
    sys.exit(main("navigation", bench, description=__doc__, arguments=arguments))
