"""The relay's stream lane: one ROUTER for all clients, one port of the hub for each connection of a session."""

import logging
from collections.abc import Callable
from typing import Final

import zmq

from sern_core.relay.hub import Hub
from sern_core.relay.hub_port import HubPort
from sern_core.vocabulary.errors import ConfigError, RemoteError, UsageError, WireError
from sern_core.vocabulary.names import client_name
from sern_core.vocabulary.params import Redundancy
from sern_core.vocabulary.types import ClientName
from sern_core.wire import framing
from sern_relay.connections import ClientConnection, ClientConnections, Served
from sern_relay.priority_lanes import JOIN, RelayPriorityLanes
from sern_runtime import clock
from sern_runtime.config.keys import KeyStatus, parse_user_id, user_id
from sern_runtime.dscp import Marks
from sern_runtime.inflow import Inflow
from sern_runtime.monitor import ConnectionTable, TcpHandle
from sern_runtime.open_files import close_reserve
from sern_runtime.pump import LANE_MESSAGE_BYTES, Pump
from sern_runtime.zmq_setup import CurvePair, bind_all, make_server, serve_curve, unbind
from sern_runtime.zmq_socket import RouterSocket, SendResult

MAX_PORTS: Final = 4
"""Connections of one client for its session: the one that has it, another process under the same name, and those that
a change of network left behind. Those for class control alone are bounded by `RelayPriorityLanes`."""
SILENT_INTERVALS: Final = 2.0
"""Times `handshake_interval_s` until a connection must have spoken: once for the handshake, and once for what is said
right after it."""
UNBIND_S: Final = 1.0
"""How long libzmq may take to let go of an address; it does so within some milliseconds."""
MAX_TOLD: Final = 1024
"""Clients of which is logged, once each, that they have too many connections."""
REFUSED_KEY: Final = {
    KeyStatus.UNKNOWN: "is revoked",
    KeyStatus.REVOKED: "is revoked",
    KeyStatus.EXPIRED: "has expired",
    KeyStatus.NOT_YET: "is not valid yet",
}
"""What the log says of a key that was let in and does not hold any more."""

_log = logging.getLogger(__name__)


