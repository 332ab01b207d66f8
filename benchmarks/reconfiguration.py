"""A stream that comes while others go, and is taken away again, between two ROS masters (fig:runtime_reconfig_demo).

Two rospy nodes publish point clouds at one master, and a third begins at 2 s and is ended at 8 s. Relay and clients are
the installed daemons with keys, which find topics by themselves; a rospy node at the other master takes all three.

    detected   from the new node's registration at its master until the bridge has the topic at the other one
    forwarded  from then until the first message is there
    removed    from the node's end until the topic is gone from the other master
    longest    pause of a stream that was there before, over its period: nothing of it is to be interrupted

Beside them the load of the bridge, CPU of its three processes in tenths of a second, over its mean with two streams.
"""

import argparse
import asyncio
import sys
import time
from collections.abc import Mapping, Sequence
from itertools import pairwise
from statistics import fmean
from typing import Any, Final, NamedTuple

from benchmarks import child, recordings
from benchmarks.common import MissingError, Report, half_width_95, main, medians, repetition_arguments, repetitions
from benchmarks.endpoints import ros1
from benchmarks.endpoints.shared import HOST, ROBOT, SITE, START_S, said, start_chain
from benchmarks.paper.published import BEGIN_S, DETECTED_S, END_S, FORWARDED_S, REMOVED_S
from sern_client.endpoints.ros1.xmlrpc import CallError, XmlRpcClient
from sern_core.vocabulary.errors import SernError
from sern_tools.harness.processes import Child, cpu_s

CLOUD_BYTES: Final = 100_000
RATE_HZ: Final = 10.0
FIRST: Final = ("/bench/robot1/points", "/bench/robot2/points")
NEW: Final = "/bench/robot3/points"
SETTLE_S: Final = 2.0
WHOLE_S: Final = 12.0
LOOK_S: Final = 0.01
BIN_S: Final = 0.1
GONE_S: Final = 30.0
PAPER: Final = {"detected_s": DETECTED_S, "forwarded_s": FORWARDED_S, "removed_s": REMOVED_S}


class Arrival(NamedTuple):
    """A message at the other master; times of this host's monotonic clock."""

    topic: str
    sent_s: float
    at_s: float


class Outcome(NamedTuple):
    """One run: its figures, and the load by time in seconds since its beginning."""

    figures: dict[str, float]
    load: list[tuple[float, float]]


async def _topics(master: XmlRpcClient) -> set[str]:
    """The topics that somebody publishes at a master."""
    state: Any = await master.call("getSystemState", "/bench")
    return {str(name) for name, _nodes in state[0]}


async def _until(master: XmlRpcClient, topic: str, *, there: bool) -> float:
    """When a topic is published at a master, or is no more."""
    while (topic in await _topics(master)) is not there:  # noqa: ASYNC110  the master's state
        await asyncio.sleep(LOOK_S)
    return time.monotonic()


async def _arrivals(watcher: Child, found: list[Arrival]) -> None:
    while True:
        told = await watcher.read_object()
        if "topic" in told:
            found.append(Arrival(told["topic"], told["sent_ns"] / 1e9, told["at_ns"] / 1e9))


async def _loads(pids: Sequence[int], began_s: float, found: list[tuple[float, float]]) -> None:
    """CPU of the bridge, in cores, by the middle of each bin."""
    before_s, before = time.monotonic(), cpu_s(*pids)
    while True:
        await asyncio.sleep(BIN_S)
        now_s, now = time.monotonic(), cpu_s(*pids)
        found.append(((before_s + now_s) / 2 - began_s, (now - before) / (now_s - before_s)))
        before_s, before = now_s, now


async def _first(arrivals: Sequence[Arrival], topic: str) -> float:
    while True:
        for arrival in arrivals:
            if arrival.topic == topic:
                return arrival.at_s
        await asyncio.sleep(LOOK_S)


async def _chain(ros: ros1.Ros, master: str, other: str) -> list[Child]:
    """Start relay and clients from one master to another; whatever is a cloud comes along."""
    endpoints = {
        name: {"kind": "ros1", "master_uri": uri, "host": HOST} for name, uri in ((ROBOT, master), (SITE, other))
    }
    rules = {ROBOT: {"topics": [{"match": ".*/points", "class": "state"}]}}
    return await start_chain(ros.children, endpoints, ros.environment(""), sections=rules)


async def _stream(ros: ros1.Ros, master: str, topic: str) -> Child:
    """A node that publishes clouds, and has said so to its master."""
    points = ros.children.directory / "points"
    if not points.exists():
        points.write_bytes(recordings.points(CLOUD_BYTES))
    command = [ros1.DEBIAN_PYTHON, "-m", "benchmarks.endpoints.rospy_roles", "clouds", str(points), str(RATE_HZ)]
    name = topic.split("/")[-2]
    environment = {**ros.environment(master), "PYTHONPATH": str(child.ROOT)}
    process = await ros.children.start(name, [*command, topic], talks=True, environment=environment)
    await said(process, "ready")
    return process


