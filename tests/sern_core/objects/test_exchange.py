"""Objects over the link: who puts, who is told, in what order, and what a blackout leaves to tell."""

from collections.abc import Iterable

import pytest

from sern_core.objects.changes import OBJECTS_TOPIC
from sern_core.objects.object_limits import ObjectLimits
from sern_core.objects.xr_object import XrObject
from sern_core.relay.access import AccessRule, AccessTable
from sern_core.relay.hub import HubParams
from sern_core.site.object_mirror import Selection
from sern_core.vocabulary.errors import RefusedError, UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import ClientName, Encoding, ObjectKind, PriorityClass, TopicName
from sern_sim.models import LinkModel, Window
from tests.world import SimClient, World, spec

ALL = (Selection(),)


class Story:
    """What a listener was told, in its order."""

    def __init__(self) -> None:
        self.told: list[tuple[str, bytes | None]] = []

    def changed(self, item: XrObject) -> None:
        self.told.append((item.id, item.value))

    def deleted(self, object_id: str) -> None:
        self.told.append((f"-{object_id}", None))


def put(client: SimClient, object_id: str, value: bytes = b"v", kind: ObjectKind = ObjectKind.OBSTACLE) -> None:
    client.core.objects.put(object_id, kind, "shape_msgs/Box", wall_ns=5, now=client.now, value=value)


def pair(
    world: World, selections: Iterable[Selection] = ALL, down: LinkModel | None = None
) -> tuple[SimClient, SimClient, Story]:
    world.tell_objects()
    robot, site = world.client("robot"), world.client("site", down, down)
    story = Story()
    site.core.mirror.listeners.append(story)
    site.core.subscribe_objects(tuple(selections), now=site.now)
    return robot, site, story


def values(site: SimClient) -> dict[str, bytes | None]:
    return {item.id: item.value for item in site.core.mirror.objects.values()}


def checked(world: World) -> None:
    world.relay.hub.validate()
    for client in world.clients.values():
        client.core.mirror.validate()
        client.core.objects.registry.validate()
    world.check_faults()


def test_a_subscriber_gets_what_is_there_and_then_every_change_in_order() -> None:
    world = World()
    robot, site, story = pair(world)
    put(robot, "robot/box", b"1")
    world.run(1.0)
    assert story.told == [("robot/box", b"1")]
    put(robot, "robot/box", b"2")
    put(robot, "robot/ball")
    robot.core.objects.delete("robot/box", now=robot.now)
    world.run(1.0)
    assert story.told[-1] == ("-robot/box", None) and ("robot/ball", b"v") in story.told
    late = world.client("late")
    late.core.subscribe_objects(ALL, now=late.now)
    world.run(1.0)
    assert values(late) == values(site) == {"robot/ball": b"v"}
    found = late.core.mirror.objects["robot/ball"]
    assert (found.owner, found.kind, found.type_name, found.wall_ns) == ("robot", "obstacle", "shape_msgs/Box", 5)
    checked(world)


def test_selections_are_by_kind_and_by_name() -> None:
    world = World()
    robot, site, _story = pair(world, [Selection(ObjectKind.ROBOT), Selection(None, "robot/b.*")])
    put(robot, "robot/me", kind=ObjectKind.ROBOT)
    put(robot, "robot/box")
    put(robot, "robot/wall")
    world.run(1.0)
    assert values(site).keys() == {"robot/me", "robot/box"}
    site.core.subscribe_objects([Selection(ObjectKind.OBSTACLE)], now=site.now)
    world.run(1.0)
    assert values(site).keys() == {"robot/box", "robot/wall"}
    site.core.subscribe_objects([], now=site.now)
    world.run(1.0)
    assert values(site) == {}
    checked(world)


