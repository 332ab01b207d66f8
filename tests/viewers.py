"""Viewers for tests, over real websockets: a person's Foxglove, as far as the protocol goes. And what they look at."""

import asyncio
import json
import ssl
import struct
from collections import defaultdict
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import asynccontextmanager
from typing import Any, Final, NamedTuple

import websockets
from websockets.asyncio.client import ClientConnection
from websockets.typing import Origin, Subprotocol

from sern_client.endpoints.base import TopicNews
from sern_client.endpoints.foxglove.endpoint import FoxgloveEndpoint
from sern_client.endpoints.foxglove.options import FoxgloveOptions
from sern_core.vocabulary.types import TopicName
from tests.support import LASTING, Events, open_sockets, until

PROTOCOLS: Final = ("foxglove.sdk.v1", "foxglove.websocket.v1")
_DATA: Final = struct.Struct("<BIQ")
_CALL: Final = struct.Struct("<BIII")


def start_runtime() -> None:
    """Have the SDK start what it keeps to the end of the process: threads, and a socket by which signals come."""
    import foxglove

    before = open_sockets()
    foxglove.start_server(port=0, context=foxglove.Context()).stop()
    LASTING.update(open_sockets() - before)


class FakeViewed:
    """What other sites have, as a test says."""

    def __init__(self) -> None:
        self.wants: list[tuple[str, bool]] = []
        self.news: dict[str, TopicNews] = {}
        self.asked = 0

    def want(self, name: TopicName, wanted: bool) -> None:
        self.wants.append((name, wanted))

    def topics(self) -> Sequence[TopicNews]:
        self.asked += 1
        return list(self.news.values())

    def set(self, name: str, age_s: float | None, *, capped_hz: float | None = None, **dropped: int) -> None:
        self.news[name] = TopicNews(TopicName(name), age_s, dict(dropped), capped_hz)  # type: ignore[arg-type]


class Shown(NamedTuple):
    stamp_ns: int
    body: bytes


class Viewer:
    """One that is connected: what it was told, and what it says."""

    def __init__(self, connection: ClientConnection) -> None:
        self.connection = connection
        self.info: dict[str, Any] = {}
        self.channels: dict[str, dict[str, Any]] = {}
        """By topic, as they were advertised."""
        self.services: dict[str, dict[str, Any]] = {}
        self.statuses: dict[str, str] = {}
        """Those with an id, which hold."""
        self.said: list[dict[str, Any]] = []
        self.got: defaultdict[str, list[Shown]] = defaultdict(list)
        self.answers: dict[int, bytes | str] = {}
        self.closed: int | None = None
        self._subscriptions: dict[int, str] = {}
        self._numbers = 0
        self._reading = asyncio.create_task(self._read())

    async def _read(self) -> None:
        try:
            async for message in self.connection:
                if isinstance(message, bytes):
                    self._binary(message)
                else:
                    self._text(json.loads(message))
        except websockets.ConnectionClosedError:
            pass
        finally:
            self.closed = self.connection.close_code or 0

    def _binary(self, message: bytes) -> None:
        if message[0] == 1:
            _, number, stamp_ns = _DATA.unpack_from(message)
            self.got[self._subscriptions[number]].append(Shown(stamp_ns, message[_DATA.size :]))
        elif message[0] == 3:
            _, _, call, size = _CALL.unpack_from(message)
            self.answers[call] = message[_CALL.size + size :]

    def _text(self, said: dict[str, Any]) -> None:
        self.said.append(said)
        match said["op"]:
            case "serverInfo":
                self.info = said
            case "advertise":
                self.channels |= {channel["topic"]: channel for channel in said["channels"]}
            case "unadvertise":
                self.channels = {t: c for t, c in self.channels.items() if c["id"] not in said["channelIds"]}
            case "advertiseServices":
                self.services |= {service["name"]: service for service in said["services"]}
            case "unadvertiseServices":
                self.services = {n: s for n, s in self.services.items() if s["id"] not in said["serviceIds"]}
            case "serviceCallFailure":
                self.answers[said["callId"]] = said["message"]
            case "status" if "id" in said:
                self.statuses[said["id"]] = said["message"]
            case "removeStatus":
                for status in said["statusIds"]:
                    self.statuses.pop(status, None)

    async def say(self, said: Mapping[str, Any]) -> None:
        await self.connection.send(json.dumps(said))

    async def look(self, *topics: str) -> None:
        """Subscribe, once they are there."""
        await until(lambda: all(topic in self.channels for topic in topics), f"{topics} are told of")
        listed = []
        for topic in topics:
            self._numbers += 1
            self._subscriptions[self._numbers] = topic
            listed.append({"id": self._numbers, "channelId": self.channels[topic]["id"]})
        await self.say({"op": "subscribe", "subscriptions": listed})

    async def look_away(self, *topics: str) -> None:
        numbers = [number for number, topic in self._subscriptions.items() if topic in topics]
        await self.say({"op": "unsubscribe", "subscriptionIds": numbers})

    async def advertise(self, number: int, topic: str, type_name: str, encoding: str = "json", **more: str) -> None:
        channel = {"id": number, "topic": topic, "encoding": encoding, "schemaName": type_name, **more}
        await self.say({"op": "advertise", "channels": [channel]})

    async def publish(self, number: int, body: bytes) -> None:
        await self.connection.send(b"\x01" + number.to_bytes(4, "little") + body)

    async def call(self, service: str, number: int, request: bytes, encoding: str = "cdr") -> None:
        word = encoding.encode()
        await self.connection.send(_CALL.pack(2, self.services[service]["id"], number, len(word)) + word + request)

    async def got_of(self, topic: str, count: int = 1) -> list[bytes]:
        """The bodies of a topic, once there are so many."""
        await until(lambda: len(self.got[topic]) >= count, f"{count} of {topic}")
        return [shown.body for shown in self.got[topic]]

    async def close(self) -> None:
        await self.connection.close()
        await self._reading


