"""How long control stays away when a relay or a router fails, and what becomes of what is reliable.

Robots 1 and 2 are at relays 1 and 2, the site is at relay 2. Each client has both relays in its list and goes over as
its file says by default, after 2 s; relays take each other for gone after a lease of 2 s.
"""

import argparse
import asyncio
import signal
import time
from functools import partial
from typing import Final, NamedTuple

from benchmarks.common import Report, interleaved, medians, repetitions
from benchmarks.fabric.world import LOG, POSE, SITE, STOP_S, World, fate, pause, world
from sern_tools.harness.processes import Child

CASE: Final = "one of them fails"
RELAYS: Final = ("relay1", "relay2")
ROUTERS: Final = ("router1", "router2")
ROBOTS: Final = {"robot1": RELAYS, "robot2": RELAYS[::-1]}
SETTLE_S: Final = 4.0


class Case(NamedTuple):
    """`who` gets a signal; one that is stopped goes on later. `routers`: relays meet at external ones. `metric` of the
    robot whose way it is on is at most `limit_s`."""

    who: str
    number: signal.Signals
    routers: bool
    metric: str
    limit_s: float
    wanted: str


GAP: Final = "control stays away, s"
FRESH: Final = "a fresh pose after, s"
CASES: Final = {
    "router killed": Case("router1", signal.SIGKILL, True, "gap_s", 0.5, GAP),
    "router stopped": Case("router1", signal.SIGSTOP, True, "gap_s", 3.0, GAP),
    "robot's relay stopped": Case("relay1", signal.SIGSTOP, False, "gap_s", 3.0, GAP),
    "site's relay stopped": Case("relay2", signal.SIGSTOP, False, "gap_s", 3.0, GAP),
    "robot's relay killed": Case("relay1", signal.SIGKILL, False, "fresh_s", 4.0, FRESH),
    "site's relay killed": Case("relay2", signal.SIGKILL, False, "fresh_s", 4.0, FRESH),
}


async def _start(here: World, case: Case) -> dict[str, Child]:
    """Everything that may fail, by name, with streams that flow."""
    found = {}
    if case.routers:
        for name in ROUTERS:
            found[name] = await here.router(name)
    for name in RELAYS:
        found[name] = await here.relay(name)
    await here.ready(*RELAYS)
    await here.connected(RELAYS)
    found[SITE] = await here.site(*RELAYS[::-1])
    await here.ready(SITE)
    for name, relays in ROBOTS.items():
        found[name] = await here.robot(name, (POSE, LOG), *relays)
    await here.flow(*(f"/{robot}{flow.topic}" for robot in ROBOTS for flow in (POSE, LOG)))
    await asyncio.sleep(SETTLE_S)
    return found


async def play(case: Case, out_s: float) -> dict[str, float]:
    """`out_s`: how long one that is stopped stands still, and how long things go on after that, or after a kill."""
    async with world(RELAYS, (SITE, *ROBOTS), routers=ROUTERS if case.routers else ()) as here:
        found = await _start(here, case)
        victim = found[case.who]
        victim.stopping = case.number is signal.SIGKILL
        at_ns = time.time_ns()
        victim.signal(case.number)
        await here.children.beside(asyncio.sleep(out_s))
        again_ns = time.time_ns()
        if case.number is signal.SIGSTOP:
            victim.signal(signal.SIGCONT)
            await here.children.beside(asyncio.sleep(out_s))
        until_ns = time.time_ns()
        await here.children.end(*(found[name] for name in ROBOTS), within_s=STOP_S)
        await here.children.end(found[SITE], within_s=STOP_S)
        logs = here.logs()
    gap_s, fresh_s = pause(logs["/robot1/pose"], at_ns, again_ns)
    row = {"gap_s": gap_s, "fresh_s": fresh_s, "other_robot_gap_s": pause(logs["/robot2/pose"], at_ns, again_ns)[0]}
    if case.number is signal.SIGSTOP:
        row["gap_when_it_goes_on_s"] = max(pause(logs[f"/{robot}/pose"], again_ns, until_ns)[0] for robot in ROBOTS)
    fates = [fate(logs[f"/{robot}/log"]) for robot in ROBOTS]
    row["lost_count"] = sum(each.lost for each in fates)
    row["doubled_count"] = sum(each.doubled + each.swapped for each in fates)
    return row


def measure(case: Case, out_s: float) -> dict[str, float]:
    return asyncio.run(play(case, out_s))


def bench(options: argparse.Namespace, report: Report) -> None:
    rounds, out_s = repetitions(options, usual=(5, 10.0), quick=(1, 6.0))
    found = interleaved({name: partial(measure, case, out_s) for name, case in CASES.items()}, rounds)
    for name, rows in found.items():
        report.row(CASE, name, **medians(rows))
        case = CASES[name]
        report.reach(f"{name}: {case.wanted}, the worst", max(row[case.metric] for row in rows), case.limit_s)
    wrong = sum(row["lost_count"] + row["doubled_count"] for rows in found.values() for row in rows)
    report.reach("relays and routers that fail: reliable messages lost or doubled", wrong, 0)
    report.note(f"failures: {rounds} rounds of {out_s:g} s; routers are zenoh's, of its Python package")
