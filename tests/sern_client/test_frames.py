"""Frame ids with a prefix on the way out and without on the way in, for real types in both encodings."""

import logging
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sern_client.frames import FramePrefixer, Rewrite
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import ros_types

BOTH = pytest.mark.parametrize("encoding", [Encoding.ROS1, Encoding.CDR])
STAMP_NS = 1_700_000_000_123_456_789
ODOMETRY = "nav_msgs/msg/Odometry"
CLOUD = "sensor_msgs/msg/PointCloud2"
TF = "tf2_msgs/msg/TFMessage"
POSES = "geometry_msgs/msg/PoseArray"


def message(type_name: str, encoding: Encoding, *ids: str) -> Any:
    """A message of the type with these frame ids and something else in it as well."""

    def header(frame_id: str) -> Any:
        return ros_types.header(STAMP_NS, frame_id, encoding, seq=7)

    def new(of: str, /, **fields: Any) -> Any:
        return ros_types.new(of, encoding, **fields)

    match type_name:
        case "nav_msgs/msg/Odometry":
            return new(ODOMETRY, header=header(ids[0]), child_frame_id=ids[1])
        case "sensor_msgs/msg/PointCloud2":
            data = np.arange(480, dtype=np.uint8)
            field = new("sensor_msgs/msg/PointField", name="x", datatype=7, count=1)
            return new(CLOUD, header=header(ids[0]), fields=[field], data=data, width=30, point_step=16)
        case "geometry_msgs/msg/PoseArray":
            poses = [new("geometry_msgs/msg/Pose", position=new("geometry_msgs/msg/Point", x=0.5)) for _ in range(3)]
            return new(POSES, header=header(ids[0]), poses=poses)
        case _:
            pairs = zip(ids[::2], ids[1::2], strict=True)
            transforms = [
                new("geometry_msgs/msg/TransformStamped", header=header(parent), child_frame_id=child)
                for parent, child in pairs
            ]
            return new(TF, transforms=transforms)


def frame_ids(type_name: str, body: bytes, encoding: Encoding) -> list[str]:
    read = ros_types.deserialise(body, type_name, encoding)
    if type_name == TF:
        return [text for one in read.transforms for text in (one.header.frame_id, one.child_frame_id)]
    return [read.header.frame_id, *([read.child_frame_id] if type_name == ODOMETRY else [])]


def rewriters(prefix: str, type_name: str, encoding: Encoding) -> tuple[Rewrite, Rewrite]:
    prefixer = FramePrefixer(prefix)
    info = ros_types.topic_info("/t", type_name, encoding)
    out, back = prefixer.outgoing(info), prefixer.incoming(info)
    assert out is not None
    assert back is not None
    return out, back


@BOTH
@pytest.mark.parametrize(
    ("type_name", "before", "after"),
    [
        (ODOMETRY, ["odom", "base_link"], ["jackal1/odom", "jackal1/base_link"]),
        (CLOUD, ["velodyne"], ["jackal1/velodyne"]),
        (POSES, ["map"], ["jackal1/map"]),
        (TF, ["map", "odom", "odom", "base_link"], [f"jackal1/{x}" for x in ("map", "odom", "odom", "base_link")]),
        (ODOMETRY, ["jackal1/odom", ""], ["jackal1/odom", ""]),
        (ODOMETRY, ["/odom", "jackal10/base"], ["jackal1/odom", "jackal1/jackal10/base"]),
        (TF, [], []),
    ],
)
def test_a_prefix_is_put_before_every_frame_id(
    encoding: Encoding, type_name: str, before: list[str], after: list[str]
) -> None:
    out, back = rewriters("jackal1/", type_name, encoding)
    body = ros_types.serialise(message(type_name, encoding, *before), type_name, encoding)
    sent = out(body)
    assert frame_ids(type_name, sent, encoding) == after
    assert sent == ros_types.serialise(message(type_name, encoding, *after), type_name, encoding)  # and nothing else
    assert out(sent) is sent  # once is enough
    if before != after and not before[0].startswith("/"):
        assert back(sent) == body


@BOTH
def test_other_robots_frames_come_in_as_they_are(encoding: Encoding) -> None:
    _, back = rewriters("jackal1/", ODOMETRY, encoding)
    for ids in (["husky/odom", "husky/base"], ["map", ""], ["jackal1/", "jackal10/base"]):
        body = ros_types.serialise(message(ODOMETRY, encoding, *ids), ODOMETRY, encoding)
        assert back(body) is body


def test_without_a_prefix_nothing_is_done() -> None:
    info = ros_types.topic_info("/odom", ODOMETRY, Encoding.CDR)
    assert FramePrefixer(None).outgoing(info) is None
    assert FramePrefixer(None).incoming(info) is None


