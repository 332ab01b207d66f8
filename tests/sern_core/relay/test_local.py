"""Streams whose source is the relay itself (the feed): they are streams like any other."""

from dataclasses import replace

import pytest

from sern_core.relay.access import AccessRule, AccessTable
from sern_core.relay.hub_events import Relayed
from sern_core.vocabulary.errors import RefusedError
from sern_core.vocabulary.message import TopicInfo, TopicSpec
from sern_core.vocabulary.types import ClientName, DropReason, Encoding, PriorityClass, TopicName
from sern_sim.models import LinkModel
from tests.world import World, spec

OWNER = ClientName("feed_unity")
CMD = TopicName("/jackal1/cmd_vel")
ACCESS = AccessTable(
    [
        AccessRule(client="feed_unity", publish=("/jackal1/.*", "/tf")),
        AccessRule(client=".*", publish=(".*",), subscribe=(".*",)),
    ]
)


def info(name: str = CMD, type_name: str = "geometry_msgs/msg/Twist") -> TopicInfo:
    return TopicInfo(TopicName(name), type_name, Encoding.ROS1, "md5", "float64 x")


def opened(world: World, topic_spec: TopicSpec | None = None, name: str = CMD) -> Relayed:
    hub = world.relay.hub
    return hub.local.open(info(name), topic_spec or spec(PriorityClass.CONTROL), OWNER, now=world.relay.now)


def inject(world: World, handle: Relayed, body: bytes, age_s: float = 0.0) -> bool:
    return world.relay.hub.local.inject(handle, body, 77, now=world.relay.now, age_s=age_s)


def drops(world: World, name: str, reason: DropReason) -> int:
    return world.relay.hub.received.topics[TopicName(name)].by_reason[reason]


def test_a_subscriber_gets_it_with_type_definition_and_age() -> None:
    world = World(access=ACCESS).watch()
    robot = world.client("jackal1", LinkModel(rate_bps=1e6, delay_s=0.02).as_stream(), patterns=["/jackal1/cmd_vel"])
    world.run(1.0)
    handle = opened(world)
    world.run(1.0)
    assert inject(world, handle, b"go", age_s=0.1)
    world.run(1.0)
    assert [(got.topic, got.seq, got.body) for got in robot.got] == [(CMD, 1, b"go")]
    assert robot.got[0].age_s == pytest.approx(0.13, abs=0.03)
    assert robot.opened[0].id.origin == OWNER
    assert robot.opened[0].info == replace(info(), reliable=False)
    held = world.relay.hub.objects.get("/jackal1/cmd_vel@feed_unity")
    assert held is not None
    assert (held.kind, held.value, held.owner) == ("command", b"go", OWNER)


def test_opening_twice_is_one_stream_and_closing_ends_it() -> None:
    world = World(access=ACCESS).watch()
    robot = world.client("jackal1", patterns=[".*"])
    world.run(1.0)
    handle = opened(world)
    assert inject(world, handle, b"1")
    assert opened(world) is handle
    world.run(1.0)
    assert inject(world, handle, b"2")
    world.run(1.0)
    world.relay.hub.local.close(handle, now=world.relay.now)
    world.relay.hub.local.close(handle, now=world.relay.now)
    assert not inject(world, handle, b"nowhere")
    world.run(1.0)
    assert len(robot.closed) == 1
    again = opened(world)
    world.run(1.0)
    assert inject(world, again, b"3")
    world.run(1.0)
    assert [(got.seq, got.body) for got in robot.got] == [(1, b"1"), (2, b"2"), (3, b"3")]
    assert len(world.relay.hub.objects) == 1


def test_a_name_has_one_owner_whoever_comes_first() -> None:
    world = World(access=ACCESS).watch()
    site = world.client("site")
    site.publish("/jackal1/goal", spec(PriorityClass.STATE))
    world.run(1.0)
    with pytest.raises(RefusedError) as caught:
        opened(world, name="/jackal1/goal")
    assert caught.value.code == "name_taken"
    assert world.relay.hub.routing.owners(TopicName("/jackal1/goal")) == ("site",)
    handle = opened(world)
    site.publish(CMD, spec(PriorityClass.CONTROL))
    world.run(1.0)
    assert [code for code, _text in site.refusals] == ["name_taken"]
    world.relay.hub.local.close(handle, now=world.relay.now)


