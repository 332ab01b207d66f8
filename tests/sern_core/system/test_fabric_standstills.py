"""Relays that are cut off from all others for a while, as one is that stands still, while their clients go elsewhere.

Nothing of a client is kept at such a relay when it is back, and nothing waits for it there.
"""

from collections.abc import Callable, Sequence

import pytest

from sern_core.stream.out_channel import OutChannel
from sern_sim.models import LinkModel, Window
from tests.fabric_world import FabricWorld
from tests.world import SimClient, spec

AWAY_S = 20.0


def cut_off(world: FabricWorld, relay: str, *, first: str, later_s: float = 5.0) -> None:
    """The connections of a relay break; the one to `first` is back after AWAY_S, the others `later_s` after that."""
    for name, hop in world.hops.items():
        pair = name.split("-")
        if relay in pair and all(each in world.relays for each in pair):
            hop.break_connection(reconnect_s=AWAY_S if first in pair else AWAY_S + later_s)


def seqs(client: SimClient, topic: str) -> list[int]:
    return [got.seq for got in client.on(topic)]


def begin(world: FabricWorld, robot: SimClient) -> tuple[OutChannel, Callable[[], None]]:
    """The robot's reliable stream flows: its channel, and what ends it."""
    log = robot.publish("/robot/log", spec(reliable=True, depth=1000))
    world.run(3.0)
    stop = robot.every(0.1, log, bytes(50))
    world.run(2.0)
    return log, stop


def whole(world: FabricWorld, robot: SimClient, *sites: SimClient) -> None:
    """All sites have all of it once and in order, and nothing of it is kept anywhere any more."""
    world.until(world.settled, within_s=10.0, what="nothing is kept anywhere")
    for site in sites:
        assert seqs(site, "/robot/log") == list(range(1, len(robot.sent) + 1))
    assert not robot.dropped_out


@pytest.mark.parametrize("to", ["a", "c"])
@pytest.mark.parametrize("first", ["a", "c"])
def test_nothing_waits_at_the_relay_that_a_site_has_left(to: str, first: str) -> None:
    world = FabricWorld(["a", "b", "c"]).watch(0.25)
    robot = world.client_at("a", "robot")
    site = world.client_at("b", "site", patterns=["/robot/.*"])
    log, stop = begin(world, robot)
    cut_off(world, "b", first=first)
    world.run(2.0)
    world.move("site", to)
    world.run(8.0)
    assert len(log.retained) < 20, "the origin waits for a relay that may be gone for good"
    world.run(22.0)
    assert world.homes("site") == [to]
    assert len(log.retained) < 20, "the origin waits for what nobody needs any more"
    stop()
    whole(world, robot, site)


@pytest.mark.parametrize("to", ["a", "c"])
def test_nothing_waits_either_where_nobody_was_cut_off(to: str) -> None:
    world = FabricWorld(["a", "b", "c"]).watch(0.25)
    robot = world.client_at("a", "robot")
    site = world.client_at("b", "site", patterns=["/robot/.*"])
    log, stop = begin(world, robot)
    world.move("site", to)
    world.run(10.0)
    assert len(log.retained) < 20
    stop()
    world.until(world.settled, within_s=5.0, what="nothing is kept anywhere")
    assert seqs(site, "/robot/log") == list(range(1, len(robot.sent) + 1))
    assert not robot.dropped_out


@pytest.mark.parametrize("to", ["b", "c"])
@pytest.mark.parametrize("first", ["b", "c"])
def test_nothing_waits_at_the_relay_that_a_robot_has_left(to: str, first: str) -> None:
    world = FabricWorld(["a", "b", "c"]).watch(0.25)
    robot = world.client_at("a", "robot")
    sites: Sequence[SimClient] = [
        world.client_at("b", "site", patterns=["/robot/.*"]), world.client_at("c", "other", patterns=["/robot/.*"]),
    ]  # fmt: skip
    log, stop = begin(world, robot)
    cut_off(world, "a", first=first)
    world.run(2.0)
    world.move("robot", to)
    world.run(30.0)
    assert world.homes("robot") == [to]
    assert len(log.retained) < 20, "the origin waits for what nobody needs any more"
    stop()
    whole(world, robot, *sites)


