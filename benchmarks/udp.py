"""What the UDP lane costs: sealing, one server socket, and a server under junk.

seal       microseconds to seal and to open `UDP_PAYLOAD_BYTES`, and to refuse a forgery, by cipher; what the bare AEAD
           takes to encrypt as much
socket     datagrams a second through one server socket, a client process in closed loop, and the server's CPU for each
forward    CPU of the bare forwarder of `benchmarks.link` for each of 2,000 evenly spaced datagrams a second
junk       CPU of the server's process (user and system) while another sends 20,000 datagrams a second, evenly spaced,
           to it: of an unknown session, and with a known id and a bad tag, each with the peer that a plain loop of
           `recvfrom_into` without filter and pause is; and a real session's round trip meanwhile. Held against what
           the forwarder takes for a good one

The load generators share this machine: on two cores they take one of them. Where allowed, the server (only) has
real-time priority, so that other load is not in its figures.
"""

import argparse
import asyncio
import multiprocessing
import os
import socket as socketlib
import statistics
import struct
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from multiprocessing.connection import Connection
from typing import Any, Final, Self

import uvloop
from cryptography.hazmat.primitives.ciphers.aead import AESGCM, ChaCha20Poly1305

from benchmarks import flood
from benchmarks.child import Worker
from benchmarks.common import (
    Report,
    interleaved,
    main,
    medians,
    percentile,
    repetition_arguments,
    repetitions,
    try_realtime,
)
from benchmarks.link.forwarder import Forwarder, Hops
from sern_core.vocabulary.errors import SernError
from sern_core.vocabulary.types import ClientName
from sern_runtime import udp_socket
from sern_runtime.seal import (
    KEY_BYTES,
    ROOM_BYTES,
    SEAL_BYTES,
    UDP_PAYLOAD_BYTES,
    Cipher,
    Opener,
    Sealer,
    SessionParameters,
    Side,
    make_seals,
)
from sern_runtime.udp import INNER_BYTES, TYPE_CHALLENGE, TYPE_DATA, TYPE_RESPONSE, UdpServer, UdpSession

FORWARD_HZ: Final = 2000
JUNK: Final = {"junk, unknown": False, "junk, bad tag": True}
"""Whether its session is one that the server knows."""
CASES: Final = ("seal", "socket", "forward", *JUNK)
JUNK_LIMIT: Final = 0.25
"""CPU of refusing a datagram, by that of forwarding one."""
SEAL_LIMITS: Final = {Cipher.AES_256_GCM: 3.0, Cipher.CHACHA20_POLY1305: 3.0}
"""What sealing costs, times the bare AEAD."""
WINDOW: Final = 32
"""Datagrams in flight in the closed loop."""
ECHO_HZ: Final = 100
ECHO_S: Final = 0.1
"""An echo that takes longer counts as lost: the next one is not to wait for it."""
WARM_UP_S: Final = 0.3
ROBOT: Final = ClientName("robot")
OFFERED: Final = tuple(Cipher)


# --- sealing ----------------------------------------------------------------------------------------------------------


def seal_us(cipher: Cipher, count: int) -> dict[str, float]:
    """Microseconds a datagram of the full size: sealed, opened, and refused for its tag."""
    parameters = SessionParameters.draw(1, cipher, 1)
    encrypt = (AESGCM if cipher is Cipher.AES_256_GCM else ChaCha20Poly1305)(os.urandom(KEY_BYTES)).encrypt
    nonces = [struct.pack("!IQ", 0, number) for number in range(count)]
    sealer, opener = Sealer(parameters, Side.CLIENT), Opener(parameters, Side.CLIENT)
    data = os.urandom(ROOM_BYTES)
    bare_s = time.process_time()  # not the clock: other load on this machine is no cost of ours
    for nonce in nonces:
        encrypt(nonce, data, nonce)
    begun_s = time.process_time()
    datagrams = [sealer.seal(data) for _ in range(count)]
    sealed_s = time.process_time()
    for datagram in datagrams:
        opener.open(datagram)
    opened_s = time.process_time()
    forged = datagrams[0][:4] + struct.pack("!Q", count + 1) + datagrams[0][12:]
    for _ in range(count):
        opener.open(forged)
    refused_s = time.process_time()
    return {
        "aead_us": (begun_s - bare_s) / count * 1e6,
        "seal_us": (sealed_s - begun_s) / count * 1e6,
        "open_us": (opened_s - sealed_s) / count * 1e6,
        "refuse_us": (refused_s - opened_s) / count * 1e6,
    }


