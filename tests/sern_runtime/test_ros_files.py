"""Definitions from .msg and .srv files."""

from pathlib import Path

import pytest

from sern_core.errors import ConfigError
from sern_core.types import Encoding
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
