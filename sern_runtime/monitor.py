"""What happens to connections: libzmq's socket monitor, and the TCP socket underneath.

libzmq owns its file descriptors and closes them when it likes, so a number from an event may be reused by the time
it is read. `TcpHandle` therefore keeps the number *and* the inode of the socket; each use duplicates the number,
compares the inode of the duplicate, acts on it and closes it. No duplicate is kept, as it would keep the connection
open after libzmq closed it.
"""

import errno
import fcntl
import logging
import os
import socket as socketlib
import stat
import struct
import sys
import termios
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import count
from typing import Final, NamedTuple

import zmq

from sern_runtime.addresses import plain_host
from sern_runtime.clock import now
from sern_runtime.open_files import open_reserve
from sern_runtime.zmq_setup import HANDSHAKE_IVL_MS
from sern_runtime.zmq_socket import FrameSocket

EventKind = zmq.Event
EVENTS: Final = int(
    EventKind.CONNECTED
    | EventKind.CONNECT_RETRIED
    | EventKind.ACCEPTED
    | EventKind.ACCEPT_FAILED
    | EventKind.CLOSED
    | EventKind.DISCONNECTED
    | EventKind.HANDSHAKE_SUCCEEDED
    | EventKind.HANDSHAKE_FAILED_AUTH
    | EventKind.HANDSHAKE_FAILED_PROTOCOL
    | EventKind.HANDSHAKE_FAILED_NO_DETAIL
)
TCP_RTO_MAX_MS: Final = 44
"""Linux 6.15 and later; not yet in the socket module."""
STREAM_CONGESTION: Final = "cubic"
"""BBR's PROBE_RTT shows as 160-260 ms spikes of class 0 every 10 s; the window above it keeps the queue short."""
PRIORITY_LANE_CONGESTION: Final = "bbr"
"""A loss takes from a thin stream what cubic lets it send, and the next pose waits; BBR leaves it 4 segments."""
SO_MAX_PACING_RATE: Final = 47
"""Linux; not yet in the socket module."""
PACING_BPS: Final = 10e9
"""No bound of its own: any value makes the kernel pace."""
HANDSHAKE_GRACE_S: Final = 3.0
"""A half-open connection keeps its place for this time, whatever comes: the four round trips of a handshake over 600 ms
fit into it."""
RTO_MAX_MS: Final = 1000
"""Bounds the kernel's backoff in a blackout: a fresh pose 0.65 s after 30 s without a link, instead of 7.1 s."""

_CRYPTOGRAPHIC: Final = 0x11000001  # ZMQ_PROTOCOL_ERROR_ZMTP_CRYPTOGRAPHIC
_log = logging.getLogger(__name__)
_monitor_numbers = count(1)
_EVENT: Final = struct.Struct("=HI")
_RECEIVED: Final = struct.Struct("=128xQ")  # struct tcp_info up to tcpi_bytes_received
_TCP_INFO: Final = struct.Struct("=8x24I2Q2Q6IQ")  # struct tcp_info up to tcpi_delivery_rate


class MonitorEvent(NamedTuple):
    """One event. `value` is the fd for CONNECTED, ACCEPTED, CLOSED and DISCONNECTED; the ZAP status for
    HANDSHAKE_FAILED_AUTH; an errno or libzmq's protocol error number for the other failures; 0 for
    HANDSHAKE_SUCCEEDED, which does not say whose."""

    kind: EventKind
    value: int
    endpoint: str