def test_an_object_that_changes_all_the_time_is_told_as_it_is_then_and_not_each_time() -> None:
    world = World()
    robot, site, story = pair(world)
    for number in range(200):
        put(robot, "robot/box", b"%d" % number)
        world.run(0.01)
    world.run(0.5)
    assert values(site) == {"robot/box": b"199"}
    assert 10 <= len(story.told) <= 90
    told = [int(value or b"-1") for _id, value in story.told]
    assert told == sorted(told)
    checked(world)


def test_after_a_blackout_only_what_is_new_is_told() -> None:
    world = World()
    robot, site, story = pair(world, down=LinkModel(blackouts=(Window(5.0, 15.0),)).as_stream())
    for number in range(50):
        put(robot, f"robot/o{number}", bytes(400))
    world.run(4.0)
    assert len(story.told) == 50
    story.told.clear()
    world.run(2.0)
    for number in range(80):
        put(robot, "robot/o7", b"%d" % number)
        world.run(0.1)
    robot.core.objects.delete("robot/o8", now=robot.now)
    world.run(20.0)
    assert values(site)["robot/o7"] == b"79" and "robot/o8" not in values(site)
    assert len(story.told) <= 15, "what did not change was told again, or what was overtaken"
    checked(world)


def test_a_client_that_starts_anew_gets_all_and_its_own_old_objects_are_gone() -> None:
    world = World()
    robot, site, _story = pair(world)
    put(robot, "robot/old")
    put(robot, "robot/kept")
    world.run(1.0)
    again = world.restart_client("robot")
    put(again, "robot/kept", b"new")
    world.run(3.0)
    assert values(site) == {"robot/kept": b"new"}
    site = world.restart_client("site")
    site.core.subscribe_objects(ALL, now=site.now)
    world.run(3.0)
    assert values(site) == {"robot/kept": b"new"}
    checked(world)


def test_a_relay_that_starts_anew_has_them_all_again() -> None:
    world = World()
    robot, site, story = pair(world)
    for number in range(20):
        put(robot, f"robot/o{number}")
    world.run(1.0)
    world.restart_relay()
    story.told.clear()
    robot.core.objects.delete("robot/o3", now=robot.now)
    world.run(8.0)
    assert len(world.relay.hub.objects) == 19
    assert len(values(site)) == 19 and ("-robot/o3", None) in story.told
    checked(world)


def test_a_client_that_was_forgotten_and_comes_back_in_the_same_process_tells_and_is_told_anew() -> None:
    world = World(hub_params=HubParams(resume_s=2.0))
    robot, site, _story = pair(world)
    put(robot, "robot/box")
    put(site, "site/door")
    world.run(1.0)
    for name in ("robot", "site"):
        world.hops[name].break_connection(reconnect_s=8.0)
    world.run(5.0)
    assert not world.relay.hub.links and not len(world.relay.hub.objects)
    world.run(10.0)
    put(robot, "robot/box", b"2")
    world.run(2.0)
    assert values(site) == {"robot/box": b"2"}
    assert {item.id for item in world.relay.hub.objects.select()} == {"robot/box", "site/door"}
    checked(world)


def test_access_rules_hold_for_objects_and_a_reload_takes_away_what_is_not_allowed_any_more() -> None:
    rules = [
        AccessRule(client="robot", publish=("/robot/.*",)),
        AccessRule(client="site", publish=("/site/.*",), subscribe=("/robot/.*",)),
    ]
    world = World(access=AccessTable(rules))
    robot, site, story = pair(world)
    put(robot, "robot/open")
    put(robot, "site/door")
    put(site, "site/door")
    put(site, "robot/open", b"mine")
    world.run(1.0)
    assert values(site) == {"robot/open": b"v"}
    assert robot.objects_refused == [("site/door", "forbidden")] and site.objects_refused == [
        ("robot/open", "forbidden")
    ]
    assert world.relay.hub.exchange.counts == {"taken": 4, "forbidden": 2}
    rules[1] = AccessRule(client="site", subscribe=("/other/.*",))
    world.relay.hub.revoke(AccessTable(rules), now=world.relay.now)
    world.run(1.0)
    assert values(site) == {} and story.told[-1] == ("-robot/open", None)
    checked(world)


