"""A master and nodes made of plain sockets, for tests without ROS. They misbehave on demand."""

import asyncio
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager, suppress
from typing import Any, Final, Self

from sern_client.endpoints.ros1 import Ros1Endpoint, Ros1Options
from sern_client.endpoints.ros1.frames import LENGTH
from sern_client.endpoints.ros1.header import decode_header, encode_header
from sern_client.endpoints.ros1.xmlrpc import XmlRpcServer
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import ros_types
from tests.support import Events, until

HOST: Final = "127.0.0.1"
STRING: Final = ros_types.topic_info("/chat", "std_msgs/msg/String", Encoding.ROS1)


def text(data: str) -> bytes:
    return ros_types.serialise(
        ros_types.new("std_msgs/msg/String", Encoding.ROS1, data=data), "std_msgs/msg/String", Encoding.ROS1
    )


def frame(body: bytes) -> bytes:
    return LENGTH.pack(len(body)) + body


def collect(endpoint: Ros1Endpoint, name: str = "/chat") -> list[bytes]:
    """Subscribes; what has come so far."""
    got: list[bytes] = []

    def sink(body: bytes, stamp_ns: int) -> bool:
        assert stamp_ns > 10**18
        got.append(body)
        return True

    endpoint.subscribe(TopicName(name), sink)
    return got


class FakeMaster:
    """What a node needs of rosmaster. `tables` are publishers, subscribers and services."""

    def __init__(self) -> None:
        self.tables: tuple[dict[str, list[str]], ...] = ({}, {}, {})
        self.nodes: dict[str, str] = {}
        self.services: dict[str, str] = {}
        self.types: dict[str, str] = {}
        """The types of topics as they were registered last."""
        self.refused: set[str] = set()
        """Methods that it answers with no."""
        self.run_id = "one"
        self.calls: dict[str, int] = {}
        self.mute = ""
        """A method that fails."""
        self.port = 0
        self._server = XmlRpcServer(self._dispatch)

    async def start(self) -> None:
        self.port = await self._server.start(HOST)

    async def stop(self) -> None:
        await self._server.stop()

    @property
    def uri(self) -> str:
        return f"http://{HOST}:{self.port}"

    def forget(self) -> None:
        """Forget all that is registered, as a restart does."""
        for table in self.tables:
            table.clear()
        self.run_id += "+"

    def add(self, kind: int, name: str, node: str, uri: str) -> None:
        self.tables[kind].setdefault(name, [])
        if node not in self.tables[kind][name]:
            self.tables[kind][name].append(node)
        self.nodes[node] = uri

    def remove(self, kind: int, name: str, node: str) -> None:
        nodes = self.tables[kind].get(name, [])
        if node in nodes:
            nodes.remove(node)
            if not nodes:
                del self.tables[kind][name]

    def _dispatch(self, method: str, params: tuple[Any, ...]) -> Any:
        self.calls[method] = self.calls.get(method, 0) + 1
        if method in self.refused:
            return 0, "not now", 0
        if method == self.mute:
            raise LookupError(method)
        match method, params:
            case "getSystemState", (_,):
                return 1, "", [[[name, nodes] for name, nodes in table.items()] for table in self.tables]
            case "getParam", (_, "/run_id"):
                return 1, "", self.run_id
            case "lookupNode", (_, node):
                return (1, "", self.nodes[node]) if node in self.nodes else (-1, "unknown node", "")
            case "lookupService", (_, name):
                return (1, "", self.services[name]) if name in self.services else (-1, "no provider", "")
            case "registerPublisher", (caller, topic, kind, uri):
                self.add(0, topic, caller, uri)
                self.types[topic] = kind
            case "registerSubscriber", (caller, topic, _, uri):
                self.add(1, topic, caller, uri)
            case "registerService", (caller, name, service_uri, uri):
                self.add(2, name, caller, uri)
                self.services[name] = service_uri
            case "unregisterPublisher", (caller, topic, _):
                self.remove(0, topic, caller)
            case "unregisterSubscriber", (caller, topic, _):
                self.remove(1, topic, caller)
            case "unregisterService", (caller, name, _):
                self.remove(2, name, caller)
            case _:
                raise LookupError(method)
        return 1, "", 1


