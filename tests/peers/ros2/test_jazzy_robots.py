"""The shipped files of a Jackal and a Husky with Jazzy, and of a site, among real rclpy nodes of the default middleware
that play robot and operator: topics, commands, goals, and a relay that is gone meanwhile."""

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from random import Random
from typing import Final, NamedTuple

import pytest

pytest.importorskip("cyclonedds", reason="the dds endpoint needs cyclonedds: pip install cyclonedds==11.0.1")

from sern_client.endpoints.dds.definitions import Definitions
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_types
from sern_tools.ports import free_ports
from tests.daemons import Lab, Process
from tests.peers.dds.peer import free_domain
from tests.peers.ros2.sourced import PLACE, RosNode, RosNodes, before, sourced, until_answered, until_fed
from tests.sern_client.messages import made_up
from tests.support import until

EXAMPLES: Final = Path(__file__).resolve().parents[3] / "deploy" / "examples"
TWIST: Final = "geometry_msgs/msg/TwistStamped"
SUCCEEDED, CANCELED, ABORTED = 4, 5, 6
STEPS_LEFT: Final = [3.0, 2.0, 1.0, 0.0]
"""What the robot's node tells of each goal."""
PACKAGES: Final = ("nav2_msgs", "clearpath_platform_msgs", "tf2_msgs")


class Sent(NamedTuple):
    """A topic of the robot below its namespace."""

    topic: str
    type_name: str
    latched: bool = False
    expires: bool = False
    """Its messages are worth nothing after half a second, which the first may take: it is written until one came."""


SENT: Final = (
    Sent("platform/odom/filtered", "nav_msgs/msg/Odometry", expires=True),
    Sent("platform/emergency_stop", "std_msgs/msg/Bool"),
    Sent("platform/mcu/status", "clearpath_platform_msgs/msg/Status"),
    Sent("sensors/gps_0/fix", "sensor_msgs/msg/NavSatFix"),
    Sent("tf", "tf2_msgs/msg/TFMessage"),
    Sent("tf_static", "tf2_msgs/msg/TFMessage", latched=True),
)


class Scene:
    """Both nodes, and the daemons between them."""

    def __init__(self, lab: Lab, nodes: RosNodes, robot: str) -> None:
        self.lab = lab
        self.robot = robot
        self.domains = free_domain(), free_domain()
        self.types = Definitions([PLACE / "share" / package for package in PACKAGES])
        self._nodes = nodes

    async def start(self, example: str) -> None:
        self.relay_file = self.lab.relay_file()
        self.relay = self.lab.process(self.relay_file)
        await self.relay.ready()
        self.machine = await self._nodes.start(self.domains[0], "machine")
        self.desk = await self._nodes.start(self.domains[1], "desk")
        self.robot_client = self._client(example, self.robot, self.domains[0])
        self.site_client = self._client("site-jazzy.yaml", "site1", self.domains[1])
        for client in (self.robot_client, self.site_client):
            await client.said("connected to relay")

    def _client(self, example: str, name: str, domain: int) -> Process:
        """The example as it is, but for addresses, and within this host."""
        text = (EXAMPLES / example).read_text(encoding="utf-8")
        for pattern, value in (
            (r"tcp://relay\.example:5555", self.lab.endpoint),
            (r"\{kind: dds, domain: 0\}", f"{{kind: dds, domain: {domain}, localhost_only: true}}"),
            (r"\{kind: rclpy, domain: 0,", f"{{kind: rclpy, domain: {domain}, poll_hz: 20,"),
            (r"127\.0\.0\.1:558\d", f"127.0.0.1:{free_ports(1)[0]}"),
        ):
            text, count = re.subn(pattern, value, text)
            assert count, f"{example} has no {pattern}"
        path = self.lab.directory / f"{name}.yaml"
        path.write_text(text, encoding="utf-8")
        return self.lab.process(path, before=before())

    def body(self, type_name: str, seed: int) -> str:
        resolved = ros_types.resolve(type_name, self.types.message(type_name).definition, Encoding.CDR)
        return bytes(
            resolved.store.serialize_cdr(made_up(resolved.store, resolved.name, Random(seed)), type_name)
        ).hex()

    def name(self, topic: str) -> str:
        return f"/{self.robot}/{topic}"

    async def goal(self, key: str, x: float) -> None:
        await self.desk.do("navigate", action=self.name("navigate_to_pose"), x=x, key=key)
        assert (await self.desk.event("accepted", key=key))["accepted"]
        assert (await self.machine.event("goal", x=x))["frame"] == "map"

    async def ends(self, key: str, status: int) -> None:
        assert (await self.desk.event("result", key=key))["status"] == status


