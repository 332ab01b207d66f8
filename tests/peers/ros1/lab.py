"""Real ROS 1: masters, nodes and tools in processes of their own, on free ports of 127.0.0.1.

`RosLab` starts one rosmaster; whatever was started through it is ended with it, also when the test fails.
"""

import asyncio
import json
import os
import subprocess
from http.client import HTTPConnection
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self
from xmlrpc.client import ServerProxy, Transport

import pytest

from sern_client.endpoints.ros1 import Ros1Endpoint, Ros1Options
from sern_tools.ports import free_ports
from tests.daemons import CALLER_HOST, HOST
from tests.support import DEADLINE_S, Events, Patience, until

GEOMETRY_MSGS: Final = "/usr/lib/python3/dist-packages/geometry_msgs"
PACKAGES: Final = {
    "/usr/bin/rosmaster": "python3-rosmaster",
    "/usr/bin/rostopic": "python3-rostopic",
    "/usr/bin/rosservice": "python3-rosservice",
    "/usr/bin/rosnode": "python3-rosnode",
    "/usr/lib/rosbag/play": "python3-rosbag",
    "/usr/lib/rosbag/record": "python3-rosbag",
    "/usr/bin/rosbag": "python3-rosbag",
    "/usr/lib/topic_tools/relay": "topic-tools",
    "/usr/include/ros/ros.h": "libroscpp-dev",
    "/usr/lib/python3/dist-packages/roscpp": "python3-roscpp-msg",
    "/usr/lib/python3/dist-packages/rospy": "python3-rospy",
    "/usr/lib/python3/dist-packages/std_srvs": "python3-std-srvs",
    GEOMETRY_MSGS: "python3-geometry-msgs",
    "/usr/lib/python3/dist-packages/nav_msgs": "python3-nav-msgs",
    "/usr/lib/python3/dist-packages/sensor_msgs": "python3-sensor-msgs",
    "/usr/lib/python3/dist-packages/actionlib": "python3-actionlib",
    "/usr/lib/python3/dist-packages/tf2_msgs": "python3-tf2-msgs",
}
PYTHON: Final = "/usr/bin/python3"
TOOL_S: Final = DEADLINE_S


def need(*paths: str) -> None:
    """Skip the test unless these parts of ROS are installed."""
    for path in paths:
        if not Path(path).exists():
            pytest.skip(f"needs {path}: install the Debian package {PACKAGES[path]}")


LOGGED: Final = ("[DEBUG]", "[INFO]", "[WARN]", "[ERROR]", "[FATAL]")
"""How what rospy logs begins."""


