"""One hop over a fabric: moves the datagrams of a link's end to a peer relay and back.

The hop is not lossless, although TCP is underneath: a queue that is full drops, datagrams of an urgent class overtake
others, and what was under way is lost when a connection ends. So the link counts, acknowledges and sends again as over
datagrams (`lossless=False`), and makes them as large as over a stream (`any_size=True`): 3 ms of the link each.
"""

from collections.abc import Callable
from typing import Final, Protocol

from sern_core.vocabulary.errors import RemoteError
from sern_core.vocabulary.types import ClientName, PriorityClass
from sern_runtime import clock
from sern_runtime.fabric.port import FabricPort
from sern_runtime.pump import Port, Pump
from sern_runtime.zmq_socket import SendResult

LOSSLESS: Final = False
ANY_SIZE: Final = True
"""What a `Link` over a fabric is to be made with."""


class HopPort(Port, Protocol):
    """The end of a hop, as the core gives it (`sern_core.link.lane_port.LanePort` is one)."""

    @property
    def priority(self) -> PriorityClass:
        """The most urgent class in the latest datagram."""

    def receive(self, data: bytes, *, now: float) -> None:
        """Raises WireError or VersionError for bytes that no honest peer sends."""


class FabricHop:
    """Kick it after whatever may have given the link something to send. `on_unreadable` is told of bytes that are none
    of ours, once for each such datagram; the link's session has ended by then."""

    def __init__(
        self,
        fabric: FabricPort,
        peer: ClientName,
        end: HopPort,
        *,
        on_unreadable: Callable[[RemoteError], None] = lambda _error: None,
    ) -> None:
        self._fabric = fabric
        self._peer = peer
        self._end = end
        self._on_unreadable = on_unreadable
        # The fine timer: at 8 Mbit/s a datagram may leave every 3 ms, and a timer of whole milliseconds is late by one.
        self._pump = Pump(end, self._send, on_gone=_never, ready=_always)

    @property
    def datagrams(self) -> int:
        """Sent so far."""
        return self._pump.datagrams

    def kick(self) -> None:
        self._pump.kick()

    def arrived(self, datagram: bytes) -> None:
        """One of the peer's (`FabricEvents.arrived`)."""
        try:
            self._end.receive(datagram, now=clock.now())
        except RemoteError as error:
            self._on_unreadable(error)
        self._pump.kick()

    def close(self) -> None:
        """Sends nothing any more. Idempotent."""
        self._pump.close()

    def _send(self, datagram: bytes) -> SendResult:
        """What is dropped is a loss, which the link makes good: nothing is held here, where it would be overtaken."""
        self._fabric.send(self._peer, self._end.priority, datagram)
        return SendResult.OK


def _always() -> bool:
    return True


def _never() -> None:
    """A fabric has no connection to lose: who is there is told by `FabricEvents`."""