class SocketMonitor:
    """Reads a socket's monitor in the running loop. Close it before the socket. Attach it before connect or bind."""

    def __init__(
        self, socket: "zmq.Socket[bytes]", on_event: Callable[[MonitorEvent], None], *, events: int = EVENTS
    ) -> None:
        self._watched = socket
        self._on_event = on_event
        address = f"inproc://sern.monitor.{next(_monitor_numbers)}"
        socket.monitor(address, events)
        pair = socket.context.socket(zmq.PAIR)
        pair.setsockopt(zmq.RCVHWM, 0)  # libzmq drops events at the mark; the count of connections must stay right
        pair.connect(address)
        self._socket = FrameSocket(pair, self._on_frames)

    def close(self) -> None:
        """Idempotent. Events that were not read are lost."""
        if not self._watched.closed and not self._socket.closed:
            self._watched.disable_monitor()
        self._socket.close()

    def drain(self) -> None:
        """Deliver all that has arrived, now."""
        taken = -1
        while taken != self._socket.messages:  # one drain takes no more than a batch
            taken = self._socket.messages
            self._socket.drain()

    def wait(self, timeout_s: float) -> None:
        """Hold up the loop until an event has come, `timeout_s` at the most, and deliver all that there are."""
        self._socket.socket.poll(max(1, round(timeout_s * 1000)))
        self.drain()

    def _on_frames(self, frames: list[zmq.Frame]) -> None:
        if len(frames) != 2:
            return
        number, value = _EVENT.unpack(frames[0].bytes)
        self._on_event(MonitorEvent(EventKind(number), value, frames[1].bytes.decode("utf-8", "replace")))


@dataclass(frozen=True, slots=True)
class TcpInfo:
    """The part of Linux's struct tcp_info that SERN reads."""

    rtt_s: float
    rttvar_s: float
    min_rtt_s: float
    unacked_segments: int
    lost_segments: int
    retransmitted_segments: int  # since the connection began
    sent_segments: int  # data segments since the connection began
    congestion_window_segments: int
    unsent_bytes: int  # in the send buffer, not yet handed to the network
    delivery_rate_bps: int


def _duplicate(fd: int) -> int:
    """Another number for what is open as `fd`, of the reserve where there is none else: who is one too many could not
    be cut off otherwise. OSError where nothing is open."""
    try:
        return os.dup(fd)
    except OSError as error:
        if error.errno != errno.EMFILE or not open_reserve():
            raise
    return os.dup(fd)


@contextmanager
def _peek(fd: int) -> Iterator[tuple[int, socketlib.socket | None]]:
    """The inode of what `fd` is, and that socket through a duplicate that lives as long as the block; None where it is
    none. OSError where nothing is open."""
    duplicate = _duplicate(fd)
    try:
        status = os.fstat(duplicate)
        if not stat.S_ISSOCK(status.st_mode):
            yield status.st_ino, None
            return
        with socketlib.socket(fileno=_duplicate(duplicate)) as connection:
            yield status.st_ino, connection
    finally:
        os.close(duplicate)


class SocketHandle:
    """A connected socket that belongs to libzmq, over TCP or on this machine. Every method answers None or False once
    the connection is gone."""

    __slots__ = ("fd", "inode")

    def __init__(self, fd: int, inode: int) -> None:
        self.fd = fd
        self.inode = inode

    @classmethod
    def at_path(cls, fd: int, endpoint: str) -> "SocketHandle | None":
        """A handle on `fd`, or None when it is no connection that was accepted at this ipc endpoint (any more)."""
        path = os.fsencode(endpoint.removeprefix("ipc://"))
        try:
            with _peek(fd) as (inode, connection):
                if connection is None or connection.family != socketlib.AF_UNIX:
                    return None
                name = connection.getsockname()
        except OSError:
            return None
        bound = name if isinstance(name, bytes) else os.fsencode(name)
        return cls(fd, inode) if bound.replace(b"\0", b"@", 1) == path else None  # @: it has no file

    def cut(self) -> bool:
        """End the connection now, both ways; libzmq notices and cleans up. False when it is gone already."""
        with self._connection() as connection:
            if connection is None:
                return False
            with suppress(OSError):
                connection.shutdown(socketlib.SHUT_RDWR)
            return True

    @contextmanager
    def _connection(self) -> Iterator[socketlib.socket | None]:
        """The connection through a duplicate that lives as long as the block; None when it is gone."""
        try:
            duplicate = _duplicate(self.fd)
        except OSError:
            yield None
            return
        if os.fstat(duplicate).st_ino != self.inode:
            os.close(duplicate)
            yield None
            return
        with socketlib.socket(fileno=duplicate) as connection:
            yield connection


