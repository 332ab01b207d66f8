"""ROS 1 at one site and ROS 2 at the other: clients and relay as a user runs them, and peers that are not ours."""

import asyncio
import zlib
from pathlib import Path
from random import Random
from typing import Any
from xmlrpc.client import ServerProxy

import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Reader, Writer
from rosbags.typesys import Stores, get_typestore

from sern_client.daemon import ClientDaemon
from sern_client.endpoints.conversion import converted
from sern_client.endpoints.dds.endpoint import DdsEndpoint
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import ros_types
from sern_runtime.ros_types import topic_info
from tests.daemons import HOST, RELIABLE, Lab, endpoint_of, recording, write_bag
from tests.peers.dds.conftest import MakePeer
from tests.peers.dds.peer import LEASE_S
from tests.peers.dds.test_topics import ODOMETRY, same
from tests.peers.ros1.lab import SUBSCRIBER, RosLab, need
from tests.sern_client.messages import made_up
from tests.support import DEADLINE_S, until

ODOM = "nav_msgs/msg/Odometry"
STRING = "std_msgs/msg/String"
ENOUGH = 150


def dds(domain: int) -> dict[str, Any]:
    return {"kind": "dds", "domain": domain, "localhost_only": True, "lease_s": LEASE_S}


def as_cdr(bag: Path, topic: str) -> list[bytes]:
    """A topic of a ROS 1 recording as ROS 2 would have serialised it."""
    store = ros_types.typestore(Encoding.CDR)
    with AnyReader([bag]) as reader:
        of_topic = [connection for connection in reader.connections if connection.topic == topic]
        return [bytes(store.ros1_to_cdr(raw, ODOM)) for _, _, raw in reader.messages(of_topic)]