@BOTH
@pytest.mark.parametrize("type_name", ["geometry_msgs/msg/Twist", "std_msgs/msg/String"])
def test_a_type_without_frame_ids_is_left_alone(encoding: Encoding, type_name: str) -> None:
    assert FramePrefixer("a/").outgoing(ros_types.topic_info("/t", type_name, encoding)) is None


def test_a_short_type_name_of_ros1_is_understood() -> None:
    info = TopicInfo(TopicName("/odom"), "nav_msgs/Odometry", Encoding.ROS1)
    out = FramePrefixer("a/").outgoing(info)
    assert out is not None
    body = ros_types.serialise(message(ODOMETRY, Encoding.ROS1, "odom", "base"), ODOMETRY, Encoding.ROS1)
    assert frame_ids(ODOMETRY, out(body), Encoding.ROS1) == ["a/odom", "a/base"]


@BOTH
def test_a_type_that_comes_with_its_definition_is_understood(encoding: Encoding) -> None:
    type_name = f"frames_{encoding}_msgs/msg/Track"
    separator = "=" * 80
    stamp = "time stamp" if encoding is Encoding.ROS1 else "builtin_interfaces/Time stamp"
    head = "uint32 seq\n" if encoding is Encoding.ROS1 else ""
    definition = (
        f"std_msgs/Header[] headers\nstring frame_id\n{separator}\nMSG: std_msgs/Header\n{head}{stamp}\n"
        "string frame_id\n"
    )
    if encoding is Encoding.CDR:
        definition += f"{separator}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
    info = TopicInfo(TopicName("/track"), type_name, encoding, "", definition)
    out = FramePrefixer("a/").outgoing(info)
    assert out is not None
    ros_types.register(type_name, definition, encoding)  # for this test to write and read them
    headers = [ros_types.header(STAMP_NS, text, encoding) for text in ("map", "")]
    body = ros_types.serialise(ros_types.new(type_name, encoding, headers=headers, frame_id="x"), type_name, encoding)
    read = ros_types.deserialise(out(body), type_name, encoding)
    assert [header.frame_id for header in read.headers] == ["a/map", ""]
    assert read.frame_id == "x"  # not the frame id of a header: it may mean anything


def test_an_unknown_type_passes_unchanged_with_one_line(caplog: pytest.LogCaptureFixture) -> None:
    prefixer = FramePrefixer("a/")
    with caplog.at_level(logging.WARNING):
        out = prefixer.outgoing(TopicInfo(TopicName("/t"), "my_msgs/msg/Mine", Encoding.CDR))
        assert out is not None
        body = b"anything"
        assert [out(body) is body for _ in range(3)] == [True] * 3
    assert prefixer.unreadable == 3
    assert [record.getMessage() for record in caplog.records] == [
        "/t: frame ids stay without 'a/': my_msgs/msg/Mine is not known here (type my_msgs/msg/Mine is "
        "unknown here, and its definition did not come with it)"
    ]


@BOTH
def test_bytes_that_do_not_fit_pass_unchanged_with_one_line(
    encoding: Encoding, caplog: pytest.LogCaptureFixture
) -> None:
    prefixer = FramePrefixer("a/")
    out = prefixer.outgoing(ros_types.topic_info("/t", ODOMETRY, encoding))
    assert out is not None
    with caplog.at_level(logging.WARNING):
        for body in (b"", b"\0\1\0\0short", b"\xff" * 700):
            assert out(body) is body
    assert prefixer.unreadable == 3
    assert len(caplog.records) == 1


def test_bodies_that_are_no_ros_messages_are_not_looked_at() -> None:
    prefixer = FramePrefixer("a/")
    assert prefixer.outgoing(TopicInfo(TopicName("/t"), "anything", Encoding.RAW)) is None
    assert prefixer.unreadable == 0


LABELS = st.text(st.characters(codec="utf-8", exclude_characters="/\0"), max_size=20)


@given(prefix=st.from_regex(r"[a-z0-9_][a-z0-9_/]{0,8}", fullmatch=True), ids=st.lists(LABELS, max_size=6),
       encoding=st.sampled_from([Encoding.ROS1, Encoding.CDR]))  # fmt: skip
def test_what_goes_out_comes_back_the_same(prefix: str, ids: list[str], encoding: Encoding) -> None:
    ids = [text for text in ids if not text.startswith(prefix)]
    ids = ids[: len(ids) // 2 * 2]
    out, back = rewriters(prefix, TF, encoding)
    body = ros_types.serialise(message(TF, encoding, *ids), TF, encoding)
    sent = out(body)
    assert frame_ids(TF, sent, encoding) == [prefix + text if text else "" for text in ids]
    assert back(sent) == body


@given(st.binary(max_size=400), st.sampled_from([Encoding.ROS1, Encoding.CDR]))
def test_no_bytes_do_harm(body: bytes, encoding: Encoding) -> None:
    out, _ = rewriters("a/", ODOMETRY, encoding)
    assert isinstance(out(body), bytes)
