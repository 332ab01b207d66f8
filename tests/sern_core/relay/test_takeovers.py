"""A client that begins sessions at several relays: each of the two is told of every turn."""

from sern_core.vocabulary.names import peer_name
from sern_core.vocabulary.types import ClientName
from tests.fabric_world import FabricWorld

ROBOT = ClientName("robot")


def test_the_two_relays_are_told_and_no_other() -> None:
    world = FabricWorld("abc").watch()
    world.client_at("a", "robot")
    world.run(2.0)
    for relay in ("b", "a"):
        world.move("robot", relay)
        world.run(2.0)
    assert world.relays["a"].turns == [(ROBOT, peer_name("b"), False), (ROBOT, peer_name("b"), True)]
    assert world.relays["b"].turns == [(ROBOT, peer_name("a"), True), (ROBOT, peer_name("a"), False)]
    assert not world.relays["c"].turns


def test_a_relay_that_is_started_anew_and_a_client_that_comes_again_are_no_turns() -> None:
    world = FabricWorld("ab").watch()
    world.client_at("a", "robot")
    world.run(2.0)
    world.hops["robot-a"].break_connection(reconnect_s=3.0)
    world.hops["a-b"].break_connection(reconnect_s=1.0)
    world.run(6.0)
    world.restart("a")
    world.run(6.0)
    assert world.homes("robot") == ["a"]
    assert not any(relay.turns for relay in world.relays.values())
