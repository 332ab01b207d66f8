"""ROS 1 to ROS 1: what a bridge adds in latency and costs in CPU.

A source publishes odometry (1 kHz) and clouds (1 MB at 20 Hz); a sink takes both behind the bridge.

    direct           no bridge: what the source, the sink and loopback take
    sern-chain       what a user runs: sern-client, sern-relay, sern-client (CURVE), between two masters
    sern-in-process  two endpoints in one process, between two masters: what the endpoints alone cost
    topic_tools      one `relay` a topic, C++, at one master
    rospy            one process, AnyMsg in and out, at one master
    rospy+zenoh      two processes joined by zenoh (TCP), each a rospy node, AnyMsg, between two masters

topic_tools and rospy cannot join two masters, and only the chain encrypts, schedules and acknowledges: all that is to
the others' advantage. CPU is that of all processes in between. Source and sink are on one CPU, because clocks of
different CPUs may differ by microseconds.
"""

import argparse
import asyncio
import os
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from typing import Final

from benchmarks import child, common
from benchmarks.common import MissingError
from benchmarks.endpoints import shared
from benchmarks.endpoints.ros1_roles import CLOUD, ODOM, TYPES
from benchmarks.endpoints.shared import ALONE, CHAIN, DIRECT, HOST, START_S, Figures, said
from sern_client.endpoints.ros1.xmlrpc import CallError, XmlRpcClient
from sern_core.vocabulary.errors import SernError
from sern_tools.harness.processes import Child, Children, cpu_s, python
from sern_tools.ports import free_ports

WARM_S: Final = 2.0
MEASURE_S: Final = 8.0
QUICK_S: Final = 2.0
TOPICS: Final = 300
MIXED: Final = (1000.0, 1_000_000, 20.0)
FAST: Final = (3000.0, 0, 0.0)
CASES: Final = {"ros1 1 kHz + 20 MB/s": MIXED, "ros1 3 kHz": FAST}
MANY: Final = f"ros1 {TOPICS} topics, none wanted"
TOPIC_TOOLS, ROSPY, ZENOH = "topic_tools", "rospy", "rospy+zenoh"
SYSTEMS: Final = (DIRECT, CHAIN, ALONE, TOPIC_TOOLS, ROSPY, ZENOH)
LATENCY_LIMIT_MS: Final = 0.5
CPU_LIMIT: Final = 0.7
"""Times the CPU of the rospy bridge."""
FOLLOW_LIMIT: Final = 0.5
"""Times the CPU of a bare poller, which asks the master as often and reads each answer whole."""

DEBIAN_PYTHON: Final = "/usr/bin/python3"
"""What Debian's rospy is for."""
ROSMASTER: Final = "/usr/bin/rosmaster"
RELAY: Final = "/usr/lib/topic_tools/relay"
_DEBIAN: Final = "/usr/lib/python3/dist-packages"
_ROSPY: Final = (f"{_DEBIAN}/rospy", f"{_DEBIAN}/nav_msgs", f"{_DEBIAN}/sensor_msgs")
PACKAGES: Final = {
    ROSMASTER: "python3-rosmaster",
    RELAY: "topic-tools",
    **dict(zip(_ROSPY, ("python3-rospy", "python3-nav-msgs", "python3-sensor-msgs"), strict=True)),
}
NEEDS: Final = {TOPIC_TOOLS: (RELAY,), ROSPY: _ROSPY, ZENOH: _ROSPY}
"""What a system cannot be measured without."""
_TOPICS: Final = [f"{topic}={type_name}" for topic, type_name in TYPES.items()]


def need(*paths: str) -> None:
    """MissingError naming the Debian packages of those that are not there."""
    if missing := [PACKAGES[path] for path in paths if not Path(path).exists()]:
        raise MissingError(f"needs the Debian packages {' '.join(missing)}")


