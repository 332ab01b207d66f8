"""Which actions stand for each other, and their bodies: against rosbags."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sern_client.action_conversion import types
from sern_client.action_conversion.types import (
    Names,
    Pair,
    action_types,
    names_of_ros1,
    names_of_ros2,
    ros1_action,
    ros1_text,
    ros2_action,
    ros2_text,
    ros2_texts,
)
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_services, ros_types
from sern_runtime.ros_files import TypeFiles
from sern_runtime.ros_types import ResolvedType
from tests.sern_client.action_conversion.files import FIBONACCI, NAVIGATE, files, types_of

UUID = bytes(range(16))


def message(resolved: ResolvedType, body: bytes) -> Any:
    if resolved.encoding is Encoding.ROS1:
        return resolved.store.deserialize_ros1(body, resolved.name)
    return resolved.store.deserialize_cdr(body, resolved.name)


def bytes_of(resolved: ResolvedType, **fields: Any) -> bytes:
    made = ros_types.new_in(resolved.store, resolved.name, **fields)
    if resolved.encoding is Encoding.ROS1:
        return bytes(resolved.store.serialize_ros1(made, resolved.name))
    return bytes(resolved.store.serialize_cdr(made, resolved.name))


def service(known: list[TypeFiles], type_name: str) -> ros_services.ResolvedService:
    text = known[0].service(type_name)
    assert text is not None
    return ros_services.resolve(type_name, text, Encoding.CDR)


def test_which_stands_for_which() -> None:
    assert names_of_ros1("count/Count") == Names("count/Count", "count/action/Count", None)
    assert names_of_ros2("count/action/Count") == Names("count/Count", "count/action/Count", None)
    there, back = names_of_ros1("move_base_msgs/MoveBase"), names_of_ros2("nav2_msgs/action/NavigateToPose")
    assert there == back and there.ros2 == "nav2_msgs/action/NavigateToPose" and there.ros1 == "move_base_msgs/MoveBase"


@pytest.mark.parametrize(
    ("type_name", "part", "action"),
    [
        ("count/msg/CountActionGoal", "goal", "count/Count"),
        ("count/msg/CountActionResult", "result", "count/Count"),
        ("count/msg/CountActionResult", "feedback", None),
        ("count/msg/CountGoal", "goal", None),
        ("count/msg/ActionGoal", "goal", None),
        ("CountActionGoal", "goal", None),
    ],
)
def test_the_action_of_a_topic_of_ros_1(type_name: str, part: str, action: str | None) -> None:
    assert ros1_action(type_name, part) == action


@pytest.mark.parametrize(
    ("type_name", "end", "action"),
    [
        ("count/action/Count_SendGoal", "SendGoal", "count/action/Count"),
        ("count/action/Count_SendGoal", "GetResult", None),
        ("count/srv/Count_SendGoal", "SendGoal", None),
        ("Count_SendGoal", "SendGoal", None),
    ],
)
def test_the_action_of_a_service_of_ros_2(type_name: str, end: str, action: str | None) -> None:
    assert ros2_action(type_name, end) == action


def test_the_topics_of_ros_1_are_those_that_actionlib_makes(tmp_path: Path) -> None:
    """actionlib/Test is the example: every installation of ROS 1 has its messages, rosbags too."""
    found = types_of(
        "actionlib/Test", files(tmp_path, actionlib__Test="int32 goal\n---\nint32 result\n---\nint32 feedback\n")
    )
    for part in (found.goal, found.result, found.feedback):
        name, text = part.topic
        known = ros_types.describe(name, Encoding.ROS1)
        assert known is not None and text.type_hash == known.type_hash
        assert ros_types.resolve(name, text.definition, Encoding.ROS1).text.type_hash == known.type_hash


def test_bodies_go_there_and_back(tmp_path: Path) -> None:
    known = files(tmp_path, count__Count=FIBONACCI)
    found = types_of("count/Count", known)
    send, get = service(known, "count/action/Count_SendGoal"), service(known, "count/action/Count_GetResult")
    goal = bytes_of(found.goal.ros1, order=5)
    request = found.goal.to_ros2(UUID, goal)
    read = message(send.request, request)
    assert (bytes(read.goal_id.uuid), read.goal.order) == (UUID, 5)
    assert found.goal.to_ros1(request) == (UUID, goal)
    big = bytes(send.request.store.serialize_cdr(read, send.request.name, little_endian=False))
    assert found.goal.to_ros1(big) == (UUID, goal)

    result = bytes_of(found.result.ros1, sequence=np.array([1, 1, 2], dtype="int32"))
    response = found.result.to_ros2(b"\4", result)
    read = message(get.response, response)
    assert (read.status, list(read.result.sequence)) == (4, [1, 1, 2])
    assert found.result.to_ros1(response) == (b"\4", result)
    read = message(get.response, found.no_result(6))
    assert (read.status, list(read.result.sequence)) == (6, [])

    text = known[0].message("count/action/Count_FeedbackMessage")
    assert text is not None
    feedback = found.feedback.to_ros2(UUID, result)
    read = message(ros_types.resolve("count/action/Count_FeedbackMessage", text, Encoding.CDR), feedback)
    assert (bytes(read.goal_id.uuid), list(read.feedback.sequence)) == (UUID, [1, 1, 2])
    assert found.feedback.to_ros1(feedback) == (UUID, result)


def test_bytes_that_are_none_are_told_of_in_one_line(tmp_path: Path) -> None:
    found = types_of("count/Count", files(tmp_path, count__Count=FIBONACCI))
    for body in (b"", b"\0\1\0\0", found.goal.to_ros2(UUID, bytes(4))[:-1], b"\0\1\0\0" + bytes(30)):
        with pytest.raises(ConfigError, match=r"^type count.*cannot be converted to ros1: [^\n]*$"):
            found.goal.to_ros1(body)
    for body in (b"", bytes(3), bytes(5)):
        with pytest.raises(ConfigError, match=r"^type count.*cannot be converted to cdr: [^\n]*$"):
            found.goal.to_ros2(UUID, body)


def test_an_action_with_everything_in_it(tmp_path: Path) -> None:
    """Headers, constants, messages of its package, parts that are empty."""
    text = "uint8 LEFT=1\nstd_msgs/Header header\nSide side\n---\n---\nstring[] words\nfloat64 angle\n"
    known = files(tmp_path, turn__Turn=text)
    (tmp_path / "turn" / "msg").mkdir()
    (tmp_path / "turn" / "msg" / "Side.msg").write_text("bool left\nfloat64[3] far\nbuiltin_interfaces/Time[] when\n")
    found = types_of("turn/Turn", known)
    name, text1 = found.goal.topic
    assert (
        name == "turn/msg/TurnActionGoal" and "uint8 LEFT=1" in text1.definition and "time[] when" in text1.definition
    )
    store = found.goal.ros1.store
    header = ros_types.header(5, "map", Encoding.ROS1, seq=0)
    side = ros_types.new_in(store, "turn/msg/Side", left=True, far=np.array([1.0, 2.0, 3.0]))
    goal = bytes_of(found.goal.ros1, header=header, side=side)
    request = found.goal.to_ros2(UUID, goal)
    read = message(service(known, "turn/action/Turn_SendGoal").request, request)
    assert (read.goal.header.frame_id, list(read.goal.side.far)) == ("map", [1.0, 2.0, 3.0])
    assert found.goal.to_ros1(request) == (UUID, goal)
    assert found.result.zero == b"" and found.result.to_ros1(found.no_result(4)) == (b"\4", b"")
    get = service(known, "turn/action/Turn_GetResult")
    assert found.no_result(4) == bytes_of(get.response, status=4)
    assert found.feedback.zero == bytes(4) + bytes(8)


def test_a_goal_of_move_base_is_one_of_nav2(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ros_types, "MAX_GENERATED_TYPES", 100)  # it is the test that reads and writes by value
    known = files(tmp_path, nav2_msgs__NavigateToPose=NAVIGATE)
    found = types_of("move_base_msgs/MoveBase", known)
    # The sums that `rosmsg md5` tells.
    assert found.goal.topic[1].type_hash == "660d6895a1b9a16dce51fbdd9a64a56b"
    assert found.result.topic[1].type_hash == "1eb06eeff08fa7ea874431638cb52332"
    assert found.feedback.topic[1].type_hash == "7d1870ff6e0decea702b943b5af0b42e"
    pose = ros_types.new("geometry_msgs/msg/PoseStamped", Encoding.ROS1)
    pose.header.frame_id, pose.pose.position.x, pose.pose.orientation.w = "map", 3.5, 1.0
    goal = bytes_of(found.goal.ros1, target_pose=pose)
    request = found.goal.to_ros2(UUID, goal)
    nav2 = message(service(known, "nav2_msgs/action/NavigateToPose_SendGoal").request, request)
    assert bytes(nav2.goal_id.uuid) == UUID and nav2.goal.behavior_tree == ""
    assert (nav2.goal.pose.header.frame_id, nav2.goal.pose.pose.position.x) == ("map", 3.5)
    assert found.goal.to_ros1(request) == (UUID, goal)

    feedback = found.feedback.to_ros2(UUID, bytes_of(found.feedback.ros1, base_position=pose))
    assert found.feedback.to_ros1(feedback)[1] == goal  # the same pose
    text = known[0].message("nav2_msgs/action/NavigateToPose_FeedbackMessage")
    assert text is not None
    read = message(ros_types.resolve("nav2_msgs/action/NavigateToPose_FeedbackMessage", text, Encoding.CDR), feedback)
    assert read.feedback.current_pose.pose.position.x == 3.5
    assert (read.feedback.distance_remaining, read.feedback.number_of_recoveries) == (0.0, 0)
    get = service(known, "nav2_msgs/action/NavigateToPose_GetResult")
    assert found.result.to_ros2(b"\4", b"") == bytes_of(get.response, status=4)
    failed = message(get.response, found.no_result(6))
    failed.result.error_code, failed.result.error_msg = 9, "no way"
    body = bytes(get.response.store.serialize_cdr(failed, get.response.name))
    assert found.result.to_ros1(body) == (b"\6", b"")


def test_a_goal_of_another_pair_is_refused_by_what_it_lacks(tmp_path: Path) -> None:
    """The definition of ROS 2 is another version's."""
    known = files(tmp_path, nav2_msgs__NavigateToPose="geometry_msgs/Pose pose\n---\n---\nfloat32 current_pose\n")
    with pytest.raises(ConfigError, match=r"MoveBaseGoal cannot be made into .*Goal: target_pose is not what"):
        types_of("move_base_msgs/MoveBase", known)


