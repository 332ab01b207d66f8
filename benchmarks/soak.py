"""A relay, a robot and a site for ten minutes, as installed, with keys, while others come and go.

Another robot comes every few seconds, with topics that nobody has seen before, and ends: by SIGTERM, or by SIGKILL.
Strangers connect and say nothing, and /metrics and what the tools ask for are read. Of the three that stay, memory and
open files are looked at every second; what they had in the first fifth is their start.
"""

import argparse
import asyncio
import signal
import statistics
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Any, Final

from benchmarks import common
from benchmarks.asking import get, ready
from benchmarks.child import environment
from sern_runtime import clock
from sern_tools.harness.files import client_content, relay_content, write
from sern_tools.harness.processes import Child, Children, daemon
from sern_tools.keygen import make_keys
from sern_tools.ports import free_ports

START_S: Final = 60.0
SECONDS: Final = 600.0
QUICK_SECONDS: Final = 60.0
WARM_UP: Final = 0.2
"""This share of the time is not looked at: what is there from the beginning on is made in it."""
STAY: Final = ("relay", "robot", "site")
CHURN_NAMES: Final = 4
CHURN_S: Final = 5.0
STRANGERS: Final = 8
GROWTH_LIMIT_MB_PER_MIN: Final = 1.0
FILES_LIMIT: Final = 2
PATHS: Final = ("/metrics", "/api/topics", "/api/link", "/api/clients", "/api/events")


@dataclass
class Watched:
    """Memory and open files of one process, a sample a second: seconds, MB, files."""

    child: Child
    samples: list[tuple[float, float, int]] = field(default_factory=list)

    def look(self, at_s: float) -> None:
        proc = Path(f"/proc/{self.child.process.pid}")
        pages = int((proc / "statm").read_text().split()[1])
        self.samples.append((at_s, pages * 4096 / 1e6, len(list((proc / "fd").iterdir()))))

    def after(self, seconds: float) -> list[tuple[float, float, int]]:
        return [sample for sample in self.samples if sample[0] >= seconds]


def slope_per_min(samples: Sequence[tuple[float, float, int]]) -> float:
    """Growth of the memory in MB a minute, by least squares."""
    return statistics.linear_regression([at_s / 60 for at_s, _mb, _files in samples], [mb for _s, mb, _f in samples])[0]


def files_more(samples: Sequence[tuple[float, float, int]]) -> float:
    """How many more files are open in the last fifth than in the first, by their medians."""
    part = max(1, len(samples) // 5)
    return statistics.median(f for *_, f in samples[-part:]) - statistics.median(f for *_, f in samples[:part])


class Soak:
    """The processes of one run."""

    def __init__(self, folder: Path, children: Children) -> None:
        self._folder = folder
        self._children = children
        self._churn = [f"churn{number}" for number in range(CHURN_NAMES)]
        make_keys(folder, "relay", "robot", "site", *self._churn)
        self._port, *https = free_ports(4)
        self._https = [f"127.0.0.1:{port}" for port in https]
        self.comings = 0

    async def start(self) -> list[Watched]:
        endpoint = f"tcp://127.0.0.1:{self._port}"
        http = [{"listen": listen} for listen in self._https]
        robot: dict[str, Any] = {"kind": "synthetic", "role": "robot", "patrol": True, "counter_topics": ["/numbers"]}
        operator = {"kind": "synthetic", "role": "operator", "command_topic": "/robot/cmd_vel"}
        site = [{"kind": "record", "path": "got", "overwrite": True}, operator]
        write(self._folder, "relay", relay_content(endpoint, http=http[0]))
        write(self._folder, "robot", client_content("robot", endpoint, robot, http=http[1]))
        wants: dict[str, Any] = {"client": {"namespace": "/"}, "subscribe": ["/robot/.*", "/churn.*"]}
        write(self._folder, "site", client_content("site", endpoint, site, http=http[2], **wants))
        watched = []
        for name in STAY:
            program = "relay" if name == "relay" else "client"
            command = daemon(program, self._folder / f"{name}.yaml")
            watched.append(Watched(await self._children.start(name, command, environment=environment())))

        async def all_ready() -> bool:
            return await asyncio.to_thread(lambda: all(map(ready, self._https)))

        await self._children.until(all_ready, START_S, "the three that stay are not connected")
        return watched

    async def come_and_go(self) -> None:
        """One robot after another, each with topics of its own."""
        endpoint = f"tcp://127.0.0.1:{self._port}"
        for number in count():
            name = self._churn[number % CHURN_NAMES]
            counters = [f"/count_{number}_{topic}" for topic in range(5)]
            robot = {"kind": "synthetic", "role": "robot", "topics": ["/pose", "/scan"], "counter_topics": counters}
            file = write(self._folder, name, client_content(name, endpoint, robot))
            child = await self._children.start(name, daemon("client", file), environment=environment())
            await asyncio.sleep(CHURN_S)
            await self._children.stop([child], number=signal.SIGKILL if number % 2 else signal.SIGTERM)
            self._children.children.remove(child)
            self.comings += 1

    async def knock(self) -> None:
        """Strangers, who say nothing or noise and stay for a moment."""
        while True:
            writers = []
            for number in range(STRANGERS):
                _reader, writer = await asyncio.open_connection("127.0.0.1", self._port)
                writer.write(b"noise" * number)
                writers.append(writer)
            await asyncio.sleep(1.0)
            for writer in writers:
                writer.close()

    async def read(self) -> None:
        """What Prometheus and the tools ask for."""
        while True:
            for listen in self._https:
                for path in PATHS:
                    await asyncio.to_thread(get, listen, path)
            await asyncio.sleep(2.0)


async def _soak(folder: Path, seconds: float) -> tuple[list[Watched], int]:
    async with Children(folder) as children:
        soak = Soak(folder, children)
        watched = await soak.start()
        tasks = [asyncio.create_task(work) for work in (soak.come_and_go(), soak.knock(), soak.read())]
        began_s = clock.now()
        try:
            while (at_s := clock.now() - began_s) < seconds:
                for each in watched:
                    if not each.child.running:
                        raise each.child.failure()
                    each.look(at_s)
                for task in tasks:
                    if task.done():
                        task.result()
                await asyncio.sleep(1.0)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
        await children.end(*(each.child for each in reversed(watched)))
        return watched, soak.comings


def bench(options: argparse.Namespace, report: common.Report) -> None:
    seconds = options.seconds or (QUICK_SECONDS if options.quick else SECONDS)
    with tempfile.TemporaryDirectory() as name:
        watched, comings = asyncio.run(_soak(Path(name), seconds))
    for who, each in zip(STAY, watched, strict=True):
        samples = each.after(WARM_UP * seconds)
        growth, files = slope_per_min(samples), files_more(samples)
        figures = {
            "memory_MB": samples[-1][1],
            "growth_MB/min": growth,
            "open_files": samples[-1][2],
            "more_files": files,
        }
        report.row("robots come and go", who, **figures)
        report.reach(f"{who}: growth of its memory, MB a minute", growth, GROWTH_LIMIT_MB_PER_MIN)
        report.reach(f"{who}: files more than at the start", files, FILES_LIMIT)
    report.note(
        f"{seconds:g} s, the first fifth not looked at; {comings} robots came and went, half of them by SIGKILL"
    )


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seconds", type=common.seconds, metavar="S", help="run for so long")


def main() -> int:
    return common.main("soak", bench, description=__doc__, arguments=_arguments)


if __name__ == "__main__":
    sys.exit(main())
