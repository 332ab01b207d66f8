"""Static transforms of several publishers as one message."""

import pytest

from sern_client.tf_latch import MAX_TRANSFORMS, TF_TYPE, TfLatch, is_static_tf
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_types

ENCODINGS = (Encoding.ROS1, Encoding.CDR)


def message(encoding: Encoding, *pairs: tuple[str, str], x: float = 0.0) -> bytes:
    transforms = [
        ros_types.new(
            "geometry_msgs/msg/TransformStamped", encoding,
            header=ros_types.header(5, parent, encoding), child_frame_id=child,
            transform=ros_types.new(
                "geometry_msgs/msg/Transform", encoding,
                translation=ros_types.new("geometry_msgs/msg/Vector3", encoding, x=x),
            ),
        )
        for parent, child in pairs
    ]  # fmt: skip
    return ros_types.serialise(ros_types.new(TF_TYPE, encoding, transforms=transforms), TF_TYPE, encoding)


def read(body: bytes, encoding: Encoding) -> list[tuple[str, str, float]]:
    return [
        (t.header.frame_id, t.child_frame_id, t.transform.translation.x)
        for t in ros_types.deserialise(body, TF_TYPE, encoding).transforms
    ]


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_one_message_goes_as_it_came(encoding: Encoding) -> None:
    latch = TfLatch(encoding)
    assert latch.merged() is None
    body = message(encoding, ("base", "lidar"), ("base", "imu"))
    assert latch.add("a", body) == body
    newer = message(encoding, ("base", "imu"), ("base", "lidar"), x=2.0)
    assert latch.add("b", newer) == newer  # it says everything
    assert latch.merged() == newer


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_the_newest_of_every_pair_is_kept_and_last(encoding: Encoding) -> None:
    latch = TfLatch(encoding)
    latch.add("a", message(encoding, ("base", "lidar"), ("base", "imu")))
    latch.add("b", message(encoding, ("base", "camera"), x=1.0))
    merged = latch.add("b", message(encoding, ("/base", "lidar"), x=3.0))
    assert read(merged, encoding) == [("base", "imu", 0.0), ("base", "camera", 1.0), ("/base", "lidar", 3.0)]
    latch.drop("b")
    assert read(latch.merged() or b"", encoding) == [("base", "imu", 0.0)]
    latch.drop("a")
    assert latch.merged() is None


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_bytes_that_are_no_transforms_change_nothing(encoding: Encoding) -> None:
    latch = TfLatch(encoding)
    body = message(encoding, ("base", "lidar"))
    latch.add("a", body)
    with pytest.raises(ConfigError):
        latch.add("b", b"\xff" * 7)
    assert latch.merged() == body


def test_only_so_many_are_kept_and_read() -> None:
    latch = TfLatch(Encoding.ROS1)
    half = MAX_TRANSFORMS // 2 + 5
    for source in "ab":
        latch.add(source, message(Encoding.ROS1, *(("base", f"{source}{n}") for n in range(half))))
    assert len(latch) == MAX_TRANSFORMS
    with pytest.raises(ConfigError, match="up to 2000 are read"):
        latch.add("c", message(Encoding.ROS1, *(("base", f"c{n}") for n in range(MAX_TRANSFORMS + 1))))
    assert len(latch) == MAX_TRANSFORMS


def test_the_whole_is_made_when_it_is_asked_for_and_once() -> None:
    latch = TfLatch(Encoding.ROS1)
    latch.keep("a", message(Encoding.ROS1, ("base", "lidar")))
    latch.keep("b", message(Encoding.ROS1, ("base", "imu")))
    merged = latch.merged()
    assert latch.merged() is merged
    latch.keep("b", message(Encoding.ROS1, ("base", "camera")))
    assert [child for _, child, _ in read(latch.merged() or b"", Encoding.ROS1)] == ["lidar", "imu", "camera"]


def test_which_topics_these_are() -> None:
    assert is_static_tf("/tf_static", "tf2_msgs/TFMessage")
    assert is_static_tf("/robot1/tf_static", "tf2_msgs/msg/TFMessage")
    assert not is_static_tf("/tf", "tf2_msgs/msg/TFMessage")
    assert not is_static_tf("/tf_static", "std_msgs/msg/String")
