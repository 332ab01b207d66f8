"""Transforms of /tf as objects: one for each pair of frames, never more often than the rate, gone with the stream."""

import json
import math

import pytest

from sern_core.objects.registry import ObjectRegistry
from sern_core.summaries.transforms import Transform, read_transforms
from sern_core.vocabulary.message import Message, StreamId, StreamInfo, TopicInfo
from sern_core.vocabulary.types import ClientName, Encoding, ObjectKind, TopicName
from sern_relay import transforms
from sern_relay.transforms import TransformObjects
from sern_runtime import ros_types
from tests.support import until
from tests.world import spec

JACKAL = ClientName("jackal1")
TF = "tf2_msgs/msg/TFMessage"
STAMP_NS = 1_700_000_000_123_456_789


def stream(topic: str = "/jackal1/tf", type_name: str = TF, encoding: Encoding = Encoding.ROS1, boot: int = 1,
           *, latched: bool = False) -> StreamInfo:  # fmt: skip
    identity = StreamId(JACKAL, boot, TopicName(topic))
    return StreamInfo(identity, TopicInfo(identity.topic, type_name, encoding), spec(latched=latched))


def body(*pairs: tuple[str, str, float], encoding: Encoding = Encoding.ROS1) -> bytes:
    items = []
    for parent, child, x in pairs:
        item = ros_types.new("geometry_msgs/msg/TransformStamped", encoding, child_frame_id=child,
                             header=ros_types.header(STAMP_NS, parent, encoding))  # fmt: skip
        item.transform.translation.x = x
        item.transform.rotation.w = 1.0
        items.append(item)
    return ros_types.serialise(ros_types.new(TF, encoding, transforms=items), TF, encoding)


class World:
    """Transforms with a clock of its own; `read` lets what is due be read."""

    def __init__(self) -> None:
        self.now_s = 100.0
        self.registry = ObjectRegistry()
        self.elsewhere: set[StreamId] = set()
        self.transforms = TransformObjects(
            self.registry, clock=lambda: self.now_s, elsewhere=lambda stream: stream in self.elsewhere
        )
        self.seq = 0

    def send(self, to: StreamInfo, data: bytes) -> None:
        self.seq += 1
        self.transforms.message(to, Message(to.id, self.seq, data, 77, self.now_s), now=self.now_s)

    async def read(self, *ids: str) -> None:
        await until(lambda: all(self.registry.get(object_id) is not None for object_id in ids), f"{ids}")

    def ids(self) -> list[str]:
        return [item.id for item in self.registry.select(kind=ObjectKind.TRANSFORM)]


@pytest.mark.parametrize("encoding", [Encoding.ROS1, Encoding.CDR])
async def test_a_pair_of_frames_is_an_object(encoding: Encoding) -> None:
    world = World()
    world.send(stream(encoding=encoding), body(("odom", "base_link", 1.5), encoding=encoding))
    await world.read("tf:odom>base_link@jackal1")
    seen = world.registry.get("tf:odom>base_link@jackal1")
    assert seen is not None
    assert (seen.owner, seen.kind, seen.seq, seen.wall_ns) == (JACKAL, "transform", 1, 77)
    assert seen.ros_stamp_ns == STAMP_NS
    assert dict(seen.attributes) == {
        "parent": "odom", "child": "base_link", "static": "false", "topic": "/jackal1/tf",
    }  # fmt: skip
    assert seen.value == b'{"translation":[1.5,0.0,0.0],"rotation":[0.0,0.0,0.0,1.0]}'
    world.transforms.close()


async def test_a_fault_costs_one_reading_and_not_the_stream(monkeypatch: pytest.MonkeyPatch) -> None:
    world = World()

    def broken(*_: object) -> None:
        raise ZeroDivisionError("injected")

    with monkeypatch.context() as patch:
        patch.setattr(transforms, "read_transforms", broken)
        world.send(stream(), body(("odom", "base_link", 1.5)))
        await until(lambda: world.transforms.failures == 1)
    world.now_s += 1.0
    world.send(stream(), body(("odom", "base_link", 2.5)))
    await world.read("tf:odom>base_link@jackal1")
    world.transforms.close()


async def test_a_fast_stream_is_read_at_the_rate_and_all_its_pairs_are_there() -> None:
    world = World()
    tf = stream()
    world.send(tf, body(("a", "b", 0.0)))
    await world.read("tf:a>b@jackal1")
    version = world.registry.version
    for number in range(50):
        world.send(tf, body(("a", "b", float(number))))
        world.send(tf, body(("a", "c", float(number))))
    assert world.registry.version == version  # nothing on the way of the messages
    world.now_s += 1.0 / transforms.RATE_HZ - 0.01
    assert world.transforms._timer.deadline_s == pytest.approx(100.2)
    world.now_s += 0.02
    await world.read("tf:a>c@jackal1")
    assert world.registry.version == version + 2  # one change for each pair, whatever the number of messages
    newest = world.registry.get("tf:a>b@jackal1")
    assert newest is not None
    assert newest.value is not None
    assert json.loads(newest.value)["translation"][0] == 49.0
    world.transforms.close()


