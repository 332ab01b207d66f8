"""The client's connections to the relay, which come back by themselves, for ever; the first carries the stream lane."""

import asyncio
import logging
from collections.abc import Callable, Sequence
from random import Random
from typing import Final, Protocol
from weakref import WeakSet

import zmq

from sern_core.link.link import Link
from sern_core.vocabulary.errors import ConfigError, RemoteError
from sern_core.wire import framing
from sern_runtime import clock
from sern_runtime.dscp import Marks
from sern_runtime.inflow import Inflow
from sern_runtime.monitor import TcpHandle
from sern_runtime.pump import LANE_MESSAGE_BYTES, Pump
from sern_runtime.transport_watch import TransportWatch
from sern_runtime.zmq_setup import HANDSHAKE_IVL_MS, CurvePair, make_client
from sern_runtime.zmq_socket import DealerSocket, SendResult

REBUILD_MIN_S: Final = 1.0
REBUILD_MAX_S: Final = 30.0
"""A relay that refused our key is asked again with a backoff that doubles, jittered by half."""

_log = logging.getLogger(__name__)


class DialerEvents(Protocol):
    """What becomes of a connection."""

    def up(self, handle: TcpHandle | None) -> None: ...

    def down(self, reason: str) -> None: ...

    def refused(self, reason: str) -> None:
        """The relay is there and does not want us; another attempt follows."""

    def given_up(self, reason: str) -> None:
        """The socket is made anew after a pause."""

    def received(self, data: framing.Datagram) -> None: ...

    def writable(self) -> None: ...