class RelayServer:
    """Binds the listeners and joins them to `hub`. Without `keys` clients are who their HELLO says they are.

    `key_status(name, key)` is asked when a connection first speaks: its key may not hold any more since it was let in.
    The key is that of its handshake, which the User-Id carries; empty without `keys`. `after` is called whenever
    something came in, `turned_away(address, key, why)` of each connection that ends before it is a client's.
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
        turned_away: Callable[[str, str, str], None] = lambda _address, _key, _why: None,
    ) -> None:
        self.hub = hub
        self._turned_away = turned_away
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
        self._over: set[ClientConnection] = set()
        self._burying = False  # connections that are over are still to be seen to
        self._listen = listen
        self._to_bind: tuple[str, ...] = ()
        self._after = after
        raw = make_server(
            ctx,
            listen,
            keys,
            zap_domain,
            heartbeat_timeout_ms=int(heartbeat_timeout_s * 1000),
            handshake_ivl_ms=int(handshake_interval_s * 1000),
            max_message_bytes=LANE_MESSAGE_BYTES,
        )
        self.connections = ConnectionTable(
            raw, max_connections=max_connections, on_change=self._connections_changed, on_capped=self._capped
        )
        self.clients = ClientConnections(self.connections)
        """Those of them on which a client has spoken."""
        self.priority_lanes = RelayPriorityLanes(hub, self.clients, self._send, redundancy, after=after)
        self.socket = RouterSocket(
            raw, self._received, on_view=self._received, identified=keys is not None, on_writable=self._writable
        )
        self.socket.on_refused = self._refused
        self.inflow = Inflow(self.socket, self.clients.taken, self._endless)

    def close(self) -> None:
        for _connection, served in self.clients.sessions():
            served.pump.close()
        self.priority_lanes.close()
        self.clients.clear()
        self.inflow.close()
        self.connections.close()
        self.socket.close()

    def _received(self, routing_id: bytes, user: str, data: framing.Datagram) -> None:
        connection = self.clients.get(routing_id)
        if connection is None:
            connection = self._accept(routing_id, user, bytes(data))
            if connection is None:
                return
        elif user != connection.user:
            self._cut(connection, f"its identity changed to {user!r}")
            return
        connection.taken += 1
        try:
            if connection.served is None:
                self.priority_lanes.received(connection, data)
            else:
                connection.served.port.receive(data, now=clock.now())
        except RemoteError as error:
            self.bad_frames += 1
            self._cut(connection, f"bad frame: {error}")
            return
        self._after()

    def _refused(self, why: str) -> None:
        """What no SERN client sends: the message is dropped and counted, and the connection closed."""
        details = self.socket.peer_details()
        _log.warning("connection from %s closed: %s", details.address, why)
        self._turned_away(details.address, "", why)
        self.connections.cut(details.fd)

    def _capped(self, source: str) -> None:
        _log.warning("connection from %s cut: there are as many as may be (max_connections, or half-open ones)", source)
        self._turned_away(source, "", "as many connections as may be")

    def _endless(self, handle: TcpHandle) -> None:
        connection = self.connections.by_fd(handle.fd)
        whose = connection.user if connection is not None and connection.user else handle.peer[0]
        _log.warning("connection of %s closed: a message without end", whose)

    def _accept(self, routing_id: bytes, user: str, data: bytes) -> ClientConnection | None:
        """A connection speaks for the first time: find out whose it is. None: what it said is dealt with."""
        details = self.socket.peer_details()
        if self.connections.ended(details.fd):
            return None
        try:
            name, key = (client_name(self._claimed(data)), "") if self._insecure else parse_user_id(user)
        except (WireError, UsageError) as error:
            self.bad_frames += 1
            _log.warning("connection from %s closed: bad frame: %s", details.address, error)
            self._turned_away(details.address, "", f"bad frame: {error}")
            self.connections.cut(details.fd)
            return None
        status = self._key_status(name, key)
        if status is not KeyStatus.VALID:
            self.revoked += 1
            _log.warning("connection from %s closed: the key of %s %s", details.address, name, REFUSED_KEY[status])
            self._turned_away(details.address, key, f"the key of {name} {REFUSED_KEY[status]}")
            self.connections.cut(details.fd)
            return None
        self.connections.bind_user(details.fd, name)
        accepted = self.connections.by_fd(details.fd)
        connection = ClientConnection(routing_id, name, user, details.fd, accepted)
        handle = connection.handle
        if handle is not None:
            joins = data[2:3] == JOIN
            marks = self._marks
            handle.prepare(priority_lane=joins, tos=marks.priority_lane_tos if joins else marks.stream_tos)
        if data[2:3] == JOIN:
            self._join(connection, data)
            return None
        self._make_room(name)
        port = HubPort(self.hub, name, details.address if handle is None else "{}:{}".format(*handle.peer))

        def send(datagram: bytes) -> SendResult:
            return self.socket.send_to(routing_id, datagram)

        connection.served = Served(port, Pump(port, send, on_gone=lambda: self._ended(connection)))
        self.clients.add(connection)
        return connection

    def _make_room(self, client: ClientName) -> None:
        """One more connection of a client is to come: where it has enough, the oldest without its session goes."""
        own = [(each, served) for each, served in self.clients.sessions() if each.client == client]
        spare = [each for each, served in own if not served.port.current]
        for connection in spare[: max(0, len(own) + 1 - MAX_PORTS)]:
            self.surplus += 1
            if client not in self._told and len(self._told) < MAX_TOLD:
                self._told.add(client)
                _log.warning("%s has more than %d connections; the oldest without its session end", client, MAX_PORTS)
            self._gone(connection)
            self.connections.cut(connection.fd)

    def look(self) -> None:
        """See to connections. Call about once a second."""
        self.silent += self.connections.cut_silent(self._silent_s)
        close_reserve()
        self._bind()
        self.priority_lanes.look()

    def _send(self, routing_id: bytes, datagram: bytes) -> SendResult:
        return self.socket.send_to(routing_id, datagram)

    def _join(self, connection: ClientConnection, data: bytes) -> None:
        """A connection for class control: of a session that its own client has, or of none, and then it is closed."""
        try:
            older = self.priority_lanes.join(connection, data)
        except RemoteError as error:
            self.bad_frames += 1
            _log.warning("connection of %s for class control closed: bad frame: %s", connection.client, error)
            older = connection
        if older is not None:
            self.connections.cut(older.fd)
        self._after()

    @staticmethod
    def _claimed(data: bytes) -> str:
        """The name that a peer without keys has in its first datagram, a HELLO or a JOIN; it is believed."""
        header = framing.decode_header(data)
        if header.kind not in (framing.Kind.HELLO, framing.Kind.JOIN):
            raise WireError("the first datagram of a connection must be HELLO or JOIN")
        return framing.take_str(framing.decode_handshake(data), "name", max_length=64)

    def flush(self) -> None:
        """Let every port that has something to say say it."""
        for _connection, served in self.clients.sessions():
            if served.port.dirty:
                served.pump.kick()
        self.priority_lanes.flush()

    def run_all(self) -> None:
        for _connection, served in list(self.clients.sessions()):
            served.pump.run()

    def _writable(self) -> None:
        for _connection, served in self.clients.sessions():
            served.pump.kick()
        self.priority_lanes.kick()

    def local_port(self, client: ClientName) -> int | None:
        """The number of our port to which the client's session came by TCP; None while it has no such connection, as
        over ipc."""
        for connection, served in self.clients.sessions():
            if connection.client == client and served.port.current:
                return None if connection.handle is None else connection.handle.local[1]
        return None

    def address(self, client: ClientName) -> str:
        """Where the client's session comes from by TCP; empty while it has no such connection."""
        port = self.hub.clients.port_of.get(client)
        if port is not None:
            return port.address
        # A session is told of before it has its connection: that is then the newest of the client.
        own = [served.port.address for connection, served in self.clients.sessions() if connection.client == client]
        return own[-1] if own else ""

    def session_key(self, client: ClientName) -> str | None:
        """The key (Z85) of the connection that has the client's session; None while it has none."""
        for connection, served in self.clients.sessions():
            if connection.client == client and served.port.current:
                return None if self._insecure else parse_user_id(connection.user)[1]
        return None

    def cut_keys(self, client: ClientName, keys: frozenset[str]) -> int:
        """End the connections of a client that were made with one of these keys; returns how many there were."""
        users = {user_id(client, key) for key in keys}
        gone = [each for each in self.clients.all() if each.user in users]
        for connection in gone:
            self._gone(connection)
            self.connections.cut(connection.fd)
        return len(gone)

    def rekey(self, keys: CurvePair, zap_domain: str) -> None:
        """Prove the relay's identity with other keys from now on.

        libzmq copies the keys of a socket when it binds: so it is bound anew. That ends the connections that there are,
        and clients come back by themselves; sessions with a datagram lane go on meanwhile.
        """
        raw = self.socket.socket
        serve_curve(raw, keys, zap_domain)
        for endpoint in self._listen:
            self.connections.unbound = False
            unbind(raw, endpoint)
            self.connections.await_unbound(clock.now() + UNBIND_S)
        self._to_bind = self._listen
        self._bind()

    def _bind(self) -> None:
        """Listen again where the relay has let go of its addresses; what another process has taken is tried again."""
        for endpoint in self._to_bind:
            try:
                bind_all(self.socket.socket, (endpoint,))
            except ConfigError as error:
                if len(self._to_bind) == len(self._listen):
                    _log.error("%s; trying again", error)
                return
            self._to_bind = self._to_bind[1:]

    def cut_client(self, client: str) -> int:
        """End every connection of a client at once; returns how many there were."""
        for connection, _served in list(self.clients.sessions()):
            if connection.client == client:
                self._gone(connection)
        self.priority_lanes.end(client)
        return self.connections.cut_user(client)

    def cut_unbound(self) -> int:
        """End every connection that has not said anything yet; returns how many there were."""
        return self.connections.cut_user("")

    def _cut(self, connection: ClientConnection, why: str) -> None:
        what = " for class control" if connection.served is None else ""
        _log.warning("connection of %s%s closed: %s", connection.client, what, why)
        self._gone(connection)
        self.connections.cut(connection.fd)

    def _gone(self, connection: ClientConnection) -> None:
        """It is over: whoever it belonged to is told. Idempotent."""
        if connection.served is None:
            self.priority_lanes.left(connection)
        elif self.clients.remove(connection.routing_id) is not None:
            connection.served.pump.close()
            connection.served.port.disconnected(now=clock.now())
            self._after()

    def _ended(self, connection: ClientConnection) -> None:
        """Nothing can be sent on it any more. What it said last is taken first: a goodbye, for example."""
        self._over.add(connection)
        self._connections_changed()

    def _connections_changed(self) -> None:
        if not self._burying:
            self._burying = True
            self.socket.when_empty(self._bury)

    def _bury(self) -> None:
        self._burying = False
        for connection in [*self._over, *self.clients.lost()]:
            self._gone(connection)
        self._over.clear()
