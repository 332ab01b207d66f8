"""The twin over a real link, by profile of the link.

A robot that follows its plan, relay and sern-twin run as their user runs them, with keys, over `tc netem` in the lab.

The robot drives at about 0.7 m/s and knows where it is by a localisation that is off by 1 cm in each axis (one sigma).
Both daemons say over HTTP where the robot truly is and where its twin is shown; the truth is interpolated to the moment
at which the twin was asked for. Needs root.
"""

import argparse
import asyncio
import math
import sys
import tempfile
import time
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, NamedTuple

from benchmarks.common import Report, main, percentile, try_realtime
from benchmarks.link.runs import START_S, STOP_S, start_daemon, start_relay
from benchmarks.link.sern import RELAY_PORT
from sern_core.vocabulary.errors import SernError
from sern_runtime.profiles import load_profile
from sern_tools.api import get_json
from sern_tools.harness.files import client_content, write
from sern_tools.harness.processes import killed
from sern_tools.keygen import make_keys
from sern_tools.lab.lab import Lab, Node

ROBOT, TWIN = "robot", "twin"
POSE, PLAN = f"/{ROBOT}/odometry/filtered", f"/{ROBOT}/plan"
PORTS: Final = {ROBOT: 8080, TWIN: 8081}
PROFILES: Final = ("wifi", "field-wifi", "lte", "satcom", "mesh-radio", "burst-loss")
RUN_S, QUICK_S = 60.0, 10.0
SETTLES_S: Final = 5.0
LOOK_S: Final = 0.05
REACH_CM: Final = 5.0


class Seen(NamedTuple):
    at_s: float
    truth: tuple[float, float, float]
    twin_at_s: float
    shown: tuple[float, float, float]
    age_s: float
    bound_m: float


def files(directory: Path, address: str, *, planned: bool) -> tuple[Path, Path]:
    """The files of robot and twin. `planned`: the twin has the robot's plan."""
    robot = {
        "kind": "synthetic",
        "role": "robot",
        "follow": True,
        "topics": ["/odometry/filtered"],
        "pose_rate_hz": 20.0,
        "encoding": "cdr",
    }
    robots = [{"name": ROBOT, "pose": POSE, "max_speed_mps": 1.5, **({"plan": PLAN} if planned else {})}]
    rules = [
        {"match": "/odometry/filtered", "class": "control", "reliability": "best_effort"},
        {"match": "/plan", "class": "state", "reliability": "reliable", "durability": "transient_local"},
    ]
    at = f"tcp://{address}:{RELAY_PORT}"
    http = {name: {"listen": f"127.0.0.1:{port}"} for name, port in PORTS.items()}
    twin = {"kind": "twin", "robots": robots}
    return (
        write(directory, ROBOT, client_content(ROBOT, at, robot, topics=rules, http=http[ROBOT])),
        write(directory, TWIN, client_content(TWIN, at, twin, client={"namespace": "/"}, http=http[TWIN])),
    )


def _ask(node: Node, name: str, path: str) -> Any:
    return node.inside(lambda: get_json(f"http://127.0.0.1:{PORTS[name]}", path))


def look(lab: Lab) -> Seen | None:
    """None: the twin has not heard the robot."""
    begin_s = time.monotonic()
    truth = _ask(lab.a, ROBOT, "/api/robot")
    between_s = time.monotonic()
    twin = _ask(lab.b, TWIN, "/api/twins")[ROBOT]
    end_s = time.monotonic()
    if twin["pose"] is None:
        return None
    return Seen(
        (begin_s + between_s) / 2,
        tuple(truth["pose"]),
        (between_s + end_s) / 2,
        tuple(twin["pose"]),
        twin["age_s"],
        twin["error_m"],
    )


async def play(lab: Lab, directory: Path, profile: str, duration_s: float, *, planned: bool) -> list[Seen]:
    make_keys(directory, "relay", ROBOT, TWIN)
    link = load_profile(profile)
    lab.reset()
    lab.link(link.up, link.down)
    robot, twin = files(directory, lab.b.address, planned=planned)
    async with killed(directory) as children:
        relay = await start_relay(children, lab.b, udp=True)
        twin_daemon = await start_daemon(children, lab.b, "client", twin)
        robot_daemon = await start_daemon(children, lab.a, "client", robot)
        ready = partial(_follows, lab, "trajectory" if planned else "acceleration")
        await children.until(ready, START_S, f"{profile}: the twin does not hear the robot")
        await asyncio.sleep(SETTLES_S)
        seen: list[Seen] = []
        until_s = time.monotonic() + duration_s
        while time.monotonic() < until_s:
            children.check()
            each = look(lab)
            if each is not None:
                seen.append(each)
            await asyncio.sleep(LOOK_S)
        for daemon in (robot_daemon, twin_daemon, relay):
            await children.end(daemon, within_s=STOP_S)
    return seen


async def _follows(lab: Lab, by: str) -> bool:
    try:
        said = _ask(lab.b, TWIN, "/api/twins")[ROBOT]
    except SernError:
        return False  # it does not listen yet
    return bool(said["pose"] is not None and said["goes_by"] == by)


def errors(seen: list[Seen]) -> tuple[list[float], list[float]]:
    """Metres and degrees that the twin was off, where the truth before and after is known."""
    off_m, off_deg = [], []
    for before, after in pairwise(seen):
        share = (before.twin_at_s - before.at_s) / (after.at_s - before.at_s)
        x_m, y_m = (a + share * (b - a) for a, b in zip(before.truth[:2], after.truth[:2], strict=True))
        turn_rad = math.remainder(after.truth[2] - before.truth[2], math.tau)
        off_m.append(math.dist((x_m, y_m), before.shown[:2]))
        off_deg.append(
            abs(math.degrees(math.remainder(before.truth[2] + share * turn_rad - before.shown[2], math.tau)))
        )
    return sorted(off_m), sorted(off_deg)


def measure(options: argparse.Namespace, report: Report) -> None:
    note = try_realtime()
    duration_s = QUICK_S if options.quick else RUN_S
    with tempfile.TemporaryDirectory(prefix="sern-sync-") as temporary, Lab() as lab:
        for profile in PROFILES[:2] if options.quick else PROFILES:
            for planned in (True, False):
                directory = Path(temporary) / f"{profile}-{planned}"
                directory.mkdir()
                seen = asyncio.run(play(lab, directory, profile, duration_s, planned=planned))
                off_m, off_deg = errors(seen)
                p95_cm = 100 * percentile(off_m, 0.95)
                report.row(
                    f"the lab's link: {profile}", "with the robot's plan" if planned else "without a plan",
                    median_cm=100 * percentile(off_m, 0.5), p95_cm=p95_cm, p95_deg=percentile(off_deg, 0.95),
                    age_p95_ms=1e3 * percentile(sorted(each.age_s for each in seen), 0.95),
                    bound_median_cm=100 * percentile(sorted(each.bound_m for each in seen), 0.5),
                )  # fmt: skip
                if planned:
                    report.reach(f"{profile}: p95 of what is shown, cm", p95_cm, REACH_CM)
        report.note(f"lab: {lab.backend}; {note}; {duration_s:g} s a run; poses 20 times a second, about 0.7 m/s")


if __name__ == "__main__":
    about = __doc__.splitlines()[0] if __doc__ else None
    sys.exit(main("sync_lab", measure, description=about))