def test_another_pair_is_a_line(tmp_path: Path) -> None:
    pair = Pair("old/Go", "new/action/Move", "float64 far\n---\nbool ok\n---\n", goal=(("far", "distance"),))
    texts = ros2_texts(
        "new/action/Move", files(tmp_path, new__Move="string why\nfloat64 distance\n---\nuint8 code\n---\n")
    )
    assert texts is not None
    found = action_types(names_of_ros1("old/Go", [pair]), texts, {})
    assert found.goal.to_ros1(found.goal.to_ros2(UUID, bytes_of(found.goal.ros1, far=2.5)))[1] == bytes_of(
        found.goal.ros1, far=2.5
    )
    assert found.result.to_ros1(found.result.to_ros2(b"\4", b"\1")) == (b"\4", b"\0")
    assert found.feedback.to_ros1(found.feedback.to_ros2(UUID, b"")) == (UUID, b"")


def test_every_kind_of_field_changes_its_place(tmp_path: Path) -> None:
    fields = (
        "string[] texts\nfloat64 one\nint16[3] few\ngeometry_msgs/Point32[2] points\nduration[] spans\nuint8[] raw\n"
    )
    theirs = "bool first\nuint8[] raw\nbuiltin_interfaces/Duration[] spans\ngeometry_msgs/Point32[2] points\n"
    theirs += "string why\nint16[3] few\nfloat64 one\nstring[] texts\ngeometry_msgs/Point32[2] more\n"
    same = tuple((name, name) for name in ("texts", "one", "few", "points", "spans", "raw"))
    pair = Pair("old/Go", "new/action/Move", f"{fields}---\n---\n", goal=same)
    texts = ros2_texts("new/action/Move", files(tmp_path, new__Move=f"{theirs}---\n---\n"))
    assert texts is not None
    found = action_types(names_of_ros1("old/Go", [pair]), texts, {})
    new = ros_types.new
    goal = bytes_of(
        found.goal.ros1, texts=["a", "", "bcd"], one=1.5, few=np.array([1, 2, 3], dtype="int16"),
        points=[new("geometry_msgs/msg/Point32", Encoding.ROS1, x=each) for each in (1.0, 2.0)],
        spans=[new("builtin_interfaces/msg/Duration", Encoding.ROS1, sec=4)], raw=np.array([9, 8], dtype="uint8"),
    )  # fmt: skip
    request = found.goal.to_ros2(UUID, goal)
    assert found.goal.to_ros1(request) == (UUID, goal)
    for broken in (goal[:-1], goal + b"\0", b""):
        with pytest.raises(ConfigError, match=r"type old/msg/GoGoal: \d+ bytes are none"):
            found.goal.to_ros2(UUID, broken)