@pytest.mark.parametrize(("example", "robot"), [("jackal-jazzy.yaml", "j100_0000"), ("husky-jazzy.yaml", "a200_0000")])
async def test_a_shipped_robot(example: str, robot: str, tmp_path: Path) -> None:
    sourced()
    missing = [package for package in PACKAGES if not (PLACE / "share" / package).is_dir()]
    if missing:
        pytest.skip(f"no {', '.join(missing)} in {PLACE}: tests/peers/ros2/setup jazzy, with a C and a C++ compiler")
    async with RosNodes(tmp_path) as nodes, Lab(tmp_path, robot, "site1") as lab:
        scene = Scene(lab, nodes, robot)
        await scene.start(example)
        await topics(scene)
        await commands(scene)
        await goals(scene)
        await a_relay_that_comes_back(scene)
        for client in (scene.robot_client, scene.site_client):
            # Nothing of services that no rule names, nor of topics at the endpoint that has services only.
            for words in ("Traceback", "_parameters", "not published everywhere"):
                assert words not in client.text, client.text
            await client.stop()


async def topics(scene: Scene) -> None:
    for sent in SENT:
        await scene.desk.do("sub", topic=scene.name(sent.topic), type=sent.type_name, latched=sent.latched, depth=100)
        await scene.machine.do(
            "pub", topic=scene.name(sent.topic), type=sent.type_name, latched=sent.latched, depth=100
        )
    for seed, sent in enumerate(SENT):
        await matched(scene.machine, scene.name(sent.topic))
        write = partial(scene.machine.do, "write", topic=scene.name(sent.topic), body=scene.body(sent.type_name, seed))
        written = await write()
        for _ in range(5000 if sent.expires else 0):
            if scene.desk.of("got", topic=scene.name(sent.topic)):
                break
            await write()
        assert (await scene.desk.event("got", topic=scene.name(sent.topic)))["value"] == written["value"]


def velocity(command: str) -> float:
    """The forward velocity that a command says, m/s."""
    found = re.search(r"linear=geometry_msgs\.msg\.Vector3\(x=([^,]+),", command)
    assert found, command
    return float(found[1])


def standing(command: str) -> bool:
    return velocity(command) == 0.0


async def commands(scene: Scene) -> None:
    """They arrive, and when no more come, the robot is told to stop."""
    name = scene.name("cmd_vel")
    await scene.machine.do("sub", topic=name, type=TWIST)
    await scene.desk.do("pub", topic=name, type=TWIST)
    await matched(scene.desk, name)
    body = scene.body(TWIST, 7)
    written = (await scene.desk.do("write", topic=name, body=body))["value"]
    while not scene.machine.got(name):  # each has a lease of 0.3 s, which a busy machine may take
        await scene.desk.do("write", topic=name, body=body)
    assert scene.machine.got(name)[0] == written
    # Nothing comes any more: the lease ends, and the robot is slowed down until it stands.
    await until(lambda: standing(scene.machine.got(name)[-1]))
    speeds = [abs(velocity(each)) for each in scene.machine.got(name)]
    assert speeds == sorted(speeds, reverse=True)


async def goals(scene: Scene) -> None:
    await scene.machine.do("navigator", action=scene.name("navigate_to_pose"))
    await until_fed(scene.desk, "navigate", action=scene.name("navigate_to_pose"), x=1.0)
    await scene.goal("done", 5.0)
    await scene.ends("done", SUCCEEDED)
    # A result may overtake the last of it, which rclpy's client then drops.
    left = fed(scene, "done")
    assert left and left == STEPS_LEFT[: len(left)]
    await scene.goal("behind", -5.0)
    await scene.ends("behind", ABORTED)
    await scene.goal("far", 100.0)
    await scene.desk.event("feedback", len(STEPS_LEFT), key="far")
    assert fed(scene, "far") == STEPS_LEFT
    await scene.desk.do("cancel", key="far")
    await scene.ends("far", CANCELED)
    assert [each["x"] for each in scene.machine.of("cancelled")] == [100.0]


def fed(scene: Scene, key: str) -> list[float]:
    """The steps that are left, as the feedback of a goal says; its node has several threads, and tells it in any
    order."""
    return sorted((each["left"] for each in scene.desk.of("feedback", key=key)), reverse=True)


async def a_relay_that_comes_back(scene: Scene) -> None:
    """It is killed while a goal is under way, and started again: the goal goes on, and can be cancelled."""
    await scene.goal("long", 200.0)
    scene.relay.kill()
    scene.relay = scene.lab.process(scene.relay_file)
    await scene.relay.ready()
    for client in (scene.robot_client, scene.site_client):
        await client.until(again(client), "connected again")
    await scene.desk.do("cancel", key="long")
    await scene.ends("long", CANCELED)


def again(client: Process) -> Callable[[], bool]:
    return lambda: sum("connected to relay" in line for line in client.lines) >= 2


async def matched(node: RosNode, topic: str) -> None:
    await until_answered(lambda: node.do("matched", topic=topic), 1)