# --- servers in processes of their own --------------------------------------------------------------------------------


async def _answer(control: Connection, usage: Callable[[], tuple[float, float, int]]) -> None:
    """Answer each word on `control` with `usage`, until told to end."""
    loop = asyncio.get_running_loop()
    ended = asyncio.Event()

    def asked() -> None:
        if control.recv():
            control.send(usage())
        else:
            ended.set()

    loop.add_reader(control.fileno(), asked)
    await ended.wait()
    loop.remove_reader(control.fileno())


def forward(control: Connection, hops: Hops, target: tuple[str, int]) -> None:
    """The bare forwarder to `target`. Tells its own address first."""
    try_realtime()

    async def run() -> None:
        with (
            socketlib.socket(socketlib.AF_INET, socketlib.SOCK_DGRAM) as inlet,
            socketlib.socket(socketlib.AF_INET, socketlib.SOCK_DGRAM) as outlet,
        ):
            inlet.bind(("127.0.0.1", 0))
            inlet.setblocking(False)
            outlet.connect(target)
            forwarder = Forwarder(hops, inlet, outlet)
            loop = asyncio.get_running_loop()
            loop.add_reader(inlet.fileno(), forwarder.step)
            control.send(inlet.getsockname())
            await _answer(control, lambda: (time.process_time(), time.monotonic(), forwarder.forwarded))
            loop.remove_reader(inlet.fileno())

    uvloop.run(run())


def serve(control: Connection, plain: bool) -> None:
    """A server with one session, whose parameters it tells first; it sends back what it gets.

    `plain`: without the filter and the pause.
    """
    try_realtime()

    async def run() -> None:
        received = 0

        def datagram(session: UdpSession, data: bytes, _now: float) -> None:
            nonlocal received
            received += 1
            session.send(data)

        if plain:
            udp_socket.MAX_FILTER_IDS = -1  # type: ignore[misc]  # the peer that the module's text compares with
            udp_socket.DatagramSocket._readable = udp_socket.DatagramSocket._take  # type: ignore[method-assign,assignment]
        server = UdpServer(["udp://127.0.0.1:*"], datagram)
        control.send(server.open_session(ROBOT, OFFERED).parameters)
        await _answer(control, lambda: (time.process_time(), time.monotonic(), received))
        server.close()

    uvloop.run(run())


class ServerProcess:
    """Started on entry, ended on exit. `told`: what it says first."""

    def __init__(self, name: str, target: Callable[..., None], *arguments: object) -> None:
        self._control, self._far = multiprocessing.Pipe()
        self._worker = Worker(name, target, self._far, *arguments)
        self.told: Any = None

    def __enter__(self) -> Self:
        try:
            self._worker.start()
            self._far.close()  # the server's copy alone keeps it open
            self.told = self._worker.hear(self._control)
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(ConnectionError):  # it has ended
            self._control.send(False)
        self._worker.end(patient=True)
        self._control.close()

    def usage(self) -> tuple[float, float, int]:
        """CPU and wall clock in seconds, and datagrams received, so far. SernError when the server has ended."""
        cpu_s, wall_s, received = self._worker.ask(self._control, True)
        return float(cpu_s), float(wall_s), int(received)


def udp_server(*, plain: bool = False) -> ServerProcess:
    return ServerProcess("the UDP server", serve, plain)


