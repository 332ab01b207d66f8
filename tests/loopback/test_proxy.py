"""The shaping proxy over real sockets: it carries bytes unharmed, is never better than its link, and holds little."""

import asyncio
import contextlib
import json
import socket
import sys
import time
from collections.abc import AsyncIterator

import pytest

from sern_core.vocabulary.errors import SernError
from sern_sim.models import LinkModel, RateStep, Window
from sern_tools.proxy import EARLY_S, Route, ShapingProxy, address
from tests.support import DEADLINE_S, until

HOST = "127.0.0.1"
FAST = LinkModel(rate_bps=80e6, delay_s=0.002)


def probes_a_closed_window(sender: socket.socket) -> bool:
    """Whether the kernel has found that the receiver takes nothing more: all it took is acknowledged, and what is left
    waits behind the persist timer, which has gone off (`tcpi_backoff` of struct tcp_info, the fifth byte)."""
    return sender.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 8)[4] > 0


class Peer:
    """The target: takes every connection, remembers what arrived when, and echoes if told so."""

    def __init__(self, *, echo: bool = False, hold: bool = False) -> None:
        self.echo = echo
        self.hold = hold
        self.received = bytearray()
        self.arrivals: list[tuple[float, int]] = []
        self.connected_s: list[float] = []
        self.ended = 0
        self.writers: list[asyncio.StreamWriter] = []
        self.port = 0
        self._server: asyncio.Server | None = None
        self._tasks: set[asyncio.Task[None]] = set()

    async def __aenter__(self) -> "Peer":
        def connected(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            self.writers.append(writer)
            self.connected_s.append(time.monotonic())
            if not self.hold:
                self._tasks.add(asyncio.create_task(self._serve(reader, writer)))

        self._server = await asyncio.start_server(connected, HOST, 0)
        self.port = self._server.sockets[0].getsockname()[1]
        return self

    async def __aexit__(self, *_: object) -> None:
        assert self._server is not None
        self._server.close()
        for writer in self.writers:
            writer.close()
            with contextlib.suppress(ConnectionError):
                await writer.wait_closed()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(ConnectionError):
            while data := await reader.read(65536):
                self.arrivals.append((time.monotonic(), len(data)))
                self.received += data
                if self.echo:
                    writer.write(data)
                    await writer.drain()
            self.ended += 1
            writer.close()


@contextlib.asynccontextmanager
async def through(up: LinkModel, peer: Peer, down: LinkModel | None = None) -> AsyncIterator[ShapingProxy]:
    async with ShapingProxy(up, down or up, [Route((HOST, 0), (HOST, peer.port))], seed=1) as proxy:
        yield proxy


async def test_bytes_arrive_whole_in_order_and_both_ends_close() -> None:
    payload = bytes(range(256)) * 4000
    async with Peer(echo=True) as peer, through(FAST, peer) as proxy:
        reader, writer = await asyncio.open_connection(*proxy.addresses[0])
        writer.write(payload)
        writer.write_eof()
        async with asyncio.timeout(DEADLINE_S):
            echoed = await reader.read()
        assert echoed == payload == bytes(peer.received)
        writer.close()
        await writer.wait_closed()
        await until(lambda: not proxy.connections)
        statistics = proxy.statistics()
        assert statistics["accepted"] == 1
        assert isinstance(statistics["up"], dict) and statistics["up"]["delivered_bytes"] == len(payload)


async def test_never_faster_than_the_link() -> None:
    link = LinkModel(rate_bps=4e6, delay_s=0.02, rate_steps=(RateStep(0.3, 1e6),), overhead_bytes=28)
    async with Peer() as peer, through(link, peer) as proxy:
        origin = proxy.start()
        _, writer = await asyncio.open_connection(*proxy.addresses[0])
        writer.write(b"x" * 200_000)
        writer.write_eof()
        await until(lambda: peer.ended == 1)
        carried = 0
        for at, size in peer.arrivals:
            carried += size
            possible = link.capacity_bits(0.0, at + EARLY_S - origin - link.delay_s) / 8
            assert carried <= possible
        assert carried == 200_000
        writer.close()


async def test_an_idle_round_trip_takes_both_delays() -> None:
    up, down = LinkModel(rate_bps=8e6, delay_s=0.03), LinkModel(rate_bps=8e6, delay_s=0.01)
    async with Peer(echo=True) as peer, through(up, peer, down) as proxy:
        reader, writer = await asyncio.open_connection(*proxy.addresses[0])
        for _ in range(3):
            sent = time.monotonic()
            writer.write(b"ping")
            async with asyncio.timeout(DEADLINE_S):
                assert await reader.readexactly(4) == b"ping"
            assert time.monotonic() - sent >= 0.04 - 2 * EARLY_S
        writer.close()


async def test_a_blackout_freezes_bytes_and_new_connections_and_keeps_the_old_ones() -> None:
    link = LinkModel(rate_bps=8e6, delay_s=0.005, blackouts=(Window(0.2, 0.8),))
    async with Peer() as peer, through(link, peer) as proxy:
        _, old = await asyncio.open_connection(*proxy.addresses[0])
        await until(lambda: len(peer.writers) == 1)
        origin = proxy.start()
        old.write(b"before")
        await until(lambda: peer.received == b"before")
        await until(lambda: time.monotonic() > origin + 0.25)
        old.write(b"frozen")
        _, new = await asyncio.open_connection(*proxy.addresses[0])
        new.write(b"fresh!")
        await until(lambda: len(peer.received) == 18)
        assert peer.arrivals[0][1] == len(b"before")
        assert peer.arrivals[1][0] >= origin + 0.8
        assert len(peer.writers) == 2
        assert peer.connected_s[1] >= origin + 0.8
        old.close()
        new.close()


async def test_an_end_in_a_blackout_is_seen_after_it() -> None:
    link = LinkModel(rate_bps=8e6, delay_s=0.005, blackouts=(Window(0.1, 0.5),))
    async with Peer() as peer, through(link, peer) as proxy:
        _, writer = await asyncio.open_connection(*proxy.addresses[0])
        await until(lambda: len(peer.writers) == 1)
        origin = proxy.start()
        await until(lambda: time.monotonic() > origin + 0.15)
        writer.close()
        await until(lambda: peer.ended == 1)
        assert time.monotonic() >= origin + 0.5
        await until(lambda: not proxy.connections)


async def test_a_link_that_is_gone_swallows_little() -> None:
    """What a sender can get rid of while nothing moves: the queue and two small kernel buffers."""
    link = LinkModel(rate_bps=4e6, delay_s=0.025, blackouts=(Window(0.1, 1e6),))
    async with Peer() as peer, through(link, peer) as proxy:
        loop = asyncio.get_running_loop()
        with socket.socket() as sender:
            sender.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 32 * 1024)
            sender.setblocking(False)
            await loop.sock_connect(sender, proxy.addresses[0])
            await until(lambda: len(peer.writers) == 1)
            origin = proxy.start()
            await until(lambda: time.monotonic() > origin + 0.15)
            swallowed = 0

            def full() -> bool:
                nonlocal swallowed
                with contextlib.suppress(BlockingIOError):
                    while True:
                        swallowed += sender.send(b"x" * 10_000)
                return probes_a_closed_window(sender)

            await until(full, "the sender finds the window closed")
            assert 100_000 < swallowed < 400_000
            assert peer.received == b""


