"""Plain ZeroMQ sockets in the event loop.

`zmq.asyncio` costs about 25 µs a message in futures; a plain socket whose file descriptor is watched and which is
drained without blocking costs 1–2 µs. Its price is one rule, kept by `DrainedSocket` and nowhere else:

    ZMQ_FD is edge-triggered. It becomes readable when something *may* have changed, and not again before
    everything was taken. So: receive until EAGAIN; when the batch is capped, `call_soon` for the rest; look again
    after a send (sending consumes edges too); and look anyway every `TICK_S`, so that a missed edge is a delay.

    RouterSocket   [routing id, body] from many peers; every message with the CURVE identity of its sender
    DealerSocket   [body] from one peer
    FrameSocket    any number of frames, as zmq.Frame: ZAP, monitors, the feed

Routing ids and identity: clients set no routing id, and a name is never taken from one. The sender of a message is
the `User-Id` that the ZAP handler gave to its connection, and it is read from every message. It could be remembered
per routing id, as libzmq never gives an automatic id twice, but a peer may *claim* an id: once the connection that
had it is gone, ROUTER_HANDOVER=0 no longer stands in the way, and a remembered name would be inherited. Reading it
costs 0.3 µs of about 1.1 µs a message (measured, 1 kB); nothing is remembered, nothing can be inherited. Messages of
peers that claim a routing id at all are refused.
"""

import asyncio
import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from enum import Enum
from typing import Final, NamedTuple, Protocol, cast

import zmq

from sern_core.vocabulary.errors import UsageError
from sern_runtime.addresses import plain_host
from sern_runtime.inflow import trim_memory

BATCH: Final = 200
"""Messages taken in one callback, about 0.3 ms: others in the loop get their turn."""
LAST_WORDS_DRAINS: Final = 64
"""After so many looks at a socket that never is empty, what was to be told when it is (`when_empty`) is told anyway."""
SKIP_FRAMES: Final = 2000
"""Frames of an unwanted message that are dropped in one callback, about 1 ms."""
TICK_S: Final = 0.2
ZERO_COPY_BYTES: Final = 32 * 1024
"""Bodies from this size on are sent without a copy (measured: it pays above 16–64 kB)."""
VIEW_BYTES: Final = 8 * 1024
"""Messages from this size on are handed to `on_view`, if there is one: a view of what libzmq received, not a copy."""

AUTO_ROUTING_ID_BYTES: Final = 5  # a zero byte and a counter of 32 bits, libzmq's router.cpp

_log = logging.getLogger(__name__)
_NOBLOCK: Final = int(zmq.NOBLOCK)
_SNDMORE: Final = int(zmq.SNDMORE)
_NOBLOCK_MORE: Final = _NOBLOCK | _SNDMORE


class RawSend(Protocol):
    def __call__(self, data: "bytes | zmq.Frame", flags: int, copy: bool = True, /) -> object: ...


class SendResult(Enum):
    """What became of a send. True only for OK."""

    OK = "ok"  # libzmq took it; that is no delivery receipt
    FULL = "full"  # high-water mark, or nobody connected yet (EAGAIN); `on_writable` tells when to try again
    GONE = "gone"  # the routing id names no connection (EHOSTUNREACH)

    def __bool__(self) -> bool:
        return self is SendResult.OK


class PeerDetails(NamedTuple):
    """Where the message being handled came from. `fd` is libzmq's: use `sern_runtime.monitor.TcpHandle` on it."""

    address: str
    fd: int


def _raise_if_alive(socket: "zmq.Socket[bytes]", error: zmq.ZMQError) -> None:
    """Swallow an error that only says that a handler closed the socket under the drain loop."""
    if not (socket.closed or error.errno in (zmq.ETERM, zmq.ENOTSOCK)):
        raise error


