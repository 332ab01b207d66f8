"""One viewer: what it sends passes on to the server when it is sound, and what it gets waits here, within bounds.

Messages of topics do not pass through the server, which would keep them by number, drop the oldest and tell nobody.
They wait here, bounded in bytes and time, and are dropped with a reason. What the server says (topics, services,
answers) is never dropped; a viewer that leaves too much of that is cut.
"""

import asyncio
import socket
from collections import Counter, deque
from contextlib import suppress
from typing import Any, Final, NamedTuple, Protocol, TypeGuard, cast

from sern_client.endpoints.common.queue import BoundedQueue
from sern_client.endpoints.foxglove import frames, handshake
from sern_client.endpoints.foxglove.frames import Fault, FrameError, Heard, Said
from sern_core.vocabulary.types import DropReason
from sern_runtime import clock

WAIT_S: Final = 1.0
"""A topic's message that a viewer has not begun to take after so long is of no use to who looks at what is now."""
MUST_BYTES: Final = 128 * 2**20
"""What must not be dropped and waits for a viewer: beyond, it is cut. Who comes may ask for several large maps at once;
what waits of them are the very bodies that are kept for all."""
SOCKET_BYTES: Final = 2**18
"""What waits in this process and in the system behind a message that has its turn: more would only make it late."""
MAX_SUBSCRIPTIONS: Final = 20_000
FLUSH_S: Final = 1.0
"""How long a viewer has to take what was said last."""


class _Waiting(NamedTuple):
    head: bytes
    body: bytes
    channel: int
    until_s: float


class Owner(Protocol):
    """What a viewer is to know of the whole, and whom it tells."""

    dropped: Counter[DropReason]

    def subscribed(self, viewer: "Viewer", subscription: int, channel: int) -> None:
        """A viewer has asked for a channel."""

    def unsubscribed(self, viewer: "Viewer", channel: int) -> None: ...

    def fault(self, fault: Fault, problem: str, peer: str = "") -> None:
        """Count something that a viewer sent, and say it, once of each host."""

    def behind(self, viewer: "Viewer") -> None:
        """It takes less than what comes; told once until it has caught up."""

    def gone(self, viewer: "Viewer") -> None: ...