class Ros:
    """Masters and processes of one run."""

    def __init__(self, children: Children) -> None:
        self.children = children
        self.masters: list[int] = []
        """Their process ids."""

    def environment(self, master: str) -> dict[str, str | None]:
        """What a program at `master` gets; what this shell has set for ROS, or for our Python, does not count."""
        ours = (name for name in os.environ if name.startswith("ROS_") or name == "PYTHONPATH")
        home = str(self.children.directory)
        return {**dict.fromkeys(ours), "ROS_MASTER_URI": master, "ROS_IP": HOST, "ROS_HOME": home}

    async def start(self, name: str, *command: str, master: str) -> Child:
        """A program that is no part of the project."""
        return await self.children.start(name, command, environment=self.environment(master))

    async def role(self, role: str, *arguments: object) -> Child:
        """A process of `ros1_roles`."""
        command = python("-m", "benchmarks.endpoints.ros1_roles", role, *map(str, arguments))
        environment = {**self.environment(""), **child.environment()}
        return await self.children.start(role, command, talks=True, environment=environment)

    async def rospy(self, role: str, master: str, *arguments: str, typed: bool = True) -> Child:
        """A process of `rospy_roles`, which is ready; `typed`: it is told the topics of this benchmark."""
        environment = {**self.environment(master), "PYTHONPATH": str(child.ROOT)}
        topics = _TOPICS if typed else []
        command = [DEBIAN_PYTHON, "-m", "benchmarks.endpoints.rospy_roles", role, *arguments, *topics]
        process = await self.children.start(f"rospy-{role}", command, talks=True, environment=environment)
        await self.children.within(said(process, "ready"), START_S, f"rospy-{role} was not ready")
        return process

    async def master(self) -> str:
        """The URI of a new master, which answers."""
        port = free_ports(1)[0]
        uri = f"http://{HOST}:{port}"
        name = f"master{len(self.masters)}"
        process = await self.start(name, ROSMASTER, "--core", "-p", str(port), master=uri)
        self.masters.append(process.process.pid)
        client = XmlRpcClient(uri)

        async def answers() -> None:
            while True:
                try:
                    await client.call("getPid", "/bench")
                    return
                except CallError:
                    await asyncio.sleep(0.02)

        await self.children.within(answers(), START_S, f"{name} did not answer at {uri}")
        client.close()
        return uri

    async def chain(self, master: str, other: str) -> list[Child]:
        """Start relay and clients from one master to another."""
        endpoints = {
            name: {"kind": "ros1", "master_uri": uri, "host": HOST}
            for name, uri in ((shared.ROBOT, master), (shared.SITE, other))
        }
        return await shared.start_chain(self.children, endpoints, self.environment(""))

    async def zenoh(self, master: str, other: str) -> list[Child]:
        """Start a pair of zenoh nodes from one master to another."""
        to = [str(shared.zenoh_folder()), f"tcp/{HOST}:{free_ports(1)[0]}"]
        listener = await self.rospy("from-zenoh", other, *to)
        return [listener, await self.rospy("to-zenoh", master, *to)]


@asynccontextmanager
async def running() -> AsyncIterator[Ros]:
    async with shared.started() as children:
        yield Ros(children)


async def _through(ros: Ros, system: str, load: tuple[float, int, float], measure_s: float) -> Figures:
    master = await ros.master()
    other, suffix = master, ""
    await said(await ros.role("source", master, *load), "ready")
    between: list[Child] = []
    if system in (CHAIN, ALONE, ZENOH):
        other = await ros.master()
    if system == CHAIN:
        between = await ros.chain(master, other)
    elif system == ALONE:
        between = [await ros.role("bridge", master, other)]
    elif system == ZENOH:
        between = await ros.zenoh(master, other)
    elif system != DIRECT:
        suffix = "_copy"
        if system == ROSPY:
            between = [await ros.rospy("copy", master, suffix)]
        else:
            between = [
                await ros.start(f"relay{number}", RELAY, topic, topic + suffix,
                                f"__name:=relay{number}", master=master)
                for number, topic in enumerate(TYPES)
            ]  # fmt: skip
    sink = await ros.role("sink", other, ODOM + suffix, CLOUD + suffix if load[2] else "", WARM_S, measure_s)
    await ros.children.within(said(sink, "begin"), START_S + WARM_S, "not every topic got through")
    pids = [process.process.pid for process in between]
    before_s, began_s = cpu_s(*pids), time.monotonic()
    await said(sink, "end")
    used_s, took_s = cpu_s(*pids) - before_s, time.monotonic() - began_s
    found: Figures = await said(sink, "found")
    return {**found, "cpu_percent": 100 * used_s / took_s}


