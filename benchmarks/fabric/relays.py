"""What a second relay between a robot and a site costs: latency, and CPU of the relays."""

import argparse
import asyncio
import statistics
import time
from collections.abc import Callable
from functools import partial
from typing import Any, Final, NamedTuple

from benchmarks.common import Report, interleaved, medians, percentile, repetitions
from benchmarks.fabric.world import LOG, POSE, SITE, STOP_S, Flow, ages_s, fate, world

ROBOT: Final = "robot1"
CASE: Final = "a robot and a site, 500 messages/s"
FLOWS: Final = (
    POSE,
    LOG,
    Flow("/state", 300, 100, {"class": "state"}),
    Flow("/bulk", 1000, 300, {"class": "bulk"}),
)
SETTLE_S: Final = 5.0
MORE_MS: Final = 5.0
TIMES_CPU: Final = 3.0


class System(NamedTuple):
    """The relay of the robot and that of the site, `tls` between them."""

    relays: tuple[str, ...]
    tls: bool = True


ONE: Final = "one relay"
TWO: Final = "two relays"
SYSTEMS: Final = {
    ONE: System(("relay1",)),
    TWO: System(("relay1", "relay2")),
    "two relays, no TLS": System(("relay1", "relay2"), tls=False),
}


async def play(system: System, duration_s: float) -> dict[str, float]:
    async with world(system.relays, (SITE, ROBOT), tls=system.tls) as here:
        relays = [await here.relay(name) for name in system.relays]
        await here.ready(*system.relays)
        await here.connected(system.relays)
        site = await here.site(system.relays[-1])
        await here.ready(SITE)
        robot = await here.robot(ROBOT, FLOWS, system.relays[0])
        await here.flow(*(f"/{ROBOT}{flow.topic}" for flow in FLOWS))
        await asyncio.sleep(SETTLE_S)
        from_ns, before = time.time_ns(), here.children.cpu_s()
        await here.children.beside(asyncio.sleep(duration_s))
        until_ns, after = time.time_ns(), here.children.cpu_s()
        await here.children.end(robot, within_s=STOP_S)
        await here.children.end(site, *relays, within_s=STOP_S)
        logs = here.logs()
    poses_s = ages_s(logs[f"/{ROBOT}/pose"], from_ns, until_ns)
    cpu_s = {name: after[name] - before[name] for name in after}
    count = sum(from_ns <= each.wall_ns < until_ns for log in logs.values() for each in log.deliveries)
    found = fate(logs[f"/{ROBOT}/log"])
    seconds = (until_ns - from_ns) / 1e9
    return {
        "control_p50_ms": 1000 * percentile(poses_s, 0.5),
        "control_p99_ms": 1000 * percentile(poses_s, 0.99),
        "messages_hz": count / seconds,
        "relay_cpu_us": 1e6 * sum(cpu_s[name] for name in system.relays) / count,
        "robot_cpu_percent": 100 * cpu_s[ROBOT] / seconds,
        "site_cpu_percent": 100 * cpu_s[SITE] / seconds,
        "lost_count": found.lost,
        "doubled_count": found.doubled + found.swapped,
    }


def measure(system: System, duration_s: float) -> dict[str, float]:
    return asyncio.run(play(system, duration_s))


def bench(options: argparse.Namespace, report: Report) -> None:
    rounds, duration_s = repetitions(options, usual=(3, 30.0), quick=(1, 5.0))
    systems: dict[str, Callable[[], Any]] = {
        name: partial(measure, system, duration_s) for name, system in SYSTEMS.items()
    }
    found = interleaved(systems, rounds)
    for name, rows in found.items():
        report.row(CASE, name, **medians(rows))
    pairs = list(zip(found[TWO], found[ONE], strict=True))
    more_ms = statistics.median(two["control_p99_ms"] - one["control_p99_ms"] for two, one in pairs)
    report.reach("two relays: control p99, ms more than with one", more_ms, MORE_MS)
    times = statistics.median(two["relay_cpu_us"] / one["relay_cpu_us"] for two, one in pairs)
    report.reach("two relays: CPU of both a message, times that of one", times, TIMES_CPU)
    wrong = sum(row["lost_count"] + row["doubled_count"] for rows in found.values() for row in rows)
    report.reach("one and two relays: reliable messages lost or doubled", wrong, 0)
    report.note(f"relays: {rounds} rounds of {duration_s:g} s, differences and ratios within a round")
