"""Ends connections of the feed on which bytes arrive and no message does (`sern_runtime.inflow` says why).

A publisher's message may be one frame as large as the feed takes, so that much may arrive first; which connection a
message came from is asked for of large ones, and of small ones only while a connection brings much of that. What
a subscriber sends does not say where it came from: of it, so many bytes are let in over the life of a connection,
beside a trickle.
"""

import logging
from collections.abc import Callable
from typing import Final

import zmq

from sern_runtime.inflow import LIMIT_BYTES, Inflow, Socket
from sern_runtime.monitor import ConnectionTable, TcpHandle

SUBSCRIBER_BYTES: Final = 2**20
"""Some thousand subscriptions, each a few hundred bytes."""
TOLD_BYTES: Final = 2048
"""Of messages from this size on it is always said which connection they came from: it takes a quarter of a
microsecond, and of smaller ones no loop takes enough between two looks to be mistaken for a message without end."""
_log = logging.getLogger(__name__)


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
    ) -> None:
        """`max_message_bytes`: of a publisher's frame; None for subscribers."""
        self.watching = False
        """Whether the socket is to say which connection each message came from (`came`)."""
        self._role = role
        self._on_endless = on_endless
        self._limit_bytes = SUBSCRIBER_BYTES if max_message_bytes is None else max_message_bytes + LIMIT_BYTES
        self._counts = max_message_bytes is not None
        self._taken: dict[int, int] = {}
        self._seen: dict[TcpHandle, tuple[int, int]] = {}  # messages seen, and what had been read then
        self.connections = ConnectionTable(raw, max_half_open_per_source=0, max_half_open=0, max_connections=0)
        self._inflow = Inflow(socket, self._connections, self._endless, limit_bytes=self._limit_bytes)

    def close(self) -> None:
        self._inflow.close()
        self.connections.close()

    def came(self, fd: int) -> None:
        self._taken[fd] = self._taken.get(fd, 0) + 1

    def _connections(self) -> list[tuple[TcpHandle, int]]:
        handles = self.connections.handles()
        if self._counts:
            self._taken = {handle.fd: self._taken.get(handle.fd, 0) for handle in handles}
            behind = [self._is_behind(handle) for handle in handles]
            self.watching = any(behind)
            self._seen = {handle: self._seen[handle] for handle in handles}
        return [(handle, self._taken.get(handle.fd, 0)) for handle in handles]

    def _is_behind(self, handle: TcpHandle) -> bool:
        read_bytes, taken = handle.read_bytes() or 0, self._taken[handle.fd]
        known = self._seen.get(handle)
        if known is None or known[0] != taken:
            known = self._seen[handle] = (taken, read_bytes)
        return read_bytes - known[1] > LIMIT_BYTES // 4

    def _endless(self, handle: TcpHandle) -> None:
        self._on_endless()
        _log.warning("connection of feed role %s from %s closed: a message without end", self._role, handle.peer[0])
