"""The relay's datagram lanes: one UDP socket for each listener, one session for each client that asks for one."""

import asyncio
import logging
from collections.abc import Callable, Sequence
from typing import Final

from sern_core.link.lane_port import LanePort
from sern_core.link.link import Link
from sern_core.path.lanes import LANE_UDP
from sern_core.relay.hub import Hub
from sern_core.vocabulary.errors import RefusedError, RemoteError
from sern_core.vocabulary.types import ClientName
from sern_runtime import clock
from sern_runtime.addresses import plain_host
from sern_runtime.config.base import split_tcp
from sern_runtime.dscp import Marks
from sern_runtime.pump import Pump
from sern_runtime.udp import UdpServer, UdpSession
from sern_runtime.udp_socket import Address
from sern_runtime.zmq_socket import SendResult

ASK_REST_S: Final = 0.5
"""Between two lanes that a client is given for the asking: keys and the kernel's filter cost much more than an ask."""

_log = logging.getLogger(__name__)


def udp_endpoints(listen: Sequence[str]) -> tuple[str, ...]:
    """The UDP addresses beside the TCP ones that the relay listens on: same address, same port number."""
    return tuple(f"udp://{endpoint.removeprefix('tcp://')}" for endpoint in listen if split_tcp(endpoint) is not None)


