"""The relay's end of the express lanes: further connections of a client, for class control alone."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Final, NamedTuple

from sern_core.link.lane_port import LanePort
from sern_core.link.link import Link
from sern_core.path.lanes import LANE_EXPRESS
from sern_core.relay.hub import Hub
from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.params import Redundancy
from sern_core.vocabulary.types import ClientName
from sern_core.wire import framing
from sern_runtime import clock
from sern_runtime.express import CONNECTIONS, ExpressPaths
from sern_runtime.monitor import Connection
from sern_runtime.pump import Pump
from sern_runtime.zmq_socket import SendResult

JOIN: Final = bytes((framing.Kind.JOIN,))
"""The third byte of a datagram that joins."""


@dataclass(slots=True, eq=False)
class Joined:
    """A connection that belongs to a client's session; `user` is its User-Id, `client` the name in it."""

    client: ClientName
    user: str
    fd: int
    connection: Connection | None
    taken: int = 0  # messages that have come in


class _Lane(NamedTuple):
    link: Link
    paths: ExpressPaths[bytes]
    pump: Pump


class RelayExpress:
    """Joins connections to the sessions of the clients whose keys they have. `after` as in `RelayServer`."""

    def __init__(
        self,
        hub: Hub,
        send: Callable[[bytes, bytes], SendResult],
        redundancy: Redundancy,
        *,
        after: Callable[[], None],
    ) -> None:
        self.hub = hub
        self.refused = 0
        """Connections that named no session of their client."""
        self.joined: dict[bytes, Joined] = {}
        self._send = send
        self._redundancy = redundancy
        self._after = after
        self._lanes: dict[ClientName, _Lane] = {}

    def close(self) -> None:
        for lane in self._lanes.values():
            lane.pump.close()
        self._lanes.clear()
        self.joined.clear()

    def join(self, routing_id: bytes, joined: Joined, data: bytes) -> Joined | None:
        """A connection names its session. The answer is the connection to close, if any: itself, when there is no such
        session; the oldest of its client, when there are enough. Raises WireError."""
        if not self.hub.join(joined.client, data, now=clock.now()):
            self.refused += 1
            self.left(routing_id)
            return joined
        link = self.hub.links[joined.client]
        lane = self._lanes.get(joined.client)
        if lane is None or lane.link is not link:
            self._drop(joined.client)
            paths: ExpressPaths[bytes] = ExpressPaths(self._redundancy, link.plane.may_copy)
            pump = Pump(LanePort(link, LANE_EXPRESS), paths.send, on_gone=lambda: None)
            lane = self._lanes[joined.client] = _Lane(link, paths, pump)
        older = None
        others = [rid for rid, other in self.joined.items() if other.client == joined.client and rid != routing_id]
        if len(others) >= CONNECTIONS:  # those of a session that is over count, too
            older = self.joined.pop(others[0])
            lane.paths.discard(others[0])
        self.joined[routing_id] = joined
        if routing_id not in lane.paths:
            handle = joined.connection.handle if joined.connection is not None else None
            lane.paths.add(routing_id, partial(self._send, routing_id), handle)
        lane.pump.reset()
        lane.pump.kick()
        return older

    def received(self, routing_id: bytes, joined: Joined, data: framing.Datagram) -> None:
        """Raises RemoteError; the caller closes the connection."""
        if data[2:3] == JOIN:  # of the next session
            if self.join(routing_id, joined, bytes(data)) is not None:
                raise WireError("it names no session of its client")
            return
        link = self.hub.links.get(joined.client)
        if link is not None:
            link.receive(data, now=clock.now(), lane=LANE_EXPRESS)

    def left(self, routing_id: bytes) -> None:
        """The connection is gone."""
        joined = self.joined.pop(routing_id, None)
        lane = self._lanes.get(joined.client) if joined is not None else None
        if joined is None or lane is None:
            return
        lane.paths.discard(routing_id)
        if not lane.paths:
            self._drop(joined.client)
            self._after()

    def end(self, client: str) -> None:
        """The client may have none any more."""
        for routing_id in [rid for rid, joined in self.joined.items() if joined.client == client]:
            self.left(routing_id)

    def _drop(self, client: ClientName) -> None:
        lane = self._lanes.pop(client, None)
        if lane is not None:
            lane.pump.close()
            lane.link.close_lane(now=clock.now(), lane_id=LANE_EXPRESS)

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
