"""The UDP lane at the client: a connected socket to the relay that is made anew when the way changes.

What is sent, and how the relay follows, is told in sern_runtime.udp.
"""

import asyncio
import ipaddress
import os
import socket as socketlib
from collections.abc import Callable, Sequence
from functools import partial
from typing import Final

from sern_core.vocabulary.errors import UsageError
from sern_runtime import clock
from sern_runtime.seal import RekeyError, SessionParameters, Side
from sern_runtime.udp import (
    INNER_BYTES,
    PATH_TIMEOUT_S,
    TOKEN_BYTES,
    TYPE_CHALLENGE,
    TYPE_DATA,
    TYPE_RESPONSE,
    Sealed,
    ignore,
)
from sern_runtime.udp_socket import NO_WAY, Address, DatagramSocket, connected_socket
from sern_runtime.zmq_socket import SendResult

PROBE_MIN_S: Final = 0.25
PROBE_MAX_S: Final = 4.0
"""The client's challenges back off: where UDP does not get through, they cost 2.4 kbit/s."""
REBIND_MIN_S: Final = 1.0
REBIND_MAX_S: Final = 8.0
"""The kernel may report the same error for each datagram: a new socket after a pause that doubles."""
LINGER_S: Final = 1.0
"""How long the client still listens on the socket it left: what was under way to it arrives."""


