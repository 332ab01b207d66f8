"""What a daemon takes when it has done nothing yet: time until it is ready, and memory.

The daemons are those of the installed programs, with the example files, keys and CURVE, on loopback: a relay, and one
client after the other that connects to it. Ready is READY=1 of sd_notify(3), at which systemd goes on; the time counts
from the start of the process. Memory is read some seconds later: `rss` is all that is resident, `own` what the end of
the process would free (USS), `anonymous` what no file stands behind. The guard of a client's commands is a process of
its own. A client of ROS 1 is measured without a master: its node waits for one. Beside them `libraries`: an
interpreter that only imports what a relay needs of others' libraries, message definitions among them.
"""

import argparse
import asyncio
import importlib.util
import re
import socket
import statistics
import sys
import tempfile
from asyncio.subprocess import PIPE
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple

import psutil

from benchmarks import common
from benchmarks.child import environment
from sern_core.vocabulary.errors import SernError
from sern_runtime import clock
from sern_tools.harness.processes import Child, Children, cpu_s, daemon, killed, python
from sern_tools.keygen import make_keys
from sern_tools.ports import free_ports

EXAMPLES: Final = Path(__file__).resolve().parents[1] / "deploy" / "examples"


class Client(NamedTuple):
    """An example file, whether its commands have a guard, and the module that its endpoint needs."""

    file: str
    guarded: bool = False
    module: str | None = None


CLIENTS: Final = {
    "simulated robot": Client("robot.yaml"),
    "simulated site": Client("site.yaml"),
    "robot with ROS 1": Client("jackal-noetic.yaml", guarded=True),
    "robot with ROS 2, DDS": Client("jackal-jazzy.yaml", guarded=True, module="cyclonedds"),
}
GUARD: Final = "sern_client.guard_process"
LIBRARIES: Final = (
    "aiohttp.web", "cryptography", "msgpack", "numpy", "prometheus_client", "pydantic", "ruamel.yaml", "typer",
    "uvloop", "zmq", "rosbags.typesys.stores.ros1_noetic", "rosbags.typesys.stores.ros2_jazzy",
)  # fmt: skip
READY_S: Final = 30.0
READY_LIMIT_S: Final = 1.0


class Footprint(NamedTuple):
    """One process. `ready_s` and `start_cpu_s`: time and CPU time until it was ready; None for a guard."""

    ready_s: float | None
    start_cpu_s: float | None
    rss_bytes: int
    own_bytes: int
    anonymous_bytes: int


