"""rospy nodes at a site are told that a robot or the relay is gone, those that come late as well."""

import signal
from pathlib import Path
from typing import Any, Final

from rosbags.typesys import Stores, get_typestore

from tests.daemons import HOST, Lab
from tests.peers.ros1.lab import RosLab, need
from tests.support import until

STATUS: Final = "diagnostic_msgs/msg/DiagnosticStatus"
ARRAY: Final = "diagnostic_msgs/msg/DiagnosticArray"
ROBOT: Final = {"kind": "synthetic", "role": "robot", "topics": ["/pose", "/map"]}
LISTENER: Final = """
import os, sys, json, rospy
rospy.init_node(sys.argv[1], disable_rosout=True)
def got(message, topic):
    header = message._connection_header
    line = {"topic": topic, "hex": message._buff.hex(), "type": header["type"], "latching": header["latching"]}
    os.write(1, json.dumps(line).encode() + b"\\n")  # at once: each topic has a thread
for topic in sys.argv[2:]:
    rospy.Subscriber(topic, rospy.AnyMsg, got, topic)
rospy.spin()
"""
"""Prints whole messages of any type."""


def site_file(lab: Lab, ros: RosLab, **link_state: Any) -> Path:
    return lab.client_file(
        "site", {"kind": "ros1", "master_uri": ros.uri, "host": HOST}, client={"namespace": "/"},
        subscribe=["/robot1/.*"], discovery={"mode": "manual"}, link_state=link_state,
    )  # fmt: skip


def messages(ros: RosLab, name: str, topic: str, type_name: str = STATUS) -> list[Any]:
    """What a listener has got on a topic, read by rosbags."""
    store = get_typestore(Stores.ROS1_NOETIC)
    rows = [row for row in ros.lines(name) if row["topic"] == topic]
    assert all(row["type"] == type_name.replace("/msg/", "/") for row in rows)
    return [store.deserialize_ros1(bytes.fromhex(row["hex"]), type_name) for row in rows]


async def test_a_late_subscriber_has_the_state_at_once_and_hears_of_robot_and_relay_going(tmp_path: Path) -> None:
    need("/usr/bin/rostopic")
    link = "/robot1/sern/link"
    async with RosLab(tmp_path) as ros, Lab(tmp_path, "robot1", "site") as lab:
        relay = lab.process(lab.relay_file())
        await relay.ready()
        robot = lab.process(lab.client_file("robot1", ROBOT))
        site = lab.process(site_file(lab, ros, period_s=60.0))  # so that what comes is latched, or a change
        await robot.ready()
        await site.ready()
        await site.said("robot1 is there")
        await until(lambda: ros.publishers(link) == ["/sern_site"], "the topic is at the master")
        ros.python("late", LISTENER, "late", link, "/sern/link", "/diagnostics")

        def level(name: str, topic: str) -> int | None:
            """What a listener was told last; on a busy machine the relay may miss a client for a moment."""
            found = messages(ros, name, topic)
            return int(found[-1].level) if found else None

        await until(lambda: level("late", link) == 0 and messages(ros, "late", "/sern/link"), "it is told at once")
        told = next(message for message in reversed(messages(ros, "late", link)) if message.level == 0)
        assert (told.hardware_id, told.message) == ("robot1", "robot1 is connected")
        assert messages(ros, "late", "/sern/link")[0].hardware_id == "relay"
        assert {row["latching"] for row in ros.lines("late") if row["topic"] == link} == {"1"}
        assert (await ros.tool("rostopic", "type", link)).strip() == "diagnostic_msgs/DiagnosticStatus"
        # /diagnostics is not latched: what it is to hear of comes only once it is connected.
        await until(
            lambda: any((row[1], row[4]) == ("/late", "/diagnostics") for row in ros.bus_info("/sern_site")),
            "it listens to /diagnostics",
        )
        robot.kill()
        await until(lambda: level("late", link) == 2, "it hears that the robot is gone")
        ros.python("later", LISTENER, "later", link)
        await until(lambda: level("later", link) == 2, "one that comes now is told as well")
        relay.kill()
        await until(lambda: level("late", link) == 3, "it hears that nobody knows")
        await until(lambda: level("late", "/sern/link") == 2, "as the relay is gone")

        def all_in_one() -> bool:
            found = messages(ros, "late", "/diagnostics", ARRAY)
            levels = [{status.hardware_id: status.level for status in array.status} for array in found]
            return {"relay": 0, "robot1": 2} in levels and {"relay": 2, "robot1": 3} in levels

        await until(all_in_one, "/diagnostics has said both")
        stamps = [array.header.stamp.sec for array in messages(ros, "late", "/diagnostics", ARRAY)]
        seqs = [array.header.seq for array in messages(ros, "late", "/diagnostics", ARRAY)]
        assert min(stamps) > 1_600_000_000 and seqs == sorted(set(seqs))


async def test_topics_of_a_robot_that_is_gone_leave_the_master_and_come_back_with_their_map(tmp_path: Path) -> None:
    topics = [{"match": "/map", "class": "state", "reliability": "reliable", "durability": "transient_local"}]
    async with RosLab(tmp_path) as ros, Lab(tmp_path, "robot1", "site") as lab:
        await lab.process(lab.relay_file()).ready()
        lab.client_file("robot1", ROBOT | {"map_rate_hz": 0.001}, topics=topics)
        robot = await lab.process(tmp_path / "robot1.yaml").ready()
        site = await lab.process(site_file(lab, ros, period_s=0.2, withdraw_after_s=1.0)).ready()
        theirs = ("/robot1/pose", "/robot1/map")
        await until(lambda: all(ros.publishers(name) == ["/sern_site"] for name in theirs), "its topics are there")
        ros.python("listener", LISTENER, "listener", "/robot1/map")
        await until(lambda: ros.line_count("listener") == 1, "the map is")
        robot.process.send_signal(signal.SIGSTOP)  # SIGSTOP: the same process comes back
        await until(lambda: not any(ros.publishers(name) for name in theirs), "they are gone")
        assert ros.publishers("/robot1/sern/link") == ["/sern_site"]
        robot.process.send_signal(signal.SIGCONT)
        await until(lambda: all(ros.publishers(name) == ["/sern_site"] for name in theirs), "they are back")
        ros.python("late", LISTENER, "late", "/robot1/map")
        await until(lambda: ros.line_count("late") == 1, "with the map, for who comes late")
        assert ros.lines("late")[0]["hex"] == ros.lines("listener")[0]["hex"]
        await site.said("robot1 is back after")