def test_an_owner_changes_only_its_own() -> None:
    world = World()
    robot, site, _story = pair(world)
    put(robot, "shared/box", b"robot")
    world.run(1.0)
    put(site, "shared/box", b"site")
    world.run(1.0)
    assert values(site) == {"shared/box": b"robot"} and site.objects_refused == [("shared/box", "not_owner")]
    site.core.objects.delete("shared/box", now=site.now)
    world.run(1.0)
    assert values(site) == {"shared/box": b"robot"}
    robot.publish("/robot/odom", spec())
    put(robot, "/robot/odom@robot")
    world.run(1.0)
    assert robot.objects_refused == [("/robot/odom@robot", "not_owner")]
    checked(world)


def test_topics_are_objects_too_with_their_definitions_once() -> None:
    world = World()
    robot, site, _story = pair(world, [Selection(ObjectKind.TOPIC)])
    for name in ("/robot/a", "/robot/b"):
        info = TopicInfo(TopicName(name), "std_msgs/msg/String", Encoding.CDR, "RIHS01_0", "string data")
        channel = robot.core.publish(info, spec(latched=True, reliable=True), now=robot.now)
        robot.send(channel, b"body")
    world.run(2.0)
    found = site.core.mirror.objects
    assert found.keys() == {"/robot/a@robot", "/robot/b@robot"}
    assert {item.definition for item in found.values()} == {"string data"}
    assert {item.value for item in found.values()} == {b"body"}
    assert found["/robot/a@robot"].attributes["topic"] == "/robot/a"
    checked(world)


def test_what_is_wanted_without_its_value_is_told_once_however_often_that_changes() -> None:
    world = World()
    robot, site, story = pair(world, [Selection(ObjectKind.TOPIC, valued=False), Selection(ObjectKind.OBSTACLE)])
    info = TopicInfo(TopicName("/robot/a"), "std_msgs/msg/String", Encoding.CDR, "RIHS01_0", "string data")
    channel = robot.core.publish(info, spec(latched=True, reliable=True), now=robot.now)
    put(robot, "robot/box", b"1")
    world.run(1.0)
    before = story.told.copy()
    assert set(before) == {("/robot/a@robot", None), ("robot/box", b"1")}
    for number in range(50):
        robot.send(channel, b"body %d" % number)
        world.run(0.05)
    put(robot, "robot/box", b"2")
    world.run(1.0)
    assert story.told == [*before, ("robot/box", b"2")]
    topic = site.core.mirror.objects["/robot/a@robot"]
    assert (topic.value_bytes, topic.seq, topic.definition) == (-1, 0, "string data")
    site.core.subscribe_objects([Selection(ObjectKind.TOPIC)], now=site.now)
    world.run(1.0)
    assert values(site) == {"/robot/a@robot": b"body 49"}
    checked(world)


def test_an_object_that_is_wanted_without_its_value_and_with_it_is_told_with_it() -> None:
    world = World()
    robot, site, story = pair(world, [Selection(ObjectKind.OBSTACLE, valued=False), Selection(None, "robot/b.*")])
    put(robot, "robot/box", b"1")
    put(robot, "robot/wall", b"1")
    world.run(1.0)
    assert values(site) == {"robot/box": b"1", "robot/wall": None}
    told = len(story.told)
    put(robot, "robot/wall", b"2")
    world.run(1.0)
    assert len(story.told) == told, "it has another value, and is what it was"
    put(robot, "robot/wall", b"2", kind=ObjectKind.TERRAIN)
    world.run(1.0)
    assert "robot/wall" not in values(site), "it is of a kind that nobody asked for"
    checked(world)