class _Ready:
    """The socket on which a daemon says that it is ready."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "notify"
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(self.path))
        self._socket.setblocking(False)

    async def wait(self) -> None:
        loop = asyncio.get_running_loop()
        while b"READY=1" not in (await loop.sock_recv(self._socket, 4096)).split(b"\n"):
            pass

    def close(self) -> None:
        self._socket.close()


def _prepare(folder: Path) -> None:
    """The example files with free ports in place of the usual ones, and the keys that they name. Without rclpy, which
    needs ROS 2 installed."""
    relay, feed, *https = map(str, free_ports(3 + len(CLIENTS)))
    make_keys(folder, "relay", "jackal1", "site1", "j100_0000")
    for name, http in zip(("relay.yaml", *(client.file for client in CLIENTS.values())), https, strict=True):
        text = (EXAMPLES / name).read_text(encoding="utf-8")
        text = re.sub("0.0.0.0:5555|relay.example:5555", f"127.0.0.1:{relay}", text).replace(":5570", f":{feed}")
        text = re.sub(r"\[({kind: dds[^}]*}), {kind: rclpy[^}]*}\]", r"\1", text)
        (folder / name).write_text(re.sub(":558[0-9]", f":{http}", text), encoding="utf-8")


def _memory(process: psutil.Process) -> tuple[int, int, int]:
    """Resident, own, anonymous, in bytes."""
    full = process.memory_full_info()
    return full.rss, full.uss, full.rss - full.shared


def _guards(child: Child) -> list[psutil.Process]:
    return [
        process
        for process in psutil.Process(child.process.pid).children(recursive=True)
        if process.status() != psutil.STATUS_ZOMBIE and GUARD in process.cmdline()
    ]


async def _start(children: Children, name: str, command: list[str]) -> tuple[Child, float, float]:
    """The daemon, once it is ready; how long that took, and its CPU time."""
    (directory := children.directory / name.replace(" ", "-")).mkdir()
    told = _Ready(directory)
    try:
        began_s = clock.now()
        child = await children.start(
            name, command, environment={**environment(), "NOTIFY_SOCKET": str(told.path), "WATCHDOG_USEC": None}
        )
        await children.within(told.wait(), READY_S, f"{name} is not ready")
        return child, clock.now() - began_s, cpu_s(child.process.pid)
    finally:
        told.close()


async def _libraries() -> Footprint:
    """What the libraries take to be imported; memory as it is then."""
    code = f"import sys, {', '.join(LIBRARIES)}; print(flush=True); sys.stdin.read()"
    began_s = clock.now()
    process = await asyncio.create_subprocess_exec(*python("-c", code), stdin=PIPE, stdout=PIPE)
    try:
        assert process.stdout is not None
        if not await process.stdout.readline():
            raise SernError("an interpreter cannot import the libraries")
        return Footprint(clock.now() - began_s, cpu_s(process.pid), *_memory(psutil.Process(process.pid)))
    finally:
        process.kill()
        await process.wait()


async def _measure(settle_s: float) -> dict[str, Footprint]:
    found = {"libraries": await _libraries()}
    with tempfile.TemporaryDirectory() as there:
        folder = Path(there)
        _prepare(folder)
        async with killed(folder) as children:
            relay, ready_s, cpu = await _start(children, "relay", daemon("relay", folder / "relay.yaml"))
            await asyncio.sleep(settle_s)
            found["relay"] = Footprint(ready_s, cpu, *_memory(psutil.Process(relay.process.pid)))
            for name, client in CLIENTS.items():
                if client.module is not None and importlib.util.find_spec(client.module) is None:
                    continue
                child, ready_s, cpu = await _start(children, name, daemon("client", folder / client.file))

                async def guarded(child: Child = child) -> bool:
                    return bool(_guards(child))

                if client.guarded:
                    await children.until(guarded, READY_S, f"{name} has no guard")
                await asyncio.sleep(settle_s)
                children.check()
                found[name] = Footprint(ready_s, cpu, *_memory(psutil.Process(child.process.pid)))
                for guard in _guards(child):
                    found[f"{name}: guard of its commands"] = Footprint(None, None, *_memory(guard))
                await children.end(child)
    return found


def measure(settle_s: float) -> dict[str, Footprint]:
    """Every daemon once. SernError when one of them does not come up."""
    return asyncio.run(_measure(settle_s))


def bench(options: argparse.Namespace, report: common.Report) -> None:
    rounds, settle_s = common.repetitions(options, (5, 5.0), quick=(1, 1.0))
    found = common.interleaved({"all": partial(measure, settle_s)}, rounds)["all"]
    for name in found[0]:
        taken = [one[name] for one in found]
        figures: dict[str, float] = {}
        for metric in ("ready_s", "start_cpu_s"):
            values = [getattr(each, metric) for each in taken]
            if None not in values:
                figures[metric] = statistics.median(values)
        for metric in ("rss", "own", "anonymous"):
            figures[f"{metric}_MB"] = statistics.median(getattr(each, f"{metric}_bytes") for each in taken) / 1e6
        report.row(name, "python" if name == "libraries" else "sern", **figures)
        if "ready_s" in figures and name != "libraries":
            report.reach(f"{name}: ready after, s", figures["ready_s"], READY_LIMIT_S)
    report.note(f"example files, CURVE, loopback; medians of {rounds} rounds, memory {settle_s:g} s after the start")


def main() -> int:
    return common.main("footprint", bench, description=__doc__, arguments=common.repetition_arguments)


if __name__ == "__main__":
    sys.exit(main())
