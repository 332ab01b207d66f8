"""Streams that ended while somebody was still to get messages of them."""

from collections.abc import Callable

import pytest

from sern_core.relay.access import AccessRule, AccessTable
from sern_core.relay.hub import HubParams
from sern_core.stream.out_channel import OutChannel
from sern_core.vocabulary.message import StreamInfo
from sern_core.vocabulary.types import ClientName, DropReason
from tests.fuzz.test_hostile_peer import Hostile, _whole
from tests.world import OPEN_ACCESS, SimClient, World, limited, spec


class Ended:
    """A reliable topic that ended while its subscriber was away and had two messages to get."""

    def __init__(self, access: AccessTable = OPEN_ACCESS, *, reconnect_s: float = 8.0) -> None:
        self.world = World(access=access, hub_params=HubParams(resume_s=60.0)).watch()
        self.robot = self.world.client("robot")
        self.site = self.world.client("site", patterns=["/robot/.*"])
        self.channel = self.robot.publish("/robot/log", spec(reliable=True), "int32 x\n")
        self.world.run(2.0)
        self.world.hops["site"].break_connection(reconnect_s=reconnect_s)
        self.world.run(0.5)
        self.robot.send(self.channel, b"last")
        self.robot.send(self.channel, b"words")
        self.world.run(0.5)
        self.robot.core.unpublish(self.channel, now=self.robot.now)
        self.world.run(0.5)
        assert len(self.world.relay.hub.streams.draining) == 1

    def bodies(self) -> list[bytes]:
        return [got.body for got in self.site.got]

    def dropped(self, reason: DropReason) -> int:
        link = self.world.relay.hub.links[self.site.name]
        return sum(counters.by_reason[reason] for counters in link.sender.ledger.topics.values())


def test_what_waits_of_an_ended_stream_is_delivered() -> None:
    case = Ended()
    case.world.run(20.0)
    assert case.bodies() == [b"last", b"words"]
    assert not case.world.relay.hub.streams.draining and len(case.site.closed) == 1


def test_the_same_stream_goes_on_where_it_ended() -> None:
    case = Ended()
    again = case.robot.publish("/robot/log", spec(reliable=True), "int32 x\n")
    case.world.run(0.5)
    case.robot.send(again, b"back")
    assert not case.world.relay.hub.streams.draining
    case.world.run(20.0)
    assert case.bodies() == [b"last", b"words", b"back"]


Again = Callable[[SimClient], OutChannel]


@pytest.mark.parametrize(
    "again",
    [
        lambda robot: robot.publish("/robot/log", spec(reliable=True), "float64 y\n", type_name="demo/msg/B"),
        lambda robot: robot.publish("/robot/log", spec(reliable=True), "float64 y\n"),
        lambda robot: robot.publish("/robot/log", spec(reliable=True, depth=7), "int32 x\n"),
    ],
    ids=["type", "definition", "properties"],
)
def test_another_stream_of_the_name_does_not_go_on_in_its_channel(again: Again) -> None:
    case = Ended()
    channel = again(case.robot)
    case.world.run(0.5)
    case.robot.send(channel, b"new")
    assert not case.world.relay.hub.streams.draining
    case.world.run(20.0)
    assert case.bodies() == [b"new"], "messages of two streams in one"
    assert case.dropped(DropReason.UNCONFIRMED) + case.dropped(DropReason.DISCONNECTED) == 2
    last: StreamInfo = case.site.opened[-1]
    assert (last.info.type_name, last.info.definition) == (
        channel.stream.info.type_name,
        channel.stream.info.definition,
    )


def test_a_subscriber_that_was_away_is_told_of_another_type() -> None:
    """Also where nothing was left to deliver: the subscriber knows the stream by its name."""
    world = World().watch()
    robot, site = world.client("robot"), world.client("site", patterns=[".*"])
    first = robot.publish("/robot/log", spec(), "int32 x\n")
    world.run(1.0)
    world.hops["site"].break_connection(reconnect_s=2.0)
    world.hops["robot"].break_connection(reconnect_s=1.0)
    robot.core.unpublish(first, now=robot.now)
    second = robot.publish("/robot/log", spec(), "float64 y\n", type_name="demo/msg/B")
    world.run(4.0)
    robot.send(second, b"new")
    world.run(1.0)
    assert [stream.info.type_name for stream in site.opened] == ["std_msgs/msg/String", "demo/msg/B"]
    assert len(site.closed) == 1 and [got.body for got in site.got] == [b"new"]
    (relayed,) = world.relay.hub.relayed.values()
    assert relayed.stream.stream.info.type_name == "demo/msg/B"


NO_SITE = AccessTable([AccessRule(client="robot", publish=(".*",))])
NO_ROBOT = AccessTable([AccessRule(client="site", subscribe=(".*",))])


@pytest.mark.parametrize("access", [NO_SITE, NO_ROBOT], ids=["subscriber", "publisher"])
def test_it_is_not_delivered_after_the_right_to_it_was_taken_away(access: AccessTable) -> None:
    case = Ended()
    case.world.relay.hub.revoke(access, now=case.world.relay.now)
    assert not case.world.relay.hub.streams.draining
    assert case.dropped(DropReason.FORBIDDEN) == 2
    case.world.run(20.0)
    assert not case.site.got


