"""One connection of a scene: frames in, what waits for it out, and signs of life both ways.

Unity may take two seconds of silence for a fault, so the endpoint sends a keep-alive before one is over. That a scene
says nothing is no sign: while it is paused or in the background its connector is silent, and goes on reading. A scene
that does not read has its time; then the connection ends, and the connector makes another one when it can.
"""

import asyncio
import logging
import socket
from contextlib import suppress
from typing import Final, NamedTuple, Protocol

from sern_client.endpoints.common.saying import say_failure
from sern_client.endpoints.unity import commands
from sern_client.endpoints.unity.commands import Command, UnknownCommandError
from sern_client.endpoints.unity.faults import Fault, Faults
from sern_client.endpoints.unity.frames import COMMAND_PREFIX, KEEP_ALIVE, Frame, FrameReader, TooLarge
from sern_client.endpoints.unity.outbox import Outbox, Pieces
from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.types import DropReason, Encoding
from sern_runtime import clock

KEEP_ALIVE_S: Final = 0.8
"""A scene gets a keep-alive after so long without anything else."""
READ_BYTES: Final = 64 * 1024
WRITE_BYTES: Final = 64 * 1024
"""A piece of a message that is handed to the kernel at once. What is there cannot be overtaken."""
UNSENT_BYTES: Final = 128 * 1024
"""What may wait in the kernel before it is on its way (TCP_NOTSENT_LOWAT)."""
FIRST_S: Final = 10.0
"""How long a connection may say nothing at first. The connector speaks at once."""
TURN_S: Final = 0.005
"""How long frames of one scene are served before it is others' turn."""
MAX_TOLD: Final = 500
"""Different texts that one connection is told: what it asks for may give reason for any number."""

_log = logging.getLogger(__name__)


class SceneHandler(Protocol):
    """What scenes say, to whoever acts on it. No call raises."""

    def command(self, scene: "Scene", command: Command) -> None: ...

    def message(self, scene: "Scene", spelling: str, body: bytes) -> None:
        """A message for a topic or service, as the scene spells it."""

    def too_large(self, scene: "Scene", spelling: str, nbytes: int) -> None: ...


class SceneLimits(NamedTuple):
    max_message_bytes: int
    queue_bytes: int
    stalled_s: float


class StalledError(Exception):
    """The scene has not read for too long."""


