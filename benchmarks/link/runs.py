"""One run: the link shaped, the ends started in their namespaces, the load offered, a script played, all collected."""

import json
import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import psutil

from benchmarks import child
from benchmarks.link import peers
from benchmarks.link.children import Running, environment
from benchmarks.link.forwarder import FORWARDER, Hops
from benchmarks.link.load import Load, Records, Spec, read_log
from benchmarks.link.sern import RELAY_PORT
from sern_core.vocabulary.errors import SernError
from sern_sim.models import LinkModel
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
POLL_S: Final = 0.1
"""How soon it is noticed that a process of the run has ended."""

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
    wire_dropped: int
    cpu_percent: dict[str, float]
    busy: float
    """Share of the machine's processors in use during the run, by everybody, 0 to 1."""
    warm_s: float = 0.0


def run(
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
    _congestion(lab, "bbr" if system.endswith("-bbr") else "cubic")
    running = Running(directory, system)
    try:
        if system.startswith("sern"):
            make_keys(directory, "relay", "robot", "site")
            running.ends["relay"] = start_relay(lab, directory, udp=system == "sern-udp")
        if system == FORWARDER:
            running.ends["relay"] = _start_forwarder(lab, directory)
        if system == "tcpros":
            _start_master(lab, running)
        for sends, node in ((False, lab.b), (True, lab.a)):
            spec = Spec(system, sends, lab.b.address, node.address, str(directory), duration_s, asdict(load))
            running.ends[spec.role] = _start(lab, node, spec)
        for role in ("robot", "site"):
            _await_ready(running, role)
        start_ns = time.monotonic_ns() + int(LEAD_S * 1e9)
        _say(running, "robot", f"go {start_ns}\n")
        sleep_until(start_ns)
        wire_before, cpu_before = lab.traffic()[0], running.cpu_s()
        psutil.cpu_percent()
        events = _play(lab, start_ns, script)
        sleep_until(start_ns + int(duration_s * 1e9))
        running.check()
        cpu_after, wire_after, busy = running.cpu_s(), lab.traffic()[0], psutil.cpu_percent()
        sleep_until(time.monotonic_ns() + int(DRAIN_S * 1e9))
        _finish(running)
    finally:
        running.stop()
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
        wire_after.dropped - wire_before.dropped,
        {role: 100 * (cpu_after[role] - cpu_before[role]) / duration_s for role in cpu_after},
        busy / 100,
        warm_s,
    )


def start_relay(lab: Lab, directory: Path, *, udp: bool) -> "subprocess.Popen[bytes]":
    """The daemon, as its user runs it."""
    content = {
        "relay": {
            "name": "relay",
            "listen": [f"tcp://*:{RELAY_PORT}"],
            "secret_key_file": "relay.key",
            "clients_dir": "clients",
            "udp": udp,
        },
        "access": [{"client": ".*", "publish": [".*"], "subscribe": [".*"]}],
        "http": {"listen": None},
        "log": {"level": "warning"},
        "summary": "relay.summary.json",
    }
    config = directory / "relay.yaml"
    config.write_text(json.dumps(content))
    return start_daemon(lab, lab.b, "relay", config)


def start_daemon(lab: Lab, node: Node, program: str, config: Path) -> "subprocess.Popen[bytes]":
    """`program`: relay or client. Its log is beside its configuration, with the suffix .log."""
    command = child.python("-m", f"sern_{program}.cli", "--config", str(config))
    return _spawn(lab, node, config.with_suffix(".log"), command, environment())


def _spawn(
    lab: Lab, node: Node, log: Path, command: Sequence[str], environ: Mapping[str, str]
) -> "subprocess.Popen[bytes]":
    """It is told to end by a signal."""
    with log.open("wb") as stream:
        return lab.popen(
            node,
            command,
            env=environ,
            stdin=subprocess.DEVNULL,
            stdout=stream,
            stderr=stream,
            cwd=log.parent,
            start_new_session=True,
        )


