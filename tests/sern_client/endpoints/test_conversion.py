"""ROS 1 and ROS 2 bodies turned into each other, checked by value."""

import logging
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from sern_client.endpoints.base import Difference, Held, Publisher, ServiceInfo, Sink, Subscription, TopicEvents
from sern_client.endpoints.conversion import Converter, converted, converted_service
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import ros_types
from sern_runtime.ros_types import topic_info
from tests.daemons import recording
from tests.exploring import cases, seeds
from tests.sern_client import messages
from tests.sern_client.messages import made_up

ROS1, CDR = Encoding.ROS1, Encoding.CDR
OTHER = {ROS1: CDR, CDR: ROS1}
EXTENDED = ("sensor_msgs/msg/Range", "shape_msgs/msg/SolidPrimitive", "visualization_msgs/msg/Marker")
RENAMED = ("sensor_msgs/msg/CameraInfo", "stereo_msgs/msg/DisparityImage")
SEPARATOR = "=" * 80 + "\n"
GAIT = """\
uint8 WALK=1
string NAME=a trot # not a comment
Header header
time since
duration[] steps
byte flags
char letter
float64[4] Legs
my_robot/Foot[] feet
my_robot/Nothing nothing
""" + (
    f"{SEPARATOR}MSG: my_robot/Foot\nfloat32 load\nstring name\n{SEPARATOR}MSG: my_robot/Nothing\nint8 X=3\n"
    f"{SEPARATOR}MSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
)


def common_types() -> list[str]:
    """Those whose values are all the same on both sides."""
    one, two = get_typestore(Stores.ROS1_NOETIC).fielddefs, get_typestore(Stores.ROS2_JAZZY).fielddefs
    names = sorted(one.keys() & two.keys())
    return [name for name in names if not set(EXTENDED) & set(ros_types.used_by(name, one))]


def plain(message: Any, info: TopicInfo) -> Any:
    return messages.plain(message, ros_types.resolve(info.type_name, info.definition, info.encoding).store)


def values(body: bytes, info: TopicInfo) -> Any:
    """What a body says, as plain values."""
    return plain(read(body, info), info)


def read(body: bytes, info: TopicInfo) -> Any:
    store = ros_types.resolve(info.type_name, info.definition, info.encoding).store
    if info.encoding is ROS1:
        return store.deserialize_ros1(body, info.type_name)
    return store.deserialize_cdr(body, info.type_name)


def written(message: Any, info: TopicInfo) -> bytes:
    store = ros_types.resolve(info.type_name, info.definition, info.encoding).store
    if info.encoding is ROS1:
        return bytes(store.serialize_ros1(message, info.type_name))
    return bytes(store.serialize_cdr(message, info.type_name))


@pytest.mark.parametrize("source", [ROS1, CDR])
@settings(max_examples=cases(8))
@given(seed=st.integers(0, 2**32))
def test_every_type_keeps_its_values_there_and_back(source: Encoding, seed: int) -> None:
    """Over all types that both sides know; what is written is what the other side would write itself."""
    random = Random(seed)
    for name in common_types():
        info = topic_info("/x", name, source)
        message = made_up(ros_types.typestore(source), name, random)
        there, to_other = converted(info, OTHER[source])
        back, to_own = converted(there, source)
        body = written(message, info)
        moved = to_other(body)
        again = read(moved, there)
        assert plain(again, there) == plain(message, info), name
        assert values(to_own(moved), back) == plain(message, info), name
        assert (back.type_hash, there.type_hash) == (
            info.type_hash,
            topic_info("/x", name, OTHER[source]).type_hash,
        )
        if there.encoding is CDR:
            assert moved == written(again, there), name


