"""A scene of Unity as a test plays it, written from the description of the protocol and not from our code.

It speaks as Unity's ROS-TCP-Connector does: a keep-alive first, and texts that end with NUL in ROS 2 mode. It expects
the handshake first, and names without NUL.
"""

import asyncio
import json
import struct
from collections import defaultdict
from types import TracebackType
from typing import Any, Self

from sern_client.endpoints.base import TopicNews
from sern_core.vocabulary.types import TopicName
from tests.support import until

TEXT = "std_msgs/String"


class FakeViewed:
    """A `Viewed` that keeps what is wanted, in order, and says what it is told to."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, bool]] = []
        self.news: list[TopicNews] = []

    @property
    def wanted(self) -> set[str]:
        last = dict(self.calls)
        return {name for name, wanted in last.items() if wanted}

    def want(self, name: TopicName, wanted: bool) -> None:
        self.calls.append((name, wanted))

    def topics(self) -> list[TopicNews]:
        return self.news


class PlayedScene:
    """One connection. `piece_bytes`: how many bytes leave at once; None: all. `ros2`: whether texts end with NUL."""

    def __init__(self, port: int, *, ros2: bool = True, piece_bytes: int | None = None) -> None:
        self.frames: list[tuple[str, bytes]] = []
        self.keep_alives = 0
        self.ended = asyncio.Event()
        self._port = port
        self._nul = b"\0" if ros2 else b""
        self._piece_bytes = piece_bytes
        self._reading: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Self:
        await self.connect()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.leave()

    async def connect(self, *, reads: bool = True) -> None:
        self.reader, self.writer = await asyncio.open_connection("127.0.0.1", self._port)
        self.writer.write(bytes(8))
        if reads:
            self.read()

    def read(self) -> None:
        self._reading = asyncio.create_task(self._read())

    async def leave(self) -> None:
        self.writer.transport.abort()
        if self._reading is not None:
            self._reading.cancel()
            await asyncio.wait([self._reading])

    async def _read(self) -> None:
        try:
            while True:
                (length,) = struct.unpack("<i", await self.reader.readexactly(4))
                destination = (await self.reader.readexactly(length)).decode("ascii")
                (length,) = struct.unpack("<i", await self.reader.readexactly(4))
                body = await self.reader.readexactly(length)
                if not self.frames and destination != "__handshake":
                    raise AssertionError(f"the handshake comes first, not {destination}")
                if destination:
                    self.frames.append((destination, body))
                else:
                    self.keep_alives += 1
        except (asyncio.IncompleteReadError, ConnectionError):
            self.ended.set()

    # --- what it has got --------------------------------------------------------------------------------------------

    def bodies(self, destination: str) -> list[bytes]:
        return [body for name, body in self.frames if name == destination]

    def commands(self, name: str) -> list[dict[str, Any]]:
        return [json.loads(body) for body in self.bodies(name)]

    @property
    def errors(self) -> list[str]:
        return [command["text"] for command in self.commands("__error")]

    @property
    def warnings(self) -> list[str]:
        return [command["text"] for command in self.commands("__warn")]

    def answers(self, kind: str) -> dict[int, tuple[str, bytes]]:
        """What followed each `__request` or `__response`, by its number."""
        found = {}
        for (name, body), after in zip(self.frames, self.frames[1:], strict=False):
            if name == kind:
                found[json.loads(body)["srv_id"]] = after
        return found

    async def told(self, part: str) -> str:
        """The error that has this in it, once it has come."""
        await until(lambda: any(part in text for text in self.errors), f"an error with {part}: {self.errors}")
        return next(text for text in self.errors if part in text)

    async def caught_up(self) -> None:
        """All that was sent before has had its effect: a list of topics is asked for, and has come."""
        before = len(self.bodies("__topic_list"))
        await self.command("__topic_list")
        await until(lambda: len(self.bodies("__topic_list")) > before, "an answer to __topic_list")

    # --- what it says -----------------------------------------------------------------------------------------------

    async def send(self, data: bytes) -> None:
        pieces = self._piece_bytes or len(data) or 1
        for at in range(0, len(data), pieces):
            self.writer.write(data[at : at + pieces])
            if self._piece_bytes is not None:
                await self.writer.drain()
                await asyncio.sleep(0)
        await self.writer.drain()

    def frame(self, destination: str, body: bytes) -> bytes:
        name = destination.encode() + self._nul
        return struct.pack("<I", len(name)) + name + struct.pack("<I", len(body)) + body

    async def message(self, destination: str, body: bytes) -> None:
        await self.send(self.frame(destination, body))

    async def command(self, name: str, **given: object) -> None:
        await self.message(name, json.dumps(given).encode() + self._nul)

    async def subscribe(self, topic: str, type_name: str = TEXT) -> None:
        await self.command("__subscribe", topic=topic, message_name=type_name)

    async def publish(self, topic: str, type_name: str = TEXT, *, latch: bool = False) -> None:
        await self.command("__publish", topic=topic, message_name=type_name, queue_size=10, latch=latch)


class Sinks(defaultdict[str, list[bytes]]):
    """What a bridge takes: it subscribes to each topic."""

    def __init__(self) -> None:
        super().__init__(list)
        self.stamps_ns: list[int] = []

    def of(self, name: str) -> Any:
        def sink(body: bytes, stamp_ns: int) -> bool:
            self[name].append(body)
            self.stamps_ns.append(stamp_ns)
            return True

        return sink


def text_body(text: str, *, ros2: bool = True) -> bytes:
    """A std_msgs/String."""
    data = text.encode()
    if ros2:
        return b"\0\1\0\0" + struct.pack("<I", len(data) + 1) + data + b"\0"
    return struct.pack("<I", len(data)) + data
