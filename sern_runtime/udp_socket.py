"""A UDP socket in the event loop that junk cannot keep busy: options, batches, a filter in the kernel, and a pause.

Anybody can send datagrams to an open port, so what is not for us must cost next to nothing. 20,000 junk datagrams a
second at a socket of this process, each 1200 bytes, spaced evenly (the dearest case: each one wakes the loop), cost of
one core (two-core virtual machine, Python 3.11, uvloop; user and system time of the process):

    how                                                         unknown id    known id, bad tag
    `recvfrom_into` one buffer, id looked up, until EAGAIN         9.0 %           8.3 %
    `recv_into`: no address made                                  10.9 %           7.5 %
    `recvmmsg` through ctypes, 64 at a time                        9.2 %           9.9 %
    the same three, and 1 ms of pause after a batch of junk   2.5/2.0/1.6 %   4.9/4.2/3.3 %
    a filter on the session ids in the kernel                      0.0 %           8.4 %
    kept: filter, `recvfrom_into`, pause                           0.0 %           4.9 %

The wake-ups are what costs, not the receives: hence the pause. `recvmmsg` saves little on top, and would need the
kernel's structures in ctypes. `python -m benchmarks.udp` measures the finished server with a real session beside the
junk (100 round trips a second): 0.4-0.5 % and 4.8-5.8 %; without filter and pause 8-16 % and 9-18 %.

The pause: after a batch with more junk than datagrams of ours, the socket is looked at every `PAUSE_S` instead of at
each arrival, until a look finds no junk. Under a flood ours wait up to that long; without one nothing changes.
"""

import asyncio
import errno
import logging
import socket as socketlib
import struct
from array import array
from collections.abc import Callable, Collection
from typing import Final

from sern_core.vocabulary.errors import ConfigError
from sern_runtime.seal import SEAL_BYTES, UDP_PAYLOAD_BYTES
from sern_runtime.zmq_socket import SendResult

Address = tuple[str, int] | tuple[str, int, int, int]
"""An address as the socket module gives it: (host, port), and for IPv6 flow and scope."""

BATCH: Final = 64
"""Datagrams taken in one callback, about 0.3 ms with what is done about them: others in the loop get their turn."""
PAUSE_S: Final = 0.001
RECEIVE_BUFFER_BYTES: Final = 4 * 2**20
"""Asked of the kernel, which grants up to net.core.rmem_max: what arrives while the loop is elsewhere. Queues here are
seen by the peer's estimator like any other; 20 ms of a busy loop at 1 Gbit/s fit."""
SEND_BUFFER_BYTES: Final = 256 * 1024
"""What may wait below us: bursts, not a queue. The pacing above keeps it empty."""

MAX_FILTER_IDS: Final = 500
"""Above it the filter is taken off: the kernel compares one id after the other (0.1 µs for 100), and the memory for
socket options is bounded (net.core.optmem_max)."""
_SO_ATTACH_FILTER: Final = 26
_SO_DETACH_FILTER: Final = 27
_SO_MEMINFO: Final = 55
_MEMINFO_DROPS: Final = 8
_IP_MTU_DISCOVER: Final = 10
_IPV6_MTU_DISCOVER: Final = 23
_PMTUDISC_PROBE: Final = 3
_UDP_HEADER_BYTES: Final = 8

# Classic BPF, linux/filter.h and bpf_common.h; offset 0 of a UDP socket's filter is the UDP header.
_INSTRUCTION: Final = struct.Struct("=HBBI")
_LOAD_LENGTH: Final = 0x80
_LOAD_WORD: Final = 0x20
_JUMP_EQUAL: Final = 0x15
_JUMP_GREATER: Final = 0x25
_RETURN: Final = 0x06

_log = logging.getLogger(__name__)


