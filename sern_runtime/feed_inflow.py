"""Ends connections of the feed on which bytes arrive and no message does (`sern_runtime.inflow` says why).

A publisher's message may be one frame as large as the feed takes, so that much may arrive first; which connection a
message came from is asked for of large ones, and of small ones only while a connection brings much of that. Of what
a subscriber sends, so many bytes are let in over the life of a connection, beside a trickle; what of that it keeps is
bounded by `sern_runtime.feed_subscriptions`.

As much as one large frame may bring in tiny ones takes thirty times its size, and nobody sees how many frames there
are. What shows is the process's memory: where that has grown by more than `GROWTH_MULTIPLE` times of what all messages
under way have brought, and `GROWTH_BYTES`, since a connection's last message, the connection has not sent one large
frame, or another one has not; each of those that are behind by `LIMIT_BYTES` is cut.
"""

import logging
from collections.abc import Callable
from typing import Final, NamedTuple

import zmq

from sern_runtime.inflow import LIMIT_BYTES, Inflow, Socket, resident_bytes
from sern_runtime.monitor import ConnectionTable, TcpHandle

SUBSCRIBER_BYTES: Final = 64 * 1024
"""Some hundred subscriptions, each a hundred bytes. libzmq's table of them takes up to a hundred times that."""
MAX_CONNECTIONS: Final = 256
"""Connections of one socket of a role; further ones are cut at once. Programs may have one for each topic."""
TOLD_BYTES: Final = 2048
"""Messages from this size on are always booked to the connection they came from, which takes a quarter of a
microsecond. Smaller ones never add up, between two looks, to what could be mistaken for a message without end."""
GROWTH_MULTIPLE: Final = 3
"""One large frame takes its size, and another time that when it has come out; one of two bytes takes 64."""
GROWTH_BYTES: Final = 64 * 2**20
"""Beside that: what the rest of the process may come to need meanwhile."""
_log = logging.getLogger(__name__)


class _Seen(NamedTuple):
    """What was seen of one connection: messages, and at the last of them its bytes and the process's memory."""

    taken: int
    read_bytes: int
    memory_bytes: int


class FeedInflow:
    """The watch of one socket of the feed. `close` before the socket."""

    def __init__(
        self,
        role: str,
        socket: Socket,
        raw: "zmq.Socket[bytes]",
        on_endless: Callable[[], None],
        *,
        max_message_bytes: int | None = None,
        max_connections: int = MAX_CONNECTIONS,
        on_gone: Callable[[int], None] | None = None,
        memory: Callable[[], int] = resident_bytes,
    ) -> None:
        """`max_message_bytes`: of a publisher's frame; None for subscribers. `memory`: of the process, bytes."""
        self.watching = False
        """Whether the socket is to say which connection each message came from (`came`)."""
        self._role = role
        self._on_endless = on_endless
        self._limit_bytes = SUBSCRIBER_BYTES if max_message_bytes is None else max_message_bytes + LIMIT_BYTES
        self._counts = max_message_bytes is not None
        self._taken: dict[int, int] = {}
        self._memory = memory
        self._seen: dict[TcpHandle, _Seen] = {}
        self.connections = ConnectionTable(
            raw,
            max_half_open_per_source=0,
            max_half_open=0,
            max_connections=max_connections,
            on_gone=on_gone,
        )
        self._inflow = Inflow(socket, self._connections, self._endless, limit_bytes=self._limit_bytes)

    def close(self) -> None:
        self._inflow.close()
        self.connections.close()

    @property
    def capped(self) -> int:
        """Connections that were cut as there were enough."""
        return self.connections.capped

    def came(self, fd: int) -> None:
        self._taken[fd] = self._taken.get(fd, 0) + 1

    def _connections(self) -> list[tuple[TcpHandle, int]]:
        handles = self.connections.handles()
        if self._counts:
            self._taken = {handle.fd: self._taken.get(handle.fd, 0) for handle in handles}
            self._look(handles, self._memory())
        return [(handle, self._taken.get(handle.fd, 0)) for handle in handles]

    def _look(self, handles: list[TcpHandle], memory_bytes: int) -> None:
        behind: dict[TcpHandle, int] = {}
        seen: dict[TcpHandle, _Seen] = {}
        for handle in handles:
            read_bytes, taken = handle.read_bytes() or 0, self._taken[handle.fd]
            known = self._seen.get(handle)
            if known is None or known.taken != taken:
                known = _Seen(taken, read_bytes, memory_bytes)
            since_bytes = read_bytes - known.read_bytes
            if since_bytes > LIMIT_BYTES // 4:
                behind[handle] = since_bytes
            else:
                known = known._replace(memory_bytes=memory_bytes)  # what grows now is not its doing
            seen[handle] = known
        self._seen = seen
        self.watching = bool(behind)
        explained_bytes = GROWTH_MULTIPLE * sum(behind.values()) + GROWTH_BYTES
        self._inflow.suspects = {
            handle for handle in behind if memory_bytes - seen[handle].memory_bytes > explained_bytes
        }

    def _endless(self, handle: TcpHandle) -> None:
        self._on_endless()
        _log.warning("connection of feed role %s from %s closed: a message without end", self._role, handle.peer[0])