async def test_a_receiver_that_does_not_read_stops_its_sender_and_no_other() -> None:
    async with Peer(hold=True) as deaf, Peer() as peer:
        routes = [Route((HOST, 0), (HOST, deaf.port)), Route((HOST, 0), (HOST, peer.port))]
        async with ShapingProxy(FAST, FAST, routes) as proxy:
            _, blocked = await asyncio.open_connection(*proxy.addresses[0])
            _, writer = await asyncio.open_connection(*proxy.addresses[1])
            blocked.write(b"x" * 30_000_000)
            writer.write(b"y" * 300_000)
            await until(lambda: len(peer.received) == 300_000)
            assert deaf.received == b""
            writer.close()
            blocked.transport.abort()


async def test_connections_share_the_link() -> None:
    link = LinkModel(rate_bps=4e6, delay_s=0.005, queue_packets=20)
    async with Peer() as one, Peer() as two:
        routes = [Route((HOST, 0), (HOST, peer.port)) for peer in (one, two)]
        async with ShapingProxy(link, link, routes) as proxy:
            writers = [(await asyncio.open_connection(*a))[1] for a in proxy.addresses]
            await until(lambda: len(one.writers) == len(two.writers) == 1)
            for writer in writers:
                writer.write(b"x" * 500_000)
            await until(lambda: len(one.received) + len(two.received) > 300_000)
            assert min(len(one.received), len(two.received)) > 75_000  # a quarter at least
            for writer in writers:
                writer.transport.abort()
            await until(lambda: not proxy.connections)


