"""ROS 1 to ROS 1: what a bridge adds in latency and costs in CPU.

A source publishes odometry (1 kHz) and clouds (1 MB at 20 Hz); a sink takes both behind the bridge.

    direct         no bridge: what the source, the sink and loopback take
    sern           two endpoints in one process, between two masters
    sern-chain     sern-client, sern-relay, sern-client (CURVE), between two masters
    topic_tools    one `relay` a topic, C++, at one master
    rospy          one process, AnyMsg in and out, at one master

The latter two cannot join two masters; that is to their advantage. CPU is that of the processes in between. Source and
sink are on one CPU, because clocks of different CPUs may differ by microseconds.
"""

import argparse
import json
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final
from xmlrpc.client import ServerProxy

from benchmarks import common
from benchmarks.endpoints.ros1_roles import CLOUD, HOST, ODOM, TYPES
from sern_core.errors import SernError
from sern_core.types import ClientName
from sern_runtime.keys import PublicKey, PublicKeys, generate, write_public, write_secret

WARM_S: Final = 2.0
MEASURE_S: Final = 8.0
QUICK_S: Final = 2.0
START_S: Final = 30.0
TOPICS: Final = 300
MIXED: Final = (1000.0, 1_000_000, 20.0)
FAST: Final = (3000.0, 0, 0.0)
CASES: Final = {"1 kHz + 20 MB/s": MIXED, "3 kHz": FAST}
SYSTEMS: Final = ("direct", "sern", "sern-chain", "topic_tools", "rospy")

_ROOT: Final = Path(__file__).resolve().parents[2]
_ROSPY: Final = f"""
import rospy, sys, nav_msgs.msg, sensor_msgs.msg
rospy.init_node("rospy_bridge", disable_rosout=True)
for topic, kind in (("{ODOM}", nav_msgs.msg.Odometry), ("{CLOUD}", sensor_msgs.msg.PointCloud2)):
    out = rospy.Publisher(topic + "_copy", kind, queue_size=1000, tcp_nodelay=True)
    rospy.Subscriber(topic, rospy.AnyMsg, out.publish, queue_size=1000, tcp_nodelay=True, buff_size=4_000_000)
rospy.spin()
"""


class Ros:
    """Masters and processes of one run; all end with the context."""

    def __init__(self, stack: ExitStack) -> None:
        self._stack = stack
        self.masters: list[int] = []
        """Their process ids."""
        self.directory = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="sern-bench-")))

    def spawn(self, *command: str, master: str = "", out: int = subprocess.DEVNULL) -> subprocess.Popen[str]:
        environment = {key: value for key, value in os.environ.items() if not key.startswith("ROS_")}
        environment |= {"ROS_MASTER_URI": master, "ROS_IP": HOST, "ROS_HOME": str(self.directory)}
        if command[0] != sys.executable:
            environment.pop("PYTHONPATH", None)
        process = subprocess.Popen(
            command, env=environment, cwd=_ROOT, stdout=out, stderr=subprocess.DEVNULL, text=True
        )
        self._stack.callback(_end, process)
        return process

    def role(self, *arguments: object) -> subprocess.Popen[str]:
        words = [str(argument) for argument in arguments]
        return self.spawn(
            sys.executable, "-P", "-m", "benchmarks.endpoints.ros1_roles", *words, out=subprocess.PIPE
        )  # fmt: skip

    def master(self) -> str:
        port = _free_port()
        uri = f"http://{HOST}:{port}"
        self.masters.append(self.spawn("/usr/bin/rosmaster", "--core", "-p", str(port), master=uri).pid)
        deadline_s = time.monotonic() + START_S
        while True:
            try:
                with ServerProxy(uri) as proxy:
                    proxy.getPid("/bench")
                return uri
            except OSError:
                if time.monotonic() > deadline_s:
                    raise SernError(f"no rosmaster at {uri} within {START_S:g} s") from None
                time.sleep(0.02)

    def chain(self, master: str, other: str) -> list[subprocess.Popen[str]]:
        """A relay and two clients, with keys and nothing else set that a user would not."""
        (self.directory / "clients").mkdir()
        relay = f"tcp://{HOST}:{_free_port()}"
        for name, public in (("relay", "relay.pub"), ("robot1", "clients/robot1.pub"), ("site", "clients/site.pub")):
            pair = generate(ClientName(name))
            write_secret(self.directory / f"{name}.key", pair)
            write_public(self.directory / public, PublicKeys(pair.name, (PublicKey(pair.public_key),)))
        access = [{"client": ".*", "publish": [".*"], "subscribe": [".*"]}]
        self._write("relay", {
            "relay": {"name": "relay", "listen": [relay], "secret_key_file": "relay.key", "clients_dir": "clients"},
            "access": access,
        })  # fmt: skip
        rules = [
            {"match": ".*/odom", "class": "control", "depth": 1000},
            {"match": ".*/cloud", "class": "bulk", "depth": 10},
        ]
        for name, uri, patterns in (("robot1", master, []), ("site", other, ["/bench/.*"])):
            self._write(name, {
                "client": {"name": name, "namespace": "/"},
                "relay": {"endpoint": relay, "server_key_file": "relay.pub", "secret_key_file": f"{name}.key"},
                "endpoint": {"kind": "ros1", "master_uri": uri, "host": HOST},
                "topics": rules, "subscribe": patterns,
            })  # fmt: skip
        daemons = []
        for program, name in (("relay", "relay"), ("client", "robot1"), ("client", "site")):
            config = str(self.directory / f"{name}.yaml")
            daemons.append(self.spawn(sys.executable, "-P", "-m", f"sern_{program}.cli", "--config", config))
        return daemons

    def _write(self, name: str, content: dict[str, Any]) -> None:
        (self.directory / f"{name}.yaml").write_text(json.dumps(content))  # JSON is YAML