async def test_a_ros1_recording_reaches_ros2(
    tmp_path: Path, domain: int, make_peer: MakePeer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A real drive in ROS 1, played to a relay; at the site a ROS 2 subscriber gets every message, converted."""
    # The peer may stand still for a second, and the socket of a usual machine holds less than that.
    monkeypatch.setattr("sern_client.endpoints.dds.endpoint.DEPTH", 1000)
    bag = recording("husky_gps_imu_odom.bag")
    topic = "/husky_velocity_controller/odom"
    peer = await make_peer(domain)
    await peer.do(f"sub odom rt/robot1{topic} {ODOMETRY} reliable depth=1000")
    async with Lab(tmp_path, "robot1", "site") as lab:
        await lab.relay()
        play = {"wait_for": [topic], "topics": [topic], "rate": 20.0, "loop": True}
        await lab.connected(lab.player_file("robot1", bag, play=play))
        await lab.connected(
            lab.client_file(
                "site",
                dds(domain),
                client={"namespace": "/"},
                subscribe=["/robot1/.*"],
                discovery={"mode": "manual"},
            )
        )
        await peer.line("got odom ", ENOUGH - 1)
    expected = as_cdr(bag, topic)
    where = {body: index for index, body in enumerate(expected)}
    assert len(where) == len(expected)
    padded = {body + bytes(-len(body) & 3): index for body, index in where.items()}
    indices = [padded[body + bytes(-len(body) & 3)] for body in peer.got("odom")[:ENOUGH]]
    assert indices == [(indices[0] + step) % len(expected) for step in range(ENOUGH)]


async def test_ros2_reaches_rospy(tmp_path: Path, domain: int, make_peer: MakePeer) -> None:
    """A ROS 2 publisher at the robot; at the site a node of a ROS 1 master gets what it would get from ROS 1."""
    need("/usr/bin/rosmaster", "/usr/lib/python3/dist-packages/nav_msgs")
    peer = await make_peer(domain)
    await peer.do(f"pub odom rt/odom {ODOMETRY} reliable")
    bodies = [
        ros_types.serialise(made_up(ros_types.typestore(Encoding.CDR), ODOM, Random(seed)), ODOM, Encoding.CDR)
        for seed in range(20)
    ]
    async with RosLab(tmp_path, "site_ros") as ros, Lab(tmp_path, "robot1", "site") as lab:
        await lab.relay()
        robot = await lab.connected(lab.client_file("robot1", dds(domain), topics=list(RELIABLE)))
        site = {"kind": "ros1", "master_uri": ros.uri, "host": HOST}
        await lab.connected(
            lab.client_file(
                "site", site, client={"namespace": "/"}, subscribe=["/robot1/.*"], discovery={"mode": "manual"}
            )
        )
        await until(lambda: ros.publishers("/robot1/odom") == ["/sern_site"], "the topic is at the master")
        ros.python("listener", SUBSCRIBER, "listener", "/robot1/odom")
        await until(lambda: ros.line_count("listener") >= 1, "rospy is there")
        await _connected(ros)
        await peer.line("matched odom 1")
        await until(lambda: _subscription(robot).matched == 1, "the robot's client hears it")
        for body in bodies:
            await peer.do(f"write odom {body.hex()}")
        await until(lambda: ros.line_count("listener") >= 1 + len(bodies), "all of them arrive")
        got = [line["crc"] for line in ros.lines("listener")]
    _, convert = converted(topic_info("/robot1/odom", ODOM, Encoding.CDR), Encoding.ROS1)
    assert got == [zlib.crc32(convert(body)) for body in bodies]


def _subscription(robot: ClientDaemon) -> Any:
    (subscription,) = endpoint_of(robot, DdsEndpoint).subscriptions.of(TopicName("/odom"))
    return subscription


async def _connected(ros: RosLab) -> None:
    """Until somebody has subscribed to our node, which runs in this process and must go on while it is asked."""

    def connections() -> int:
        with ServerProxy(str(ros.call("lookupNode", "/sern_site"))) as proxy:
            answer: Any = proxy.getBusInfo("/test")
        return len(answer[2])

    async with asyncio.timeout(DEADLINE_S):
        while not await asyncio.to_thread(connections):  # noqa: ASYNC110  the node tells nobody
            await asyncio.sleep(0.02)


CALLER = """
import rospy, sys
from std_srvs.srv import SetBool
rospy.init_node("caller", disable_rosout=True)
lamp = rospy.ServiceProxy("/robot1/set_bool", SetBool)
lamp.wait_for_service()
print([lamp(bool(n % 2)).message for n in range(4)], flush=True)
"""


async def test_rospy_calls_a_service_of_ros2(tmp_path: Path, domain: int, make_peer: MakePeer) -> None:
    need("/usr/bin/rosmaster", "/usr/lib/python3/dist-packages/std_srvs")
    peer = await make_peer(domain)
    await peer.do("serve s set_bool userdata=serviceid=1.2.3;")
    async with RosLab(tmp_path, "site_ros") as ros, Lab(tmp_path, "robot1", "site") as lab:
        await lab.relay()
        offer = {"offer": [{"match": "/set_bool", "timeout_s": 60}]}
        await lab.connected(lab.client_file("robot1", dds(domain), services=offer))
        site = {"kind": "ros1", "master_uri": ros.uri, "host": HOST}
        use = {"use": [{"match": "/robot1/.*", "timeout_s": 60}]}
        await lab.connected(lab.client_file("site", site, client={"namespace": "/"}, services=use))
        ros.python("caller", CALLER)
        await ros.until_printed("caller", "['no', 'yes', 'no', 'yes']")


async def test_two_ros2_sites(tmp_path: Path, domain: int, other_domain: int, make_peer: MakePeer) -> None:
    """Two domains with a relay between them: bytes as they were, latched ones for whoever comes late."""
    robot, site = await make_peer(domain), await make_peer(other_domain)
    info: TopicInfo = topic_info("/odom", ODOM, Encoding.CDR)
    body = ros_types.serialise(made_up(ros_types.typestore(info.encoding), ODOM, Random(3)), ODOM, Encoding.CDR)
    await robot.do(f"pub odom rt/odom {ODOMETRY} reliable transient_local depth=1")
    await robot.do(f"write odom {body.hex()}")
    async with Lab(tmp_path, "robot1", "site") as lab:
        await lab.relay()
        await lab.connected(lab.client_file("robot1", dds(domain), topics=list(RELIABLE)))
        daemon = await lab.connected(
            lab.client_file(
                "site",
                dds(other_domain),
                client={"namespace": "/"},
                subscribe=["/robot1/.*"],
                discovery={"mode": "manual"},
            )
        )
        await site.do(f"sub odom rt/robot1/odom {ODOMETRY} reliable transient_local")
        await site.line("got odom ")
        assert same(site.got("odom")[0], body)
        offered = {channel.stream.id.topic for channel in daemon.core.link.sender.channels.values()}
        assert not any(name.endswith("/odom") for name in offered)  # nothing goes back


async def test_a_type_that_cannot_be_converted_is_said_once_and_stops_nothing_else(
    tmp_path: Path, domain: int, make_peer: MakePeer
) -> None:
    """Two fields of it differ in case only, which ROS 2 does not allow; the strings beside it arrive."""
    bag = write_bag(tmp_path / "robot.bag", {"/chat": 50})
    with Writer(tmp_path / "both.bag") as writer, Reader(bag) as reader:
        odd = writer.add_connection("/odd", "my_msgs/msg/Odd", msgdef="int8 a\nint8 A\n", md5sum="0" * 32)
        chat = writer.add_connection("/chat", STRING, typestore=get_typestore(Stores.ROS1_NOETIC))
        for _, time_ns, body in reader.messages():
            writer.write(odd, time_ns, b"\1\2")
            writer.write(chat, time_ns, body)
    peer = await make_peer(domain)
    await peer.do("sub chat rt/robot1/chat std_msgs::msg::dds_::String_ reliable depth=1000")
    async with Lab(tmp_path, "robot1", "site") as lab:
        await lab.process(lab.relay_file()).ready()
        play = {"wait_for": ["/chat"], "loop": True}  # a reader of DDS misses what came before it was found
        site = lab.process(
            lab.client_file(
                "site", dds(domain), client={"namespace": "/"}, subscribe=["/robot1/.*"], discovery={"mode": "manual"}
            )
        )
        await site.ready()
        await lab.process(lab.player_file("robot1", tmp_path / "both.bag", play=play)).ready()
        await peer.line("got chat ", 49)
        await site.said("/robot1/odd", "cannot be converted to cdr: two of its fields differ in case only")
        assert sum("/robot1/odd" in line for line in site.lines) == 1
