"""Objects of clients of several relays: one writer each, everybody sees them, and whatever dies or moves, in the end
all see the same."""

from random import Random

import pytest

from sern_core.objects.changes import Put
from sern_core.objects.xr_object import XrObject
from sern_core.relay.access import AccessRule, AccessTable
from sern_core.relay.far_objects import MOVED_S
from sern_core.relay.hub import HubParams
from sern_core.relay.peer_objects import LOOK_S, MAX_PEER_WANTS
from sern_core.site.object_mirror import Selection
from sern_core.stream.out_channel import OutChannel
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.names import peer_name
from sern_core.vocabulary.types import ClientName, Encoding, ObjectKind, TopicName
from tests.exploring import cases
from tests.fabric_world import FabricWorld
from tests.world import OPEN_ACCESS, SimClient, spec

BARE = (Selection(valued=False),)
VALUED = (Selection(),)
BOX = "robot/box"


class Story:
    """What a listener was told, in its order."""

    def __init__(self) -> None:
        self.told: list[tuple[str, bytes | None]] = []

    def changed(self, item: XrObject) -> None:
        self.told.append((item.id, item.value))

    def deleted(self, object_id: str) -> None:
        self.told.append((f"-{object_id}", None))

    @property
    def gone(self) -> list[str]:
        return [object_id[1:] for object_id, _value in self.told if object_id.startswith("-")]


def put(client: SimClient, object_id: str = BOX, value: bytes = b"v", kind: ObjectKind = ObjectKind.OBSTACLE) -> None:
    client.core.objects.put(object_id, kind, "shape_msgs/Box", wall_ns=5, now=client.now, value=value)


def watcher(
    world: FabricWorld, relay: str, name: str, selections: tuple[Selection, ...] = VALUED
) -> tuple[SimClient, Story]:
    site, story = world.client_at(relay, name), Story()
    site.core.mirror.listeners.append(story)
    site.core.subscribe_objects(selections, now=site.now)
    return site, story


def told(site: SimClient) -> dict[str, bytes | None]:
    return {item.id: item.value for item in site.core.mirror.objects.values()}


def shown(world: FabricWorld, relay: str) -> dict[str, bytes | None]:
    return {item.id: item.value for item in world.relays[relay].hub.objects.select()}


def publish(robot: SimClient, topic: str = "/robot/odom", *, definition: str = "float64 x\n") -> OutChannel:
    info = TopicInfo(TopicName(topic), "nav_msgs/msg/Odometry", Encoding.CDR, "RIHS01_0", definition)
    return robot.core.publish(info, spec(latched=True, reliable=True), now=robot.now)


def test_who_wants_the_values_gets_them_and_the_others_are_told_what_there_is() -> None:
    world = FabricWorld(["a", "b", "c"]).watch()
    robot = world.client_at("a", "robot")
    valued, _ = watcher(world, "b", "valued")
    bare, story = watcher(world, "c", "bare", BARE)
    put(robot, value=b"0")
    world.run(1.0)
    assert shown(world, "b") == told(valued) == {BOX: b"0"}
    assert shown(world, "c") == told(bare) == {BOX: None}
    for number in range(1, 20):
        put(robot, value=b"%d" % number)
        world.run(0.1)
    world.run(1.0)
    assert told(valued) == {BOX: b"19"}
    assert story.told == [(BOX, None)], "another value is no news to who wants none"
    found = world.relays["c"].hub.objects.get(BOX)
    assert found is not None and (found.owner, found.kind, found.type_name) == ("robot", "obstacle", "shape_msgs/Box")
    robot.core.objects.delete(BOX, now=robot.now)
    world.run(1.0)
    assert [told(site) for site in (valued, bare)] == [{}, {}]
    assert [shown(world, relay) for relay in "abc"] == [{}, {}, {}]


