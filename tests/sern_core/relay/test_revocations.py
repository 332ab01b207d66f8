"""Keys that are revoked at one relay: all others hear of it, whoever was away, and no relay fills another's memory."""

from typing import Any

import pytest

from sern_core.relay.revocations import MAX_UNKNOWN, is_key
from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.key_news import KeyRevocation
from sern_core.vocabulary.names import peer_name
from sern_core.vocabulary.types import ClientName
from tests.control_vectors import A_KEY, ANOTHER_KEY
from tests.fabric_world import FabricWorld

ROBOT = ClientName("robot")
ONE, OTHER = KeyRevocation(ROBOT, A_KEY, 1000.5, True), KeyRevocation(ROBOT, ANOTHER_KEY, 2000.0, False)


def put(world: FabricWorld, relay: str, *revocations: KeyRevocation) -> None:
    """They are revoked there, as soon as the world runs on."""
    at = world.relays[relay]
    world.network.after(0.0, lambda _now: at.hub.revocations.put(revocations, now=at.now), node=at)


def heard(world: FabricWorld, relay: str) -> list[KeyRevocation]:
    return [each for _peer, each in world.relays[relay].revoked_keys]


def test_all_relays_that_are_reached_are_told_at_once_and_each_key_once() -> None:
    world = FabricWorld("abc").watch()
    world.run(1.0)
    put(world, "a", ONE)
    world.run(0.1)
    assert [heard(world, name) for name in "abc"] == [[], [ONE], [ONE]]
    put(world, "a", ONE, OTHER)  # a reload reads all of them again
    put(world, "b", ONE)
    world.run(5.0)
    assert [heard(world, name) for name in "abc"] == [[], [ONE, OTHER], [ONE, OTHER]]
    world.hops["a-b"].break_connection(reconnect_s=0.5)
    world.run(5.0)
    assert [heard(world, name) for name in "abc"] == [[], [ONE, OTHER], [ONE, OTHER]]


def test_a_relay_that_was_away_is_told_by_whoever_is_left() -> None:
    world = FabricWorld("abc").watch()
    world.run(1.0)
    for hop, away_s in (("a-c", 1000.0), ("b-c", 10.0)):
        world.hops[hop].break_connection(reconnect_s=away_s)
    put(world, "a", ONE)
    world.run(1.0)
    world.hops["a-b"].break_connection(reconnect_s=1000.0)
    world.run(20.0)
    assert world.relays["c"].revoked_keys == [(peer_name("b"), ONE)]


def test_a_relay_that_is_started_anew_is_told_again() -> None:
    world = FabricWorld("ab").watch()
    put(world, "a", *(each._replace(at_s=float(number)) for number, each in enumerate((ONE, OTHER))))
    world.run(1.0)
    world.restart("b")
    assert not heard(world, "b")
    world.run(5.0)
    assert [each.key for each in heard(world, "b")] == [A_KEY, ANOTHER_KEY]


def key_of(number: int) -> str:
    return f"{number:040d}"


def test_many_are_told_in_many_messages() -> None:
    world = FabricWorld("ab").watch()
    put(world, "a", *(KeyRevocation(ClientName("r" * 63), key_of(number), 1.7e9, True) for number in range(500)))
    world.run(5.0)
    assert len(heard(world, "b")) == 500


def test_a_relay_that_makes_keys_up_fills_nothing_and_what_is_in_the_directory_is_taken_all_the_same() -> None:
    world = FabricWorld("ab")
    world.run(1.0)
    hub = world.relays["a"].hub
    hub.revocations.known = lambda key: key == A_KEY

    def told(*keys: str) -> None:
        said = {"t": "revoked", "keys": [["robot", key, 1.0, False] for key in keys]}
        hub.revocations.told(hub.links[peer_name("b")], said, now=world.relays["a"].now)
        hub.revocations.validate()

    for start in range(0, MAX_UNKNOWN + 64, 64):
        told(*map(key_of, range(start, start + 64)))
    assert len(hub.revocations) == MAX_UNKNOWN and hub.revocations.left_out == 64
    told(ANOTHER_KEY, A_KEY)
    assert hub.revocations.left_out == 65 and heard(world, "a")[-1].key == A_KEY
    hub.revocations.put([OTHER], now=world.relays["a"].now)  # the operator's own are not bounded
    assert len(hub.revocations) == MAX_UNKNOWN + 2


@pytest.mark.parametrize(
    "keys",
    [
        None, "x", [A_KEY], [["robot", A_KEY, 1.0]], [["robot", A_KEY, 1, True]], [["robot", A_KEY, 1.0, 1]],
        [["robot", A_KEY, -1.0, True]], [["robot", A_KEY, float("nan"), True]], [["robot", A_KEY, float("inf"), True]],
        [["robot", A_KEY[1:], 1.0, True]], [["robot", A_KEY[:-1] + "~", 1.0, True]], [["robot", "#" * 40, 1.0, True]],
        [["@b", A_KEY, 1.0, True]], [["../robot", A_KEY, 1.0, True]], [["", A_KEY, 1.0, True]], [[7, A_KEY, 1.0, True]],
    ],
)  # fmt: skip
def test_what_no_relay_says_of_keys_ends_its_session(keys: Any) -> None:
    world = FabricWorld("ab")
    world.run(1.0)
    hub = world.relays["a"].hub
    with pytest.raises(WireError):
        hub.revocations.told(hub.links[peer_name("b")], {"t": "revoked", "keys": keys}, now=world.relays["a"].now)
    assert len(hub.revocations) == 0


def test_what_a_key_is() -> None:
    assert is_key(A_KEY) and is_key(ANOTHER_KEY) and is_key("0" * 40) and is_key("%nSc0" * 8)
    assert not is_key("%nSc1" * 8), "more than 32 bits"