class Dialer:
    """One DEALER connection to `endpoint`; with several `server_keys` (a rotation) they are tried in turn."""

    def __init__(
        self,
        ctx: "zmq.Context[zmq.Socket[bytes]]",
        endpoint: str,
        keys: CurvePair | None,
        server_keys: Sequence[str],
        events: DialerEvents,
        *,
        heartbeat_timeout_s: float,
        handshake_interval_s: float,
        random: Random,
        tos: int = 0,
        priority_lane: bool = False,
        attempt: int = 0,
    ) -> None:
        self.rebuilds = 0
        self.attempt = attempt
        """Which of the server's keys is tried now."""
        self._ctx = ctx
        self._endpoint = endpoint
        self._keys = keys
        self._server_keys = tuple(server_keys)
        self._events = events
        self._made_with: tuple[CurvePair | None, str | None] = keys, None
        self._was_up = False
        self._refusing = False
        """Whether its owner is being told that the relay does not know our key: another attempt follows anyway."""
        self._handshake_ivl_ms = int(handshake_interval_s * 1000)
        self._heartbeat_timeout_ms = int(heartbeat_timeout_s * 1000)
        self._random = random
        self._priority_lane = priority_lane
        self._tos = tos
        self._backoff_s = REBUILD_MIN_S
        self._rebuild: asyncio.Handle | None = None
        self._socket: DealerSocket | None = None
        self._watch: TransportWatch | None = None
        self._handle: TcpHandle | None = None
        self._inflow: Inflow[TcpHandle] | None = None

    @property
    def waiting(self) -> bool:
        """Whether a connection is there, and its handshake under way."""
        return self._watch is not None and self._watch.waiting

    @property
    def letting_in(self) -> bool:
        """Whether the handshake of a connection is under way, and something of it has come back."""
        return self._watch is not None and self._watch.letting_in

    def open(self) -> None:
        """Connect for the first time. Raises ConfigError."""

        def attach(socket: "zmq.Socket[bytes]") -> None:
            self._watch = TransportWatch(socket, self._up, self._down, self._refused, self._give_up)

        server_key = self._server_keys[self.attempt % len(self._server_keys)] if self._server_keys else None
        self._made_with = self._keys, server_key
        raw = make_client(
            self._ctx,
            self._endpoint,
            self._keys,
            server_key,
            heartbeat_timeout_ms=self._heartbeat_timeout_ms,
            max_message_bytes=LANE_MESSAGE_BYTES,
            handshake_ivl_ms=self._handshake_ivl_ms,
            tos=self._tos,
            before_connect=attach,
        )
        self._socket = DealerSocket(raw, self._events.received)
        self._have_told(self._socket)
        self._inflow = Inflow(self._socket, self._taken, self._endless)

    def _have_told(self, socket: DealerSocket) -> None:
        socket.on_message = socket.on_view = self._events.received
        socket.on_writable = self._events.writable

    def hand_over(self, events: DialerEvents) -> None:
        """Another one is told from now on, first that there is a connection if there is."""
        self._events = events
        if self._socket is not None:
            self._have_told(self._socket)
        if self._was_up:
            events.up(self._handle)

    def use(self, keys: CurvePair | None, server_keys: Sequence[str]) -> None:
        """Other keys, for the sockets that are made from now on. One that was made with keys that are over is kept
        while it is connected, and made anew when it is not: libzmq would try them for ever."""
        if self._server_keys != tuple(server_keys):
            self.attempt = 0
        self._keys, self._server_keys = keys, tuple(server_keys)
        if self._socket is not None and self._stale and not self._was_up and not self._refusing:
            self.again("other keys are used")

    @property
    def _stale(self) -> bool:
        keys, server_key = self._made_with
        return keys != self._keys or (server_key is not None and server_key not in self._server_keys)

    def _reopen(self) -> None:
        self._rebuild = None
        try:
            self.open()
        except (zmq.ZMQError, ConfigError) as error:  # out of file descriptors, for example: that passes
            self._shut()
            self._events.down(f"no connection can be made: {error}")
            self._give_up(str(error))

    def _shut(self, linger_s: float = 0.0) -> None:
        if self._watch is not None:
            self._watch.close()
            self._watch = None
        if self._inflow is not None:
            self._inflow.close()
            self._inflow = None
        if self._socket is not None:
            self._socket.linger_s = linger_s
            self._socket.close()
            self._socket = None

    def close(self, *, linger_s: float = 0.0) -> None:
        """What was sent may take `linger_s` to leave."""
        if self._rebuild is not None:
            self._rebuild.cancel()
        self._shut(linger_s)

    def send(self, datagram: bytes) -> SendResult:
        if self._socket is None:
            return SendResult.FULL
        return self._socket.send(datagram)

    def _taken(self) -> list[tuple[TcpHandle, int]]:
        if self._handle is None or self._socket is None:
            return []
        return [(self._handle, self._socket.messages)]

    def _endless(self, handle: TcpHandle) -> None:
        del handle
        _log.warning("%s sends a message without end; the connection is cut", self._endpoint)

    def _up(self, handle: TcpHandle | None) -> None:
        self._handle = handle
        if handle is not None:
            handle.prepare(priority_lane=self._priority_lane, tos=self._tos)
        self._backoff_s = REBUILD_MIN_S
        self._was_up = True
        self._events.up(handle)

    def _down(self, reason: str) -> None:
        self._events.down(reason)
        if self._stale or (len(self._server_keys) > 1 and not self._was_up):
            self.again(reason)  # the relay may have another of the keys it announced
        self._was_up = False

    def _refused(self, reason: str) -> None:
        self._refusing = True
        self._events.refused(reason)
        self._refusing = False
        self._give_up(reason)

    def _give_up(self, reason: str) -> None:
        self.again(reason, self._backoff_s)
        self._backoff_s = min(2 * self._backoff_s, REBUILD_MAX_S)

    def again(self, reason: str, delay_s: float = REBUILD_MIN_S) -> None:
        """Make a new socket after a jittered pause: libzmq does not try this one again."""
        if self._rebuild is not None:
            return
        self.attempt += 1
        self._replace(reason, delay_s * (1 + 0.5 * self._random.random()))

    def redial(self, reason: str) -> None:
        """Make a new socket at once, with the keys that are to be used by now."""
        if self._rebuild is not None:
            self._rebuild.cancel()
        self._replace(reason, 0.0)

    def _replace(self, reason: str, delay_s: float) -> None:
        self.rebuilds += 1
        self._events.given_up(reason)
        loop = asyncio.get_running_loop()
        loop.call_soon(self._shut)
        # In this order also without a pause: the old one goes before the new one comes.
        self._rebuild = loop.call_later(delay_s, self._reopen) if delay_s else loop.call_soon(self._reopen)


