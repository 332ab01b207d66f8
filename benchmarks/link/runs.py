"""One run: the link shaped, the ends started in their namespaces, the load offered, a script played, all collected."""

import asyncio
import json
import socket
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import psutil

from benchmarks import child
from benchmarks.link import peers
from benchmarks.link.forwarder import FORWARDER, Hops
from benchmarks.link.load import READY, Load, Records, Spec, read_log
from benchmarks.link.sern import RELAY_PORT
from sern_sim.models import LinkModel
from sern_tools.harness.files import relay_content, write
from sern_tools.harness.processes import Child, Children, daemon, killed, python
from sern_tools.keygen import make_keys
from sern_tools.lab.backends import DEVICE, NETWORK, PREFIX
from sern_tools.lab.host import run as run_command
from sern_tools.lab.lab import Lab, Node

START_S: Final = 60.0
"""How long ends may take to start and to find each other; the machine may be busy, the link lossy. One that ends is
noticed at once."""
LEAD_S: Final = 0.3
"""Time from the order to go until the first message."""
DRAIN_S: Final = 1.5
"""What is under way at the end of the load may still arrive for so long."""
STOP_S: Final = 20.0
"""Time for a process to end when it is told to."""
EXACT_S: Final = 0.005
"""How long before a moment the loop's timers, which know whole milliseconds, leave off."""

Action = Callable[[Lab], None]


class Step(NamedTuple):
    """Something that happens to the link during a run."""

    at_s: float
    name: str
    action: Action


@dataclass
class Outcome:
    """What came of a run. Times in ns of the monotonic clock; `events` are (asked, done) by a step's name."""

    system: str
    model: LinkModel
    load: Load
    start_ns: int
    duration_s: float
    offered: Records
    arrived: Records
    robot: dict[str, Any]
    site: dict[str, Any]
    relay: dict[str, Any]
    events: dict[str, tuple[int, int]]
    wire_packets: int
    """What left the link from the robot to the relay while load was offered; `wire_bytes` with Ethernet headers."""
    wire_bytes: int
    cpu_percent: dict[str, float]
    busy: float
    """Share of the machine's processors in use during the run, by everybody, 0 to 1."""
    warm_s: float = 0.0


async def run(
    lab: Lab,
    system: str,
    model: LinkModel,
    load: Load,
    duration_s: float,
    directory: Path,
    *,
    script: Sequence[Step] = (),
    warm_s: float = 0.0,
) -> Outcome:
    """`directory` must be empty. Raises SernError when an end does not work."""
    lab.reset()
    lab.link(model, model)
    congestion(lab, "bbr" if system.endswith("-bbr") else "cubic")
    async with killed(directory) as children:
        between = []
        if system.startswith("sern"):
            make_keys(directory, "relay", "robot", "site")
            between = [await start_relay(children, lab.b, udp=system == "sern-udp")]
        if system == FORWARDER:
            between = [await _start_forwarder(children, lab.b)]
        if system == "tcpros":
            await _start_master(children, lab.b)
        ends = []
        for sends, node in ((False, lab.b), (True, lab.a)):
            spec = Spec(system, sends, lab.b.address, node.address, str(directory), duration_s, asdict(load))
            ends.append(await _start_end(children, node, spec))
        site, robot = ends
        for end in (robot, site):
            problem = f"{end.name}: nothing got through; is the machine overloaded? It was not ready"
            await children.within(until_ready(end), START_S, problem)
        start_ns = time.monotonic_ns() + int(LEAD_S * 1e9)
        await robot.say(f"go {start_ns}")
        await sleep_until(start_ns)
        wire_before, cpu_before = lab.traffic()[0], children.cpu_s()
        psutil.cpu_percent()
        events = await _play(lab, start_ns, script)
        await sleep_until(start_ns + int(duration_s * 1e9))
        children.check()
        cpu_after, wire_after, busy = children.cpu_s(), lab.traffic()[0], psutil.cpu_percent()
        await sleep_until(time.monotonic_ns() + int(DRAIN_S * 1e9))
        # The site first, so that nothing which arrives after the end counts. Ends stop with their input.
        await children.end(site, robot, number=None, within_s=STOP_S)
        await children.end(*between, within_s=STOP_S)
    read = {role: json.loads((directory / f"{role}.json").read_text()) for role in ("robot", "site")}
    summary = directory / "relay.summary.json"
    return Outcome(
        system,
        model,
        load,
        start_ns,
        duration_s,
        read_log(directory / "robot.npy"),
        read_log(directory / "site.npy"),
        read["robot"],
        read["site"],
        json.loads(summary.read_text()) if summary.exists() else {},
        events,
        wire_after.packets - wire_before.packets,
        wire_after.bytes - wire_before.bytes,
        {role: 100 * (cpu_after[role] - cpu_before[role]) / duration_s for role in cpu_after},
        busy / 100,
        warm_s,
    )


