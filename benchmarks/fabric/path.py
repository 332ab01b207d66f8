"""One hop between two relays, path level: two processes with a link and a port each, over a thin path of tc netem."""

import argparse
import asyncio
import json
import os
import sys
import tempfile
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Final

from benchmarks.common import MissingError, Report, interleaved, medians, repetitions
from benchmarks.fabric.hop_end import VARIANTS, certificates
from benchmarks.fabric.rivals import NATS
from benchmarks.link.figures import AT, KIND, NUMBER, SIZE, STAMP, quantile
from benchmarks.link.load import Kind, Load, Spec, read_log
from benchmarks.link.runs import DRAIN_S, LEAD_S, START_S, STOP_S, congestion, sleep_until, start_program, until_ready
from sern_runtime import clock
from sern_sim.models import LinkModel
from sern_tools.harness.processes import killed
from sern_tools.lab.backends import choose
from sern_tools.lab.host import LabError
from sern_tools.lab.lab import Lab

RATE_BPS: Final = 8e6
MODEL: Final = LinkModel(rate_bps=RATE_BPS, delay_s=0.010, queue_packets=100)
LOAD: Final = Load(cloud_bytes=42_500, cloud_hz=50.0, maps=False)
"""17 Mbit/s of bulk."""
WARM_S: Final = 5.0
SYSTEMS: Final = (*VARIANTS, "zenoh", "nats leaf")
THIN: Final = "8 Mbit/s, 20 ms"
STEP: Final = "down to 1 Mbit/s for 5 s"
LOSSY: Final = "1 % lost"
CASES: Final[dict[str, tuple[LinkModel, tuple[tuple[float, float], ...]]]] = {
    THIN: (MODEL, ()),
    STEP: (MODEL, ((8.0, 1e6), (13.0, RATE_BPS))),
    LOSSY: (replace(MODEL, loss=0.01), ()),
}
"""The link of each case, and its rate from some seconds on."""
P50_MS: Final = 30.0
P99_MS: Final = 60.0
SHARE_PERCENT: Final = 65.0


async def play(lab: Lab, case: str, system: str, duration_s: float, directory: Path) -> dict[str, float]:
    """One run; `directory` is empty."""
    certificates(directory)
    model, steps = CASES[case]
    lab.reset()
    lab.link(model, model)
    congestion(lab, "cubic")
    async with killed(directory) as children:
        ends = []
        for sends, node in ((False, lab.b), (True, lab.a)):
            spec = Spec(system, sends, lab.b.address, node.address, str(directory), duration_s, asdict(LOAD))
            ends.append(await start_program(children, node, spec.role, "benchmarks.fabric.end", asdict(spec)))
        site, robot = ends
        for end in (robot, site):
            await children.within(until_ready(end), START_S, f"{end.name}: nothing got through")
        start_ns = round(1e9 * (clock.now() + LEAD_S))
        await robot.say(f"go {start_ns}")
        await sleep_until(start_ns)
        cpu_before = children.cpu_s()
        for at_s, rate_bps in steps:
            await sleep_until(start_ns + round(1e9 * at_s))
            lab.change(rate_bps=rate_bps)
        await sleep_until(start_ns + round(1e9 * duration_s))
        children.check()
        cpu_after = children.cpu_s()
        await sleep_until(start_ns + round(1e9 * (duration_s + DRAIN_S)))
        await children.end(site, robot, number=None, within_s=STOP_S)
    return _row(directory, start_ns, duration_s, {name: cpu_after[name] - cpu_before[name] for name in cpu_after})


def _row(directory: Path, start_ns: int, duration_s: float, cpu_s: dict[str, float]) -> dict[str, float]:
    from_ns, until_ns = start_ns + round(1e9 * WARM_S), start_ns + round(1e9 * duration_s)
    offered, arrived = (read_log(directory / f"{role}.npy") for role in ("robot", "site"))
    arrived, offered = (rows[rows[:, STAMP] >= from_ns] for rows in (arrived, offered))
    poses = arrived[arrived[:, KIND] == Kind.POSE]
    bulk = arrived[(arrived[:, KIND] == Kind.BULK) & (arrived[:, AT] < until_ns)]
    latencies_ms = (poses[:, AT] - poses[:, STAMP]) / 1e6
    ends = [json.loads((directory / f"{role}.json").read_text()) for role in ("robot", "site")]
    lost = {"datagrams_lost_count": ends[0]["port"]["sent"] - ends[1]["port"]["received"]} if all(ends) else {}
    wanted = len(offered[offered[:, KIND] == Kind.POSE])
    return {
        "control_p50_ms": quantile(latencies_ms, 0.5),
        "control_p99_ms": quantile(latencies_ms, 0.99),
        "control_arrives_percent": 100 * len(set(poses[:, NUMBER].tolist())) / wanted,
        "bulk_percent": 100 * 8 * float(bulk[:, SIZE].sum()) / (duration_s - WARM_S) / RATE_BPS,
        "robot_cpu_percent": 100 * cpu_s["robot"] / duration_s,
        "site_cpu_percent": 100 * cpu_s["site"] / duration_s,
        **lost,
    }


def bench(options: argparse.Namespace, report: Report) -> None:
    """All systems over the thin path, and those with a link over one that changes and one that loses packets.

    Raises MissingError where there is no such path to be had: it needs root.
    """
    rounds, duration_s = repetitions(options, usual=(3, 35.0), quick=(1, 15.0))
    systems = [name for name in options.systems or SYSTEMS if name != "nats leaf" or NATS is not None]
    chosen = [
        (case, system) for case in options.cases or CASES for system in systems if case == THIN or system in VARIANTS
    ]
    try:
        choose(f"{os.getpid()}")
    except LabError as error:
        raise MissingError(str(error)) from None
    if NATS is None:
        report.note("no row of NATS: nats-server is not installed (Debian's package nats-server)")
    with tempfile.TemporaryDirectory(prefix="sern-fabric-") as temporary, Lab() as lab:
        folders = iter(Path(temporary) / str(number) for number in range(rounds * len(chosen)))

        def measure(case: str, system: str) -> dict[str, float]:
            folder = next(folders)
            folder.mkdir()
            row = asyncio.run(play(lab, case, system, duration_s, folder))
            if options.verbose:
                print(
                    case,
                    system,
                    row,
                    *(path.read_text() for path in folder.glob("*.json")),
                    file=sys.stderr,
                    flush=True,
                )
            return row

        found = interleaved({f"{case}: {system}": partial(measure, case, system) for case, system in chosen}, rounds)
    for case, system in chosen:
        report.row(case, system, **medians(found[f"{case}: {system}"]))
    if (THIN, "fabric") in chosen:
        for metric, limit in (("control_p50_ms", P50_MS), ("control_p99_ms", P99_MS)):
            report.reach(f"{THIN}: {metric}", report.value(THIN, "fabric", metric), limit)
        share = report.value(THIN, "fabric", "bulk_percent")
        report.reach(f"{THIN}: bulk, % of the link", share, SHARE_PERCENT, at_least=True)
    report.note(f"path: {rounds} rounds of {duration_s:g} s, the first {WARM_S:g} s not counted; medians; cubic")