class RelayTransport:
    """Joins `link` to `endpoint`; with several `server_keys` (a rotation) they are tried in turn.

    `on_reason` is told why the transport is down, `on_refused` that the relay does not know our key; `after` is called
    when the link has something to send, which may be for another lane. `ready`: a connection that there is already.
    """

    def __init__(
        self,
        ctx: "zmq.Context[zmq.Socket[bytes]]",
        link: Link,
        endpoint: str,
        keys: CurvePair | None,
        server_keys: Sequence[str],
        *,
        heartbeat_timeout_s: float,
        handshake_interval_s: float = HANDSHAKE_IVL_MS / 1000,
        random: Random,
        on_reason: Callable[[str], None],
        on_refused: Callable[[], None] = lambda: None,
        after: Callable[[], None] = lambda: None,
        marks: Marks | None = None,
        ready: Dialer | None = None,
    ) -> None:
        marks = marks or Marks()
        self.up_s: float | None = None
        """When the relay let a connection in last; None: it has not yet."""
        self.after = after
        self.link = link
        self.endpoint = endpoint
        self.bad_frames = 0
        self._on_reason = on_reason
        self._on_refused = on_refused
        self._keys = keys
        self._server_keys = tuple(server_keys)
        self._others: WeakSet[Dialer] = WeakSet()

        def dial(events: DialerEvents, *, priority_lane: bool = False, attempt: int = 0) -> Dialer:
            return Dialer(
                ctx,
                endpoint,
                self._keys,
                self._server_keys,
                events,
                heartbeat_timeout_s=heartbeat_timeout_s,
                handshake_interval_s=handshake_interval_s,
                random=random,
                tos=marks.priority_lane_tos if priority_lane else marks.stream_tos,
                priority_lane=priority_lane,
                attempt=attempt,
            )

        self._dial = dial
        self.dialer = ready or dial(self)
        self.pump = Pump(link, self.dialer.send, on_gone=lambda: None)
        if ready is None:
            self.dialer.open()
        else:
            ready.hand_over(self)

    @property
    def rebuilds(self) -> int:
        return self.dialer.rebuilds

    @property
    def waiting(self) -> bool:
        """Whether a connection is there, and its handshake under way."""
        return self.dialer.waiting

    @property
    def letting_in(self) -> bool:
        """Whether that handshake is under way, and something of it has come back."""
        return self.dialer.letting_in

    def another(self, events: DialerEvents) -> Dialer:
        """Another connection to the same relay, for class control, not opened yet."""
        other = self._dial(events, priority_lane=True, attempt=self.dialer.attempt)
        self._others.add(other)
        return other

    def use(self, keys: CurvePair | None, server_keys: Sequence[str]) -> None:
        """Other keys, for every connection that is made from now on."""
        self._keys, self._server_keys = keys, tuple(server_keys)
        for dialer in (self.dialer, *self._others):
            dialer.use(keys, server_keys)

    def close(self, *, linger_s: float = 0.0) -> None:
        """What was sent may take `linger_s` to leave."""
        self.pump.close()
        self.dialer.close(linger_s=linger_s)

    # --- DialerEvents -------------------------------------------------------------------------------------------------

    def up(self, handle: TcpHandle | None) -> None:
        self.up_s = clock.now()
        self.pump.reset()
        self.link.connected(now=self.up_s)
        self.pump.kick()

    def down(self, reason: str) -> None:
        self._on_reason(reason)
        self.given_up(reason)
        self.pump.kick()

    def refused(self, reason: str) -> None:
        """Then not by another lane either."""
        self._on_refused()
        self.link.close(reason, now=clock.now())

    def given_up(self, reason: str) -> None:
        self.pump.reset()
        self.link.disconnected(now=clock.now(), reason=reason)

    def received(self, data: framing.Datagram) -> None:
        if not self.link.handshake.reads:
            return
        try:
            self.link.receive(data, now=clock.now())
        except RemoteError as error:
            self.bad_frames += 1
            _log.warning("%s sent a bad frame (%s); reconnecting", self.endpoint, error)
            self.dialer.again(f"bad frame: {error}")
            return
        if self.link.dirty:
            self.pump.kick()
            self.after()

    def writable(self) -> None:
        self.pump.kick()
