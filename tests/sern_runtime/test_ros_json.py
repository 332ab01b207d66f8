"""Messages in JSON: read as their type has it, or refused with what is wrong."""

import json
from typing import Any

import pytest

from sern_core.vocabulary.errors import BodyError
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_json, ros_types

ENCODINGS = (Encoding.ROS1, Encoding.CDR)


def read(type_name: str, value: Any, encoding: Encoding = Encoding.CDR) -> Any:
    kind = ros_types.resolve(type_name, "", encoding)
    return ros_types.deserialise(ros_json.body_of(kind, json.dumps(value).encode()), kind.name, encoding)


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("word", ["nsec", "nanosec"])
def test_headers_and_times(encoding: Encoding, word: str) -> None:
    header = {"seq": 7, "stamp": {"sec": 5, word: 6}, "frame_id": "map"}
    found = read("geometry_msgs/PoseStamped", {"header": header, "pose": {"position": {"x": 1}}}, encoding)
    assert (found.header.stamp.sec, found.header.stamp.nanosec, found.header.frame_id) == (5, 6, "map")
    assert (found.pose.position.x, found.pose.orientation.w) == (1.0, 0.0)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_lists(encoding: Encoding) -> None:
    assert read("sensor_msgs/LaserScan", {"ranges": [1, 2.5]}, encoding).ranges.tolist() == [1.0, 2.5]
    assert read("sensor_msgs/Image", {"data": "AAEC"}, encoding).data.tolist() == [0, 1, 2]
    assert read("sensor_msgs/Image", {"data": [0, 255]}, encoding).data.tolist() == [0, 255]
    joints = read("sensor_msgs/JointState", {"name": ["a", "b"], "position": [1, 2]}, encoding)
    assert (joints.name, joints.position.tolist()) == (["a", "b"], [1.0, 2.0])
    path = read("nav_msgs/Path", {"poses": [{}, {"pose": {"position": {"y": 2.0}}}]}, encoding)
    assert [each.pose.position.y for each in path.poses] == [0.0, 2.0]
    grid = read("nav_msgs/OccupancyGrid", {"data": [-1, 100]}, encoding)
    assert grid.data.tolist() == [-1, 100]


@pytest.mark.parametrize(
    ("type_name", "value", "said"),
    [
        ("std_msgs/Float64", {"data": "1"}, "data is no number"),
        ("std_msgs/Float64", {"data": True}, "data is no number"),
        ("std_msgs/Float64", {"data": None}, "data is no number"),
        ("std_msgs/Float32", {"data": 1e39}, "data has what does not fit into float32"),
        ("std_msgs/Int8", {"data": 128}, "data has what does not fit into int8"),
        ("std_msgs/UInt64", {"data": -1}, "data has what does not fit into uint64"),
        ("std_msgs/UInt64", {"data": 2**64}, "data has what does not fit into uint64"),
        ("std_msgs/Int32", {"data": 1.5}, "data is no whole number"),
        ("std_msgs/Bool", {"data": 2}, "data is neither true nor false"),
        ("std_msgs/String", {"data": 5}, "data is no text"),
        ("std_msgs/String", {"text": ""}, "has no field 'text'"),
        ("std_msgs/String", [], "is no mapping"),
        ("sensor_msgs/NavSatFix", {"position_covariance": [1.0]}, "has 1 elements, 9 are needed"),
        ("sensor_msgs/Image", {"data": "?"}, "neither a list of numbers nor base64"),
        ("sensor_msgs/Image", {"data": [256]}, "does not fit into uint8"),
        ("sensor_msgs/Image", {"data": [1.5]}, "has what is no uint8"),
        ("sensor_msgs/LaserScan", {"ranges": [[1.0], [2.0]]}, "ranges has what is no float32"),
        ("sensor_msgs/LaserScan", {"ranges": ["a"]}, "ranges has what is no float32"),
        ("sensor_msgs/LaserScan", {"ranges": 5}, "ranges is no list"),
        ("nav_msgs/Path", {"poses": [{}] * 3_000}, "more than 2000 messages in one"),
        ("sensor_msgs/JointState", {"name": [""] * 3_000}, "more than 2000 messages in one"),
    ],
)
def test_what_does_not_fit(type_name: str, value: Any, said: str) -> None:
    with pytest.raises(BodyError, match=said):
        read(type_name, value)


def test_whole_numbers_that_fit() -> None:
    assert read("std_msgs/UInt64", {"data": 2**64 - 1}).data == 2**64 - 1
    assert read("std_msgs/Int64", {"data": -(2**63)}).data == -(2**63)
    assert read("std_msgs/Int32", {"data": 3.0}).data == 3
    assert read("std_msgs/Bool", {"data": True}).data is True
