"""Bodies walked in one pass: as rosbags writes them, and at a price that is known before it is paid."""

import random
import struct
from typing import Any

import numpy as np
import pytest
from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import FieldDesc
from rosbags.typesys.store import Typestore

from sern_client.endpoints import conversion
from sern_client.frames import FramePrefixer
from sern_core.vocabulary.errors import BodyError, ConfigError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import ros_bodies, ros_text, ros_types

ROS1, CDR = Encoding.ROS1, Encoding.CDR


def made(name: str, store: Typestore, rng: random.Random) -> Any:
    fields = store.fielddefs[name][1]
    return store.types[name](**{ros_types.attribute(key): value_of(desc, store, rng) for key, desc in fields})


def value_of(desc: FieldDesc, store: Typestore, rng: random.Random) -> Any:
    if desc[0] == Nodetype.BASE:
        base = str(desc[1][0])
        if base == "string":
            return "s" * rng.randrange(9)
        return rng.random() if base.startswith("float") else bool(rng.getrandbits(1)) if base == "bool" else 7
    if desc[0] == Nodetype.NAME:
        return made(str(desc[1]), store, rng)
    item, size = desc[1]
    count = int(size) if desc[0] == Nodetype.ARRAY else rng.randrange(min(int(size) or 3, 3) + 1)
    if item[0] == Nodetype.BASE and item[1][0] != "string":
        base = str(item[1][0])
        return np.ones(count, "uint8" if base in ("byte", "char") else base)
    return [value_of(item, store, rng) for _ in range(count)]


def test_every_type_is_converted_as_rosbags_does_it() -> None:
    rng = random.Random(5)
    ros1, cdr = ros_types.typestore(ROS1), ros_types.typestore(CDR)
    compared = 0
    for name in ros1.fielddefs:
        if name not in cdr.fielddefs:
            continue
        try:
            if not ros_types.counterpart(name, "", ROS1).same_layout:
                continue
        except ConfigError:
            continue
        plan = ros_bodies.plan(name, cdr.fielddefs, ros1=ros1.fielddefs)
        for _ in range(2):
            body = bytes(ros1.serialize_ros1(made(name, ros1, rng), name))
            there = bytes(cdr.ros1_to_cdr(body, name))
            assert ros_bodies.convert(plan, body, ROS1, CDR) == there, name
            assert ros_bodies.convert(plan, there, CDR, ROS1) == bytes(cdr.cdr_to_ros1(there, name)), name
            compared += 1
    assert compared > 200


@pytest.mark.parametrize("encoding", [ROS1, CDR])
@pytest.mark.parametrize("little", [True, False])
def test_frame_ids_are_changed_in_place(encoding: Encoding, little: bool) -> None:
    if encoding is ROS1 and not little:
        return
    name = "nav_msgs/msg/Path"
    store = ros_types.typestore(encoding)
    rng = random.Random(3)
    message = made(name, store, rng)
    message.poses = [made("geometry_msgs/msg/PoseStamped", store, rng) for _ in range(5)]
    for number, pose in enumerate(message.poses):
        pose.header.frame_id = "m" * number
    if encoding is ROS1:
        body = bytes(store.serialize_ros1(message, name))
    else:
        body = bytes(store.serialize_cdr(message, name, little_endian=little))
    plan = ros_bodies.plan(name, store.fielddefs)
    assert plan.has_frames
    assert ros_bodies.rewrite(plan, body, encoding, lambda text: text) is body
    out = ros_bodies.rewrite(plan, body, encoding, lambda text: f"robot/{text}")
    read: Any = store.deserialize_ros1(out, name) if encoding is ROS1 else store.deserialize_cdr(out, name)
    assert [pose.header.frame_id for pose in read.poses] == [f"robot/{'m' * number}" for number in range(5)]
    for before, after in zip(message.poses, read.poses, strict=True):
        assert before.pose == after.pose


EMPTY = "std_msgs/Header header\nEmpty[] x\n" + "=" * 80 + "\nMSG: evil/Empty\n"
SEQ = "=" * 80 + "\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
BYTE = "std_msgs/Header header\nOne[] x\n" + "=" * 80 + "\nMSG: evil/One\nuint8 x\nstring y\n"
HEAD = struct.pack("<IIII", 0, 0, 0, 0)
TEXTS = "std_msgs/Header header\nstring[] x\n"
HOSTILE = {
    "four thousand million messages without fields": (EMPTY + SEQ, HEAD + b"\xff\xff\xff\xff"),
    "two million of them": (EMPTY + SEQ, HEAD + struct.pack("<I", 2_000_000)),
    "a million small messages": (BYTE + SEQ, HEAD + struct.pack("<I", 10**6) + bytes(5 * 10**6)),
    "a million texts": (TEXTS + SEQ, HEAD + struct.pack("<I", 10**6) + bytes(4 * 10**6)),
    "numbers that are not there": ("std_msgs/Header header\nfloat64[] x\n" + SEQ, HEAD + b"\xff\xff\xff\xff"),
    "a text that is not there": ("std_msgs/Header header\nstring x\n" + SEQ, HEAD + b"\xff\xff\xff\xff"),
    "an array that is not there": ("std_msgs/Header header\nuint8[1000000] x\n" + SEQ, HEAD),
}  # fmt: skip


