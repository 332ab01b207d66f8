"""Several relays on one fabric: what their hop carries, what a second one costs, what comes of failures, how many fit.

path      two processes with a link and a port each over 8 Mbit/s and 20 ms of round trip made by tc netem (needs root):
          control at 50 Hz (100 bytes) beside 17 Mbit/s of bulk. Beside it zenoh alone with the same certificates,
          REAL_TIME over BACKGROUND, and two NATS servers, leaf and hub, where nats-server is installed
loopback  how long a datagram takes through two ports on an idle loopback, and what it costs
relays    a robot and a site at one relay, and at two: latency, and CPU of the relays
failover  a router, or a relay, is killed or stopped: how long control stays away, what becomes of what is reliable
twenty    20 relays, every two with a connection: until all have sessions, CPU and memory when nothing happens
robots    4 relays with 25 robots each

But for the first two, relays and clients are the installed daemons with keys and certificates (of robots, the relays).
systems of the path: fabric (datagrams as large as 3 ms of the link, which may be lost), its variants with datagrams of
1171 bytes and with a link that takes the stream for lossless, zenoh, nats leaf
"""

import argparse
import importlib.util
import sys
from collections.abc import Callable
from typing import Final

from benchmarks.common import MissingError, Report, main, repetition_arguments, try_realtime
from benchmarks.fabric import failover, loopback, path, relays, robots, twenty

Bench = Callable[[argparse.Namespace, Report], None]

PARTS: Final[dict[str, Bench]] = {
    "path": path.bench,
    "loopback": loopback.bench,
    "relays": relays.bench,
    "failover": failover.bench,
    "twenty": twenty.bench,
    "robots": robots.bench,
}


def bench(options: argparse.Namespace, report: Report) -> None:
    if importlib.util.find_spec("zenoh") is None:
        report.note("nothing is measured: zenoh is not installed (pip install eclipse-zenoh)")
        return
    report.note(try_realtime())
    for name in options.only or PARTS:
        try:
            PARTS[name](options, report)
        except MissingError as error:
            report.note(f"no {name}: {error}")


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    repetition_arguments(parser)
    parser.add_argument("--only", nargs="+", choices=PARTS, help="these parts alone")
    parser.add_argument("--systems", nargs="+", choices=path.SYSTEMS, help="of the path these systems alone")
    parser.add_argument("--cases", nargs="+", choices=path.CASES, help="of the path these cases alone")
    parser.add_argument("--verbose", action="store_true", help="say what each run over the path saw")


if __name__ == "__main__":
    sys.exit(main("fabric", bench, description=__doc__, arguments=_arguments))
