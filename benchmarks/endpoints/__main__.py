"""Endpoints beside what their middleware offers for the same work: added latency and CPU of a bridge.

ros1        from one ROS 1 system to another, beside topic_tools relay and a bridge written with rospy
dds         from one DDS domain to another, between Fast DDS peers
discovery   how soon a new ROS 1 topic is at the other master, and gone there
"""

import argparse
import sys
from collections.abc import Callable
from typing import Final

from benchmarks import common
from benchmarks.endpoints import dds, discovery, ros1

PARTS: Final[dict[str, Callable[[argparse.Namespace, common.Report], None]]] = {
    "ros1": ros1.bench,
    "dds": dds.bench,
    "discovery": discovery.bench,
}


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--only", nargs="+", choices=list(PARTS), help="these parts alone")


def _run(options: argparse.Namespace, report: common.Report) -> None:
    for name in options.only or PARTS:
        PARTS[name](options, report)


if __name__ == "__main__":
    sys.exit(common.main("endpoints", _run, description=__doc__, arguments=_arguments))
