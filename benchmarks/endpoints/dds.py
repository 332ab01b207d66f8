"""ROS 2 to ROS 2 over DDS: what a bridge adds in latency and costs in CPU.

A Fast DDS peer publishes odometry (1 kHz) and clouds (1 MB at 20 Hz), reliable; another takes both behind the bridge.

    direct         no bridge: both peers in one domain
    sern           two endpoints in one process, from one domain to another
    sern-chain     sern-client, sern-relay, sern-client (CURVE), from one domain to another

Everything is on loopback. CPU is that of the processes in between.
"""

import argparse
import asyncio
import json
import statistics
import subprocess
import sys
import tempfile
import time
from contextlib import AsyncExitStack, ExitStack
from pathlib import Path
from random import Random
from typing import Any, Final

import numpy as np

from benchmarks import common
from benchmarks.endpoints.ros1 import cpu_s
from sern_client.endpoints.dds.domain import DomainOptions
from sern_client.endpoints.dds.endpoint import DdsEndpoint, DdsOptions
from sern_core.errors import SernError
from sern_core.message import TopicInfo
from sern_core.types import ClientName, Encoding, TopicName
from sern_runtime import ros_types
from sern_runtime.keys import PublicKey, PublicKeys, generate, write_public, write_secret
from sern_tools.ports import free_ports
from tests.peers.dds.peer import Peer, build_peer, free_domain, missing_packages

MEASURE_S: Final = 8.0
QUICK_S: Final = 3.0
START_S: Final = 30.0
WARM_SHARE: Final = 0.2
"""This much of each run is not counted: connections, caches and the schedulers settle."""
ODOM_HZ: Final = 1000
CLOUD_HZ: Final = 20
CLOUD_BYTES: Final = 1_000_000
SYSTEMS: Final = ("direct", "sern", "sern-chain")
CASE: Final = "dds 1 kHz + 20 MB/s"
HOST: Final = "127.0.0.1"
_TYPES: Final = {"odom": "nav_msgs/msg/Odometry", "cloud": "sensor_msgs/msg/PointCloud2"}
_DDS: Final = {"odom": "nav_msgs::msg::dds_::Odometry_", "cloud": "sensor_msgs::msg::dds_::PointCloud2_"}
_ROOT: Final = Path(__file__).resolve().parents[2]


def _body(name: str) -> bytes:
    fields: dict[str, Any] = {}
    if name == "cloud":
        fields["data"] = np.frombuffer(Random(1).randbytes(CLOUD_BYTES), dtype="uint8")
    message = ros_types.new(_TYPES[name], Encoding.CDR, **fields)
    return ros_types.serialise(message, _TYPES[name], Encoding.CDR)


# The bridge, in a process of its own ----------------------------------------------------------------------------------


class _Through:
    """`TopicEvents`: what one domain has is published in the other."""

    def __init__(self, source: DdsEndpoint, target: DdsEndpoint) -> None:
        self._source = source
        self._target = target

    def topic_added(self, info: TopicInfo) -> None:
        publisher = self._target.advertise(info)

        def sink(body: bytes, stamp_ns: int) -> bool:
            publisher.publish(body, stamp_ns)
            return True

        self._source.subscribe(info.name, sink)

    def topic_removed(self, name: TopicName) -> None:
        """The run ends with it."""


async def _bridge(source_domain: int, target_domain: int) -> None:
    source = DdsEndpoint(DdsOptions(DomainOptions(source_domain, localhost_only=True)))
    target = DdsEndpoint(DdsOptions(DomainOptions(target_domain, localhost_only=True), node_name="sern_target"))
    through = _Through(source, target)
    await target.start(_Through(target, source))
    await source.start(through)
    try:
        await asyncio.Event().wait()
    finally:
        await source.stop()
        await target.stop()


# The run --------------------------------------------------------------------------------------------------------------


def _spawn(stack: ExitStack, *command: str) -> int:
    process = subprocess.Popen(
        [sys.executable, "-P", "-m", *command], cwd=_ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )

    def end() -> None:
        process.kill()
        process.wait()

    stack.callback(end)
    return process.pid