def test_bodies_with_too_many_parts_are_not_read_value_by_value(tmp_path: Path) -> None:
    pair = Pair("old/Go", "new/action/Move", "string[] words\n---\n---\n", goal=(("words", "texts"),))
    texts = ros2_texts("new/action/Move", files(tmp_path, new__Move="string[] texts\n---\n---\n"))
    assert texts is not None
    found = action_types(names_of_ros1("old/Go", [pair]), texts, {})
    with pytest.raises(ConfigError, match=r"type old/msg/GoGoal: .* have too many parts"):
        found.goal.to_ros2(UUID, b"\0\0\1\0" + bytes(4 * 2**16))


def test_parts_of_what_a_stream_brings(tmp_path: Path) -> None:
    known = files(tmp_path, count__Count=FIBONACCI)
    text = known[0].service("count/action/Count_SendGoal")
    assert text is not None
    goal = ros2_text("count/action/Count", "goal", "count/action/Count_SendGoal", text)
    assert goal.partition("=")[0] == "int32 order\n"
    with pytest.raises(ConfigError, match="does not have count/action/Count_Result in it"):
        ros2_text("count/action/Count", "result", "count/action/Count_SendGoal", text)
    ros1 = types_of("count/Count", known).result.topic
    found = ros1_text("count/Count", "result", ros1[0], ros1[1].definition)
    assert found.partition("=")[0] == "int32[] sequence\n"
    assert types_of("count/Count", known, {"result": found}).result.to_ros2(b"\4", bytes(4))[4] == 4
    with pytest.raises(ConfigError, match="does not have"):
        ros1_text("count/Count", "result", "count/msg/CountActionResult", "")