class FakePublisher:
    """A node that publishes /chat with the header that it is given, and then whatever bytes the test sends."""

    def __init__(self, master: FakeMaster, name: str = "/talker", **fields: str) -> None:
        self.name = name
        self.fields: dict[str, str] = {
            "callerid": name, "topic": "/chat", "type": "std_msgs/String", "md5sum": STRING.type_hash,
            "message_definition": STRING.definition, "latching": "0", **fields,
        }  # fmt: skip
        self.greeting: bytes | None = None  # in place of the header
        self.host = HOST  # where it says that it is
        self.requests: list[dict[str, str]] = []
        self.writers: list[asyncio.StreamWriter] = []
        self._master = master
        self._api = XmlRpcServer(self._dispatch)
        self._server: asyncio.Server | None = None
        self._port = 0

    async def __aenter__(self) -> Self:
        api_port = await self._api.start(HOST)
        self._server = await asyncio.start_server(self._connected, HOST, 0)
        self._port = self._server.sockets[0].getsockname()[1]
        self._master.add(0, "/chat", self.name, f"http://{HOST}:{api_port}/")
        return self

    async def __aexit__(self, *_: object) -> None:
        """It crashes: the master is not told."""
        assert self._server is not None
        self._server.close()
        self.hang_up()
        await self._api.stop()
        await self._server.wait_closed()

    def _dispatch(self, method: str, params: tuple[Any, ...]) -> Any:
        if method != "requestTopic":
            raise LookupError(method)
        return 1, "", ["TCPROS", self.host, self._port]

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(asyncio.IncompleteReadError, OSError):
            (size,) = LENGTH.unpack(await reader.readexactly(4))
            self.requests.append(decode_header(await reader.readexactly(size)))
            writer.write(encode_header(self.fields) if self.greeting is None else self.greeting)
            self.writers.append(writer)
            await reader.read()
        writer.transport.abort()

    def send(self, data: bytes) -> None:
        """Raw bytes to everybody who is connected."""
        for writer in self.writers:
            if not writer.transport.is_closing():
                writer.write(data)

    def hang_up(self) -> None:
        for writer in self.writers:
            writer.transport.abort()
        self.writers.clear()


class Listener:
    """A subscriber's connection to the TCPROS port of an endpoint."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader = reader
        self.writer = writer

    async def header(self) -> dict[str, str]:
        return decode_header(await self.frame())

    async def frame(self) -> bytes:
        (size,) = LENGTH.unpack(await self.reader.readexactly(4))
        return await self.reader.readexactly(size)

    def close(self) -> None:
        self.writer.transport.abort()


@asynccontextmanager
async def listening(endpoint: Ros1Endpoint, **fields: str) -> AsyncIterator[Listener]:
    """A connection with this header sent; the answer is not read yet."""
    reader, writer = await asyncio.open_connection(*endpoint.tcpros_address())
    listener = Listener(reader, writer)
    try:
        writer.write(encode_header({"callerid": "/listener", "md5sum": "*", "type": "*", **fields}))
        yield listener
    finally:
        listener.close()


@asynccontextmanager
async def running(
    master: FakeMaster, name: str = "sern", environ: Mapping[str, str] | None = None, **options: Any
) -> AsyncIterator[tuple[Ros1Endpoint, Events]]:
    """An endpoint at this master, polling fast, and what it announced."""
    settings: dict[str, Any] = {"master_uri": master.uri, "host": HOST, "poll_hz": 20.0, **options}
    endpoint, events = Ros1Endpoint(Ros1Options(node_name=name, **settings), environ=environ or {}), Events()
    await endpoint.start(events)
    try:
        await until(lambda: endpoint.connected, "the master is found")
        yield endpoint, events
    finally:
        await endpoint.stop()
