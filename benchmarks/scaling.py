"""Robots as replayed point clouds, more and more of them, over a WiFi-like link (fig:aurora_comparison_agents).

Each robot is a rospy node that publishes clouds of a recorded scan under a namespace of its own, on one side of a link
made by tc netem with 5 to 10 ms of round trip; a rospy node on the other side takes all of them. Needs root and ROS 1.

    sern     a master on each side; client, relay and client, the installed daemons with keys; the relay behind the link
    tcpros   one master, behind the link: a standard ROS setup
    zmq      PUB and SUB in place of the nodes, as they come
    zenoh    two peers in place of the nodes, as they come

Small clouds are 10 kB at 20 Hz, large ones 200 kB at 10 Hz. An idle link carries three times what is offered, a full
one six tenths. Latency is from the publisher's call to the subscriber's callback; `far` is all that runs behind the
link, `server` of that what is neither subscriber nor master. Power is RAPL's where this machine has it; else it is CPU
time at WATTS_A_CORE, an estimate.
"""

import argparse
import asyncio
import socket
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from statistics import fmean, median
from typing import Any, Final, NamedTuple

import psutil

from benchmarks import child, recordings
from benchmarks.common import (
    MissingError,
    Report,
    half_width_95,
    interleaved,
    main,
    percentile,
    repetition_arguments,
    repetitions,
    try_realtime,
)
from benchmarks.endpoints import ros1
from benchmarks.link.runs import START_S, congestion, sleep_until, start_daemon, start_relay
from benchmarks.link.sern import RELAY_PORT
from benchmarks.paper.published import LEVELS, MOST_LATENCY, MOST_LOAD
from sern_core.vocabulary.errors import SernError
from sern_sim.models import LinkModel
from sern_tools.harness.files import client_content, write
from sern_tools.harness.processes import Child, Children, killed, python
from sern_tools.keygen import make_keys
from sern_tools.lab.lab import Lab, Node

SIZES: Final = {"small": (10_000, 20.0), "large": (200_000, 10.0)}
LINKS: Final = {"idle": 3.0, "full": 0.6}
"""What the link carries, of what is offered."""
DELAY_S, JITTER_S = 0.00375, 0.00125
SERN, TCPROS, ZMQ, ZENOH = "sern", "tcpros", "zmq", "zenoh"
SYSTEMS: Final = (TCPROS, SERN, ZMQ, ZENOH)
COMPARED: Final = (TCPROS, SERN)
"""Those that the paper compares."""
ROS_PORT: Final = 11311
WATTS_A_CORE: Final = 12.0
"""A desktop processor of 65 W with four cores and a quarter of it for the rest: an estimate, where there is no RAPL."""
RAPL: Final = Path("/sys/class/powercap/intel-rapl:0/energy_uj")
WARM_S: Final = 1.0
RUN_S: Final = 3.0
FEW_ROUNDS: Final = 5
"""Runs of the systems that the paper does not compare."""


class Case(NamedTuple):
    """A level of load: how many robots, which clouds, how the link is."""

    robots: int
    size: str
    link: str

    @property
    def name(self) -> str:
        return f"{self.robots} robots, {self.size} clouds, {self.link} link"

    @property
    def topics(self) -> list[str]:
        return [f"/bench/robot{number}/points" for number in range(1, self.robots + 1)]

    def model(self) -> LinkModel:
        """The link, each way."""
        nbytes, rate_hz = SIZES[self.size]
        return LinkModel(
            rate_bps=8 * nbytes * rate_hz * self.robots * LINKS[self.link], delay_s=DELAY_S, jitter_s=JITTER_S
        )


class Started(NamedTuple):
    """The processes of a run, by what they are."""

    watcher: Child
    server: Sequence[Child]
    beside: Sequence[Child]
    """A master, where the subscriber is."""


def _environment(node: Node, master: Node, directory: Path) -> dict[str, str | None]:
    return {
        "ROS_MASTER_URI": f"http://{master.address}:{ROS_PORT}",
        "ROS_IP": node.address,
        "ROS_HOME": str(directory),
        "PYTHONPATH": str(child.ROOT),
    }


async def _master(children: Children, node: Node) -> Child:
    environment = _environment(node, node, children.directory)
    name = f"master_{node.address}"
    command = [*node.prefix, ros1.ROSMASTER, "--core", "-p", str(ROS_PORT)]
    process = await children.start(name, command, environment={**environment, "PYTHONPATH": None})

    async def listens() -> bool:
        with node.socket(socket.SOCK_STREAM) as probe:
            return not probe.connect_ex((node.address, ROS_PORT))

    await children.until(listens, START_S, f"{name} does not listen")
    return process


