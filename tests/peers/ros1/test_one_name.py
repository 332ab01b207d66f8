"""Two programs that use one client's name, side by side for a while: sessions follow each other within milliseconds."""

import asyncio
import sys
from contextlib import suppress
from pathlib import Path
from xmlrpc.client import ServerProxy

from tests.daemons import HOST, Lab, Process
from tests.peers.ros1.lab import SUBSCRIBER, RosLab, need
from tests.support import until

HUSKY = """
import rospy
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import Imu, JointState
from tf2_msgs.msg import TFMessage
rospy.init_node("husky", disable_rosout=True)
live = [(rospy.Publisher(name, kind, queue_size=10), kind) for name, kind in
        (("/odometry/filtered", Odometry), ("/imu/data", Imu), ("/joint_states", JointState))]
static = rospy.Publisher("/tf_static", TFMessage, queue_size=10, latch=True)
static.publish(TFMessage([TransformStamped(child_frame_id="imu_link")]))
print("ready")
rate = rospy.Rate(20)
while not rospy.is_shutdown():
    for publisher, kind in live:
        publisher.publish(kind())
    rate.sleep()
"""
TOPICS = [f"/husky1/{name}" for name in ("odometry/filtered", "imu/data", "joint_states", "tf_static")]
ROUNDS = 3


def sessions(client: Process) -> list[str]:
    """What it says of each session that began."""
    return [line for line in client.lines if "connected to relay" in line]


async def test_topics_stay_published_whatever_sessions_follow_each_other(tmp_path: Path) -> None:
    need("/usr/lib/python3/dist-packages/nav_msgs", "/usr/lib/python3/dist-packages/sensor_msgs",
         "/usr/lib/python3/dist-packages/tf2_msgs")  # fmt: skip
    async with (
        RosLab(tmp_path, "robot_ros") as robot_ros,
        RosLab(tmp_path, "site_ros") as site_ros,
        Lab(tmp_path, "husky1", "site1") as lab,
    ):
        relay = await lab.process(lab.relay_file()).ready()
        robot_ros.python("husky", HUSKY)
        static = {"match": "/tf_static", "class": "state", "reliability": "reliable", "durability": "transient_local"}
        await lab.process(
            lab.client_file("husky1", {"kind": "ros1", "master_uri": robot_ros.uri, "host": HOST}, topics=[static])
        ).ready()
        site = await lab.process(
            lab.client_file(
                "site1", {"kind": "ros1", "master_uri": site_ros.uri, "host": HOST}, client={"namespace": "/"},
                subscribe=["/husky1/.*"], discovery={"mode": "manual"},
            )
        ).ready()  # fmt: skip

        def published() -> bool:
            with ServerProxy(str(site_ros.call("lookupNode", "/sern_site1"))) as node:
                answer: object = node.getPublications("/test")
            told = {name for name, _type in answer[2]} if isinstance(answer, list) else set()
            return told >= set(TOPICS) and all(site_ros.publishers(name) == ["/sern_site1"] for name in TOPICS)

        await until(lambda: all(site_ros.publishers(name) == ["/sern_site1"] for name in TOPICS), "all are published")
        for number in range(ROUNDS):
            before = len(sessions(site))
            # The relay is asked as the site itself, for a topic that there is not.
            rival = await asyncio.create_subprocess_exec(
                sys.executable, "-m", "sern_tools.cli", "echo", "/husky1/nosuch", "--timeout", "0",
                "--relay", lab.endpoint, "--key", str(tmp_path / "site1.key"),
                "--server-key", str(tmp_path / "relay.pub"),
                stdout=asyncio.subprocess.DEVNULL, stderr=asyncio.subprocess.DEVNULL,
            )  # fmt: skip
            try:
                await site.until(lambda before=before: len(sessions(site)) > before, "has had a new session")
            finally:
                with suppress(ProcessLookupError):
                    rival.terminate()
                await rival.wait()
            await until(published, f"round {number}: all are published again")
        site_ros.python("listener", SUBSCRIBER, "listener", *TOPICS)

        def heard() -> bool:
            return {line["topic"] for line in site_ros.lines("listener") if isinstance(line, dict)} >= set(TOPICS)

        await until(heard, "all four are heard")
        await site.until(lambda: site.get("/readyz")[0] == 200, "is ready")
        assert "sern_endpoint_differences 0.0" in site.get("/metrics")[1]
        assert relay.process.poll() is None