@pytest.mark.parametrize("name", EXTENDED + RENAMED)
@pytest.mark.parametrize("seed", seeds(20))
def test_types_that_ros2_laid_out_otherwise(name: str, seed: int) -> None:
    info = topic_info("/x", name, ROS1)
    message = made_up(ros_types.typestore(ROS1), name, Random(seed))
    there, to_cdr = converted(info, CDR)
    moved = read(to_cdr(written(message, info)), there)
    expected, got = plain(message, info), plain(moved, there)
    added = got.keys() - expected.keys()
    assert {key: got[key] for key in expected} == expected
    assert added == (
        {
            "sensor_msgs/msg/Range": {"variance"},
            "shape_msgs/msg/SolidPrimitive": {"polygon"},
            "visualization_msgs/msg/Marker": {"texture_resource", "texture", "uv_coordinates", "mesh_file"},
        }.get(name, set())
    )
    own, to_ros1 = converted(there, ROS1)
    assert values(to_ros1(to_cdr(written(message, info))), own) == expected
    assert own.type_hash == info.type_hash


def test_a_marker_in_an_array_loses_only_what_ros1_does_not_have() -> None:
    name = "visualization_msgs/msg/MarkerArray"
    info = topic_info("/markers", name, CDR)
    message = ros_types.new(name, CDR, markers=[made_up(ros_types.typestore(CDR), EXTENDED[2], Random(7))])
    there, convert = converted(info, ROS1)
    moved = read(convert(written(message, info)), there).markers[0]
    original = plain(message, info)["markers"][0]
    assert {key: original[key] for key in plain(moved, there)} == plain(moved, there)
    assert not hasattr(moved, "mesh_file") and moved.mesh_resource == message.markers[0].mesh_resource


def test_four_dimensions_are_one_too_many() -> None:
    name = "shape_msgs/msg/SolidPrimitive"
    info = topic_info("/shape", name, ROS1)
    message = ros_types.new(name, ROS1, dimensions=np.arange(4.0))
    _, convert = converted(info, CDR)
    with pytest.raises(ConfigError, match="dimensions has 4 elements, ROS 2 allows 3"):
        convert(written(message, info))


def test_a_custom_type_is_made_up_from_its_definition() -> None:
    md5 = ros_types.hash_of("my_robot/msg/Gait", GAIT, ROS1)
    info = TopicInfo(TopicName("/gait"), "my_robot/msg/Gait", ROS1, md5, GAIT)
    there, to_cdr = converted(info, CDR)
    assert there.type_name == "my_robot/msg/Gait" and there.type_hash.startswith("RIHS01_")
    assert "builtin_interfaces/Time since\n" in there.definition and "float64[4] legs\n" in there.definition
    assert "seq" not in there.definition and "uint8 WALK=1\n" in there.definition
    assert ros_types.hash_of(there.type_name, there.definition, CDR) == there.type_hash
    store = ros_types.resolve(info.type_name, info.definition, ROS1).store
    for seed in range(30):
        message = made_up(store, "my_robot/msg/Gait", Random(seed))
        moved = to_cdr(written(message, info))
        assert values(moved, there) == plain(message, info)
        back, to_ros1 = converted(there, ROS1)
        assert values(to_ros1(moved), back) == plain(message, info)
    assert back.type_hash == ros_types.hash_of("my_robot/msg/Gait", GAIT.replace("Legs", "legs"), ROS1)


def test_bounds_are_dropped_on_the_way_to_ros1() -> None:
    definition = "string<=5 name\nfloat32[<=3] values\nuint8[2] pair\n"
    info = TopicInfo(TopicName("/x"), "my_bounded/msg/Thing", CDR, "", definition)
    there, convert = converted(info, ROS1)
    assert there.definition == "string name\nfloat32[] values\nuint8[2] pair\n"
    message = made_up(ros_types.resolve(info.type_name, definition, CDR).store, info.type_name, Random(1))
    assert values(convert(written(message, info)), there) == plain(message, info)


def test_two_versions_of_a_type_do_not_meet() -> None:
    """A Range without `variance`, as ROS 2 had it once, is that and nothing else."""
    text = "std_msgs/Header header\nuint8 radiation_type\nfloat32 field_of_view\nfloat32 min_range\nfloat32 max_range\n"
    old = TopicInfo(TopicName("/range"), "sensor_msgs/msg/Range", CDR, "", text + "float32 range\n")
    message = made_up(ros_types.resolve(old.type_name, old.definition, CDR).store, old.type_name, Random(3))
    there, convert = converted(old, ROS1)
    assert there.type_hash == topic_info("/x", "sensor_msgs/msg/Range", ROS1).type_hash
    assert values(convert(written(message, old)), there) == plain(message, old)
    assert ("variance" in dict(ros_types.typestore(CDR).fielddefs["sensor_msgs/msg/Range"][1])) is True


