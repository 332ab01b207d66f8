"""The client's datagram lane: asked for in each session, opened with the keys the relay answers, closed by the core."""

import logging
from collections.abc import Callable
from math import inf
from typing import Final

from sern_core.link.lane_port import LanePort
from sern_core.link.link import Link
from sern_core.path.lanes import LANE_UDP, LANE_ZMQ
from sern_core.site.client import ClientCore
from sern_core.vocabulary.errors import RemoteError, SernError
from sern_core.wire import framing
from sern_runtime import clock
from sern_runtime.dscp import Marks
from sern_runtime.pump import Pump
from sern_runtime.seal import SessionParameters, offered_ciphers
from sern_runtime.udp_client import UdpClient
from sern_runtime.zmq_socket import SendResult

REBIND_S: Final = 2.0
"""While the lane has stalled it tries another source port this often: a lost NAT binding or route raises no error."""
ASK_AGAIN_S: Final = (10.0, 300.0)
"""First and longest pause before a lane that failed, or is silent while the stream works, is asked for again: the relay
may have given it up, or the way be open again."""
ANSWER_S: Final = 5.0
"""How long an answer is waited for before a lane whose keys are nearly used up is asked for again."""

_log = logging.getLogger(__name__)


class ClientLane:
    """Joins the core's datagram lane to a UDP socket. `kick` is called when the core may have something to send.

    `host` is the relay's address of the stream lane. Call `tick` about twice a second.
    """

    def __init__(self, core: ClientCore, host: str, *, kick: Callable[[], None], marks: Marks | None = None) -> None:
        self._marks = marks or Marks()
        self.core = core
        self.host = host
        self.bad_frames = 0
        self._kick = kick
        self._socket: UdpClient | None = None
        self._pump: Pump | None = None
        self._rebind_s = 0.0
        self.ask_s: float | None = None
        """When the lane is asked for again; None: it works, or an answer is awaited."""
        self._asked_s = -inf
        self.pause_s = ASK_AGAIN_S[0]
        """How long before that."""

    def ask(self) -> None:
        """A session has begun, or the lane there is will not do."""
        self.ask_s = None
        self._asked_s = clock.now()
        self.core.ask_lane(offered_ciphers(), now=clock.now())

    def offered(self, envelope: framing.Envelope) -> None:
        """The relay's answer. Raises WireError when it is none."""
        parameters = SessionParameters.from_envelope(envelope)
        self.closed()
        try:
            self._socket = socket = UdpClient(
                self.host,
                parameters.port,
                parameters,
                self._received,
                on_writable=self._writable,
                after=self._kick,
                tos=self._marks.stream_tos,
            )
        except SernError as error:
            _log.warning("no datagram lane: %s", error)
            self._ask_later()
            return
        port = LanePort(self.core.link, LANE_UDP)
        tos = self._marks.tos

        def send(datagram: bytes) -> SendResult:
            return socket.send(datagram, tos[port.priority])

        self._pump = Pump(port, send, on_gone=self._used_up, ready=socket.ready)
        self.core.link.close_lane(now=clock.now())
        self.core.link.open_lane(now=clock.now())
        self._pump.kick()

    def closed(self) -> None:
        """The core has closed the lane, or the daemon stops."""
        if self._pump is not None:
            self._pump.close()
            self._pump = None
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def problem(self, link: Link, within_s: float) -> str:
        """What is known about why no datagram passes to and from the relay, as `DatagramWatch` wants it."""
        socket = self._socket
        if socket is None:
            return (
                f"the relay at {self.host} has offered no datagram lane in {within_s:g} s; using TCP; set "
                "relay.udp: true there, or relay.udp: false here"
            )
        port = socket.parameters.port
        there = f"{self.host}:{port}/udp"
        if socket.opener.highest:
            return (
                f"datagrams come through from {there}, and it has confirmed none of ours for {within_s:g} s; "
                f"using TCP; allow outgoing UDP to port {port} here, and datagrams of 1200 bytes on the way"
            )
        seen = f" ({socket.problem})" if socket.problem else ""
        return (
            f"no datagram came through from {there} in {within_s:g} s{seen}; using TCP; open UDP port {port} "
            "in the relay's firewall and in its cloud security group, and allow outgoing UDP here"
        )

    def kick(self) -> None:
        if self._pump is not None:
            self._pump.kick()

    def tick(self) -> None:
        now = clock.now()
        if self.ask_s is not None and now >= self.ask_s and self.core.link.established:
            self.ask()
        lane = self.core.link.lanes.by_id.get(LANE_UDP)
        if self._socket is None or lane is None:
            return
        if lane.answered and not lane.stalled:
            self.ask_s = None
            self.pause_s = ASK_AGAIN_S[0]
        elif self.ask_s is None and self.core.link.lanes.by_id[LANE_ZMQ].usable:
            self._ask_later()  # a blackout takes both: then there is nobody to ask
        if self._socket.rekey_due and now >= self._asked_s + ANSWER_S:
            self.ask()
        elif lane.stalled and now >= self._rebind_s:
            self._rebind_s = now + REBIND_S
            self._socket.rebind()

    def _received(self, data: bytes, now: float) -> None:
        if not self.core.link.handshake.reads:
            return
        try:
            self.core.link.receive(data, now=now, lane=LANE_UDP)
        except RemoteError as error:
            self.bad_frames += 1
            _log.warning("the relay sent a bad datagram (%s); the lane is closed", error)
            self._failed()

    def _used_up(self) -> None:
        """Our key has sealed all that it may, before there was another."""
        self.closed()
        self.core.link.close_lane(now=clock.now())
        self.ask()
        self._kick()

    def _failed(self) -> None:
        self.closed()
        self.core.link.close_lane(now=clock.now())
        self._ask_later()
        self._kick()

    def _ask_later(self) -> None:
        self.ask_s = clock.now() + self.pause_s
        self.pause_s = min(2 * self.pause_s, ASK_AGAIN_S[1])

    def _writable(self) -> None:
        self.kick()