class TcpHandle(SocketHandle):
    """A TCP socket that belongs to libzmq."""

    __slots__ = ("local", "peer")

    def __init__(self, fd: int, inode: int, local: tuple[str, int], peer: tuple[str, int]) -> None:
        super().__init__(fd, inode)
        self.local = local
        self.peer = peer

    @classmethod
    def of(cls, fd: int, *, local_port: int | None = None, peer_port: int | None = None) -> "TcpHandle | None":
        """A handle on `fd`, or None when it is no connected TCP socket (any more), or is one with other ports.

        Give the port that is known (of the endpoint listened on, or connected to): the event may be late and the
        number reused meanwhile.
        """
        try:
            with _peek(fd) as (inode, connection):
                if connection is None or connection.family not in (socketlib.AF_INET, socketlib.AF_INET6):
                    return None
                local, peer = connection.getsockname()[:2], connection.getpeername()[:2]
        except OSError:
            return None
        if local_port not in (None, local[1]) or peer_port not in (None, peer[1]):
            return None
        return cls(fd, inode, (plain_host(local[0]), local[1]), (plain_host(peer[0]), peer[1]))

    def info(self) -> TcpInfo | None:
        """The kernel's view of the connection (TCP_INFO)."""
        with self._connection() as connection:
            if connection is None:
                return None
            raw = connection.getsockopt(socketlib.IPPROTO_TCP, socketlib.TCP_INFO, 256)
        return _parse_tcp_info(raw)

    def read_bytes(self) -> int | None:
        """How many bytes have been read from the connection since it began; None where the kernel does not say.

        Takes 3 µs: without a duplicate, and so of another connection if the number has been reused.
        """
        connection = None
        try:
            connection = socketlib.socket(socketlib.AF_INET, socketlib.SOCK_STREAM, 0, fileno=self.fd)
            raw = connection.getsockopt(socketlib.IPPROTO_TCP, socketlib.TCP_INFO, _RECEIVED.size)
            unread = fcntl.ioctl(self.fd, termios.FIONREAD, bytes(4))
        except OSError:
            return None
        finally:
            if connection is not None:
                connection.detach()  # the number is libzmq's to close
        if len(raw) < _RECEIVED.size:
            return None
        received: int = _RECEIVED.unpack(raw)[0]
        return received - int.from_bytes(unread, sys.byteorder)

    def kept(self) -> socketlib.socket | None:
        """A duplicate to close soon: it keeps the connection open when libzmq has closed it. None when it is gone."""
        with self._connection() as connection:
            if connection is None:
                return None
            return socketlib.socket(
                fileno=_duplicate(connection.fileno())
            )  # `dup()` would make libzmq's socket blocking

    def congestion(self) -> str | None:
        """The name of the congestion control, for example `cubic`."""
        with self._connection() as connection:
            if connection is None:
                return None
            raw = connection.getsockopt(socketlib.IPPROTO_TCP, socketlib.TCP_CONGESTION, 16)
        return raw.rstrip(b"\0").decode("ascii", "replace")

    def prepare(self, *, priority_lane: bool, tos: int) -> None:
        """What a connection of a lane needs, with `tos` as its IP byte (DSCP in the upper six bits); what the kernel
        does not have or allow is left as it is."""
        self.set_congestion(PRIORITY_LANE_CONGESTION if priority_lane else STREAM_CONGESTION)
        self.set_rto_max()
        self.set_pacing()
        self._set(socketlib.IP_TOS, tos, level=socketlib.IPPROTO_IP)
        self._set(socketlib.IPV6_TCLASS, tos, level=socketlib.IPPROTO_IPV6)

    def set_congestion(self, name: str) -> bool:
        """Choose the congestion control. False when the kernel does not have it or does not allow it."""
        return self._set(socketlib.TCP_CONGESTION, name.encode())

    def set_user_timeout(self, timeout_s: float) -> bool:
        """Give the connection up when data stays unacknowledged this long (RFC 5482)."""
        return self._set(socketlib.TCP_USER_TIMEOUT, round(timeout_s * 1000))

    def set_rto_max(self, rto_max_ms: int = RTO_MAX_MS) -> bool:
        """Bound the retransmission timeout. False on kernels before 6.15, which is no error."""
        return self._set(TCP_RTO_MAX_MS, rto_max_ms)

    def set_pacing(self, rate_bps: float = PACING_BPS) -> bool:
        """Have the kernel space out what it sends, as its congestion window would in a round trip, and at most at
        `rate_bps`. Without it a window that a loss held back leaves as one burst, and fills the path's queue."""
        return self._set(SO_MAX_PACING_RATE, int(rate_bps / 8), level=socketlib.SOL_SOCKET)

    def _set(self, option: int, value: int | bytes, *, level: int = socketlib.IPPROTO_TCP) -> bool:
        with self._connection() as connection:
            if connection is None:
                return False
            try:
                connection.setsockopt(level, option, value)
            except OSError as error:
                if error.errno not in (errno.ENOPROTOOPT, errno.ENOENT, errno.EPERM, errno.EINVAL):
                    raise
                return False
            return True