class Scene:
    """`outbox` is filled by others, who call `wake` then."""

    def __init__(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, handler: SceneHandler, outbox: Outbox,
        faults: Faults, limits: SceneLimits,
    ) -> None:  # fmt: skip
        peer = writer.get_extra_info("peername")
        self.peer = f"{peer[0]}:{peer[1]}" if peer else "somewhere"
        self.outbox = outbox
        self._reader = reader
        self._writer = writer
        self._handler = handler
        self._faults = faults
        self._stalled_s = limits.stalled_s
        self._frames = FrameReader(limits.max_message_bytes)
        self._waiting = asyncio.Event()
        self._told: set[int] = set()
        self._closed = False
        writer.transport.set_write_buffer_limits(high=WRITE_BYTES, low=WRITE_BYTES // 4)
        _tune(writer.get_extra_info("socket"), limits.stalled_s)

    @property
    def kept_bytes(self) -> int:
        """What this connection keeps in memory here, beside what the kernel has."""
        return self.outbox.nbytes + self._frames.kept_bytes + self._writer.transport.get_write_buffer_size()

    async def refuse(self, encoding: Encoding, within_s: float) -> None:
        """Say what there is to say, and end the connection; it has this long to be read."""
        self._writer.write(commands.handshake(encoding))
        while (pieces := self.outbox.pop()) is not None:
            self._writer.writelines(pieces)
        with suppress(TimeoutError, OSError):
            async with asyncio.timeout(within_s):
                while await self._reader.read(READ_BYTES):
                    pass
        self.close()

    async def run(self, encoding: Encoding) -> None:
        """Serve it until it goes, or `close`. Never raises but when it is cancelled."""
        self._writer.write(commands.handshake(encoding))
        self._writer.write(KEEP_ALIVE)
        writing = asyncio.create_task(self._write(), name=f"to the scene {self.peer}")
        writing.add_done_callback(say_failure)
        try:
            await self._read()
        except WireError as error:
            self._faults(Fault.FRAMING, f"{error}; its connection ends", None)
        except TimeoutError:
            text = f"a connection on which nothing comes for {FIRST_S:g} s is none of a scene; it ends"
            self._faults(Fault.FRAMING, text, None)
        except OSError as error:
            _log.debug("%s: %s", self.peer, error)
        finally:
            self.close()
            writing.cancel()
            await asyncio.wait([writing])
            self.outbox.clear(DropReason.DISCONNECTED)

    def wake(self) -> None:
        """Something waits in the outbox."""
        self._waiting.set()

    def error(self, text: str) -> None:
        self._tell(commands.ERROR, text)

    def warn(self, text: str) -> None:
        self._tell(commands.WARN, text)

    def close(self) -> None:
        """End the connection. What waits for a scene that reads nothing is not waited for."""
        if self._closed:
            return
        self._closed = True
        transport = self._writer.transport
        if transport.get_write_buffer_size():
            transport.abort()
        else:
            transport.close()

    # --- in ---------------------------------------------------------------------------------------------------------

    async def _read(self) -> None:
        async with asyncio.timeout(FIRST_S):
            data = await self._reader.read(READ_BYTES)
        until_s = clock.now() + TURN_S
        while data:
            for item in self._frames.feed(data):
                if self._closed:
                    return
                self._take(item)
                if clock.now() >= until_s:
                    await asyncio.sleep(0)  # whatever one scene says, others and the link have their turn
                    until_s = clock.now() + TURN_S
            data = await self._reader.read(READ_BYTES)

    def _take(self, item: Frame | TooLarge) -> None:
        if isinstance(item, TooLarge):
            self._handler.too_large(self, item.destination, item.nbytes)
        elif item.destination.startswith(COMMAND_PREFIX):
            try:
                command = commands.parse(item.destination, item.body)
            except UnknownCommandError as error:
                self._faults(Fault.COMMAND, f"{error}; it changes nothing", self)
            except WireError as error:
                self._faults(Fault.COMMAND, str(error), self)
            else:
                self._handler.command(self, command)
        elif item.destination:
            self._handler.message(self, item.destination, item.body)

    # --- out --------------------------------------------------------------------------------------------------------

    def _tell(self, kind: str, text: str) -> None:
        told = hash((kind, text))
        if told not in self._told and len(self._told) < MAX_TOLD and not self._closed:
            self._told.add(told)
            self.outbox.say(commands.command(kind, text=f"SERN: {text}"))
            self.wake()

    async def _write(self) -> None:
        try:
            while True:
                pieces = self.outbox.pop()
                if pieces is None:
                    pieces = await self._next()
                await self._send(pieces)
        except StalledError:
            text = f"it has read nothing for {self._stalled_s:g} s; its connection ends, and it may come back"
            self._faults(Fault.STALLED, text, None)
        except OSError as error:
            _log.debug("%s: %s", self.peer, error)
        finally:
            self._closed = True
            self._writer.transport.abort()  # which ends the reading, too

    async def _next(self) -> Pieces:
        """What is to be sent once there is something, or has not been for a while."""
        try:
            async with asyncio.timeout(KEEP_ALIVE_S):
                while True:
                    self._waiting.clear()
                    pieces = self.outbox.pop()
                    if pieces is not None:
                        return pieces
                    await self._waiting.wait()
        except TimeoutError:
            return (KEEP_ALIVE,)

    async def _send(self, pieces: Pieces) -> None:
        if sum(map(len, pieces)) <= WRITE_BYTES:
            self._writer.write(b"".join(pieces))
            await self._taken()
            return
        for piece in pieces:
            view = memoryview(piece)
            for at in range(0, len(view), WRITE_BYTES):
                self._writer.write(view[at : at + WRITE_BYTES])
                await self._taken()

    async def _taken(self) -> None:
        """Wait until the kernel has most of what was written. StalledError when it takes none of it."""
        transport = self._writer.transport
        while (before := transport.get_write_buffer_size()) > WRITE_BYTES:
            try:
                async with asyncio.timeout(self._stalled_s):
                    await self._writer.drain()
                    return
            except TimeoutError:
                if transport.get_write_buffer_size() >= before:
                    raise StalledError from None


def _tune(sock: socket.socket, stalled_s: float) -> None:
    """A peer that is gone without a word is found by the kernel, and little waits where it cannot be overtaken."""
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in (("TCP_NOTSENT_LOWAT", UNSENT_BYTES), ("TCP_USER_TIMEOUT", int(stalled_s * 1000))):
        if hasattr(socket, option):
            sock.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)
