"""Moves datagrams between a port of the core (a link, or the relay's side of one) and a lane's socket."""

import asyncio
from collections.abc import Callable
from typing import Final, Protocol

from sern_runtime import clock
from sern_runtime.fine_timer import FineTimer, fine_timer
from sern_runtime.loop import Timer
from sern_runtime.zmq_socket import SendResult

LANE_MESSAGE_BYTES: Final = 68 * 1024
"""The largest message a lane takes: the largest `fragment_bytes_max`, and what frames and CURVE put around it."""
BURST: Final = 64
"""Datagrams sent in one go before others in the loop get their turn; about 1 ms of work."""
BLOCKED_S: Final = 0.01
"""A lane that is not ready, or has been full for a while, is tried again at most this often, whatever has become due
meanwhile. libzmq reports every change of a full socket and seldom the one that helps: trying at each of them kept a
core busy for as long as the peer took nothing (measured)."""
AGAIN_S: Final = 1.0
"""After an error that nobody expects, of the socket for example, the port is asked again in so long at the latest."""
FULL_S: Final = 0.0002
"""The first pause after a full lane; it doubles up to `BLOCKED_S` while nothing leaves. A timer comes after a whole
millisecond, a change of the socket sooner: a pipe of 32 datagrams of 64 kB is empty after one at 2 GB/s."""


class Port(Protocol):
    """What the core gives for one side of a hop."""

    def next_datagram(self, *, now: float) -> bytes | None: ...

    def next_deadline(self) -> float | None: ...

    def handle_timeout(self, *, now: float) -> None: ...


class Pump:
    """Sends what `port` has, when it has it, and wakes it at its deadline.

    Call `kick` after anything that may have given the port something to send: it costs one flag, and everything that
    happens before the loop comes round is sent together. `send` answers FULL when the socket cannot take more; it is
    tried again soon. `on_gone` is called when the peer's connection is over.

    A paced lane (UDP) says with `next_deadline` when its next datagram may leave. The timer wakes for it at most once a
    millisecond, never early, and what has become due until then leaves as one burst: the core's pacing must grant what
    was not used for at least that long. Give such a lane `ready`: it is asked before a datagram is taken, so that none
    is held here, where it could no longer be overtaken, and its send stamp would grow old. It has a finer timer, too.
    """

    def __init__(
        self,
        port: Port,
        send: Callable[[bytes], SendResult],
        *,
        on_gone: Callable[[], None],
        ready: Callable[[], bool] | None = None,
    ) -> None:
        self._port = port
        self._send = send
        self._on_gone = on_gone
        self._ready = ready
        self._loop = asyncio.get_running_loop()
        self._timer: Timer | FineTimer = Timer(self._due) if ready is None else fine_timer(self._due)
        self._scheduled: asyncio.Handle | None = None
        self._held: bytes | None = None
        self._retry_s = 0.0  # not before then, while something is held
        self._pause_s = FULL_S
        self._closed = False
        self.datagrams = 0
        self.bytes = 0

    def kick(self) -> None:
        if self._scheduled is None and not self._closed:
            self._scheduled = self._loop.call_soon(self._run)

    def run(self) -> None:
        """Send now instead of when the loop comes round."""
        if not self._closed:
            self._run()

    def reset(self) -> None:
        """The transport is another one: forget what waited for the old one."""
        self._held = None

    def close(self) -> None:
        self._closed = True
        self._timer.close()
        if self._scheduled is not None:
            self._scheduled.cancel()
            self._scheduled = None

    def _due(self) -> None:
        try:
            self._port.handle_timeout(now=clock.now())
        finally:
            self._run()

    def _run(self) -> None:
        if self._scheduled is not None:
            self._scheduled.cancel()
            self._scheduled = None
        if self._closed:
            return
        now = clock.now()
        try:
            self._serve(now)
        except Exception:  # goes on to the loop's handler, which counts it
            self._timer.arm(now + AGAIN_S)  # whatever it was, the port is asked again
            raise

    def _serve(self, now: float) -> None:
        port = self._port
        ready = self._ready
        if self._held is not None and now < self._retry_s:
            self._timer.arm(self._retry_s)
            return
        earliest_s = now
        for _ in range(BURST):
            if ready is not None and not ready():
                earliest_s = now + BLOCKED_S
                break
            datagram = self._held
            if datagram is None:
                datagram = port.next_datagram(now=now)
                if datagram is None:
                    break
            result = self._send(datagram)
            if result is SendResult.OK:
                self._held = None
                self._pause_s = FULL_S
                self.datagrams += 1
                self.bytes += len(datagram)
            elif result is SendResult.FULL:
                self._held = datagram
                self._retry_s = now + self._pause_s
                self._pause_s = min(2 * self._pause_s, BLOCKED_S)
                self._timer.arm(self._retry_s)
                return
            else:
                self._held = None
                self._on_gone()
                return
        else:
            self.kick()
        deadline_s = port.next_deadline()
        self._timer.arm(deadline_s if deadline_s is None else max(deadline_s, earliest_s))