def _parse_tcp_info(raw: bytes) -> TcpInfo:
    """Fields by position in struct tcp_info (linux/tcp.h); kernels that know fewer give zeros."""
    fields = _TCP_INFO.unpack_from(raw.ljust(_TCP_INFO.size, b"\0"))
    return TcpInfo(
        rtt_s=fields[15] / 1e6,
        rttvar_s=fields[16] / 1e6,
        min_rtt_s=fields[31] / 1e6,
        unacked_segments=fields[4],
        lost_segments=fields[6],
        retransmitted_segments=fields[23],
        sent_segments=fields[33],
        congestion_window_segments=fields[18],
        unsent_bytes=fields[30],
        delivery_rate_bps=fields[34] * 8,
    )


def received_bytes(connection: socketlib.socket) -> int | None:
    """How many bytes have arrived over a TCP connection, the peer's end of it counting as one; None where the kernel
    does not say."""
    raw = connection.getsockopt(socketlib.IPPROTO_TCP, socketlib.TCP_INFO, _RECEIVED.size)
    if len(raw) < _RECEIVED.size:
        return None
    received: int = _RECEIVED.unpack(raw)[0]
    return received


def port_of(endpoint: str) -> int | None:
    """The port of a tcp endpoint, None for others."""
    if endpoint.startswith("tcp://"):
        with suppress(ValueError):
            return int(endpoint.rpartition(":")[2])
    return None


@dataclass(slots=True)
class Connection:
    """One accepted connection. `handle` over TCP, `local` over ipc. `user` is empty until `ConnectionTable.bind_user`;
    `ended`: it was cut, and may still be listed, and heard, until libzmq has noticed."""

    handle: TcpHandle | None
    source: str
    accepted_s: float
    user: str = ""
    ended: bool = False
    number: int = 0
    """Rises with every connection of the table."""
    local: SocketHandle | None = None

    def cut(self) -> bool:
        """End it now. False when it is gone already, or was cut before."""
        if self.ended:
            return False
        self.ended = True
        handle = self.handle or self.local
        return handle is not None and handle.cut()


