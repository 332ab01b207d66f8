"""ROS 1 services: those of the local nodes, found and called; those of the far side, served.

A call is one connection: header, header, request, response; the definition of a service is nowhere on the wire, its
type name and md5sum are in the headers. Bodies pass through unread.
"""

import asyncio
import logging
from collections.abc import Callable
from typing import Final, NamedTuple

from sern_client.endpoints.base import ServiceEvents, ServiceHandler, ServiceInfo
from sern_client.endpoints.common.calls import within
from sern_client.endpoints.common.saying import Trouble
from sern_client.endpoints.ros1.frames import LENGTH
from sern_client.endpoints.ros1.graph import Graph
from sern_client.endpoints.ros1.header import (
    BRIDGE_FIELD,
    MAX_HEADER_BYTES,
    check_lengths,
    decode_header,
    encode_header,
    shown,
)
from sern_client.endpoints.ros1.master import ANY, Master, Table
from sern_client.endpoints.ros1.server import Inbound
from sern_client.endpoints.ros1.xmlrpc import CallError, reason, split_uri
from sern_core.vocabulary.errors import ConfigError, ServiceError, UsageError, WireError
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import ros_types

PROBE_S: Final = 5.0
PROBE_AGAIN_S: Final = (0.25, 10.0)
MAX_WAITING: Final = 16
"""Requests that one connection may send ahead of their responses."""

_log = logging.getLogger(__name__)


class _Connection(NamedTuple):
    reader: asyncio.StreamReader
    writer: asyncio.StreamWriter
    fields: dict[str, str]


async def _connect(uri: str, request: dict[str, str]) -> _Connection:
    """Open a connection to a service and exchange headers. CallError, OSError, or WireError, also for a refusal."""
    host, port = split_uri(uri, "rosrpc")
    reader, writer = await asyncio.open_connection(host, port)
    try:
        writer.write(encode_header(request))
        (size,) = LENGTH.unpack(await reader.readexactly(4))
        if size > MAX_HEADER_BYTES:
            raise WireError(f"a connection header of {size} bytes")
        fields = decode_header(await reader.readexactly(size))
    except BaseException:
        writer.transport.abort()
        raise
    if "error" in fields:
        writer.transport.abort()
        raise WireError(f"refused: {' '.join(fields['error'].split())[:300]}")
    return _Connection(reader, writer, fields)


class Provider:
    """A service of a local node: probed once its node lives, for what its header says."""

    def __init__(self, service: str, node_name: str, owner: "ServiceWatch") -> None:
        self.service = service
        self.node_name = node_name
        self.info: ServiceInfo | None = None
        self._owner = owner
        self._task: asyncio.Task[None] | None = None
        self._trouble = Trouble(_log, f"{service}: service of {node_name}")

    def up(self, uri: str) -> None:
        del uri  # its own address is looked up, because it is not its node's
        self.down()
        self._task = asyncio.create_task(self._run(), name=f"ros1 service {self.service}")

    def down(self) -> None:
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
        if self.info is not None:
            self.info = None
            self._owner.withdraw(self)

    async def _run(self) -> None:
        pause_s = PROBE_AGAIN_S[0]
        while True:
            unexpected: Exception | None = None
            try:
                async with asyncio.timeout(PROBE_S):
                    fields = await self._probe()
                if BRIDGE_FIELD not in fields or self._owner.accept_bridged:
                    self.info = self._describe(fields)
                    self._owner.announce(self)
                self._trouble.over()
                return
            except (CallError, WireError, OSError, asyncio.IncompleteReadError, ConfigError) as error:
                problem = reason(error)
            except TimeoutError:
                problem = f"no answer within {PROBE_S:g} s"
            except Exception as error:  # noqa: BLE001  an error of ours must not be the end of a service
                problem, unexpected = f"internal error: {reason(error)}", error
            level = logging.WARNING if unexpected is None else logging.ERROR
            self._trouble.say(problem, level, unexpected, lost=True)
            await asyncio.sleep(pause_s)
            pause_s = min(pause_s * 2, PROBE_AGAIN_S[1])

    async def _probe(self) -> dict[str, str]:
        uri = await self._owner.master.service_uri(self.service)
        connection = await _connect(
            uri, {"callerid": self._owner.master.caller, "service": self.service, "md5sum": ANY, "probe": "1"}
        )
        connection.writer.transport.abort()
        return connection.fields

    def _describe(self, fields: dict[str, str]) -> ServiceInfo:
        check_lengths(fields, "type", "request_type", "md5sum")
        name = fields.get("type", "")
        if not name:
            name = fields.get("request_type", "").removesuffix("Request")
        package, separator, short = name.partition("/")
        if not separator:
            raise WireError("its header does not say its type")
        type_name = ros_types.canonical(f"{package}/srv/{short.removeprefix('srv/')}")
        md5 = fields.get("md5sum", "")
        return ServiceInfo(TopicName(self._owner.local(self.service)), type_name, Encoding.ROS1, md5)


