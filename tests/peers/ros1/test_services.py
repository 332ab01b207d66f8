"""Services of, and for, real ROS 1 nodes."""

import asyncio
from pathlib import Path

import pytest

from sern_client.endpoints.base import ServiceInfo
from sern_core.vocabulary.errors import ConfigError, ServiceError
from sern_core.vocabulary.types import Encoding, TopicName
from tests.peers.ros1.lab import RosLab, need
from tests.support import until

SET_BOOL_MD5 = "09fb03525b03e7ea1fd3992bafd87e16"
SET_BOOL = ServiceInfo(TopicName("/lamp"), "std_srvs/srv/SetBool", Encoding.ROS1, SET_BOOL_MD5)

SERVER = """
import rospy, sys, time
from std_srvs.srv import SetBool, SetBoolResponse, Trigger
rospy.init_node(sys.argv[1], disable_rosout=True)
def lamp(request):
    return SetBoolResponse(success=request.data, message="lamp on" if request.data else "lamp off")
def broken(request):
    raise rospy.ServiceException("out of order")
def slow(request):
    time.sleep(60)
rospy.Service("/lamp", SetBool, lamp)
rospy.Service("/broken", Trigger, broken)
rospy.Service("/slow", Trigger, slow)
rospy.spin()
"""

CALLER = """
import rospy, sys
from std_srvs.srv import SetBool
rospy.init_node("caller", disable_rosout=True)
lamp = rospy.ServiceProxy("/lamp", SetBool, persistent=True)
lamp.wait_for_service()
print([lamp(bool(n % 2)).message for n in range(4)])
"""


def answer(success: bool, message: str) -> bytes:
    return bytes([success]) + len(message).to_bytes(4, "little") + message.encode()


@pytest.fixture(autouse=True)
def _installed() -> None:
    need("/usr/bin/rosservice", "/usr/lib/python3/dist-packages/std_srvs")


async def test_finds_and_calls_services_of_rospy(tmp_path: Path) -> None:
    async with RosLab(tmp_path) as ros:
        endpoint, events = await ros.started()
        endpoint.watch_services(events)
        server = ros.python("server", SERVER, "server")
        await until(lambda: {"/lamp", "/broken", "/slow"} <= events.services.keys(), "they are announced")
        assert events.services[TopicName("/lamp")] == SET_BOOL
        lamp = TopicName("/lamp")
        assert await endpoint.call(lamp, b"\x01", timeout_s=10) == answer(True, "lamp on")
        several = await asyncio.gather(*(endpoint.call(lamp, bytes([n % 2]), timeout_s=10) for n in range(6)))
        assert several == [answer(False, "lamp off"), answer(True, "lamp on")] * 3
        with pytest.raises(ServiceError, match=r"/broken: .*out of order"):
            await endpoint.call(TopicName("/broken"), b"", timeout_s=10)
        with pytest.raises(ServiceError, match=r"/slow: no response within 0\.2 s"):
            await endpoint.call(TopicName("/slow"), b"", timeout_s=0.2)
        with pytest.raises(ServiceError, match="/nowhere: "):
            await endpoint.call(TopicName("/nowhere"), b"", timeout_s=10)
        ros.kill(server)
        await until(lambda: "/lamp" not in events.services, "services of a dead node are gone")
        with pytest.raises(ServiceError, match="/lamp: connection refused"):
            await endpoint.call(lamp, b"\x01", timeout_s=10)
        ros.python("server", SERVER, "server")
        await until(lambda: "/lamp" in events.services, "and come back with it")


async def test_serves_rospy_and_the_tools(tmp_path: Path) -> None:
    async with RosLab(tmp_path) as ros:
        endpoint, events = await ros.started()
        endpoint.watch_services(events)
        requests: list[bytes] = []

        async def handler(request: bytes) -> bytes:
            requests.append(request)
            if request == b"\x00":
                raise ServiceError("the lamp is broken")
            return answer(True, "shines")

        served = endpoint.serve(SET_BOOL, handler)
        await until(lambda: ["/lamp", ["/sern_test"]] in ros.call("getSystemState")[2], "it is registered")
        assert "/lamp" in (await ros.tool("rosservice", "list")).split()
        assert (await ros.tool("rosservice", "type", "/lamp")).strip() == "std_srvs/SetBool"
        info = await ros.tool("rosservice", "info", "/lamp")
        assert "Node: /sern_test" in info and "Type: std_srvs/SetBool" in info
        assert "shines" in await ros.tool("rosservice", "call", "/lamp", "true")
        assert requests == [b"\x01"]
        with pytest.raises(AssertionError, match="the lamp is broken"):
            await ros.tool("rosservice", "call", "/lamp", "false")
        assert "/lamp" not in events.services  # what we serve is not offered again
        with pytest.raises(ServiceError, match="served from the far side"):
            await endpoint.call(TopicName("/lamp"), b"\x01", timeout_s=10)
        served.close()
        await until(lambda: not ros.call("getSystemState")[2], "it is unregistered")


async def test_persistent_connections_are_served(tmp_path: Path) -> None:
    async with RosLab(tmp_path) as ros:
        endpoint, _ = await ros.started()

        async def handler(request: bytes) -> bytes:
            return answer(True, f"got {request[0]}")

        endpoint.serve(SET_BOOL, handler)
        ros.python("caller", CALLER)
        await ros.until_printed("caller", "['got 0', 'got 1', 'got 0', 'got 1']")


async def test_a_service_of_a_local_node_is_not_taken_over(tmp_path: Path) -> None:
    async with RosLab(tmp_path) as ros:
        endpoint, events = await ros.started()
        endpoint.watch_services(events)
        ros.python("server", SERVER, "server")
        await until(lambda: "/lamp" in events.services, "it is announced")

        async def handler(request: bytes) -> bytes:
            return request

        with pytest.raises(ConfigError, match="/lamp: is served by /server here"):
            endpoint.serve(SET_BOOL, handler)


async def test_another_endpoint_does_not_offer_what_we_serve(tmp_path: Path) -> None:
    async with RosLab(tmp_path) as ros:
        left, _ = await ros.started("left")
        right, events = await ros.started("right")
        right.watch_services(events)

        async def handler(request: bytes) -> bytes:
            return answer(True, "left")

        left.serve(SET_BOOL, handler)
        ros.python("server", SERVER.replace('"/lamp"', '"/other_lamp"'), "server")
        await until(lambda: "/other_lamp" in events.services, "that of a local node is announced")
        await until(lambda: ["/lamp", ["/left"]] in ros.call("getSystemState")[2], "ours is registered")
        assert await right.call(TopicName("/lamp"), b"\x01", timeout_s=10) == answer(True, "left")
        assert "/lamp" not in events.services
