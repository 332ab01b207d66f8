"""What viewers publish: a topic of this site while they do, with bodies of ROS."""

import json

import pytest

from sern_client.endpoints.foxglove.frames import Fault
from sern_core.vocabulary.errors import UsageError
from sern_core.vocabulary.types import DropReason, Encoding, TopicName
from sern_runtime import ros_types
from tests.support import until
from tests.viewers import Bridge, Viewer, bridge, viewer

TWIST = "geometry_msgs/msg/Twist"
CMD = TopicName("/cmd_vel")


class Sink:
    def __init__(self, *, accepts: bool = True) -> None:
        self.got: list[bytes] = []
        self.accepts = accepts

    def __call__(self, body: bytes, stamp_ns: int) -> bool:
        assert stamp_ns > 0
        self.got.append(body)
        return self.accepts


def twist(encoding: Encoding, x: float, z: float) -> bytes:
    vector = "geometry_msgs/msg/Vector3"
    linear, angular = ros_types.new(vector, encoding, x=x), ros_types.new(vector, encoding, z=z)
    return ros_types.serialise(ros_types.new(TWIST, encoding, linear=linear, angular=angular), TWIST, encoding)


async def told(person: Viewer, topic: str, *words: str) -> None:
    """Wait until a viewer has been told something about a topic that it publishes."""
    await until(lambda: all(word in person.statuses.get(f"sern/publish{topic}", "") for word in words), f"told {words}")


async def announced(run: Bridge, topic: TopicName = CMD) -> Sink:
    await until(lambda: topic in run.events.infos)
    sink = Sink()
    run.endpoint.subscribe(topic, sink)
    return sink


@pytest.mark.parametrize("encoding", [Encoding.CDR, Encoding.ROS1])
@pytest.mark.parametrize("type_name", ["geometry_msgs/Twist", TWIST])
async def test_commands_in_json(encoding: Encoding, type_name: str) -> None:
    async with bridge(publish=("/cmd_.*",), encoding=str(encoding)) as run:
        async with viewer(run.port) as person:
            assert person.info["supportedEncodings"][0] == "json" and "clientPublish" in person.info["capabilities"]
            await person.advertise(1, CMD, type_name)
            sink = await announced(run)
            info = run.events.infos[CMD]
            assert (info.type_name, info.encoding) == (TWIST, encoding)
            assert info.type_hash == ros_types.topic_info(CMD, TWIST, encoding).type_hash
            await person.publish(1, json.dumps({"linear": {"x": 0.5}, "angular": {"z": -1}}).encode())
            await until(lambda: sink.got == [twist(encoding, 0.5, -1.0)])
        await until(lambda: run.events.removed == [CMD])
        assert run.endpoint.drops == {}


@pytest.mark.parametrize("encoding", [Encoding.CDR, Encoding.ROS1])
async def test_commands_that_are_serialised_already_pass_as_they_are(encoding: Encoding) -> None:
    schema = ros_types.topic_info(CMD, TWIST, encoding).definition
    async with bridge(publish=True) as run, viewer(run.port) as person:
        await person.advertise(7, CMD, "geometry_msgs/Twist", str(encoding), schema=schema, schemaEncoding="ros1msg")
        sink = await announced(run)
        assert run.events.infos[CMD].encoding is encoding
        body = twist(encoding, 1.0, 0.0)
        await person.publish(7, body)
        await until(lambda: sink.got == [body])


async def test_a_type_that_comes_with_its_definition() -> None:
    async with bridge(publish=True) as run, viewer(run.port) as person:
        await person.advertise(1, "/own", "own_msgs/Thing", "cdr", schema="int32 number\n", schemaEncoding="ros2msg")
        await until(lambda: TopicName("/own") in run.events.infos)
        assert run.events.infos[TopicName("/own")].definition == "int32 number\n"


