"""One connection of a scene: its frames in, what waits for it out, and signs of life both ways."""

import asyncio
import itertools
import logging
from collections.abc import Callable
from enum import StrEnum
from typing import Final, Protocol

from sern_client.endpoints.unity import framing
from sern_client.endpoints.unity.framing import Frame, Frames
from sern_client.endpoints.unity.options import UnityOptions
from sern_client.endpoints.unity.waiting import Waiting
from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.types import TopicName

ALIVE_S: Final = 0.5
"""A scene gives up after two seconds in which it hears nothing."""
AHEAD_BYTES: Final = 64 * 2**10
"""What the socket may hold of what is sent: what waits here can still be replaced by what is newer."""
READ_BYTES: Final = 256 * 2**10
MAX_ERRORS: Final = 100
"""So many errors a scene is told in one connection; it shows each to people."""

_log = logging.getLogger(__name__)
_numbers = itertools.count(1)


class Ended(StrEnum):
    """Why a connection has ended."""

    CLOSED = "closed"
    """By the scene."""
    STALLED = "stalled"
    """It takes nothing of what is sent."""
    UNREAD = "unread"
    """It asks, and does not read the answers."""
    MALFORMED = "malformed"
    STOPPED = "stopped"
    """This endpoint stops."""


class Handler(Protocol):
    """Is told what scenes say."""

    def frame(self, scene: "Scene", frame: Frame) -> None:
        """WireError: the connection cannot be gone on with."""
        ...


class Scene:
    """`faults(problem)` counts and logs what the scene does wrong."""

    def __init__(
        self,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
        options: UnityOptions,
        handler: Handler,
        faults: Callable[[str], None],
    ) -> None:
        self.number = next(_numbers)
        self.types: dict[TopicName, str] = {}
        """What it reads them as."""
        self.spelled: dict[TopicName, str] = {}
        """Topics that it subscribes to, as it writes them."""
        self.waiting = Waiting(options.max_waiting_bytes)
        self.ended: Ended | None = None
        host, port = writer.get_extra_info("peername")[:2]
        self.address = f"{host}:{port}"
        self._reader = reader
        self._writer = writer
        self._options = options
        self._handler = handler
        self._faults = faults
        self._more = asyncio.Event()
        self._errors = 0

    async def run(self) -> Ended:
        """Until the connection has ended, and why."""
        self._writer.transport.set_write_buffer_limits(high=AHEAD_BYTES)
        self._writer.write(framing.handshake(self._options.encoding))
        reading = asyncio.create_task(self._read(), name=f"unity-read-{self.number}")
        writing = asyncio.create_task(self._write(), name=f"unity-write-{self.number}")
        try:
            await asyncio.wait((reading, writing), return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in (reading, writing):
                task.cancel()
            found = await asyncio.gather(reading, writing, return_exceptions=True)
            self.ended = self.ended or next((each for each in found if isinstance(each, Ended)), Ended.STOPPED)
            self.waiting.close()
            self._writer.transport.abort()
        for each in found:
            if isinstance(each, Exception):
                raise each
        return self.ended

    def end(self, why: Ended) -> None:
        """End the connection soon."""
        if self.ended is None:
            self.ended = why
            self._more.set()

    # What it is told

    def answer(self, frames: bytes) -> None:
        if not self.waiting.answer(frames):
            self.end(Ended.UNREAD)
        self._more.set()

    def error(self, text: str) -> None:
        """An error that the scene shows to people; beyond MAX_ERRORS it is counted and logged alone."""
        self._faults(f"{self.address}: {text}")
        self._errors += 1
        if self._errors <= MAX_ERRORS:
            self.answer(framing.command("error", text=text))

    def message(self, name: TopicName, body: bytes, *, reliable: bool) -> None:
        """A message of a topic, if it subscribes to it."""
        spelled = self.spelled.get(name)
        if spelled is not None:
            self.waiting.message(name, framing.frame(spelled, body), reliable=reliable)
            self._more.set()

    # The connection

    async def _read(self) -> Ended:
        frames = Frames(self._options.max_message_bytes)
        try:
            while data := await self._reader.read(READ_BYTES):
                for frame in frames.feed(data):
                    if not frame.alive:
                        self._handler.frame(self, frame)
                    if self.ended is not None:
                        return self.ended
                await asyncio.sleep(0)  # a scene that sends all the time has its turn, and no more
        except WireError as error:
            self._faults(f"{self.address}: {error}; the connection is closed")
            return Ended.MALFORMED
        except ConnectionError:
            return Ended.CLOSED
        if frames.nbytes:
            self._faults(f"{self.address}: went in the middle of a frame")
        return Ended.CLOSED

    async def _write(self) -> Ended:
        try:
            while self.ended is None:
                self._more.clear()
                while self.ended is None and (data := self.waiting.next()) is not None:
                    self._writer.write(data)
                    async with asyncio.timeout(self._options.stalled_s):
                        await self._writer.drain()
                if self.ended is None and not self._more.is_set():
                    await self._rest()
        except TimeoutError:
            self._faults(f"{self.address}: takes nothing for {self._options.stalled_s:g} s; the connection is closed")
            return Ended.STALLED
        except ConnectionError:
            return Ended.CLOSED
        return self.ended

    async def _rest(self) -> None:
        """Until there is more to send, with signs of life meanwhile."""
        try:
            async with asyncio.timeout(ALIVE_S):
                await self._more.wait()
        except TimeoutError:
            self._writer.write(framing.ALIVE)
            async with asyncio.timeout(self._options.stalled_s):
                await self._writer.drain()
