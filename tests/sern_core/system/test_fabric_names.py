"""A topic's name belongs to one client of the whole fleet: to whoever claimed it first, also after a partition."""

from random import Random

import pytest

from sern_core.vocabulary.types import PriorityClass, TopicName
from tests.exploring import seeds
from tests.fabric_world import FabricWorld
from tests.world import SimClient, spec

POSE = spec(PriorityClass.STATE)


def refusals(client: SimClient) -> list[str]:
    return [code for code, _text in client.refusals]


def owners(world: FabricWorld, topic: str) -> dict[str, tuple[str, ...]]:
    return {name: relay.hub.routing.owners(TopicName(topic)) for name, relay in world.relays.items()}


def test_a_name_that_a_client_of_another_relay_has_is_taken_though_nobody_wants_it() -> None:
    world = FabricWorld(["a", "b"]).watch()
    first, second = world.client_at("a", "first"), world.client_at("b", "second")
    world.run(1.0)
    first.publish("/odom", POSE)
    world.run(1.0)
    second.publish("/odom", POSE)
    world.run(1.0)
    assert refusals(second) == ["name_taken"] and not refusals(first)
    (text,) = (text for _code, text in second.refusals)
    assert "first, a client of the relay a, owns that name" in text


def test_many_may_write_a_name_that_all_declare_so() -> None:
    world = FabricWorld(["a", "b", "c"]).watch()
    writers = [world.client_at("a", "one"), world.client_at("b", "two")]
    site = world.client_at("c", "site", patterns=["/tf"])
    world.run(1.0)
    pairs = [(writer, writer.publish("/tf", spec(PriorityClass.STATE, many_writers=True))) for writer in writers]
    world.run(1.0)
    for writer, tf in pairs:
        writer.every(0.1, tf, bytes(50))
    alone = world.client_at("c", "alone")
    world.run(1.0)
    alone.publish("/tf", POSE)
    world.run(5.0)
    assert {got.stream.origin for got in site.on("/tf")} == {"one", "two"}
    assert refusals(alone) == ["name_taken"]
    assert not any(refusals(writer) for writer in writers)


@pytest.mark.parametrize("later", ["first", "second"])
def test_after_a_partition_the_earlier_claim_holds_everywhere(later: str) -> None:
    world = FabricWorld(["a", "b", "c"]).watch()
    clients = {"first": world.client_at("a", "first"), "second": world.client_at("b", "second")}
    site = world.client_at("c", "site", patterns=["/odom"])
    world.run(1.0)
    for hop in ("a-b", "a-c", "b-c"):
        world.hops[hop].break_connection(reconnect_s=20.0)
    world.run(1.0)
    earlier = "second" if later == "first" else "first"
    for name in (earlier, later):
        pose = clients[name].publish("/odom", POSE)
        clients[name].every(0.1, pose, name.encode())
        world.run(2.0)
    assert not refusals(clients[earlier]) and not refusals(clients[later])
    world.run(30.0)
    assert refusals(clients[later]) == ["name_taken"] and not refusals(clients[earlier])
    assert owners(world, "/odom")["c"] == (earlier,)
    assert set(owners(world, "/odom").values()) <= {(earlier,), ()}, "whoever does not want it does not know it"
    assert [got.body for got in site.on("/odom")][-50:] == [earlier.encode()] * 50


def test_a_client_that_goes_over_keeps_its_names() -> None:
    world = FabricWorld(["a", "b"]).watch()
    robot, other = world.client_at("a", "robot"), world.client_at("b", "other")
    world.run(1.0)
    robot.publish("/odom", POSE)
    world.run(1.0)
    world.move("robot", "b")
    world.run(3.0)
    other.publish("/odom", POSE)
    world.run(3.0)
    assert not refusals(robot) and refusals(other) == ["name_taken"]
    assert owners(world, "/odom")["b"] == ("robot",)


def test_a_name_that_has_become_free_goes_to_who_claims_it_next() -> None:
    world = FabricWorld(["a", "b", "c"]).watch()
    first, second = world.client_at("a", "first"), world.client_at("b", "second")
    site = world.client_at("c", "site", patterns=["/odom"])
    world.run(1.0)
    pose = first.publish("/odom", POSE)
    world.run(2.0)
    first.core.unpublish(pose, now=first.now)
    world.run(2.0)
    pose = second.publish("/odom", POSE)
    world.run(2.0)
    second.every(0.1, pose, b"second")
    world.run(2.0)
    assert not refusals(second)
    assert [got.body for got in site.on("/odom")] and {got.body for got in site.on("/odom")} == {b"second"}


@pytest.mark.parametrize("seed", seeds(12))
def test_whatever_parts_and_dies_one_client_has_a_name_in_the_end(seed: int) -> None:
    world = FabricWorld(["a", "b", "c"], seed).watch(0.25)
    rng = Random(seed)
    rivals = [world.client_at(relay, f"rival_{relay}") for relay in "abc"]
    site = world.client_at(rng.choice("abc"), "site", patterns=["/odom"])
    world.run(2.0)
    for rival in rng.sample(rivals, len(rivals)):
        for _ in range(rng.randint(0, 2)):
            if rng.random() < 0.3:
                world.restart(rng.choice("abc"))
            else:
                world.hops[rng.choice(("a-b", "a-c", "b-c"))].break_connection(reconnect_s=rng.choice((0.5, 3.0, 8.0)))
        pose = rival.publish("/odom", POSE)
        rival.every(0.1, pose, rival.name.encode())
        world.run(rng.choice((0.01, 0.3, 2.0)))
    world.until(world.peers_up, within_s=60.0, what="all relays reach each other")
    world.run(10.0)
    held = {owner for names in owners(world, "/odom").values() for owner in names}
    assert len(held) == 1, owners(world, "/odom")
    assert {got.body.decode() for got in site.on("/odom")[-20:]} == held


@pytest.mark.parametrize("apart_s", [0.0, 0.01, 0.03, 2.0])
def test_of_two_processes_of_one_name_at_two_relays_each_is_told_when_the_other_connects(apart_s: float) -> None:
    """Also one that waits for what it sent to be acknowledged, and that its relay forgets at once."""
    world = FabricWorld(["a", "b"])
    world.run(2.0)
    one = world.client_at("a", "robot", among="a")
    world.run(apart_s)
    other = world.rival_at("b", "robot")
    turns: list[list[bool]] = []
    for _ in range(600):
        world.run(0.1)
        up = [each.core.link.established for each in (one, other)]
        if any(up) and [up] != turns[-1:]:
            turns.append(up)
    assert len(turns) >= 6, "each takes its turn"
    assert not all(turns[-1])
    for relay, (code, why) in (("b", one.rejections[0]), ("a", other.rejections[0])):
        assert code == "displaced" and why.startswith(f"another process connected as robot at the relay {relay}; ")
