"""ROS 2 to ROS 2 among real rclpy nodes of Jazzy with the default middleware, rmw_fastrtps: what SERN's chain adds.

One node publishes odometry (50 Hz), then clouds (1 MB at 5 Hz), serves a SetBool and an action; another takes and calls
all of that. Both name no quality of service but a depth of 10. Both publish one topic that both hear.

    direct           both in one domain
    sern-chain       what a user runs: sern-client, sern-relay, sern-client (CURVE) from one domain to another, with the
                     endpoints of the shipped Jazzy files: topics through dds, services and actions through rclpy
    sern-in-process  two dds endpoints in one process: topics alone, from one domain to the other
    bare rclpy       the least that a bridge in rclpy can be: one process in both domains, without link, queues and keys

Needs the environment that tests/peers/ros2/setup makes. CPU is that of all processes in between.
"""

import argparse
import asyncio
import json
import sys
import time
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final

from benchmarks import child, common
from benchmarks.common import MissingError
from benchmarks.endpoints import shared
from benchmarks.endpoints.shared import ALONE, CHAIN, DIRECT, START_S, Figures, said
from sern_core.vocabulary.errors import SernError
from sern_tools.harness.processes import Child, Children, cpu_s, python
from tests.peers.dds.peer import free_domain
from tests.peers.ros2.sourced import environment

MEASURE_S: Final = 10.0
QUICK_S: Final = 3.0
LATE_S: Final = 2.0
"""Messages are lost when they are not there so long after the last was published."""
RATES_HZ: Final = {"odom": 50.0, "cloud": 5.0}
TALK_HZ: Final = 20.0
CALLS, QUICK_CALLS = 200, 30
BARE: Final = "bare rclpy"
SYSTEMS: Final = (DIRECT, CHAIN, ALONE, BARE)
CASE: Final = "ros2 50 Hz, then 5 MB/s"
ROLES: Final = Path(__file__).with_name("ros2_roles.py")
LAMP, FIBONACCI = "/bench/lamp", "/bench/fibonacci"
GOAL: Final = ("accepted", "feedback", "result")


class End:
    """A node in a process of its own."""

    def __init__(self, process: Child) -> None:
        self._process = process

    async def do(self, what: str, **details: Any) -> dict[str, Any]:
        """Have it done; its answer. SernError with its words where it cannot."""
        await self._process.say(json.dumps({"do": what, **details}))
        while True:
            answer: dict[str, Any] = await self._process.read_object()
            if "problem" in answer:
                raise SernError(f"{self._process.name} cannot go on: {answer['problem']}")
            if answer.get("answer") == what:
                return answer


async def _role(children: Children, role: str, *domains: int, sourced: Mapping[str, str]) -> Child:
    process = await children.start(
        role, [sys.executable, "-P", str(ROLES), role, *map(str, domains)], talks=True, environment=dict(sourced)
    )
    await children.within(said(process, "ready"), START_S, f"{role} was not ready")
    return process


async def _between(
    children: Children, system: str, source: int, target: int, sourced: Mapping[str, str]
) -> list[Child]:
    if system == ALONE:
        command = python("-m", "benchmarks.endpoints.dds_roles", "bridge", str(source), str(target))
        return [await children.start("bridge", command, environment=child.environment())]
    if system == BARE:
        return [await _role(children, "bridge", source, target, sourced=sourced)]
    if system == DIRECT:
        return []
    endpoints = {
        name: [
            {"kind": "dds", "domain": domain, "localhost_only": True},
            {"kind": "rclpy", "domain": domain, "services_only": True},
        ]
        for name, domain in ((shared.ROBOT, source), (shared.SITE, target))
    }
    topics = [
        {"match": ".*/odom", "class": "control"},
        {"match": ".*/cloud", "class": "bulk"},
        {"match": ".*/talk", "class": "state", "depth": 1000, "many_writers": True},
    ]
    sections: dict[str, dict[str, Any]] = {
        shared.ROBOT: {
            "topics": topics,
            "services": {"offer": [{"match": LAMP}]},
            "actions": {"offer": [{"match": FIBONACCI}]},
            "subscribe": ["/bench/talk"],
        },
        shared.SITE: {
            "topics": topics,
            "services": {"use": [{"match": LAMP}]},
            "actions": {"use": [{"match": FIBONACCI}]},
        },
    }
    return await shared.start_chain(children, endpoints, {}, sections=sections, sourced=sourced)


