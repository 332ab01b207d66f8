"""A client behind a NAT that forgets its mappings: the datagram lane goes on from another port or address, and the
reliable streams in both directions stay complete."""

import asyncio
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Final

import pytest

from sern_client.daemon import ClientDaemon
from sern_tools.ports import free_ports
from tests.daemons import HOST, Lab, bodies, under, write_bag
from tests.support import until

INSIDE: Final = "127.0.0.2"
"""Where the client finds the relay; only the NAT knows that it is elsewhere."""
COUNT: Final = 1000
NAMES: Final = ("robot1", "site1")
ANY = ("", 0)


class Outer(asyncio.DatagramProtocol):
    """The NAT's socket towards the relay: one mapping."""

    def __init__(self, back: Callable[[bytes], None]) -> None:
        self.back = back
        self.replies = 0

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        self.replies += 1
        self.back(data)


class Nat(asyncio.DatagramProtocol):
    """Forwards what comes to `INSIDE`:port, datagrams and TCP connections, to the same port of `HOST`.

    `rebind` gives datagrams another outer socket; what is sent to the old one is lost. `cut` makes the TCP connections
    of now hang: neither end is told. New ones pass. Without `answers` no datagram comes back.
    """

    def __init__(self, port: int, *, answers: bool = True) -> None:
        self.port = port
        self._answers = answers
        self.outer: asyncio.DatagramTransport | None = None
        self.mapping = Outer(self._back)
        self._client: tuple[str, int] = ANY
        self._inner: asyncio.DatagramTransport | None = None
        self._server: asyncio.Server | None = None
        self._pipes: set[asyncio.Task[None]] = set()
        self._hanging: list[asyncio.StreamWriter] = []

    async def start(self) -> None:
        loop = asyncio.get_running_loop()
        self._inner, _ = await loop.create_datagram_endpoint(lambda: self, local_addr=(INSIDE, self.port))
        self._server = await asyncio.start_server(self._connected, INSIDE, self.port)
        await self.rebind("127.0.0.3")

    async def rebind(self, address: str) -> Outer:
        if self.outer is not None:
            self.outer.close()
        loop = asyncio.get_running_loop()
        self.mapping = mapping = Outer(self._back)
        self.outer, _ = await loop.create_datagram_endpoint(lambda: mapping, local_addr=(address, 0))
        return mapping

    def block(self) -> None:
        """TCP passes, datagrams are swallowed, until `rebind`."""
        assert self.outer is not None
        self.outer.close()
        self.outer = None

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        self._client = addr
        if self.outer is not None:
            self.outer.sendto(data, (HOST, self.port))

    def _back(self, data: bytes) -> None:
        if self._answers and self._inner is not None and self._client is not ANY:
            self._inner.sendto(data, self._client)

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        far_reader, far_writer = await asyncio.open_connection(HOST, self.port)
        self._hanging += [writer, far_writer]
        for source, sink in ((reader, far_writer), (far_reader, writer)):
            task = asyncio.create_task(self._pipe(source, sink))
            self._pipes.add(task)
            task.add_done_callback(self._pipes.discard)

    async def _pipe(self, source: asyncio.StreamReader, sink: asyncio.StreamWriter) -> None:
        with suppress(OSError):
            while data := await source.read(65536):
                sink.write(data)
                await sink.drain()
            sink.close()

    async def cut(self) -> None:
        tasks = list(self._pipes)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def close(self) -> None:
        if self._server is not None:
            self._server.close()
        await self.cut()
        for writer in self._hanging:
            writer.close()
            with suppress(OSError):
                await writer.wait_closed()
        for transport in (self.outer, self._inner):
            if transport is not None:
                transport.close()


@pytest.mark.parametrize("hangs", [False, True], ids=["datagrams", "everything"])
@pytest.mark.parametrize("behind", ["robot1", "site1"])
async def test_a_forgotten_mapping_loses_nothing_reliable(
    tmp_path: Path, behind: str, hangs: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The sender is behind the NAT, or the receiver. `everything`: the NAT has forgotten the TCP connection as well, as
    one does that was restarted."""
    monkeypatch.setattr(
        "sern_core.path.flight.STALL_MIN_S", 30.0
    )  # a busy machine's pause is no lane without datagrams
    (port,) = free_ports(1)
    bag = write_bag(tmp_path / "run.bag", {"/log": COUNT})
    nat = Nat(port)
    async with Lab(tmp_path, "robot1", "site1", relay_port=port) as lab:
        try:
            await lab.relay()
            await nat.start()
            relay = {name: {"endpoint": f"tcp://{INSIDE if name == behind else HOST}:{port}"} for name in NAMES}
            site = await lab.connected(lab.recorder_file("site1", "/robot1/.*", relay=relay["site1"]))
            play = {"rate": 0.25}
            robot = await lab.connected(lab.player_file("robot1", bag, play=play, relay=relay["robot1"]))
            link = (robot if behind == "robot1" else site).core.link
            await until(lambda: link.lane.name == "udp", "datagrams are used")
            under_way = 0
            for address in ("127.0.0.3", "127.0.0.4", "127.0.0.3", "127.0.0.5"):
                before = delivered(site)
                under_way += before < COUNT
                if hangs:
                    await nat.cut()
                mapping = await nat.rebind(address)
                await until(partial(_answered, mapping), f"the relay answers to {address}")
                await until(partial(_more, site, before), "the site hears more")
                assert link.lane.name == "udp", "it has fallen back"
            assert under_way, "everything was there before the first change"
            await until(lambda: delivered(site) == COUNT, "everything has arrived")
        finally:
            await nat.close()
    assert bodies(tmp_path / "site1.bag") == under("robot1", bodies(bag))


def delivered(site: ClientDaemon) -> int:
    return int(site.topics().get("/robot1/log", {}).get("delivered", 0))


def _answered(mapping: Outer) -> bool:
    return mapping.replies > 0


def _more(site: ClientDaemon, before: int) -> bool:
    return delivered(site) > before or before == COUNT
