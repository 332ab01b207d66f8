"""A Unity scene at a site: what it subscribes to crosses the link, and it drives a robot."""

from pathlib import Path

from sern_client.endpoints.unity.endpoint import UnityEndpoint
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import ros_types
from sern_tools.ports import free_ports
from tests.daemons import Json, Lab, endpoint_of
from tests.sern_client.endpoints.unity.scene import PlayedScene
from tests.support import until

ODOM, IMU, DRIVE = "/robot1/odometry/filtered", "/robot1/imu/data", "/robot1/cmd_vel"
TWIST = "geometry_msgs/msg/Twist"
ROBOT: Json = {"kind": "synthetic", "role": "robot", "encoding": "ros1", "topics": ["/odometry/filtered", "/imu/data"]}


async def test_a_scene_looks_at_a_robot_of_ros_1_and_drives_it(tmp_path: Path) -> None:
    async with Lab(tmp_path, "robot1", "site") as lab:
        await lab.relay()
        stop = {"publish": "zero", "after_s": 0.5}
        rule = {"match": "/cmd_vel", "class": "control", "direction": "receive", "on_link_loss": stop}
        robot = await lab.connected(lab.client_file("robot1", ROBOT, topics=[rule]))
        (port,) = free_ports(1)
        unity = {"kind": "unity", "listen": f"127.0.0.1:{port}", "publish": [DRIVE]}
        command = {"match": DRIVE, "class": "control", "direction": "send"}
        site = await lab.connected(
            lab.client_file("site", unity, client={"namespace": "/"}, topics=[command], on_demand=["/robot1/.*"])
        )
        endpoint: UnityEndpoint = endpoint_of(site, UnityEndpoint)
        async with PlayedScene(port) as looks:
            await looks.caught_up()
            assert not site.core.received.topics, "nobody looks yet"
            await looks.subscribe(ODOM, "nav_msgs/Odometry")
            await looks.subscribe(f"{ODOM}/sern/age", "std_msgs/Float32")
            await until(lambda: len(looks.bodies(ODOM)) > 2 and looks.bodies(f"{ODOM}/sern/age"))
            pose = ros_types.deserialise(looks.bodies(ODOM)[-1], "nav_msgs/msg/Odometry", Encoding.CDR)
            assert pose.header.frame_id == "odom" and not looks.errors
            assert TopicName(IMU) not in site.core.received.topics, "what nobody looks at does not come"
            await looks.publish(DRIVE, "geometry_msgs/Twist")
            twist = ros_types.new(TWIST, Encoding.CDR)
            twist.linear.x = 0.5
            drive = looks.frame(DRIVE, ros_types.serialise(twist, TWIST, Encoding.CDR))

            def drives() -> bool:
                looks.writer.write(drive)
                counters = robot.core.received.topics.get(TopicName(DRIVE))
                return counters is not None and counters.delivered > 2

            await until(drives, "the robot is driven")
            assert not looks.errors
        await until(lambda: not endpoint.scenes)
        await until(lambda: not site.core.subscription.patterns, "and nothing is asked for any more")