class ServiceWatch:
    """Finds the services of local nodes for `events`, and calls them."""

    def __init__(
        self, master: Master, graph: Graph, local: Callable[[str], str], max_message_bytes: int, *, accept_bridged: bool
    ) -> None:
        self.master = master
        self.local = local
        self.accept_bridged = accept_bridged
        self.providers: dict[str, Provider] = {}
        self.known: Table = {}
        """The services at the master, ours too, and the nodes they are of."""
        self._graph = graph
        self._max_message_bytes = max_message_bytes
        self._events: ServiceEvents | None = None

    def watch(self, events: ServiceEvents) -> None:
        if self._events is not None:
            raise UsageError("watch_services is called once")
        self._events = events
        self.update(self.known)

    def update(self, services: Table) -> None:
        """The master's list, new or again."""
        self.known = services
        if self._events is None:
            return
        foreign = {name: nodes[0] for name, nodes in services.items() if nodes and nodes[0] != self.master.caller}
        for name, provider in list(self.providers.items()):
            if foreign.get(name) != provider.node_name:
                del self.providers[name]
                self._graph.detach(provider.node_name, provider)
        for name, node in foreign.items():
            if name not in self.providers:
                provider = self.providers[name] = Provider(name, node, self)
                self._graph.attach(node, provider)

    def announce(self, provider: Provider) -> None:
        if self._events is not None and provider.info is not None:
            self._events.service_added(provider.info)

    def withdraw(self, provider: Provider) -> None:
        if self._events is not None:
            self._events.service_removed(TopicName(self.local(provider.service)))

    def stop(self) -> None:
        self._events = None  # nobody is to be told any more
        for provider in self.providers.values():
            provider.down()
        self.providers.clear()

    async def call(self, service: str, request: bytes, timeout_s: float) -> bytes:
        """One call. ServiceError when there is no such service, it says no, or the time is over."""
        if self.known.get(service, ())[:1] == (self.master.caller,):
            raise ServiceError(f"{service} is served from the far side here; it cannot be called from there")
        if len(request) > self._max_message_bytes:
            raise ServiceError(f"{service}: a request of {len(request)} bytes is above {self._max_message_bytes}")
        try:
            async with within(timeout_s, f"{service}: no response within {timeout_s:g} s"):
                return await self._call(service, request)
        except CallError as error:
            raise ServiceError(f"{service}: {error}") from error
        except asyncio.IncompleteReadError:
            raise ServiceError(f"{service}: the connection ended before the response") from None
        except (OSError, WireError) as error:
            raise ServiceError(f"{service}: {reason(error)}") from error

    async def _call(self, service: str, request: bytes) -> bytes:
        uri = await self.master.service_uri(service)
        provider = self.providers.get(service)
        md5 = provider.info.type_hash if provider is not None and provider.info is not None else ANY
        connection = await _connect(
            uri,
            {"callerid": self.master.caller, "service": service, "md5sum": md5 or ANY, "persistent": "0"},
        )
        try:
            connection.writer.writelines((LENGTH.pack(len(request)), request))
            ok, size = await _response_head(connection.reader)
            if size > self._max_message_bytes:
                raise ServiceError(f"{service}: a response of {size} bytes is above {self._max_message_bytes}")
            body = await connection.reader.readexactly(size)
        finally:
            connection.writer.transport.abort()
        if not ok:
            text = " ".join(body.decode("utf-8", "replace").split())
            raise ServiceError(f"{service}: {text[:300] or 'it failed, without saying why'}")
        return body


async def _response_head(reader: asyncio.StreamReader) -> tuple[bool, int]:
    head = await reader.readexactly(5)
    return head[0] != 0, int(LENGTH.unpack(head[1:])[0])


