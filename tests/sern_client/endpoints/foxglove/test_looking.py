"""What viewers see: topics with their types, only what somebody looks at is wanted, late ones get what holds."""

import struct
from dataclasses import replace

import pytest

from sern_client.endpoints import base
from sern_client.tf_latch import TF_TYPE
from sern_core.summaries.transforms import read_transforms
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import DropReason, Encoding, TopicName
from sern_runtime import ros_types
from tests.support import until
from tests.viewers import Viewer, bridge, viewer

CHAT = ros_types.topic_info("/chat", "std_msgs/msg/String", Encoding.CDR)
ODOM = ros_types.topic_info("/jackal1/odom", "nav_msgs/msg/Odometry", Encoding.ROS1)
MAP = ros_types.topic_info("/map", "nav_msgs/msg/OccupancyGrid", Encoding.CDR, latched=True)
STATIC = ros_types.topic_info("/tf_static", "tf2_msgs/msg/TFMessage", Encoding.CDR, latched=True)


def tf_message(*frames: tuple[str, str]) -> bytes:
    transforms = [
        ros_types.new(
            "geometry_msgs/msg/TransformStamped", Encoding.CDR,
            header=ros_types.header(5, parent, Encoding.CDR), child_frame_id=child,
        )
        for parent, child in frames
    ]  # fmt: skip
    return ros_types.serialise(ros_types.new(TF_TYPE, Encoding.CDR, transforms=transforms), TF_TYPE, Encoding.CDR)


def pairs(body: bytes) -> set[tuple[str, str]]:
    return {transform.pair for transform in read_transforms(body, Encoding.CDR)}


def left_of_age(body: bytes) -> float:
    return float(struct.unpack("<f", body[-4:])[0])


async def test_it_is_what_it_says() -> None:
    async with bridge() as run:
        assert isinstance(run.endpoint, base.ViewingEndpoint)
        assert isinstance(run.endpoint, base.ServiceEndpoint)
        assert isinstance(run.endpoint, base.CountingEndpoint)
        assert isinstance(run.endpoint, base.MeasuredEndpoint)
        assert run.endpoint.encoding is None and not run.endpoint.exhausted


@pytest.mark.parametrize(
    ("info", "name", "encoding"),
    [(CHAT, "std_msgs/msg/String", "ros2msg"), (ODOM, "nav_msgs/Odometry", "ros1msg")],
    ids=["ros2", "ros1"],
)
async def test_a_topic_is_a_channel_with_its_type(info: TopicInfo, name: str, encoding: str) -> None:
    async with bridge() as run, viewer(run.port) as person:
        run.endpoint.topic_offered(info)
        await until(lambda: len(person.channels) == 2)
        channel = person.channels[info.name]
        assert channel["encoding"] == info.encoding
        assert (channel["schemaName"], channel["schemaEncoding"], channel["schema"]) == (
            name, encoding, info.definition,
        )  # fmt: skip
        assert person.channels[f"{info.name}/sern/age"]["encoding"] == info.encoding


async def test_definitions_that_are_written_otherwise() -> None:
    three_parts = replace(CHAT, definition="std_msgs/Header header\n" + "=" * 80 + "\nMSG: std_msgs/msg/Header\n")
    idl = replace(
        ODOM, name=TopicName("/idl"), encoding=Encoding.CDR, definition="=" * 80 + "\nIDL: a/msg/B\nmodule a {};"
    )
    unknown = TopicInfo(TopicName("/own"), "own_msgs/Thing", Encoding.CDR)
    raw = TopicInfo(TopicName("/raw"), "own_msgs/Thing", Encoding.RAW)
    async with bridge() as run, viewer(run.port) as person:
        for info in (three_parts, idl, unknown, raw):
            run.endpoint.topic_offered(info)
        await until(lambda: "/own/sern/age" in person.channels)
        assert person.channels["/chat"]["schema"].endswith("\nMSG: std_msgs/Header\n")
        assert person.channels["/idl"]["schemaEncoding"] == "ros2idl"
        assert person.channels["/own"]["schema"] == ""
        assert "/raw" not in person.channels


async def test_what_is_looked_at_is_wanted_while_anybody_looks() -> None:
    async with bridge() as run, viewer(run.port) as first:
        run.endpoint.topic_offered(CHAT)
        await first.look("/chat")
        await until(lambda: run.viewed.wants == [("/chat", True)])
        async with viewer(run.port) as second:
            await second.look("/chat")
            await run.looked_at("/chat", 2)
            publisher = run.endpoint.advertise(CHAT)
            publisher.publish(b"one", 1)
            await first.got_of("/chat")
            await first.look_away("/chat")
            await run.looked_at("/chat", 1)
            publisher.publish(b"two", 2)
            assert await second.got_of("/chat", 2) == [b"one", b"two"]
            assert run.viewed.wants == [("/chat", True)]
        await until(lambda: run.viewed.wants == [("/chat", True), ("/chat", False)])
        assert [shown.body for shown in first.got["/chat"]] == [b"one"]


