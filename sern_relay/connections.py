"""The relay's connections on which a client has spoken: whose each is, and what serves it. One table for all kinds."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

from sern_core.relay.hub_port import HubPort
from sern_core.vocabulary.types import ClientName
from sern_runtime.monitor import Connection, ConnectionTable, TcpHandle
from sern_runtime.pump import Pump


class Served(NamedTuple):
    """A connection's port of the hub, and the pump that serves it."""

    port: HubPort
    pump: Pump


@dataclass(slots=True, eq=False)
class ClientConnection:
    """One connection. `user` is its User-Id, `client` the name in it, `accepted` its socket as it was accepted (None:
    not known). `served` None: it is for class control alone."""

    routing_id: bytes
    client: ClientName
    user: str
    fd: int
    accepted: Connection | None
    served: Served | None = None
    taken: int = 0  # messages that have come in

    @property
    def handle(self) -> TcpHandle | None:
        """Its TCP socket; None: it has none, as over ipc."""
        return None if self.accepted is None else self.accepted.handle


class ClientConnections:
    """All of them by routing id, in the order in which they came. `accepted` are the sockets of all connections."""

    def __init__(self, accepted: ConnectionTable) -> None:
        self.accepted = accepted
        self._by_id: dict[bytes, ClientConnection] = {}
        self.get = self._by_id.get
        """`get(routing_id)`: the connection, or None; called for each datagram."""

    def add(self, connection: ClientConnection) -> None:
        self._by_id[connection.routing_id] = connection

    def remove(self, routing_id: bytes) -> ClientConnection | None:
        """Forget a connection; None: it was not known."""
        return self._by_id.pop(routing_id, None)

    def clear(self) -> None:
        self._by_id.clear()

    def sessions(self) -> Iterator[tuple[ClientConnection, Served]]:
        """Those that are for sessions."""
        return ((each, each.served) for each in self._by_id.values() if each.served is not None)

    def all(self) -> list[ClientConnection]:
        """Each of them, of either kind."""
        return list(self._by_id.values())

    def for_control(self) -> list[ClientConnection]:
        """Those for class control alone."""
        return [each for each in self._by_id.values() if each.served is None]

    def lost(self) -> list[ClientConnection]:
        """Those whose socket has ended, or is another's by now."""
        return [each for each in self._by_id.values() if self.accepted.by_fd(each.fd) is not each.accepted]

    def taken(self) -> Iterator[tuple[TcpHandle, int]]:
        """Every socket, and how many messages came out of it."""
        taken = {each.fd: each.taken for each in self._by_id.values()}
        return ((handle, taken.get(handle.fd, 0)) for handle in self.accepted.handles())
