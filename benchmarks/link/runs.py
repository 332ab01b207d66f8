"""One run: the link shaped, the ends started in their namespaces, the load offered, a script played, all collected."""

import json
import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

import psutil

from benchmarks import child
from benchmarks.link import peers
from benchmarks.link.load import Load, Records, Spec, read_log
from benchmarks.link.sern import RELAY_PORT
from sern_core.errors import SernError
from sern_sim.models import LinkModel
from sern_tools.keygen import make_keys
from sern_tools.lab.backends import DEVICE, NETWORK, PREFIX
from sern_tools.lab.lab import Lab, Node
from sern_tools.processes import failure

START_S: Final = 40.0
"""How long ends may take to start and to find each other; the machine may be busy, the link lossy."""
LEAD_S: Final = 0.3
"""From the order to go until the first message."""
DRAIN_S: Final = 1.5
"""What is under way at the end of the load may still arrive for so long."""
STOP_S: Final = 20.0

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
    wire_bytes: int
    wire_dropped: int
    cpu_percent: dict[str, float]
    busy: float
    """Share of the machine's processors in use during the run, by everybody, 0 to 1."""
    warm_s: float = 0.0


@dataclass
class Running:
    """Processes of one run by role."""

    ends: dict[str, "subprocess.Popen[bytes]"] = field(default_factory=dict)

    def cpu_s(self) -> dict[str, float]:
        found = {}
        for role, process in self.ends.items():
            times = psutil.Process(process.pid).cpu_times()
            found[role] = times.user + times.system
        return found

    def stop(self) -> None:
        """End what still runs, whatever state it is in."""
        for process in self.ends.values():
            if process.poll() is None:
                process.kill()
            process.wait()
            for pipe in (process.stdin, process.stdout):
                if pipe is not None:
                    with suppress(BrokenPipeError):
                        pipe.close()


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
    running = Running()
    try:
        if system.startswith("sern"):
            make_keys(directory, "relay", "robot", "site")
            running.ends["relay"] = start_relay(lab, directory, udp=system == "sern-udp")
        if system == "tcpros":
            running.ends["master"] = _start_master(lab, directory)
        for sends, node in ((False, lab.b), (True, lab.a)):
            spec = Spec(system, sends, lab.b.address, node.address, str(directory), duration_s, asdict(load))
            running.ends[spec.role] = _start(lab, node, spec)
        for role in ("robot", "site"):
            _await_ready(running.ends[role], directory / f"{role}.log", f"{system}, {role}")
        start_ns = time.monotonic_ns() + int(LEAD_S * 1e9)
        _say(running.ends["robot"], f"go {start_ns}\n")
        sleep_until(start_ns)
        wire_before, cpu_before = lab.traffic()[0], running.cpu_s()
        psutil.cpu_percent()
        events = _play(lab, start_ns, script)
        sleep_until(start_ns + int(duration_s * 1e9))
        cpu_after, wire_after, busy = running.cpu_s(), lab.traffic()[0], psutil.cpu_percent()
        sleep_until(time.monotonic_ns() + int(DRAIN_S * 1e9))
        _finish(running, directory)
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
    with config.with_suffix(".log").open("wb") as log:
        return lab.popen(
            node,
            child.python("-m", f"sern_{program}.cli", "--config", str(config)),
            env={**os.environ, **child.environment()},
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            cwd=config.parent,
            start_new_session=True,
        )


def _start_master(lab: Lab, directory: Path) -> "subprocess.Popen[bytes]":
    """Returns when it listens."""
    command = [sys.executable, "-c", peers.ROS_MASTER, "--core", "-p", str(peers.ROS_PORT)]
    environment = {**os.environ, "ROS_MASTER_URI": f"http://{lab.b.address}:{peers.ROS_PORT}", "ROS_IP": lab.b.address}
    log = directory / "master.log"
    with log.open("wb") as stream:
        master = lab.popen(
            lab.b,
            command,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=stream,
            stderr=stream,
            start_new_session=True,
        )
    give_up_s = time.monotonic() + START_S
    with lab.b.socket(socket.SOCK_STREAM) as probe:
        while probe.connect_ex((lab.b.address, peers.ROS_PORT)):
            if master.poll() is not None:
                raise failure("rosmaster", master.returncode, log)
            if time.monotonic() > give_up_s:
                raise SernError(f"rosmaster does not listen within {START_S:g} s")
            time.sleep(0.1)
    return master


def _start(lab: Lab, node: Node, spec: Spec) -> "subprocess.Popen[bytes]":
    command = child.python("-m", "benchmarks.link.end", json.dumps(asdict(spec)))
    with (spec.path / f"{spec.role}.log").open("wb") as log:
        return lab.popen(
            node,
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            env={**os.environ, **child.environment()},
            cwd=spec.path,
            start_new_session=True,
        )


def _await_ready(process: "subprocess.Popen[bytes]", log: Path, what: str) -> None:
    assert process.stdout is not None
    text = b""
    give_up_s = time.monotonic() + START_S
    while b"ready" not in text:
        left_s = give_up_s - time.monotonic()
        if left_s <= 0 or not select.select([process.stdout], [], [], left_s)[0]:
            raise SernError(f"{what}: nothing got through within {START_S:g} s")
        data = os.read(process.stdout.fileno(), 4096)
        if not data:
            raise failure(what, process.wait(), log)
        text += data


def _say(process: "subprocess.Popen[bytes]", text: str) -> None:
    assert process.stdin is not None
    process.stdin.write(text.encode())
    process.stdin.flush()


def _finish(running: Running, directory: Path) -> None:
    """The site first, so that nothing which arrives after the end counts."""
    for role in ("site", "robot"):
        process = running.ends[role]
        assert process.stdin is not None
        process.stdin.close()
    for role, process in reversed(running.ends.items()):
        if role in ("relay", "master"):
            process.send_signal(signal.SIGTERM)
        try:
            code = process.wait(STOP_S)
        except subprocess.TimeoutExpired as error:
            raise SernError(f"{role} does not end") from error
        if code and role != "master":
            raise failure(role, code, directory / f"{role}.log")


def _play(lab: Lab, start_ns: int, script: Sequence[Step]) -> dict[str, tuple[int, int]]:
    events: dict[str, tuple[int, int]] = {}
    for step in script:
        sleep_until(start_ns + int(step.at_s * 1e9))
        asked_ns = time.monotonic_ns()
        step.action(lab)
        events[step.name] = (asked_ns, time.monotonic_ns())
    return events


def sleep_until(at_ns: int) -> None:
    """By the monotonic clock."""
    while (left_ns := at_ns - time.monotonic_ns()) > 0:
        time.sleep(left_ns / 1e9)


def _congestion(lab: Lab, name: str) -> None:
    """What TCP in both namespaces uses from now on."""
    for node in lab.nodes:
        words = f"ip route replace {NETWORK}.0.0/{PREFIX} dev {DEVICE} proto kernel scope link src {node.address}"
        done = lab.exec(node, [*words.split(), "congctl", name])
        if done.returncode:
            raise SernError(f"TCP {name}: {done.stderr.strip()}")