def test_what_came_from_a_relay_is_told_to_no_other() -> None:
    world = FabricWorld(["a", "b", "c"]).watch()
    robot = world.client_at("a", "robot")
    world.run(1.0)
    world.hops["a-c"].break_connection(reconnect_s=5.0)
    put(robot)
    world.run(3.0)
    assert BOX in shown(world, "b") and BOX not in shown(world, "c")
    world.run(5.0)
    assert BOX in shown(world, "c")
    assert [world.relays["c"].hub.objects.teller(BOX), world.relays["a"].hub.objects.teller(BOX)] == ["@a", None]


def test_values_are_asked_for_while_somebody_wants_them() -> None:
    world = FabricWorld(["a", "b"]).watch()
    robot = world.client_at("a", "robot")
    site, _ = watcher(world, "b", "site", BARE)
    put(robot, value=b"1")
    world.run(1.0)
    assert told(site) == {BOX: None}
    site.core.subscribe_objects([Selection(ObjectKind.OBSTACLE)], now=site.now)
    world.run(1.0)
    assert told(site) == {BOX: b"1"}
    put(robot, value=b"2")
    world.run(1.0)
    assert told(site) == {BOX: b"2"}
    site.core.subscribe_objects(BARE, now=site.now)
    world.run(1.0)
    put(robot, value=b"3")
    world.run(1.0)
    assert shown(world, "b") == {BOX: None}


def test_who_looks_at_a_topic_gets_its_value_and_nobody_else_pays_for_it_later() -> None:
    world = FabricWorld(["a", "b"]).watch()
    robot = world.client_at("a", "robot")
    odom = publish(robot)
    robot.send(odom, b"1")
    put(robot)
    world.run(1.0)
    asked = {"/robot/odom@robot": None, BOX: None}
    assert shown(world, "b") == asked
    hub = world.relays["b"].hub
    hub.exchange.peers.look("", "/robot/odom", now=world.relays["b"].now)
    hub.exchange.peers.look("", "no name", now=world.relays["b"].now)
    world.run(1.0)
    assert shown(world, "b") == asked | {"/robot/odom@robot": b"1"}
    robot.send(odom, b"2")
    world.run(1.0)
    assert shown(world, "b") == asked | {"/robot/odom@robot": b"2"}
    world.run(LOOK_S)
    robot.send(odom, b"3")
    world.run(1.0)
    assert shown(world, "b") == asked


