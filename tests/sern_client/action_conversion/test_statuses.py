"""Every status of one ROS has one in the other, and what has ended has ended in both."""

import pytest

from sern_client.action_conversion.statuses import (
    ENDED_ROS1,
    ENDED_ROS2,
    ROS1_STATUS,
    ROS2_STATUS,
    Ros1Status,
    Ros2Status,
    ros1_status,
    ros2_status,
)
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_types


@pytest.mark.parametrize(
    ("type_name", "encoding", "ours", "prefix"),
    [
        ("actionlib_msgs/msg/GoalStatus", Encoding.ROS1, Ros1Status, ""),
        ("action_msgs/msg/GoalStatus", Encoding.CDR, Ros2Status, "STATUS_"),
    ],
)
def test_the_values_are_those_of_the_messages(
    type_name: str, encoding: Encoding, ours: type[Ros1Status] | type[Ros2Status], prefix: str
) -> None:
    constants = ros_types.typestore(encoding).fielddefs[type_name][0]
    assert {name.removeprefix(prefix): value for name, _, value in constants} == {
        each.name: each.value for each in ours
    }


def test_every_status_has_one_in_the_other_ros() -> None:
    assert ROS2_STATUS.keys() == set(Ros1Status) and ROS1_STATUS.keys() == set(Ros2Status)
    for ros1, ros2 in ROS2_STATUS.items():
        assert (ros1 in ENDED_ROS1) == (ros2 in ENDED_ROS2)
    for ros2, ros1 in ROS1_STATUS.items():
        assert (ros1 in ENDED_ROS1) == (ros2 in ENDED_ROS2 or ros2 is Ros2Status.UNKNOWN)
    for ros2 in set(Ros2Status) - {Ros2Status.UNKNOWN}:
        assert ROS2_STATUS[ROS1_STATUS[ros2]] is ros2


def test_any_byte_can_be_read() -> None:
    assert [ros1_status(value) for value in (-1, 0, 9, 10, 255)] == [
        None,
        Ros1Status.PENDING,
        Ros1Status.LOST,
        None,
        None,
    ]
    assert [ros2_status(value) for value in (-1, 0, 6, 7)] == [0, 0, 6, 0]
