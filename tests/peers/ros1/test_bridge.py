"""From one ROS 1 system to another: two masters, a robot's client, the relay and a site's client."""

import signal
import subprocess
import zlib
from functools import partial
from pathlib import Path
from typing import Any

from rosbags.rosbag1 import Reader

from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_types
from tests.daemons import HOST, Lab, bodies, recording
from tests.peers.ros1.lab import GEOMETRY_MSGS, SUBSCRIBER, RosLab, need, publisher
from tests.support import until

STRING = "std_msgs/msg/String"
BAG_S = 120
"""How much of the Husky's drive is played."""


def endpoint(ros: RosLab) -> dict[str, Any]:
    return {"kind": "ros1", "master_uri": ros.uri, "host": HOST}


async def test_a_real_drive_reaches_rospy_at_the_other_master_byte_for_byte(tmp_path: Path) -> None:
    need("/usr/lib/rosbag/play")
    bag = recording("husky_gps_imu_odom.bag")
    robot_rules = [{"match": ".*", "class": "state", "reliability": "reliable", "depth": 10_000}]
    async with (
        RosLab(tmp_path, "robot_ros") as robot_ros,
        RosLab(tmp_path, "site_ros") as site_ros,
        Lab(tmp_path, "robot1", "site") as lab,
    ):
        await lab.process(lab.relay_file()).ready()
        robot = lab.process(lab.client_file("robot1", endpoint(robot_ros), topics=robot_rules))
        patient = endpoint(site_ros) | {"queue_messages": 100_000}  # rospy need not keep up
        site = lab.process(
            lab.client_file(
                "site", patient, client={"namespace": "/"}, subscribe=["/robot1/.*"], discovery={"mode": "manual"},
            )
        )  # fmt: skip
        await robot.ready()
        await site.ready()
        with_prefix = sorted(f"/robot1{topic}" for topic in bodies(bag))
        site_ros.python("listener", SUBSCRIBER, "listener", *with_prefix)
        play = robot_ros.spawn(
            "play", "/usr/lib/rosbag/play", "--pause", "--queue", "100000", "-r", "60", "-d", "0", "-u", str(BAG_S),
            str(bag),
            stdin=subprocess.PIPE,
        )  # fmt: skip

        def connected() -> bool:
            rows = robot_ros.call("getSystemState")[1]
            here = {name for name, nodes in rows if "/sern_robot1" in nodes}
            there = [name for name in with_prefix if site_ros.publishers(name) == ["/sern_site"]]
            return here >= {name.removeprefix("/robot1") for name in with_prefix} and len(there) == len(with_prefix)

        await until(connected, "the topics are at the other master")
        # A rospy subscriber connects some time after the master told it.
        await until(lambda: _connected(site_ros, "/sern_site", "o") >= set(with_prefix), "the listener is connected")
        topics = bodies(bag).keys()
        await until(lambda: _connected(robot_ros, "/sern_robot1", "i") >= topics, "the robot's client is too")
        assert play.stdin is not None
        play.stdin.write(b" ")
        play.stdin.flush()
        expected = {f"/robot1{topic}": crcs for topic, crcs in _played(bag).items()}
        total = sum(len(crcs) for crcs in expected.values())
        before = 1  # "ready"
        await until(lambda: site_ros.line_count("listener") >= total + before, "all comes")
        play.stdin.close()
        got: dict[str, list[int]] = {topic: [] for topic in expected}
        for line in site_ros.lines("listener"):
            got[line["topic"]].append(line["crc"])
        assert got == expected


def _connected(ros: RosLab, node: str, direction: str) -> set[str]:
    """The topics that a node has connections of: those it receives ("i") or those it sends ("o")."""
    return {row[4] for row in ros.bus_info(node) if row[2] == direction}


def _played(bag: Path) -> dict[str, list[int]]:
    """What `rosbag play -u BAG_S` plays of it: the bodies' checksums by topic."""
    found: dict[str, list[int]] = {}
    with Reader(bag) as reader:
        last_ns = reader.start_time + BAG_S * 10**9
        for connection, time_ns, body in reader.messages():
            if time_ns <= last_ns:
                found.setdefault(connection.topic, []).append(zlib.crc32(body))
    return found


async def test_the_one_message_of_rostopic_pub_reaches_who_listens_at_the_other_master(tmp_path: Path) -> None:
    need("/usr/bin/rostopic")
    reliable = [{"match": ".*/sure", "class": "state", "reliability": "reliable"}]
    async with (
        RosLab(tmp_path, "robot_ros") as robot_ros,
        RosLab(tmp_path, "site_ros") as site_ros,
        Lab(tmp_path, "robot1", "site") as lab,
    ):
        await lab.relay()
        dynamic = {"mode": "dynamic", "allow": ["/(robot1|site)?/?(sure|any)"]}
        for name, ros, other in (("robot1", robot_ros, "site"), ("site", site_ros, "robot1")):
            await lab.connected(
                lab.client_file(name, endpoint(ros), topics=reliable, subscribe=[f"/{other}/.*"], discovery=dynamic)
            )
            ros.python("listener", SUBSCRIBER, "listener", f"/{other}/sure", f"/{other}/any")
            await until(partial(ros.subscribers, f"/{other}/any"), "the listener has subscribed")
        for ros in (robot_ros, site_ros):
            for topic in ("sure", "any"):
                # Without -1 it stays: with it, it ends after three seconds, whether anybody has connected or not.
                ros.spawn("pub", "/usr/bin/rostopic", "pub", f"/{topic}", "std_msgs/String", f"my {topic}")
        expected = sorted(f"my {topic}".encode().hex() for topic in ("sure", "any"))
        for ros in (robot_ros, site_ros):
            await ros.until_printed("listener", *expected)
            assert sorted(line["hex"][8:] for line in ros.lines("listener")) == expected