async def _rospy(children: Children, node: Node, master: Node, name: str, *words: str) -> Child:
    command = [*node.prefix, ros1.DEBIAN_PYTHON, "-m", "benchmarks.endpoints.rospy_roles", *words]
    environment = _environment(node, master, children.directory)
    return await children.start(name, command, talks=True, environment=environment)


async def _plain(children: Children, node: Node, name: str, *words: str) -> Child:
    command = [*node.prefix, *python("-m", "benchmarks.scaling_ends", *words)]
    return await children.start(name, command, talks=True, environment=child.environment())


async def _ros(children: Children, lab: Lab, case: Case, points: Path, *, bridged: bool) -> Started:
    beside = [await _master(children, lab.b)]
    robots_master, server = lab.b, []
    if bridged:
        robots_master = lab.a
        await _master(children, lab.a)
        server = await _chain(children, lab)
    watcher = await _rospy(children, lab.b, lab.b, "watch", "watch", *case.topics)
    for topic in case.topics:
        words = ("clouds", str(points), str(SIZES[case.size][1]), topic)
        await _rospy(children, lab.a, robots_master, topic.split("/")[2], *words)
    return Started(watcher, server, beside)


async def _chain(children: Children, lab: Lab) -> list[Child]:
    """Returns those behind the link."""
    directory = children.directory
    make_keys(directory, "relay", "robot", "site")
    relay = await start_relay(children, lab.b, udp=True)
    daemons = {}
    for name, node in (("robot", lab.a), ("site", lab.b)):
        endpoint = {"kind": "ros1", "master_uri": f"http://{node.address}:{ROS_PORT}", "host": node.address}
        content = client_content(
            name, f"tcp://{lab.b.address}:{RELAY_PORT}", endpoint, client={"namespace": "/"}, log={"level": "warning"},
            topics=[{"match": ".*/points", "class": "state"}], subscribe=["/bench/.*"] if name == "site" else [],
        )  # fmt: skip
        daemons[name] = await start_daemon(children, node, "client", write(directory, name, content))
    return [relay, daemons["site"]]


async def _start(children: Children, lab: Lab, system: str, case: Case, points: Path) -> Started:
    if system in (SERN, TCPROS):
        return await _ros(children, lab, case, points, bridged=system == SERN)
    watcher = await _plain(children, lab.b, "watch", f"{system}-watch", *case.topics)
    words = (f"{system}-clouds", lab.b.address, str(points), str(SIZES[case.size][1]))
    for topic in case.topics:
        await _plain(children, lab.a, topic.split("/")[2], *words, topic)
    return Started(watcher, [], [])


async def _arrivals(watcher: Child, found: list[dict[str, Any]]) -> None:
    while True:
        told = await watcher.read_object()
        if "topic" in told:
            found.append(told)


def _cpu(processes: Sequence[Child]) -> float:
    return sum(_tree_cpu_s(each.process.pid) for each in processes)


def _tree_cpu_s(pid: int) -> float:
    """CPU time of a process and those that it started: a prefix may stay in front of what it runs."""
    process = psutil.Process(pid)
    return sum(sum(each.cpu_times()[:2]) for each in (process, *process.children(recursive=True)))


def _memory(processes: Sequence[Child]) -> float:
    """Proportional set size, in bytes: what is shared counts once."""
    found = 0.0
    for each in processes:
        process = psutil.Process(each.process.pid)
        found += sum(one.memory_full_info().pss for one in (process, *process.children(recursive=True)))
    return found


def _energy_j() -> float | None:
    """What the processor package has used so far; None: it does not say."""
    try:
        return int(RAPL.read_text()) / 1e6
    except (OSError, ValueError):
        return None


