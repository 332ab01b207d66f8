"""Services from one ROS 1 system to another with everything between: rospy, clients, relay, and what goes wrong."""

import asyncio
import json
import re
import signal
import subprocess
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any, Final

import pytest

from sern_client.daemon import ClientDaemon
from sern_client.services import ServiceBridge
from tests.daemons import HOST, Lab, Process
from tests.peers.ros1.lab import RosLab, need
from tests.support import until

SENSOR_MSGS: Final = "/usr/lib/python3/dist-packages/sensor_msgs"

SERVER: Final = """
import io, rospy, signal, threading, zlib
from sensor_msgs.srv import SetCameraInfo
from std_srvs.srv import SetBool, Trigger
rospy.init_node("server", disable_rosout=True)
released = threading.Event()
signal.signal(signal.SIGUSR1, lambda *_: released.set())
def lamp(request):
    print("lamp", request.data, flush=True)
    return request.data, "lamp is " + ("on" if request.data else "off")
def broken(request):
    raise rospy.ServiceException("out of order")
def slow(request):
    print("slow begins", flush=True)
    released.wait()
    return True, "slow has ended"
def camera(request):
    body = io.BytesIO()
    request.serialize(body)
    return True, "%d coefficients, %08x" % (len(request.camera_info.D), zlib.crc32(body.getvalue()))
rospy.Service("/lamp", SetBool, lamp)
rospy.Service("/broken", Trigger, broken)
rospy.Service("/slow", Trigger, slow)
rospy.Service("/camera", SetCameraInfo, camera)
rospy.spin()
"""
"""At the robot. Slow services end on SIGUSR1."""

CALLER: Final = """
import json, os, rospy, sys, threading
from std_srvs.srv import SetBool, Trigger
rospy.init_node("caller", disable_rosout=True)
def call(name, request, number):
    try:
        text = rospy.ServiceProxy(name, SetBool if request else Trigger)(*request).message
    except rospy.ServiceException as error:
        text = str(error)
    os.write(1, json.dumps([number, text]).encode() + b"\\n")
print("ready", flush=True)
for number, line in enumerate(sys.stdin):
    name, *request = json.loads(line)
    threading.Thread(target=call, args=(name, request, number)).start()
"""
"""At the site. Calls what the lines of its standard input say, all at once; prints what became of each."""

LARGE: Final = """
import rospy, zlib, io
from sensor_msgs.srv import SetCameraInfo, SetCameraInfoRequest
rospy.init_node("large", disable_rosout=True)
request = SetCameraInfoRequest()
request.camera_info.D = [n / 7 for n in range(131072)]
buffer = io.BytesIO()
request.serialize(buffer)
camera = rospy.ServiceProxy("/robot1/camera", SetCameraInfo)
camera.wait_for_service()
print(camera(request).status_message == "131072 coefficients, %08x" % zlib.crc32(buffer.getvalue()), flush=True)
"""


class Sites:
    """Two ROS 1 systems, a robot's and an operator's, and what they are joined by."""

    def __init__(self, robot_ros: RosLab, site_ros: RosLab, lab: Lab) -> None:
        self.robot_ros = robot_ros
        self.site_ros = site_ros
        self.lab = lab

    def robot_file(self) -> Path:
        services = {"offer": [{"match": "/(?:lamp|broken|slow|camera)", "timeout_s": 30}]}
        return self.lab.client_file("robot1", _endpoint(self.robot_ros), services=services)

    def site_file(self, **timeouts_s: float) -> Path:
        """What the site waits for these services at the most, by their own name; a minute for all others."""
        limits = {f"/robot1/{name}": timeout_s for name, timeout_s in timeouts_s.items()} | {"/robot1/.*": 60.0}
        services = {"use": [{"match": match, "timeout_s": timeout_s} for match, timeout_s in limits.items()]}
        return self.lab.client_file("site", _endpoint(self.site_ros), client={"namespace": "/"}, services=services)

    def start_server(self) -> subprocess.Popen[bytes]:
        return self.robot_ros.python("server", SERVER)

    async def served(self, *names: str) -> None:
        wanted = names or ("/robot1/lamp", "/robot1/broken", "/robot1/slow", "/robot1/camera")
        await until(
            lambda: {row[0] for row in self.site_ros.call("getSystemState")[2]} >= set(wanted), f"{wanted} are served"
        )

    async def start_caller(self) -> "Caller":
        process = self.site_ros.spawn("caller", "/usr/bin/python3", "-u", "-c", CALLER, stdin=subprocess.PIPE)
        await self.site_ros.until_printed("caller", "ready")
        return Caller(self.site_ros, process)


class Caller:
    """The process of `CALLER`."""

    def __init__(self, ros: RosLab, process: subprocess.Popen[bytes]) -> None:
        self.process = process
        self._ros = ros
        self._next = 0

    def ask(self, *line: Any) -> int:
        """Call a service; the number of the call."""
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(line).encode() + b"\n")
        self.process.stdin.flush()
        self._next += 1
        return self._next - 1

    def outcomes(self) -> dict[int, str]:
        return dict(self._ros.lines("caller"))

    async def outcome(self, number: int) -> str:
        await until(lambda: number in self.outcomes(), f"call {number} has ended")
        return self.outcomes()[number]


def _endpoint(ros: RosLab) -> dict[str, Any]:
    return {"kind": "ros1", "master_uri": ros.uri, "host": HOST}


def outcomes(daemon: ClientDaemon) -> dict[str, int]:
    """How the calls from a site have ended, whatever the service."""
    services = daemon.bridge.services
    assert isinstance(services, ServiceBridge)
    found: dict[str, int] = {}
    for (_, outcome), count in services.outcomes.items():
        found[outcome] = found.get(outcome, 0) + count
    return found


