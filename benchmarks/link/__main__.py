"""SERN beside plain ZeroMQ and zenoh over a degraded link made by tc netem. Needs root; see docs/performance.md.

Offered: a pose at 50 Hz (100 bytes, class control), clouds at 10 Hz (100 kB in most cases, bulk) and maps at 5 Hz
(20 kB, state). Latency is from the hand-over at one end to the delivery at the other, by the one clock of this host.

systems: sern-udp, sern-zmq (robot, relay and site, both hops on that lane; CURVE), zmq (PUB/SUB as it comes), zenoh,
zenoh-multilink, zenoh-multilink-bbr (peers, REAL_TIME against DATA_LOW, one TCP connection or two by priority),
tcpros (rospy, where it is installed). Beside sern-udp: floor (one bare datagram on the idle link) and forwarder (opens,
seals and sends each datagram in the relay's place), whose latency and CPU the limits are multiples of
"""

import argparse
import sys
from pathlib import Path

from benchmarks import common
from benchmarks.link.cases import ALL, CASES, bench_all


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--cases", nargs="+", choices=list(CASES), help="these alone")
    parser.add_argument("--systems", nargs="+", choices=ALL, help="these alone")
    parser.add_argument("--plots", type=Path, metavar="DIR", help="draw latency against time into DIR")
    parser.add_argument("--traces", type=Path, metavar="DIR", help="keep what both ends wrote down, in a new folder")


def main() -> int:
    complete = True

    def bench(options: argparse.Namespace, report: common.Report) -> None:
        nonlocal complete
        complete = bench_all(options, report, common.try_realtime())  # all that is started inherits the priority

    code = common.main("link", bench, description=__doc__, arguments=_arguments)
    return code if complete else 1


if __name__ == "__main__":
    sys.exit(main())
