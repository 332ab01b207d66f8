"""What a goal's status is called in ROS 1 (actionlib_msgs/GoalStatus) and in ROS 2 (action_msgs/GoalStatus)."""

from enum import IntEnum
from typing import Final


class Ros1Status(IntEnum):
    PENDING = 0
    ACTIVE = 1
    PREEMPTED = 2
    SUCCEEDED = 3
    ABORTED = 4
    REJECTED = 5
    PREEMPTING = 6
    RECALLING = 7
    RECALLED = 8
    LOST = 9


class Ros2Status(IntEnum):
    UNKNOWN = 0
    ACCEPTED = 1
    EXECUTING = 2
    CANCELING = 3
    SUCCEEDED = 4
    CANCELED = 5
    ABORTED = 6


ROS2_STATUS: Final = {
    Ros1Status.PENDING: Ros2Status.ACCEPTED,
    Ros1Status.ACTIVE: Ros2Status.EXECUTING,
    Ros1Status.PREEMPTED: Ros2Status.CANCELED,
    Ros1Status.SUCCEEDED: Ros2Status.SUCCEEDED,
    Ros1Status.ABORTED: Ros2Status.ABORTED,
    Ros1Status.REJECTED: Ros2Status.ABORTED,  # of a goal that was pending so long that it counted as accepted
    Ros1Status.PREEMPTING: Ros2Status.CANCELING,
    Ros1Status.RECALLING: Ros2Status.CANCELING,
    Ros1Status.RECALLED: Ros2Status.CANCELED,
    Ros1Status.LOST: Ros2Status.ABORTED,
}

ROS1_STATUS: Final = {
    Ros2Status.UNKNOWN: Ros1Status.ABORTED,  # LOST is a client's own word, which no server says
    Ros2Status.ACCEPTED: Ros1Status.PENDING,
    Ros2Status.EXECUTING: Ros1Status.ACTIVE,
    Ros2Status.CANCELING: Ros1Status.PREEMPTING,
    Ros2Status.SUCCEEDED: Ros1Status.SUCCEEDED,
    Ros2Status.CANCELED: Ros1Status.PREEMPTED,  # never RECALLED: that it did not run at all, nobody says
    Ros2Status.ABORTED: Ros1Status.ABORTED,
}

ENDED_ROS1: Final = frozenset(
    {
        Ros1Status.PREEMPTED, Ros1Status.SUCCEEDED, Ros1Status.ABORTED, Ros1Status.REJECTED, Ros1Status.RECALLED,
        Ros1Status.LOST,
    }
)  # fmt: skip
ENDED_ROS2: Final = frozenset({Ros2Status.SUCCEEDED, Ros2Status.CANCELED, Ros2Status.ABORTED})


def ros1_status(value: int) -> Ros1Status | None:
    """None for a value that is none."""
    return Ros1Status(value) if 0 <= value < len(Ros1Status) else None


def ros2_status(value: int) -> Ros2Status:
    """UNKNOWN for a value that is none."""
    return Ros2Status(value) if 0 <= value < len(Ros2Status) else Ros2Status.UNKNOWN