class DrainedSocket(ABC):
    """A socket in the running loop. Subclasses say what a message looks like in `_take`.

    All calls on the loop's thread. `close()` once; it closes the socket too. `on_writable` is called once after a FULL
    send, when libzmq reports any change: try again, and be told FULL again if it was another one.
    A handler that raises is reported by the loop's exception handler; the next message is delivered all the same.
    """

    def __init__(
        self,
        socket: "zmq.Socket[bytes]",
        *,
        on_writable: Callable[[], None] | None = None,
        batch: int = BATCH,
        tick_s: float = TICK_S,
        loop: asyncio.AbstractEventLoop | None = None,
    ) -> None:
        if batch < 1:
            raise UsageError(f"batch is {batch}, it must be at least 1")
        self.socket = socket
        self.raw_send = cast("RawSend", super(zmq.Socket, socket).send)
        """`send` of the extension type, (data, flags, copy): without the checks of options that SERN does not use.
        May raise zmq.Again; `kick` is the caller's duty."""
        self.on_writable = on_writable
        self.linger_s = 0.0
        """How long libzmq may go on with what it has not sent when the socket is closed; its context ends no sooner."""
        self.malformed = 0
        """Messages dropped whole because their frames were not what this socket takes."""
        self.drains = 0
        """Counts every look at the socket, the tick's included: the liveness of this socket's reader."""
        self.emptied = 0
        """Counts every time that nothing was left to take."""
        self.late = 0
        """Messages that only the tick found. Stays 0 while the edge rule is kept."""
        self._loop = loop or asyncio.get_running_loop()
        self._batch = batch
        self._tick_s = tick_s
        self._scheduled: asyncio.Handle | None = None
        self._blocked = False
        self._closed = False
        self._when_empty: list[tuple[Callable[[], None], int]] = []  # and by which drain at the latest
        self.skipping = False
        """Inside a message that is not wanted: `_take` returns True meanwhile."""
        self._fd = int(socket.FD)
        self._loop.add_reader(self._fd, self.drain)
        self._tick = self._loop.call_later(tick_s, self._on_tick)
        self.kick()  # what arrived before the watcher was set made its edge already

    def kick(self) -> None:
        """Look at the socket again soon. Needed after using `socket` directly."""
        if self._scheduled is None and not self._closed:
            self._scheduled = self._loop.call_soon(self._drain_rest)

    def when_empty(self, tell: Callable[[], None]) -> None:
        """Call `tell` once all is taken that has arrived by now, or after `LAST_WORDS_DRAINS` looks where more and more
        comes. A monitor says that a connection is over while its last messages wait here still."""
        self._when_empty.append((tell, self.drains + LAST_WORDS_DRAINS))
        self.kick()

    def send(self, body: bytes) -> SendResult:
        """Send one frame without waiting."""
        try:
            self.raw_send(body, _NOBLOCK, len(body) < ZERO_COPY_BYTES)
        except zmq.ZMQError as error:
            return self._unsent(error)
        if self._scheduled is None:
            self.kick()
        return SendResult.OK

    def send_frames(self, frames: "Sequence[bytes | zmq.Frame]") -> SendResult:
        """Send one message of several frames without waiting: all of it or nothing."""
        try:
            self.socket.send_multipart(frames, _NOBLOCK, copy=True)
        except zmq.ZMQError as error:
            return self._unsent(error)
        if self._scheduled is None:
            self.kick()
        return SendResult.OK

    def close(self) -> None:
        """Stop watching and close the socket; what libzmq has not sent yet may go on for `linger_s`. Idempotent;
        allowed inside a handler."""
        if self._closed:
            return
        self._closed = True
        self._tick.cancel()
        if self._scheduled is not None:
            self._scheduled.cancel()
        if not self.socket.closed:
            self._loop.remove_reader(self._fd)
            self.socket.close(linger=round(1000 * self.linger_s))

    @property
    def closed(self) -> bool:
        return self._closed

    def _unsent(self, error: zmq.ZMQError) -> SendResult:
        if error.errno == zmq.EAGAIN:
            self._blocked = True
            self.kick()
            return SendResult.FULL
        if error.errno == zmq.EHOSTUNREACH:
            return SendResult.GONE
        raise error

    def _on_tick(self) -> None:
        before = self._received()
        self._tick = self._loop.call_later(self._tick_s, self._on_tick)
        pending = self._scheduled is not None
        self.drain()
        if not pending and not self._closed:
            self.late += self._received() - before

    def _received(self) -> int:
        return 0

    def _drain_rest(self) -> None:
        self._scheduled = None
        self.drain()

    def drain(self) -> None:
        """Take what has arrived, now, up to one batch; the rest follows by itself."""
        if self._closed:
            return
        self.drains += 1
        more = True  # also when a handler raises: the edge is used up, so the rest must be asked for
        try:
            if not self.skipping:
                more = self._take(self._batch)
            elif self._skip():
                trim_memory()
        except zmq.Again:
            more = False
            self.emptied += 1
        except zmq.ZMQError as error:
            more = False
            _raise_if_alive(self.socket, error)
        finally:
            if more:
                self.kick()
        if self._blocked and not self._closed and self.on_writable is not None:
            self._blocked = False
            self.on_writable()
        if self._when_empty and not self._closed:
            self._tell_empty(now=not more)

    def _tell_empty(self, *, now: bool) -> None:
        due = [tell for tell, drains in self._when_empty if now or self.drains >= drains]
        self._when_empty = [] if now else [each for each in self._when_empty if self.drains < each[1]]
        for tell in due:
            tell()

    @abstractmethod
    def _take(self, count: int) -> bool:
        """Receive and hand over up to `count` messages. True: there may be more. zmq.Again: all taken."""

    def skip_rest(self, frame: zmq.Frame) -> None:
        """Drop the remaining frames of a message, without which they would pass for a message of their own.

        There may be very many: `_take` calls this, returns True while `skipping`, and the next callback goes on.
        """
        self.malformed += 1
        self.skipping = bool(frame.more)
        if self.skipping:
            self._skip()

    def _skip(self) -> bool:
        """Drop some frames. True: these were the last of their message."""
        recv = self.socket.recv
        for _ in range(SKIP_FRAMES):
            if not recv(_NOBLOCK, copy=False).more:
                self.skipping = False
                return True
        return False


