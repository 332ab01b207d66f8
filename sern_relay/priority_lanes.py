"""The relay's end of the priority lanes: further connections of a client, for class control alone."""

from collections.abc import Callable
from functools import partial
from typing import Final, NamedTuple

from sern_core.link.lane_port import LanePort
from sern_core.link.link import Link
from sern_core.path.lanes import LANE_PRIORITY
from sern_core.relay.hub import Hub
from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.params import Redundancy
from sern_core.vocabulary.types import ClientName
from sern_core.wire import framing
from sern_relay.connections import ClientConnection, ClientConnections
from sern_runtime import clock
from sern_runtime.priority_paths import CONNECTIONS, PriorityPaths
from sern_runtime.pump import Pump
from sern_runtime.zmq_socket import SendResult

JOIN: Final = bytes((framing.Kind.JOIN,))
"""The third byte of a datagram that joins."""


class _Lane(NamedTuple):
    link: Link
    paths: PriorityPaths[bytes]
    pump: Pump


class RelayPriorityLanes:
    """Joins connections to the sessions of the clients whose keys they have. Those of `clients` that are for class
    control alone are its own. `after` as in `RelayServer`."""

    def __init__(
        self,
        hub: Hub,
        clients: ClientConnections,
        send: Callable[[bytes, bytes], SendResult],
        redundancy: Redundancy,
        *,
        after: Callable[[], None],
    ) -> None:
        self.hub = hub
        self.refused = 0
        """Connections that named no session of their client."""
        self._clients = clients
        self._send = send
        self._redundancy = redundancy
        self._after = after
        self._lanes: dict[ClientName, _Lane] = {}

    def close(self) -> None:
        for lane in self._lanes.values():
            lane.pump.close()
        self._lanes.clear()

    @property
    def joined(self) -> list[ClientConnection]:
        """The connections that have joined, the oldest first."""
        return self._clients.for_control()

    def join(self, connection: ClientConnection, data: bytes) -> ClientConnection | None:
        """A connection names its session. The answer is the connection to close, if any: itself, when there is no such
        session; the oldest of its client, when there are enough. Raises WireError."""
        client, routing_id = connection.client, connection.routing_id
        if not self.hub.join(client, data, now=clock.now()):
            self.refused += 1
            self.left(connection)
            return connection
        link = self.hub.links[client]
        lane = self._lanes.get(client)
        if lane is None or lane.link is not link:
            self._drop(client)
            paths: PriorityPaths[bytes] = PriorityPaths(self._redundancy, link.plane.may_copy)
            pump = Pump(LanePort(link, LANE_PRIORITY), paths.send, on_gone=lambda: None)
            lane = self._lanes[client] = _Lane(link, paths, pump)
        older = None
        others = [each for each in self.joined if each.client == client and each is not connection]
        if len(others) >= CONNECTIONS:  # those of a session that is over count, too
            older = others[0]
            self._clients.remove(older.routing_id)
            lane.paths.discard(older.routing_id)
        self._clients.add(connection)
        if routing_id not in lane.paths:
            lane.paths.add(routing_id, partial(self._send, routing_id), connection.handle)
        lane.pump.reset()
        lane.pump.kick()
        return older

    def received(self, connection: ClientConnection, data: framing.Datagram) -> None:
        """Raises RemoteError; the caller closes the connection."""
        if data[2:3] == JOIN:  # of the next session
            if self.join(connection, bytes(data)) is not None:
                raise WireError("it names no session of its client")
            return
        link = self.hub.links.get(connection.client)
        if link is not None:
            link.receive(data, now=clock.now(), lane=LANE_PRIORITY)

    def left(self, connection: ClientConnection) -> None:
        """The connection is gone. Idempotent."""
        if self._clients.remove(connection.routing_id) is None:
            return
        lane = self._lanes.get(connection.client)
        if lane is None:
            return
        lane.paths.discard(connection.routing_id)
        if not lane.paths:
            self._drop(connection.client)
            self._after()

    def end(self, client: str) -> None:
        """The client may have none any more."""
        for connection in self.joined:
            if connection.client == client:
                self.left(connection)

    def _drop(self, client: ClientName) -> None:
        lane = self._lanes.pop(client, None)
        if lane is not None:
            lane.pump.close()
            lane.link.close_lane(now=clock.now(), lane_id=LANE_PRIORITY)

    def look(self) -> None:
        """See what TCP loses. Call about once a second."""
        for lane in self._lanes.values():
            lane.paths.look()

    def flush(self) -> None:
        for lane in self._lanes.values():
            if lane.link.dirty:
                lane.pump.kick()

    def kick(self) -> None:
        for lane in self._lanes.values():
            lane.pump.kick()