@pytest.fixture
async def sites(tmp_path: Path) -> AsyncIterator[Sites]:
    need("/usr/bin/rosservice", "/usr/lib/python3/dist-packages/std_srvs", SENSOR_MSGS)
    async with (
        RosLab(tmp_path, "robot_ros") as robot_ros,
        RosLab(tmp_path, "site_ros") as site_ros,
        Lab(tmp_path, "robot1", "site") as lab,
    ):
        yield Sites(robot_ros, site_ros, lab)


async def test_the_tools_of_ros_see_a_service_of_the_robot(sites: Sites) -> None:
    await sites.lab.relay()
    await sites.lab.connected(sites.robot_file())
    site = await sites.lab.connected(sites.site_file())
    sites.start_server()
    await sites.served()
    listed, kind, info, answer = await asyncio.gather(
        sites.site_ros.tool("rosservice", "list"),
        sites.site_ros.tool("rosservice", "type", "/robot1/lamp"),
        sites.site_ros.tool("rosservice", "info", "/robot1/lamp"),
        sites.site_ros.tool("rosservice", "call", "/robot1/lamp", "true"),
    )
    assert {"/robot1/lamp", "/robot1/broken", "/robot1/slow", "/robot1/camera"} <= set(listed.split())
    assert kind.strip() == "std_srvs/SetBool"
    assert "Node: /sern_site" in info and "Type: std_srvs/SetBool" in info and "Args: data" in info
    assert "lamp is on" in answer
    with pytest.raises(AssertionError, match=r"responded with an error: .*/broken: .*out of order"):
        await sites.site_ros.tool("rosservice", "call", "/robot1/broken")
    assert outcomes(site) == {"ok": 1, "error": 1}


async def test_many_calls_at_once_and_large_ones(sites: Sites) -> None:
    await sites.lab.relay()
    await sites.lab.connected(sites.robot_file())
    site = await sites.lab.connected(sites.site_file())
    sites.start_server()
    await sites.served()
    sites.site_ros.python("large", LARGE)
    caller = await sites.start_caller()
    count = 40
    for number in range(count):
        caller.ask("/robot1/lamp", bool(number % 2))
    await until(lambda: len(caller.outcomes()) == count, "all calls have ended")
    texts = {number: "lamp is " + ("on" if number % 2 else "off") for number in range(count)}
    assert caller.outcomes() == texts
    await sites.site_ros.until_printed("large", "True")
    assert outcomes(site) == {"ok": count + 1}


async def test_a_service_that_takes_too_long(sites: Sites) -> None:
    await sites.lab.relay()
    await sites.lab.connected(sites.robot_file())
    site = await sites.lab.connected(sites.site_file(slow=0.5))
    server = sites.start_server()
    await sites.served()
    caller = await sites.start_caller()
    said = await caller.outcome(caller.ask("/robot1/slow"))
    ends = r"/robot1/slow did not answer within 0\.5 s|/slow: no response within 0\.\d+ s|dropped on its way: lifespan"
    assert re.search(ends, said), said
    # Its answer, when it comes at last, is nobody's, and the node goes on as before.
    server.send_signal(signal.SIGUSR1)
    assert await caller.outcome(caller.ask("/robot1/lamp", True)) == "lamp is on"
    assert sum(outcomes(site).values()) == 2


async def test_a_relay_that_dies_is_an_error_in_time_and_what_it_held_is_never_executed(sites: Sites) -> None:
    relay = sites.lab.process(sites.lab.relay_file())
    await relay.ready()
    await sites.lab.connected(sites.robot_file())
    site = await sites.lab.connected(sites.site_file(slow=10.0, lamp=1.0))
    sites.start_server()
    await sites.served()
    caller = await sites.start_caller()
    answer = ""
    while answer != "lamp is on":  # on a busy machine a second may be too short
        answer = await caller.outcome(caller.ask("/robot1/lamp", True))

    under_way = caller.ask("/robot1/slow")
    await sites.robot_ros.until_printed("server", "slow begins")
    answered = outcomes(site)["ok"]
    relay.kill()
    lost = caller.ask("/robot1/lamp", False)
    for number in (under_way, lost):
        assert "responded with an error" in await caller.outcome(number)
    assert outcomes(site)["ok"] == answered

    await sites.lab.process(relay.config).ready()
    answer = ""
    while answer != "lamp is on":  # until both clients are there again
        answer = await caller.outcome(caller.ask("/robot1/lamp", True))
    assert "lamp False" not in sites.robot_ros.printed("server")
    assert sites.robot_ros.printed("server").count("slow begins") == 1


async def test_a_client_of_the_robot_that_dies_and_comes_back(sites: Sites) -> None:
    await sites.lab.relay()
    robot: Process = sites.lab.process(sites.robot_file())
    await robot.ready()
    await sites.lab.connected(sites.site_file(slow=5.0, lamp=5.0))
    sites.start_server()
    await sites.served()
    caller = await sites.start_caller()
    under_way = caller.ask("/robot1/slow")
    await sites.robot_ros.until_printed("server", "slow begins")
    robot.kill()
    await sites.lab.process(robot.config).ready()
    assert "responded with an error" in await caller.outcome(under_way)

    answer = ""
    while answer != "lamp is on":  # until the new process has found the services
        await sites.served("/robot1/lamp")
        answer = await caller.outcome(caller.ask("/robot1/lamp", True))
    assert sites.robot_ros.printed("server").count("slow begins") == 1, "a call is executed at most once"
