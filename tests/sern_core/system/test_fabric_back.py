"""A client goes back to a relay that was started again and has not met the others yet."""

import pytest

from sern_core.vocabulary.types import PriorityClass
from sern_sim.models import LinkModel
from tests.fabric_world import FabricWorld
from tests.world import Clock, SimClient, spec

APART_S = 3.0
SLOW_TO_MEET = LinkModel(delay_s=0.01, disconnect_after_s=0.5, reconnect_s=APART_S).as_stream()
POSE, LOG = "/robot/odom", "/robot/log"
EACH = pytest.mark.parametrize("names", [("a", "b"), ("a", "b", "c"), ("z", "b", "c")], ids="".join)


def back(names: tuple[str, ...], *, offset_s: float = 0.0) -> tuple[FabricWorld, list[SimClient]]:
    """The client is back, and the relays have met. `offset_s`: by how much the clock of the new process is ahead. The
    sites are at the other relays."""
    home, other = names[:2]
    world = FabricWorld(names, between=SLOW_TO_MEET).watch()
    robot = world.client_at(home, "robot")
    sites = [world.client_at(name, f"site_{name}", patterns=["/robot/.*"]) for name in names[1:]]
    pose = robot.publish(POSE, spec(PriorityClass.CONTROL))
    log = robot.publish(LOG, spec(reliable=True))
    world.run(2.0)
    robot.every(0.1, pose, bytes(100))
    robot.every(0.5, log, bytes(100))
    world.run(5.0)
    world.move("robot", other)
    world.run(3.0)
    world.relay_clock = Clock(offset_s=offset_s)
    world.restart(home)
    world.run(0.001)
    world.move("robot", home)
    world.run(APART_S + 7.0)
    assert world.homes("robot") == [home]
    return world, sites


def goes_on(world: FabricWorld, sites: list[SimClient]) -> None:
    came = [len(site.on(POSE)) for site in sites]
    world.run(5.0)
    for site, before in zip(sites, came, strict=True):
        assert len(site.on(POSE)) >= before + 49


@EACH
def test_it_is_there_for_the_others_too_and_nothing_reliable_is_lost(names: tuple[str, ...]) -> None:
    """Its session there is the latest, though the relay has heard of none before."""
    world, sites = back(names)
    goes_on(world, sites)
    assert not any(relay.refusals for relay in world.relays.values())
    for site in sites:
        seqs = [got.seq for got in site.on(LOG)]
        assert seqs == list(range(1, seqs[-1] + 1)) and seqs[-1] >= 44


@EACH
def test_where_the_clock_of_that_relay_is_behind_its_streams_go_on_all_the_same(names: tuple[str, ...]) -> None:
    """The others still think that it is where it was: they refuse its streams, and take them when they know better."""
    world, sites = back(names, offset_s=-3600.0)
    relay = world.relays[names[0]]
    goes_on(world, sites)
    refusals = len(relay.refusals)
    world.run(5.0)
    assert len(relay.refusals) == refusals, "it is not offered for ever"
