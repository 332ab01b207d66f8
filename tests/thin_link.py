"""The thinnest link that SERN is said to be for, 64 kbit/s, in virtual time: offered are five times what it carries.

A pose ten times a second, a reliable status and clouds go one way, commands the other. A full datagram takes 0.15 s of
such a link, so that is what a pose may have to wait for. Nothing adapts.
"""

from dataclasses import dataclass
from typing import Final

from sern_core.vocabulary.types import PriorityClass
from sern_sim.models import LinkModel
from tests.world import SimClient, World, spec

RATE_BPS: Final = 64e3
DELAY_S: Final = 0.1
OVERHEAD_BYTES: Final = 28
DATAGRAM_S: Final = 8 * (1200 + OVERHEAD_BYTES) / RATE_BPS
SETTLED_S: Final = 20.0
RUN_S: Final = 120.0
COUNTED_S: Final = RUN_S - SETTLED_S
SEEDS: Final = range(1, 8)
"""Which datagrams are lost moves the tail of the ages by a third: a figure is the median of as many runs."""
POSE, STATUS, CLOUD, COMMAND = "/robot/odom", "/robot/status", "/robot/points", "/robot/cmd_vel"
RATES_HZ: Final = {POSE: 10.0, COMMAND: 10.0, STATUS: 1.0, CLOUD: 2.0}
SIZES_BYTES: Final = {POSE: 100, COMMAND: 50, STATUS: 300, CLOUD: 20_000}


@dataclass
class ThinLink:
    """A run that is over."""

    world: World
    robot: SimClient
    site: SimClient

    def ages_s(self, topic: str) -> list[float]:
        """True ages of what arrived once the link's capacity was found, youngest first. What the
        receiver thinks is as true as it says."""
        sender, receiver = (self.site, self.robot) if topic == COMMAND else (self.robot, self.site)
        found = []
        for got in receiver.on(topic):
            age_s = got.at_s - sender.sent[topic, got.seq][0]
            assert abs(got.age_s - age_s) <= got.error_s
            if got.at_s - self.world.network.start_s > SETTLED_S:
                found.append(age_s)
        return sorted(found)


def play(*, lossless: bool, clouds: bool = True, seed: int = 1) -> ThinLink:
    """Over a stream that loses nothing, or over datagrams of which 1 % are lost; `seed` says which."""
    world = World(lossless=lossless, seed=seed)
    model = LinkModel(rate_bps=RATE_BPS, delay_s=DELAY_S, overhead_bytes=OVERHEAD_BYTES, loss=0.0 if lossless else 0.01)
    robot = world.client("robot", model.as_stream() if lossless else model)
    site = world.client("site", patterns=["/robot/.*"])
    robot.subscribe(COMMAND)
    pose = robot.publish(POSE, spec(PriorityClass.CONTROL))
    status = robot.publish(STATUS, spec(PriorityClass.STATE, reliable=True, depth=10))
    cloud = robot.publish(CLOUD, spec(PriorityClass.BULK))
    command = site.publish(COMMAND, spec(PriorityClass.CONTROL, lifespan_s=1.0))
    for sender, channel, topic in (
        (robot, pose, POSE),
        (robot, status, STATUS),
        (robot, cloud, CLOUD),
        (site, command, COMMAND),
    ):
        if clouds or topic != CLOUD:
            sender.every(1 / RATES_HZ[topic], channel, bytes(SIZES_BYTES[topic]))
    world.run(RUN_S)
    return ThinLink(world, robot, site)
