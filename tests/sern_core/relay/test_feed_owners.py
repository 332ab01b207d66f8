"""What relays publish themselves (the plain feed's roles), at one relay and at the others."""

import pytest

from sern_core.relay.feed_owners import MAX_OWNERS
from sern_core.relay.hub_events import Relayed
from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.names import peer_name
from sern_core.vocabulary.types import ClientName, Encoding, TopicName
from tests.fabric_world import FabricWorld
from tests.world import spec

OWNER = ClientName("feed_unity")
GOAL = TopicName("/goal")


def publishes(world: FabricWorld, relay: str, *, topic: TopicName = GOAL, latched: bool = False) -> Relayed:
    node = world.relays[relay]
    info = TopicInfo(topic, "std_msgs/msg/String", Encoding.CDR, "")
    return node.hub.local.open(info, spec(reliable=latched, latched=latched), OWNER, now=node.now)


def inject(world: FabricWorld, relay: str, handle: Relayed, body: bytes) -> None:
    node = world.relays[relay]
    assert node.hub.local.inject(handle, body, 0, now=node.now)
    node.hub.after()


def test_what_a_relay_publishes_itself_goes_to_the_clients_of_others() -> None:
    world = FabricWorld(["a", "b", "c"]).watch()
    sites = [world.client_at(relay, f"site_{relay}", patterns=["/goal"]) for relay in "abc"]
    world.run(1.0)
    handle = publishes(world, "a")
    world.run(1.0)
    for number in range(5):
        inject(world, "a", handle, b"%d" % number)
        world.run(0.2)
    for site in sites:
        assert [got.body for got in site.on("/goal")] == [b"%d" % number for number in range(5)]
    assert [world.relays[relay].hub.peers.home(OWNER) for relay in "abc"] == [None, "@a", "@a"]
    assert [world.relays[relay].refusals for relay in "abc"] == [[], [], []]
    found = world.relays["b"].hub.objects.get("/goal@feed_unity")
    assert found is not None and found.owner == OWNER


def test_a_name_that_two_relays_publish_under_is_said_once_and_each_keeps_its_own() -> None:
    world = FabricWorld(["a", "b"]).watch()
    sites = {relay: world.client_at(relay, f"site_{relay}", patterns=["/goal.*"]) for relay in "ab"}
    handles = {"a": publishes(world, "a"), "b": publishes(world, "b", topic=TopicName("/goal_b"))}
    world.run(3.0)
    for relay, handle in handles.items():
        inject(world, relay, handle, relay.encode())
    world.hops["a-b"].break_connection(reconnect_s=0.5)
    world.run(3.0)
    for relay, other in ("ab", "ba"):
        assert [got.body for got in sites[relay].got] == [relay.encode()]
        ((code, text),) = world.relays[relay].refusals
        assert code == "name_taken" and text.startswith(f"both {relay} and {other} have a feed role that publishes as ")
    world.restart("b")  # without that role
    world.run(5.0)
    inject(world, "a", handles["a"], b"2")
    world.run(1.0)
    assert [got.body for got in sites["b"].on("/goal")] == [b"2"]


def test_a_client_of_another_relay_with_such_a_name_is_nobody_here() -> None:
    world = FabricWorld(["a", "b"]).watch()
    handle = publishes(world, "a")
    site = world.client_at("a", "site", patterns=["/.*"])
    world.client_at("b", str(OWNER)).publish("/other", spec())
    world.run(2.0)
    inject(world, "a", handle, b"mine")
    world.run(1.0)
    assert [(got.topic, got.body) for got in site.got] == [("/goal", b"mine")]
    assert world.relays["a"].hub.peers.home(OWNER) is None
    assert [code for code, _text in world.relays["a"].refusals].count("name_taken") == 1


def test_what_is_latched_of_it_comes_to_late_joiners_elsewhere() -> None:
    world = FabricWorld(["a", "b"]).watch()
    world.run(1.0)
    handle = publishes(world, "a", latched=True)
    inject(world, "a", handle, b"there")
    world.run(1.0)
    site = world.client_at("b", "site", patterns=["/goal"])
    world.run(2.0)
    assert [got.body for got in site.on("/goal")] == [b"there"]


def test_a_relay_that_is_gone_publishes_no_more() -> None:
    world = FabricWorld(["a", "b"]).watch()
    publishes(world, "a")
    site = world.client_at("b", "site", patterns=["/goal"])
    world.run(2.0)
    assert [info.id.topic for info in site.opened] == ["/goal"]
    relay = world.relays["b"]
    relay.hub.forget(peer_name("a"), "test", now=relay.now)
    assert relay.hub.peers.home(OWNER) is None


def test_what_the_feed_wants_is_asked_of_other_relays() -> None:
    world = FabricWorld(["a", "b"]).watch()
    robot = world.client_at("a", "robot")
    pose = robot.publish("/robot/odom", spec())
    world.run(1.0)
    hub = world.relays["b"].hub
    assert hub.exchange.peers.far.topics == {"/robot/odom": 1}
    hub.peers.also = lambda: {TopicName("/robot/odom")}
    hub.streams.tap = lambda stream: stream.id.topic == "/robot/odom"
    world.run(1.0)
    robot.send(pose, b"here")
    world.run(1.0)
    assert [message.body for message in world.relays["b"].fed] == [b"here"]
    hub.peers.also = tuple
    world.run(1.0)
    assert not hub.relayed


@pytest.mark.parametrize(
    "told", [{"owners": "feed"}, {"owners": [7]}, {"owners": ["@a"]}, {"owners": [f"f{n}" for n in range(65)]}]
)
def test_what_no_relay_says_of_its_names_ends_its_session(told: dict[str, object]) -> None:
    feeds = FabricWorld(["a", "b"]).relays["a"].hub.feeds
    assert MAX_OWNERS == 64
    with pytest.raises(WireError):
        feeds.told(peer_name("b"), told, now=0.0)
    assert feeds.home(ClientName("f1")) is None
