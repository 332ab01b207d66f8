"""TCPROS framing: every header and every message is a little-endian u32 length and so many bytes.

`Frames` is the receiving half of a connection. Small frames are cut out of one buffer that all connections share
(a read and its handling are one step of the event loop). A frame that is still incomplete then gets a buffer of its
own, which the socket fills directly: as long as the frame where one so long has come before, else `SCRATCH_BYTES`, and
each time that is full another one as long as all that came. A length alone makes nobody take memory.
"""

import asyncio
import socket
import struct
from abc import ABC, abstractmethod
from typing import Final, cast

from sern_client.endpoints.ros1.header import MAX_HEADER_BYTES, decode_header
from sern_core.vocabulary.errors import WireError

SCRATCH_BYTES: Final = 256 * 1024
HANDSHAKE_S: Final = 10.0
"""How long a peer may take to send its connection header."""

LENGTH: Final = struct.Struct("<I")
_scratch: Final = memoryview(bytearray(SCRATCH_BYTES))
_skipped: Final = memoryview(bytearray(SCRATCH_BYTES))


class Frames(asyncio.BufferedProtocol, ABC):
    """One connection's receiving half. A subclass says what to do with the header and with each message.

    `max_frame_bytes` bounds messages: one that is longer is read and thrown away, and `too_large` is told once it is
    announced. A header that is too long, or none in time, ends the connection, and so does a message that is not
    complete `frame_s` after its beginning; None: it may take its time.
    """

    max_frame_bytes: int
    frame_s: float | None = None

    def __init__(self, max_frame_bytes: int) -> None:
        self.max_frame_bytes = max_frame_bytes
        self.transport: asyncio.Transport | None = None
        self.peer = "?"
        self.received_bytes = 0
        self.received_messages = 0
        self._partial = b""  # less than a length
        self._frame: bytearray | None = None  # what is being filled of an incomplete frame
        self._view = memoryview(b"")
        self._have = 0
        self._filled: list[bytearray] = []  # the full buffers before it
        self._missing = 0  # bytes of the frame that no buffer is there for
        self._longest = SCRATCH_BYTES  # what has come in one frame
        self._skip = 0  # bytes of a frame that is too long
        self._headed = False
        self._patience: asyncio.TimerHandle | None = None

    # What a subclass does

    @abstractmethod
    def header(self, fields: dict[str, str]) -> None:
        """The peer's header. WireError ends the connection."""

    @abstractmethod
    def message(self, body: bytes) -> None:
        """One message."""

    @abstractmethod
    def too_large(self, size_bytes: int) -> None:
        """A message above the limit is being thrown away."""

    @abstractmethod
    def failed(self, error: WireError) -> None:
        """The peer broke the protocol; the connection ends."""

    # asyncio.BufferedProtocol

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast("asyncio.Transport", transport)  # uvloop's is no subclass of it
        address = transport.get_extra_info("peername")
        self.peer = f"{address[0]}:{address[1]}" if isinstance(address, tuple) and len(address) >= 2 else "?"
        keep_alive(transport)
        self._wait(HANDSHAKE_S)

    def connection_lost(self, exc: Exception | None) -> None:
        del exc
        self.transport = None
        self._settle()
        self._forget_frame()

    def get_buffer(self, sizehint: int) -> memoryview:
        del sizehint
        if self._frame is not None:
            return self._view[self._have :]
        return _scratch if not self._skip else _skipped[: min(self._skip, SCRATCH_BYTES)]

    def buffer_updated(self, nbytes: int) -> None:
        self.received_bytes += nbytes
        try:
            if self._frame is not None:
                self._have += nbytes
                if self._have == len(self._frame):
                    if self._missing:
                        self._grow(self._frame)
                    else:
                        self._whole(self._frame)
            elif self._skip:
                self._skip -= nbytes
            elif self._partial:
                self._cut(memoryview(self._partial + bytes(_scratch[:nbytes])))
            else:
                self._cut(_scratch[:nbytes])
        except WireError as error:
            self.failed(error)
            self.close()

    def close(self) -> None:
        """End the connection now; what is still unsent is lost."""
        self._settle()
        if self.transport is not None:
            self.transport.abort()
            self.transport = None

    # Inside

    def _begin(self, size: int, data: memoryview) -> None:
        """A frame of which this has come."""
        self._frame = bytearray(min(size, self._longest))
        self._missing = size - len(self._frame)
        self._view = memoryview(self._frame)
        self._have = len(data)
        self._view[: self._have] = data
        if self._headed and self.frame_s is not None:
            self._wait(self.frame_s)

    def _grow(self, full: bytearray) -> None:
        self._filled.append(full)
        came = sum(map(len, self._filled))
        self._frame = bytearray(min(self._missing, came))
        self._missing -= len(self._frame)
        self._view, self._have = memoryview(self._frame), 0

    def _whole(self, last: bytearray) -> None:
        body = b"".join((*self._filled, last)) if self._filled else bytes(last)
        self._longest = max(self._longest, len(body))
        self._forget_frame()
        if self._headed:
            self._settle()
        self._take(body)

    def _forget_frame(self) -> None:
        self._frame, self._view, self._have = None, memoryview(b""), 0
        self._filled.clear()
        self._missing = 0

    def _cut(self, data: memoryview) -> None:
        self._partial = b""
        at, end = 0, len(data)
        while end - at >= 4 and self.transport is not None:
            (size,) = LENGTH.unpack_from(data, at)
            at += 4
            if size <= end - at:
                body = bytes(data[at : at + size])
                at += size
                if size > self.max_frame_bytes and self._headed:
                    self.too_large(size)
                else:
                    self._take(body)
                continue
            if not self._headed and size > MAX_HEADER_BYTES:
                raise WireError(f"a connection header of {size} bytes")
            if self._headed and size > self.max_frame_bytes:
                self._skip = size - (end - at)
                self.too_large(size)
                return
            self._begin(size, data[at:])
            return
        self._partial = bytes(data[at:])

    def _take(self, body: bytes) -> None:
        if self._headed:
            self.received_messages += 1
            self.message(body)
            return
        if len(body) > MAX_HEADER_BYTES:
            raise WireError(f"a connection header of {len(body)} bytes")
        self._headed = True
        self._settle()
        self.header(decode_header(body))

    def _wait(self, patience_s: float) -> None:
        self._settle()
        self._patience = asyncio.get_running_loop().call_later(patience_s, self._impatient, patience_s)

    def _settle(self) -> None:
        if self._patience is not None:
            self._patience.cancel()
            self._patience = None

    def _impatient(self, patience_s: float) -> None:
        what = "a message that is not complete" if self._headed else "no connection header"
        self.failed(WireError(f"{what} within {patience_s:g} s"))
        self.close()


def keep_alive(transport: asyncio.BaseTransport) -> None:
    """Let the kernel notice a host that vanished, within about 8 s, and send small messages at once."""
    sock = transport.get_extra_info("socket")
    if sock is None:
        return
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in (("TCP_KEEPIDLE", 3), ("TCP_KEEPINTVL", 1), ("TCP_KEEPCNT", 5), ("TCP_NODELAY", 1)):
        option = getattr(socket, name, None)  # not every system has each of them
        if option is not None:
            sock.setsockopt(socket.IPPROTO_TCP, option, value)
