"""A person at a site without ROS looks at a robot and drives it, over a relay."""

from pathlib import Path

import pytest

pytest.importorskip("foxglove", reason="the foxglove endpoint needs foxglove-sdk: pip install foxglove-sdk")
pytest.importorskip("websockets", reason="viewers of the tests need websockets: pip install websockets")

from sern_client.endpoints.foxglove.endpoint import FoxgloveEndpoint
from sern_client.endpoints.synthetic import SyntheticEndpoint
from sern_core.summaries.transforms import read_transforms
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_types
from sern_tools.ports import free_ports
from tests.daemons import Lab, endpoint_of
from tests.support import LASTING, until
from tests.viewers import start_runtime, viewer

COMMAND = b'{"linear": {"x": 0.5}}'
ROBOT_RULES = [
    {
        "match": "/cmd_vel",
        "class": "control",
        "direction": "receive",
        "on_link_loss": {"publish": "zero", "after_s": 0.5},
    }
]
SITE_RULES = [{"match": "/robot1/cmd_vel", "class": "control", "direction": "send", "lifespan_s": 1.0}]


@pytest.fixture(autouse=True)
def runtime(nothing_left_behind: None) -> None:
    """What the SDK keeps to the end of the process is not held against a test."""
    if not LASTING:
        start_runtime()


async def test_a_person_looks_and_drives(tmp_path: Path) -> None:
    (port,) = free_ports(1)
    async with Lab(tmp_path, "robot1", "site") as lab:
        relay = await lab.relay()
        robot = await lab.connected(
            lab.client_file(
                "robot1", {"kind": "synthetic", "role": "robot", "topics": ["/pose", "/tf_static"], "encoding": "ros1"},
                topics=ROBOT_RULES, discovery={"mode": "dynamic"},
            )
        )  # fmt: skip
        site = await lab.connected(
            lab.client_file(
                "site", {"kind": "foxglove", "listen": f"127.0.0.1:{port}", "publish": ["/robot1/cmd_vel"]},
                client={"namespace": "/"}, topics=SITE_RULES, subscribe=["/robot1/.*"],
            )
        )  # fmt: skip
        endpoint: FoxgloveEndpoint = endpoint_of(site, FoxgloveEndpoint)
        simulated: SyntheticEndpoint = endpoint_of(robot, SyntheticEndpoint)
        async with viewer(port) as person:
            await person.look("/robot1/pose", "/robot1/tf_static")
            (body, *_) = await person.got_of("/robot1/pose")
            start = ros_types.deserialise(body, "geometry_msgs/msg/PoseStamped", Encoding.ROS1).pose.position
            (tree, *_) = await person.got_of("/robot1/tf_static")
            assert read_transforms(tree, Encoding.ROS1)
            await person.advertise(1, "/robot1/cmd_vel", "geometry_msgs/Twist")

            def moved() -> bool:
                newest = person.got["/robot1/pose"][-1].body
                here = ros_types.deserialise(newest, "geometry_msgs/msg/PoseStamped", Encoding.ROS1).pose.position
                return bool(abs(here.x - start.x) + abs(here.y - start.y) > 0.2)

            while not moved():
                await person.publish(1, COMMAND)
                seen = len(person.got["/robot1/pose"])
                await until(lambda seen=seen: len(person.got["/robot1/pose"]) > seen)  # type: ignore[misc]
            assert simulated.received("/cmd_vel") is not None
        fired = robot.bridge.inbound.commands.leases_fired
        await until(lambda: robot.bridge.inbound.commands.leases_fired > fired or simulated.state().speed_mps == 0.0)
        assert endpoint.drops == {}
        for daemon in (site, robot, relay):
            await lab.end(daemon)
