"""The client's datagram lane: asked for in each session, opened with the keys the relay answers, closed by the core."""

import logging
import time
from collections.abc import Callable
from typing import Final

from sern_core import wire
from sern_core.client import ClientCore
from sern_core.errors import RemoteError, SernError
from sern_core.lane_port import LanePort
from sern_core.lanes import LANE_UDP
from sern_runtime.pump import Pump
from sern_runtime.seal import SessionParameters, offered_ciphers
from sern_runtime.udp_client import UdpClient

REBIND_S: Final = 2.0
"""While the lane has stalled it tries another source port this often: a lost NAT binding or route raises no error."""
ASK_AGAIN_S: Final = 30.0
"""A lane that failed is asked for again after so long."""

_log = logging.getLogger(__name__)


class ClientLane:
    """Joins the core's datagram lane to a UDP socket. `kick` is called when the core may have something to send.

    `host` is the relay's address of the stream lane. Call `tick` about twice a second.
    """

    def __init__(self, core: ClientCore, host: str, *, kick: Callable[[], None]) -> None:
        self.core = core
        self.host = host
        self.bad_frames = 0
        self._kick = kick
        self._socket: UdpClient | None = None
        self._pump: Pump | None = None
        self._rebind_s = 0.0
        self._ask_s: float | None = None

    def ask(self) -> None:
        """A session has begun."""
        self._ask_s = None
        self.core.ask_lane(offered_ciphers(), now=time.monotonic())

    def offered(self, envelope: wire.Envelope) -> None:
        """The relay's answer. Raises WireError when it is none."""
        parameters = SessionParameters.from_envelope(envelope)
        self.closed()
        try:
            self._socket = UdpClient(
                self.host,
                parameters.port,
                parameters,
                self._received,
                on_writable=self._writable,
                after=self._kick,
            )
        except SernError as error:
            _log.warning("no datagram lane: %s", error)
            return
        port = LanePort(self.core.link, LANE_UDP)
        self._pump = Pump(port, self._socket.send, on_gone=self._failed, ready=self._socket.ready)
        self.core.link.close_lane(now=time.monotonic())
        self.core.link.open_lane(now=time.monotonic())
        self._pump.kick()

    def closed(self) -> None:
        """The core has closed the lane, or the daemon stops."""
        if self._pump is not None:
            self._pump.close()
            self._pump = None
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def kick(self) -> None:
        if self._pump is not None:
            self._pump.kick()

    def tick(self) -> None:
        now = time.monotonic()
        if self._ask_s is not None and now >= self._ask_s and self.core.link.established:
            self.ask()
        lane = self.core.link.lanes.get(LANE_UDP)
        if self._socket is None or lane is None:
            return
        if self._socket.rekey_due:
            self.ask()
        elif lane.stalled and now >= self._rebind_s:
            self._rebind_s = now + REBIND_S
            self._socket.rebind()

    def _received(self, data: bytes, now: float) -> None:
        if self.core.link.deaf:
            return
        try:
            self.core.link.receive(data, now=now, lane=LANE_UDP)
        except RemoteError as error:
            self.bad_frames += 1
            _log.warning("the relay sent a bad datagram (%s); the lane is closed", error)
            self._failed()

    def _failed(self) -> None:
        self.closed()
        self.core.link.close_lane(now=time.monotonic())
        self._ask_s = time.monotonic() + ASK_AGAIN_S
        self._kick()

    def _writable(self) -> None:
        self.kick()
