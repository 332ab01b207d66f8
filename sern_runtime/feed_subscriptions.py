"""What the subscribers of one role of the feed want, connection by connection, and what all of it may come to.

libzmq keeps some hundred bytes for each byte that is subscribed to, for as long as the connection lasts. The XPUB tells
every subscription, with the connection it came over (`ZMQ_XPUB_VERBOSE`), and the end of a prefix when its last
subscriber is gone. So a connection counts with all that it ever subscribed to and that anybody subscribes to still.
"""

import logging
from collections import Counter
from typing import Final

from sern_runtime.feed_inflow import MAX_CONNECTIONS, SUBSCRIBER_BYTES
from sern_runtime.monitor import Connection, ConnectionTable

ENTRY_BYTES: Final = 16
"""What a subscription counts beside its prefix: short ones cost more than their bytes."""
KEPT_BYTES: Final = 2 * SUBSCRIBER_BYTES
"""Of one connection. In the long run it may bring more than `SUBSCRIBER_BYTES`, and keep so much of that."""
ROLE_BYTES: Final = 2**20
"""Of all connections of a role together: about 120 MB in libzmq's table."""

_log = logging.getLogger(__name__)


class Subscriptions:
    """The subscriptions of one role. A connection above `kept_bytes` is cut. Where all are above `role_bytes`, the
    newest connection is that has more than its share (`role_bytes` by the number of connections that a role may have);
    so what is within its share is never cut, whatever others do.
    """

    def __init__(
        self,
        role: str,
        connections: ConnectionTable,
        *,
        kept_bytes: int = KEPT_BYTES,
        role_bytes: int = ROLE_BYTES,
        max_connections: int = MAX_CONNECTIONS,
    ) -> None:
        self.crowded = 0
        """Connections that were cut."""
        self.total_bytes = 0
        self._role = role
        self._connections = connections
        self._kept_bytes = kept_bytes
        self._role_bytes = role_bytes
        self._share_bytes = role_bytes // max_connections
        self._prefixes: dict[bytes, set[int]] = {}  # with the connections that count with it, by fd
        self._lengths: Counter[int] = Counter()  # of the prefixes: few, so that none of them need be tried in turn
        self._by_fd: dict[int, set[bytes]] = {}
        self._bytes: Counter[int] = Counter()

    def __len__(self) -> int:
        return len(self._prefixes)

    @property
    def prefixes(self) -> tuple[bytes, ...]:
        """In order."""
        return tuple(sorted(self._prefixes))

    def match(self, frame: bytes) -> bool:
        """Whether anybody subscribes to a topic frame."""
        return any(frame[:length] in self._prefixes for length in self._lengths)

    def subscribed(self, prefix: bytes, fd: int | None) -> bool:
        """A subscription came over the connection `fd`; None: over one without a descriptor, which is not counted.
        Returns whether it is the first to this prefix."""
        users = self._prefixes.get(prefix)
        first = users is None
        if users is None:
            users = self._prefixes[prefix] = set()
            self._lengths[len(prefix)] += 1
        connection = None if fd is None else self._connections.current(fd)
        if fd is not None and connection is not None and connection.handle is not None and not connection.ended:
            if fd not in users:
                users.add(fd)
                self._by_fd.setdefault(fd, set()).add(prefix)
                self._count(fd, len(prefix) + ENTRY_BYTES)
            if self._bytes[fd] > self._kept_bytes:
                self._cut(fd, connection)
            elif self.total_bytes > self._role_bytes:
                self._cut_newest()
        return first

    def unsubscribed(self, prefix: bytes) -> bool:
        """The last subscriber of a prefix is gone. Returns whether there was one; a peer may say what it likes."""
        users = self._prefixes.pop(prefix, None)
        if users is None:
            return False
        self._lengths[len(prefix)] -= 1
        if not self._lengths[len(prefix)]:
            del self._lengths[len(prefix)]
        for fd in users:
            self._by_fd[fd].remove(prefix)
            self._count(fd, -len(prefix) - ENTRY_BYTES)
        return True

    def gone(self, fd: int) -> None:
        """A connection has ended: it counts no more. What only it subscribed to is told as unsubscribed."""
        for prefix in self._by_fd.pop(fd, ()):
            self._prefixes[prefix].remove(fd)
        self.total_bytes -= self._bytes.pop(fd, 0)

    def _count(self, fd: int, change_bytes: int) -> None:
        self._bytes[fd] += change_bytes
        self.total_bytes += change_bytes

    def _cut_newest(self) -> None:
        above = [
            (connection.number, fd, connection)
            for fd, kept_bytes in self._bytes.items()
            if kept_bytes > self._share_bytes and (connection := self._connections.by_fd(fd)) is not None
        ]
        _, fd, connection = max(above)
        self._cut(fd, connection)

    def _cut(self, fd: int, connection: Connection) -> None:
        self.crowded += 1
        _log.warning(
            "connection of feed role %s from %s closed: it subscribes to %d bytes (at most %d), all of the role to %d "
            "(at most %d)",
            self._role, connection.source, self._bytes[fd], self._kept_bytes, self.total_bytes, self._role_bytes,
        )  # fmt: skip
        connection.cut()
        self.gone(fd)