def _start_forwarder(lab: Lab, directory: Path) -> "subprocess.Popen[bytes]":
    """Start it in the relay's place."""
    Hops.draw().write(directory)
    command = child.python("-m", "benchmarks.link.forwarder", str(directory), lab.b.address)
    return _spawn(lab, lab.b, directory / "relay.log", command, environment())


def _start_master(lab: Lab, running: Running) -> None:
    """Returns when it listens."""
    command = [sys.executable, "-c", peers.ROS_MASTER, "--core", "-p", str(peers.ROS_PORT)]
    names = {"ROS_MASTER_URI": f"http://{lab.b.address}:{peers.ROS_PORT}", "ROS_IP": lab.b.address}
    running.ends["master"] = _spawn(lab, lab.b, running.directory / "master.log", command, {**os.environ, **names})
    give_up_s = time.monotonic() + START_S
    with lab.b.socket(socket.SOCK_STREAM) as probe:
        while probe.connect_ex((lab.b.address, peers.ROS_PORT)):
            running.check()
            if time.monotonic() > give_up_s:
                raise SernError(f"the ROS master does not listen within {START_S:g} s{running.said()}")
            time.sleep(POLL_S)


def _start(lab: Lab, node: Node, spec: Spec) -> "subprocess.Popen[bytes]":
    command = child.python("-m", "benchmarks.link.end", json.dumps(asdict(spec)))
    with (spec.path / f"{spec.role}.log").open("wb") as log:
        return lab.popen(
            node,
            command,
            env=environment(),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            start_new_session=True,
        )


def _await_ready(running: Running, role: str) -> None:
    """Until it says so; SernError as soon as any process of the run has ended."""
    process = running.ends[role]
    assert process.stdout is not None
    text = b""
    give_up_s = time.monotonic() + START_S
    while b"ready" not in text:
        running.check()
        left_s = give_up_s - time.monotonic()
        if left_s <= 0:
            raise SernError(
                f"{running.name(role)}: nothing got through within {START_S:g} s; is the machine "
                f"overloaded?{running.said()}"
            )
        if select.select([process.stdout], [], [], min(left_s, POLL_S))[0]:
            data = os.read(process.stdout.fileno(), 4096)
            if not data:
                raise SernError(running.ending(role))
            text += data


def _say(running: Running, role: str, text: str) -> None:
    process = running.ends[role]
    assert process.stdin is not None
    try:
        process.stdin.write(text.encode())
        process.stdin.flush()
    except BrokenPipeError as error:
        raise SernError(running.ending(role)) from error


def _finish(running: Running) -> None:
    """The site first, so that nothing which arrives after the end counts."""
    for role in ("site", "robot"):
        process = running.ends[role]
        assert process.stdin is not None
        process.stdin.close()
    for role, process in reversed(running.ends.items()):
        if role in ("relay", "master"):
            process.send_signal(signal.SIGTERM)
        running.await_end(role, any_status=role == "master")


def _play(lab: Lab, start_ns: int, script: Sequence[Step]) -> dict[str, tuple[int, int]]:
    events: dict[str, tuple[int, int]] = {}
    for step in script:
        sleep_until(start_ns + int(step.at_s * 1e9))
        asked_ns = time.monotonic_ns()
        step.action(lab)
        events[step.name] = (asked_ns, time.monotonic_ns())
    return events


def sleep_until(at_ns: int) -> None:
    """Sleep until then by the monotonic clock."""
    while (left_ns := at_ns - time.monotonic_ns()) > 0:
        time.sleep(left_ns / 1e9)


def _congestion(lab: Lab, name: str) -> None:
    """What TCP in both namespaces uses from now on."""
    for node in lab.nodes:
        words = f"ip route replace {NETWORK}.0.0/{PREFIX} dev {DEVICE} proto kernel scope link src {node.address}"
        run_command([*node.prefix, *words.split(), "congctl", name])
