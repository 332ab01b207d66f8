"""What the subscribers of one role of the feed want, connection by connection, and what all of it may come to.

libzmq keeps some hundred bytes for each byte that is subscribed to, for as long as the connection lasts. The XPUB tells
every subscription and unsubscription, with the connection it came over (`ZMQ_XPUB_VERBOSER`). So each connection counts
with exactly what it subscribes to, and a prefix lasts as long as somebody subscribes to it.

The end of a connection comes from libzmq's monitor. What libzmq unsubscribes then by itself names no connection, and is
passed over. libzmq, with its one I/O thread, tells that a connection was accepted before its first message, and that it
has ended before its number is another's. So a connection that is not listed when its message is read has ended, or
been cut. Where its number is another's by then, the message counts for that one, and at most until that one ends.

Peers that speak an older protocol than ZMTP 3.0 have no name in their messages. They count together, as one that may be
any connection of which nothing was heard yet: what they subscribe to lasts until there is no such connection.
"""

import logging
from collections import Counter
from typing import Final

from sern_runtime.feed_inflow import MAX_CONNECTIONS, SUBSCRIBER_BYTES
from sern_runtime.monitor import Connection, ConnectionTable

ENTRY_BYTES: Final = 16
"""What a subscription counts beside its prefix: short ones cost more than their bytes."""
KEPT_BYTES: Final = 2 * SUBSCRIBER_BYTES
"""What one connection may keep. In the long run it may bring more than `SUBSCRIBER_BYTES`."""
ROLE_BYTES: Final = 2**20
"""What all connections of a role may keep together: about 120 MB in libzmq's table."""

_NAMELESS: Final = -1
"""Stands for all connections without a name, where others have their fd."""

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
        self._prefixes: dict[bytes, set[int]] = {}  # with the connections that subscribe to it, by fd
        self._lengths: Counter[int] = Counter()  # of the prefixes: few, so that none of them need be tried in turn
        self._by_fd: dict[int, set[bytes]] = {}
        self._bytes: Counter[int] = Counter()
        self._named: set[int] = set()  # connections that a message has named
        self._nameless_bytes = 0

    def __len__(self) -> int:
        return len(self._prefixes)

    @property
    def prefixes(self) -> tuple[bytes, ...]:
        """What is subscribed to, in order."""
        return tuple(sorted(self._prefixes))

    def match(self, frame: bytes) -> bool:
        """Whether anybody subscribes to a topic frame."""
        return any(frame[:length] in self._prefixes for length in self._lengths)

    def subscribed(self, prefix: bytes, fd: int | None) -> bool:
        """A subscription came over the connection `fd`; None: over one without a name. Returns whether `prefixes` may
        have changed."""
        self._connections.take_in()  # first of all: it may tell `gone`
        if fd is None:
            return self._subscribed_nameless(prefix)
        connection = self._connections.by_fd(fd)
        if connection is None or connection.ended:
            return False
        changed = False
        if fd not in self._named:
            self._named.add(fd)
            changed = self._end_nameless()
        known = self._by_fd.setdefault(fd, set())
        if prefix in known:
            return changed
        changed = self._add(prefix, fd) or changed
        if connection.handle is None:  # not over TCP: nothing here could cut it
            return changed
        self._count(fd, len(prefix) + ENTRY_BYTES)
        if self._bytes[fd] > self._kept_bytes:
            return self._cut(fd, connection) or changed
        if self.total_bytes > self._role_bytes:
            return self._cut_newest() or changed
        return changed

    def unsubscribed(self, prefix: bytes, fd: int | None) -> bool:
        """The connection `fd` unsubscribes; a peer may say what it likes. None: one without a name, or libzmq for one
        that has ended. Returns whether nobody is left who subscribes to the prefix."""
        if fd is None or prefix not in self._by_fd.get(fd, ()):
            return False
        self._by_fd[fd].remove(prefix)
        if fd in self._bytes:
            self._count(fd, -len(prefix) - ENTRY_BYTES)
        return self._remove(prefix, fd)

    def gone(self, fd: int) -> bool:
        """A connection has ended, and with it what it subscribed to. Returns whether `prefixes` has changed."""
        self._named.discard(fd)
        changed = self._drop(fd)
        return self._end_nameless() or changed

    def _add(self, prefix: bytes, fd: int) -> bool:
        """Returns whether it is the first to this prefix."""
        self._by_fd[fd].add(prefix)
        users = self._prefixes.get(prefix)
        if users is not None:
            users.add(fd)
            return False
        self._prefixes[prefix] = {fd}
        self._lengths[len(prefix)] += 1
        return True

    def _remove(self, prefix: bytes, fd: int) -> bool:
        """Returns whether it was the last."""
        users = self._prefixes[prefix]
        users.remove(fd)
        if users:
            return False
        del self._prefixes[prefix]
        self._lengths[len(prefix)] -= 1
        if not self._lengths[len(prefix)]:
            del self._lengths[len(prefix)]
        return True

    def _drop(self, fd: int) -> bool:
        """Returns whether it was the last for some prefix."""
        self.total_bytes -= self._bytes.pop(fd, 0)
        last = [self._remove(prefix, fd) for prefix in self._by_fd.pop(fd, ())]
        return any(last)

    def _subscribed_nameless(self, prefix: bytes) -> bool:
        if len(self._connections) == len(self._named):
            return False  # whoever sent it has ended
        known = self._by_fd.setdefault(_NAMELESS, set())
        if prefix in known:
            return False
        changed = self._add(prefix, _NAMELESS)
        self._nameless_bytes += len(prefix) + ENTRY_BYTES
        if self._nameless_bytes > self._kept_bytes:
            suspects = [each for fd, each in self._connections.items() if fd not in self._named]
            count = sum(each.cut() for each in suspects)
            if count:
                self.crowded += count
                _log.warning(
                    "%d connections of feed role %s closed: those without ZMTP 3.0 subscribe to %d bytes (at most %d)",
                    count, self._role, self._nameless_bytes, self._kept_bytes,
                )  # fmt: skip
                return self._drop_nameless() or changed
        return changed

    def _end_nameless(self) -> bool:
        """Forget what those without a name subscribe to, where there is nobody who could be one."""
        return len(self._connections) == len(self._named) and self._drop_nameless()

    def _drop_nameless(self) -> bool:
        self._nameless_bytes = 0
        return self._drop(_NAMELESS)

    def _count(self, fd: int, change_bytes: int) -> None:
        self._bytes[fd] += change_bytes
        self.total_bytes += change_bytes

    def _cut_newest(self) -> bool:
        above = [
            (connection.number, fd, connection)
            for fd, kept_bytes in self._bytes.items()
            if kept_bytes > self._share_bytes and (connection := self._connections.by_fd(fd)) is not None
        ]
        _, fd, connection = max(above)
        return self._cut(fd, connection)

    def _cut(self, fd: int, connection: Connection) -> bool:
        """Returns whether `prefixes` has changed."""
        self.crowded += 1
        _log.warning(
            "connection of feed role %s from %s closed: it subscribes to %d bytes (at most %d), all of the role to %d "
            "(at most %d)",
            self._role, connection.source, self._bytes[fd], self._kept_bytes, self.total_bytes, self._role_bytes,
        )  # fmt: skip
        connection.cut()
        return self._drop(fd)