def test_access_rules_hold_for_it_and_end_it() -> None:
    world = World(access=ACCESS).watch()
    robot = world.client("jackal1", patterns=[".*"])
    world.run(1.0)
    with pytest.raises(RefusedError) as caught:
        opened(world, name="/husky/cmd_vel")
    assert caught.value.code == "forbidden"
    assert not world.relay.hub.relayed
    handle = opened(world)
    world.run(1.0)
    world.relay.hub.revoke(AccessTable([AccessRule(client="jackal1", subscribe=(".*",))]), now=world.relay.now)
    assert not world.relay.hub.local.is_open(handle)
    assert not inject(world, handle, b"go")
    world.run(1.0)
    assert len(robot.closed) == 1


def test_what_is_older_than_its_lifespan_goes_no_further() -> None:
    world = World(access=ACCESS)
    robot = world.client("jackal1", LinkModel(delay_s=0.05).as_stream(), patterns=[".*"])
    world.run(2.0)
    handle = opened(world, spec(PriorityClass.CONTROL, lifespan_s=0.3))
    world.run(1.0)
    assert inject(world, handle, b"fresh", age_s=0.1)
    assert not inject(world, handle, b"late", age_s=0.31)
    world.run(1.0)
    inject(world, handle, b"late on arrival", age_s=0.29)
    world.run(1.0)
    assert [got.body for got in robot.got] == [b"fresh"]
    assert drops(world, CMD, DropReason.LIFESPAN) == 1


def test_reliable_is_in_order_and_its_bound_is_a_refusal() -> None:
    world = World(access=ACCESS).watch()
    robot = world.client("jackal1", LinkModel(rate_bps=400_000, delay_s=0.02).as_stream(), patterns=[".*"])
    world.run(1.0)
    handle = opened(world, spec(PriorityClass.STATE, reliable=True, max_queue_bytes=35_000), name="/jackal1/path")
    world.run(1.0)
    accepted = [inject(world, handle, b"%05d" % number * 1_000) for number in range(10)]
    assert accepted == [True] * 6 + [False] * 4
    assert drops(world, "/jackal1/path", DropReason.REFUSED) == 4
    world.run(5.0)
    assert inject(world, handle, b"more")
    world.run(1.0)
    assert robot.seqs("/jackal1/path") == [1, 2, 3, 4, 5, 6, 7]


def test_latched_state_reaches_a_late_joiner() -> None:
    world = World(access=ACCESS).watch()
    handle = opened(world, spec(PriorityClass.STATE, latched=True, reliable=True), name="/jackal1/goal")
    assert inject(world, handle, b"old")
    assert inject(world, handle, b"new")
    world.run(1.0)
    late = world.client("late", patterns=[".*"])
    world.run(1.0)
    assert [(got.body, got.replay) for got in late.got] == [(b"new", True)]


def test_several_may_write_tf() -> None:
    world = World(access=ACCESS).watch()
    site = world.client("site", patterns=["/tf"])
    robot = world.client("jackal1", patterns=["/tf"])
    robot.publish("/tf", spec(PriorityClass.STATE, many_writers=True))
    world.run(1.0)
    topic_info = TopicInfo(TopicName("/tf"), "std_msgs/msg/String", Encoding.CDR, "RIHS01_0")
    handle = world.relay.hub.local.open(
        topic_info, spec(PriorityClass.STATE, many_writers=True), OWNER, now=world.relay.now
    )
    world.run(1.0)
    assert inject(world, handle, b"t")
    world.run(1.0)
    assert [got.body for got in site.got] == [got.body for got in robot.got] == [b"t"]


def test_no_client_may_have_the_feeds_name() -> None:
    world = World(access=ACCESS)
    opened(world)
    thief = world.client("feed_unity", patterns=[".*"])
    world.run(2.0)
    assert [code for code, _text in thief.rejections][:1] == ["name"]
    assert "feed_unity" not in world.relay.hub.links


def test_a_client_that_is_there_keeps_its_name() -> None:
    world = World(access=ACCESS)
    world.client("feed_unity")
    world.run(1.0)
    with pytest.raises(RefusedError, match="name of a client"):
        opened(world)
