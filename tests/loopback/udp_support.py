"""What tests of the UDP lane use: a relay that notes what happens, and a client made by hand that may misbehave."""

import socket as socketlib
from collections.abc import Callable, Sequence
from contextlib import suppress

from sern_core.vocabulary.types import ClientName
from sern_runtime.seal import Cipher, SessionParameters, Side, make_seals
from sern_runtime.udp import TYPE_CHALLENGE, TYPE_DATA, TYPE_RESPONSE, UdpServer, UdpSession
from sern_runtime.udp_client import UdpClient
from sern_runtime.udp_socket import Address
from tests.support import until

OFFERED = tuple(Cipher)
ROBOT, SITE = ClientName("robot1"), ClientName("site1")


class Relay:
    """A UdpServer and what it reported. Close it."""

    def __init__(
        self,
        listen: Sequence[str] = ("udp://127.0.0.1:*",),
        *,
        echo: bool = False,
        ciphers: Sequence[Cipher] | None = None,
    ) -> None:
        self.received: list[tuple[ClientName, bytes]] = []
        self.paths: list[tuple[ClientName, Address, bool]] = []
        self.writable: list[ClientName] = []
        self.batches = 0
        self._echo = echo
        self.server = UdpServer(
            listen,
            self._datagram,
            on_path=lambda session, address, validated: self.paths.append((session.client, address, validated)),
            on_writable=lambda session: self.writable.append(session.client),
            after=self._after,
            ciphers=ciphers,
        )

    def _datagram(self, session: UdpSession, data: bytes, now: float) -> None:
        assert now > 0
        self.received.append((session.client, data))
        if self._echo:
            session.send(b"echo " + data)

    def _after(self) -> None:
        self.batches += 1

    def data(self, client: ClientName = ROBOT) -> list[bytes]:
        return [data for name, data in self.received if name == client]

    def open(self, client: ClientName = ROBOT, offered: Sequence[str] = OFFERED) -> UdpSession:
        return self.server.open_session(client, offered)

    def close(self) -> None:
        self.server.close()


class RawClient:
    """The client's end of a session by hand, on a socket of its own, or several (`elsewhere`). Close it."""

    def __init__(self, parameters: SessionParameters, *, side: Side = Side.CLIENT) -> None:
        self.parameters = parameters
        self.sealer, self.opener = make_seals(parameters, side)
        self.sockets: list[socketlib.socket] = []
        self._relay_ports: set[int] = set()
        self.elsewhere()
        self.got: list[tuple[int, int, bytes]] = []
        """(index of the socket, size of the datagram, what was sealed)."""

    def elsewhere(self) -> int:
        """One more address; returns its index."""
        socket = socketlib.socket(socketlib.AF_INET, socketlib.SOCK_DGRAM)
        socket.bind(("127.0.0.1", 0))
        socket.setblocking(False)
        self.sockets.append(socket)
        return len(self.sockets) - 1

    def address(self, index: int = 0) -> tuple[str, int]:
        host, port = self.sockets[index].getsockname()
        return str(host), int(port)

    def seal(self, data: bytes, kind: bytes = TYPE_DATA) -> bytes:
        return self.sealer.seal(kind + data)

    def put(self, datagram: bytes, index: int = 0) -> None:
        """Send bytes as they are."""
        self._relay_ports.add(self.parameters.port)
        self.sockets[index].sendto(datagram, ("127.0.0.1", self.parameters.port))

    def send(self, data: bytes, index: int = 0, kind: bytes = TYPE_DATA) -> bytes:
        datagram = self.seal(data, kind)
        self.put(datagram, index)
        return datagram

    def poll(self) -> list[tuple[int, int, bytes]]:
        for index, socket in enumerate(self.sockets):
            with suppress(BlockingIOError):
                while True:
                    datagram, (_host, port) = socket.recvfrom(65536)
                    if port not in self._relay_ports:
                        continue  # meant for whoever had our port before: relays speak to lost clients for a while
                    inner = self.opener.open(datagram)
                    assert inner is not None, "the relay sent what does not open"
                    self.got.append((index, len(datagram), inner))
        return self.got

    def inner(self, kind: bytes, index: int | None = None) -> list[bytes]:
        """What came of one type, so far."""
        return [inner[1:] for at, _, inner in self.poll() if inner[:1] == kind and index in (None, at)]

    def bytes_at(self, index: int) -> int:
        return sum(size for at, size, _ in self.poll() if at == index)

    async def answer_challenge(self, index: int = 0) -> None:
        """Wait for a challenge at one address, and answer the newest from there."""
        await until(lambda: self.inner(TYPE_CHALLENGE, index), "a challenge")
        self.send(self.inner(TYPE_CHALLENGE, index)[-1], index, TYPE_RESPONSE)

    def close(self) -> None:
        for socket in self.sockets:
            socket.close()


class Client:
    """A UdpClient and what it reported. Close it."""

    def __init__(
        self,
        parameters: SessionParameters,
        host: str = "127.0.0.1",
        port: int | None = None,
        *,
        on_data: Callable[[bytes], None] | None = None,
    ) -> None:
        self.received: list[bytes] = []
        self.paths: list[tuple[Address, bool]] = []
        self.writable = 0
        self._on_data = on_data
        self.udp = UdpClient(
            host,
            parameters.port if port is None else port,
            parameters,
            self._datagram,
            on_path=lambda address, validated: self.paths.append((address, validated)),
            on_writable=self._on_writable,
        )

    def _datagram(self, data: bytes, now: float) -> None:
        assert now > 0
        self.received.append(data)
        if self._on_data is not None:
            self._on_data(data)

    def _on_writable(self) -> None:
        self.writable += 1

    @property
    def local(self) -> tuple[str, int]:
        assert self.udp.socket is not None
        host, port = self.udp.socket.socket.getsockname()[:2]
        return str(host), int(port)

    async def validated(self) -> None:
        await until(lambda: self.udp.validated, "the relay's answer")

    def close(self) -> None:
        self.udp.close()
