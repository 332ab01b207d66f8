"""The relay's lane: one ROUTER for all clients, one port of the hub for each connection."""

import logging
from collections.abc import Callable, Iterator
from typing import Final

import zmq

from sern_core.relay.hub import Hub
from sern_core.relay.hub_port import HubPort
from sern_core.vocabulary.errors import RemoteError, UsageError, WireError
from sern_core.vocabulary.names import client_name
from sern_core.vocabulary.params import Redundancy
from sern_core.vocabulary.types import ClientName
from sern_core.wire import framing
from sern_relay.express import JOIN, Joined, RelayExpress
from sern_runtime import clock
from sern_runtime.config.keys import KeyStatus, parse_user_id
from sern_runtime.dscp import Marks
from sern_runtime.inflow import Inflow
from sern_runtime.monitor import Connection, ConnectionTable, TcpHandle
from sern_runtime.pump import LANE_MESSAGE_BYTES, Pump
from sern_runtime.zmq_socket import CurvePair, RouterSocket, SendResult, make_server

MAX_PORTS: Final = 4
"""Connections of one client for its session: the one that has it, another process under the same name, and those that
a change of network left behind. Those for class control alone are bounded by `RelayExpress`."""
SILENT_INTERVALS: Final = 2.0
"""Times `handshake_interval_s` until a connection must have spoken: once for the handshake, and once for what is said
right after it."""
MAX_TOLD: Final = 1024
"""Clients of which is logged, once each, that they have too many connections."""
REFUSED_KEY: Final = {
    KeyStatus.UNKNOWN: "is revoked",
    KeyStatus.EXPIRED: "has expired",
    KeyStatus.NOT_YET: "is not valid yet",
}
"""What the log says of a key that was let in and does not hold any more."""

_log = logging.getLogger(__name__)


class Session:
    """One connection: its port of the hub and the pump that serves it."""

    __slots__ = ("connection", "fd", "port", "pump", "taken", "user")

    def __init__(self, port: HubPort, pump: Pump, user: str, fd: int, connection: Connection | None) -> None:
        self.port = port
        self.pump = pump
        self.user = user
        self.fd = fd
        self.connection = connection
        self.taken = 0  # messages that have come in