class UdpClient(Sealed):
    """The client's end: a connected socket to `host` (a name or an address) and `port`, made anew when the way changes.

    `on_datagram(data, now)`, `after()` and `on_writable()` as at the relay. `on_path(address, validated)`: a socket to
    `address` was made, and later: the relay answered there. While no socket can be made (no network, no such name)
    sends are FULL and it is tried again every second. `host` is looked up again at each rebind. Sends do not wait for
    the validation: choose this lane after it.
    """

    def __init__(
        self,
        host: str,
        port: int,
        parameters: SessionParameters,
        on_datagram: Callable[[bytes, float], None],
        *,
        on_path: Callable[[Address, bool], None] = ignore,
        on_writable: Callable[[], None] = ignore,
        after: Callable[[], None] = ignore,
        tos: int = 0,
    ) -> None:
        super().__init__(parameters, Side.CLIENT)
        self.on_datagram = on_datagram
        self.on_path = on_path
        self.on_writable = on_writable
        self.address: Address | None = None
        """The relay's, of the socket in use."""
        self.rebinds = 0
        self.problem = ""
        """Why there is no socket, or what the network said of this one; empty once the relay answered."""
        self.closed = False
        self._host = host
        self._port = port
        self._after = after
        self._tos = tos & 0xFC  # the lower two bits are ECN's
        self._loop = asyncio.get_running_loop()
        self._socket: DatagramSocket | None = None
        self._old: DatagramSocket | None = None
        self._old_ends: asyncio.TimerHandle | None = None
        self._lookup: asyncio.Task[None] | None = None
        self._again: asyncio.Handle | None = None
        self._probe: asyncio.TimerHandle | None = None
        self._probe_delay_s = PROBE_MIN_S
        self._rebind_delay_s = REBIND_MIN_S
        self._opened_s = 0.0
        self._token = b""
        self._turn = 0  # which of the host's addresses
        self._several = False
        self._waiting = False
        self._again = self._loop.call_soon(self._renew)  # not now: the callbacks may want to know this object

    @property
    def socket(self) -> DatagramSocket | None:
        return self._socket

    def ready(self) -> bool:
        """Whether a datagram would be sent now. False: `on_writable` follows when that changes."""
        ready = self._socket is not None and not self._socket.blocked
        self._waiting |= not ready
        return ready

    def send(self, data: bytes, tos: int | None = None) -> SendResult:
        """Send `data`, at most INNER_BYTES, sealed, with the IP byte `tos` (default: the client's). FULL: `on_writable`
        follows. GONE: closed, or the key used up."""
        if len(data) > INNER_BYTES:
            raise UsageError(f"{len(data)} bytes do not fit the UDP lane: at most {INNER_BYTES}")
        if self.closed:
            return SendResult.GONE
        return self._put(TYPE_DATA, data, tos)

    def rebind(self) -> None:
        """Take another socket, as the network may have changed: another local port and address, the same session.

        When the relay never answered at the present address of `host`, the next of its addresses is tried.
        """
        self._probe_delay_s = PROBE_MIN_S
        self._rebind_delay_s = REBIND_MIN_S
        self._renew()

    def _renew(self) -> None:
        if self.closed or self._lookup is not None:
            return
        if self._again is not None:
            self._again.cancel()
            self._again = None
        if self._socket is not None and not self.validated:
            self._turn += 1
        if _numeric(self._host):
            flags = socketlib.AI_NUMERICHOST  # never asks a name server, so it may be called here
            self._open(socketlib.getaddrinfo(self._host, self._port, type=socketlib.SOCK_DGRAM, flags=flags))
        else:
            self._lookup = self._loop.create_task(self._look_up())

    def close(self) -> None:
        """Idempotent; allowed in callbacks."""
        self.closed = True
        self.validated = False
        for handle in (self._again, self._probe, self._old_ends, self._lookup):
            if handle is not None:
                handle.cancel()
        self._again = self._probe = self._old_ends = self._lookup = None
        for socket in (self._socket, self._old):
            if socket is not None:
                socket.close()
        self._socket = self._old = None

    def _put(self, kind: bytes, payload: bytes, tos: int | None = None) -> SendResult:
        socket = self._socket
        if socket is None:
            self._waiting = True
            return SendResult.FULL
        try:
            datagram = self.sealer.seal(kind + payload)
        except RekeyError:
            return SendResult.GONE
        result = socket.send(datagram, None, self._tos if tos is None else tos)
        if result is SendResult.FULL:
            self._waiting = True
        return result

    async def _look_up(self) -> None:
        try:
            found = await self._loop.getaddrinfo(self._host, self._port, type=socketlib.SOCK_DGRAM)
        except (OSError, UnicodeError) as error:  # UnicodeError: no name that DNS could hold
            self._lookup = None
            self._later(f"cannot find {self._host}: {getattr(error, 'strerror', None) or 'not a host name'}")
        else:
            self._lookup = None
            self._open(found)

    def _open(self, found: Sequence[tuple[int, int, int, str, Address | tuple[int, bytes]]]) -> None:
        problem = f"{self._host} has no address"
        for index in range(len(found)):
            family, _, _, _, address = found[(self._turn + index) % len(found)]
            if isinstance(address[0], int):
                continue  # a kernel without IPv6 describes such addresses otherwise
            try:
                raw = connected_socket(family, address)
            except OSError as error:
                problem = f"no way to {address[0]}: {(error.strerror or str(error)).lower()}"
            else:
                self._turn = (self._turn + index) % len(found)
                self._adopt(raw, address, several=len(found) > 1)
                return
        self._later(problem)

    def _adopt(self, raw: socketlib.socket, address: Address, *, several: bool) -> None:
        socket = DatagramSocket(
            raw, self._received, after=self._after, on_writable=self._writable, on_error=lambda number: None
        )
        socket.on_error = partial(self._failed, socket)
        socket.only((self.parameters.id,))
        self._leave()
        self.rebinds += self.address is not None
        self._socket = socket
        self.address = address
        self.validated = False
        self._opened_s = clock.now()
        self._several = several
        self._token = os.urandom(TOKEN_BYTES)
        self._challenge()
        self.on_path(address, False)
        if not self.closed:
            self._writable()

    def _leave(self) -> None:
        """The socket in use becomes the old one, which still takes what is under way to it."""
        self._end_old()
        self._old, self._socket = self._socket, None
        if self._old is not None:
            self._old_ends = self._loop.call_later(LINGER_S, self._end_old)

    def _end_old(self) -> None:
        if self._old_ends is not None:
            self._old_ends.cancel()
            self._old_ends = None
        if self._old is not None:
            old, self._old = self._old, None
            old.drain()
            old.close()

    def _received(self, view: memoryview, _address: Address) -> bool:
        inner = self.opener.open(view)
        if inner is None:
            return False
        kind = inner[:1]
        if kind == TYPE_DATA:
            self.on_datagram(inner[1:], clock.now())
        elif kind == TYPE_CHALLENGE:
            if len(inner) > TOKEN_BYTES and not self.closed:
                self._put(TYPE_RESPONSE, inner[1:])
        elif kind == TYPE_RESPONSE and not self.validated and self._token == inner[1 : 1 + TOKEN_BYTES]:
            self._validated()
        return True

    def _validated(self) -> None:
        self.validated = True
        self.problem = ""
        self._token = b""
        self._probe_delay_s = PROBE_MIN_S
        self._rebind_delay_s = REBIND_MIN_S
        if self._probe is not None:
            self._probe.cancel()
            self._probe = None
        if self.address is not None:
            self.on_path(self.address, True)

    def _challenge(self) -> None:
        """Ask until the relay answers. The full size: the path must carry it, and the relay may answer as much."""
        if self._probe is not None:
            self._probe.cancel()
        self._probe = self._loop.call_later(self._probe_delay_s, self._challenge_again)
        self._put(TYPE_CHALLENGE, self._token.ljust(INNER_BYTES, b"\0"))

    def _challenge_again(self) -> None:
        self._probe = None
        if self._several and clock.now() - self._opened_s > PATH_TIMEOUT_S:
            self._renew()  # the host has another address
        else:
            self._probe_delay_s = min(2 * self._probe_delay_s, PROBE_MAX_S)
            self._challenge()

    def _failed(self, socket: DatagramSocket, number: int) -> None:
        """The kernel reports an error of `socket`. Soon, not now: the caller is in the middle of sending or reading."""
        if socket is not self._socket or number not in NO_WAY:
            return
        self._later(f"the network says: {os.strerror(number).lower()}")

    def _later(self, problem: str) -> None:
        """The socket in use, if any, is not good: make another one after a pause."""
        self.problem = problem
        if not self.closed and self._again is None and self._lookup is None:
            self._again = self._loop.call_later(self._rebind_delay_s, self._renew)
            self._rebind_delay_s = min(2 * self._rebind_delay_s, REBIND_MAX_S)

    def _writable(self) -> None:
        if self._waiting and self.ready():
            self._waiting = False
            self.on_writable()


def _numeric(host: str) -> bool:
    try:
        ipaddress.ip_address(host.partition("%")[0])
    except ValueError:
        return False
    return True
