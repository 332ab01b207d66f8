"""What a client knows of its connection to the relay: up, down and why, as far as libzmq and the kernel tell.

libzmq says which end gave up and whether an answer came, the kernel how much of one. Together they tell apart what a
person must do: nobody listens, somebody listens and is silent, something else than ZeroMQ answers, or a peer that
greeted ended the handshake, as a relay does whose key is another one.
"""

import asyncio
import errno
import socket as socketlib
from collections.abc import Callable
from typing import Final

import zmq

from sern_runtime.monitor import EventKind, MonitorEvent, SocketMonitor, TcpHandle, port_of, received_bytes

GREETING_BYTES: Final = 64
"""What a ZMTP peer says first (RFC 23)."""
RETRY_GRACE_S: Final = 2.0
"""libzmq says at once that it will try again; what it has not said by then it does not do."""

NOT_YET: Final = "not connected yet"
WAITING: Final = "connected, and nothing has come back yet"
LOST: Final = "the connection to the relay was lost"
NOBODY: Final = "the relay does not answer: connecting failed"
SILENT: Final = (
    "connected, and nothing came back in the time for a handshake: the relay hangs, nothing gets through, or "
    "what listens there is no relay"
)
HALF_WAY: Final = (
    "the relay began the handshake and did not end it in time: it hangs, refuses us for now, or the link is very slow"
)
UNFINISHED: Final = (
    "connected, and no handshake in time: the relay hangs or refuses us for now, the link "
    "is very slow, or what listens there is no relay"
)
SHUT: Final = (
    "the connection was closed before a relay's greeting came: the relay is full, or what listens there is no relay"
)
ENDED: Final = "the relay ended the handshake: its key is not the one in server_key_file, or it is full"
CUT: Final = (
    "the connection was closed during the handshake: what listens there is no relay, the relay is full, or its key is "
    "not the one in server_key_file"
)
"""Where it is not known how much came: a port that just closes and a wrong key look the same, so the key is the last
guess."""
OTHER: Final = "what listens there is no relay: it does not speak ZeroMQ's protocol"

_TIME_WAS_OVER: Final = (errno.EAGAIN, errno.EINTR)
"""libzmq says the errno of its last call then: that nothing was to be read, or that a machine which stood still goes
on."""
_ZAP_UNKNOWN_KEY: Final = 400
_MECHANISM_MISMATCH: Final = 0x11000002  # ZMQ_PROTOCOL_ERROR_ZMTP_MECHANISM_MISMATCH


class TransportWatch:
    """A client's transport in four calls.

    `on_up(handle)` after the handshake (`handle` None on ipc); `on_down(reason)` when a transport that was up is
    gone, or an attempt failed for a new reason; `on_rebuild(reason)` when libzmq has given up for good because the
    relay does not want us (it said 400, or has no keys), and `on_dead(reason)` when it has given up on what it met
    there: the caller makes a new socket, with jittered backoff.
    """

    def __init__(
        self,
        socket: "zmq.Socket[bytes]",
        on_up: Callable[[TcpHandle | None], None],
        on_down: Callable[[str], None],
        on_rebuild: Callable[[str], None],
        on_dead: Callable[[str], None],
    ) -> None:
        self.up = False
        self.reason = NOT_YET
        self._on_up = on_up
        self._on_down = on_down
        self._on_rebuild = on_rebuild
        self._on_dead = on_dead
        self._handle: TcpHandle | None = None
        self._shaking = False
        self._failed = False  # libzmq has said how this handshake failed
        self._kept: socketlib.socket | None = None  # while the handshake lasts: what has come is asked at its end
        self._retry: asyncio.TimerHandle | None = None
        self._monitor = SocketMonitor(socket, self._on_event)

    @property
    def waiting(self) -> bool:
        """Whether a connection is there, and its handshake under way."""
        return self._shaking

    @property
    def letting_in(self) -> bool:
        """Whether a handshake is under way, and something of it has come back."""
        if not self._shaking:
            return False
        received = None if self._kept is None else received_bytes(self._kept)
        return received is None or received > 0

    def close(self) -> None:
        """Close this before the socket. Idempotent."""
        self._monitor.close()
        self._retries()
        self._received()

    def _on_event(self, event: MonitorEvent) -> None:
        match event.kind:
            case EventKind.CONNECTED:
                self._received()  # of an attempt before it, if its end was not said
                self._shaking, self._failed = True, False
                self._handle = TcpHandle.of(event.value, peer_port=port_of(event.endpoint))
                self._kept = None if self._handle is None else self._handle.kept()
            case EventKind.HANDSHAKE_SUCCEEDED:
                self._received()
                self._shaking = False
                self.up = True
                self.reason = ""
                self._on_up(self._handle)
            case EventKind.HANDSHAKE_FAILED_AUTH:
                self._failed = True
                self._refused(event.value)
            case EventKind.HANDSHAKE_FAILED_PROTOCOL:
                self._failed = True
                self._give_up(_protocol_problem(event.value))
            case EventKind.HANDSHAKE_FAILED_NO_DETAIL:
                self._failed = True
                self._down(_unfinished(event.value, self._received()))
            case EventKind.DISCONNECTED:
                self._disconnected()
            case EventKind.CLOSED if not self.up:
                self._down(NOBODY)
            case EventKind.CONNECT_RETRIED:
                self._retries()
            case _:
                pass

    def _disconnected(self) -> None:
        """libzmq tries again, or has met what it does not try again: then it says nothing more."""
        shaking, self._shaking = self._shaking, False
        self._received()
        if shaking and not self._failed:  # the only end of a handshake that has no event of its own
            self._down(OTHER)
            self._on_dead(OTHER)
            return
        if self.up:
            self._down(LOST)
        self._retries()
        self._retry = asyncio.get_running_loop().call_later(RETRY_GRACE_S, self._dead)

    def _dead(self) -> None:
        self._retry = None
        self._on_dead(self.reason)

    def _retries(self) -> None:
        if self._retry is not None:
            self._retry.cancel()
            self._retry = None

    def _received(self) -> int | None:
        """How many bytes of this handshake came, if that is known; from then on it is not any more."""
        kept, self._kept = self._kept, None
        if kept is None:
            return None
        with kept:
            return received_bytes(kept)

    def _refused(self, status: int) -> None:
        if status == _ZAP_UNKNOWN_KEY:
            self._give_up("relay refused our key: it is not in the relay's directory, or has expired")
        else:  # libzmq 4.3 says nothing to the client in this case and lets the handshake time out
            self._down("relay refused us for now: it is full or being reconfigured")

    def _give_up(self, reason: str) -> None:
        self._down(reason)
        self._on_rebuild(reason)

    def _down(self, reason: str) -> None:
        if self.up or reason != self.reason:
            self.up = False
            self.reason = reason
            self._on_down(reason)


def _unfinished(number: int, received: int | None) -> str:
    """Why a handshake has no end: libzmq's errno, and how many bytes came (None: not known)."""
    greeted = received is not None and received >= GREETING_BYTES
    if number in _TIME_WAS_OVER:
        silent = received is not None and received <= 1  # one for the end of the stream
        return SILENT if silent else HALF_WAY if greeted else UNFINISHED
    return CUT if received is None else ENDED if greeted else SHUT


def _protocol_problem(code: int) -> str:
    if code == _MECHANISM_MISMATCH:
        return "the handshake with the relay failed: one side has keys configured and the other has not"
    return f"the handshake with the relay failed (libzmq protocol error {code:#x}): is this a SERN relay?"
