"""Where rclpy is looked for, and what is said of the Python it needs."""

import sys
from pathlib import Path

import pytest

from sern_runtime import ros_installation

MINE = f"{sys.version_info.major}.{sys.version_info.minor}"


def installed(place: Path, layout: str) -> Path:
    (place / layout / "rclpy").mkdir(parents=True)
    return place


@pytest.mark.parametrize(
    ("layout", "said"),
    [
        ("lib/python3.8/site-packages", "is for Python 3.8, and this is"),
        ("local/lib/python3.8/dist-packages", "install SERN with python3.8 and source"),
        (f"lib/python{MINE}/site-packages", "before this is started, in the same shell or unit"),
    ],
)
def test_the_remedy_names_the_python_that_is_needed(tmp_path: Path, layout: str, said: str) -> None:
    place = installed(tmp_path / "ros" / "jazzy", layout)
    for environment, system in (({"AMENT_PREFIX_PATH": str(place)}, tmp_path / "none"), ({}, tmp_path / "ros")):
        found = ros_installation.remedy(environment, system)
        assert said in found and f"{place}/setup.bash" in found and "\n" not in found


def test_without_an_installation_the_remedy_says_so(tmp_path: Path) -> None:
    found = ros_installation.remedy({"AMENT_PREFIX_PATH": str(tmp_path)}, tmp_path / "none")
    assert "no ROS 2 installation was found" in found and MINE in found


def test_the_files_of_a_package_lie_beside_it(tmp_path: Path) -> None:
    package = tmp_path / "lib" / "python3.12" / "site-packages" / "robot_msgs" / "__init__.py"
    assert ros_installation.share_of(str(package), "robot_msgs") is None
    share = tmp_path / "share" / "robot_msgs"
    share.mkdir(parents=True)
    assert ros_installation.share_of(str(package), "robot_msgs") == share