class Served:
    """A service of the far side that we serve here; the `ServiceServer` of the endpoint."""

    def __init__(self, name: str, info: ServiceInfo, handler: ServiceHandler, owner: "ServiceHost") -> None:
        self.name = name
        self.info = info
        self.handler = handler
        self.calls: set[_Call] = set()
        self._owner = owner
        type_name = info.type_name.replace("/srv/", "/")
        self.answer = {
            "callerid": owner.caller,
            "service": name,
            "md5sum": info.type_hash or ANY,
            "type": type_name,
            "request_type": f"{type_name}Request",
            "response_type": f"{type_name}Response",
        } | ({} if owner.as_node else {BRIDGE_FIELD: owner.caller})

    def close(self) -> None:
        self._owner.withdraw(self)
        for call in list(self.calls):
            call.fail()


class _Call:
    """One connection that calls a service of ours: requests are answered one after the other."""

    def __init__(self, link: Inbound, served: Served, *, persistent: bool) -> None:
        self._link = link
        self._served = served
        self._persistent = persistent
        self._waiting: list[bytes] = []
        self._task: asyncio.Task[None] | None = None
        served.calls.add(self)

    def request(self, body: bytes) -> None:
        if len(self._waiting) >= MAX_WAITING:
            self._link.server.complain(f"{self._served.name}: {self._link.peer} sends requests without waiting")
            self._link.close()
            return
        self._waiting.append(body)
        if self._task is None:
            self._task = asyncio.create_task(self._run(), name=f"ros1 call of {self._served.name}")

    async def _run(self) -> None:
        while self._waiting:
            try:
                response = b"\x01", await self._served.handler(self._waiting.pop(0))
            except ServiceError as error:
                response = b"\x00", str(error).encode()
            except Exception:  # noqa: BLE001  a fault of one handler; its caller is told
                _log.exception("%s: a call failed", self._served.name)
                response = b"\x00", b"internal error of the bridge"
            self._write(*response)
            if not self._persistent:
                self._hang_up()
                return
        self._task = None

    def _write(self, ok: bytes, body: bytes) -> None:
        if self._link.transport is not None:
            self._link.transport.writelines((ok, LENGTH.pack(len(body)), body))

    def _hang_up(self) -> None:
        if self._link.transport is not None:
            self._link.transport.close()  # after what was written

    def fail(self) -> None:
        """The service is withdrawn."""
        if self._task is not None:
            self._write(b"\x00", b"the service was withdrawn")
        self._hang_up()
        self.ended()

    def ended(self) -> None:
        self._served.calls.discard(self)
        self._waiting.clear()
        task, self._task = self._task, None
        if task is not None:
            task.cancel()


class ServiceHost:
    """The services that we serve; `accept` is what the TCPROS port asks."""

    def __init__(self, caller: str, *, as_node: bool = False) -> None:
        self.caller = caller
        self.as_node = as_node
        """Other SERN endpoints are not told that a service is one's."""
        self.served: dict[str, Served] = {}

    def serve(self, name: str, info: ServiceInfo, handler: ServiceHandler) -> Served:
        if info.encoding is not Encoding.ROS1:
            raise ConfigError(f"{info.name}: a {info.encoding} service cannot be served by a ROS 1 node")
        if name in self.served:
            raise ConfigError(f"{info.name}: another service of that name is served here already")
        package, kind, short = ros_types.canonical(info.type_name).split("/")
        if kind != "srv":
            raise ConfigError(f"{info.name}: {package}/{kind}/{short} is not a service type")
        served = self.served[name] = Served(name, info, handler, self)
        return served

    def withdraw(self, served: Served) -> None:
        if self.served.get(served.name) is served:
            del self.served[served.name]

    def accept(self, link: Inbound, fields: dict[str, str]) -> _Call | str:
        name = fields["service"]
        served = self.served.get(name)
        if served is None:
            return f"{self.caller} does not serve [{name[:200]}]"
        md5, own = fields.get("md5sum", ""), served.info.type_hash or ANY
        if ANY not in (md5, own) and md5 != own:
            return (
                f"{name}: {shown(fields, 'callerid', 'a caller')} expects {shown(fields, 'type', 'a type')} "
                f"with md5sum {shown(fields, 'md5sum')}, what is served here is {served.info.type_name} with {own}"
            )
        link.answer(served.answer)
        if fields.get("probe") == "1" and link.transport is not None:
            link.transport.close()
        return _Call(link, served, persistent=fields.get("persistent", "0") in ("1", "true"))