def test_seq_is_counted_for_each_topic() -> None:
    name = "nav_msgs/msg/Odometry"
    info = topic_info("/odom", name, CDR)
    body = ros_types.serialise(ros_types.new(name, CDR), name, CDR)
    there, convert = converted(info, ROS1)
    assert [read(convert(body), there).header.seq for _ in range(3)] == [1, 2, 3]
    assert read(converted(info, ROS1)[1](body), there).header.seq == 1
    header = topic_info("/header", "std_msgs/msg/Header", CDR)
    bare, convert = converted(header, ROS1)
    assert read(convert(ros_types.serialise(ros_types.header(5, "a", CDR), "std_msgs/msg/Header", CDR)), bare).seq == 1


def test_big_endian_cdr_is_read() -> None:
    name = "geometry_msgs/msg/TwistStamped"
    info = topic_info("/cmd", name, CDR)
    message = made_up(ros_types.typestore(CDR), name, Random(5))
    body = bytes(ros_types.typestore(CDR).serialize_cdr(message, name, little_endian=False))
    there, convert = converted(info, ROS1)
    assert values(convert(body), there) == plain(message, info)


@pytest.mark.parametrize("source", [ROS1, CDR])
@pytest.mark.parametrize("body", [b"", b"\0\x01\0\0", b"\xff" * 64, b"\0\x07\0\0" + b"\0" * 60])
def test_bytes_that_are_no_message(source: Encoding, body: bytes) -> None:
    _, convert = converted(topic_info("/odom", "nav_msgs/msg/Odometry", source), OTHER[source])
    with pytest.raises(ConfigError, match="cannot be converted to") as caught:
        convert(body)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("info", "wanted", "said"),
    [
        (TopicInfo(TopicName("/x"), "no_msgs/msg/Such", CDR), ROS1, "unknown here"),
        (TopicInfo(TopicName("/x"), "std_msgs/msg/String", Encoding.RAW), ROS1, "raw bodies cannot be converted"),
        (TopicInfo(TopicName("/x"), "std_msgs/msg/String", ROS1, "0" * 32), CDR, "hash 0{32}, but its definition"),
        (TopicInfo(TopicName("/x"), "std_msgs/msg/String", CDR, "", "int32 data\n"), ROS1, "differs in data"),
        (TopicInfo(TopicName("/x"), "my_case/msg/Two", ROS1, "", "int8 a\nint8 A\n"), CDR, "differ in case only"),
        (TopicInfo(TopicName("/x"), "my_wide/msg/Text", CDR, "", "wstring text\n"), ROS1, "does not define|parsed"),
    ],
)
def test_what_cannot_be_converted(info: TopicInfo, wanted: Encoding, said: str) -> None:
    with pytest.raises(ConfigError, match=said) as caught:
        converted(info, wanted)
    assert "\n" not in str(caught.value) and str(caught.value).startswith("/x: ")


@pytest.mark.parametrize("name", ["husky_gps_imu_odom.bag", "jackal_imu_odom.bag"])
def test_real_recordings_there_and_back(name: str) -> None:
    """Every 7th message of a real robot: ROS 1 to CDR to ROS 1 is the same bytes but for `seq`."""
    path: Path = recording(name)
    compared = 0
    with AnyReader([path]) as reader:
        converters: dict[str, tuple[Callable[[bytes], bytes], Callable[[bytes], bytes]]] = {}
        for index, (connection, _, raw) in enumerate(reader.messages()):
            if index % 7:
                continue
            if connection.topic not in converters:
                definition = connection.msgdef.data if hasattr(connection.msgdef, "data") else str(connection.msgdef)
                info = TopicInfo(TopicName(connection.topic), connection.msgtype, ROS1, connection.digest, definition)
                there, to_cdr = converted(info, CDR)
                converters[connection.topic] = to_cdr, converted(there, ROS1)[1]
            to_cdr, to_ros1 = converters[connection.topic]
            assert to_ros1(to_cdr(bytes(raw)))[4:] == bytes(raw)[4:]
            compared += 1
    assert compared > 100