@asynccontextmanager
async def viewer(
    port: int, *, origin: str | None = None, query: str = "", tls: ssl.SSLContext | None = None
) -> AsyncIterator[Viewer]:
    """Connected, until the end of the block."""
    scheme = "ws" if tls is None else "wss"
    connection = await websockets.connect(
        f"{scheme}://127.0.0.1:{port}/{query}",
        subprotocols=[Subprotocol(protocol) for protocol in PROTOCOLS],
        origin=None if origin is None else Origin(origin),
        max_size=None,
        compression=None,
        proxy=None,
        ssl=tls,
    )
    looking = Viewer(connection)
    try:
        await until(lambda: looking.info, "the server says who it is")
        yield looking
    finally:
        await looking.close()


class Bridge(NamedTuple):
    """An endpoint that runs, and what is around it."""

    endpoint: FoxgloveEndpoint
    viewed: FakeViewed
    events: Events

    @property
    def port(self) -> int:
        return self.endpoint.port

    async def looked_at(self, topic: str, count: int = 1) -> None:
        """Wait until so many viewers look at a topic."""
        await until(lambda: self.endpoint.looked_at[TopicName(topic)] == count, f"{count} look at {topic}")


@asynccontextmanager
async def bridge(**options: Any) -> AsyncIterator[Bridge]:
    """An endpoint on a free port, with a fake of what other sites have."""
    endpoint = FoxgloveEndpoint(FoxgloveOptions(**{"listen": "127.0.0.1:0", **options}))
    viewed, events = FakeViewed(), Events()
    endpoint.use_viewed(viewed)
    await endpoint.start(events)
    try:
        yield Bridge(endpoint, viewed, events)
    finally:
        await endpoint.stop()


def frame(payload: bytes, *, opcode: int = 1, fin: bool = True, size: int | None = None) -> bytes:
    """A frame of a viewer, with a mask that leaves everything as it is. `size`: what it says of its length."""
    length = len(payload) if size is None else size
    first = (0x80 if fin else 0) | opcode
    if length < 126:
        head = bytes((first, 0x80 | length))
    elif length < 1 << 16:
        head = bytes((first, 0x80 | 126)) + length.to_bytes(2, "big")
    else:
        head = bytes((first, 0x80 | 127)) + length.to_bytes(8, "big")
    return head + b"\0\0\0\0" + payload


def head(*, target: str = "/", drop: Sequence[str] = (), **more: str) -> bytes:
    """The request of a viewer; `more`: headers, with _ for -."""
    headers = {
        "Host": "127.0.0.1",
        "Upgrade": "websocket",
        "Connection": "Upgrade",
        "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
        "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Protocol": ", ".join(PROTOCOLS),
    } | {name.replace("_", "-"): value for name, value in more.items()}
    lines = [f"GET {target} HTTP/1.1", *(f"{name}: {value}" for name, value in headers.items() if name not in drop)]
    return "\r\n".join(lines).encode() + b"\r\n\r\n"