class ConnectionTable:
    """The accepted connections of a server socket, by fd: caps, and cutting a user off.

    Half-open connections are capped by source address and in all, connections in all too; what comes above a cap is
    cut at once and counted in `capped`. Above a cap of half-open ones the oldest gives way instead if it is older than
    HANDSHAKE_GRACE_S: whoever gets a place has the time for a handshake, and each place is free again after that time.
    A cap of 0 means none. libzmq does not say which connection finished its
    handshake, but it ends those that did not after HANDSHAKE_IVL: so a connection is half-open until `bind_user`,
    or until it is older than that.
    """

    def __init__(
        self,
        socket: "zmq.Socket[bytes]",
        *,
        max_half_open_per_source: int = 32,
        max_half_open: int = 256,
        max_connections: int = 1024,
        on_change: Callable[[], None] | None = None,
        on_gone: Callable[[int], None] | None = None,
        on_capped: Callable[[str], None] | None = None,
        clock: Callable[[], float] = now,
    ) -> None:
        """`on_gone(fd)`: a connection has ended, and its number may be another's next. `on_capped(source)`: one was cut
        for a cap."""
        self.unbound = False
        """Whether libzmq has let go of an address that the socket listened on."""
        self.capped = 0
        self.accepted = 0
        self.accept_failed = 0
        self.handshake_failed = 0
        self.forged = 0
        """Those of them in which what was sealed did not open: for another server's key, or made up."""
        self.max_half_open_per_source = max_half_open_per_source
        self.max_half_open = max_half_open
        self.max_connections = max_connections
        self._connections: dict[int, Connection] = {}
        self._half_open_until_s: dict[int, float] = {}  # by fd, oldest first
        self._half_open_by_source: Counter[str] = Counter()
        self._on_change = on_change
        self._on_gone = on_gone
        self._on_capped = on_capped
        self._clock = clock
        self._monitor = SocketMonitor(socket, self._on_event)

    def close(self) -> None:
        """Close this before the socket. Idempotent."""
        self._monitor.close()

    def await_unbound(self, until_s: float) -> bool:
        """Wait after `unbind` until libzmq has let go of the address, or until `until_s` on `sern_runtime.clock`.

        False: not by then. It does so on its own thread, within some milliseconds; the loop is held up meanwhile.
        """
        left_s = until_s - now()
        while not self.unbound:
            self._monitor.wait(max(0.0, left_s))  # also where the time is over: what is said by now counts
            if left_s <= 0.0:
                break
            left_s = until_s - now()
        return self.unbound

    def __len__(self) -> int:
        return len(self._connections)

    @property
    def half_open(self) -> int:
        self._expire()
        return len(self._half_open_until_s)

    def by_fd(self, fd: int) -> Connection | None:
        return self._connections.get(fd)

    def items(self) -> list[tuple[int, Connection]]:
        """Those that are open, with their fd."""
        return list(self._connections.items())

    def take_in(self) -> None:
        """Take in all that has happened to connections until now, so that `by_fd` knows whose a frame is that has just
        been read."""
        self._monitor.drain()

    def bind_user(self, fd: int, user: str) -> None:
        """Remember whose connection this is; `fd` and `user` from a frame that came over it."""
        connection = self._connections.get(fd)
        if connection is None:  # the frame overtook its event
            self._monitor.drain()
            connection = self._connections.get(fd)
        if connection is not None:
            connection.user = user
            self._not_half_open(fd, connection)

    def ended(self, fd: int) -> bool:
        """Whether the connection that a frame has come over was cut, or is gone already: what had arrived is read all
        the same. libzmq tells that a connection was accepted before its first message."""
        connection = self._connections.get(fd)
        if connection is None or connection.ended:  # its event may wait, or the number be another's by now
            self._monitor.drain()
            connection = self._connections.get(fd)
        return connection is None or connection.ended

    def handles(self) -> list[TcpHandle]:
        return [c.handle for c in self._connections.values() if c.handle is not None]

    def cut(self, fd: int) -> None:
        """End one connection; `fd` from a frame that came over it."""
        connection = self._connections.get(fd)
        if connection is None:  # the frame overtook its event
            self._monitor.drain()
            connection = self._connections.get(fd)
        if connection is not None:
            connection.cut()

    def handles_of(self, user: str) -> list[TcpHandle]:
        return [c.handle for c in self._connections.values() if c.user == user and c.handle is not None]

    def cut_user(self, user: str) -> int:
        """End every connection of a user; returns how many. Those count whose handshake is over, whether or not their
        event has been read."""
        self._monitor.drain()
        return sum(connection.cut() for connection in self._connections.values() if connection.user == user)

    def cut_silent(self, after_s: float) -> int:
        """End every connection that has no user `after_s` after it was accepted; returns how many."""
        until_s = self._clock() - after_s
        return sum(c.cut() for c in self._connections.values() if not c.user and c.accepted_s <= until_s)

    def _on_event(self, event: MonitorEvent) -> None:
        match event.kind:
            case EventKind.ACCEPTED:
                self._accepted(event)
            case EventKind.DISCONNECTED:
                self._gone(event.value)
            case EventKind.CLOSED:
                self.unbound = True
                self._gone(event.value)
            case EventKind.ACCEPT_FAILED:
                self.accept_failed += 1
                if event.value != errno.EMFILE or not open_reserve():
                    _log.warning("a connection could not be accepted: %s", os.strerror(event.value))
            case EventKind.HANDSHAKE_SUCCEEDED:
                pass
            case _:
                self.handshake_failed += 1
                self.forged += event.value == _CRYPTOGRAPHIC
        if self._on_change is not None:
            self._on_change()

    def _accepted(self, event: MonitorEvent) -> None:
        fd = event.value
        self._gone(fd)  # a number in use again means that its connection ended, whatever we were told
        self.accepted += 1
        handle = TcpHandle.of(fd, local_port=port_of(event.endpoint))
        source = handle.peer[0] if handle is not None else ""
        local = SocketHandle.at_path(fd, event.endpoint) if handle is None else None
        connection = Connection(handle, source, self._clock(), number=self.accepted, local=local)
        self._connections[fd] = connection
        self._expire()
        self._half_open_until_s[fd] = self._clock() + HANDSHAKE_IVL_MS / 1000
        self._half_open_by_source[source] += 1
        if handle is None:
            return
        if self.max_connections and len(self._connections) > self.max_connections:
            self._cap(fd, connection)
            return
        if self.max_half_open_per_source and self._half_open_by_source[source] > self.max_half_open_per_source:
            self._give_way(fd, source)
        elif self.max_half_open and len(self._half_open_until_s) > self.max_half_open:
            self._give_way(fd, None)

    def _give_way(self, newest_fd: int, source: str | None) -> None:
        """Cut the oldest half-open connection, of one source or of all, if it had its time, else the newest."""
        until_s = self._clock() - HANDSHAKE_GRACE_S
        for fd in self._half_open_until_s:  # oldest first
            connection = self._connections[fd]
            if connection.accepted_s > until_s:
                break
            if connection.handle is not None and source in (None, connection.source):
                self._cap(fd, connection)
                return
        self._cap(newest_fd, self._connections[newest_fd])

    def _cap(self, fd: int, connection: Connection) -> None:
        """It is no longer half-open from now on, and not only when libzmq has noticed: whoever comes again and again,
        faster than that, must not take the places of others with what was cut."""
        self.capped += 1
        connection.cut()
        self._not_half_open(fd, connection)
        if self._on_capped is not None:
            self._on_capped(connection.source)

    def _expire(self) -> None:
        now_s = self._clock()
        while self._half_open_until_s:
            fd, until_s = next(iter(self._half_open_until_s.items()))
            if until_s > now_s:
                break
            self._not_half_open(fd, self._connections[fd])

    def _gone(self, fd: int) -> None:
        connection = self._connections.pop(fd, None)
        if connection is not None:
            self._not_half_open(fd, connection)
            if self._on_gone is not None:
                self._on_gone(fd)

    def _not_half_open(self, fd: int, connection: Connection) -> None:
        if self._half_open_until_s.pop(fd, None) is not None:
            self._half_open_by_source[connection.source] -= 1
            if not self._half_open_by_source[connection.source]:
                del self._half_open_by_source[connection.source]