async def _measured(system: str, load: tuple[float, int, float], measure_s: float) -> Figures:
    try:
        async with running() as ros:
            return await ros.children.beside(_through(ros, system, load, measure_s))
    except SernError as error:
        raise SernError(f"ros1, {system}: {error}") from error


def measure(system: str, load: tuple[float, int, float], measure_s: float) -> Figures:
    """One run of one system under one load: odometry in Hz, clouds in bytes and in Hz."""
    return asyncio.run(_measured(system, load, measure_s))


async def _found_many(ros: Ros, measure_s: float) -> Figures:
    master = await ros.master()
    await said(await ros.role("many", master, TOPICS), "ready")
    follower = await ros.role("follow", master, TOPICS)
    found_s = float(await ros.children.within(said(follower, "found_s"), START_S, f"{TOPICS} topics were not found"))
    await asyncio.sleep(WARM_S)
    pids = [follower.process.pid]
    before_s, master_s, began_s = cpu_s(*pids), cpu_s(*ros.masters), time.monotonic()
    await asyncio.sleep(measure_s)
    used_s, asked_s = cpu_s(*pids) - before_s, cpu_s(*ros.masters) - master_s
    share = 100 / (time.monotonic() - began_s)
    found = {"found_s": found_s, "cpu_percent": share * used_s, "master_cpu_percent": share * asked_s}
    bare = (await ros.role("poll", master)).process.pid
    await asyncio.sleep(WARM_S)
    bare_s, began_s = cpu_s(bare), time.monotonic()
    await asyncio.sleep(measure_s)
    return {**found, "bare_cpu_percent": 100 * (cpu_s(bare) - bare_s) / (time.monotonic() - began_s)}


async def _follow(measure_s: float) -> Figures:
    try:
        async with running() as ros:
            return await ros.children.beside(_found_many(ros, measure_s))
    except SernError as error:
        raise SernError(f"{MANY}: {error}") from error


async def _try_zenoh() -> None:
    """MissingError when zenoh is not here, or Debian's Python cannot use what is."""
    folder = shared.zenoh_folder()
    program = f"import sys; sys.path.append({str(folder)!r}); import zenoh; print('{{}}')"
    try:
        async with shared.started() as children:
            process = await children.start("zenoh", [DEBIAN_PYTHON, "-I", "-c", program], talks=True)
            await process.read_object()
    except SernError as error:
        raise MissingError(f"{DEBIAN_PYTHON} cannot use the zenoh of this environment ({error})") from None


def bench(options: argparse.Namespace, report: common.Report) -> None:
    """MissingError where ROS 1 is not installed."""
    need(ROSMASTER)
    systems = list(SYSTEMS)
    for system, paths in NEEDS.items():
        try:
            need(*paths)
            if system == ZENOH:
                asyncio.run(_try_zenoh())
        except MissingError as error:
            systems.remove(system)
            report.note(f"ros1 without {system}: {error}")
    measure_s = QUICK_S if options.quick else MEASURE_S
    mixed, fast = (
        shared.bench_rounds(report, case, {name: partial(measure, name, load, measure_s) for name in systems},
                            options.rounds)
        for case, load in CASES.items()
    )  # fmt: skip
    report.row(
        MANY, "sern-endpoint", **common.medians([asyncio.run(_follow(measure_s)) for _ in range(options.rounds)])
    )
    report.note("ros1: source and sink pinned to one CPU, the bridges to none; messages between processes of this host")
    if ZENOH in systems:
        times = mixed.times(CHAIN, ZENOH, "cpu_percent")
        report.note(f"ros1 {CHAIN}: {times:.1f} times the CPU of {ZENOH}, which neither encrypts nor schedules")
    for system, where in ((CHAIN, "ros1"), (ALONE, "ros1, in one process")):
        shared.reach_added(report, where, mixed, system, LATENCY_LIMIT_MS)
        if ROSPY in systems:
            times = mixed.times(system, ROSPY, "cpu_percent")
            report.reach(f"{where}: CPU beside the rospy bridge", times, CPU_LIMIT)
        report.reach(f"{where}: lost at 3 kHz", fast.figures(system)["odom_lost"], 0)
    used, bare = (report.value(MANY, "sern-endpoint", metric) for metric in ("cpu_percent", "bare_cpu_percent"))
    report.reach(f"ros1, one endpoint: CPU with {TOPICS} topics, times a bare poller's", used / bare, FOLLOW_LIMIT)