def _chain(stack: ExitStack, source_domain: int, target_domain: int) -> list[int]:
    """A relay and two clients, with keys and nothing else set that a user would not."""
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="sern-bench-")))
    (folder / "clients").mkdir()
    for name, public in (("relay", "relay.pub"), ("robot1", "clients/robot1.pub"), ("site", "clients/site.pub")):
        pair = generate(ClientName(name))
        write_secret(folder / f"{name}.key", pair)
        write_public(folder / public, PublicKeys(pair.name, (PublicKey(pair.public_key),)))
    relay = f"tcp://{HOST}:{free_ports(1)[0]}"
    files: dict[str, Any] = {
        "relay": {
            "relay": {"name": "relay", "listen": [relay], "secret_key_file": "relay.key", "clients_dir": "clients"},
            "access": [{"client": ".*", "publish": [".*"], "subscribe": [".*"]}],
        }
    }
    rules = [
        {"match": ".*/odom", "class": "control", "reliability": "reliable", "depth": 1000},
        {"match": ".*/cloud", "class": "bulk", "reliability": "reliable", "depth": 10},
    ]
    for name, domain, patterns in (("robot1", source_domain, []), ("site", target_domain, ["/bench/.*"])):
        files[name] = {
            "client": {"name": name, "namespace": "/"},
            "relay": {"endpoint": relay, "server_key_file": "relay.pub", "secret_key_file": f"{name}.key"},
            "endpoint": {"kind": "dds", "domain": domain, "localhost_only": True},
            "topics": rules,
            "subscribe": patterns,
        }
    pids = []
    for name, content in files.items():
        config = folder / f"{name}.yaml"
        config.write_text(json.dumps(content))  # JSON is YAML
        pids.append(_spawn(stack, f"sern_{'relay' if name == 'relay' else 'client'}.cli", "--config", str(config)))
    return pids


async def _measure(system: str, program: Path, measure_s: float) -> dict[str, float]:
    source_domain = free_domain()
    target_domain = source_domain if system == "direct" else free_domain()
    bodies = {name: _body(name).hex() for name in _TYPES}
    rates = {"odom": ODOM_HZ, "cloud": CLOUD_HZ}
    depths = {"odom": 1000, "cloud": 20}
    async with AsyncExitStack() as stack:
        processes = stack.enter_context(ExitStack())
        source = await stack.enter_async_context(Peer(program, source_domain))
        sink = await stack.enter_async_context(Peer(program, target_domain))
        for name, kind in _DDS.items():
            await source.do(f"pub {name} rt/bench/{name} {kind} reliable depth={depths[name]}")
            await sink.do(f"sub {name} rt/bench/{name} {kind} reliable quiet depth={depths[name]}")
        pids: list[int] = []
        if system == "sern":
            pids = [_spawn(processes, "benchmarks.endpoints.dds", str(source_domain), str(target_domain))]
        elif system == "sern-chain":
            pids = _chain(processes, source_domain, target_domain)
        async with asyncio.timeout(START_S):
            for name in _DDS:
                await source.line(f"matched {name} 1")
                await sink.line(f"matched {name} 1")
        # A daemon says that somebody wants a topic some time after it is there.
        await asyncio.sleep(1.0)
        before_s, began_s = cpu_s(pids), time.monotonic()
        for name, body in bodies.items():
            await source.do(f"flood {name} {body} {rates[name]} {round(rates[name] * measure_s)}")
        async with asyncio.timeout(measure_s + START_S):
            for name in bodies:
                await source.line(f"flooded {name}")
        used_s, took_s = cpu_s(pids) - before_s, time.monotonic() - began_s
        await asyncio.sleep(0.5)  # what is under way
        found: dict[str, float] = {}
        for name in _TYPES:
            await sink.do(f"stats {name}")
            words = await sink.line(f"stats {name} ")
            delays_ms = [int(text) / 1e6 for text in words[3].split(",") if text]
            settled = sorted(delays_ms[round(len(delays_ms) * WARM_SHARE) :])
            if not settled:
                raise SernError(f"dds: nothing of {name} arrived through {system}")
            found[f"{name}_p50_ms"] = statistics.median(settled)
            found[f"{name}_p99_ms"] = settled[int(0.99 * (len(settled) - 1))]
            found[f"{name}_lost"] = rates[name] * measure_s - len(delays_ms)
        return {**found, "cpu_percent": 100 * used_s / took_s}


def bench(options: argparse.Namespace, report: common.Report) -> None:
    """SernError where the peer cannot be built."""
    if missing := missing_packages():
        raise SernError(f"dds: needs the Debian packages {' '.join(missing)}")
    program = build_peer()
    measure_s = QUICK_S if options.quick else MEASURE_S
    for system in SYSTEMS:
        report.row(CASE, system, **asyncio.run(_measure(system, program, measure_s)))
    report.note("dds: reliable on both sides, messages of 700 bytes and of 1 MB between processes of this host")
    direct = {metric: report.value(CASE, "direct", metric) for metric in ("odom_p50_ms", "odom_p99_ms", "cloud_p50_ms")}
    for system in SYSTEMS[1:]:
        added = {metric: report.value(CASE, system, metric) - direct[metric] for metric in direct}
        report.note(
            f"dds {system}: adds {added['odom_p50_ms']:.3f} ms to odometry (p50), {added['odom_p99_ms']:.3f} ms (p99), "
            f"{added['cloud_p50_ms']:.3f} ms to clouds (p50)"
        )
    added_ms = report.value(CASE, "sern", "odom_p50_ms") - direct["odom_p50_ms"]
    report.reach("dds: latency added to odometry [ms]", added_ms, 1.0)
    report.reach("dds: odometry lost", report.value(CASE, "sern", "odom_lost"), 0)


if __name__ == "__main__":
    asyncio.run(_bridge(int(sys.argv[1]), int(sys.argv[2])))