async def test_an_unknown_type_is_told_and_the_bridge_goes_on() -> None:
    async with bridge(publish=True) as run, viewer(run.port) as person:
        await person.advertise(1, "/own", "own_msgs/Thing")
        await person.publish(1, b"{}")
        await told(person, "/own", "own_msgs/msg/Thing is unknown here")
        await until(lambda: run.endpoint.drops == {DropReason.UNKNOWN_CHANNEL: 1})
        assert run.endpoint.shared.faults[Fault.TYPE] == 1 and not run.events.added
        await person.say({"op": "unadvertise", "channelIds": [1]})
        await until(lambda: not person.statuses, "it is taken back")
        await person.advertise(2, CMD, TWIST)
        await announced(run)


@pytest.mark.parametrize(
    ("topic", "type_name", "encoding", "said"),
    [
        ("/odom", TWIST, "json", "`publish` of this site's file does not name it"),
        ("cmd_vel", TWIST, "json", "must start with '/'"),
        ("/cmd_vel", TWIST, "protobuf", "is no encoding that is taken"),
        ("/cmd_vel", "Twist", "json", "is not a message type"),
    ],
    ids=["not_allowed", "name", "encoding", "type"],
)
async def test_what_may_not_be_published(topic: str, type_name: str, encoding: str, said: str) -> None:
    async with bridge(publish=("/?cmd_vel",)) as run, viewer(run.port) as person:
        await person.advertise(1, topic, type_name, encoding, schema="x", schemaEncoding="ros2msg")
        await person.publish(1, b"{}")
        await told(person, topic, said)
        assert not run.events.added


async def test_by_default_nothing_is_published() -> None:
    async with bridge() as run, viewer(run.port) as person:
        assert "clientPublish" not in person.info["capabilities"]
        await person.advertise(1, CMD, TWIST)
        await until(lambda: any(said["op"] == "status" for said in person.said), "the viewer is told")
        assert not run.events.added


@pytest.mark.parametrize(
    "text",
    [b"{", b"[1]", b'{"linear": {"w": 1}}', b'{"linear": {"x": "1"}}', b'{"linear": {"x": NaN}}',
     b'{"linear": {"x": null}}', b'{"linear": {"x": 1e999}}', b"\xff\xfe", b"[" * 100_000, b"null",
     b"{" + b" " * 300_000],
    ids=range(11),
)  # fmt: skip
async def test_json_that_is_no_message_moves_nobody(text: bytes) -> None:
    async with bridge(publish=True) as run, viewer(run.port) as person:
        await person.advertise(1, CMD, TWIST)
        sink = await announced(run)
        await person.publish(1, text)
        await told(person, CMD, "a message was not sent")
        await person.publish(1, b"{}")
        await until(lambda: sink.got == [twist(Encoding.CDR, 0.0, 0.0)])
        assert run.endpoint.drops == {DropReason.UNDECODABLE: 1}
        assert run.endpoint.shared.faults[Fault.MESSAGE] == 1


async def test_two_viewers_with_one_topic() -> None:
    async with bridge(publish=True) as run, viewer(run.port) as first:
        await first.advertise(1, CMD, TWIST)
        sink = await announced(run)
        async with viewer(run.port) as second:
            await second.advertise(1, CMD, "geometry_msgs/Twist")
            await second.publish(1, b"{}")
            await until(lambda: len(sink.got) == 1)
            await second.advertise(2, CMD, "std_msgs/String")
            await second.publish(2, b"{}")
            await told(second, CMD, "another viewer publishes it as geometry_msgs/msg/Twist")
        await first.publish(1, b"{}")
        await until(lambda: len(sink.got) == 2)
        assert not run.events.removed


async def test_what_nobody_sends_and_what_is_refused() -> None:
    async with bridge(publish=True) as run, viewer(run.port) as person:
        await person.advertise(1, CMD, TWIST)
        await person.publish(1, b"{}")
        await told(person, CMD, "nothing of this site's file sends it")
        await until(lambda: run.endpoint.drops == {DropReason.UNWANTED: 1})
        full = Sink(accepts=False)
        subscription = run.endpoint.subscribe(CMD, full)
        run.endpoint.interest(CMD, False)
        await person.publish(1, b"{}")
        await until(lambda: run.endpoint.drops.get(DropReason.REFUSED) == 1)
        subscription.close()
        with pytest.raises(UsageError, match="no viewer publishes"):
            run.endpoint.subscribe(TopicName("/other"), full)