def forwarding(duration_s: float) -> dict[str, float]:
    """Datagrams of the full size, FORWARD_HZ, as evenly as a process that sleeps in between can send them."""
    hops = Hops.draw()
    sealer = Sealer(hops.first, Side.CLIENT)
    data = os.urandom(ROOM_BYTES)
    with (
        socketlib.socket(socketlib.AF_INET, socketlib.SOCK_DGRAM) as sink,
        socketlib.socket(socketlib.AF_INET, socketlib.SOCK_DGRAM) as source,
    ):
        sink.bind(("127.0.0.1", 0))
        sink.settimeout(2.0)
        with ServerProcess("the bare forwarder", forward, hops, sink.getsockname()) as server:
            source.connect(server.told)
            cpu_s, _, before = server.usage()
            begun_s = time.monotonic()
            for number in range(int(duration_s * FORWARD_HZ)):
                time.sleep(max(0.0, begun_s + number / FORWARD_HZ - time.monotonic()))
                source.send(sealer.seal(data))
                sink.recv(UDP_PAYLOAD_BYTES)
            ended_s = time.monotonic()
            cpu_end_s, _, after = server.usage()
    count = after - before
    return {"datagrams_hz": count / (ended_s - begun_s), "server_cpu_us": (cpu_end_s - cpu_s) / count * 1e6}


class Peer:
    """A client by hand on a blocking socket, validated by the server."""

    def __init__(self, parameters: SessionParameters) -> None:
        self.sealer, self.opener = make_seals(parameters, Side.CLIENT)
        self.socket = socketlib.socket(socketlib.AF_INET, socketlib.SOCK_DGRAM)
        self.socket.connect(("127.0.0.1", parameters.port))
        self.socket.settimeout(2.0)
        self.send(b"here")
        challenge = self.receive(TYPE_CHALLENGE)
        self.send(challenge, TYPE_RESPONSE)

    def send(self, data: bytes, kind: bytes = TYPE_DATA) -> None:
        self.socket.send(self.sealer.seal(kind + data))

    def receive(self, kind: bytes = TYPE_DATA) -> bytes:
        """The next of one inner type. Raises TimeoutError."""
        while True:
            inner = self.opener.open(self.socket.recv(2048))
            if inner is not None and inner[:1] == kind:
                return inner[1:]


def throughput(duration_s: float) -> dict[str, float]:
    """Datagrams of the full size there and back, WINDOW in flight."""
    with udp_server() as server:
        peer = Peer(server.told)
        data = bytes(INNER_BYTES)
        with peer.socket:
            with suppress(TimeoutError):  # the echo of "here" may have come before the validation, or after it
                peer.socket.settimeout(0.1)
                peer.receive()
            peer.socket.settimeout(2.0)
            for _ in range(WINDOW):
                peer.send(data)
            cpu_s, begun_s, received = server.usage()
            end_s = time.monotonic() + duration_s
            while time.monotonic() < end_s:
                peer.receive()
                peer.send(data)
            cpu_end_s, end_s, received_end = server.usage()
    count = received_end - received
    return {"datagrams_hz": count / (end_s - begun_s), "server_cpu_us": (cpu_end_s - cpu_s) / count * 1e6}


# --- junk -------------------------------------------------------------------------------------------------------------


def send_junk(port: int, session_id: int, seconds: float, told: Connection) -> None:
    """Say when it is ready, begin when told to, and tell the rate that it came to."""
    with socketlib.socket(socketlib.AF_INET, socketlib.SOCK_DGRAM) as target:
        target.connect(("127.0.0.1", port))
        datagrams = flood.junk(session_id)
        told.send(True)
        told.recv()
        told.send(flood.send(target, datagrams, seconds))


