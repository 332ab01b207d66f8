"""Definitions from .msg and .srv files."""

from pathlib import Path

import pytest

from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_services, ros_types
from sern_runtime.ros_files import TypeFiles


@pytest.fixture
def share(tmp_path: Path) -> Path:
    files = {
        "my_msgs/msg/Deep.msg": "std_msgs/Header header\nPart[] parts\nint32 A=3\n",
        "my_msgs/msg/Part.msg": "float64 x  # metres\nother_msgs/Leaf leaf",
        "my_msgs/srv/Do.srv": "Part part\n---\nbool ok\n",
        "src/other_msgs/msg/Leaf.msg": "string name\n",
        "my_msgs/msg/Lost.msg": "nowhere_msgs/Thing thing\n",
        "my_msgs/msg/Bad.msg": "uint8[ x\n",
        "my_msgs/srv/Half.srv": "bool a\n",
        "my_msgs/action/Go.action": "Part target\n---\nbool there\n---\nPart[] passed\n",
        "my_msgs/action/Odd.action": "bool a\n---\nbool b\n",
    }
    for name, text in files.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return tmp_path


def test_a_message_with_all_it_uses(share: Path) -> None:
    text = TypeFiles([share]).message("my_msgs/msg/Deep")
    assert text is not None
    heads = [line for line in text.splitlines() if line.startswith("MSG: ")]
    assert heads == [
        "MSG: std_msgs/Header",
        "MSG: builtin_interfaces/Time",
        "MSG: my_msgs/Part",
        "MSG: other_msgs/Leaf",
    ]
    resolved = ros_types.resolve("my_msgs/msg/Deep", text, Encoding.CDR)
    names = [name for name, _ in resolved.store.fielddefs["my_msgs/msg/Deep"][1]]
    assert names == ["header", "parts"]
    assert resolved.text.type_hash.startswith("RIHS01_")


def test_a_service(share: Path) -> None:
    text = TypeFiles([share]).service("my_msgs/srv/Do")
    assert text is not None
    service = ros_services.resolve("my_msgs/srv/Do", text, Encoding.CDR)
    assert [name for name, _ in service.request.store.fielddefs[service.request.name][1]] == ["part"]


def fields(type_name: str, text: str | None) -> list[tuple[str, str]]:
    """Names and types of a message's fields, types by their last word."""
    assert text is not None
    resolved = ros_types.resolve(type_name, text, Encoding.CDR)
    return [(name, repr(desc).split("'")[1]) for name, desc in resolved.store.fielddefs[type_name][1]]


def test_an_action(share: Path) -> None:
    """Three services and two topics, as ROS 2 makes them of it; `CancelGoal` and the status are of every action."""
    files, go = TypeFiles([share]), "my_msgs/action/Go"
    uuid = ("goal_id", "unique_identifier_msgs/msg/UUID")
    assert fields(f"{go}_FeedbackMessage", files.message(f"{go}_FeedbackMessage")) == [
        uuid,
        ("feedback", f"{go}_Feedback"),
    ]
    assert fields(f"{go}_Goal", files.message(f"{go}_Goal")) == [("target", "my_msgs/msg/Part")]
    parts = {}
    for name in (f"{go}_SendGoal", f"{go}_GetResult", "action_msgs/srv/CancelGoal"):
        text = files.service(name)
        assert text is not None
        service = ros_services.resolve(name, text, Encoding.CDR)
        assert service.name == name and service.text.type_hash.startswith("RIHS01_")
        parts[name] = [
            [(key, repr(desc).split("'")[1]) for key, desc in half.store.fielddefs[half.name][1]]
            for half in (service.request, service.response)
        ]
    assert parts == {
        f"{go}_SendGoal": [
            [uuid, ("goal", f"{go}_Goal")],
            [("accepted", "bool"), ("stamp", "builtin_interfaces/msg/Time")],
        ],
        f"{go}_GetResult": [[uuid], [("status", "int8"), ("result", f"{go}_Result")]],
        "action_msgs/srv/CancelGoal": [
            [("goal_info", "action_msgs/msg/GoalInfo")],
            [("return_code", "int8"), ("goals_canceling", "action_msgs/msg/GoalInfo")],
        ],
    }
    assert files.message(f"{go}_Nothing") is None and files.service("my_msgs/action/Stay_SendGoal") is None
    assert TypeFiles().service("example_interfaces/action/Fibonacci_SendGoal") is not None


def test_what_is_known_needs_no_file() -> None:
    files = TypeFiles()
    known = ros_types.describe("nav_msgs/msg/Odometry", Encoding.CDR)
    assert known is not None
    assert files.message("nav_msgs/Odometry") == known.definition
    assert files.service("std_srvs/srv/SetBool") == "bool data\n---\nbool success\nstring message\n"
    assert files.message("my_msgs/msg/Deep") is None
    assert files.service("my_msgs/srv/Do") is None


@pytest.mark.parametrize(
    ("kind", "name", "problem"),
    [
        ("message", "my_msgs/msg/Lost", r"uses nowhere_msgs/msg/Thing, whose definition is in none of the type_paths"),
        ("message", "my_msgs/msg/Bad", r"my_msgs/msg/Bad: its definition cannot be parsed"),
        ("service", "my_msgs/srv/Half", r"needs one line of --- between"),
        ("message", "my_msgs/action/Odd_Goal", r"action/Odd: its definition needs two lines of --- between its parts"),
    ],
)
def test_what_is_wrong_with_a_file_is_said(share: Path, kind: str, name: str, problem: str) -> None:
    files = TypeFiles([share])
    with pytest.raises(ConfigError, match=problem):
        (files.message if kind == "message" else files.service)(name)


def test_a_file_that_cannot_be_read(share: Path) -> None:
    (share / "my_msgs/msg/Part.msg").write_bytes(b"\xff\xfe")
    with pytest.raises(ConfigError, match=r"Part.msg: cannot be read"):
        TypeFiles([share]).message("my_msgs/msg/Part")


def test_what_the_paths_lack_comes_from_an_installation(share: Path, tmp_path: Path) -> None:
    installed = tmp_path / "installed" / "robot_msgs"
    (installed / "msg").mkdir(parents=True)
    (installed / "msg" / "Arm.msg").write_text("my_msgs/Part part\n")
    asked: list[str] = []

    def of(package: str) -> Path | None:
        asked.append(package)
        return installed if package == "robot_msgs" else None

    files = TypeFiles([share], of)
    text = files.message("robot_msgs/msg/Arm")
    assert text is not None and text.startswith("my_msgs/Part part\n") and "MSG: other_msgs/Leaf" in text
    assert files.message("robot_msgs/msg/Leg") is None and "my_msgs" not in asked
