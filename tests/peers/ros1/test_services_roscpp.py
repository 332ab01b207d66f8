"""Services of C++ nodes, called from C++ nodes and the tools, both ways across the link."""

import shutil
import subprocess
from pathlib import Path
from typing import Any, Final

import pytest

from tests.daemons import HOST, Lab
from tests.peers.ros1.lab import RosLab, need

SOURCE: Final = Path(__file__).with_name("services.cpp")
BUILD_S: Final = 300
SERVICES: Final = "/lamp/(?:set|get)"


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The program, compiled for the ROS that is installed here now."""
    need("/usr/include/ros/ros.h")
    for tool in ("g++", "pkg-config"):
        if shutil.which(tool) is None:
            pytest.skip(f"no C++ node: install the Debian package {tool}")
    built = tmp_path_factory.mktemp("services") / "services"
    flags = subprocess.run(["pkg-config", "--cflags", "--libs", "roscpp"], capture_output=True, text=True, check=True)
    command = ["g++", "-O0", "-std=c++17", "-o", str(built), str(SOURCE), *flags.stdout.split()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=BUILD_S, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return str(built)


def _endpoint(ros: RosLab) -> dict[str, Any]:
    return {"kind": "ros1", "master_uri": ros.uri, "host": HOST}


async def test_cpp_nodes_call_each_other_both_ways(tmp_path: Path, program: str) -> None:
    need("/usr/bin/rosservice", "/usr/lib/python3/dist-packages/roscpp")
    async with (
        RosLab(tmp_path, "robot_ros") as robot_ros,
        RosLab(tmp_path, "site_ros") as site_ros,
        Lab(tmp_path, "robot1", "site") as lab,
    ):
        await lab.process(lab.relay_file()).ready()
        sides = {"robot1": robot_ros, "site": site_ros}
        for name, ros in sides.items():
            (other,) = sides.keys() - {name}
            services = {"offer": [{"match": SERVICES}], "use": [{"match": f"/{other}{SERVICES}"}]}
            file = lab.client_file(name, _endpoint(ros), discovery={"mode": "manual"}, services=services)
            await lab.process(file).ready()
            ros.spawn("lamp", program, "serve")
        for far, ros in ((("site", site_ros), robot_ros), (("robot1", robot_ros), site_ros)):
            other, its_ros = far
            printed = await ros.tool(program, "call", f"/{other}/lamp", "front", "on")
            lines = [line for line in printed.splitlines() if line in {"front on", "refused"}]
            assert lines == ["front on", "front on", "refused", "refused"], printed
            shown = await ros.tool("rosservice", "call", f"/{other}/lamp/get")
            assert 'name: "front"' in shown and shown == await its_ros.tool("rosservice", "call", "/lamp/get")
            kind = await ros.tool("rosservice", "type", f"/{other}/lamp/set")
            assert kind.strip() == "roscpp/SetLoggerLevel"