def under_junk(known_id: bool, plain: bool, duration_s: float) -> dict[str, float]:
    with udp_server(plain=plain) as server:
        parameters: SessionParameters = server.told
        peer = Peer(parameters)
        ours, far = multiprocessing.Pipe()
        session_id = parameters.id if known_id else parameters.id ^ 1
        generator = Worker(
            "the source of junk", send_junk, parameters.port, session_id, WARM_UP_S + duration_s + 0.3, far
        )
        peer.socket.settimeout(ECHO_S)
        round_trips = []
        with ExitStack() as stack:
            stack.callback(generator.end, patient=True)
            stack.enter_context(peer.socket)
            stack.enter_context(ours)
            generator.start()
            far.close()  # the generator's copy alone keeps it open
            generator.hear(ours)  # it is ready
            ours.send(True)
            time.sleep(WARM_UP_S)
            cpu_s, begun_s, _ = server.usage()
            lost = 0
            end_s = time.monotonic() + duration_s
            number = 0
            while time.monotonic() < end_s:
                number += 1
                mark = struct.pack("!I", number)
                sent_s = time.monotonic()
                peer.send(mark)
                try:
                    while peer.receive() != mark:
                        pass
                except TimeoutError:
                    lost += 1
                else:
                    round_trips.append(time.monotonic() - sent_s)
                time.sleep(1 / ECHO_HZ)
            cpu_end_s, end_s, _ = server.usage()
            rate_hz = generator.hear(ours)
    if not rate_hz or not round_trips:
        raise SernError("no junk could be sent, or nothing came back beside it: is the machine overloaded?")
    round_trips.sort()
    return {
        "cpu_percent": 100 * (cpu_end_s - cpu_s) / (end_s - begun_s),
        "junk_hz": float(rate_hz),
        "echo_p50_ms": 1000 * statistics.median(round_trips),
        "echo_p99_ms": 1000 * percentile(round_trips, 0.99),
        "echo_lost_count": float(lost),
    }


# --- the report -------------------------------------------------------------------------------------------------------


def bench(options: argparse.Namespace, report: Report) -> None:
    rounds, duration_s = repetitions(options, (3, 3.0), quick=(1, 1.0))
    count = 5_000 if options.quick else 30_000
    if "seal" in options.cases:
        sealed = interleaved({cipher.value: _sealing(cipher, count) for cipher in Cipher}, max(rounds, 3))
        for cipher in Cipher:
            report.row("seal", cipher.value, **medians(sealed[cipher.value]))
    if "socket" in options.cases:
        report.row("socket", "echo", **medians([throughput(duration_s) for _ in range(rounds)]))
    if "forward" in options.cases:
        report.row("forward", "bare", **medians([forwarding(duration_s) for _ in range(rounds)]))
    for case, known_id in JUNK.items():
        if case in options.cases:
            systems = {"sern": _junk(known_id, False, duration_s), "plain": _junk(known_id, True, duration_s)}
            for name, runs in interleaved(systems, rounds).items():
                report.row(case, name, **medians(runs))
    _reaches(options.cases, report)
    report.note(f"datagrams of {UDP_PAYLOAD_BYTES} bytes ({SEAL_BYTES} of them the seal); medians of {rounds} rounds")


def _reaches(cases: Sequence[str], report: Report) -> None:
    """What was set out, as far as both sides of it were measured."""
    for case in JUNK:
        if case in cases and "forward" in cases:
            refuse_us = 1e4 * report.value(case, "sern", "cpu_percent") / report.value(case, "sern", "junk_hz")
            forward_us = report.value("forward", "bare", "server_cpu_us")
            report.reach(f"CPU of refusing one, by that of forwarding one, {case}", refuse_us / forward_us, JUNK_LIMIT)
    for cipher, limit in SEAL_LIMITS.items():
        if "seal" in cases:
            times = report.value("seal", cipher.value, "seal_us") / report.value("seal", cipher.value, "aead_us")
            report.reach(f"{cipher.value}: seal {UDP_PAYLOAD_BYTES} bytes, times the bare AEAD", times, limit)


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--cases", nargs="+", choices=CASES, default=CASES, help="measure these alone")
    repetition_arguments(parser)


def _sealing(cipher: Cipher, count: int) -> Callable[[], dict[str, float]]:
    return lambda: seal_us(cipher, count)


def _junk(known_id: bool, plain: bool, duration_s: float) -> Callable[[], dict[str, float]]:
    return lambda: under_junk(known_id, plain, duration_s)


if __name__ == "__main__":
    # Spawned processes import this file by its name, not as __main__.
    from benchmarks.udp import bench as imported_bench

    sys.exit(main("udp", imported_bench, description=__doc__, arguments=arguments))