class RelayLanes:
    """Opens a session for a client that asks, and joins it to the client's link until the core closes the lane.

    Raises ConfigError when an address cannot be had. `port_of(client)` is the number of the port over which the client
    reached the relay by TCP, None while it has no such connection: its datagrams go to the UDP port of that number, as
    firewalls and routes to another may be closed. `after` is called whenever something came in.
    """

    def __init__(
        self,
        hub: Hub,
        listen: Sequence[str],
        *,
        port_of: Callable[[ClientName], int | None],
        after: Callable[[], None],
        marks: Marks | None = None,
    ) -> None:
        self.hub = hub
        self._port_of = port_of
        marks = marks or Marks()
        self._tos = marks.tos
        self._after = after
        self.bad_frames = 0
        self.moved = 0
        """Times a client's address changed."""
        self.rekeyed = 0
        """Lanes opened anew because the relay's own key was used up."""
        self._lanes: dict[ClientName, tuple[UdpSession, Pump]] = {}
        self._ciphers: dict[ClientName, tuple[str, ...]] = {}  # what the client of a lane has offered
        self._resting: dict[ClientName, asyncio.TimerHandle] = {}  # who was given a lane just now
        self._waiting: dict[ClientName, tuple[str, ...]] = {}  # the newest that these have asked for since
        self.server = UdpServer(
            udp_endpoints(listen),
            self._received,
            on_path=self._path,
            on_writable=self._writable,
            after=after,
            tos=marks.stream_tos,
        )

    def close(self) -> None:
        for timer in self._resting.values():
            timer.cancel()
        self._resting.clear()
        self._waiting.clear()
        for _, pump in self._lanes.values():
            pump.close()
        self._lanes.clear()
        self.server.close()

    def asked(self, client: ClientName, ciphers: Sequence[str]) -> None:
        """A client would like a datagram lane: give it one, over the session that its CURVE key opened. Of what it asks
        for within `ASK_REST_S` of that, it is given the newest when the time is over."""
        if client in self._resting:
            self._waiting[client] = tuple(ciphers)
            return
        self._resting[client] = asyncio.get_running_loop().call_later(ASK_REST_S, self._rested, client)
        self._open(client, ciphers)

    def _rested(self, client: ClientName) -> None:
        del self._resting[client]
        ciphers = self._waiting.pop(client, None)
        link = self.hub.links.get(client)
        if ciphers is not None and link is not None and link.established:
            self.asked(client, ciphers)
            self._after()

    def _open(self, client: ClientName, ciphers: Sequence[str]) -> None:
        before = self._lanes.get(client)
        port_number = self._port_of(client)
        if port_number is None and before is not None:  # it asks over the lane itself, while TCP is lost
            port_number = before[0].parameters.port
        self.closed(client)
        link = self.hub.links[client]
        link.close_lane(now=clock.now())
        if port_number is None:
            _log.warning("%s gets no datagram lane: it has no TCP connection to this relay", client)
            return
        try:
            session = self.server.open_session(client, ciphers, port=port_number)
        except RefusedError as refusal:
            _log.warning("%s gets no datagram lane: %s", client, refusal)
            return
        port = LanePort(link, LANE_UDP)
        tos = self._tos

        def send(datagram: bytes) -> SendResult:
            return session.send(datagram, tos[port.priority])

        pump = Pump(port, send, on_gone=lambda: self._used_up(client, session), ready=session.ready)
        self._lanes[client] = (session, pump)
        self._ciphers[client] = tuple(ciphers)
        self.hub.offer_lane(client, session.parameters.to_envelope(), now=clock.now())
        pump.kick()

    def closed(self, client: ClientName) -> None:
        """The core has closed the client's lane."""
        self._waiting.pop(client, None)
        lane = self._lanes.pop(client, None)
        self._ciphers.pop(client, None)
        if lane is not None:
            session, pump = lane
            pump.close()
            self.server.close_session(session)

    def address(self, client: ClientName) -> str:
        """Where the client's datagrams come from; empty while it has no datagram lane, or has not spoken on it."""
        lane = self._lanes.get(client)
        address = None if lane is None else lane[0].address
        return "" if address is None else f"{plain_host(address[0])}:{address[1]}"

    def problem(self, link: Link, within_s: float) -> str | None:
        """What is known about why no datagram passes to and from a client, as `DatagramWatch` wants it; None: the
        client has asked for no datagram lane, or cannot have one, which was said."""
        lane = self._lanes.get(link.peer)
        if lane is None:
            return None
        session = lane[0]
        port = session.parameters.port
        if session.address is None:
            return (
                f"no datagram came through from it to {port}/udp here in {within_s:g} s; using TCP; open UDP port "
                f"{port} in this host's firewall and in its cloud security group, or allow outgoing UDP at the client"
            )
        return (
            f"datagrams come through from it ({plain_host(session.address[0])}), and it has confirmed none of ours for "
            f"{within_s:g} s; using TCP; allow this host's UDP port {port} to answer, and datagrams of 1200 bytes"
        )

    def flush(self) -> None:
        """Let every lane that has something to say say it: first those with messages, which somebody waits for, then
        those that only acknowledge."""
        patient: list[Pump] = []
        for session, pump in self._lanes.values():
            link = self.hub.links[session.client]
            if not link.dirty:
                continue
            if link.sender.pending:
                pump.kick()
            else:
                patient.append(pump)
        for pump in patient:
            pump.kick()

    def _received(self, session: UdpSession, data: bytes, now: float) -> None:
        link = self.hub.links.get(session.client)
        lane = self._lanes.get(session.client)
        if link is None or lane is None or lane[0] is not session:
            return
        try:
            link.receive(data, now=now, lane=LANE_UDP)
        except RemoteError as error:
            self.bad_frames += 1
            _log.warning("datagram lane of %s closed: bad frame: %s", session.client, error)
            self._gone(session.client, session)

    def _used_up(self, client: ClientName, session: UdpSession) -> None:
        """The session can send no more, as its key is used up: offer another, as if the client had asked. It asks by
        itself, long before, where the key lasts longer than it takes to look."""
        lane = self._lanes.get(client)
        if lane is not None and lane[0] is session:
            self.rekeyed += 1
            self._open(client, self._ciphers[client])

    def _gone(self, client: ClientName, session: UdpSession) -> None:
        """The client sent what no honest one does."""
        lane = self._lanes.get(client)
        if lane is not None and lane[0] is session:
            self.closed(client)
            self.hub.links[client].close_lane(now=clock.now())

    def _path(self, session: UdpSession, address: Address, validated: bool) -> None:
        if validated:
            _log.info("%s is reached over UDP at %s", session.client, plain_host(address[0]))
        else:
            self.moved += 1
        self._writable(session)

    def _writable(self, session: UdpSession) -> None:
        lane = self._lanes.get(session.client)
        if lane is not None and lane[0] is session:
            lane[1].kick()
