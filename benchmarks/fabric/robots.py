"""Four relays with 25 robots and a site each, on this machine; one robot in five is heard at another relay.

The relays are the installed daemons. Their 104 clients are cores with connections and keys of their own in three
processes: daemons of that number would not fit a small machine.
"""

import argparse
import asyncio
import json
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benchmarks.child import environment
from benchmarks.common import Report, interleaved, medians, repetitions
from benchmarks.fabric.members import ROBOT, Members, streams_of
from benchmarks.fabric.world import START_S, STOP_S, World, world
from benchmarks.fleet import rate_hz_of
from benchmarks.link.figures import quantile
from benchmarks.link.runs import until_ready
from sern_core.vocabulary.types import PriorityClass
from sern_runtime import clock
from sern_tools.harness.processes import Child, python

RELAYS: Final = ("relay1", "relay2", "relay3", "relay4")
ROBOTS: Final = 25
CROSSING: Final = 5
"""Robots of each relay that a site at the next relay takes, in place of that of their own."""
HOSTS: Final = 2
"""Processes that the robots are spread over."""
CASE: Final = f"4 relays, {ROBOTS} robots each"
SETTLE_S: Final = 3.0
LIMIT_MS: Final = 20.0
AT, CLASS, CROSSES, AGE = range(4)


def robots_of(relay: str) -> list[str]:
    return [f"{relay}_{number:02}" for number in range(ROBOTS)]


def takes(place: int) -> list[str]:
    """What the site at the relay of that place subscribes to."""
    own, before = RELAYS[place], RELAYS[place - 1]
    near, far = robots_of(own)[: ROBOTS - CROSSING], robots_of(before)[ROBOTS - CROSSING :]
    return [f"/({'|'.join(names)})/.*" for names in (near, far)]


EVERYBODY: Final = tuple((name, relay) for relay in RELAYS for name in robots_of(relay))
SITES: Final = {f"site{place}": (relay, takes(place)) for place, relay in enumerate(RELAYS)}


def members(here: World) -> list[Members]:
    """The processes: the sites, and the robots."""
    folder, endpoints = str(here.folder), here.files.endpoints
    return [
        Members("sites", folder, endpoints, SITES, opened=streams_of(len(EVERYBODY))),
        *(
            Members(f"robots{host}", folder, endpoints, {name: (relay, []) for name, relay in EVERYBODY[host::HOSTS]})
            for host in range(HOSTS)
        ),
    ]


async def play(seconds: float) -> dict[str, float]:
    async with world(RELAYS, (*SITES, *(name for name, _ in EVERYBODY))) as here:
        relays = [await here.relay(name) for name in RELAYS]
        await here.ready(*RELAYS)
        await here.connected(RELAYS)
        ends: list[Child] = []
        for spec in members(here):
            command = python("-m", "benchmarks.fabric.members", json.dumps(asdict(spec)))
            ends.append(await here.children.start(spec.name, command, talks=True, environment=environment()))
        for end in reversed(ends):
            await here.children.within(until_ready(end), START_S, f"{end.name}: not all of them are there")
        await asyncio.sleep(SETTLE_S)
        from_s, before = clock.now(), here.children.cpu_s()
        await here.children.beside(asyncio.sleep(seconds))
        until_s, after = clock.now(), here.children.cpu_s()
        sites, *robots = ends
        await here.children.end(*robots, number=None, within_s=STOP_S)
        await here.children.end(sites, number=None, within_s=STOP_S)
        await here.children.end(*relays, within_s=STOP_S)
        cpu_s = {name: after[name] - before[name] for name in after}
        return _row(here.folder, from_s, until_s, cpu_s)


def _row(folder: Path, from_s: float, until_s: float, cpu_s: dict[str, float]) -> dict[str, float]:
    rows: NDArray[np.float64] = np.load(folder / "sites.npy")
    rows = rows[(rows[:, AT] >= from_s) & (rows[:, AT] < until_s)]
    control = rows[rows[:, CLASS] == PriorityClass.CONTROL]
    crossing = control[control[:, CROSSES] > 0]
    told: dict[str, Any] = json.loads((folder / "sites.json").read_text())
    sent: dict[str, int] = {}
    for host in range(HOSTS):
        sent |= json.loads((folder / f"robots{host}.json").read_text())
    tail = sum(last - told["last"].get(stream, 0) for stream, last in sent.items())
    return {
        "messages_hz": len(rows) / (until_s - from_s),
        "crossing_percent": 100 * float(rows[:, CROSSES].mean()),
        "control_p50_ms": 1000 * quantile(control[:, AGE], 0.5),
        "control_p99_ms": 1000 * quantile(control[:, AGE], 0.99),
        "crossing_p99_ms": 1000 * quantile(crossing[:, AGE], 0.99),
        "relay_cpu_percent": 100 * sum(cpu_s[name] for name in RELAYS) / len(RELAYS) / (until_s - from_s),
        "clients_cpu_percent": 100 * sum(cpu_s[name] for name in cpu_s if name not in RELAYS) / (until_s - from_s),
        "lost_count": told["lost"] + tail,
        "doubled_count": told["doubled"],
    }


def measure(seconds: float) -> dict[str, float]:
    return asyncio.run(play(seconds))


def bench(options: argparse.Namespace, report: Report) -> None:
    rounds, seconds = repetitions(options, usual=(3, 30.0), quick=(1, 5.0))
    system = "clients in 3 processes"
    runs = interleaved({system: partial(measure, seconds)}, rounds)[system]
    row = medians(runs)
    report.row(CASE, system, **row)
    report.reach(f"{CASE}: control p99, ms", row["control_p99_ms"], LIMIT_MS)
    report.reach(f"{CASE}: control p99 of what crosses, ms", row["crossing_p99_ms"], LIMIT_MS)
    wrong = sum(run["lost_count"] + run["doubled_count"] for run in runs)
    report.reach(f"{CASE}: reliable messages lost or doubled", wrong, 0)
    report.note(f"robots: {rate_hz_of(ROBOT):g} messages/s each; {rounds} rounds of {seconds:g} s")