class RouterSocket(DrainedSocket):
    """A ROUTER of single-frame messages.

    `on_message(routing_id, user, body)`: `user` is the sender's User-Id as the ZAP handler gave it, empty on a socket
    without CURVE (say so with `identified`: asking for what is not there costs 3 µs). It and `send_to` are all there is
    to identity: nothing else in a message says who sent it.
    """

    def __init__(
        self,
        socket: "zmq.Socket[bytes]",
        on_message: Callable[[bytes, str, bytes], None],
        *,
        on_view: Callable[[bytes, str, memoryview], None] | None = None,
        identified: bool = True,
        on_writable: Callable[[], None] | None = None,
        batch: int = BATCH,
        tick_s: float = TICK_S,
    ) -> None:
        super().__init__(socket, on_writable=on_writable, batch=batch, tick_s=tick_s)
        self.on_message = on_message
        self.on_view = on_view
        self.identified = identified
        self.on_refused: Callable[[str], None] | None = None
        """Told why a message was dropped unread; `peer_details` says whose it was."""
        self.messages = 0
        self.refused_routing_ids = 0
        """Messages of peers that claimed a routing id of their own choice."""
        self._frame: zmq.Frame | None = None

    def peer_details(self) -> PeerDetails:
        """Address and file descriptor of the sender; only inside `on_message` and `on_refused`."""
        if self._frame is None:
            raise UsageError("peer_details() is for use inside on_message and on_refused")
        return PeerDetails(plain_host(_text(self._frame, "Peer-Address")), int(self._frame.get(zmq.SRCFD)))

    def send_to(self, routing_id: bytes, body: bytes) -> SendResult:
        """Send to one peer without waiting. GONE when its connection is over (ROUTER_MANDATORY)."""
        try:
            self.raw_send(routing_id, _NOBLOCK_MORE)
            self.raw_send(body, _NOBLOCK, len(body) < ZERO_COPY_BYTES)
        except zmq.ZMQError as error:
            return self._unsent(error)
        if self._scheduled is None:
            self.kick()
        return SendResult.OK

    def _received(self) -> int:
        return self.messages

    def _take(self, count: int) -> bool:
        recv = self.socket.recv
        on_message = self.on_message
        on_view = self.on_view
        identified = self.identified
        try:
            for _ in range(count):
                routing_id = recv(_NOBLOCK)
                frame = recv(_NOBLOCK, copy=False)  # a Frame knows `more` and User-Id; RCVMORE alone costs as much
                self.messages += 1
                self._frame = frame
                if frame.more:
                    self._refuse("a message of several frames")
                    self.skip_rest(frame)
                    if self.skipping:
                        return True
                elif len(routing_id) != AUTO_ROUTING_ID_BYTES or routing_id[0] != 0:
                    self.refused_routing_ids += 1
                    self._refuse("a routing id of its own choice")
                else:
                    user = user_of(frame) if identified else ""
                    if on_view is not None and len(frame) >= VIEW_BYTES:
                        on_view(routing_id, user, frame.buffer)
                    else:
                        on_message(routing_id, user, frame.bytes)
        finally:
            self._frame = None
        return True

    def _refuse(self, why: str) -> None:
        if self.on_refused is not None:
            self.on_refused(why)


