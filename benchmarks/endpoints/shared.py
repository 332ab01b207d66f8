"""What the parts share: children of one run, the chain of SERN's daemons, a bridge over zenoh, and the rounds."""

import importlib.util
import statistics
import tempfile
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

from benchmarks import child, common
from benchmarks.common import MissingError
from sern_core.vocabulary.errors import SernError
from sern_tools.harness.files import RELAY, client_content, relay_content, write
from sern_tools.harness.processes import Child, Children, daemon, killed
from sern_tools.keygen import make_keys
from sern_tools.ports import free_ports

HOST: Final = "127.0.0.1"
START_S: Final = 60.0
"""How long processes may take to start and to find each other; the machine may be busy."""
ROUNDS: Final = 3
DIRECT, CHAIN, ALONE = "direct", "sern-chain", "sern-in-process"
ROBOT, SITE = "robot1", "site"
Environment = Mapping[str, str | None]
Figures = dict[str, float]


@asynccontextmanager
async def started() -> AsyncIterator[Children]:
    """Children of one run, with a folder of their own. They are killed at the end: nothing of them is needed then."""
    with tempfile.TemporaryDirectory(prefix="sern-bench-") as name:
        async with killed(Path(name)) as children:
            yield children


async def start_chain(
    children: Children, endpoints: Mapping[str, object], environment: Environment, *,
    sections: Mapping[str, Mapping[str, Any]] = MappingProxyType({}), sourced: Environment = MappingProxyType({}),
    **rule: str,
) -> list[Child]:  # fmt: skip
    """A relay and two clients as their user starts them, with CURVE keys, and nothing set that a user would not set.

    `endpoints`: the section `endpoint` of ROBOT, which offers its topics, and of SITE, which takes them. `rule` goes on
    top of the rules of both topics, `sections` of a client's file on top of what is there; `sourced`: variables of a
    ROS 2 installation.
    """
    folder = children.directory
    make_keys(folder, RELAY, ROBOT, SITE)
    address = f"tcp://{HOST}:{free_ports(1)[0]}"
    files = {RELAY: relay_content(address)}
    for name, endpoint in endpoints.items():
        content = {
            "client": {"namespace": "/"},
            "topics": [
                {"match": ".*/odom", "class": "control", "depth": 1000, **rule},
                {"match": ".*/cloud", "class": "bulk", "depth": 10, **rule},
            ],
            "subscribe": ["/bench/.*"] if name == SITE else [],
        }
        files[name] = client_content(name, address, endpoint, **{**content, **sections.get(name, {})})
    daemons = []
    for name, content in files.items():
        command = daemon("relay" if name == RELAY else "client", write(folder, name, content))
        daemons.append(
            await children.start(name, command, environment={**environment, **child.environment(), **sourced})
        )
    return daemons


async def said(process: Child, word: str) -> Any:
    """The value of `word` in the next line that has it. SernError when it is refused its work, or ends."""
    while True:
        content = await process.read_object()
        if "problem" in content:
            raise SernError(f"{process.name} cannot go on: {content['problem']}")
        if word in content:
            return content[word]


def zenoh_folder() -> Path:
    """Where this interpreter has zenoh. MissingError without it."""
    found = importlib.util.find_spec("zenoh")
    if found is None or found.origin is None:
        raise MissingError("needs zenoh: pip install eclipse-zenoh")
    return Path(found.origin).parents[1]


@dataclass(frozen=True)
class Rounds:
    """Runs of every system, in rounds: `runs[system][round]`."""

    runs: Mapping[str, Sequence[Figures]]

    def added_ms(self, system: str, metric: str) -> list[float]:
        """What the system adds to `metric` beside `direct`, round by round."""
        return [
            ours[metric] - direct[metric] for ours, direct in zip(self.runs[system], self.runs[DIRECT], strict=True)
        ]

    def times(self, system: str, other: str, metric: str) -> float:
        """How many times that of `other` the system's `metric` is: the median over rounds."""
        pairs = zip(self.runs[system], self.runs[other], strict=True)
        return statistics.median(ours[metric] / theirs[metric] for ours, theirs in pairs)

    def figures(self, system: str) -> Figures:
        """One row: medians, but of `_lost` and `_doubled` the most of a round; and how far apart the rounds are, if
        there are more. A figure that a round does not have (nothing of the topic arrived) is left out."""
        runs = self.runs[system]
        row: Figures = {}
        for metric, value in common.medians(runs).items():
            row[metric] = max(run[metric] for run in runs) if metric.endswith(("_lost", "_doubled")) else value
            if metric == "odom_p50_ms":
                added_ms = self.added_ms(system, metric)
                row["odom_added_ms"] = statistics.median(added_ms)
                if len(runs) > 1:
                    row["odom_added_spread_ms"] = common.spread(added_ms)
        if len(runs) > 1:
            row["cpu_spread_percent"] = common.spread([run["cpu_percent"] for run in runs])
        return row


def bench_rounds(report: common.Report, case: str, systems: Mapping[str, Callable[[], Figures]], rounds: int) -> Rounds:
    """Measure interleaved, and add a row for each system."""
    found = Rounds(common.interleaved(systems, rounds))
    for system in systems:
        report.row(case, system, **found.figures(system))
    return found


def reach_added(report: common.Report, where: str, rounds: Rounds, system: str, limit_ms: float) -> None:
    """The median over rounds of what the system adds to odometry, against its limit."""
    added_ms = statistics.median(rounds.added_ms(system, "odom_p50_ms"))
    report.reach(f"{where}: latency added to odometry [ms]", added_ms, limit_ms)
