"""Several relays: what works through one works through two and three."""

from random import Random

import pytest

from sern_core.vocabulary.types import PriorityClass
from sern_sim.models import LinkModel, Window
from tests.exploring import seeds
from tests.fabric_world import FabricWorld
from tests.world import spec

THIN = LinkModel(rate_bps=256e3, delay_s=0.05, disconnect_after_s=2.0, reconnect_s=0.5).as_stream()


def test_a_pose_goes_from_one_relay_to_the_clients_of_another() -> None:
    world = FabricWorld(["a", "b", "c"]).watch()
    robot = world.client_at("a", "robot")
    here, there = (
        world.client_at("a", "here", patterns=["/robot/.*"]),
        world.client_at("b", "there", patterns=["/robot/.*"]),
    )
    aside = world.client_at("c", "aside", patterns=["/other"])
    pose = robot.publish("/robot/odom", spec(PriorityClass.CONTROL))
    world.run(2.0)
    robot.every(0.02, pose, bytes(100))
    world.run(5.0)
    for site in (here, there):
        seqs = [got.seq for got in site.on("/robot/odom")]
        assert seqs == sorted(set(seqs)) and len(seqs) > 240
    assert not aside.got
    assert not any(identity.topic == "/robot/odom" for identity in world.relays["c"].hub.relayed)


def test_nothing_goes_round_in_circles_and_unwanted_streams_stay() -> None:
    world = FabricWorld(["a", "b", "c"]).watch()
    robot = world.client_at("a", "robot")
    sites = [world.client_at(relay, f"site_{relay}", patterns=["/.*"]) for relay in ("a", "b", "c")]
    pose = robot.publish("/robot/odom", spec(PriorityClass.STATE))
    world.run(2.0)
    robot.every(0.1, pose, bytes(100))
    world.run(10.0)
    for site in sites:
        seqs = [got.seq for got in site.on("/robot/odom")]
        assert seqs == sorted(set(seqs)) and len(seqs) > 95
    for relay in world.relays.values():
        assert not relay.refusals
    for name in ("b", "c"):
        hub = world.relays[name].hub
        (relayed,) = hub.relayed.values()
        assert set(relayed.outs) == {f"site_{name}"}


def test_a_site_that_comes_later_gets_what_is_latched() -> None:
    world = FabricWorld(["a", "b"]).watch()
    robot = world.client_at("a", "robot")
    described = robot.publish("/robot/description", spec(reliable=True, latched=True))
    world.run(1.0)
    robot.send(described, b"a robot")
    world.run(1.0)
    first = world.client_at("b", "first", patterns=["/robot/.*"])
    world.run(2.0)
    second = world.client_at("b", "second", patterns=["/robot/description"])
    world.run(2.0)
    for site in (first, second):
        assert [got.body for got in site.on("/robot/description")] == [b"a robot"]


@pytest.mark.parametrize("seed", range(6))
def test_reliable_streams_lose_nothing_whatever_process_dies(seed: int) -> None:
    world = FabricWorld(["a", "b"], seed).watch(0.25)
    robot = world.client_at("a", "robot", THIN)
    site = world.client_at("b", "site", THIN, patterns=["/robot/.*"])
    log = robot.publish("/robot/log", spec(reliable=True, depth=1000))
    world.run(3.0)
    stop = robot.every(0.1, log, bytes(50))
    for name in ("a", "b", "b", "a"):
        world.run(1.0 + seed * 0.37)
        world.restart(name)
    world.run(2.0)
    stop()
    world.until(world.quiet, within_s=300.0, what="everything has arrived")
    seqs = [got.seq for got in site.on("/robot/log")]
    assert seqs == list(range(1, len(seqs) + 1)) and len(seqs) == len(robot.sent) > 50
    assert not robot.dropped_out


def test_what_a_site_has_not_confirmed_is_kept_while_it_is_away() -> None:
    world = FabricWorld(["a", "b"]).watch(0.25)
    away = LinkModel(
        rate_bps=256e3, delay_s=0.05, disconnect_after_s=2.0, reconnect_s=0.5, blackouts=(Window(5.0, 40.0),)
    ).as_stream()
    robot, site = world.client_at("a", "robot"), world.client_at("b", "site", away, patterns=["/robot/.*"])
    log = robot.publish("/robot/log", spec(reliable=True, depth=1000))
    world.run(3.0)
    stop = robot.every(0.1, log, bytes(50))
    world.run(7.0)
    assert log.retained and log.required == ("site",)
    world.run(30.0)
    stop()
    world.until(world.quiet, within_s=60.0, what="everything has arrived")
    assert [got.seq for got in site.on("/robot/log")] == list(range(1, len(robot.sent) + 1))


FOUND = (30, 43, 53, 54, 84, 195, 1097, 3034, 1171950521)
"""Seeds of worlds that lost something once."""


@pytest.mark.parametrize("seed", [*FOUND, *seeds(8)])
def test_whatever_dies_parts_or_moves_a_reliable_stream_is_whole_or_what_is_missing_is_reported(seed: int) -> None:
    world = FabricWorld(["a", "b", "c"], seed).watch(0.25)
    rng = Random(seed)
    robot = world.client_at("a", "robot", THIN)
    site = world.client_at("b", "site", THIN, patterns=["/robot/.*"])
    beside = world.client_at("c", "beside", THIN, patterns=["/robot/log"])
    log = robot.publish("/robot/log", spec(reliable=True, depth=1000))
    world.run(3.0)
    stop = robot.every(0.1, log, bytes(50))

    def restart() -> None:
        world.restart(rng.choice("abc"))

    def part() -> None:
        world.hops[rng.choice(("a-b", "a-c", "b-c"))].break_connection(reconnect_s=rng.choice((0.5, 3.0)))

    def move() -> None:
        world.move(rng.choice(("robot", "site", "beside")), rng.choice("abc"))

    for _ in range(rng.randint(2, 6)):
        world.run(rng.choice((0.05, 0.5, 2.0, 5.0)))
        rng.choice((restart, part, move))()
    world.run(3.0)
    stop()
    world.until(world.settled, within_s=900.0, what="everything has arrived or is given up")
    for client in (site, beside):
        seqs = [got.seq for got in client.on("/robot/log")]
        assert seqs == sorted(set(seqs)), "twice, or out of order"
        missing = set(range(1, len(robot.sent) + 1)) - set(seqs)
        reported = {dropped.seq for dropped in robot.dropped_out}
        assert missing <= reported, f"{client.name} lacks {sorted(missing - reported)}, and nobody says so"


@pytest.mark.parametrize("back_s", [0.3, 2.0, 8.0])
def test_a_relay_that_dies_and_is_back_before_its_client_loses_nothing(back_s: float) -> None:
    world = FabricWorld(["a", "b"]).watch(0.25)
    robot = world.client_at("a", "robot")
    site = world.client_at("b", "site", THIN, patterns=["/robot/.*"])
    log = robot.publish("/robot/log", spec(reliable=True, depth=1000))
    world.run(3.0)
    stop = robot.every(0.02, log, bytes(50))
    world.run(2.0)
    world.restart("b")
    world.hops["site-b"].break_connection(reconnect_s=back_s)
    world.run(2.0)
    stop()
    world.until(world.quiet, within_s=120.0, what="everything has arrived")
    assert [got.seq for got in site.on("/robot/log")] == list(range(1, len(robot.sent) + 1))
    assert not robot.dropped_out