@pytest.mark.parametrize("name", list(HOSTILE))
def test_what_a_body_claims_is_counted_before_it_is_done(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    definition, body = HOSTILE[name]
    steps = 0

    def count(walk: ros_bodies._Walk, *args: Any) -> Any:
        nonlocal steps
        steps += 1
        return original(walk, *args)

    original = ros_bodies._Walk._do
    monkeypatch.setattr(ros_bodies._Walk, "_do", count)
    info = TopicInfo(TopicName("/evil"), "evil/msg/A", ROS1, "", definition)
    prefixer = FramePrefixer("robot/")
    rewrite = prefixer.incoming(info)
    assert rewrite is not None
    assert rewrite(body) is body
    assert prefixer.unreadable == 1
    _, convert = conversion.converted(info, CDR)
    with pytest.raises(ConfigError, match="cannot be converted to cdr"):
        convert(body)
    assert steps <= 2 * ros_bodies.MAX_STEPS


def test_messages_without_fields_are_a_byte_in_ros2() -> None:
    info = TopicInfo(TopicName("/evil"), "evil/msg/A", ROS1, "", EMPTY + SEQ)
    other, convert = conversion.converted(info, CDR)
    there = convert(HEAD + struct.pack("<I", 3))
    assert there == b"\0\1\0\0" + bytes(8) + struct.pack("<I", 1) + bytes(4) + struct.pack("<I", 3) + bytes(3)
    _, back = conversion.converted(other, ROS1)
    assert back(there) == struct.pack("<I", 1) + HEAD[4:] + struct.pack("<I", 3)


def test_big_endian_bodies_have_a_limit_of_their_own() -> None:
    name = "diagnostic_msgs/msg/DiagnosticArray"
    store = ros_types.typestore(CDR)
    rng = random.Random(1)
    _, convert = conversion.converted(ros_types.topic_info("/d", name, CDR), ROS1)
    for count, fits in ((100, True), (1000, False)):
        message = made(name, store, rng)
        message.status = [made("diagnostic_msgs/msg/DiagnosticStatus", store, rng) for _ in range(count)]
        body = bytes(store.serialize_cdr(message, name, little_endian=False))
        if fits:
            assert convert(body)[4:] == convert(bytes(store.serialize_cdr(message, name, little_endian=True)))[4:]
        else:
            with pytest.raises(ConfigError, match="too many parts"):
                convert(body)


def test_any_bytes_are_a_body_or_an_error() -> None:
    rng = random.Random(9)
    for name in ("visualization_msgs/msg/MarkerArray", "nav_msgs/msg/Odometry", "sensor_msgs/msg/PointCloud2"):
        for encoding, other in ((ROS1, CDR), (CDR, ROS1)):
            store, there = ros_types.typestore(encoding), ros_types.typestore(other)
            cdr, ros1 = (store, there) if encoding is CDR else (there, store)
            plan = ros_bodies.plan(name, cdr.fielddefs, ros1=ros1.fielddefs)
            message = made(name, store, rng)
            body = bytearray(
                store.serialize_ros1(message, name) if encoding is ROS1 else store.serialize_cdr(message, name)
            )
            for _ in range(150):
                damaged = bytearray(body)
                for _ in range(rng.randrange(4)):
                    damaged[rng.randrange(len(damaged))] = rng.randrange(256)
                damaged = damaged[: rng.randrange(len(damaged) + 1)] if rng.random() < 0.5 else damaged
                try:
                    out = ros_bodies.convert(plan, bytes(damaged), encoding, other)
                except BodyError:
                    continue
                assert len(out) <= 8 * len(damaged) + 64


@pytest.mark.parametrize("encoding", [ROS1, CDR])
def test_plans_of_all_shipped_types_take_a_fraction_of_what_may_be(encoding: Encoding) -> None:
    store = ros_types.typestore.__wrapped__(encoding)  # a new one: nobody has registered anything in it
    planner = ros_bodies._Planner(store.fielddefs, None, one_by_one=True)
    for name in store.fielddefs:
        planner.ops_of(name)  # what the others have made is not made again: this is the sum of them all
    assert 0 < ros_bodies.MAX_PLAN_STEPS - planner._left < ros_bodies.MAX_PLAN_STEPS / 2


def test_steps_of_types_behind_sequences_are_counted_as_they_are_made(monkeypatch: pytest.MonkeyPatch) -> None:
    made = 0
    original = ros_bodies._append

    def count(ops: list[ros_bodies._Op], op: ros_bodies._Op) -> None:
        nonlocal made
        made += 1
        original(ops, op)

    monkeypatch.setattr(ros_bodies, "_append", count)
    users = 200
    text = "".join(f"C{n}[] c{n}\n" for n in range(users))
    text += f"{ros_text.SEPARATOR}\nMSG: my_msgs/B\n" + "".join(f"string s{n}\n" for n in range(500))
    text += "".join(f"{ros_text.SEPARATOR}\nMSG: my_msgs/C{n}\nB b\n" for n in range(users))
    resolved = ros_types.resolve("my_msgs/msg/A", text, CDR)
    for _ in range(3):  # what is wrong with it is found out once
        with pytest.raises(ConfigError, match="too many parts in each other: over 5000"):
            ros_bodies.plan_of(resolved)
    assert made <= ros_bodies.MAX_PLAN_STEPS


def test_the_plan_of_a_type_is_made_once_for_all_its_streams() -> None:
    text = "Header header\nfloat64 x\n"
    first = ros_bodies.plan_of(ros_types.resolve("my_msgs/msg/Kept", text, CDR))
    assert ros_bodies.plan_of(ros_types.resolve("my_msgs/msg/Kept", text, CDR)) is first
    other = ros_bodies.plan_of(ros_types.resolve("my_msgs/msg/Kept", text + "string y\n", CDR))
    assert len(other.ops) == len(first.ops) + 1
    assert ros_bodies._planned.cache_info().maxsize == ros_bodies.PLANS