async def test_static_ones_are_marked_and_go_with_their_stream() -> None:
    world = World()
    tf, static = stream(), stream("/jackal1/tf_static", latched=True)
    world.send(static, body(("base", "laser", 0.1), ("base", "camera", 0.2)))
    world.send(tf, body(("odom", "base", 1.0)))
    await world.read("tf:base>laser@jackal1", "tf:base>camera@jackal1", "tf:odom>base@jackal1")
    laser = world.registry.get("tf:base>laser@jackal1")
    assert laser is not None
    assert laser.attributes["static"] == "true"
    world.transforms.stream_removed(static)
    assert world.ids() == ["tf:odom>base@jackal1"]
    world.transforms.stream_removed(static)
    world.transforms.stream_removed(tf)
    assert world.ids() == []
    world.registry.validate()
    world.transforms.close()


async def test_a_pair_that_another_stream_took_over_stays() -> None:
    world = World()
    old, new = stream(), stream(boot=2)
    world.send(old, body(("a", "b", 1.0)))
    await world.read("tf:a>b@jackal1")
    world.send(new, body(("a", "b", 2.0), ("a", "c", 2.0)))
    await world.read("tf:a>c@jackal1")
    world.transforms.stream_removed(old)
    assert world.ids() == ["tf:a>b@jackal1", "tf:a>c@jackal1"]
    world.transforms.close()


async def test_what_cannot_be_taken_is_counted_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transforms, "MAX_PAIRS", 2)
    world = World()
    tf = stream()
    world.send(tf, b"no transforms")
    world.send(tf, b"\0" * (transforms.MAX_BODY_BYTES + 1))
    world.send(tf, body(("a", "far", math.inf), ("a", "d", 0.0), ("a", "c", 0.0), ("a", "b", 0.0), ("\n", "e", 0.0)))
    await world.read("tf:a>b@jackal1", "tf:a>c@jackal1")
    assert world.transforms.refused == {
        (JACKAL, "undecodable"): 1,
        (JACKAL, "too_large"): 1,
        (JACKAL, "not_finite"): 1,
        (JACKAL, "too_many_transforms"): 1,
        (JACKAL, "bad_id"): 1,
    }
    world.transforms.stream_removed(tf)
    again = stream(boot=2)
    world.send(again, body(("a", "d", 0.0)))
    world.now_s += 1
    await world.read("tf:a>d@jackal1")  # there is room again
    world.transforms.close()


async def test_other_topics_are_not_looked_at() -> None:
    world = World()
    world.send(stream("/jackal1/odom", "nav_msgs/msg/Odometry"), b"anything")
    world.send(stream("/jackal1/tf", TF, Encoding.RAW), b"anything")
    assert world.transforms._timer.deadline_s is None
    world.send(stream("/jackal1/tf", "tf/tfMessage"), body(("a", "b", 0.0)))  # the name before tf2
    await world.read("tf:a>b@jackal1")
    world.transforms.close()


async def test_many_tiny_transforms_are_read_in_slices(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compressed, 64 messages of 500 transforms are a few kilobytes on the link."""
    read = 0

    def count_read(data: bytes, encoding: Encoding) -> list[Transform]:
        nonlocal read
        found = read_transforms(data, encoding)
        read += len(found)
        return found

    monkeypatch.setattr(transforms, "read_transforms", count_read)
    world = World()
    tf, other = stream(), stream("/jackal1/other/tf")
    for _ in range(transforms.MAX_WAITING):
        world.send(tf, body(*(("", f"b{number}", 0.0) for number in range(500))))
    world.send(other, body(("a", "b", 1.0)))
    world.transforms._timer.cancel()
    slices = []
    for _ in range(20):
        before = read, world.registry.version
        world.transforms._read_due()
        written = world.registry.version - before[1]
        slices.append(read - before[0] + transforms.PUT_COST * written)
        world.now_s += transforms.PAUSE_S
        if not world.transforms._streams[tf.id].reading:
            break
    assert max(slices) <= transforms.SLICE_COST + 500
    assert read <= transforms.MAX_READ + 500 + 1  # older ones are not looked at
    assert len(world.ids()) == 501
    world.transforms.close()


async def test_a_frame_that_is_no_text_is_refused() -> None:
    world = World()
    tf = stream()
    world.send(tf, body(("a", "bad", 0.0), ("a", "b", 0.0)).replace(b"bad", b"\xff\xfe\xfd"))
    await world.read("tf:a>b@jackal1")
    assert world.transforms.refused == {(JACKAL, "undecodable"): 1}
    world.transforms.close()


async def test_streams_of_another_relay_are_read_there() -> None:
    world = World()
    tf, other = stream(), stream("/jackal1/other/tf")
    world.elsewhere.add(other.id)
    assert world.transforms.reads(tf) and not world.transforms.reads(other)
    world.send(other, body(("map", "odom", 1.0)))
    world.send(tf, body(("odom", "base", 1.0)))
    await world.read("tf:odom>base@jackal1")
    world.elsewhere.add(tf.id)  # its client has gone there
    world.now_s += 10.0
    world.send(tf, body(("odom", "laser", 1.0)))
    world.elsewhere.discard(tf.id)
    world.send(tf, body(("odom", "camera", 1.0)))
    await world.read("tf:odom>camera@jackal1")
    assert world.ids() == ["tf:odom>base@jackal1", "tf:odom>camera@jackal1"]
