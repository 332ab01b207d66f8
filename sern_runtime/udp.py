"""The UDP lane at the relay: one socket for all clients, sealed datagrams, peers that move. The other end: udp_client.

What is sealed (sern_runtime.seal) begins with one byte, its inner type:

   0 DATA       a datagram of the core, at most `INNER_BYTES`
   1 CHALLENGE  8 random bytes, then zeros: answer with the same bytes. Padded to the full size where allowed
   2 RESPONSE   the payload of a CHALLENGE, unchanged

Other types are ignored. Where the peer is: the relay follows an authenticated datagram with the newest counter to
whatever address it came from, so that a client behind a NAT, or one that changes networks, is not lost. But a
datagram can be copied and sent from elsewhere: a new address is challenged, and until the response it gets at most
three times the bytes that came from it (RFC 9000, 8.1); senders are told FULL. An address that does not answer within
`PATH_TIMEOUT_S` is given up for the last one that did (RFC 9000, 9.3.2), and a newer datagram from the latter brings
the relay back at once. The client challenges the relay after every (re)bind, which tells it whether the path is there
and carries datagrams of full size.

Sending is never a delivery receipt; errors of the network are losses, which the core makes good.
"""

import asyncio
import os
import secrets
import struct
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Final

from sern_core.vocabulary.errors import UsageError
from sern_core.vocabulary.types import ClientName
from sern_runtime import clock
from sern_runtime.seal import (
    ROOM_BYTES,
    SEAL_BYTES,
    UDP_PAYLOAD_BYTES,
    Cipher,
    RekeyError,
    SessionParameters,
    Side,
    choose_cipher,
    make_seals,
)
from sern_runtime.udp_socket import Address, DatagramSocket, bound_socket
from sern_runtime.zmq_socket import SendResult

TYPE_DATA: Final = b"\x00"
TYPE_CHALLENGE: Final = b"\x01"
TYPE_RESPONSE: Final = b"\x02"
INNER_BYTES: Final = ROOM_BYTES - 1
"""The largest datagram of the core that this lane carries."""
OVERHEAD_BYTES: Final = SEAL_BYTES + 1
"""What the lane adds to it, below which come 8 bytes of UDP and 20 or 40 of IP."""
TOKEN_BYTES: Final = 8
AMPLIFICATION: Final = 3
"""RFC 9000, 8.1."""
CHALLENGE_INTERVAL_S: Final = 0.25
"""The relay's challenge may be lost: again so often, without waiting for a round trip that nobody has measured."""
PATH_TIMEOUT_S: Final = 3.0
"""Longer than the round trip of a satellite link with a queue on it."""

_ID: Final = struct.Struct("!I")


class Sealed:
    """What both ends have of one session."""

    def __init__(self, parameters: SessionParameters, side: Side) -> None:
        self.parameters = parameters
        self.sealer, self.opener = make_seals(parameters, side)
        self.validated = False
        """Whether the peer has answered at the address in use."""

    @property
    def rekey_due(self) -> bool:
        """Most of what the keys allow is used up: open another session soon. At the limit, sends are GONE."""
        return self.sealer.rekey_due or self.opener.rekey_due


