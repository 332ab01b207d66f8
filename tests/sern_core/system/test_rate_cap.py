"""A rate cap through a whole system: the last value of a joystick always arrives."""

import pytest

from sern_core.vocabulary.types import DropReason, PriorityClass
from tests.world import World, spec

TOPIC = "/robot/joy"


@pytest.mark.parametrize("lossless", [True, False])
@pytest.mark.parametrize("share", [1.0, 0.2])
def test_the_last_value_arrives_within_a_period(lossless: bool, share: float) -> None:
    """A burst of 30 in half a second at 5 Hz, then nothing: no other traffic wakes the link for it."""
    world = World(lossless=lossless).watch()
    robot, site = world.client("robot"), world.client("site", patterns=[".*"])
    joy = robot.publish(TOPIC, spec(PriorityClass.CONTROL, lifespan_s=2.0, max_rate_hz=5.0))
    world.run(1.0)
    joy.adapt(share=share, depth_max=10)
    for number in range(30):
        robot.send(joy, b"%d" % number)
        world.run(0.5 / 30)
    world.run(2.5)
    got = site.on(TOPIC)
    assert got[-1].body == b"29" and len(got) <= 5
    assert joy.counters.delivered + joy.counters.by_reason[DropReason.RATE_CAP] == 30
    if share == 1.0:
        assert got[-1].at_s - robot.sent[TOPIC, 30][0] < 0.2 + 0.1
    world.validate()


def test_while_the_link_is_away_only_the_newest_waits() -> None:
    world = World().watch()
    robot, site = world.client("robot"), world.client("site", patterns=[".*"])
    joy = robot.publish(TOPIC, spec(lifespan_s=60.0, max_rate_hz=5.0))
    world.run(1.0)
    robot.core.link.disconnected(now=robot.now)
    for number in range(30):
        robot.send(joy, b"%d" % number)
        world.run(0.01)
    world.run(1.0)
    robot.core.link.connected(now=robot.now)
    world.run(5.0)
    assert site.on(TOPIC)[-1].body == b"29"
    world.validate()


def test_what_is_held_back_when_a_new_relay_asks_again_comes_once() -> None:
    """Latched and capped: the replay for a relay that has lost everything and the message that waits are the same."""
    world = World().watch()
    robot, site = world.client("robot"), world.client("site", patterns=[".*"])
    state = robot.publish(TOPIC, spec(latched=True, lifespan_s=None, max_rate_hz=0.2))
    world.run(1.0)
    robot.send(state, b"1")
    robot.send(state, b"2")
    assert state.newest is not None
    world.restart_relay()
    world.run(15.0)
    assert site.seqs(TOPIC).count(2) == 1 and site.seqs(TOPIC)[-1] == 2
    world.validate()