def test_a_stream_whose_publisher_loses_the_right_does_not_drain() -> None:
    case = Ended()
    channel = case.robot.publish("/robot/map", spec(reliable=True))
    case.world.run(0.5)
    case.robot.send(channel, b"map")
    case.world.run(0.5)
    case.world.relay.hub.revoke(NO_ROBOT, now=case.world.relay.now)
    assert not case.world.relay.hub.streams.draining
    case.world.run(20.0)
    assert not case.site.got


def test_nor_after_the_name_of_its_publisher_was_revoked() -> None:
    case = Ended()
    case.world.relay.hub.forget(case.robot.name, "the name is revoked", now=case.world.relay.now)
    assert not case.world.relay.hub.streams.draining
    case.world.run(20.0)
    assert not case.site.got


def test_nor_to_a_client_that_does_not_want_it_any_more() -> None:
    world = World()
    hub, site, robot = world.relay.hub, Hostile(world, "site"), Hostile(world)  # a site that confirms nothing
    site.control({"t": "subscribe", "patterns": [".*"], "more": False})
    robot.announce(1, "/robot/log", reliable=True)
    robot.say(_whole(1, 1, b"x"))
    robot.control({"t": "retract", "ch": 1})
    assert len(hub.streams.draining) == 1
    site.control({"t": "subscribe", "patterns": ["/robot/l.*"], "more": False})
    assert len(hub.streams.draining) == 1
    site.control({"t": "subscribe", "patterns": ["/other/.*"], "more": False})
    assert not hub.streams.draining and not hub.links[site.name].sender.channels
    hub.validate()


def test_a_client_that_stays_away_takes_it_along() -> None:
    case = Ended(reconnect_s=500.0)
    case.world.run(100.0)
    assert not case.world.relay.hub.streams.draining and ClientName("site") not in case.world.relay.hub.links


def test_there_is_a_bound_for_each_client() -> None:
    world = World(link=limited(draining=50))
    site = Hostile(world, "site")
    site.control({"t": "subscribe", "patterns": [".*"], "more": False})
    site.port.disconnected(now=0.0)
    peer = Hostile(world, "mallory")
    for index in range(200):
        peer.announce(1, f"/mallory/t{index}", reliable=True)
        peer.say(_whole(1, 1, b"x"))
        peer.control({"t": "retract", "ch": 1})
        world.relay.hub.validate()
    link = world.relay.hub.links[ClientName("site")]
    assert len(world.relay.hub.streams.draining) == len(link.sender.channels) == 50
    dropped = sum(counters.by_reason[DropReason.QUEUE_FULL] for counters in link.sender.ledger.topics.values())
    assert dropped == 150
    newest = {channel.stream.id.topic for channel in link.sender.channels.values()}
    assert newest == {f"/mallory/t{index}" for index in range(150, 200)}


def test_a_limit_of_the_access_rules_holds_for_it() -> None:
    case = Ended()
    rules = [
        AccessRule(client="robot", publish=(".*",)),
        AccessRule(client="site", subscribe=(".*",), max_queue_bytes=100),
    ]
    case.world.relay.hub.revoke(AccessTable(rules), now=case.world.relay.now)
    assert not case.world.relay.hub.streams.draining
    assert case.dropped(DropReason.QUEUE_FULL) == 2


def test_a_stream_that_is_refused_after_a_change_leaves_nothing_behind() -> None:
    """The rules let it be announced once, and not again with other properties."""
    world = World().watch(0.05)
    robot, site = world.client("robot"), world.client("site", patterns=[".*"])
    other = world.client("other")
    first = robot.publish("/shared/log", spec(reliable=True, latched=True, many_writers=True))
    world.run(1.0)
    second = other.publish("/shared/log", spec(reliable=True, latched=True, many_writers=True))
    world.run(1.0)
    robot.send(first, b"1")
    other.send(second, b"2")
    world.run(1.0)
    robot.core.unpublish(first, now=robot.now)
    first = robot.publish("/shared/log", spec(reliable=True, latched=True, depth=3))  # of one writer now
    world.run(1.0)
    assert [code for code, _text in robot.refusals] == ["name_taken"]
    other.send(second, b"3")
    world.run(1.0)
    assert sorted(got.body for got in site.got) == [b"1", b"2", b"3"]
    assert [stream.origin for stream in world.relay.hub.relayed] == ["other"]


def test_messages_kept_for_late_joiners_follow_the_properties_of_their_stream() -> None:
    world = World().watch(0.05)
    robot = world.client("robot")
    channel = robot.publish("/robot/map", spec(latched=True, depth=1))
    world.run(1.0)
    robot.send(channel, b"1")
    world.run(1.0)
    link, stream = robot.core.link, channel.stream
    for depth, latched in ((3, True), (3, False)):
        channel.stream = StreamInfo(stream.id, stream.info, spec(latched=latched, depth=depth), stream.attributes)
        link.outgoing.announce(channel, world.now)
        world.run(1.0)
        (relayed,) = world.relay.hub.relayed.values()
        assert relayed.stream.stream.spec.depth == depth
        if latched:
            assert relayed.cache is not None and relayed.cache.depth == 3
            assert [message.body for message in relayed.cache.replay()] == [b"1"]
        else:
            assert relayed.cache is None
    world.validate()
