"""ROS 2 to ROS 2 over DDS: what a bridge adds in latency and costs in CPU.

A Fast DDS peer publishes odometry (1 kHz) and clouds (1 MB at 20 Hz), reliable; another takes both behind the bridge.

    direct             no bridge: both peers in one domain
    sern-chain         what a user runs: sern-client, sern-relay, sern-client (CURVE), from one domain to another
    sern-in-process    two endpoints in one process, from one domain to another: what the endpoints alone cost
    DdsEndpoint+zenoh  two processes joined by zenoh (TCP), each with our own DDS endpoint, from one domain to another

The last stands for a zenoh bridge of DDS, which is a program of its own that no package index of Python or Debian has:
the same zenoh, and at its ends the same Cyclone DDS with bodies unread, but hand-overs in Python. Only the chain
encrypts, schedules and acknowledges. Everything is on loopback. CPU is that of all processes in between.
"""

import argparse
import asyncio
import statistics
import time
from contextlib import AsyncExitStack
from functools import partial
from pathlib import Path
from random import Random
from typing import Any, Final

import numpy as np

from benchmarks import child, common
from benchmarks.common import MissingError
from benchmarks.endpoints import shared
from benchmarks.endpoints.dds_roles import DEPTHS, TYPES
from benchmarks.endpoints.shared import ALONE, CHAIN, DIRECT, HOST, START_S, Figures
from sern_core.vocabulary.errors import SernError
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_types
from sern_tools.harness.processes import Child, Children, cpu_s, python
from sern_tools.ports import free_ports
from tests.peers.dds.peer import Peer, PeerError, build_peer, free_domain, missing_packages

MEASURE_S: Final = 8.0
QUICK_S: Final = 3.0
LATE_S: Final = 1.0
"""Messages are lost when after the last one nothing arrives for so long."""
WARM_SHARE: Final = 0.2
"""This much of each run is not counted: connections, caches and the schedulers settle."""
RATES_HZ: Final = {"odom": 1000, "cloud": 20}
CLOUD_BYTES: Final = 1_000_000
ZENOH: Final = "DdsEndpoint+zenoh"
SYSTEMS: Final = (DIRECT, CHAIN, ALONE, ZENOH)
CASE: Final = "dds 1 kHz + 20 MB/s"
LATENCY_LIMIT_MS: Final = 1.0
_DDS: Final = {"odom": "nav_msgs::msg::dds_::Odometry_", "cloud": "sensor_msgs::msg::dds_::PointCloud2_"}


def _body(name: str) -> bytes:
    fields: dict[str, Any] = {}
    if name == "cloud":
        fields["data"] = np.frombuffer(Random(1).randbytes(CLOUD_BYTES), dtype="uint8")
    type_name = TYPES[f"/bench/{name}"]
    return ros_types.serialise(ros_types.new(type_name, Encoding.CDR, **fields), type_name, Encoding.CDR)


async def _role(children: Children, role: str, *arguments: str) -> Child:
    command = python("-m", "benchmarks.endpoints.dds_roles", role, *arguments)
    return await children.start(role, command, environment=child.environment())


async def _between(children: Children, system: str, source: int, target: int) -> list[Child]:
    """The bridge from one domain to another."""
    if system == CHAIN:
        endpoints = {
            name: {"kind": "dds", "domain": domain, "localhost_only": True}
            for name, domain in ((shared.ROBOT, source), (shared.SITE, target))
        }
        return await shared.start_chain(children, endpoints, {}, reliability="reliable")
    if system == ALONE:
        return [await _role(children, "bridge", str(source), str(target))]
    if system == ZENOH:
        locator = f"tcp/{HOST}:{free_ports(1)[0]}"
        listener = await _role(children, "from-zenoh", str(target), locator)
        return [listener, await _role(children, "to-zenoh", str(source), locator)]
    return []


async def _delays_ms(sink: Peer, name: str, expected: int) -> list[float]:
    """Latency from publishing to arrival of all messages that arrive, in their order."""
    delays_ms: list[float] = []
    for number in range(expected):
        await sink.do(f"stats {name}")
        words = await sink.line(f"stats {name} ", number)
        fresh = [int(text) / 1e6 for text in words[3].split(",") if text]
        delays_ms += fresh
        if len(delays_ms) >= expected or (number and not fresh):
            break
        await asyncio.sleep(LATE_S)
    return delays_ms