async def _play(lab: Lab, system: str, case: Case, directory: Path, measure_s: float) -> dict[str, float]:
    lab.reset()
    model = case.model()
    lab.link(model, model)
    congestion(lab, "cubic")
    points = directory / "points"
    points.write_bytes(recordings.points(SIZES[case.size][0]))
    async with killed(directory) as children:
        started = await _start(children, lab, system, case, points)
        arrivals: list[dict[str, Any]] = []
        task = asyncio.create_task(_arrivals(started.watcher, arrivals))
        try:

            async def all_come() -> bool:
                return {told["topic"] for told in arrivals} >= set(case.topics)

            await children.until(all_come, START_S, f"{system}, {case.name}: not every robot got through")
            await asyncio.sleep(WARM_S)
            far = [started.watcher, *started.server, *started.beside]
            begin_ns, energy_j = time.monotonic_ns(), _energy_j()
            before = _cpu(far), _cpu(started.server)
            await sleep_until(begin_ns + int(measure_s * 1e9))
            end_ns, used_j = time.monotonic_ns(), _energy_j()
            took_s = (end_ns - begin_ns) / 1e9
            far_s, server_s = _cpu(far) - before[0], _cpu(started.server) - before[1]
            memory_bytes = _memory(far), _memory(started.server)
            children.check()
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
    came = [told for told in arrivals if begin_ns <= told["at_ns"] < end_ns]
    if not came:
        raise SernError(f"{system}, {case.name}: nothing came while it was measured")
    latency_ms = sorted((told["at_ns"] - told["sent_ns"]) / 1e6 for told in came)
    watts = WATTS_A_CORE * far_s / took_s if energy_j is None or used_j is None else (used_j - energy_j) / took_s
    return {
        "latency_ms": fmean(latency_ms),
        "p50_ms": percentile(latency_ms, 0.5),
        "p99_ms": percentile(latency_ms, 0.99),
        "came_percent": 100 * len(came) / (case.robots * SIZES[case.size][1] * took_s),
        "far_percent": 100 * far_s / took_s,
        "server_percent": 100 * server_s / took_s,
        "far_MB": memory_bytes[0] / 1e6,
        "server_MB": memory_bytes[1] / 1e6,
        "power_W": watts,
    }


def measure(lab: Lab, system: str, case: Case, measure_s: float) -> dict[str, float]:
    """One run. Raises SernError when an end does not work."""
    with tempfile.TemporaryDirectory(prefix="sern-scaling-") as name:
        return asyncio.run(_play(lab, system, case, Path(name), measure_s))


def summary(runs: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Medians, and half the width of the 95 % interval of the mean latency and of the CPU behind the link."""
    row = {name: median(run[name] for run in runs) for name in runs[0]}
    if len(runs) > 1:
        row["latency_half_ms"] = half_width_95([run["latency_ms"] for run in runs])
        row["far_half_percent"] = half_width_95([run["far_percent"] for run in runs])
    return row


def cases(*, quick: bool) -> list[Case]:
    levels = LEVELS[:1] if quick else LEVELS
    return [Case(robots, size, link) for size in SIZES for link in LINKS for robots in levels]


def bench(options: argparse.Namespace, report: Report) -> None:
    rounds, measure_s = repetitions(options, usual=(20, RUN_S), quick=(1, 2.0))
    try:
        ros1.need(ros1.ROSMASTER, *ros1.NEEDS[ros1.ROSPY])
    except MissingError as error:
        report.note(f"nothing is measured: it {error}")
        return
    note = try_realtime()
    chosen = [case for case in cases(quick=options.quick) if options.sizes is None or case.size in options.sizes]
    with Lab() as lab:
        for case in chosen:
            runs: dict[str, Callable[[], dict[str, float]]] = {
                system: partial(measure, lab, system, case, measure_s) for system in SYSTEMS
            }
            few = min(rounds, FEW_ROUNDS)
            played = interleaved(runs, few)
            for system, more in interleaved({each: runs[each] for each in COMPARED}, rounds - few).items():
                played[system] += more
            found = {system: summary(each) for system, each in played.items()}
            for system, row in found.items():
                report.row(case.name, system, **row)
            ours, theirs = found[SERN], found[TCPROS]
            for what, metric, limit in (("latency", "latency_ms", MOST_LATENCY), ("CPU", "far_percent", MOST_LOAD)):
                name = f"{case.name}: {what} over that of TCPROS (paper: .75 to .85 in latency, .85 in load)"
                report.reach(name, ours[metric] / theirs[metric], limit)
        power = "RAPL, the package"
        if _energy_j() is None:
            power = f"CPU behind the link at {WATTS_A_CORE:g} W a core, an estimate"
        report.note(
            f"lab: {lab.backend}; {note}; {rounds} runs of {measure_s:g} s, {few} of zmq and "
            f"zenoh; {recordings.note()}; power: {power}"
        )


def _arguments(parser: argparse.ArgumentParser) -> None:
    repetition_arguments(parser)
    parser.add_argument("--sizes", nargs="+", choices=tuple(SIZES), help="these clouds alone")


if __name__ == "__main__":
    sys.exit(main("scaling", bench, description=__doc__, arguments=_arguments))