class UdpSession(Sealed):
    """The relay's end of one session. Made by `UdpServer.open_session`."""

    def __init__(self, server: "UdpServer", client: ClientName, parameters: SessionParameters) -> None:
        super().__init__(parameters, Side.RELAY)
        self.client = client
        self.address: Address | None = None
        """Where the client is; None before its first datagram."""
        self.closed = False
        self._server = server
        self._listener: DatagramSocket | None = None
        self._good: tuple[DatagramSocket, Address] | None = None  # the last one that was validated, if not the present
        self._token = b""
        self._since_s = 0.0
        self._received_bytes = 0  # from and to an address that is not validated
        self._sent_bytes = 0
        self._retry: asyncio.TimerHandle | None = None
        self._waiting = False

    @property
    def id(self) -> int:
        return self.parameters.id

    def ready(self) -> bool:
        """Whether a datagram of any size would be sent now. False: `on_writable` follows when that changes."""
        ready = (
            self._listener is not None
            and not self._listener.blocked
            and (self.validated or self._allowed(UDP_PAYLOAD_BYTES))
        )
        self._waiting |= not ready
        return ready

    def send(self, data: bytes, tos: int | None = None) -> SendResult:
        """Send `data`, at most INNER_BYTES, sealed, with the IP byte `tos` (default: the server's). FULL: `on_writable`
        follows; the client has not spoken yet, or its new address has had its share until it is validated, or the
        kernel's buffer is full. GONE: the session is closed, or its key used up."""
        if len(data) > INNER_BYTES:
            raise UsageError(f"{len(data)} bytes do not fit the UDP lane: at most {INNER_BYTES}")
        if self.closed:
            return SendResult.GONE
        if not self.validated and not self._allowed(len(data) + OVERHEAD_BYTES):
            self._waiting = True
            return SendResult.FULL
        return self._put(TYPE_DATA, data, tos)

    def _allowed(self, nbytes: int) -> bool:
        return self._sent_bytes + nbytes <= AMPLIFICATION * self._received_bytes

    def _put(self, kind: bytes, payload: bytes, tos: int | None = None) -> SendResult:
        listener = self._listener
        if listener is None:
            return SendResult.FULL
        try:
            datagram = self.sealer.seal(kind + payload)
        except RekeyError:
            return SendResult.GONE
        result = listener.send(datagram, self.address, self._server.tos if tos is None else tos)
        if result is SendResult.FULL:
            self._waiting = True
        elif not self.validated:
            self._sent_bytes += len(datagram)
        return result

    def _arrived(
        self, listener: DatagramSocket, address: Address, inner: bytes, nbytes: int, *, newest: bool, now: float
    ) -> None:
        """An authenticated datagram of `nbytes` from `address`; `newest`: none with a higher counter came before."""
        here = address == self.address and listener is self._listener
        if newest and not here:
            here = True
            self._move(listener, address, nbytes, now)
            if self.closed:
                return
        elif here and not self.validated:
            self._received_bytes += nbytes
            if self._retry is None:
                self._begin_validation(now)
        kind = inner[:1]
        if kind == TYPE_DATA:
            self._server.on_datagram(self, inner[1:], now)
        elif kind == TYPE_CHALLENGE:
            if here and len(inner) > TOKEN_BYTES and (self.validated or self._allowed(nbytes)):
                self._put(TYPE_RESPONSE, inner[1:])
        elif kind == TYPE_RESPONSE and not self.validated and self._token == inner[1 : 1 + TOKEN_BYTES]:
            self._validated()
        if self._waiting and not self.closed and self.ready():
            self._wake()

    def _move(self, listener: DatagramSocket, address: Address, nbytes: int, now: float) -> None:
        if self.validated and self._listener is not None and self.address is not None:
            self._good = (self._listener, self.address)
        self._stop_validation()
        self._listener, self.address = listener, address
        self._received_bytes, self._sent_bytes = nbytes, 0
        self.validated = self._good == (listener, address)
        if self.validated:
            self._good = None
        else:
            self._token = os.urandom(TOKEN_BYTES)
            self._begin_validation(now)
        self._server.on_path(self, address, self.validated)

    def _begin_validation(self, now: float) -> None:
        self._since_s = now
        self._challenge()

    def _stop_validation(self) -> None:
        self._token = b""
        if self._retry is not None:
            self._retry.cancel()
            self._retry = None

    def _challenge(self) -> None:
        """Padded to the full size, so that the path is known to carry it, unless that is more than it may get."""
        self._retry = asyncio.get_running_loop().call_later(CHALLENGE_INTERVAL_S, self._challenge_again)
        size = INNER_BYTES if self._allowed(UDP_PAYLOAD_BYTES) else TOKEN_BYTES
        if self._allowed(size + OVERHEAD_BYTES):
            self._put(TYPE_CHALLENGE, self._token.ljust(size, b"\0"))

    def _challenge_again(self) -> None:
        self._retry = None
        if clock.now() - self._since_s < PATH_TIMEOUT_S:
            self._challenge()
        elif self._good is not None:
            (self._listener, self.address), self._good = self._good, None
            self._validated()

    def _validated(self) -> None:
        self._stop_validation()
        self.validated = True
        self._good = None
        if self.address is not None:
            self._server.on_path(self, self.address, True)
        if self._waiting and not self.closed and self.ready():
            self._wake()

    def _wake(self) -> None:
        self._waiting = False
        self._server.on_writable(self)

    def _listener_writable(self, listener: DatagramSocket) -> None:
        if self._waiting and self._listener is listener and self.ready():
            self._wake()

    def _close(self) -> None:
        self.closed = True
        self._listener = None
        self._stop_validation()