class Taking:
    """An endpoint that takes CDR and keeps what it got."""

    encoding = CDR
    exhausted = True

    def __init__(self) -> None:
        self.infos: list[TopicInfo] = []
        self.got: list[tuple[bytes, int]] = []

    async def start(self, events: TopicEvents) -> None: ...

    async def stop(self) -> None: ...

    def subscribe(self, name: TopicName, sink: Sink) -> Subscription:
        raise UsageError(f"{name}: gives nothing")

    def validate(self, held: Held) -> list[Difference]:
        del held
        return []

    def interest(self, name: TopicName, wanted: bool) -> None: ...

    def advertise(self, info: TopicInfo) -> Publisher:
        self.infos.append(info)
        taking = self

        class Out:
            def publish(self, body: bytes, stamp_ns: int) -> None:
                taking.got.append((body, stamp_ns))

            def close(self) -> None:
                taking.infos.remove(info)

        return Out()


def test_a_publisher_converts_and_counts_what_it_cannot(caplog: pytest.LogCaptureFixture) -> None:
    endpoint, converter = Taking(), Converter()
    publisher = converter.advertise(endpoint, topic_info("/chat", "std_msgs/msg/String", ROS1))
    with caplog.at_level(logging.INFO):
        publisher.publish(b"\x02\0\0\0hi", 9)
        publisher.publish(b"nonsense", 10)
        publisher.publish(b"nonsense", 11)
    assert endpoint.got == [(b"\0\x01\0\0\x03\0\0\0hi\0", 9)]
    assert endpoint.infos[0] == topic_info("/chat", "std_msgs/msg/String", CDR)
    assert converter.failures == 2
    assert [record.message for record in caplog.records if "is dropped" in record.message] != []
    assert sum("is dropped" in record.message for record in caplog.records) == 1
    publisher.close()
    assert endpoint.infos == []


def test_what_has_the_right_encoding_passes_through() -> None:
    endpoint, converter = Taking(), Converter()
    info = TopicInfo(TopicName("/odd"), "no_msgs/msg/Such", CDR)
    converter.advertise(endpoint, info).publish(b"anything", 1)
    assert endpoint.infos == [info] and endpoint.got == [(b"anything", 1)]


@pytest.mark.parametrize(
    ("type_name", "definition"),
    [
        ("std_srvs/srv/SetBool", ""),
        ("std_srvs/srv/Trigger", ""),
        ("std_srvs/srv/Empty", ""),
        ("nav_msgs/srv/GetPlan", ""),
        ("sensor_msgs/srv/SetCameraInfo", ""),
        ("my_robot/srv/Plan", "string goal\nmy_robot/Foot foot\n---\ntime when\n"
         f"{SEPARATOR}MSG: my_robot/Foot\nfloat32 load\nstring name\n"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("source", [ROS1, CDR])
def test_service_bodies(type_name: str, definition: str, source: Encoding) -> None:
    from sern_runtime import ros_services

    info = ServiceInfo(TopicName("/serve"), type_name, source, "", definition)
    other, to_own, to_wanted = converted_service(info, OTHER[source])
    own = ros_services.resolve(type_name, definition, source)
    theirs = ros_services.resolve(type_name, other.definition, OTHER[source])
    assert theirs.text.type_hash == other.type_hash
    for seed in range(10):
        request = made_up(theirs.request.store, theirs.request.name, Random(seed))
        body = to_own(written(request, as_topic(theirs.request)))
        assert values(body, as_topic(own.request)) == plain(request, as_topic(theirs.request))
        response = made_up(own.response.store, own.response.name, Random(seed))
        body = to_wanted(written(response, as_topic(own.response)))
        assert values(body, as_topic(theirs.response)) == plain(response, as_topic(own.response))


def as_topic(half: ros_types.ResolvedType) -> TopicInfo:
    return TopicInfo(TopicName("/x"), half.name, half.encoding, "", half.text.definition or "\n")
