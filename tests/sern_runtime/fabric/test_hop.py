"""Two pure links over two ports on loopback: a session, large messages, and what is dropped on the way."""

from pathlib import Path

import pytest

from sern_core.vocabulary.errors import RemoteError
from sern_core.vocabulary.message import TopicSpec
from sern_core.vocabulary.types import ClientName, PriorityClass, Reliability
from sern_runtime import clock
from sern_runtime.fabric.hop import ANY_SIZE, LOSSLESS, FabricHop
from sern_runtime.fabric.port import FabricCounters, FabricPort
from tests.sern_runtime.fabric.relays import Told, chain, running
from tests.support import until
from tests.two_links import BareEnd, pair

pytest.importorskip("zenoh", reason="zenoh is not installed: pip install 'sern[zenoh]'")

RELIABLE = TopicSpec(PriorityClass.STATE, reliability=Reliability.RELIABLE, depth=200, lifespan_s=None)
COMMANDS = TopicSpec(PriorityClass.CONTROL, reliability=Reliability.RELIABLE, depth=200, lifespan_s=None)


class Losing:
    """A port that loses every tenth datagram on its way out, and says nothing of it, as a full queue does."""

    def __init__(self, port: FabricPort) -> None:
        self._port = port
        self.lost = 0
        self._count = 0

    @property
    def counters(self) -> FabricCounters:
        return self._port.counters

    def send(self, destination: ClientName, priority: PriorityClass, datagram: bytes) -> bool:
        self._count += 1
        if self._count % 10 == 0:
            self.lost += 1
            return True
        return self._port.send(destination, priority, datagram)

    async def start(self) -> None: ...
    async def close(self) -> None: ...


def hand_over(told: Told, hop: FabricHop) -> None:
    """Whatever arrives is the hop's."""
    told.on_datagram = lambda _source, datagram: hop.arrived(datagram)


@pytest.mark.parametrize("losing", [False, True])
async def test_a_hop_over_a_fabric(certificates: Path, losing: bool) -> None:
    one, other = chain(certificates)
    async with running(one, other) as (a, b):
        await a.until(lambda: a.told.peers)
        await b.until(lambda: b.told.peers)
        first, second = pair(now=clock.now(), lossless=LOSSLESS, any_size=ANY_SIZE)
        port: FabricPort = Losing(a.port) if losing else a.port
        hops = [FabricHop(port, b.name, first.port), FabricHop(b.port, a.name, second.port)]
        hand_over(a.told, hops[0])
        hand_over(b.told, hops[1])
        try:
            await _exchange(first, second, hops)
            if isinstance(port, Losing):
                assert port.lost
            assert hops[0].datagrams and hops[1].datagrams
        finally:
            for hop in hops:
                hop.close()
        for end in (first, second):
            assert not end.faults
            end.link.validate()


async def _exchange(first: BareEnd, second: BareEnd, hops: list[FabricHop]) -> None:
    channels = [first.open("/log", RELIABLE, now=clock.now()), first.open("/do", COMMANDS, now=clock.now())]
    first.link.connected(now=clock.now())
    hops[0].kick()
    await until(lambda: all(channel.ready for channel in channels))
    sent: list[list[bytes]] = [[], []]
    for number in range(60):
        for which, size in ((0, 20_000), (1, 40)):
            body = bytes([which, number]) * (size // 2)
            assert first.submit(channels[which], body, now=clock.now())
            sent[which].append(body)
        hops[0].kick()
    await until(lambda: len(second.got) == 120)
    for which in (0, 1):
        assert [body for body in second.got if body[0] == which] == sent[which]


async def test_bytes_of_no_peer_of_ours_are_told(certificates: Path) -> None:
    one, other = chain(certificates)
    async with running(one, other) as (a, b):
        await b.until(lambda: b.told.peers)
        first, _ = pair(now=clock.now(), lossless=LOSSLESS, any_size=ANY_SIZE)
        errors: list[RemoteError] = []
        hop = FabricHop(b.port, a.name, first.port, on_unreadable=errors.append)
        hop.arrived(b"\x00" * 40)
        assert len(errors) == 1
        hop.close()
        hop.close()
