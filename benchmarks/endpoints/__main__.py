"""Endpoints beside what their middleware offers for the same work: added latency and CPU of a bridge.

ros1        from one ROS 1 system to another, beside topic_tools relay, a rospy bridge, and rospy joined by zenoh
dds         from one DDS domain to another, between Fast DDS peers, beside endpoints joined by zenoh
ros2        from one ROS 2 domain to another, between rclpy nodes: topics, calls, goals, beside nodes in one domain
discovery   how soon a new ROS 1 topic is at the other master, and gone there

Limits apply to the whole chain that a user runs, client, relay and client, but where a name says otherwise.
"""

import argparse
import importlib
import sys
from typing import Final

from benchmarks import common
from benchmarks.common import MissingError
from benchmarks.endpoints.shared import ROUNDS
from sern_core.vocabulary.errors import SernError

PARTS: Final = ("ros1", "dds", "ros2", "discovery")


def run_part(name: str, options: argparse.Namespace, report: common.Report) -> None:
    """A part that needs what is not installed is left out, and a note says what that is."""
    try:
        importlib.import_module(f"benchmarks.endpoints.{name}").bench(options, report)
    except MissingError as error:
        report.note(f"{name} left out: {error}")
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith(("benchmarks", "sern_")):
            raise
        report.note(f"{name} left out: needs the Python package {error.name}")


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--only", nargs="+", choices=PARTS, help="these parts alone")
    parser.add_argument("--rounds", type=common.positive, metavar="N", help=f"default: {ROUNDS}, with --quick 1")


def run(options: argparse.Namespace, report: common.Report) -> None:
    """SernError when no part can be measured."""
    options.rounds = options.rounds or (1 if options.quick else ROUNDS)
    for name in options.only or PARTS:
        run_part(name, options, report)
    if not report.rows:
        raise SernError("; ".join(report.notes))
    report.note(
        f"medians of {options.rounds} interleaved rounds, lost: the most of a round; added and ratios within a round, "
        "spread: between rounds"
    )


if __name__ == "__main__":
    sys.exit(common.main("endpoints", run, description=__doc__, arguments=_arguments))