def test_a_relay_whose_clients_want_very_much_asks_for_everything() -> None:
    world = FabricWorld(["a", "b"]).watch()
    robot = world.client_at("a", "robot")
    put(robot)
    for number in range(MAX_PEER_WANTS // 20 + 1):
        site = world.client_at("b", f"site{number}")
        site.core.subscribe_objects([Selection(None, f"robot/{number}/{each}") for each in range(20)], now=site.now)
    world.run(2.0)
    assert shown(world, "b") == {BOX: b"v"}
    assert not world.relays["a"].refusals


def test_texts_of_definitions_come_along_each_once() -> None:
    world = FabricWorld(["a", "b"]).watch()
    robot = world.client_at("a", "robot")
    for number in range(3):
        publish(robot, f"/robot/t{number}")
    site, _ = watcher(world, "b", "site", BARE)
    world.run(2.0)
    assert {item.definition for item in site.core.mirror.objects.values()} == {"float64 x\n"}
    hub = world.relays["b"].hub
    item = hub.objects.get("/robot/t0@robot")
    assert item is not None and item.definition == "", "kept once, not with each object"
    assert hub.exchange.peers.far.text("/robot/t0@robot")[0] == "float64 x\n"
    assert not hub.relayed, "nobody takes it"


def test_a_stream_that_is_relayed_here_speaks_for_itself() -> None:
    world = FabricWorld(["a", "b"]).watch()
    robot = world.client_at("a", "robot")
    odom = publish(robot)
    robot.send(odom, b"1")
    watching, story = watcher(world, "b", "watching", BARE)
    world.run(1.0)
    hub, object_id = world.relays["b"].hub, "/robot/odom@robot"
    assert hub.objects.teller(object_id) == "@a"
    taker = world.client_at("b", "taker", patterns=["/robot/odom"])
    world.run(1.0)
    assert hub.objects.teller(object_id) is None and shown(world, "b") == {object_id: b"1"}
    robot.send(odom, b"2")
    world.run(1.0)
    assert shown(world, "b") == {object_id: b"2"}
    taker.subscribe("/none")
    world.run(1.0)
    assert not hub.relayed and hub.objects.teller(object_id) == "@a"
    assert told(watching) == {object_id: None} and not story.gone


def test_a_client_that_moves_takes_its_objects_along() -> None:
    """Who watches sees none of them go."""
    world = FabricWorld(["a", "b", "c"]).watch()
    robot = world.client_at("a", "robot")
    put(robot, value=b"1")
    sites = {relay: watcher(world, relay, f"site_{relay}") for relay in "abc"}
    world.run(2.0)
    for number, relay in enumerate("bcab"):
        world.move("robot", relay)
        put(robot, value=b"%d" % number)
        world.run(3.0)
        for site, story in sites.values():
            assert told(site) == {BOX: b"%d" % number}
            assert not story.gone
        tellers = {other: world.relays[other].hub.objects.teller(BOX) for other in "abc"}
        assert tellers == {other: None if other == relay else f"@{relay}" for other in "abc"}
    world.run(2 * MOVED_S)
    assert [told(site) for site, _story in sites.values()] == [{BOX: b"3"}] * 3


def test_another_process_of_a_client_that_moved_has_what_it_puts_and_no_more() -> None:
    world = FabricWorld(["a", "b", "c"]).watch()
    robot = world.client_at("a", "robot")
    put(robot)
    publish(robot)
    world.run(2.0)
    world.move("robot", "b")
    again = world.restart_client("robot")
    world.run(1.0)
    assert all(BOX in shown(world, relay) for relay in "abc"), "it may be about to tell"
    put(again, "robot/other")
    world.run(2 * MOVED_S)
    assert [sorted(set(shown(world, relay)) - {"/robot/odom@robot"}) for relay in "abc"] == [["robot/other"]] * 3


def test_what_is_told_while_relays_do_not_reach_each_other_comes_later_and_nothing_goes_meanwhile() -> None:
    world = FabricWorld(["a", "b"]).watch()
    robot = world.client_at("a", "robot")
    site, story = watcher(world, "b", "site")
    put(robot, value=b"1")
    put(robot, "robot/wall")
    world.run(2.0)
    world.hops["a-b"].break_connection(reconnect_s=30.0)
    world.run(1.0)
    put(robot, value=b"2")
    robot.core.objects.delete("robot/wall", now=robot.now)
    world.run(25.0)
    assert told(site) == {BOX: b"1", "robot/wall": b"v"}
    world.run(10.0)
    assert told(site) == {BOX: b"2"} and story.gone == ["robot/wall"]


def test_a_relay_that_is_gone_for_good_takes_its_objects_along_and_brings_them_back() -> None:
    world = FabricWorld(["a", "b"], hub_params=HubParams(resume_s=5.0)).watch()
    robot = world.client_at("a", "robot")
    site, _ = watcher(world, "b", "site")
    mine, _ = watcher(world, "a", "mine")
    put(robot)
    put(site, "site/door")
    world.run(2.0)
    world.hops["a-b"].break_connection(reconnect_s=20.0)
    world.run(15.0)
    assert told(site) == {} and told(mine) == {BOX: b"v"}
    world.run(10.0)
    assert told(site) == {BOX: b"v"} and told(mine) == {BOX: b"v", "site/door": b"v"}


@pytest.mark.parametrize("forgets", ["a", "b"])
def test_of_two_relays_one_alone_may_have_forgotten_the_other(forgets: str) -> None:
    world = FabricWorld(["a", "b"]).watch()
    robot, site = world.client_at("a", "robot"), world.client_at("b", "site")
    put(robot)
    put(site, "site/door")
    world.run(2.0)
    world.hops["a-b"].break_connection(reconnect_s=3.0)
    world.run(1.0)
    relay = world.relays[forgets]
    relay.hub.forget(ClientName("@b" if forgets == "a" else "@a"), "test", now=relay.now)
    world.run(1.0)
    assert len(shown(world, forgets)) == 1
    world.run(5.0)
    assert [sorted(shown(world, relay)) for relay in "ab"] == [[BOX, "site/door"]] * 2


@pytest.mark.parametrize("dies", ["a", "b"])
def test_a_relay_that_begins_anew_has_them_all_again(dies: str) -> None:
    world = FabricWorld(["a", "b"]).watch()
    robot = world.client_at("a", "robot")
    site, _ = watcher(world, "b", "site")
    put(robot)
    put(robot, "robot/wall")
    world.run(2.0)
    world.restart(dies)
    robot.core.objects.delete("robot/wall", now=robot.now)
    world.run(10.0)
    assert told(site) == {BOX: b"v"}
    assert [sorted(shown(world, relay)) for relay in "ab"] == [[BOX]] * 2


def test_the_rules_of_each_relay_hold_for_what_it_shows() -> None:
    world = FabricWorld(["a", "b", "c"]).watch()
    robot = world.client_at("a", "robot")
    sites = {relay: watcher(world, relay, f"site_{relay}")[0] for relay in "bc"}
    strict = AccessTable(
        [AccessRule(client="robot", publish=("/robot/w.*",)), AccessRule(client="site_.*", subscribe=(".*",))]
    )
    relay = world.relays["b"]
    relay.hub.revoke(strict, now=relay.now)
    put(robot)
    put(robot, "robot/wall")
    world.run(2.0)
    assert told(sites["b"]).keys() == shown(world, "b").keys() == {"robot/wall"}
    assert told(sites["c"]).keys() == {BOX, "robot/wall"}
    assert [code for code, _text in relay.refusals] == ["forbidden"]
    assert relay.hub.exchange.counts["forbidden"] >= 1
    relay.hub.revoke(OPEN_ACCESS, now=relay.now)
    world.run(2.0)
    assert told(sites["b"]).keys() == {BOX, "robot/wall"}
    relay.hub.revoke(strict, now=relay.now)
    world.run(2.0)
    assert told(sites["b"]).keys() == {"robot/wall"}


def test_transforms_are_judged_by_the_topic_that_they_were_read_on() -> None:
    world = FabricWorld(["a", "b"]).watch()
    world.client_at("a", "robot")
    strict = AccessTable([AccessRule(client="robot", publish=("/tf",))])
    for relay in world.relays.values():
        relay.hub.revoke(strict, now=relay.now)
    world.run(1.0)
    for object_id, topic in (
        ("tf:map>base@robot", "/tf"),
        ("tf:map>odom@robot", "/robot/tf"),
        ("/secret@robot", "/tf"),
    ):
        world.relays["a"].hub.objects.put(
            object_id,
            owner=ClientName("robot"),
            kind=ObjectKind.TRANSFORM,
            type_name="geometry_msgs/msg/TransformStamped",
            attributes={"topic": topic},
            wall_ns=0,
            now=world.relays["a"].now,
        )
    world.run(1.0)
    assert shown(world, "b").keys() == {"tf:map>base@robot"}


def test_an_id_that_two_have_taken_at_two_relays_is_whose_it_is_at_each_until_one_goes() -> None:
    world = FabricWorld(["a", "b", "c"]).watch()
    robot, site = world.client_at("a", "robot"), world.client_at("b", "site")
    world.run(1.0)
    world.hops["a-b"].break_connection(reconnect_s=5.0)
    put(robot, "shared/box", b"robot")
    put(site, "shared/box", b"site")
    world.run(10.0)

    def owners() -> list[str]:
        items = [world.relays[relay].hub.objects.get("shared/box") for relay in "abc"]
        return ["" if item is None else item.owner for item in items]

    assert owners()[:2] == ["robot", "site"] and owners()[2] in ("robot", "site")
    assert all([code for code, _text in world.relays[relay].refusals] == ["not_owner"] for relay in "ab")
    robot.core.objects.delete("shared/box", now=robot.now)
    world.run(2.0)
    assert owners() == ["site", "site", "site"]


def test_a_client_that_another_relay_has_claimed_for_a_moment_tells_its_objects_again() -> None:
    """As where its relay began anew, and did not know yet that it was elsewhere in between."""
    world = FabricWorld(["a", "b"]).watch()
    robot = world.client_at("a", "robot")
    put(robot, value=b"2")
    world.run(2.0)
    relay, peer = world.relays["a"], peer_name("b")
    old = Put(BOX, "robot", ObjectKind.OBSTACLE, "shape_msgs/Box", "", "", {}, b"1", 1, "", 1, None, 5)
    relay.hub.peers.told(peer, {"clients": [["robot", 2**61]]}, now=relay.now)
    relay.hub.exchange.peers.far.take(peer, old, now=relay.now)
    assert shown(world, "a") == {BOX: b"1"} and world.homes("robot") == []
    world.run(2 * MOVED_S)
    assert world.homes("robot") == ["a"]
    assert shown(world, "a") == {BOX: b"2"} and shown(world, "b") == {BOX: None}


@pytest.mark.parametrize("seed", range(cases(8)))
def test_whatever_dies_parts_or_moves_in_the_end_all_see_the_same(seed: int) -> None:
    world = FabricWorld(["a", "b", "c"], seed, hub_params=HubParams(resume_s=40.0)).watch(0.25)
    rng = Random(seed)
    owners = {name: world.client_at(relay, name) for relay, name in (("a", "robot"), ("b", "rover"))}
    sites = {relay: watcher(world, relay, f"site_{relay}")[0] for relay in "abc"}
    for name, owner in owners.items():
        publish(owner, f"/{name}/odom")
    world.run(2.0)

    def restart() -> None:
        world.restart(rng.choice("abc"))

    def part() -> None:
        world.hops[rng.choice(("a-b", "a-c", "b-c"))].break_connection(reconnect_s=rng.choice((0.5, 3.0, 50.0)))

    def move() -> None:
        world.move(rng.choice(("robot", "rover")), rng.choice("abc"))

    def change() -> None:
        name, owner = rng.choice(list(owners.items()))
        object_id = f"{name}/o{rng.randrange(4)}"
        if rng.random() < 0.3:
            owner.core.objects.delete(object_id, now=owner.now)
        else:
            put(owner, object_id, b"%d" % rng.randrange(1000))

    for _ in range(rng.randint(10, 30)):
        world.run(rng.choice((0.02, 0.1, 0.5, 3.0)))
        rng.choice((restart, part, move, change, change, change))()
    world.until(world.settled, within_s=300.0, what="all are connected")
    world.run(3 * MOVED_S)
    world.until(world.settled, within_s=300.0, what="all is told")
    want: dict[str, bytes | None] = {}
    for owner in owners.values():
        want |= {item.id: item.value for item in owner.core.objects.registry.select()}
    topics = {"/robot/odom@robot", "/rover/odom@rover"}
    for relay, site in sites.items():
        assert {name: value for name, value in shown(world, relay).items() if name not in topics} == want, relay
        assert shown(world, relay).keys() == told(site).keys() == want.keys() | topics
        assert {name: value for name, value in told(site).items() if name not in topics} == want, relay
        # `bad_object`: a client has yet to hear that its relay is another process, and to tell all anew.
        assert {code for code, _text in world.relays[relay].refusals} <= {"origin", "bad_object"}