async def test_a_late_joiner_gets_the_map_and_commands_come_back_with_a_stop(tmp_path: Path) -> None:
    need("/usr/bin/rostopic", GEOMETRY_MSGS)
    robot_rules = [
        {
            "match": "/cmd_vel", "class": "control", "direction": "receive", "lifespan_s": 0.3,
            "on_link_loss": {"publish": "zero", "after_s": 0.5},
        },
        {"match": "/map_name", "class": "state"},
    ]  # fmt: skip
    site_rules = [{"match": "/robot1/cmd_vel", "class": "control", "direction": "send", "lifespan_s": 0.3}]
    async with (
        RosLab(tmp_path, "robot_ros") as robot_ros,
        RosLab(tmp_path, "site_ros") as site_ros,
        Lab(tmp_path, "robot1", "site") as lab,
    ):
        await lab.relay()
        await lab.connected(
            lab.client_file("robot1", endpoint(robot_ros), topics=robot_rules, discovery={"mode": "manual"})
        )
        await lab.connected(
            lab.client_file(
                "site", endpoint(site_ros), topics=site_rules, client={"namespace": "/"}, discovery={"mode": "manual"},
                subscribe=["/robot1/map_name"],
            )
        )  # fmt: skip
        robot_ros.python("map", publisher("/map_name", "std_msgs/String", "m.String('office')", latch=True), "map")
        await until(lambda: site_ros.publishers("/robot1/map_name"), "the map is at the other master")
        # A node that subscribes now gets what was published before it began, twice over.
        for _ in range(2):
            assert "office" in await site_ros.tool("rostopic", "echo", "-n", "1", "/robot1/map_name")

        robot_ros.python("motors", SUBSCRIBER, "motors", "/cmd_vel")
        body = "m.Twist(linear=m.Vector3(x=0.5))"
        driver = site_ros.python("driver", publisher("/robot1/cmd_vel", "geometry_msgs/Twist", body), "driver")
        zero = ros_types.zero_message("geometry_msgs/msg/Twist", Encoding.ROS1)
        assert zero is not None

        def commands() -> list[str]:
            return [line["hex"] for line in robot_ros.lines("motors")]

        # On a busy machine a gap between two commands may be a stop already.
        await until(lambda: len(commands()) > 5 and commands()[-1] != zero.hex(), "commands arrive")
        driver.send_signal(signal.SIGSTOP)  # it hangs: its connections stay
        await until(lambda: commands()[-3:] == [zero.hex()] * 3, "the robot is told to stand still")
        driver.send_signal(signal.SIGCONT)
        await until(lambda: commands()[-1] != zero.hex(), "it drives on")
        site_ros.kill(driver)
        await until(lambda: commands()[-1] == zero.hex(), "it is told to stand still when the driver is gone")


async def test_services_across_the_link(tmp_path: Path) -> None:
    need("/usr/bin/rosservice", "/usr/lib/python3/dist-packages/std_srvs")
    async with (
        RosLab(tmp_path, "robot_ros") as robot_ros,
        RosLab(tmp_path, "site_ros") as site_ros,
        Lab(tmp_path, "robot1", "site") as lab,
    ):
        await lab.relay()
        await lab.connected(
            lab.client_file("robot1", endpoint(robot_ros), services={"offer": [{"match": "/lamp", "timeout_s": 10}]})
        )
        await lab.connected(
            lab.client_file(
                "site", endpoint(site_ros), client={"namespace": "/"},
                services={"use": [{"match": "/robot1/lamp", "timeout_s": 10}]},
            )
        )  # fmt: skip
        robot_ros.python(
            "server",
            "import rospy\nfrom std_srvs.srv import SetBool\nrospy.init_node('server', disable_rosout=True)\n"
            "rospy.Service('/lamp', SetBool, lambda r: (r.data, 'lamp is on'))\nrospy.spin()",
        )
        await until(lambda: any(row[0] == "/robot1/lamp" for row in site_ros.call("getSystemState")[2]), "it is served")
        assert "lamp is on" in await site_ros.tool("rosservice", "call", "/robot1/lamp", "true")
        assert (await site_ros.tool("rosservice", "type", "/robot1/lamp")).strip() == "std_srvs/SetBool"


async def test_drops_are_in_the_metrics(tmp_path: Path) -> None:
    async with RosLab(tmp_path) as ros, Lab(tmp_path, "site") as lab:
        await lab.process(lab.relay_file()).ready()
        site = await lab.process(lab.client_file("site", endpoint(ros) | {"max_message_bytes": 1000})).ready()
        # Latched, so that it is wanted although nobody subscribes at the far side.
        ros.python("talker", publisher("/chat", "std_msgs/String", "m.String('x' * 2000)", latch=True), "talker")

        def counted() -> bool:
            return 'sern_endpoint_dropped_total{reason="too_large"}' in site.get("/metrics")[1]

        await until(counted, "they are counted")
