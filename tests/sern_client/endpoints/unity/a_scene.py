"""A scene as ROS-TCP-Connector's description has it, written without what it is held against."""

import asyncio
import json
import struct
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any


class AScene:
    """`got`: messages by destination; `commands`: what it was told, by command. `nul`: it ends its strings as Unity
    does in ROS 2."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, *, nul: bool) -> None:
        self.got: dict[str, list[bytes]] = {}
        self.commands: dict[str, list[dict[str, Any]]] = {}
        self.signs_of_life = 0
        self.closed = False
        self.slices = 0
        self._end = b"\0" if nul else b""
        self._reader = reader
        self.writer = writer
        self._task = asyncio.create_task(self._read())

    async def _read(self) -> None:
        try:
            while True:
                name, body = [await self._part() for _ in range(2)]
                destination = name.decode()
                if not name and not body:
                    self.signs_of_life += 1
                elif destination.startswith("__"):
                    self.commands.setdefault(destination, []).append(json.loads(body))
                else:
                    self.got.setdefault(destination, []).append(body)
        except (asyncio.IncompleteReadError, ConnectionError):
            self.closed = True

    async def _part(self) -> bytes:
        (length,) = struct.unpack("<I", await self._reader.readexactly(4))
        return await self._reader.readexactly(length)

    def frame(self, destination: str, body: bytes) -> bytes:
        name = destination.encode() + self._end
        return struct.pack("<I", len(name)) + name + struct.pack("<I", len(body)) + body

    def send(self, destination: str, body: bytes) -> None:
        """In one piece, or byte by byte when `slices` is set."""
        data = self.frame(destination, body)
        size = self.slices or len(data)
        for begin in range(0, len(data), size):
            self.writer.write(data[begin : begin + size])

    def say(self, command: str, **parameters: Any) -> None:
        self.send(f"__{command}", json.dumps(parameters).encode() + self._end)

    def subscribe(self, topic: str, type_name: str) -> None:
        self.say("subscribe", topic=topic, message_name=type_name)

    def publish(self, topic: str, type_name: str, *, latch: bool = False) -> None:
        self.say("publish", topic=topic, message_name=type_name, queue_size=10, latch=latch)

    def told(self, command: str) -> list[dict[str, Any]]:
        return self.commands.get(f"__{command}", [])

    @property
    def errors(self) -> list[str]:
        return [said["text"] for said in self.told("error")]

    async def leave(self) -> None:
        self._task.cancel()
        await asyncio.gather(self._task, return_exceptions=True)
        self.writer.transport.abort()
        self.closed = True


@asynccontextmanager
async def scene(port: int, *, nul: bool = True) -> AsyncIterator[AScene]:
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    made = AScene(reader, writer, nul=nul)
    try:
        yield made
    finally:
        await made.leave()