class DealerSocket(DrainedSocket):
    """A DEALER (or PAIR) of single-frame messages. `on_message(body)`."""

    def __init__(
        self,
        socket: "zmq.Socket[bytes]",
        on_message: Callable[[bytes], None],
        *,
        on_view: Callable[[memoryview], None] | None = None,
        on_writable: Callable[[], None] | None = None,
        batch: int = BATCH,
        tick_s: float = TICK_S,
    ) -> None:
        super().__init__(socket, on_writable=on_writable, batch=batch, tick_s=tick_s)
        self.on_message = on_message
        self.on_view = on_view
        self.messages = 0

    def _received(self) -> int:
        return self.messages

    def _take(self, count: int) -> bool:
        recv = self.socket.recv
        on_message = self.on_message
        on_view = self.on_view
        for _ in range(count):
            frame = recv(_NOBLOCK, copy=False)
            self.messages += 1
            if frame.more:
                self.skip_rest(frame)
                if self.skipping:
                    return True
            else:
                if on_view is not None and len(frame) >= VIEW_BYTES:
                    on_view(frame.buffer)
                else:
                    on_message(frame.bytes)
        return True


class FrameSocket(DrainedSocket):
    """Any socket, any number of frames up to `max_frames`. `on_message(frames)`; longer ones are dropped whole."""

    def __init__(
        self,
        socket: "zmq.Socket[bytes]",
        on_message: Callable[[list[zmq.Frame]], None],
        *,
        max_frames: int = 8,
        on_writable: Callable[[], None] | None = None,
        batch: int = BATCH,
        tick_s: float = TICK_S,
        loop: asyncio.AbstractEventLoop | None = None,
    ) -> None:
        super().__init__(socket, on_writable=on_writable, batch=batch, tick_s=tick_s, loop=loop)
        self.on_message = on_message
        self.max_frames = max_frames
        self.messages = 0

    def _received(self) -> int:
        return self.messages

    def _take(self, count: int) -> bool:
        recv = self.socket.recv
        on_message = self.on_message
        max_frames = self.max_frames
        for _ in range(count):
            frame = recv(_NOBLOCK, copy=False)
            frames = [frame]
            while frame.more:
                frame = recv(_NOBLOCK, copy=False)
                if len(frames) == max_frames:
                    self.skip_rest(frame)
                    frames = []
                    if self.skipping:
                        self.messages += 1
                        return True
                    break
                frames.append(frame)
            self.messages += 1
            if frames:
                on_message(frames)
        return True


def _text(frame: zmq.Frame, name: str) -> str:
    """A connection property of a frame, empty where the connection has none (no ZAP, inproc)."""
    try:
        return str(frame.get(name))
    except zmq.ZMQError:
        return ""


def user_of(frame: zmq.Frame) -> str:
    """The User-Id that the ZAP handler gave to the connection of this frame; empty without one."""
    return _text(frame, "User-Id")
