"""The thinnest link that SERN is said to be for, 64 kbit/s, in virtual time: what is driven by goes on.

Offered are five times what the link carries: a pose ten times a second, a reliable status, and clouds; commands come
the other way. A full datagram takes 0.15 s of such a link, so that is what a pose may have to wait for.
"""

import pytest

from sern_core.types import PriorityClass
from sern_sim.models import LinkModel
from tests.world import SimClient, World, spec

RATE_BPS = 64e3
DELAY_S = 0.1
OVERHEAD_BYTES = 28
DATAGRAM_S = 8 * (1200 + OVERHEAD_BYTES) / RATE_BPS
SETTLED_S = 20.0
RUN_S = 120.0


def ages_s(sender: SimClient, taker: SimClient, topic: str) -> list[float]:
    """True ages of what arrived once the link's capacity was found, youngest first. What the taker thinks is as true as
    it says."""
    found = []
    for got in taker.on(topic):
        age_s = got.at_s - sender.sent[topic, got.seq][0]
        assert abs(got.age_s - age_s) <= got.error_s
        if got.at_s - taker.world.network.start_s > SETTLED_S:
            found.append(age_s)
    return sorted(found)


@pytest.mark.parametrize("lossless", [True, False])
def test_over_64_kbit_per_s_control_and_state_arrive_in_time_beside_clouds(lossless: bool) -> None:
    world = World(lossless=lossless)
    model = LinkModel(rate_bps=RATE_BPS, delay_s=DELAY_S, overhead_bytes=OVERHEAD_BYTES, loss=0.0 if lossless else 0.01)
    robot = world.client("robot", model.as_stream() if lossless else model)
    site = world.client("site", patterns=["/robot/.*"])
    robot.subscribe("/robot/cmd_vel")
    pose = robot.publish("/robot/odom", spec(PriorityClass.CONTROL))
    status = robot.publish("/robot/status", spec(PriorityClass.STATE, reliable=True, depth=10))
    cloud = robot.publish("/robot/points", spec(PriorityClass.BULK))
    command = site.publish("/robot/cmd_vel", spec(PriorityClass.CONTROL, lifespan_s=1.0))
    robot.every(0.1, pose, b"p" * 100)
    robot.every(1.0, status, b"s" * 300)
    robot.every(0.5, cloud, b"c" * 20_000)
    site.every(0.1, command, b"v" * 50)
    world.run(RUN_S)

    poses, commands = ages_s(robot, site, "/robot/odom"), ages_s(site, robot, "/robot/cmd_vel")
    seconds = RUN_S - SETTLED_S
    assert len(poses) >= 0.98 * 10 * seconds and len(commands) >= 0.98 * 10 * seconds
    assert poses[0] > DELAY_S, "nothing is faster than the link"
    assert poses[int(0.99 * len(poses))] < DELAY_S + 3 * DATAGRAM_S
    assert commands[int(0.99 * len(commands))] < DELAY_S + DATAGRAM_S

    assert site.seqs("/robot/status") == list(range(1, len(site.on("/robot/status")) + 1))
    states = ages_s(robot, site, "/robot/status")
    assert len(states) >= seconds - 1 and states[-1] < DELAY_S + 6 * DATAGRAM_S
    assert len(ages_s(robot, site, "/robot/points")) >= 10, "clouds are not starved"
    world.validate()