class DatagramSocket:
    """One bound or connected UDP socket in the running loop.

    `on_datagram(view, address) -> bool` gets each datagram as a view of a buffer that the next one overwrites, and
    answers whether it was one of ours; `after()` is called once a batch that had some. `on_error(errno)` is told what
    the kernel reports about what was sent before (ICMP), which is never fatal. `on_writable()` follows a FULL send.
    The caller closes it, once or more often; allowed inside the callbacks.
    """

    def __init__(
        self,
        socket: socketlib.socket,
        on_datagram: Callable[[memoryview, Address], bool],
        *,
        after: Callable[[], None],
        on_writable: Callable[[], None],
        on_error: Callable[[int], None],
    ) -> None:
        self.socket = socket
        self.datagrams = 0
        """Taken from the kernel, junk included."""
        self.junk = 0
        self.pauses = 0
        self.send_errors = 0
        """Datagrams that the kernel would not send: lost like any other."""
        self._on_datagram = on_datagram
        self._after = after
        self._on_writable = on_writable
        self.on_error = on_error
        self._buffer = bytearray(UDP_PAYLOAD_BYTES + 1)  # one more tells a datagram that is too long
        self._view = memoryview(self._buffer)
        self._loop = asyncio.get_running_loop()
        self._fd = socket.fileno()
        self._paused: asyncio.Handle | None = None
        self._blocked = False
        self._tos = -1  # of the datagram before
        self._tos_options = [(socketlib.IPPROTO_IP, socketlib.IP_TOS)]  # IPv4 through a socket of IPv6 has its own
        if socket.family == socketlib.AF_INET6:
            self._tos_options.append((socketlib.IPPROTO_IPV6, socketlib.IPV6_TCLASS))
        self._filtered = False
        self._closed = False
        self._loop.add_reader(self._fd, self._readable)

    @property
    def blocked(self) -> bool:
        """A send was FULL, and `on_writable` has not followed yet."""
        return self._blocked

    @property
    def port(self) -> int:
        return int(self.socket.getsockname()[1])

    @property
    def kernel_drops(self) -> int:
        """Datagrams that the kernel dropped at this socket: those the filter stopped, and those that found its buffer
        full. Counts modulo 2^32; 0 where the kernel does not tell."""
        try:
            words = self.socket.getsockopt(socketlib.SOL_SOCKET, _SO_MEMINFO, 64)
        except OSError:
            return 0
        return int(struct.unpack_from("=I", words, 4 * _MEMINFO_DROPS)[0]) if len(words) > 4 * _MEMINFO_DROPS else 0

    def send(self, datagram: bytes, address: Address | None, tos: int) -> SendResult:
        """Send to `address`, or to the peer of a connected socket, with `tos` as its IP byte (DSCP in the upper six
        bits). FULL: `on_writable` follows. Whatever else the kernel says is a datagram lost, which UDP allows: OK,
        counted, and told to `on_error`."""
        try:
            if tos != self._tos:
                for level, option in self._tos_options:
                    self.socket.setsockopt(level, option, tos)
                self._tos = tos
            if address is None:
                self.socket.send(datagram)
            else:
                self.socket.sendto(datagram, address)
        except (BlockingIOError, InterruptedError):
            if not self._blocked:
                self._blocked = True
                self._loop.add_writer(self._fd, self._writable)
            return SendResult.FULL
        except OSError as error:
            self.send_errors += 1
            self.on_error(error.errno or 0)
        return SendResult.OK

    def drain(self) -> None:
        """Take all that has arrived, now."""
        while self._take() == BATCH:
            pass

    def only(self, ids: Collection[int]) -> None:
        """Let the kernel drop whatever does not begin with one of these session ids or cannot be a datagram of ours.

        A kernel without such filters, or too many ids, leave the work to `on_datagram`, which must check anyway.
        """
        if len(ids) <= MAX_FILTER_IDS:
            program = _filter_program(ids)
            memory = array("B", program)
            pointer = struct.pack("@HP", len(program) // _INSTRUCTION.size, memory.buffer_info()[0])
            try:
                self.socket.setsockopt(socketlib.SOL_SOCKET, _SO_ATTACH_FILTER, pointer)
            except OSError as error:
                _log.info(
                    "no packet filter on UDP port %d (%s); unknown datagrams cost more", self.port, error.strerror
                )
            else:
                self._filtered = True
                return
        if self._filtered:
            self._filtered = False
            self.socket.setsockopt(socketlib.SOL_SOCKET, _SO_DETACH_FILTER, struct.pack("@i", 0))

    def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        if self._paused is not None:
            self._paused.cancel()
            self._paused = None
        self._loop.remove_reader(self._fd)
        self._loop.remove_writer(self._fd)
        self.socket.close()

    def _readable(self) -> None:
        junk = self.junk
        taken = self._take()
        if 2 * (self.junk - junk) > taken and not self._closed:
            self.pauses += 1
            self._loop.remove_reader(self._fd)
            self._look_later(taken)

    def _look(self) -> None:
        self._paused = None
        junk = self.junk
        flooded = False  # stays so when a handler raises: then the reader sees to the rest
        taken = 0
        try:
            taken = self._take()
            flooded = 2 * (self.junk - junk) > taken
        finally:
            if not self._closed:
                if flooded:
                    self._look_later(taken)
                else:
                    self._loop.add_reader(self._fd, self._readable)

    def _look_later(self, taken: int) -> None:
        """Look again after a pause. A full batch says that there is more: then only the others' turn is between."""
        if taken == BATCH:
            self._paused = self._loop.call_soon(self._look)
        else:
            self._paused = self._loop.call_later(PAUSE_S, self._look)

    def _take(self) -> int:
        """Up to a batch; returns how many were taken from the kernel."""
        receive = self.socket.recvfrom_into
        buffer = self._buffer
        view = self._view
        on_datagram = self._on_datagram
        taken = ours = 0
        try:
            while taken < BATCH and not self._closed:
                nbytes, address = receive(buffer)
                taken += 1
                if SEAL_BYTES < nbytes <= UDP_PAYLOAD_BYTES and on_datagram(view[:nbytes], address):
                    ours += 1
        except BlockingIOError:
            pass
        except OSError as error:  # of a datagram sent before; reading it took it off the socket
            if not self._closed:
                self.on_error(error.errno or 0)
        finally:
            self.datagrams += taken
            self.junk += taken - ours
        if ours and not self._closed:
            self._after()
        return taken

    def _writable(self) -> None:
        self._blocked = False
        self._loop.remove_writer(self._fd)
        self._on_writable()


def _filter_program(ids: Collection[int]) -> bytes:
    """Length first, then id by id: `return accept` stands behind each comparison, as jumps reach 255 instructions."""
    shortest, longest = _UDP_HEADER_BYTES + SEAL_BYTES + 1, _UDP_HEADER_BYTES + UDP_PAYLOAD_BYTES
    program = [
        (_LOAD_LENGTH, 0, 0, 0),
        (_JUMP_GREATER, 0, 1, longest),
        (_RETURN, 0, 0, 0),
        (_JUMP_GREATER, 1, 0, shortest - 1),
        (_RETURN, 0, 0, 0),
        (_LOAD_WORD, 0, 0, _UDP_HEADER_BYTES),
    ]
    for number in ids:
        program += [(_JUMP_EQUAL, 0, 1, number), (_RETURN, 0, 0, 0xFFFF)]
    program.append((_RETURN, 0, 0, 0))
    return b"".join(_INSTRUCTION.pack(*instruction) for instruction in program)


def bound_socket(endpoint: str) -> socketlib.socket:
    """A socket on `udp://address:port`; `*` is every address, or a free port. Raises ConfigError of one line.

    It takes datagrams wherever libzmq takes connections for the same address: at `[::]` and `*` of both families, with
    those of IPv4 as `::ffff:` addresses, and at `*` of IPv4 alone where the kernel has no IPv6.

    On a host with several addresses name the one that clients connect to: from a wildcard the kernel chooses the source
    of each answer by its routes, and a connected client takes datagrams of the address it knows only. The path is then
    never validated, and the ZMQ lane carries the data.
    """
    host, port = split_udp(endpoint)
    try:
        found = socketlib.getaddrinfo(
            "::" if host == "*" else host, port, type=socketlib.SOCK_DGRAM, flags=socketlib.AI_PASSIVE
        )
    except (OSError, UnicodeError):  # UnicodeError: no name that DNS could hold
        raise ConfigError(f"{endpoint}: cannot find the address; write one of this host's") from None
    family, _, _, _, address = found[0]
    try:
        try:
            return _bound(family, address)
        except OSError as error:
            if host != "*" or error.errno != errno.EAFNOSUPPORT:
                raise
            return _bound(socketlib.AF_INET, ("0.0.0.0", port))
    except OSError as error:
        raise ConfigError(f"cannot listen on {endpoint}: {(error.strerror or str(error)).lower()}") from error


def _bound(family: int, address: Address | tuple[int, bytes]) -> socketlib.socket:
    socket = socketlib.socket(family, socketlib.SOCK_DGRAM)
    try:
        if family == socketlib.AF_INET6:
            socket.setsockopt(socketlib.IPPROTO_IPV6, socketlib.IPV6_V6ONLY, 0)  # whatever bindv6only says
        prepare(socket)
        socket.bind(address)
    except OSError:
        socket.close()
        raise
    return socket


def connected_socket(family: int, address: Address) -> socketlib.socket:
    """Raises OSError when the kernel knows no way to `address`."""
    socket = socketlib.socket(family, socketlib.SOCK_DGRAM)
    try:
        prepare(socket)
        socket.connect(address)
    except OSError:
        socket.close()
        raise
    return socket


def prepare(socket: socketlib.socket) -> None:
    """Options of both sides.

    Don't Fragment is set, and what the kernel believes to know of the path's MTU is ignored (PMTUDISC_PROBE): a
    fragmented datagram is lost with any of its pieces, and believing ICMP would let anybody shrink the path. A path
    that cannot carry UDP_PAYLOAD_BYTES fails its validation, whose challenge is as long, and TCP carries the data.
    """
    socket.setblocking(False)
    socket.setsockopt(socketlib.SOL_SOCKET, socketlib.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
    socket.setsockopt(socketlib.SOL_SOCKET, socketlib.SO_SNDBUF, SEND_BUFFER_BYTES)
    socket.setsockopt(socketlib.IPPROTO_IP, _IP_MTU_DISCOVER, _PMTUDISC_PROBE)
    if socket.family == socketlib.AF_INET6:  # IPv4 may pass through it, too
        socket.setsockopt(socketlib.IPPROTO_IPV6, _IPV6_MTU_DISCOVER, _PMTUDISC_PROBE)


def split_udp(endpoint: str) -> tuple[str, int]:
    """Host and port of `udp://host:port`, brackets of IPv6 removed, `*` as 0. Raises ConfigError."""
    scheme, _, rest = endpoint.partition("://")
    host, _, digits = rest.rpartition(":")
    plain = host.removeprefix("[").removesuffix("]")
    number = 0 if digits == "*" else int(digits) if digits.isascii() and digits.isdigit() else -1
    if scheme != "udp" or not plain or not 0 <= number <= 0xFFFF or (":" in plain) != (host.startswith("[")):
        raise ConfigError(f"{endpoint} is not a UDP endpoint; write udp://address:port, udp://[address]:port")
    return plain, number


NO_WAY: Final = frozenset(
    {
        errno.ENETUNREACH,
        errno.EHOSTUNREACH,
        errno.ECONNREFUSED,
        errno.ENETDOWN,
        errno.EHOSTDOWN,
        errno.EADDRNOTAVAIL,
        errno.EINVAL,  # the address this socket was bound to by `connect` is no longer this host's
    }
)
"""What the kernel reports when another socket may find a way that this one does not."""
