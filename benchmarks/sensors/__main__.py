"""A scan (8 Hz), a camera (11.9 Hz, VGA) and clouds of 7.4 MB (12 Hz) over 25 Mbit/s, 20±10 ms, .5 % loss, 1 %
reordering, .1 % duplicates, made by tc netem, as in Arm's study "Tune Zenoh for ROS 2". Needs root.

systems: sern (the installed daemons with CURVE and the datagram lane, configured by robot.yaml beside this),
zenoh (as it comes), zenoh-tuned-bbr (priorities, express for the scan, two connections, BBR)
"""

import argparse
import asyncio
import importlib.util
import sys
import tempfile
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
import psutil

from benchmarks import common
from benchmarks.link import runs
from benchmarks.link.sern import RELAY_PORT
from benchmarks.sensors import WIFI, figures
from benchmarks.sensors.bodies import Sensor
from benchmarks.sensors.ends import ALL, OUR_PORT, SERN, THEIR_PORT, ZENOH_TUNED, Spec
from sern_core.vocabulary.errors import SernError
from sern_runtime.config.yaml import read_document
from sern_tools.harness.files import client_content, write
from sern_tools.harness.processes import Child, Children, killed
from sern_tools.keygen import make_keys
from sern_tools.lab.lab import Lab

EXAMPLE: Final = Path(__file__).resolve().parent / "robot.yaml"
"""What the robot is configured by, but for addresses."""
WARM_S: Final = 3.0
CASE: Final = "25 Mbit/s 20±10 ms"


def robot_content(address: str, our_port: int = OUR_PORT, their_port: int = THEIR_PORT) -> dict[str, Any]:
    """The example, with the relay of this run, and the ports at which sensors and daemon find each other."""
    content = cast(dict[str, Any], read_document(EXAMPLE).data)
    content["relay"]["endpoint"] = address
    content["endpoint"] |= endpoint(our_port, their_port)
    return content


def endpoint(our_port: int, their_port: int) -> dict[str, Any]:
    return {"connect": [f"tcp/127.0.0.1:{our_port}"], "listen": [f"tcp/127.0.0.1:{their_port}"]}


def site_content(address: str, our_port: int = OUR_PORT, their_port: int = THEIR_PORT) -> dict[str, Any]:
    """A site that takes everything of the robot."""
    section = {"kind": "zenoh", **endpoint(our_port, their_port)}
    return client_content("site", address, section, subscribe=["/robot/.*"])


async def play(lab: Lab, system: str, duration_s: float, directory: Path) -> figures.Outcome:
    """One run; `directory` must be empty. SernError when an end does not work."""
    lab.reset()
    lab.link(WIFI, WIFI)
    runs.congestion(lab, "bbr" if system == ZENOH_TUNED else "cubic")
    async with killed(directory) as children:
        between = []
        if system == SERN:
            make_keys(directory, "relay", "robot", "site")
            address = f"tcp://{lab.b.address}:{RELAY_PORT}"
            between.append(await runs.start_relay(children, lab.b, udp=True))
            for node, name, content in (
                (lab.b, "site", site_content(address)),
                (lab.a, "robot", robot_content(address)),
            ):
                config = write(directory, f"{name}-daemon", content)
                between.append(await runs.start_daemon(children, node, "client", config))
        ends = []
        for sends, node in ((False, lab.b), (True, lab.a)):
            spec = Spec(system, sends, lab.b.address, str(directory), duration_s)
            ends.append(await runs.start_program(children, node, spec.role, "benchmarks.sensors.ends", asdict(spec)))
        return await measure(children, system, ends, between, duration_s, directory)


async def measure(
    children: Children, system: str, ends: list[Child], between: list[Child], duration_s: float, directory: Path
) -> figures.Outcome:
    """Play the load between ends (the site's first) that are started."""
    site, robot = ends
    for end in (robot, site):
        problem = f"{end.name}: nothing got through; it was not ready"
        await children.within(runs.until_ready(end), runs.START_S, problem)
    start_ns = time.monotonic_ns() + int(runs.LEAD_S * 1e9)
    await robot.say(f"go {start_ns}")
    await runs.sleep_until(start_ns)
    before = children.cpu_s()
    end_ns = start_ns + int(duration_s * 1e9)
    await runs.sleep_until(end_ns)
    children.check()
    after = children.cpu_s()
    await children.end(site, robot, number=None, within_s=runs.STOP_S)
    await children.end(*between, within_s=runs.STOP_S)
    begin_ns = start_ns + int(min(WARM_S, duration_s / 3) * 1e9)
    cpu = {name: 100 * (after[name] - before[name]) / duration_s for name in after}
    offered, arrived = (np.load(directory / f"{role}.npy") for role in ("robot", "site"))
    return figures.Outcome(system, offered, arrived, begin_ns, end_ns, cpu)


def report_of(outcomes: list[figures.Outcome], report: common.Report) -> None:
    """The rows, sensor by sensor, and what was set out for SERN."""
    for sensor in Sensor:
        for outcome in outcomes:
            report.row(f"{CASE}: {sensor.name.lower()}", outcome.system, **figures.metrics(outcome, sensor))
    for outcome in outcomes:
        cpu = {f"{name.replace('-', '_')}_cpu_percent": value for name, value in outcome.cpu_percent.items()}
        report.row(f"{CASE}: processes", outcome.system, **cpu)
        if outcome.system == SERN:
            for name, value, limit, at_least in figures.reaches(outcome):
                report.reach(f"{CASE}, {SERN}: {name}", value, limit, at_least=at_least)


def bench(options: argparse.Namespace, report: common.Report) -> None:
    if importlib.util.find_spec("zenoh") is None:
        raise SernError("the sensors and what is beside SERN need zenoh: pip install eclipse-zenoh")
    note = common.try_realtime()  # all that is started inherits the priority
    duration_s = 20.0 if options.quick else 60.0
    outcomes = []
    psutil.cpu_percent()
    with tempfile.TemporaryDirectory(prefix="sern-bench-") as temporary, Lab() as lab:
        for system in options.systems or ALL:
            directory = Path(temporary) / system
            directory.mkdir()
            outcomes.append(asyncio.run(play(lab, system, duration_s, directory)))
        report.note(f"lab: {lab.backend}; {note}; {duration_s:g} s each, without the first {WARM_S:g}")
    report.note(f"the machine's processors were {psutil.cpu_percent():.0f} % busy in the mean")
    report_of(outcomes, report)


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--systems", nargs="+", choices=ALL, help="these alone")


def main() -> int:
    return common.main("sensors", bench, description=__doc__, arguments=_arguments)


if __name__ == "__main__":
    sys.exit(main())
