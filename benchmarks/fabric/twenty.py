"""Twenty relays, every two with a connection: until all have sessions, and what they take when nothing happens.

What the fabric takes is the difference to relays without one, which are started and looked at together with the others.
"""

import argparse
import asyncio
import statistics
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Final, NamedTuple

import psutil

from benchmarks.common import Report, interleaved, medians, repetitions
from benchmarks.fabric.world import world
from sern_runtime import clock
from sern_tools.harness.processes import Child, cpu_s

CASE: Final = "relays that do nothing"
COUNT: Final = 20
QUICK_COUNT: Final = 5
ALONE: Final = "without a fabric"
SETTLE_S: Final = 5.0
CONVERGED_S: Final = 5.0
IDLE_PERCENT: Final = 1.0
FABRIC_MB: Final = 40.0
LOOK_S: Final = 0.05


class Taken(NamedTuple):
    """What a relay takes: share of a core, resident memory, and what the end of its process would free."""

    cpu_percent: float
    rss_bytes: float
    own_bytes: float

    def row(self) -> dict[str, float]:
        return {"cpu_percent": self.cpu_percent, "rss_MB": self.rss_bytes / 1e6, "own_MB": self.own_bytes / 1e6}


async def _take(relays: Sequence[Child], seconds: float) -> Taken:
    """What one relay takes: the mean of their CPU, medians of their memory."""
    pids = [relay.process.pid for relay in relays]
    before_s, began_s = cpu_s(*pids), clock.now()
    await asyncio.sleep(seconds)
    percent = 100 * (cpu_s(*pids) - before_s) / (clock.now() - began_s) / len(pids)
    memory = [psutil.Process(pid).memory_full_info() for pid in pids]
    rss, own = (statistics.median(getattr(each, name) for each in memory) for name in ("rss", "uss"))
    return Taken(percent, rss, own)


async def play(count: int, seconds: float) -> dict[str, Mapping[str, float]]:
    names = [f"relay{number}" for number in range(1, count + 1)]
    async with world(names) as here, world(["alone1"]) as one, world(["alone2"]) as two:
        alone = [await one.relay("alone1"), await two.relay("alone2")]
        began_s = clock.now()
        relays = [await here.relay(name) for name in names]
        await here.ready(*names)
        ready_s = clock.now()
        await here.connected(names, every_s=LOOK_S)
        now_s = clock.now()
        await here.children.beside(asyncio.sleep(SETTLE_S))
        taken, without = await here.children.beside(asyncio.gather(_take(relays, seconds), _take(alone, seconds)))
        times = {"converged_s": now_s - ready_s, "from_start_s": now_s - began_s}
        await here.children.end(*relays)
    return {f"{count} relays": {**taken.row(), **times}, ALONE: without.row()}


def measure(count: int, seconds: float) -> dict[str, Mapping[str, float]]:
    return asyncio.run(play(count, seconds))


def bench(options: argparse.Namespace, report: Report) -> None:
    rounds, seconds = repetitions(options, usual=(3, 30.0), quick=(1, 5.0))
    count = QUICK_COUNT if options.quick else COUNT
    runs = interleaved({"all": partial(measure, count, seconds)}, rounds)["all"]
    name = f"{count} relays"
    row, without = (medians([run[system] for run in runs]) for system in (name, ALONE))
    report.row(CASE, name, **row)
    report.row(CASE, ALONE, **without)
    report.reach(f"{name}: sessions of every two, s after the last was ready", row["converged_s"], CONVERGED_S)
    cpu_percent = row["cpu_percent"] - without["cpu_percent"]
    report.reach(f"{name}: idle CPU of the fabric, % of a core, each", cpu_percent, IDLE_PERCENT)
    report.reach(f"{name}: memory of the fabric, MB (RSS), each", row["rss_MB"] - without["rss_MB"], FABRIC_MB)
    report.note(
        f"{name}: {rounds} rounds, idle for {seconds:g} s; what the fabric takes is what a relay takes more than one "
        "without a fabric beside them"
    )