class RelayServer:
    """Binds the listeners and joins them to `hub`. Without `keys` clients are who their HELLO says they are.

    `key_status(name, key)` is asked when a connection first speaks: its key may not hold any more since it was let in.
    The key is that of its handshake, which the User-Id carries; empty without `keys`. `after` is called whenever
    something came in.
    """

    def __init__(
        self,
        ctx: "zmq.Context[zmq.Socket[bytes]]",
        hub: Hub,
        listen: tuple[str, ...],
        keys: CurvePair | None,
        zap_domain: str,
        *,
        key_status: Callable[[ClientName, str], KeyStatus],
        heartbeat_timeout_s: float,
        handshake_interval_s: float,
        max_connections: int,
        redundancy: Redundancy,
        after: Callable[[], None],
        marks: Marks | None = None,
    ) -> None:
        self.hub = hub
        self.bad_frames = 0
        self.revoked = 0
        """Connections that spoke first when their key was no longer known."""
        self.surplus = 0
        """Connections that were cut because their client had `MAX_PORTS` others."""
        self.silent = 0
        """Connections that were cut because nothing was said on them."""
        self._silent_s = SILENT_INTERVALS * handshake_interval_s
        self._told: set[ClientName] = set()
        self._key_status = key_status
        self._marks = marks or Marks()
        self._insecure = keys is None
        self._after = after
        self._sessions: dict[bytes, Session] = {}
        self.express = RelayExpress(hub, self._send, redundancy, after=after)
        raw = make_server(
            ctx,
            listen,
            keys,
            zap_domain,
            heartbeat_timeout_ms=int(heartbeat_timeout_s * 1000),
            handshake_ivl_ms=int(handshake_interval_s * 1000),
            max_message_bytes=LANE_MESSAGE_BYTES,
        )
        self.connections = ConnectionTable(raw, max_connections=max_connections, on_change=self._connections_changed)
        self.socket = RouterSocket(
            raw, self._received, on_view=self._received, identified=keys is not None, on_writable=self._writable
        )
        self.socket.on_refused = self._refused
        self.inflow = Inflow(self.socket, self._taken, self._endless)

    def close(self) -> None:
        for session in self._sessions.values():
            session.pump.close()
        self._sessions.clear()
        self.express.close()
        self.inflow.close()
        self.connections.close()
        self.socket.close()

    def _received(self, routing_id: bytes, user: str, data: framing.Datagram) -> None:
        session = self._sessions.get(routing_id)
        if session is None:
            joined = self.express.joined.get(routing_id)
            if joined is not None:
                self._received_express(routing_id, joined, user, data)
                return
            session = self._accept(routing_id, user, bytes(data))
            if session is None:
                return
        elif user != session.user:
            self._cut(routing_id, session, f"its identity changed to {user!r}")
            return
        session.taken += 1
        try:
            session.port.receive(data, now=clock.now())
        except RemoteError as error:
            self.bad_frames += 1
            self._cut(routing_id, session, f"bad frame: {error}")
            return
        self._after()

    def _refused(self, why: str) -> None:
        """What no SERN client sends: the message is dropped and counted, and the connection closed."""
        details = self.socket.peer_details()
        _log.warning("connection from %s closed: %s", details.address, why)
        self.connections.cut(details.fd)

    def _taken(self) -> Iterator[tuple[TcpHandle, int]]:
        """Every connection, and how many messages came out of it."""
        taken = {session.fd: session.taken for session in self._sessions.values()}
        taken |= {joined.fd: joined.taken for joined in self.express.joined.values()}
        return ((handle, taken.get(handle.fd, 0)) for handle in self.connections.handles())

    def _endless(self, handle: TcpHandle) -> None:
        connection = self.connections.by_fd(handle.fd)
        whose = connection.user if connection is not None and connection.user else handle.peer[0]
        _log.warning("connection of %s closed: a message without end", whose)

    def _received_express(self, routing_id: bytes, joined: Joined, user: str, data: framing.Datagram) -> None:
        if user != joined.user:
            problem = f"its identity changed to {user!r}"
        else:
            try:
                self.express.received(routing_id, joined, data)
            except RemoteError as error:
                self.bad_frames += 1
                problem = f"bad frame: {error}"
            else:
                joined.taken += 1
                self._after()
                return
        _log.warning("connection of %s for class control closed: %s", joined.client, problem)
        self.express.left(routing_id)
        self.connections.cut(joined.fd)

    def _accept(self, routing_id: bytes, user: str, data: bytes) -> Session | None:
        """A connection speaks for the first time: find out whose it is."""
        details = self.socket.peer_details()
        if self.connections.ended(details.fd):
            return None
        try:
            name, key = (client_name(self._claimed(data)), "") if self._insecure else parse_user_id(user)
        except (WireError, UsageError) as error:
            self.bad_frames += 1
            _log.warning("connection from %s closed: bad frame: %s", details.address, error)
            self.connections.cut(details.fd)
            return None
        status = self._key_status(name, key)
        if status is not KeyStatus.VALID:
            self.revoked += 1
            _log.warning("connection from %s closed: the key of %s %s", details.address, name, REFUSED_KEY[status])
            self.connections.cut(details.fd)
            return None
        self.connections.bind_user(details.fd, name)
        connection = self.connections.by_fd(details.fd)
        handle = connection.handle if connection is not None else None
        if handle is not None:
            express = data[2:3] == JOIN
            marks = self._marks
            handle.prepare(express=express, tos=marks.express_tos if express else marks.stream_tos)
        if data[2:3] == JOIN:
            self._join(routing_id, Joined(name, user, details.fd, connection), data)
            return None
        self._make_room(name)
        port = HubPort(self.hub, name, details.address if handle is None else "{}:{}".format(*handle.peer))

        def send(datagram: bytes) -> SendResult:
            return self.socket.send_to(routing_id, datagram)

        pump = Pump(port, send, on_gone=lambda: self._gone(routing_id))
        session = self._sessions[routing_id] = Session(port, pump, user, details.fd, connection)
        return session

    def _make_room(self, client: ClientName) -> None:
        """One more connection of a client is to come: where it has enough, the oldest without its session goes."""
        ports = [(rid, session) for rid, session in self._sessions.items() if session.port.client == client]
        spare = [(rid, session) for rid, session in ports if not session.port.current]
        for routing_id, session in spare[: max(0, len(ports) + 1 - MAX_PORTS)]:
            self.surplus += 1
            if client not in self._told and len(self._told) < MAX_TOLD:
                self._told.add(client)
                _log.warning("%s has more than %d connections; the oldest without its session end", client, MAX_PORTS)
            self._gone(routing_id)
            self.connections.cut(session.fd)

    def look(self) -> None:
        """See to connections. Call about once a second."""
        self.silent += self.connections.cut_silent(self._silent_s)
        self.express.look()

    def _send(self, routing_id: bytes, datagram: bytes) -> SendResult:
        return self.socket.send_to(routing_id, datagram)

    def _join(self, routing_id: bytes, joined: Joined, data: bytes) -> None:
        """A connection for class control: of a session that its own client has, or of none, and then it is closed."""
        try:
            older = self.express.join(routing_id, joined, data)
        except RemoteError as error:
            self.bad_frames += 1
            _log.warning("connection of %s for class control closed: bad frame: %s", joined.client, error)
            older = joined
        if older is not None:
            self.connections.cut(older.fd)
        self._after()

    @staticmethod
    def _claimed(data: bytes) -> str:
        """Without keys the first datagram must be a HELLO or a JOIN, and its name is believed."""
        header = framing.decode_header(data)
        if header.kind not in (framing.Kind.HELLO, framing.Kind.JOIN):
            raise WireError("the first datagram of a connection must be HELLO or JOIN")
        return framing.take_str(framing.decode_handshake(data), "name", max_length=64)

    def flush(self) -> None:
        """Let every port that has something to say say it."""
        for session in self._sessions.values():
            if session.port.dirty:
                session.pump.kick()
        self.express.flush()

    def run_all(self) -> None:
        for session in list(self._sessions.values()):
            session.pump.run()

    def _writable(self) -> None:
        for session in self._sessions.values():
            session.pump.kick()
        self.express.kick()

    def local_port(self, client: ClientName) -> int | None:
        """The number of our port to which the client's session came by TCP; None while it has no such connection, as
        over ipc."""
        for session in self._sessions.values():
            if session.port.client == client and session.port.current:
                handle = session.connection.handle if session.connection is not None else None
                return None if handle is None else handle.local[1]
        return None

    def cut_client(self, client: str) -> int:
        """End every connection of a client at once; returns how many there were."""
        for routing_id, session in list(self._sessions.items()):
            if session.port.client == client:
                self._gone(routing_id)
        self.express.end(client)
        return self.connections.cut_user(client)

    def cut_unbound(self) -> int:
        """End every connection that has not said anything yet; returns how many there were."""
        return self.connections.cut_user("")

    def _cut(self, routing_id: bytes, session: Session, why: str) -> None:
        _log.warning("connection of %s closed: %s", session.port.client, why)
        self._gone(routing_id)
        self.connections.cut(session.fd)

    def _gone(self, routing_id: bytes) -> None:
        session = self._sessions.pop(routing_id, None)
        if session is not None:
            session.pump.close()
            session.port.disconnected(now=clock.now())
            self._after()

    def _connections_changed(self) -> None:
        for routing_id, session in list(self._sessions.items()):
            if self.connections.by_fd(session.fd) is not session.connection:
                self._gone(routing_id)
        for routing_id, joined in list(self.express.joined.items()):
            if self.connections.by_fd(joined.fd) is not joined.connection:
                self.express.left(routing_id)