@pytest.mark.parametrize("first", ["a", "c"])
def test_a_site_that_comes_back_to_the_relay_it_had_left(first: str) -> None:
    world = FabricWorld(["a", "b", "c"]).watch(0.25)
    robot = world.client_at("a", "robot")
    site = world.client_at("b", "site", patterns=["/robot/.*"])
    _log, stop = begin(world, robot)
    cut_off(world, "b", first=first)
    world.run(2.0)
    world.move("site", "c")
    world.run(26.0)
    world.move("site", "b")
    world.run(5.0)
    assert world.homes("site") == ["b"]
    stop()
    whole(world, robot, site)


def test_clients_stay_at_a_relay_that_is_cut_off_and_lose_nothing() -> None:
    world = FabricWorld(["a", "b", "c"]).watch(0.25)
    robot = world.client_at("a", "robot")
    near = world.client_at("a", "near", patterns=["/robot/.*"])
    far = world.client_at("b", "far", patterns=["/robot/.*"])
    _log, stop = begin(world, robot)
    cut_off(world, "a", first="b")
    world.run(10.0)
    assert len(seqs(near, "/robot/log")) > 100 > len(seqs(far, "/robot/log"))
    world.run(20.0)
    stop()
    whole(world, robot, near, far)


@pytest.mark.parametrize("order", ["robot first", "site first"])
@pytest.mark.parametrize("gone", [False, True])
def test_robot_and_site_leave_a_relay_that_stands_still(order: str, gone: bool) -> None:
    """The other one still takes it for there, and holds for it what its site lacks; until that comes as well."""
    silent = LinkModel(delay_s=0.01, blackouts=(Window(5.0, 20.0),), disconnect_after_s=1.0 if gone else 60.0)
    world = FabricWorld(["b", "c"], between=silent.as_stream()).watch(0.25)
    clients = {"robot": world.client_at("b", "robot"), "site": world.client_at("b", "site", patterns=["/robot/.*"])}
    robot, site = clients["robot"], clients["site"]
    log = robot.publish("/robot/log", spec(reliable=True, depth=1000))
    world.run(3.0)
    stop = robot.every(0.01, log, bytes(50))
    world.run(2.5)
    first, second = ("robot", "site") if order == "robot first" else ("site", "robot")
    world.hops[f"{first}-b"].break_connection(reconnect_s=60.0)  # it does not hear of either's going
    world.hops[f"{second}-b"].break_connection(reconnect_s=60.0)
    world.run(1.0)
    world.move(first, "c")
    world.run(0.13)
    world.move(second, "c")
    world.run(5.0)
    assert not gone or len(log.retained) < 200
    world.run(20.0)
    stop()
    whole(world, robot, site)


@pytest.mark.parametrize("reliable", [True, False])
@pytest.mark.parametrize("first", ["b", "c"])
def test_a_robot_that_comes_back_to_the_relay_it_had_left(first: str, reliable: bool) -> None:
    """Others had refused its streams of that relay, when that was back and did not know yet that it had gone."""
    world = FabricWorld(["a", "b", "c"]).watch(0.25)
    robot = world.client_at("a", "robot")
    sites = [
        world.client_at("b", "site", patterns=["/robot/.*"]), world.client_at("c", "other", patterns=["/robot/.*"]),
    ]  # fmt: skip
    log = robot.publish("/robot/log", spec(reliable=reliable, depth=1000))
    world.run(3.0)
    stop = robot.every(0.1, log, bytes(50))
    world.run(2.0)
    cut_off(world, "a", first=first)
    world.run(2.0)
    world.move("robot", "c")
    world.run(26.0)
    world.move("robot", "a")
    world.run(5.0)
    before = [len(seqs(site, "/robot/log")) for site in sites]
    world.run(5.0)
    stop()
    world.until(world.settled, within_s=10.0, what="nothing is kept anywhere")
    for site, count in zip(sites, before, strict=True):
        got = seqs(site, "/robot/log")
        assert len(got) >= count + 45, "its stream goes on"
        assert got == sorted(set(got))
        assert not reliable or got == list(range(1, len(robot.sent) + 1))
    assert not (reliable and robot.dropped_out)
