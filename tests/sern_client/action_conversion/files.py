"""Definitions of actions, as users have them, and what is in a stream of them."""

from pathlib import Path
from typing import Final

from sern_client.action_conversion.types import ActionTypes, action_types, names_of_ros1, ros2_texts
from sern_runtime.ros_files import TypeFiles

FIBONACCI: Final = "int32 order\n---\nint32[] sequence\n---\nint32[] sequence\n"
NAVIGATE: Final = """#goal definition
geometry_msgs/PoseStamped pose
string behavior_tree
---
uint16 NONE=0
uint16 error_code
string error_msg
---
geometry_msgs/PoseStamped current_pose
builtin_interfaces/Duration navigation_time
builtin_interfaces/Duration estimated_time_remaining
int16 number_of_recoveries
float32 distance_remaining
"""


def folder(place: Path, **actions: str) -> Path:
    """`package__Name=text`: files of ROS 2 as a workspace has them."""
    for name, text in actions.items():
        package, _, base = name.partition("__")
        path = place / package / "action" / f"{base}.action"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return place


def files(place: Path, **actions: str) -> list[TypeFiles]:
    return [TypeFiles([folder(place, **actions)])]


def types_of(action: str, known: list[TypeFiles], ros1: dict[str, str] | None = None) -> ActionTypes:
    """The types of an action of ROS 1, PACKAGE/NAME."""
    names = names_of_ros1(action)
    texts = ros2_texts(names.ros2, known)
    assert texts is not None
    return action_types(names, texts, ros1 or {})
