"""The `rclpy` endpoint itself in a sourced Python: this one cannot become one, so another runs `rclpy_cases.py`."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.peers.ros2.sourced import DISTROS, HERE, before


@pytest.mark.parametrize("distro", DISTROS)
def test_the_cases_in_a_sourced_python(distro: str, tmp_path: Path) -> None:
    cases = Path(__file__).with_name("rclpy_cases.py")
    # A package of ROS imports a module that Python 3.11 warns of.
    options = ["-W", "ignore::DeprecationWarning", "-p", "no:cacheprovider", f"--basetemp={tmp_path / 'inside'}"]
    command = [*before(distro), sys.executable, "-m", "pytest", *options, str(cases)]
    done = subprocess.run(command, cwd=HERE, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    passed = re.search(r"(\d+) passed", done.stdout)
    assert passed is not None and int(passed[1]) == cases.read_text().count("\nasync def test_"), done.stdout