@pytest.mark.parametrize(
    ("theirs", "named"),
    [
        ("int32 other\n", "order, other"),
        ("int64 order\n", "order"),
        ("int32 order\nbool more\n", "more"),
        ("int32[] order\n", "order"),
    ],
)
def test_parts_that_differ_are_named(tmp_path: Path, theirs: str, named: str) -> None:
    with pytest.raises(ConfigError, match=f"count/msg/CountGoal and its like in the other ROS differ in {named}$"):
        types_of("count/Count", files(tmp_path, count__Count=FIBONACCI), {"goal": theirs})


def test_fields_in_another_order_differ(tmp_path: Path) -> None:
    known = files(tmp_path, count__Count="int32 a\nint32 b\n---\n---\n")
    with pytest.raises(ConfigError, match=r"differ in b, a$"):
        types_of("count/Count", known, {"goal": "int32 b\nint32 a\n"})
    types_of("count/Count", known, {"goal": "int32 A\nuint8 CONSTANT=1\nint32 b\n"})


def test_types_in_each_other_many_times_are_compared_at_once() -> None:
    lines = [f"T{number + 1}[] a\nT{number + 1}[] b\n" for number in range(25)] + ["int32 a\nint32 b\n"]
    text = lines[0] + "".join(f"{'=' * 80}\nMSG: deep/T{number}\n{line}" for number, line in enumerate(lines) if number)
    resolved = ros_types.resolve("deep/msg/DeepGoal", text, Encoding.ROS1)
    assert types._differing(resolved, resolved) == []


def test_what_is_in_no_file_is_none(tmp_path: Path) -> None:
    assert ros2_texts("count/action/Count", files(tmp_path)) is None
    with pytest.raises(ConfigError, match="two lines of ---"):
        ros2_texts("count/action/Count", files(tmp_path, count__Count="int32 order\n"))
