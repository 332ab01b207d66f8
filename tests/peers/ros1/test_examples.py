"""The ready-made configurations for ROS 1 Noetic, with only addresses and ports changed: a robot and a van."""

import json
from pathlib import Path
from typing import Any, Final

from ruamel.yaml import YAML

from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_types
from sern_tools.ports import free_ports
from tests.daemons import HOST, Lab
from tests.peers.ros1.lab import GEOMETRY_MSGS, SUBSCRIBER, RosLab, need, publisher
from tests.support import until

EXAMPLES: Final = Path(__file__).resolve().parents[3] / "deploy" / "examples"


def adapt(lab: Lab, name: str, *, to: str, ros: RosLab | None = None) -> Path:
    """The example as TO.yaml of the lab."""
    content: Any = YAML(typ="safe").load((EXAMPLES / f"{name}.yaml").read_text())
    content["http"]["listen"] = f"{HOST}:{free_ports(1)[0]}"
    if ros is None:
        content["relay"]["listen"] = [lab.endpoint]
        for role in content["feed"]["roles"]:
            role["publish_endpoint"] = f"tcp://{HOST}:{free_ports(1)[0]}"
    else:
        content["relay"]["endpoint"] = lab.endpoint
        content["endpoint"] |= {"master_uri": ros.uri, "host": HOST}
    path = lab.directory / f"{to}.yaml"
    path.write_text(json.dumps(content))  # JSON is YAML
    return path


async def test_a_jackal_and_a_van(tmp_path: Path) -> None:
    need("/usr/lib/python3/dist-packages/nav_msgs", GEOMETRY_MSGS)
    async with (
        RosLab(tmp_path, "robot_ros") as robot_ros,
        RosLab(tmp_path, "van_ros") as van_ros,
        Lab(tmp_path, "jackal1", "site1") as lab,
    ):
        await lab.process(adapt(lab, "relay", to="relay")).ready()
        robot = lab.process(adapt(lab, "jackal-noetic", to="jackal1", ros=robot_ros))
        van = lab.process(adapt(lab, "site-noetic", to="site1", ros=van_ros))
        await robot.ready()
        await van.ready()

        pose = "m.Odometry(header=m.Path().header, child_frame_id='base_link')"
        robot_ros.python("pose", publisher("/odometry/filtered", "nav_msgs/Odometry", pose), "pose")
        robot_ros.python("joy", publisher("/joy_teleop/cmd_vel", "geometry_msgs/Twist", "m.Twist()"), "joy")
        grid = "m.OccupancyGrid(info=m.MapMetaData(resolution=0.05, width=200, height=200), data=[0] * 40000)"
        robot_ros.python("map", publisher("/map", "nav_msgs/OccupancyGrid", grid, latch=True), "map")
        robot_ros.python("motors", SUBSCRIBER, "motors", "/cmd_vel")
        van_ros.python("viewer", SUBSCRIBER, "viewer", "/jackal1/odometry/filtered", "/jackal1/map")
        body = "m.Twist(linear=m.Vector3(x=0.5))"
        driver = van_ros.python("driver", publisher("/jackal1/cmd_vel", "geometry_msgs/Twist", body), "driver")

        def seen(topic: str) -> list[Any]:
            return [line for line in van_ros.lines("viewer") if line["topic"] == topic]

        await until(lambda: len(seen("/jackal1/odometry/filtered")) > 5, "the pose arrives")
        await until(lambda: seen("/jackal1/map"), "the map arrives")
        (frame,) = {line["hex"] for line in seen("/jackal1/odometry/filtered")[-1:]}
        assert b"jackal1/base_link".hex() in frame, "frames are the robot's own"
        assert seen("/jackal1/map")[0]["bytes"] > 40_000

        zero = ros_types.zero_message("geometry_msgs/msg/Twist", Encoding.ROS1)
        assert zero is not None

        def commands() -> list[str]:
            return [line["hex"] for line in robot_ros.lines("motors")]

        # On a busy machine a gap between two commands may be a stop already.
        await until(lambda: len(commands()) > 5 and commands()[-1] != zero.hex(), "commands arrive")
        van_ros.kill(driver)
        await until(lambda: commands()[-1] == zero.hex(), "without the driver the robot is told to stand still")
        assert not van_ros.publishers("/jackal1/joy_teleop/cmd_vel"), "what no rule names stays at the robot"