async def _through(children: Children, stack: AsyncExitStack, system: str, program: Path, measure_s: float) -> Figures:
    source_domain = free_domain()
    target_domain = source_domain if system == DIRECT else free_domain()
    bodies = {name: _body(name).hex() for name in _DDS}
    patience_s = measure_s + START_S
    source = await stack.enter_async_context(Peer(program, source_domain, deadline_s=patience_s))
    sink = await stack.enter_async_context(Peer(program, target_domain, deadline_s=patience_s))
    for name, kind in _DDS.items():
        topic = f"rt/bench/{name} {kind} reliable"
        await source.do(f"pub {name} {topic} depth={DEPTHS[f'/bench/{name}']}")
        await sink.do(f"sub {name} {topic} quiet depth={DEPTHS[f'/bench/{name}']}")
    pids = [each.process.pid for each in await _between(children, system, source_domain, target_domain)]

    async def matched() -> None:
        for name in _DDS:
            await source.line(f"matched {name} 1")
            await sink.line(f"matched {name} 1")

    await children.within(matched(), START_S, "the Fast DDS peers did not find each other")
    # A daemon says that somebody wants a topic some time after it is there.
    await asyncio.sleep(1.0)
    before_s, began_s = cpu_s(*pids), time.monotonic()
    for name, body in bodies.items():
        await source.do(f"flood {name} {body} {RATES_HZ[name]} {round(RATES_HZ[name] * measure_s)}")

    async def flooded() -> None:
        for name in bodies:
            await source.line(f"flooded {name}")

    await children.within(flooded(), patience_s, "not everything could be published")
    took_s = time.monotonic() - began_s
    found: Figures = {}
    for name, rate_hz in RATES_HZ.items():
        expected = round(rate_hz * measure_s)
        delays_ms = await _delays_ms(sink, name, expected)
        settled = sorted(delays_ms[round(len(delays_ms) * WARM_SHARE) :])
        if not settled:
            raise SernError(f"nothing of {name} arrived")
        found[f"{name}_p50_ms"] = statistics.median(settled)
        found[f"{name}_p99_ms"] = settled[int(0.99 * (len(settled) - 1))]
        found[f"{name}_lost"] = expected - len(delays_ms)
    # A bridge that is behind works on after the last message is published: that counts as well.
    return {**found, "cpu_percent": 100 * (cpu_s(*pids) - before_s) / took_s}


async def _measured(system: str, program: Path, measure_s: float) -> Figures:
    try:
        async with shared.started() as children, AsyncExitStack() as stack:
            return await children.beside(_through(children, stack, system, program, measure_s))
    except (PeerError, SernError) as error:
        raise SernError(f"dds, {system}: {error}") from error
    except TimeoutError as error:
        raise SernError(f"dds, {system}: a Fast DDS peer does not answer") from error


def measure(system: str, program: Path, measure_s: float) -> Figures:
    """One run of one system."""
    return asyncio.run(_measured(system, program, measure_s))


def bench(options: argparse.Namespace, report: common.Report) -> None:
    """MissingError where the peer cannot be built."""
    if missing := missing_packages():
        raise MissingError(f"needs the Debian packages {' '.join(missing)}")
    systems = list(SYSTEMS)
    try:
        shared.zenoh_folder()
    except MissingError as error:
        systems.remove(ZENOH)
        report.note(f"dds without {ZENOH}: {error}")
    program = build_peer()
    measure_s = QUICK_S if options.quick else MEASURE_S
    runs = {system: partial(measure, system, program, measure_s) for system in systems}
    found = shared.bench_rounds(report, CASE, runs, options.rounds)
    report.note("dds: reliable on both sides, messages of 700 bytes and of 1 MB between processes of this host")
    if ZENOH in systems:
        times = found.times(CHAIN, ZENOH, "cpu_percent")
        report.note(f"dds {CHAIN}: {times:.1f} times the CPU of {ZENOH}, which neither encrypts nor schedules")
    for system, where in ((CHAIN, "dds"), (ALONE, "dds, in one process")):
        shared.reach_added(report, where, found, system, LATENCY_LIMIT_MS)
        report.reach(f"{where}: odometry lost", found.figures(system)["odom_lost"], 0)
