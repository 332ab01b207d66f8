"""A site is told how a robot at another relay is reached, as it is of one at its own."""

import pytest

from sern_core.site.peers import PeerStatus, PeerView
from sern_core.vocabulary.types import PriorityClass
from sern_sim.models import LinkModel, Window
from tests.fabric_world import FabricWorld
from tests.world import SimClient, spec

TELLING_S = 1.5
"""A relay looks once a second; a hop takes 10 ms."""


def view(site: SimClient, name: str = "robot") -> PeerView:
    (found,) = (each for each in site.core.peers.look(now=site.now) if each.name == name)
    return found


def fleet(*names: str, link: LinkModel | None = None) -> tuple[FabricWorld, SimClient, SimClient]:
    """A robot at the first of them that says where it is ten times a second, and a site at the last."""
    world = FabricWorld(names).watch()
    robot = world.client_at(names[0], "robot", link)
    site = world.client_at(names[-1], "site", patterns=["/pose"])
    world.run(1.0)
    robot.every(0.1, robot.publish("/pose", spec(PriorityClass.STATE)), bytes(50))
    world.run(4.0)
    return world, robot, site


def test_a_robot_whose_path_is_cut_is_gone_and_then_there_again() -> None:
    link = LinkModel(delay_s=0.05, blackouts=(Window(10.0, 30.0),))
    world, _robot, site = fleet("a", "b", link=link)
    seen = view(site)
    assert seen.status is PeerStatus.CONNECTED
    assert seen.rtt_s == pytest.approx(0.1 + 0.02, abs=0.03), "both hops"
    assert seen.lane == view_at_home(world).lane
    world.run(4.0)  # the path is cut now
    silent_s = 0.0
    while view(site).status is PeerStatus.CONNECTED:
        world.run(0.1)
        silent_s += 0.1
    assert silent_s < 3.0 + TELLING_S
    world.run(3.0)
    assert view(site).status is PeerStatus.GONE and view(site).since_s > 3.0
    world.run(30.0)
    assert view(site).status is PeerStatus.CONNECTED


def view_at_home(world: FabricWorld) -> PeerView:
    """What a site at the robot's own relay is told."""
    beside = world.client_at("a", "beside", patterns=["/pose"])
    world.run(1.0)
    return view(beside)


def test_a_robot_that_is_killed_is_gone_at_once_and_given_up_with_its_streams() -> None:
    world, _robot, site = fleet("a", "b")
    world.hops["robot-a"].break_connection(reconnect_s=1e6)
    world.run(0.2)
    assert view(site).status is PeerStatus.GONE
    world.run(world.relays["a"].hub.clients.resume_s + 5.0)
    assert view(site).given_up


def test_a_robot_that_goes_over_is_told_of_by_its_next_relay() -> None:
    world, _robot, site = fleet("a", "b", "c")
    for relay in ("b", "c", "a"):
        world.move("robot", relay)
        world.run(3.0)
        assert view(site).status is PeerStatus.CONNECTED
        world.hops[f"robot-{relay}"].break_connection(reconnect_s=4.0)
        world.run(0.2)
        assert view(site).status is PeerStatus.GONE
        world.run(10.0)
        assert view(site).status is PeerStatus.CONNECTED


def test_who_is_at_a_relay_that_is_not_reached_is_gone_until_it_is() -> None:
    world, _robot, site = fleet("a", "b")
    world.hops["a-b"].break_connection(reconnect_s=5.0)
    world.run(0.2)
    assert view(site).status is PeerStatus.GONE
    world.hops["robot-a"].break_connection(reconnect_s=20.0)
    world.run(10.0)
    assert view(site).status is PeerStatus.GONE, "the relay is back, and does not have the robot"
    world.run(20.0)
    assert view(site).status is PeerStatus.CONNECTED


def test_of_whom_nobody_takes_anything_nothing_is_kept() -> None:
    world, robot, site = fleet("a", "b")
    site.subscribe()
    world.run(2.0)
    world.hops["robot-a"].break_connection(reconnect_s=1.0)
    world.run(5.0)
    assert not site.core.peers.look(now=site.now)
    site.subscribe("/pose")
    world.run(3.0)
    assert view(site).status is PeerStatus.CONNECTED and robot.core.link.established
