"""The client's lane to the relay: one DEALER connection that comes back by itself, for ever."""

import asyncio
import logging
import time
from collections.abc import Callable, Sequence
from random import Random
from typing import Final

import zmq

from sern_core.errors import ConfigError, RemoteError
from sern_core.link import Link
from sern_runtime.monitor import TcpHandle, TransportWatch
from sern_runtime.pump import LANE_MESSAGE_BYTES, Pump
from sern_runtime.zmq_socket import CurvePair, DealerSocket, SendResult, make_client

REBUILD_MIN_S: Final = 1.0
REBUILD_MAX_S: Final = 30.0
"""A relay that refused our key is asked again with a backoff that doubles, jittered by half."""
CONGESTION_CONTROL: Final = "cubic"
"""BBR's PROBE_RTT shows as 160-260 ms spikes of class 0 every 10 s; the window above it keeps the queue short."""

_log = logging.getLogger(__name__)


class RelayTransport:
    """Joins `link` to `endpoint`; with several `server_keys` (a rotation) they are tried in turn.

    `on_reason` is told why the transport is down; `after` is called when the link has something to send, which may be
    for another lane.
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
        random: Random,
        on_reason: Callable[[str], None],
        after: Callable[[], None] = lambda: None,
    ) -> None:
        self.after = after
        self.link = link
        self.endpoint = endpoint
        self.bad_frames = 0
        self.rebuilds = 0
        self._ctx = ctx
        self._keys = keys
        self._server_keys = tuple(server_keys)
        self._attempt = 0
        self._was_up = False
        self._heartbeat_timeout_ms = int(heartbeat_timeout_s * 1000)
        self._random = random
        self._on_reason = on_reason
        self._backoff_s = REBUILD_MIN_S
        self._rebuild: asyncio.TimerHandle | None = None
        self._socket: DealerSocket | None = None
        self._watch: TransportWatch | None = None
        self.pump = Pump(link, self._send, on_gone=lambda: None)
        self._open()

    def _open(self) -> None:
        def attach(socket: "zmq.Socket[bytes]") -> None:
            self._watch = TransportWatch(socket, self._up, self._down, self._refused)

        raw = make_client(
            self._ctx,
            self.endpoint,
            self._keys,
            self._server_keys[self._attempt % len(self._server_keys)] if self._server_keys else None,
            heartbeat_timeout_ms=self._heartbeat_timeout_ms,
            max_message_bytes=LANE_MESSAGE_BYTES,
            before_connect=attach,
        )
        self._socket = DealerSocket(raw, self._received, on_writable=self.pump.kick)

    def _reopen(self) -> None:
        self._rebuild = None
        try:
            self._open()
        except (zmq.ZMQError, ConfigError) as error:  # out of file descriptors, for example: that passes
            self._shut()
            self._on_reason(f"no connection can be made: {error}")
            self._give_up(str(error))

    def _shut(self) -> None:
        if self._watch is not None:
            self._watch.close()
            self._watch = None
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def close(self) -> None:
        if self._rebuild is not None:
            self._rebuild.cancel()
        self.pump.close()
        self._shut()

    def _send(self, datagram: bytes) -> SendResult:
        if self._socket is None:
            return SendResult.FULL
        return self._socket.send(datagram)

    def _received(self, data: bytes) -> None:
        try:
            self.link.receive(data, now=time.monotonic())
        except RemoteError as error:
            self.bad_frames += 1
            _log.warning("%s sent a bad frame (%s); reconnecting", self.endpoint, error)
            self._again(f"bad frame: {error}", REBUILD_MIN_S)
            return
        if self.link.dirty:
            self.pump.kick()
            self.after()

    def _up(self, handle: TcpHandle | None) -> None:
        if handle is not None:
            handle.set_congestion(CONGESTION_CONTROL)
            handle.set_rto_max()
        self._backoff_s = REBUILD_MIN_S
        self._was_up = True
        self.pump.reset()
        self.link.connected(now=time.monotonic())
        self.pump.kick()

    def _down(self, reason: str) -> None:
        self._on_reason(reason)
        self.pump.reset()
        self.link.disconnected(now=time.monotonic(), reason=reason)
        self.pump.kick()
        if len(self._server_keys) > 1 and not self._was_up:
            self._again(reason, REBUILD_MIN_S)  # the relay may have another of the keys it announced
        self._was_up = False

    def _refused(self, reason: str) -> None:
        """The relay is there and does not want us: then not by another lane either."""
        self.link.close(reason, now=time.monotonic())
        self._give_up(reason)

    def _give_up(self, reason: str) -> None:
        self._again(reason, self._backoff_s)
        self._backoff_s = min(2 * self._backoff_s, REBUILD_MAX_S)

    def _again(self, reason: str, delay_s: float) -> None:
        """Make a new socket after a jittered pause: libzmq does not try this one again."""
        if self._rebuild is not None:
            return
        self.rebuilds += 1
        self._attempt += 1
        self.pump.reset()
        self.link.disconnected(now=time.monotonic(), reason=reason)
        loop = asyncio.get_running_loop()
        loop.call_soon(self._shut)
        self._rebuild = loop.call_later(delay_s * (1 + 0.5 * self._random.random()), self._reopen)
