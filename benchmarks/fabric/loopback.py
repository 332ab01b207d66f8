"""How long a datagram takes through two ports on an idle loopback, with certificates, and what it costs both ends."""

import argparse
import asyncio
import tempfile
import time
from functools import partial
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from struct import Struct
from typing import Final

import uvloop

from benchmarks.child import Worker
from benchmarks.common import Report, interleaved, medians, percentile, repetitions
from benchmarks.fabric.hop_end import ROBOT, SITE, certificates
from sern_core.vocabulary.types import ClientName, PriorityClass
from sern_runtime.config.fabric import CA_FILE, CertificateFiles, certificate_file, key_file
from sern_runtime.fabric.port import PeerRelay
from sern_runtime.fabric.zenoh_port import ZenohPort
from sern_runtime.fabric.zenoh_settings import FabricOptions
from sern_tools.ports import free_ports

STAMP: Final = Struct("!d")
CASES: Final = {"1171 B, 1,000/s": (1171, 1000.0), "3000 B, 330/s": (3000, 330.0), "65,000 B, 200/s": (65_000, 200.0)}
"""Datagrams of 1171 bytes; of 3 ms of 8 Mbit/s; the largest."""
SETTLE_S: Final = 0.5
STEP_S: Final = 0.002


class _Told:
    """A `FabricEvents` that notes how long each datagram took."""

    def __init__(self) -> None:
        self.up = asyncio.Event()
        self.took_s: list[float] = []

    def peer_up(self, peer: PeerRelay) -> None:
        del peer
        self.up.set()

    def peer_down(self, name: ClientName, boot: int) -> None: ...

    def arrived(self, source: ClientName, datagram: bytes) -> None:
        del source
        self.took_s.append(time.monotonic() - STAMP.unpack_from(datagram)[0])


def _options(folder: Path, own: ClientName, other: ClientName, port: int, *, listens: bool) -> FabricOptions:
    at = (f"tls/127.0.0.1:{port}",)
    files = CertificateFiles(folder / CA_FILE, folder / certificate_file(own), folder / key_file(own))
    return FabricOptions(
        own, 1, relays=(other,), certificates=files, listen=at if listens else (), peers=() if listens else at
    )


def _work(connection: Connection, options: FabricOptions, size: int, rate_hz: float, duration_s: float) -> None:
    uvloop.install()
    asyncio.run(_run(connection, options, size, rate_hz, duration_s))


async def _run(connection: Connection, options: FabricOptions, size: int, rate_hz: float, duration_s: float) -> None:
    """Who connects sends; both say what they saw, and what CPU it took."""
    told = _Told()
    port = ZenohPort(options, told)
    await port.start()
    await told.up.wait()
    await asyncio.sleep(SETTLE_S)
    cpu_s, began_s = time.process_time(), time.monotonic()
    if options.peers:
        padding, sent = bytes(size - STAMP.size), 0
        while (elapsed_s := time.monotonic() - began_s) < duration_s:
            while sent < elapsed_s * rate_hz:
                port.send(SITE, PriorityClass.STATE, STAMP.pack(time.monotonic()) + padding)
                sent += 1
            await asyncio.sleep(1 / rate_hz)
    else:
        await asyncio.sleep(duration_s)
    cpu_s = time.process_time() - cpu_s
    await asyncio.sleep(SETTLE_S)
    connection.send((cpu_s, port.counters.snapshot(), told.took_s))
    await asyncio.to_thread(connection.recv)
    await port.close()


def measure(size: int, rate_hz: float, duration_s: float) -> dict[str, float]:
    with tempfile.TemporaryDirectory(prefix="sern-fabric-") as temporary:
        folder = Path(temporary)
        certificates(folder)
        (port,) = free_ports(1)
        workers, answers = [], []
        try:
            for own, other, listens in ((SITE, ROBOT, True), (ROBOT, SITE, False)):
                ours, theirs = Pipe()
                options = _options(folder, own, other, port, listens=listens)
                worker = Worker(own, _work, theirs, options, size, rate_hz, duration_s)
                workers.append((worker, ours))
                worker.start()
                theirs.close()
            answers = [worker.hear(ours) for worker, ours in workers]
            for _, ours in workers:
                ours.send("end")
        finally:
            for worker, _ in workers:
                worker.end(patient=bool(answers))
    (site_cpu_s, received, took_s), (robot_cpu_s, sent, _) = answers
    took_s.sort()
    return {
        "latency_p50_ms": 1000 * percentile(took_s, 0.5),
        "latency_p99_ms": 1000 * percentile(took_s, 0.99),
        "lost_percent": 100 * (1 - received["received"] / sent["sent"]),
        "sender_cpu_us": 1e6 * robot_cpu_s / sent["sent"],
        "receiver_cpu_us": 1e6 * site_cpu_s / received["received"],
        "longest_put_ms": 1000 * sent["send_block_max_s"],
    }


def bench(options: argparse.Namespace, report: Report) -> None:
    rounds, duration_s = repetitions(options, usual=(3, 10.0), quick=(1, 2.0))
    cases = {name: partial(measure, size, rate_hz, duration_s) for name, (size, rate_hz) in CASES.items()}
    for name, rows in interleaved(cases, rounds).items():
        report.row("idle loopback, TLS", name, **medians(rows))