async def _topics(source: End, sink: End, measure_s: float, *, both_ways: bool) -> Figures:
    counts = {name: round(rate_hz * measure_s) for name, rate_hz in RATES_HZ.items()}
    talks = round(TALK_HZ * measure_s)
    await asyncio.gather(*(end.do("chatter", rate_hz=TALK_HZ, count=talks) for end in (source, sink)))
    for name, count in counts.items():  # not beside each other: a node in Python that takes a cloud does nothing else
        await source.do("send", topic=f"/bench/{name}", rate_hz=RATES_HZ[name], count=count)
    await asyncio.sleep(LATE_S)
    found: Figures = {}
    for name, count in counts.items():
        delays_ms = sorted((await sink.do("delays", topic=f"/bench/{name}"))["ms"])
        if not delays_ms:
            raise SernError(f"nothing of {name} arrived")
        found[f"{name}_p50_ms"] = delays_ms[len(delays_ms) // 2]
        found[f"{name}_p99_ms"] = delays_ms[int(0.99 * (len(delays_ms) - 1))]
        found[f"{name}_lost"] = count - len(delays_ms)
    heard = [await end.do("talked") for end in (source, sink)]
    if both_ways:
        found["talk_lost"] = sum(2 * talks - each["heard"] for each in heard)
    found["talk_doubled"] = sum(each["doubled"] for each in heard)
    return found


async def _services(sink: End, calls: int) -> Figures:
    found: Figures = {}
    await sink.do("calls", count=3)  # the first finds its server
    found["call_p50_ms"] = _median((await sink.do("calls", count=calls))["ms"])
    await sink.do("give", count=3)
    goals = await sink.do("give", count=calls // 4)
    for part in GOAL:
        found[f"goal_{part}_p50_ms"] = _median(goals[f"{part}_ms"])
    found["goal_feedback_lost"] = goals["feedback_lost"]
    return found


def _median(values: list[float]) -> float:
    if not values:
        raise SernError("of all that was asked nothing came back")
    return sorted(values)[len(values) // 2]


async def _through(
    children: Children, system: str, measure_s: float, calls: int, sourced: Mapping[str, str]
) -> Figures:
    source_domain = free_domain()
    target_domain = source_domain if system == DIRECT else free_domain()
    source = End(await _role(children, "source", source_domain, sourced=sourced))
    sink = End(await _role(children, "sink", target_domain, sourced=sourced))
    pids = [each.process.pid for each in await _between(children, system, source_domain, target_domain, sourced)]

    async def matched() -> None:
        while (await source.do("matched"))["count"] < 1:  # each answer comes from another process, which is the pause
            pass

    await children.within(matched(), START_S, "the nodes did not find each other")
    await asyncio.sleep(2.0)  # the topic of both is wanted a moment after it is there
    before_s, began_s = cpu_s(*pids), time.monotonic()
    found = await _topics(source, sink, measure_s, both_ways=system in (DIRECT, CHAIN))
    cpu_percent = 100 * (cpu_s(*pids) - before_s) / (time.monotonic() - began_s)
    if system != ALONE:
        found |= await _services(sink, calls)
    return {**found, "cpu_percent": cpu_percent}


def measure(system: str, measure_s: float, calls: int, sourced: Mapping[str, str]) -> Figures:
    """One run of one system."""

    async def run() -> Figures:
        async with shared.started() as children:
            return await children.beside(_through(children, system, measure_s, calls, sourced))

    try:
        return asyncio.run(run())
    except SernError as error:
        raise SernError(f"ros2, {system}: {error}") from error


def bench(options: argparse.Namespace, report: common.Report) -> None:
    """MissingError where there is no environment with real nodes."""
    try:
        sourced = environment("jazzy")
    except LookupError as error:
        raise MissingError(str(error)) from None
    measure_s, calls = (QUICK_S, QUICK_CALLS) if options.quick else (MEASURE_S, CALLS)
    runs = {system: partial(measure, system, measure_s, calls, sourced) for system in SYSTEMS}
    found = shared.bench_rounds(report, CASE, runs, options.rounds)
    report.note("ros2: rclpy nodes of Jazzy, rmw_fastrtps, default quality of service, on this host")
    ours = found.figures(CHAIN)
    beside_bare = []
    for metric, limit in (
        ("odom_p50_ms", 2.5),
        ("odom_p99_ms", 3.0),
        ("call_p50_ms", 3.0),
        *((f"goal_{part}_p50_ms", 3.0) for part in GOAL),
    ):
        what = metric.removesuffix("_ms").replace("_", " ")
        report.reach(f"ros2: {what}, times that of direct", found.times(CHAIN, DIRECT, metric), limit)
        beside_bare.append(f"{what} {found.times(CHAIN, BARE, metric):.2g}")
    report.note(f"ros2 sern-chain, times a bare bridge in rclpy: {', '.join(beside_bare)}")
    for name in ("odom", "cloud", "talk", "goal_feedback"):
        report.reach(f"ros2: {name.replace('_', ' ')} lost", ours[f"{name}_lost"], 0)
    report.reach("ros2: messages doubled or echoed", ours["talk_doubled"], 0)
