"""Bodies that are the same for every action: against rosbags, and cut anywhere."""

from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sern_client.action_conversion import bodies
from sern_client.action_conversion.bodies import GoalInfo, Stamp, StatusPart
from sern_client.actions import MAX_STATUSES, GoalId
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_services, ros_types
from sern_runtime.ros_types import ResolvedType

STAMPS = st.builds(Stamp, st.integers(0, 2**31 - 1), st.integers(0, 2**32 - 1))
UUIDS = st.binary(min_size=16, max_size=16)
INFOS = st.builds(GoalInfo, UUIDS, STAMPS)
IDENTS = st.builds(GoalId, st.integers(0, 2**31 - 1), st.integers(0, 2**32 - 1), st.text(max_size=20))
CANCEL = ros_services.resolve("action_msgs/srv/CancelGoal", "", Encoding.CDR)
STATUSES = ros_types.resolve("action_msgs/msg/GoalStatusArray", "", Encoding.CDR)
BIG: dict[str, Any] = {"little_endian": False}


def read(body: bytes, resolved: ResolvedType) -> Any:
    if resolved.encoding is Encoding.ROS1:
        return resolved.store.deserialize_ros1(body, resolved.name)
    return resolved.store.deserialize_cdr(body, resolved.name)


def info_of(message: Any) -> GoalInfo:
    return GoalInfo(bytes(message.goal_id.uuid), Stamp(message.stamp.sec, message.stamp.nanosec))


@given(st.lists(st.tuples(INFOS, st.integers(0, 6)), max_size=5))
def test_the_statuses_of_ros_2(statuses: list[tuple[GoalInfo, int]]) -> None:
    body = bodies.ros2_statuses(statuses)
    message = read(body, STATUSES)
    assert [(info_of(each.goal_info), each.status) for each in message.status_list] == statuses
    expected = [(info.uuid, status) for info, status in statuses]
    assert bodies.split_statuses(body) == expected
    big = bytes(STATUSES.store.serialize_cdr(message, STATUSES.name, **BIG))
    assert bodies.split_statuses(big) == expected


def test_statuses_that_are_none_or_too_many() -> None:
    info = GoalInfo(bytes(16), Stamp(1, 2))
    body = bodies.ros2_statuses([(info, 1), (info, 2)])
    for size in range(len(body)):
        with pytest.raises(ConfigError):
            bodies.split_statuses(body[:size])
    with pytest.raises(ConfigError, match="it mentions 4001 goals, more than 4000"):
        bodies.split_statuses(bodies.ros2_statuses([(info, 1)] * (MAX_STATUSES + 1)))
    with pytest.raises(ConfigError, match="more than"):
        bodies.split_statuses(bodies.HEAD + b"\xff" * 4)


@given(INFOS)
def test_a_request_to_cancel(info: GoalInfo) -> None:
    body = bodies.cancel_request(info)
    message = read(body, CANCEL.request)
    assert info_of(message.goal_info) == info == bodies.split_cancel_request(body)
    big = bytes(CANCEL.request.store.serialize_cdr(message, CANCEL.request.name, **BIG))
    assert bodies.split_cancel_request(big) == info


@given(st.integers(0, 3), st.lists(INFOS, max_size=3))
def test_an_answer_to_that(code: int, infos: list[GoalInfo]) -> None:
    body = bodies.cancel_response(code, infos)
    message = read(body, CANCEL.response)
    assert (message.return_code, [info_of(each) for each in message.goals_canceling]) == (code, infos)
    assert bodies.cancel_code(body) == code


def test_the_answers_of_a_goal() -> None:
    text = "bool accepted\nbuiltin_interfaces/Time stamp\n" + "=" * 80
    text += "\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
    resolved = ros_types.resolve("test/msg/Answer", text, Encoding.CDR)
    for accepted in (True, False):
        body = bodies.goal_response(accepted=accepted, stamp=Stamp(5, 6))
        message = read(body, resolved)
        assert (message.accepted, message.stamp.sec, message.stamp.nanosec) == (accepted, 5, 6)
        assert bodies.is_accepted(body) is accepted
    assert bodies.request_uuid(bodies.result_request(bytes(range(16)))) == bytes(range(16))


@pytest.mark.parametrize(
    ("read", "size"),
    [(bodies.is_accepted, 5), (bodies.cancel_code, 5), (bodies.split_cancel_request, 28), (bodies.request_uuid, 20)],
)
def test_calls_that_are_none(read: Callable[[bytes], object], size: int) -> None:
    for body in (b"", b"\0\1\0\0" + bytes(size - 5), b"\1\1\0\0" + bytes(size), b"\0\2\0\0" + bytes(size)):
        with pytest.raises(ConfigError, match="cannot be read"):
            read(body)


@given(IDENTS, st.integers(0, 9), st.text(max_size=20), st.integers(0, 2**32 - 1), STAMPS)
def test_the_statuses_of_ros_1(ident: GoalId, status: int, text: str, seq: int, stamp: Stamp) -> None:
    body = bodies.ros1_statuses(seq, stamp, [bodies.ros1_status(ident, status, text)] * 2)
    message = read(body, ros_types.resolve("actionlib_msgs/msg/GoalStatusArray", "", Encoding.ROS1))
    assert (message.header.seq, message.header.stamp.sec, message.header.frame_id) == (seq, stamp.secs, "")
    assert len(message.status_list) == 2
    for each in message.status_list:
        assert (each.goal_id.stamp.sec, each.goal_id.stamp.nanosec, each.goal_id.id) == ident
        assert (each.status, each.text) == (status, text)


@given(IDENTS, st.integers(0, 255), st.text(max_size=20), st.binary(max_size=20))
def test_what_stands_before_a_part_of_ros_1(ident: GoalId, status: int, text: str, own: bytes) -> None:
    head = bodies.ros1_header(7, Stamp(8, 9))
    body = head + bodies.ros1_status(ident, status, text) + own
    assert bodies.split_status(body) == StatusPart(ident, status, text, own)
    for size in range(len(body) - len(own)):
        with pytest.raises(ConfigError):
            bodies.split_status(body[:size])
    goal = bodies.ros1_goal(7, ident, own)
    assert bodies.split_goal(goal) == (ident, own)
    for size in range(len(goal) - len(own)):
        with pytest.raises(ConfigError):
            bodies.split_goal(goal[:size])
    assert bodies.split_cancel(ident.pack()) == ident
    for broken in (ident.pack() + b"\0", ident.pack()[:-1], b""):
        with pytest.raises(ConfigError, match="no goal id"):
            bodies.split_cancel(broken)
