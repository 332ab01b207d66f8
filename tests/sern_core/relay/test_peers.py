"""Who is at which relay, and what relays ask each other for: also what no honest one says."""

import pytest

from sern_core.relay.peers import MAX_EPOCH, MOVED_S
from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.names import is_client_name, is_peer, peer_name
from sern_core.vocabulary.types import ClientName, PriorityClass
from tests.fabric_world import FabricWorld
from tests.world import spec

ROBOT = ClientName("robot")


def test_no_client_can_be_called_like_a_relay() -> None:
    assert is_peer(peer_name("hub1")) and not is_client_name(peer_name("hub1"))
    assert not is_peer(ROBOT)


def test_everybody_knows_where_a_client_is_and_the_latest_session_holds() -> None:
    world = FabricWorld(["a", "b", "c"]).watch()
    world.client_at("a", "robot")
    world.run(1.0)
    peers = {name: relay.hub.peers for name, relay in world.relays.items()}
    assert [peers[name].home(ROBOT) for name in "abc"] == [None, "@a", "@a"]
    world.move("robot", "b")
    world.run(1.0)
    assert [peers[name].home(ROBOT) for name in "abc"] == ["@b", None, "@b"]
    assert world.homes("robot") == ["b"]
    now = world.relays["b"].now
    assert peers["b"].moved(ROBOT, now) and not peers["b"].moved(ROBOT, now + MOVED_S)
    assert not peers["c"].moved(ROBOT, now)


@pytest.mark.parametrize(
    "told",
    [
        {}, {"clients": "robot"}, {"clients": [["robot"]]}, {"clients": [["robot", 0]]}, {"clients": [["robot", True]]},
        {"clients": [["robot", MAX_EPOCH]]}, {"clients": [["@a", 1]]}, {"clients": [[7, 1]]}, {"clients": [["", 1]]},
    ],
)  # fmt: skip
def test_what_no_relay_says_of_clients_ends_its_session(told: dict[str, object]) -> None:
    peers = FabricWorld(["a", "b"]).relays["a"].hub.peers
    with pytest.raises(WireError):
        peers.told(peer_name("b"), told, now=0.0)
    peers.validate()


def test_a_relay_cannot_announce_streams_of_a_client_that_is_not_there() -> None:
    world = FabricWorld(["a", "b"]).watch()
    robot = world.client_at("a", "robot")
    robot.publish("/robot/odom", spec(PriorityClass.STATE))
    site = world.client_at("b", "site", patterns=["/.*"])
    world.run(1.0)
    assert [info.id.topic for info in site.opened] == ["/robot/odom"]
    world.relays["b"].hub.peers.told(peer_name("a"), {"clients": []}, now=world.relays["b"].now)
    world.relays["b"].hub.peers.told_left(peer_name("a"), {"clients": ["robot"]}, now=world.relays["b"].now)
    world.hops["a-b"].break_connection(reconnect_s=0.5)
    world.relays["a"].hub.peers.left(ROBOT, now=world.relays["a"].now)
    world.run(3.0)
    assert ("origin", "a announced a stream of robot, who is not there") in world.relays["a"].refusals


def test_relays_ask_for_what_their_clients_want_and_no_more() -> None:
    world = FabricWorld(["a", "b"]).watch()
    robot = world.client_at("a", "robot")
    for topic in ("/robot/odom", "/robot/scan"):
        robot.publish(topic, spec(PriorityClass.STATE))
    site = world.client_at("b", "site", patterns=["/robot/o.*"])
    world.run(1.0)

    def streams() -> list[str]:
        return sorted(identity.topic for identity in world.relays["b"].hub.relayed)

    assert streams() == ["/robot/odom"]
    site.subscribe("/robot/scan")
    world.run(1.0)
    assert streams() == ["/robot/scan"]
    site.subscribe("/none")
    world.run(1.0)
    assert streams() == []