def test_a_pose_passes_the_objects_that_wait() -> None:
    """256 kbit/s: forty kilobytes of objects take over a second, and a pose waits for a datagram or two of them."""
    thin = LinkModel(rate_bps=256_000.0, delay_s=0.02)
    world = World(lossless=False)
    world.tell_objects()
    robot, site = world.client("robot", thin), world.client("site", patterns=["/robot/pose"])
    site.core.subscribe_objects([Selection(ObjectKind.OBSTACLE)], now=site.now)
    pose = robot.publish("/robot/pose", spec(priority=PriorityClass.CONTROL))
    world.run(1.0)
    robot.every(0.05, pose, bytes(200))
    for kind in (b"first", b"second"):  # by the first the link learns what it is
        world.run(2.0)
        since = len(site.on("/robot/pose"))
        for number in range(100):
            put(robot, f"robot/o{number}", kind * 2 + bytes(range(256)) + bytes([number]) * 100)
        world.run(6.0)
    ages = sorted(got.age_s for got in site.on("/robot/pose")[since:])
    assert len(values(site)) == 100
    assert {value[:6] for value in values(site).values() if value} == {b"second"}
    assert ages[int(len(ages) * 0.95)] < 0.12 and ages[-1] < 0.2
    checked(world)


def test_what_is_lost_on_the_way_arrives_all_the_same() -> None:
    world = World(seed=3, lossless=False)
    lossy = LinkModel(delay_s=0.03, loss=0.05)
    robot, site, story = pair(world, down=lossy)
    for number in range(300):
        put(robot, f"robot/o{number % 20}", b"%d" % number)
        world.run(0.05)
    world.run(3.0)
    assert values(site) == values_of(robot)
    checked(world)
    assert len({object_id for object_id, _value in story.told}) == 20


def values_of(owner: SimClient) -> dict[str, bytes | None]:
    return {item.id: item.value for item in owner.core.objects.registry.select()}


def test_what_is_too_large_is_refused_at_once_and_changes_nothing() -> None:
    world = World()
    robot, site, _story = pair(world)
    put(robot, "robot/box", b"1")
    with pytest.raises(UsageError, match="a value of 4097 bytes; at most 4096"):
        put(robot, "robot/box", bytes(4097))
    with pytest.raises(UsageError, match="more than 4096 bytes; put less into its attributes"):
        robot.core.objects.put(
            "robot/box",
            ObjectKind.NODE,
            "a",
            wall_ns=0,
            now=robot.now,
            attributes={f"k{n}": "v" * 100 for n in range(60)},
        )
    with pytest.raises(RefusedError, match="1 to 512 printable"):
        put(robot, "")
    world.run(1.0)
    assert values(site) == {"robot/box": b"1"}
    checked(world)


def test_a_client_fills_what_is_its_own_and_nobody_elses() -> None:
    world = World()
    mallory = world.client("mallory")
    world.tell_objects()
    mallory.core.objects.registry.limits = ObjectLimits(max_bytes_per_owner=2**40, max_total_bytes=2**40)
    mallory.core.objects.registry._values.limits = mallory.core.objects.registry.limits
    for index in range(4095):
        put(mallory, f"x{index:0200d}", bytes(4096))
    world.run(30.0)
    hub = world.relay.hub
    assert hub.objects.total_bytes <= hub.objects.limits.max_bytes_per_owner < hub.objects.limits.max_total_bytes / 4
    assert hub.exchange.counts["registry_full"] > 100 and len(hub.objects) > 500
    hub.forget(ClientName("mallory"), "test", now=world.relay.now)
    assert len(hub.objects) == 0
    checked(world)


def test_the_stream_of_objects_is_nobodys_topic() -> None:
    world = World()
    robot, site, _story = pair(world)
    site.subscribe(".*")
    put(robot, "robot/box")
    world.run(1.0)
    assert OBJECTS_TOPIC not in {info.id.topic for info in world.relay.hub.routing.infos()}
    assert site.opened == [] and site.got == [] and robot.wants == {}
