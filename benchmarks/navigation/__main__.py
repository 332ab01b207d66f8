"""Three ways across a campus: by a robot's own sensors, by the twin, and by both; what that costs; and how soon the
twin is found to be wrong.

Between start and goal are a wall with two narrow ways, of which a car may stand in one, two buildings that are dead
ends, cars and logs. A simulated robot with slip drives there with the library of navigation; scans, localisation (off
by 2 cm), planner, controller and seeds are the same in all modes. Success is the goal in 150 s without help.
"""

import argparse
import sys
from pathlib import Path
from typing import Final

from benchmarks.common import Report, main, positive
from benchmarks.navigation import corrections, costs, drives, mapping_costs

PARTS: Final = ("modes", "accuracies", "links", "corrections", "mapping", "costs")


def bench(options: argparse.Namespace, report: Report) -> None:
    parts = options.parts or PARTS
    seeds = options.seeds or (2 if options.quick else 400)
    some = min(seeds, options.some or (1 if options.quick else 60))
    driving = {"modes": (drives.modes, seeds), "accuracies": (drives.accuracies, some), "links": (drives.links, some)}
    if any(part in driving for part in parts):
        with drives.drivers(options.processes) as pool:
            known = drives.Drives(pool, options.resume)
            for part, (drive, count) in driving.items():
                if part in parts:
                    drive(count, report, known)
        report.note(f"drives are of commit {', '.join(sorted(known.commits))}")
    if "corrections" in parts:
        corrections.corrections(2 if options.quick else 12, report)
    if "mapping" in parts:
        mapping_costs.accuracy(report, 10 if options.quick else 200, 1 if options.quick else 12)
    if "costs" in parts:
        costs.cycle(report, 60 if options.quick else 400)
        costs.plans(report, 10 if options.quick else 100)
        mapping_costs.costs(report, 30 if options.quick else 200)
        report.note("cycles, plans and scans in CPU time of one process")


def part(text: str) -> str:
    """One of `PARTS`, for arguments."""
    if text not in PARTS:
        raise argparse.ArgumentTypeError(f"{text} is none of {', '.join(PARTS)}")
    return text


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("parts", nargs="*", type=part, metavar="PART", help=f"all, or {', '.join(PARTS)}")
    parser.add_argument("--seeds", type=positive, metavar="N", help="campuses a mode")
    parser.add_argument("--some", type=positive, metavar="N", help="campuses of each accuracy and link")
    parser.add_argument("--processes", type=positive, metavar="N", help="drives at once; all cores")
    parser.add_argument(
        "--resume", type=Path, metavar="FILE", help="read the drives there, and add those that are missing"
    )


if __name__ == "__main__":
    sys.exit(main("navigation", bench, description=__doc__, arguments=arguments))