class Viewer:
    """One viewer, from its admission to its end. `transport`: its own. `protocol`: its name for the one that is
    spoken."""

    def __init__(
        self, peer: str, transport: asyncio.Transport, owner: Owner, *, protocol: str, max_waiting_bytes: int
    ) -> None:
        self.peer = peer
        self.closed = False
        self.ready = False
        """The server has answered, so something may be said to it."""
        self.subscriptions: dict[int, int] = {}
        """Channel ids by the viewer's own numbers, those that it says it has."""
        self.dropped: Counter[int] = Counter()
        """Messages of topics that it did not get, by channel id."""
        self._channels: set[int] = set()
        self._protocol = protocol
        self._transport = transport
        self._owner = owner
        self._server: asyncio.Transport | None = None
        self._heard = Heard()
        self._said = Said()
        self._answer = bytearray()
        self._paused = False
        self._behind = False
        self._waiting: BoundedQueue[_Waiting] = BoundedQueue(max_bytes=max_waiting_bytes)
        self._must: deque[tuple[bytes, ...]] = deque()
        self._must_bytes = 0
        transport.set_write_buffer_limits(high=SOCKET_BYTES)
        _set(transport, socket.SOL_SOCKET, socket.SO_SNDBUF, SOCKET_BYTES)
        _set(transport, socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)

    def joined(self, server: asyncio.Transport) -> None:
        """The connection to the server behind it is there."""
        self._server = server

    # --- from the viewer --------------------------------------------------------------------------------------------

    def hear(self, data: bytes) -> None:
        if self.closed or self._server is None:
            return
        try:
            spoken = self._heard.feed(data)
        except FrameError as error:
            self._owner.fault(error.fault, f"is cut: {error}", self.peer)
            self.cut(error.code, str(error))
            return
        self._server.write(data)
        for each in spoken:
            if each.problem:  # the server tells it so
                self._owner.fault(Fault.CONTENT, f"sent {each.problem}", self.peer)
            elif each.said["op"] == "subscribe":
                self._subscribes(each.said.get("subscriptions"))
            elif each.said["op"] == "unsubscribe":
                self._unsubscribes(each.said.get("subscriptionIds"))

    def _subscribes(self, listed: Any) -> None:
        for each in listed if isinstance(listed, list) else ():
            number, channel = (each.get("id"), each.get("channelId")) if isinstance(each, dict) else (None, None)
            if not (_is_id(number) and _is_id(channel)) or number in self.subscriptions:
                continue
            if len(self.subscriptions) < MAX_SUBSCRIPTIONS and channel not in self._channels:
                self.subscriptions[number] = channel
                self._channels.add(channel)
                self._owner.subscribed(self, number, channel)

    def _unsubscribes(self, listed: Any) -> None:
        for number in listed if isinstance(listed, list) else ():
            if _is_id(number):
                channel = self.subscriptions.pop(number, None)
                if channel is not None:
                    self._channels.discard(channel)
                    self._owner.unsubscribed(self, channel)

    def forget(self, subscription: int, channel: int) -> None:
        """A channel is no more."""
        self._channels.discard(channel)
        self.dropped.pop(channel, None)
        self.subscriptions.pop(subscription, None)

    # --- to the viewer ----------------------------------------------------------------------------------------------

    def say(self, data: bytes) -> None:
        """What the server has for it."""
        if self.closed:
            return
        if not self.ready:
            self._answer += data
            answer = handshake.answered(bytes(self._answer))
            if answer is None:
                if len(self._answer) > handshake.MAX_HEAD_BYTES:
                    self.close()
                return
            head, data = answer
            self._answer.clear()
            self._transport.write(handshake.renamed(head, self._protocol))
            if not handshake.accepted(head):
                self._transport.write(data)
                self.close()
                return
            self.ready = True
        for each in self._said.feed(data):
            self._send(each)

    def tell(self, said: dict[str, Any]) -> None:
        """Say something of our own to this viewer alone."""
        if self.ready and not self.closed:
            self._send(frames.text_frame(said))

    def show(self, subscription: int, stamp_ns: int, body: bytes, *, must: bool) -> None:
        """A topic's message. `must`: it holds until there is another, so that it must arrive."""
        if not self.ready or self.closed:
            return
        head = frames.message_head(subscription, stamp_ns, len(body))
        if self._free:
            self._transport.writelines([head, body])
        elif must:
            self._send(head, body)
        else:
            if not self._behind and len(self._waiting):
                self._behind = True
                self._owner.behind(self)
            channel = self.subscriptions.get(subscription, -1)
            waiting = _Waiting(head, body, channel, clock.now() + WAIT_S)
            for dropped in self._waiting.put(waiting, len(head) + len(body)):
                self._drop(DropReason.QUEUE_FULL, dropped)

    @property
    def _free(self) -> bool:
        """Whether nothing waits."""
        return not self._paused and not self._must and not len(self._waiting)

    def _send(self, *parts: bytes) -> None:
        """What must arrive."""
        if self._free:
            self._transport.writelines(parts)
            return
        self._must.append(parts)
        self._must_bytes += sum(map(len, parts))
        if self._must_bytes > MUST_BYTES:
            self._owner.fault(Fault.SLOW, "is cut: it takes nothing of what must arrive", self.peer)
            self.cut(frames.AGAIN_LATER, "too slow")

    def pause(self) -> None:
        """Its connection takes nothing more now."""
        self._paused = True

    def resume(self) -> None:
        """Its connection takes something again: what must arrive first."""
        self._paused = False
        now = clock.now()
        while self._must and not self._paused:
            parts = self._must.popleft()
            self._must_bytes -= sum(map(len, parts))
            self._transport.writelines(parts)
        while len(self._waiting) and not self._paused:
            waiting = self._waiting.pop()
            if waiting.until_s < now:
                self._drop(DropReason.LIFESPAN, waiting)
            else:
                self._transport.writelines([waiting.head, waiting.body])
        if not self._paused:
            self._behind = False

    def _drop(self, why: DropReason, waiting: _Waiting) -> None:
        self._owner.dropped[why] += 1
        self.dropped[waiting.channel] += 1

    # --- its end ----------------------------------------------------------------------------------------------------

    def cut(self, code: int, why: str) -> None:
        """End it, and tell it why where it can be told."""
        if not self.closed and self.ready and not self._paused:
            self._transport.write(frames.close_frame(code, why))
        self.close()

    def close(self) -> None:
        if self.closed:
            return
        self.closed = True
        while len(self._waiting):
            self._drop(DropReason.DISCONNECTED, self._waiting.pop())
        self._must.clear()
        self._must_bytes = 0
        for channel in self._channels:
            self._owner.unsubscribed(self, channel)
        if self._server is not None:
            self._server.abort()
        if self._paused:
            self._transport.abort()  # it would wait for who takes nothing
        else:
            self._transport.close()
            asyncio.get_running_loop().call_later(FLUSH_S, self._transport.abort)
        self._owner.gone(self)

    def hold(self, *, held: bool) -> None:
        """Whether the server takes what the viewer sends."""
        with suppress(RuntimeError):  # it is closing
            (self._transport.pause_reading if held else self._transport.resume_reading)()


class ServerSide(asyncio.Protocol):
    """The connection from a viewer to the server behind the door."""

    def __init__(self, viewer: Viewer, connection: socket.socket) -> None:
        self._viewer = viewer
        self._connection = connection

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._viewer.joined(cast("asyncio.Transport", transport))

    def data_received(self, data: bytes) -> None:
        # The server sends with Nagle's algorithm: what it has next waits until we have confirmed what came.
        self._connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)
        self._viewer.say(data)

    def pause_writing(self) -> None:
        self._viewer.hold(held=True)

    def resume_writing(self) -> None:
        self._viewer.hold(held=False)

    def connection_lost(self, error: Exception | None) -> None:
        self._viewer.close()


def _is_id(value: object) -> TypeGuard[int]:
    return type(value) is int and 0 <= value < 1 << 32


def _set(transport: asyncio.Transport, level: int, option: int, value: int) -> None:
    """Best effort: a connection that is closing takes none, and a test's transport has no socket."""
    found = transport.get_extra_info("socket")
    if found is not None:
        with suppress(OSError):
            found.setsockopt(level, option, value)
