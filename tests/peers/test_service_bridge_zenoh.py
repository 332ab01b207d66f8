"""Services between ROS 1 and ROS 2 over zenoh, both ways: rospy and its tools here, zenoh-ros2-sdk there."""

from pathlib import Path

from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_services
from tests.daemons import HOST, Lab
from tests.peers.ros1.lab import RosLab, need
from tests.peers.test_zenoh import DOMAIN, Peer, Router, peer, router
from tests.support import until

__all__ = ["peer", "router"]

SERVER = """
import rospy
from std_srvs.srv import SetBool
rospy.init_node("server", disable_rosout=True)
def lamp(request):
    if not request.data:
        raise rospy.ServiceException("it stays on")
    return True, "lamp is on"
rospy.Service("/lamp", SetBool, lamp)
rospy.spin()
"""


async def test_ros_1_and_ros_2_call_each_other(tmp_path: Path, router: Router, peer: Peer) -> None:
    need("/usr/bin/rosservice", "/usr/lib/python3/dist-packages/std_srvs")
    type_hash = ros_services.resolve("std_srvs/srv/SetBool", "", Encoding.CDR).text.type_hash
    zenoh = {
        "kind": "zenoh", "connect": [router.locator], "listen": ["tcp/127.0.0.1:0"], "domain": DOMAIN,
    }  # fmt: skip
    manual = {"mode": "manual"}
    async with RosLab(tmp_path) as ros, Lab(tmp_path, "one", "two") as lab:
        await lab.relay()
        ros1 = {"kind": "ros1", "master_uri": ros.uri, "host": HOST}
        services = {"offer": [{"match": "/lamp", "timeout_s": 60}], "use": [{"match": "/two/mode", "timeout_s": 60}]}
        await lab.connected(lab.client_file("one", ros1, discovery=manual, services=services))
        services = {"offer": [{"match": "/mode", "timeout_s": 60}], "use": [{"match": "/one/lamp", "timeout_s": 60}]}
        await lab.connected(lab.client_file("two", zenoh, discovery=manual, services=services))
        ros.python("server", SERVER)
        await peer.do("server", name="/mode")

        await peer.sees("SS", "/one/lamp")
        assert (await peer.do("call", name="/one/lamp", hash=type_hash, data=True))["answer"] == [True, "lamp is on"]
        assert (await peer.do("call", name="/one/lamp", hash=type_hash, data=False))["answer"] is None  # an error
        await until(lambda: any(row[0] == "/two/mode" for row in ros.call("getSystemState")[2]), "it is served")
        assert "as you say" in await ros.tool("rosservice", "call", "/two/mode", "false")
        assert (await ros.tool("rosservice", "type", "/two/mode")).strip() == "std_srvs/SetBool"
