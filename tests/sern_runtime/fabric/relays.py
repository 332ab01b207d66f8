"""Ports of relays on loopback, what their owners were told, and certificates for them."""

import asyncio
import json
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from contextlib import AsyncExitStack, asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any

from sern_core.vocabulary.types import ClientName
from sern_runtime.config.fabric import CA_FILE, CertificateFiles, certificate_file, key_file
from sern_runtime.fabric.port import FabricPort, PeerRelay
from sern_runtime.fabric.sealed_port import port_of
from sern_runtime.fabric.zenoh_settings import FabricOptions
from sern_tools.ports import free_ports
from tests.support import DEADLINE_S

BOOT = 2**62 + 7
A, B, C = (ClientName(name) for name in ("relay_a", "relay_b", "relay_c"))


class Told:
    """A `FabricEvents` that writes down, and wakes whoever waits."""

    def __init__(self) -> None:
        self.peers: dict[ClientName, PeerRelay] = {}
        self.news: list[tuple[str, object]] = []
        self.datagrams: list[tuple[ClientName, bytes]] = []
        self.on_datagram: Callable[[ClientName, bytes], None] = lambda _source, _datagram: None
        """Is told of each datagram as well."""
        self.raises_at_bytes: int | None = None
        """An owner's error at every datagram of that size."""
        self._changed = asyncio.Event()

    def peer_up(self, peer: PeerRelay) -> None:
        self.peers[peer.name] = peer
        self._note("up", peer)

    def peer_down(self, name: ClientName, boot: int) -> None:
        if self.peers[name].boot == boot:
            del self.peers[name]
        self._note("down", (name, boot))

    def arrived(self, source: ClientName, datagram: bytes) -> None:
        self.datagrams.append((source, datagram))
        self._changed.set()
        self.on_datagram(source, datagram)
        if len(datagram) == self.raises_at_bytes:
            raise ZeroDivisionError

    def _note(self, kind: str, what: object) -> None:
        self.news.append((kind, what))
        self._changed.set()

    async def until(self, condition: Callable[[], object]) -> None:
        """Until it holds; it is looked at whenever something was told."""
        async with asyncio.timeout(DEADLINE_S):
            while not condition():
                await self._changed.wait()
                self._changed.clear()


class Relay:
    """A port that runs, and what it told."""

    def __init__(self, options: FabricOptions) -> None:
        self.told = Told()
        self.port: FabricPort = port_of(options, self.told)
        self.name = options.name

    async def until(self, condition: Callable[[], object]) -> None:
        await self.told.until(condition)


def files(folder: Path, relay: str, *, key_of: str | None = None, ca: Path | None = None) -> CertificateFiles:
    """The certificate files of a relay, with another's key or another authority where a test wants that."""
    key = folder / key_file(key_of or relay)
    return CertificateFiles((ca or folder) / CA_FILE, folder / certificate_file(relay), key)


def options(name: ClientName, *, listen: int | None = None, connect: Sequence[int] = (), **more: Any) -> FabricOptions:
    """On loopback; over TLS where `certificates` are given."""
    protocol = "tcp" if more.get("certificates") is None else "tls"
    if more.get("certificates") is not None:
        more.setdefault("relays", tuple(other for other in (A, B, C) if other != name))
    return FabricOptions(
        name=name,
        boot=more.pop("boot", BOOT),
        listen=() if listen is None else (f"{protocol}/127.0.0.1:{listen}",),
        peers=tuple(f"{protocol}/127.0.0.1:{port}" for port in connect),
        **more,
    )


@asynccontextmanager
async def running(*chosen: FabricOptions) -> AsyncIterator[list[Relay]]:
    async with AsyncExitStack() as stack:
        relays = []
        for each in chosen:
            relay = Relay(each)
            stack.push_async_callback(relay.port.close)
            await relay.port.start()
            relays.append(relay)
        yield relays


def chain(certificates: Path | None = None, **more: Any) -> tuple[FabricOptions, FabricOptions]:
    """Two relays, of which the second connects."""
    (port,) = free_ports(1)
    own = (None, None) if certificates is None else (files(certificates, A), files(certificates, B))
    return options(A, listen=port, certificates=own[0], **more), options(B, connect=[port], certificates=own[1], **more)


class Wire:
    """What is between a relay and the port that it connects to."""

    def __init__(self, to: int) -> None:
        self.port = 0
        self._to = to
        self._open = asyncio.Event()
        self._open.set()
        self._cut = False
        self._tasks: set[asyncio.Task[None]] = set()
        self._server: asyncio.Server | None = None

    async def start(self) -> None:
        self._server = await asyncio.start_server(self._accept, "127.0.0.1", 0)
        self.port = self._server.sockets[0].getsockname()[1]

    def close_door(self, *, cut: bool) -> None:
        """Let nothing through. `cut`: connections end, and no new ones begin; else they stay, and are silent."""
        self._open.clear()
        self._cut = cut
        if cut:
            for task in self._tasks:
                task.cancel()

    def open_door(self) -> None:
        self._cut = False
        self._open.set()

    async def stop(self) -> None:
        if self._server is not None:
            self._server.close()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self._cut:
            writer.transport.abort()
            return
        task = asyncio.create_task(self._carry(reader, writer))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _carry(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        others: list[asyncio.StreamWriter] = [writer]
        try:
            there, back = await asyncio.open_connection("127.0.0.1", self._to)
            others.append(back)
            async with asyncio.TaskGroup() as group:
                group.create_task(self._one_way(reader, back))
                group.create_task(self._one_way(there, writer))
        except* OSError:
            pass
        finally:
            for each in others:
                each.transport.abort()

    async def _one_way(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while data := await reader.read(65_536):
            await self._open.wait()
            writer.write(data)
            await writer.drain()
        raise ConnectionError


@asynccontextmanager
async def between(port: int) -> AsyncIterator[Wire]:
    wire = Wire(port)
    await wire.start()
    try:
        yield wire
    finally:
        await wire.stop()


@contextmanager
def external_router(
    port: int, certificates: CertificateFiles | None = None, *, beside: int | None = None
) -> Iterator[Any]:
    """A zenoh router that is none of ours, and its session, which may do what a router can. It connects to the one at
    the port `beside`."""
    import zenoh

    told: dict[str, Any] = {
        "mode": "router",
        "listen/endpoints": [f"{'tcp' if certificates is None else 'tls'}/127.0.0.1:{port}"],
        "connect/endpoints": [] if beside is None else [f"tcp/127.0.0.1:{beside}"],
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
    }
    if certificates is not None:
        told["transport/link/tls"] = {
            "root_ca_certificate": str(certificates.ca),
            "listen_certificate": str(certificates.certificate),
            "listen_private_key": str(certificates.key),
            "enable_mtls": True,
        }
    config = zenoh.Config()
    for key, value in told.items():
        config.insert_json5(key, json.dumps(value))
    with zenoh.open(config) as session:
        yield session
