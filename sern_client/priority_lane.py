"""The client's priority lane: class control on TCP connections of its own, where data goes over the stream lane."""

import asyncio
import logging
from collections.abc import Callable
from typing import Final

from sern_client.transport import Dialer, RelayTransport
from sern_core.link.lane_port import LanePort
from sern_core.path.lanes import LANE_PRIORITY, LANE_ZMQ
from sern_core.site.client import ClientCore
from sern_core.vocabulary.errors import ConfigError, RemoteError
from sern_core.vocabulary.params import Redundancy
from sern_core.wire import framing
from sern_runtime import clock
from sern_runtime.monitor import TcpHandle
from sern_runtime.priority_paths import CONNECTIONS, PriorityPaths
from sern_runtime.pump import Pump

DATAGRAMS_FIRST_S: Final = 3.0
"""How long the datagram lane has in a session to show that it works, where it may be used."""
ATTEMPTS: Final = 3
"""Connections that ended before the relay said anything on them: it does not want them."""
ASK_AGAIN_S: Final = 30.0

_log = logging.getLogger(__name__)


class ClientPriorityLane:
    """Opens the connections when they are of use and joins each to the session. `kick` is called when the core may have
    something to send. Call `tick` about twice a second."""

    def __init__(
        self,
        core: ClientCore,
        transport: RelayTransport,
        redundancy: Redundancy,
        *,
        datagrams: bool,
        kick: Callable[[], None],
    ) -> None:
        self.core = core
        self.bad_frames = 0
        self.paths: PriorityPaths[_Connection] = PriorityPaths(redundancy, core.link.plane.may_copy)
        self._transport = transport
        self._wait_s = DATAGRAMS_FIRST_S if datagrams else 0.0
        self._kick = kick
        self.connections: list[_Connection] = []
        self._pump: Pump | None = None
        self._open_s = 0.0
        self._failures = 0
        self._without_s: float | None = None  # since when there is no lane, if that was said

    def begin(self) -> None:
        """A session has begun: what is connected must join it."""
        self._open_s = clock.now() + self._wait_s
        self._failures = 0
        self.paths.clear()
        for connection in self.connections:
            connection.join()

    def tick(self) -> None:
        link = self.core.link
        if not self.connections:
            if link.established and link.lane.id == LANE_ZMQ and clock.now() >= self._open_s:
                self._open()
        else:
            self.paths.look()

    def _open(self) -> None:
        self._failures = 0
        self._pump = Pump(LanePort(self.core.link, LANE_PRIORITY), self.paths.send, on_gone=lambda: None)
        try:
            for _ in range(CONNECTIONS):
                self.connections.append(_Connection(self, self._transport))
        except ConfigError as error:
            _log.warning("class control has no connection of its own: %s", error)
            self._said()
            self._give_up()

    def _said(self) -> None:
        if self._without_s is None:
            self._without_s = clock.now()

    def _give_up(self) -> None:
        self.close()
        self._open_s = clock.now() + ASK_AGAIN_S

    def close(self) -> None:
        """The daemon stops, or the relay does not want the lane."""
        if self._pump is not None:
            self._pump.close()
            self._pump = None
        for connection in self.connections:
            connection.dialer.close()
        self.connections.clear()
        self.paths.clear()
        self.core.link.close_lane(now=clock.now(), lane_id=LANE_PRIORITY)

    def kick(self) -> None:
        if self._pump is not None:
            self._pump.kick()

    def joined(self, connection: "_Connection", handle: TcpHandle | None) -> None:
        self.paths.add(connection, connection.dialer.send, handle)
        link = self.core.link
        if LANE_PRIORITY not in link.lanes.by_id:
            if self._pump is not None:
                self._pump.reset()
            link.open_lane(now=clock.now(), lane_id=LANE_PRIORITY)
        self._kick()

    def lost(self, connection: "_Connection", *, answered: bool) -> None:
        self.paths.discard(connection)
        if not self.paths:
            self.core.link.close_lane(now=clock.now(), lane_id=LANE_PRIORITY)
        self._failures = 0 if answered else self._failures + 1
        link = self.core.link
        if self._failures >= ATTEMPTS * CONNECTIONS and link.established and link.lanes.priority_lane is None:
            self._failures = 0
            _log.warning("the relay takes no connection for class control alone; asking again in %g s", ASK_AGAIN_S)
            self._said()
            asyncio.get_running_loop().call_soon(self._give_up)
        self._kick()

    def received(self, connection: "_Connection", data: framing.Datagram) -> None:
        if not self.core.link.handshake.reads:
            return
        try:
            self.core.link.receive(data, now=clock.now(), lane=LANE_PRIORITY)
        except RemoteError as error:
            self.bad_frames += 1
            _log.warning("the relay sent a bad frame for class control (%s); reconnecting", error)
            connection.dialer.again(f"bad frame: {error}")
            return
        if self._without_s is not None:
            without_s, self._without_s = clock.now() - self._without_s, None
            _log.warning("class control has connections of its own again, after %.0f s", without_s)
        if self.core.link.dirty:
            self._kick()


class _Connection:
    """One connection of the lane."""

    def __init__(self, lane: ClientPriorityLane, transport: RelayTransport) -> None:
        self._lane = lane
        self._handle: TcpHandle | None = None
        self._up = False
        self._answered = False
        self.dialer: Dialer = transport.another(self)
        self.dialer.open()

    def join(self) -> None:
        """Say whose connection this is; without a session, when there is one."""
        said = self._lane.core.link.handshake.join(clock.now())
        if self._up and said is not None and self.dialer.send(said):
            self._lane.joined(self, self._handle)

    def up(self, handle: TcpHandle | None) -> None:
        self._handle = handle
        self._up = True
        self._answered = False
        self.join()

    def down(self, reason: str) -> None:
        self._up = False
        self._lane.lost(self, answered=self._answered)

    def refused(self, reason: str) -> None: ...

    def given_up(self, reason: str) -> None:
        self._up = False
        self._lane.lost(self, answered=True)

    def received(self, data: framing.Datagram) -> None:
        self._answered = True
        self._lane.received(self, data)

    def writable(self) -> None:
        self._lane.kick()