async def test_a_viewer_that_just_goes_looks_at_nothing_any_more() -> None:
    async with bridge() as run:
        run.endpoint.topic_offered(CHAT)
        async with viewer(run.port) as person:
            await person.look("/chat")
            await until(lambda: run.viewed.wants == [("/chat", True)])
            person.connection.transport.abort()
            await until(lambda: run.viewed.wants[-1] == ("/chat", False))
        await until(lambda: not run.endpoint.shared.viewers)


async def test_what_is_withdrawn_and_what_comes_anyway() -> None:
    async with bridge() as run, viewer(run.port) as person:
        run.endpoint.topic_offered(CHAT)
        publisher = run.endpoint.advertise(ODOM)  # nobody offered it: it comes by `subscribe`
        await person.look("/chat", ODOM.name)
        await until(lambda: run.viewed.wants == [("/chat", True)])
        await run.looked_at(ODOM.name)
        publisher.publish(b"pose", 1)
        assert await person.got_of(ODOM.name) == [b"pose"]
        run.endpoint.topic_withdrawn(CHAT.name)
        await until(lambda: "/chat" not in person.channels and "/chat/sern/age" not in person.channels)
        assert run.viewed.wants == [("/chat", True)], "nobody need say it of what is gone"
        publisher.close()
        await until(lambda: not person.channels)
        publisher.publish(b"late", 1)
        assert run.endpoint.drops == {DropReason.DISCONNECTED: 1}


async def test_what_comes_with_another_definition_than_was_offered_has_another_channel() -> None:
    bare = replace(CHAT, definition="", type_name="own_msgs/Text", type_hash="")
    told = replace(bare, definition="string data\nint32 more\n")
    async with bridge() as run, viewer(run.port) as person:
        run.endpoint.topic_offered(bare)
        await person.look("/chat")
        await until(lambda: run.viewed.wants == [("/chat", True)])
        first = person.channels["/chat"]["id"]
        publisher = run.endpoint.advertise(told)
        await until(lambda: person.channels.get("/chat", {}).get("schema") == told.definition)
        assert person.channels["/chat"]["id"] != first
        await person.look("/chat")
        await run.looked_at("/chat")
        run.endpoint.topic_offered(bare)  # as it was told before: nothing new
        publisher.publish(b"text", 1)
        assert (await person.got_of("/chat"))[-1] == b"text"
        assert run.viewed.wants == [("/chat", True)], "viewers find the new channel; meanwhile it stays wanted"


async def test_two_sites_with_one_name() -> None:
    ros1 = ros_types.topic_info("/chat", "std_msgs/msg/String", Encoding.ROS1)
    async with bridge() as run, viewer(run.port) as person:
        first, second = run.endpoint.advertise(CHAT), run.endpoint.advertise(ros1)
        await person.look("/chat")
        body = {
            each: ros_types.serialise(ros_types.new(CHAT.type_name, each, data="hello"), CHAT.type_name, each)
            for each in (Encoding.CDR, Encoding.ROS1)
        }
        await run.looked_at("/chat")
        first.publish(body[Encoding.CDR], 1)
        second.publish(body[Encoding.ROS1], 1)
        second.publish(b"\xff", 1)
        assert await person.got_of("/chat", 2) == [body[Encoding.CDR]] * 2
        assert run.endpoint.drops == {DropReason.UNDECODABLE: 1}
        with pytest.raises(ConfigError, match=r"/chat: what comes is std_msgs/msg/Int32, and viewers are shown"):
            run.endpoint.advertise(ros_types.topic_info("/chat", "std_msgs/msg/Int32", Encoding.CDR))
        held = base.Held()
        held.publishers["/chat"] = 2  # type: ignore[index]
        assert run.endpoint.validate(held) == []


async def test_a_late_viewer_gets_what_holds_and_gets_it_alone() -> None:
    async with bridge() as run, viewer(run.port) as early:
        publisher = run.endpoint.advertise(MAP)
        await early.look("/map")
        await run.looked_at("/map")
        publisher.publish(b"old map", 1)
        publisher.publish(b"map", 2)
        assert await early.got_of("/map", 2) == [b"old map", b"map"]
        async with viewer(run.port) as late:
            await late.look("/map")
            assert await late.got_of("/map") == [b"map"]
            await run.looked_at("/map", 2)
            publisher.publish(b"new map", 3)
            assert await late.got_of("/map", 2) == [b"map", b"new map"]
        assert await early.got_of("/map", 3) == [b"old map", b"map", b"new map"]
        publisher.close()