def longest_pause(arrivals: Sequence[Arrival], topic: str, from_s: float, to_s: float) -> float:
    """The longest time between two messages of a topic in that time, less their period, in seconds."""
    times = [arrival.at_s for arrival in arrivals if arrival.topic == topic and from_s <= arrival.at_s <= to_s]
    if len(times) < 2:
        raise SernError(f"{topic} has stopped: {len(times)} messages in {to_s - from_s:.0f} s")
    return max(after - before for before, after in pairwise(times)) - 1.0 / RATE_HZ


async def _play(ros: ros1.Ros) -> Outcome:
    here, there = await ros.master(), await ros.master()
    daemons = await _chain(ros, here, there)
    other = XmlRpcClient(there)
    tasks: list[asyncio.Task[None]] = []
    try:
        for topic in FIRST:
            await _stream(ros, here, topic)
        arrivals: list[Arrival] = []
        load: list[tuple[float, float]] = []
        watcher = await ros.rospy("watch", there, *FIRST, NEW, typed=False)
        tasks.append(asyncio.create_task(_arrivals(watcher, arrivals)))
        for topic in FIRST:
            await ros.children.within(_first(arrivals, topic), START_S, f"{topic} does not come through")
        await asyncio.sleep(SETTLE_S)
        began_s = time.monotonic()
        pids = [each.process.pid for each in daemons]
        tasks.append(asyncio.create_task(_loads(pids, began_s, load)))
        await asyncio.sleep(BEGIN_S)
        seeing = asyncio.create_task(_until(other, NEW, there=True))
        new = await _stream(ros, here, NEW)
        registered_s = time.monotonic()
        detected_s = await ros.children.within(seeing, START_S, f"{NEW} was not found")
        forwarded_s = await ros.children.within(_first(arrivals, NEW), START_S, f"{NEW} does not come through")
        await asyncio.sleep(max(0.0, began_s + END_S - time.monotonic()))
        ended_s = time.monotonic()
        await ros.children.stop([new], within_s=GONE_S)
        removed_s = await ros.children.within(_until(other, NEW, there=False), GONE_S, f"{NEW} did not go")
        await asyncio.sleep(max(0.0, began_s + WHOLE_S - time.monotonic()))
        until_s = time.monotonic()
    except CallError as error:
        raise SernError(f"a master: {error}") from error
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        other.close()
    figures = {
        "detected_s": max(0.0, detected_s - registered_s),
        "forwarded_s": forwarded_s - detected_s,
        "removed_s": removed_s - ended_s,
        "longest_s": max(longest_pause(arrivals, topic, began_s, until_s) for topic in FIRST),
        **loads(load, registered_s - began_s, ended_s - began_s),
    }
    return Outcome(figures, load)


def loads(load: Sequence[tuple[float, float]], from_s: float, to_s: float) -> dict[str, float]:
    """The mean load with the new stream and after it, over that before it."""
    margin_s = 1.0
    before = fmean(cores for at_s, cores in load if at_s < from_s)
    during = fmean(cores for at_s, cores in load if from_s + margin_s < at_s < to_s)
    after = fmean(cores for at_s, cores in load if at_s > to_s + margin_s)
    return {"load_during_1": during / before, "load_after_1": after / before, "cpu_percent": 100 * before}


async def _measured() -> Outcome:
    async with ros1.running() as ros:
        return await ros.children.beside(_play(ros))


def measure() -> Outcome:
    """One run."""
    return asyncio.run(_measured())


def curve(outcomes: Sequence[Outcome]) -> list[tuple[float, float]]:
    """The mean load of all runs by time, over that of two streams, in bins."""
    bins: dict[int, list[float]] = {}
    for outcome in outcomes:
        before = outcome.figures["cpu_percent"] / 100
        for at_s, cores in outcome.load:
            bins.setdefault(int(at_s / BIN_S), []).append(cores / before)
    return [((at + 0.5) * BIN_S, fmean(values)) for at, values in sorted(bins.items())]


def summary(runs: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Medians, and half the width of the 95 % interval of the mean of each time."""
    row = medians(runs)
    if len(runs) > 1:
        row |= {name.replace("_s", "_half_s"): half_width_95([run[name] for run in runs]) for name in PAPER}
    return row


def bench(options: argparse.Namespace, report: Report) -> None:
    rounds, _ = repetitions(options, usual=(20, WHOLE_S), quick=(2, WHOLE_S))
    try:
        ros1.need(ros1.ROSMASTER, *ros1.NEEDS[ros1.ROSPY])
    except MissingError as error:
        report.note(f"nothing is measured: it {error}")
        return
    outcomes = [measure() for _ in range(rounds)]
    runs = [outcome.figures for outcome in outcomes]
    report.row("a third stream comes and goes", "SERN", **summary(runs))
    report.row("a third stream comes and goes", "paper", **PAPER)
    for at_s, load in curve(outcomes):
        report.row("load by time, two streams are 1", f"{at_s:.2f} s", load_1=load)
    for name, limit_s in PAPER.items():
        report.reach(f"{name.removesuffix('_s')}, s (paper: {limit_s:g})", summary(runs)[name], limit_s)
    report.note(f"{rounds} runs; clouds of {CLOUD_BYTES:,} bytes at {RATE_HZ:g} Hz, masters and daemons on {HOST}")


if __name__ == "__main__":
    sys.exit(main("reconfiguration", bench, description=__doc__, arguments=repetition_arguments))
