"""Something between a client and its relay: what comes to it at an address of its own, it passes on."""

import asyncio
from collections.abc import Callable
from contextlib import suppress
from typing import Final

from tests.daemons import HOST

INSIDE: Final = "127.0.0.2"
"""The address at which the client finds the relay; only what is between them knows that it is elsewhere."""
ANY: Final = ("", 0)


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


class Repeater(Nat):
    """Has all datagrams: each goes on twice, and again when `AGAIN` others have followed."""

    AGAIN: Final = 50

    def __init__(self, port: int) -> None:
        super().__init__(port)
        self.repeated = 0
        self._kept: list[bytes] = []

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        self._kept.append(data)
        again = [self._kept.pop(0)] if len(self._kept) > self.AGAIN else []
        for datagram in (data, data, *again):
            super().datagram_received(datagram, addr)
        self.repeated += 1 + len(again)