async def test_a_late_viewer_gets_the_whole_tree_of_several_sites() -> None:
    async with bridge() as run:
        first, second = run.endpoint.advertise(STATIC), run.endpoint.advertise(STATIC)
        first.publish(tf_message(("map", "jackal1")), 1)
        first.publish(tf_message(("jackal1", "scanner")), 2)
        second.publish(tf_message(("map", "jackal2")), 3)
        async with viewer(run.port) as late:
            await late.look("/tf_static")
            (body,) = await late.got_of("/tf_static")
            assert pairs(body) == {("map", "jackal1"), ("jackal1", "scanner"), ("map", "jackal2")}
        second.close()
        async with viewer(run.port) as later:
            await later.look("/tf_static")
            (body,) = await later.got_of("/tf_static")
            assert pairs(body) == {("map", "jackal1"), ("jackal1", "scanner")}


async def ages(person: Viewer, topic: str, count: int) -> list[float]:
    return [left_of_age(body) for body in await person.got_of(topic, count)]


@pytest.mark.parametrize("info", [CHAT, ODOM], ids=["ros2", "ros1"])
async def test_the_age_of_a_topic_is_a_topic(info: TopicInfo) -> None:
    async with bridge() as run, viewer(run.port) as person:
        run.endpoint.topic_offered(info)
        age = f"{info.name}/sern/age"
        await person.look(age)
        found = await ages(person, age, 1)
        assert found[0] != found[0], "nothing has come yet: not a number"
        run.viewed.set(info.name, 0.5)
        await until(lambda: left_of_age(person.got[age][-1].body) == 0.5)
        run.viewed.set(info.name, 3.0)
        await until(lambda: left_of_age(person.got[age][-1].body) == 3.0)
        assert run.viewed.wants == [], "who looks at the age does not make the topic come"
        size = 4 if info.encoding is Encoding.ROS1 else 8
        assert {len(shown.body) for shown in person.got[age]} == {size}
        ros_types.deserialise(person.got[age][-1].body, "std_msgs/msg/Float32", info.encoding)


async def test_no_age_of_an_age() -> None:
    nested = replace(CHAT, name=TopicName("/chat/sern/age"))
    long = replace(CHAT, name=TopicName("/" + "a" * 254))
    async with bridge() as run, viewer(run.port) as person:
        run.endpoint.topic_offered(nested)
        run.endpoint.topic_offered(long)
        run.endpoint.topic_offered(ODOM)
        await until(lambda: f"{ODOM.name}/sern/age" in person.channels)
        assert set(person.channels) == {nested.name, long.name, ODOM.name, f"{ODOM.name}/sern/age"}


async def test_two_thousand_topics() -> None:
    async with bridge() as run, viewer(run.port) as person:
        names = [f"/robot/topic_{number}" for number in range(2_000)]
        for name in names:
            run.endpoint.topic_offered(replace(CHAT, name=TopicName(name)))
        await person.look(*names)
        await until(lambda: len(run.viewed.wants) == 2_000)
        await run.looked_at(names[-1])
        publisher = run.endpoint.advertise(replace(CHAT, name=TopicName(names[-1])))
        publisher.publish(b"last", 1)
        assert await person.got_of(names[-1]) == [b"last"]
        assert person.closed is None
        assert run.endpoint.drops == {}


async def test_before_its_start() -> None:
    from sern_client.endpoints.foxglove.endpoint import FoxgloveEndpoint
    from sern_client.endpoints.foxglove.options import FoxgloveOptions
    from tests.support import Events

    endpoint = FoxgloveEndpoint(FoxgloveOptions(listen="127.0.0.1:0"))
    endpoint.topic_offered(CHAT)
    endpoint.topic_offered(ODOM)
    endpoint.topic_withdrawn(ODOM.name)
    with pytest.raises(UsageError):
        endpoint.advertise(CHAT)
    with pytest.raises(UsageError, match="no viewer publishes"):
        endpoint.subscribe(CHAT.name, lambda body, stamp_ns: True)
    assert endpoint.validate(base.Held()) == [] and endpoint.drops == {}
    await endpoint.start(Events())
    async with viewer(endpoint.port) as person:
        await until(lambda: set(person.channels) == {"/chat", "/chat/sern/age"})
        await person.look("/chat")  # nobody is asked for it: it comes by `subscribe`, or it does not
        await until(lambda: endpoint.looked_at[CHAT.name])
        publisher = endpoint.advertise(CHAT)
        await person.advertise(1, "/cmd_vel", "geometry_msgs/Twist")
        await until(lambda: any(said["op"] == "status" for said in person.said), "publishing is not offered")
        publisher.publish(b"text", 1)
        await person.got_of("/chat")
    await endpoint.stop()