def ignore(*_: object) -> None:
    """Does nothing, for what the owner does not want to know."""


class UdpServer:
    """Sockets on `listen` (`udp://address:port`, ...) that serve all clients, each in a session of its own.

    `on_datagram(session, data, now)` for each authenticated datagram of the core, `after()` once a batch that had some.
    `on_path(session, address, validated)` when a client's address changed, and when it was validated.
    `on_writable(session)` once after a FULL send or a `ready()` that was false. Raises ConfigError of one line.
    The owner opens a session for each connection of the ZMQ lane, sends its `parameters` there, and closes it with it.
    """

    def __init__(
        self,
        listen: Sequence[str],
        on_datagram: Callable[[UdpSession, bytes, float], None],
        *,
        on_path: Callable[[UdpSession, Address, bool], None] = ignore,
        on_writable: Callable[[UdpSession], None] = ignore,
        after: Callable[[], None] = ignore,
        tos: int = 0,
        ciphers: Sequence[Cipher] | None = None,
    ) -> None:
        self.on_datagram = on_datagram
        self.on_path = on_path
        self.on_writable = on_writable
        self.tos = tos & 0xFC  # the lower two bits are ECN's
        self.sessions: dict[int, UdpSession] = {}
        self.unknown = 0
        """Datagrams of no session that the kernel's filter did not stop."""
        self.listeners: list[DatagramSocket] = []
        self._ciphers = ciphers
        self._past: Counter[str] = Counter()
        self._narrowing: asyncio.Handle | None = None
        try:
            for endpoint in listen:
                self._listen(endpoint, after)
        except BaseException:
            self.close()
            raise
        self._narrow()

    def _listen(self, endpoint: str, after: Callable[[], None]) -> None:
        def received(view: memoryview, address: Address) -> bool:
            session = self.sessions.get(_ID.unpack_from(view)[0])
            if session is None:
                self.unknown += 1
                return False
            opener = session.opener
            highest = opener.highest
            inner = opener.open(view)
            if inner is None:
                return False
            newest = opener.highest > highest
            session._arrived(listener, address, inner, len(view), newest=newest, now=clock.now())
            return True

        def writable() -> None:
            for session in list(self.sessions.values()):
                session._listener_writable(listener)

        socket = bound_socket(endpoint)
        listener = DatagramSocket(socket, received, after=after, on_writable=writable, on_error=ignore)
        self.listeners.append(listener)

    @property
    def ports(self) -> tuple[int, ...]:
        """The ports of the listeners, in their order."""
        return tuple(listener.port for listener in self.listeners)

    def open_session(self, client: ClientName, offered: Sequence[str], *, port: int | None = None) -> UdpSession:
        """A new session with fresh keys. `offered`: the client's ciphers, its favourite first; `port`: where it is to
        send (default: the first listener's). Raises RefusedError when no cipher is in common."""
        if not self.listeners:
            raise UsageError("this UDP server is closed, or listens nowhere")
        cipher = choose_cipher(offered, self._ciphers)
        number = secrets.randbits(32)
        while number in self.sessions:
            number = secrets.randbits(32)
        parameters = SessionParameters.draw(number, cipher, self.ports[0] if port is None else port)
        session = self.sessions[number] = UdpSession(self, client, parameters)
        self._narrow()
        return session

    def close_session(self, session: UdpSession) -> None:
        """Nothing is sent or taken any more. Idempotent."""
        if self.sessions.pop(session.id, None) is not None:
            session._close()
            self._past.update(session.opener.refused)
            if self._narrowing is None:  # many may end at once; until then their datagrams are merely unknown
                self._narrowing = asyncio.get_running_loop().call_soon(self._narrow)

    def close(self) -> None:
        """Idempotent."""
        for session in list(self.sessions.values()):
            self.close_session(session)
        if self._narrowing is not None:
            self._narrowing.cancel()
            self._narrowing = None
        for listener in self.listeners:
            listener.close()
        self.listeners.clear()

    def refused(self) -> Mapping[str, int]:
        """Datagrams refused since the start, by reason (`unknown`, and those of `Opener.refused`)."""
        total = Counter({"unknown": self.unknown})
        total.update(self._past)
        for session in self.sessions.values():
            total.update(session.opener.refused)
        return total

    def _narrow(self) -> None:
        if self._narrowing is not None:
            self._narrowing.cancel()
            self._narrowing = None
        for listener in self.listeners:
            listener.only(self.sessions)
