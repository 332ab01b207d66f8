"""Datagrams through the shaping proxy: carried whole and apart by client, through the one bottleneck, lost as asked."""

import asyncio
import contextlib
import socket
import time
from collections.abc import AsyncIterator
from itertools import pairwise
from random import Random

import pytest

from sern_sim.models import BurstLoss, LinkModel, Window
from sern_tools import proxy_datagrams
from sern_tools.ports import free_ports
from sern_tools.proxy import EARLY_S, Route, ShapingProxy
from sern_tools.proxy_datagrams import Address, Carry, DatagramRoute, Loss
from tests.support import until

HOST = "127.0.0.1"
FAST = LinkModel(rate_bps=80e6, delay_s=0.002)


def udp(host: str = HOST, port: int = 0) -> socket.socket:
    found = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    found.setblocking(False)
    found.bind((host, port))
    return found


def answered(client: socket.socket, answers: list[tuple[bytes, tuple[str, int]]]) -> bool:
    """Whether something has come to `client`, which is put into `answers`."""
    with contextlib.suppress(BlockingIOError):
        answers.append(client.recvfrom(100))
    return bool(answers)


class Target:
    """Notes what comes, from where and when."""

    def __init__(self, port: int = 0) -> None:
        self.socket = udp(port=port)
        self.port = self.socket.getsockname()[1]
        self.got: list[tuple[float, bytes, tuple[str, int]]] = []
        asyncio.get_running_loop().add_reader(self.socket, self._take)

    def _take(self) -> None:
        with contextlib.suppress(BlockingIOError):
            while True:
                data, address = self.socket.recvfrom(65536)
                self.got.append((time.monotonic(), data, address))

    def close(self) -> None:
        asyncio.get_running_loop().remove_reader(self.socket)
        self.socket.close()


@contextlib.asynccontextmanager
async def through(model: LinkModel, target: Target, *, seed: int = 1) -> AsyncIterator[ShapingProxy]:
    route = Route((HOST, 0), (HOST, target.port))
    try:
        async with ShapingProxy(model, model, [route], seed=seed, datagrams=True) as proxy:
            yield proxy
    finally:
        target.close()


def up(proxy: ShapingProxy, name: str) -> int:
    statistics = proxy.statistics()["up"]
    assert isinstance(statistics, dict)
    return int(statistics[name])


async def test_each_client_has_a_mapping_and_gets_its_own_answers() -> None:
    target = Target()
    async with through(FAST, target) as proxy:
        clients = [udp() for _ in range(3)]
        for turn in range(2):
            for number, client in enumerate(clients):
                client.sendto(b"%d %d" % (number, turn), proxy.addresses[0])
        await until(lambda: len(target.got) == 6, "all arrive")
        sources = {data.split()[0]: address for _, data, address in target.got}
        assert len(set(sources.values())) == 3 == len({address for _, _, address in target.got})
        for name, address in sources.items():
            target.socket.sendto(b"for " + name, address)
        for number, client in enumerate(clients):
            answers: list[tuple[bytes, tuple[str, int]]] = []
            await until(lambda c=client, a=answers: answered(c, a), "an answer")  # type: ignore[misc]
            assert answers == [(b"for %d" % number, proxy.addresses[0])]
            client.close()


@pytest.mark.parametrize("free", [True, False], ids=["any port", "this port"])
async def test_a_port_that_is_taken_for_datagrams_only(monkeypatch: pytest.MonkeyPatch, free: bool) -> None:
    """The kernel chooses one for connections, at which somebody else takes datagrams: another one will do, unless that
    one was asked for."""
    others: list[socket.socket] = []

    class Late(DatagramRoute):
        def __init__(self, listen: Address, target: Address, *, up: Carry, down: Carry) -> None:
            if not others:
                others.append(udp(*listen))
            super().__init__(listen, target, up=up, down=down)

    monkeypatch.setattr("sern_tools.proxy.DatagramRoute", Late)
    target = Target()
    route = Route((HOST, 0 if free else free_ports(1)[0]), (HOST, target.port))
    proxy = ShapingProxy(FAST, FAST, [route], seed=1, datagrams=True)
    try:
        if free:
            async with proxy:
                (address,) = proxy.addresses
                assert address != others[0].getsockname() and len(proxy._listeners) == 1
                with udp() as client:
                    client.sendto(b"through", address)
                    await until(lambda: target.got, "it arrives")
        else:
            with pytest.raises(OSError, match="in use"):
                await proxy.__aenter__()
            assert others[0].getsockname() == route.listen
    finally:
        target.close()
        others[0].close()


