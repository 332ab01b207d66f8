"""How fast the virtual-time network runs the real core: a robot, a relay and a site on a thin link, for an hour.

The relay's and the clients' cores as in the daemons, joined by simulated links: the robot's is 500 kbit/s, 50 ms each
way, with 1 % loss, over the datagram lane's fragments and acknowledgements; the site's is perfect. Offered: a pose of
100 bytes at 10 Hz, alone or beside a cloud of 30 kB a second, which is half the link. One thread; CPU time, not the
clock's. Every message must be accounted for at the end: delivered, or dropped for a reason, of which one is that nobody
knows whether it arrived.
"""

import argparse
import sys
import time
from dataclasses import dataclass
from typing import Final

from benchmarks.common import Report, main
from sern_core.stream.out_channel import OutChannel
from sern_core.vocabulary.errors import SernError
from sern_core.vocabulary.types import DropReason, PriorityClass
from sern_sim.models import LinkModel
from tests.world import SimClient, World, spec

HOUR_S: Final = 3600.0
QUICK_S: Final = 120.0
THIN: Final = LinkModel(rate_bps=500e3, delay_s=0.05, loss=0.01)
POSE_PERIOD_S: Final = 0.1
POSE: Final = b"p" * 100
CLOUD_PERIOD_S: Final = 1.0
CLOUD: Final = b"c" * 30_000
POSES: Final = "/robot/odom"
CLOUDS: Final = "/robot/points"
SETTLE_S: Final = 60.0


@dataclass
class Run:
    """A world after its load has ended and all has arrived that will."""

    world: World
    site: SimClient
    channels: list[OutChannel]

    def check(self) -> None:
        """SernError when a message is not accounted for, or the site did not get just what was delivered.

        Of what its sender could not have confirmed, any part may have arrived."""
        for channel in self.channels:
            counters = channel.counters
            missing = counters.offered - counters.delivered - counters.dropped
            if missing:
                raise SernError(f"{counters.topic}: {missing} of {counters.offered} messages are not accounted for")
            seqs = self.site.seqs(counters.topic)
            unknown = counters.by_reason[DropReason.UNCONFIRMED]
            if seqs != sorted(set(seqs)) or not 0 <= len(seqs) - counters.delivered <= unknown:
                raise SernError(
                    f"{counters.topic}: {len(seqs)} arrived, {counters.delivered} were delivered, of {unknown} more "
                    "nobody knows"
                )


def simulate(seconds: float, *, clouds: bool) -> Run:
    """Offer the load for so many virtual seconds, then let it drain."""
    world = World(lossless=False)
    robot = world.client("robot", THIN)
    site = world.client("site", patterns=["/robot/.*"])
    loads = [(robot.publish(POSES, spec(PriorityClass.CONTROL)), POSE_PERIOD_S, POSE)]
    if clouds:
        loads.append((robot.publish(CLOUDS, spec(PriorityClass.BULK)), CLOUD_PERIOD_S, CLOUD))
    cancels = [robot.every(period_s, channel, body) for channel, period_s, body in loads]
    world.run(seconds)
    for cancel in cancels:
        cancel()
    world.until(world.quiet, within_s=SETTLE_S, what="everything has arrived")
    return Run(world, site, [channel for channel, _, _ in loads])


def bench(options: argparse.Namespace, report: Report) -> None:
    seconds = QUICK_S if options.quick else HOUR_S
    for case, clouds in (("poses", False), ("poses and clouds", True)):
        begun_s = time.process_time()
        run = simulate(seconds, clouds=clouds)
        cpu_s = time.process_time() - begun_s
        run.check()
        report.row(
            case,
            "core",
            virtual_s=seconds,
            cpu_s=cpu_s,
            speed_1=seconds / cpu_s,
            events_hz=run.world.network.event_count / seconds,
            arrived_count=len(run.site.got),
            delivered_count=sum(channel.counters.delivered for channel in run.channels),
            dropped_count=sum(channel.counters.dropped for channel in run.channels),
        )
    report.note("speed: virtual seconds a second of CPU; events: of the network, a virtual second")


if __name__ == "__main__":
    sys.exit(main("virtual_time", bench, description=__doc__))