@contextmanager
def _ros() -> Iterator[Ros]:
    with ExitStack() as stack:
        yield Ros(stack)


def _end(process: subprocess.Popen[str]) -> None:
    if process.poll() is None:
        process.kill()
    process.wait()
    if process.stdout is not None:
        process.stdout.close()


def _free_port() -> int:
    with socket.socket() as sock:
        sock.bind((HOST, 0))
        return int(sock.getsockname()[1])


def _line(process: subprocess.Popen[str], word: str) -> Any:
    """The value of `word` in the next line that has it."""
    assert process.stdout is not None
    for line in process.stdout:
        content = json.loads(line)
        if "problem" in content:
            raise SernError(f"the benchmark's sink was refused: {content['problem']}")
        if word in content:
            return content[word]
    raise SernError(f"a process of the benchmark ended with {process.wait()} before it said {word!r}")


def cpu_s(pids: Iterable[int]) -> float:
    """CPU time of all threads of these processes, in the kernel's nanoseconds rather than in ticks of 10 ms."""
    files = (path for pid in pids for path in Path(f"/proc/{pid}/task").glob("*/schedstat"))
    return sum(int(path.read_text().split()[0]) for path in files) / 1e9


def measure(system: str, load: tuple[float, int, float], measure_s: float) -> dict[str, float]:
    """One run of one system under one load."""
    with _ros() as ros:
        master = ros.master()
        other, suffix = master, ""
        source = ros.role("source", master, *load)
        _line(source, "ready")
        between: list[subprocess.Popen[str]] = []
        match system:
            case "sern":
                other = ros.master()
                between = [ros.role("bridge", master, other)]
            case "sern-chain":
                other = ros.master()
                between = ros.chain(master, other)
            case "topic_tools":
                suffix = "_copy"
                between = [
                    ros.spawn("/usr/lib/topic_tools/relay", topic, topic + suffix, f"__name:=relay{number}",
                              master=master)
                    for number, topic in enumerate(TYPES)
                ]  # fmt: skip
            case "rospy":
                suffix = "_copy"
                between = [ros.spawn("/usr/bin/python3", "-c", _ROSPY, master=master)]
        sink = ros.role("sink", other, ODOM + suffix, CLOUD + suffix if load[2] else "", WARM_S, measure_s)
        _line(sink, "begin")
        pids = [process.pid for process in between]
        before_s, began_s = cpu_s(pids), time.monotonic()
        _line(sink, "end")
        used_s, took_s = cpu_s(pids) - before_s, time.monotonic() - began_s
        found: dict[str, float] = _line(sink, "found")
        return {**found, "cpu_percent": 100 * used_s / took_s}


def _follow(measure_s: float) -> dict[str, float]:
    with _ros() as ros:
        master = ros.master()
        _line(ros.role("many", master, TOPICS), "ready")
        follower = ros.role("follow", master, TOPICS)
        found_s = float(_line(follower, "found_s"))
        time.sleep(WARM_S)
        before_s, master_s, began_s = cpu_s([follower.pid]), cpu_s(ros.masters), time.monotonic()
        time.sleep(measure_s)
        used_s, asked_s = cpu_s([follower.pid]) - before_s, cpu_s(ros.masters) - master_s
        share = 100 / (time.monotonic() - began_s)
        return {"found_s": found_s, "cpu_percent": share * used_s, "master_cpu_percent": share * asked_s}


def bench(options: argparse.Namespace, report: common.Report) -> None:
    """SernError where ROS 1 is not installed."""
    for path, package in (
        ("/usr/bin/rosmaster", "python3-rosmaster"),
        ("/usr/lib/topic_tools/relay", "topic-tools"),
        ("/usr/lib/python3/dist-packages/rospy", "python3-rospy"),
        ("/usr/lib/python3/dist-packages/sensor_msgs", "python3-sensor-msgs"),
    ):
        if not Path(path).exists():
            raise SernError(f"ros1: needs the Debian package {package}")
    measure_s = QUICK_S if options.quick else MEASURE_S
    for case, load in CASES.items():
        for system in SYSTEMS:
            report.row(f"ros1 {case}", system, **measure(system, load, measure_s))
    report.row(f"ros1 {TOPICS} topics, none wanted", "sern", **_follow(measure_s))
    report.note("ros1: source and sink pinned to one CPU, the bridges to none; messages between processes of this host")
    mixed, fast = (f"ros1 {case}" for case in CASES)
    direct_ms = report.value(mixed, "direct", "odom_p50_ms")
    for system in SYSTEMS[1:]:
        report.note(
            f"ros1 {system}: adds {report.value(mixed, system, 'odom_p50_ms') - direct_ms:.3f} ms to odometry (p50), "
            f"{report.value(mixed, system, 'odom_p99_ms') - report.value(mixed, 'direct', 'odom_p99_ms'):.3f} ms (p99)"
        )
    sern_cpu = report.value(mixed, "sern", "cpu_percent")
    report.reach("ros1: latency added to odometry [ms]", report.value(mixed, "sern", "odom_p50_ms") - direct_ms, 0.5)
    report.reach("ros1: CPU beside the rospy bridge", sern_cpu / report.value(mixed, "rospy", "cpu_percent"), 0.7)
    report.reach("ros1: lost at 3 kHz", report.value(fast, "sern", "odom_lost"), 0)
    follow = report.value(f"ros1 {TOPICS} topics, none wanted", "sern", "cpu_percent")
    report.reach(f"ros1: CPU with {TOPICS} topics [%]", follow, 2.0)