async def test_a_target_that_is_away_ends_the_connection() -> None:
    with socket.socket() as unused:
        unused.bind((HOST, 0))
        target = unused.getsockname()
        async with ShapingProxy(FAST, FAST, [Route((HOST, 0), target)]) as proxy:
            reader, writer = await asyncio.open_connection(*proxy.addresses[0])
            async with asyncio.timeout(DEADLINE_S):
                with contextlib.suppress(ConnectionResetError):
                    assert await reader.read() == b""
            writer.close()
            assert not proxy.connections


async def test_a_receiver_that_resets_ends_the_sender() -> None:
    async with Peer(hold=True) as peer, through(FAST, peer) as proxy:
        reader, writer = await asyncio.open_connection(*proxy.addresses[0])
        await until(lambda: len(peer.writers) == 1)
        peer.writers[0].transport.abort()
        async with asyncio.timeout(DEADLINE_S):
            assert await reader.read() == b""
        with contextlib.suppress(ConnectionError):
            for _ in range(100):
                writer.write(b"x" * 10_000)
                await writer.drain()
        writer.close()
        await until(lambda: not proxy.connections)


async def test_a_profile_starts_once() -> None:
    async with Peer() as peer, through(FAST, peer) as proxy:
        assert proxy.statistics()["elapsed_s"] is None
        proxy.start()
        with pytest.raises(SernError, match="already"):
            proxy.start()


@pytest.mark.parametrize("text", ["5555", ":5555", "host:", "host:x", "host:65536"])
def test_an_address_that_is_none(text: str) -> None:
    with pytest.raises(ValueError, match="host:port"):
        address(text)


async def test_the_process_says_where_it_listens_answers_and_stops() -> None:
    async with Peer(echo=True) as peer:
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "sern_tools.proxy",
            "--listen", f"{HOST}:0", "--target", f"{HOST}:{peer.port}", "--profile", "demo", "--seed", "3",
            stdout=asyncio.subprocess.PIPE,
        )  # fmt: skip
        try:
            assert process.stdout is not None
            async with asyncio.timeout(DEADLINE_S):
                ready = json.loads(await process.stdout.readline())
                reader, writer = await asyncio.open_connection(*address(ready["listening"][0]))
                control, requests = await asyncio.open_connection(HOST, ready["control"])

                async def ask(line: bytes) -> dict[str, object]:
                    requests.write(line + b"\n")
                    answer: dict[str, object] = json.loads(await control.readline())
                    return answer

                assert "error" in await ask(b"nonsense")
                assert "error" in await ask(b'{"do": "dance"}')
                assert "error" in await ask(b'{"do": "start", "at_s": "x"}')
                at_s = time.monotonic()
                assert await ask(json.dumps({"do": "start", "at_s": at_s}).encode()) == {"origin_s": at_s}
                assert "error" in await ask(b'{"do": "start"}')
                writer.write(b"ping")
                assert await reader.readexactly(4) == b"ping"
                statistics = await ask(b'{"do": "stats"}')
                assert isinstance(statistics["down"], dict)
                assert sum(statistics["down"]["bytes_per_bucket"]) == 4
                process.terminate()
                assert await process.wait() == 0
            for each in (writer, requests):
                each.close()
        finally:
            if process.returncode is None:
                process.kill()
                await process.wait()