async def test_they_take_the_time_of_the_link_and_its_rate() -> None:
    target = Target()
    model = LinkModel(rate_bps=800_000, delay_s=0.05, queue_packets=100)
    async with through(model, target) as proxy:
        client = udp()
        start_s = time.monotonic()
        for number in range(20):
            client.sendto(b"%02d" % number + b"x" * 998, proxy.addresses[0])
        await until(lambda: len(target.got) == 20, "all arrive")
        client.close()
    assert [int(data[:2]) for _, data, _ in target.got] == list(range(20))
    for count, (at_s, _, _) in enumerate(target.got, start=1):
        assert at_s - start_s >= 0.05 + count * 0.01 - EARLY_S, "never faster than the link"


async def test_what_finds_the_queue_full_is_dropped() -> None:
    target = Target()
    model = LinkModel(rate_bps=800_000, delay_s=0.0, queue_packets=5, blackouts=(Window(0.0, 3600.0),))
    async with through(model, target) as proxy:
        proxy.start()
        client = udp()
        for _ in range(30):
            client.sendto(b"x" * 1000, proxy.addresses[0])
        await until(lambda: up(proxy, "datagrams") == 30, "all came in")
        assert (up(proxy, "datagrams_dropped"), up(proxy, "queue_packets")) == (25, 5)
        client.close()
    assert target.got == []


async def test_connections_and_datagrams_share_the_bottleneck() -> None:
    """Datagrams alone would be through at once; they wait behind the bytes of the connection, and those behind them."""
    target = Target(*free_ports(1))
    model = LinkModel(rate_bps=800_000, delay_s=0.0, queue_packets=40)
    got: list[tuple[float, int]] = []
    done = asyncio.Event()

    async def taken(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while data := await reader.read(65536):
            got.append((time.monotonic(), len(data)))
        writer.close()
        done.set()

    server = await asyncio.start_server(taken, HOST, target.port)
    async with through(model, target) as proxy:
        _, writer = await asyncio.open_connection(*proxy.addresses[0])
        start_s = time.monotonic()
        writer.write(b"y" * 10_000)
        client = udp()
        for _ in range(10):
            client.sendto(b"x" * 1000, proxy.addresses[0])
        await until(lambda: sum(size for _, size in got) == 10_000 and len(target.got) == 10, "all arrive")
        last_s = max(got[-1][0], target.got[-1][0])
        assert last_s - start_s >= 20_000 * 8 / 800_000 - EARLY_S, "20 kB take 0.2 s, whoever sends them"
        writer.close()
        await done.wait()
        client.close()
    server.close()


async def test_losses_take_their_share_of_the_rate_and_are_counted() -> None:
    target = Target()
    async with through(LinkModel(rate_bps=80e6, delay_s=0.0, loss=0.3, queue_packets=1000), target, seed=7) as proxy:
        client = udp()
        for number in range(200):
            client.sendto(b"%d" % number, proxy.addresses[0])
        await until(lambda: up(proxy, "datagrams") == 200, "all came in")
        lost = up(proxy, "datagrams_lost")
        await until(lambda: len(target.got) == 200 - lost, "the others arrive")
        assert 30 <= lost <= 90
        client.close()


def test_bursts_of_loss() -> None:
    loss = Loss(LinkModel(burst_loss=BurstLoss(enter=0.02, leave=0.2)), Random(1))
    fates = [loss.strikes() for _ in range(50_000)]
    share = sum(fates) / len(fates)
    assert 0.07 < share < 0.11, "0.02 / 0.22"
    after = sum(b for a, b in pairwise(fates) if a) / sum(fates)
    assert 0.75 < after < 0.85, "a burst goes on with 0.8"
    assert not any(Loss(LinkModel(), Random(1)).strikes() for _ in range(100))


async def test_a_mapping_too_many_forgets_the_oldest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(proxy_datagrams, "MAPPINGS", 2)
    target = Target()
    async with through(FAST, target) as proxy:
        clients = [udp() for _ in range(3)]
        for count, client in enumerate(clients, start=1):
            client.sendto(b"%d" % count, proxy.addresses[0])
            await until(lambda n=count: len(target.got) == n, "it arrives")  # type: ignore[misc]
        assert [route.clients for route in proxy._datagrams] == [2]
        for client in clients:
            client.close()