async def start_relay(children: Children, node: Node, *, udp: bool) -> Child:
    """The daemon, as its user runs it."""
    content = relay_content(
        f"tcp://*:{RELAY_PORT}",
        relay={"udp": udp},
        http={"listen": None},
        log={"level": "warning"},
        summary="relay.summary.json",
    )
    config = write(children.directory, "relay", content)
    return await start_daemon(children, node, "relay", config)


async def start_daemon(children: Children, node: Node, program: str, config: Path) -> Child:
    """`program`: relay or client. Its name is that of its configuration."""
    return await _start(children, node, config.stem, daemon(program, config))


async def _start(
    children: Children, node: Node, name: str, command: Sequence[str], *, talks: bool = False,
    environment: Mapping[str, str] | None = None,
) -> Child:  # fmt: skip
    """One that finds this checkout, unless it has an `environment` of its own."""
    own = child.environment() if environment is None else environment
    return await children.start(name, [*node.prefix, *command], talks=talks, environment=own)


async def _start_forwarder(children: Children, node: Node) -> Child:
    """Start it in the relay's place."""
    Hops.draw().write(children.directory)
    command = python("-m", "benchmarks.link.forwarder", str(children.directory), node.address)
    return await _start(children, node, "relay", command)


async def _start_master(children: Children, node: Node) -> None:
    """Returns when it listens."""
    command = [sys.executable, "-c", peers.ROS_MASTER, "--core", "-p", str(peers.ROS_PORT)]
    names = {"ROS_MASTER_URI": f"http://{node.address}:{peers.ROS_PORT}", "ROS_IP": node.address}
    await _start(children, node, "master", command, environment=names)
    with node.socket(socket.SOCK_STREAM) as probe:

        async def listens() -> bool:
            return not probe.connect_ex((node.address, peers.ROS_PORT))

        await children.until(listens, START_S, "the ROS master does not listen")


async def _start_end(children: Children, node: Node, spec: Spec) -> Child:
    return await start_program(children, node, spec.role, "benchmarks.link.end", asdict(spec))


async def start_program(children: Children, node: Node, name: str, program: str, spec: Mapping[str, Any]) -> Child:
    """A module of ours that talks, told what to do."""
    return await _start(children, node, name, python("-m", program, json.dumps(spec)), talks=True)


async def until_ready(end: Child) -> None:
    """Wait until it says so; rospy may say other things before."""
    while READY not in await end.read_line():
        pass


async def _play(lab: Lab, start_ns: int, script: Sequence[Step]) -> dict[str, tuple[int, int]]:
    events: dict[str, tuple[int, int]] = {}
    for step in script:
        await sleep_until(start_ns + int(step.at_s * 1e9))
        asked_ns = time.monotonic_ns()
        step.action(lab)
        events[step.name] = (asked_ns, time.monotonic_ns())
    return events


async def sleep_until(at_ns: int) -> None:
    """Sleep until then by the monotonic clock."""
    while (left_s := (at_ns - time.monotonic_ns()) / 1e9) > 0:
        if left_s > EXACT_S:
            await asyncio.sleep(left_s - EXACT_S)
        else:
            time.sleep(left_s)  # noqa: ASYNC251  nothing else is to be done so shortly before


def congestion(lab: Lab, name: str) -> None:
    """What TCP in both namespaces uses from now on."""
    for node in lab.nodes:
        words = f"ip route replace {NETWORK}.0.0/{PREFIX} dev {DEVICE} proto kernel scope link src {node.address}"
        run_command([*node.prefix, *words.split(), "congctl", name])