class RosLab:
    """`async with RosLab(tmp_path) as ros:` one master, and what is started at it."""

    def __init__(self, directory: Path, name: str = "ros") -> None:
        need("/usr/bin/rosmaster", "/usr/lib/python3/dist-packages/rospy")
        self.directory = directory / name
        self.directory.mkdir()
        self.port = free_ports(1)[0]
        self.uri = f"http://{HOST}:{self.port}"
        self.environment = {
            **{key: value for key, value in os.environ.items() if not key.startswith(("ROS_", "PYTHONPATH"))},
            "ROS_MASTER_URI": self.uri,
            "ROS_IP": HOST,
            "ROS_LOG_DIR": str(self.directory),
            "ROS_HOME": str(self.directory),
            "HOME": str(self.directory),
        }
        self.master: subprocess.Popen[bytes] | None = None
        self._processes: list[subprocess.Popen[bytes]] = []
        self._endpoints: list[Ros1Endpoint] = []

    async def __aenter__(self) -> Self:
        await self.start_master()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        try:
            for endpoint in self._endpoints:
                await endpoint.stop()
        finally:
            for process in reversed(self._processes):
                self.kill(process)
            if error is not None:
                for log in sorted(self.directory.glob("*.txt")):
                    print(f"--- {log.name}\n{log.read_text(errors='replace')[-4000:]}")

    def spawn(self, name: str, *command: str, stdin: int = subprocess.DEVNULL) -> subprocess.Popen[bytes]:
        """Start a program; what it prints is in NAME.txt."""
        with (self.directory / f"{name}.txt").open("ab") as log:
            process = subprocess.Popen(
                command, env=self.environment, cwd=self.directory, stdin=stdin, stdout=log, stderr=log
            )
        self._processes.append(process)
        return process

    def printed(self, name: str) -> str:
        path = self.directory / f"{name}.txt"
        return path.read_text(errors="replace") if path.exists() else ""

    def kill(self, process: subprocess.Popen[bytes]) -> None:
        """kill -9: it tells nobody."""
        if process.poll() is None:
            process.kill()
        process.wait()
        if process.stdin is not None:
            process.stdin.close()

    async def start_master(self) -> None:
        self.master = self.spawn("master", "/usr/bin/rosmaster", "--core", "-p", str(self.port), "-w", "3")
        await until(self.answers, "the master answers")

    def answers(self) -> bool:
        try:
            self.call("getPid")
        except OSError:
            return False
        return True

    def call(self, method: str, *params: object) -> Any:
        """A call of the master's API by a stranger; its value."""
        return _call(self.uri, method, *params)

    def bus_info(self, node: str) -> list[Any]:
        """A node's connections as `rosnode info` sees them: [id, peer, "i" or "o", transport, topic, ...]."""
        rows: list[Any] = _call(str(self.call("lookupNode", node)), "getBusInfo")
        return rows

    def publishers(self, topic: str) -> list[str]:
        return next((nodes for name, nodes in self.call("getSystemState")[0] if name == topic), [])

    def subscribers(self, topic: str) -> list[str]:
        return next((nodes for name, nodes in self.call("getSystemState")[1] if name == topic), [])

    def python(self, name: str, script: str, *arguments: str) -> subprocess.Popen[bytes]:
        """A rospy script in a process of its own."""
        return self.spawn(name, PYTHON, "-u", "-c", script, *arguments)

    async def tool(self, *command: str, timeout_s: float = TOOL_S) -> str:
        """Run a ROS tool to its end; what it prints. It must exit 0."""
        process = await asyncio.create_subprocess_exec(
            *command, env=self.environment, cwd=self.directory,
            stdin=asyncio.subprocess.DEVNULL, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT,
        )  # fmt: skip
        ended = asyncio.create_task(process.communicate())
        patience = Patience(timeout_s)
        try:
            while not ended.done():
                assert not patience.over(), f"{' '.join(command)} has not ended within {timeout_s:g} s"
                await asyncio.wait([ended], timeout=0.5)
            output, _ = ended.result()
        finally:
            ended.cancel()
            if process.returncode is None:
                process.kill()
                await process.wait()
        text = output.decode(errors="replace")
        assert process.returncode == 0, f"{' '.join(command)} ended with {process.returncode}:\n{text}"
        return text

    async def until_printed(self, name: str, *words: str) -> None:
        await until(lambda: all(word in self.printed(name) for word in words), f"{name} prints {words}")

    def endpoint(self, name: str = "sern_test", **options: Any) -> Ros1Endpoint:
        """An endpoint at this master; it is stopped with the lab. The test starts it."""
        endpoint = Ros1Endpoint(Ros1Options(master_uri=self.uri, host=HOST, node_name=name, **options))
        self._endpoints.append(endpoint)
        return endpoint

    async def started(self, name: str = "sern_test", **options: Any) -> tuple[Ros1Endpoint, Events]:
        endpoint, events = self.endpoint(name, **options), Events()
        await endpoint.start(events)
        return endpoint, events

    def lines(self, name: str) -> list[Any]:
        """The JSON lines that a script has printed; its last line may be under way. What rospy logs is among them."""
        complete = self.printed(name).rpartition("\n")[0]
        said = [line for line in complete.splitlines() if line.startswith(("{", "["))]
        return [json.loads(line) for line in said if not line.startswith(LOGGED)]

    def line_count(self, name: str) -> int:
        """How many lines it has printed, which is quicker to tell."""
        path = self.directory / f"{name}.txt"
        return path.read_bytes().count(b"\n") if path.exists() else 0


class _Transport(Transport):
    """HTTP from another address of loopback. Polling a port that nobody listens on yet could connect to itself where
    the kernel gives that port to the caller: it would read its own request, and occupy the port."""

    def make_connection(self, host: Any) -> HTTPConnection:
        connection = HTTPConnection(str(host), source_address=(CALLER_HOST, 0))
        self._connection = host, connection  # to be closed with the rest
        return connection


def _call(uri: str, method: str, *params: object) -> Any:
    with ServerProxy(uri, transport=_Transport()) as proxy:
        triple: Any = getattr(proxy, method)("/test", *params)
    return triple[2]


def publisher(topic: str, type_name: str, body: str, *, rate_hz: float = 20, latch: bool = False) -> str:
    """A rospy script that publishes `body`, an expression over the module `m` and the number `n`."""
    package, name = type_name.split("/")
    publish = (
        "p.publish(eval(body))\nrospy.spin()"
        if latch
        else f"r = rospy.Rate({rate_hz})\nwhile not rospy.is_shutdown():\n p.publish(eval(body)); n += 1; r.sleep()"
    )
    return (
        f"import rospy, sys\nimport {package}.msg as m\nbody = {body!r}\nn = 0\n"
        "rospy.init_node(sys.argv[1], disable_rosout=True)\n"
        f"p = rospy.Publisher({topic!r}, m.{name}, queue_size=1000, latch={latch})\n{publish}\n"
    )


SUBSCRIBER: Final = """
import os, sys, json, zlib, rospy
rospy.init_node(sys.argv[1], disable_rosout=True)
def got(message, topic):
    header = message._connection_header
    line = json.dumps({"topic": topic, "crc": zlib.crc32(message._buff), "bytes": len(message._buff),
                      "hex": message._buff[:64].hex(), "md5sum": header["md5sum"], "type": header["type"]})
    os.write(1, line.encode() + b"\\n")  # at once: every topic has a thread of its own
for topic in sys.argv[2:]:
    rospy.Subscriber(topic, rospy.AnyMsg, got, topic, queue_size=None, tcp_nodelay=True)
os.write(1, b"ready\\n")
rospy.spin()
"""
"""A rospy node that takes any type and prints a JSON line for each message."""
