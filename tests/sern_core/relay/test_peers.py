"""Who is at which relay, and what relays ask each other for: also what no honest one says."""

import pytest

from sern_core.relay.peers import MAX_CLIENTS, MAX_EPOCH
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


def test_a_client_is_where_it_is_also_for_a_relay_that_heard_of_its_move_from_nobody() -> None:
    """It goes from one relay to another that cannot tell the third, and that begins anew with lower epochs."""
    world = FabricWorld(["a", "b", "c"]).watch()
    world.client_at("c", "robot")
    world.run(1.0)
    world.move("robot", "b")
    world.run(1.0)
    homes = {name: relay.hub.peers.home for name, relay in world.relays.items()}
    assert homes["a"](ROBOT) == "@b"
    world.hops["a-c"].break_connection(reconnect_s=5.0)
    world.move("robot", "c")
    world.run(2.0)
    assert homes["a"](ROBOT) is None and homes["b"](ROBOT) == "@c"
    world.restart("c")
    world.run(10.0)
    assert homes["a"](ROBOT) == homes["b"](ROBOT) == "@c"
    assert world.homes("robot") == ["c"]


def test_what_a_relay_said_that_was_not_right_then_holds_when_the_other_has_left() -> None:
    peers = FabricWorld(["a", "b", "c"]).relays["a"].hub.peers
    b, c = peer_name("b"), peer_name("c")
    peers.told(b, {"clients": [["robot", 2]]}, now=0.0)
    peers.told(c, {"clients": [["robot", 1]]}, now=0.0)
    assert peers.home(ROBOT) == b
    peers.told_left(b, {"clients": ["robot"]}, now=0.0)
    assert peers.home(ROBOT) == c
    peers.told_left(c, {"clients": ["robot", "other"]}, now=0.0)
    assert peers.home(ROBOT) is None
    peers.came(ROBOT, now=0.0)
    peers.came(ROBOT, now=0.0)
    peers.told(c, {"clients": [["robot", 1]]}, now=0.0)
    assert peers.home(ROBOT) is None
    peers.left(ROBOT, now=0.0)
    assert peers.home(ROBOT) == c
    peers.validate()


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


def test_a_relay_cannot_fill_another_with_clients_that_it_makes_up() -> None:
    hub = FabricWorld(["a", "b"]).relays["a"].hub
    with pytest.raises(WireError, match="more than"):
        hub.peers.told(peer_name("b"), {"clients": [[f"c{number}", 1] for number in range(MAX_CLIENTS + 1)]}, now=0.0)
    assert hub.peers.counts() == {peer_name("b"): MAX_CLIENTS}
    hub.peers.validate()


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


def test_a_relay_may_ask_for_as_much_as_many_clients_want() -> None:
    world = FabricWorld(["a", "b"])
    robot = world.client_at("a", "robot")
    robot.publish("/robot/odom", spec(PriorityClass.STATE))
    for number in range(4):
        site = world.client_at("b", f"site{number}", patterns=[f"/t{number}/{each}" for each in range(2000)])
    site.subscribe("/robot/odom", *(f"/t3/{each}" for each in range(2000)))
    world.run(5.0)
    assert [info.id.topic for info in site.opened] == ["/robot/odom"]
    assert not world.relays["a"].refusals
