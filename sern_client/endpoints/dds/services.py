"""ROS 2 services over DDS, as rmw_cyclonedds has them: a request topic, a reply topic, and in each message, before its
fields, 8 bytes for the client and 8 for the number of the call.

rmw_fastrtps has the same topics and types, but sends client and number as RTPS inline QoS (related sample identity).
Cyclone DDS neither shows nor sends those, so services of rmw_fastrtps nodes are told of in one line and left alone, and
their calls are not answered.
"""

import asyncio
import logging
import secrets
import struct
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Final

from sern_client.endpoints.base import ServiceEvents, ServiceHandler, ServiceInfo
from sern_client.endpoints.common.calls import PendingCalls, Tasks, within
from sern_client.endpoints.common.saying import SayOnce
from sern_client.endpoints.dds import names
from sern_client.endpoints.dds.definitions import Definitions
from sern_client.endpoints.dds.entities import Entities, Reader, Writer
from sern_client.endpoints.dds.graph import Remote, puts_header
from sern_client.endpoints.dds.names import Role
from sern_client.endpoints.dds.qos import EndpointQos
from sern_client.endpoints.dds.worker import Sample
from sern_core.vocabulary.errors import ConfigError, ServiceError, UsageError
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import ros_services

DEPTH: Final = 10
"""History of requests and replies: what ROS 2 has by default for services."""
MATCH_POLL_S: Final = 0.005
"""How often a call that waits for its server looks whether it is there."""
SETTLE_S: Final = 0.1
"""The pause before the first call of a new client."""
REPLY_WAIT_S: Final = 1.0
"""How long a reply waits for the reader of a client that has just appeared."""
MAX_CALLS: Final = 100
"""Calls of one service under way here at a time; more are not answered."""
_ENCAPSULATION_BYTES: Final = 4
_HEADER_BYTES: Final = 16

_log = logging.getLogger(__name__)


class Wrapped:
    """A body with the header of its call. 16 bytes keep the alignment of what follows."""

    @staticmethod
    def join(body: bytes, client: int, number: int) -> bytes:
        return body[:_ENCAPSULATION_BYTES] + _layout(body).pack(client, number) + body[_ENCAPSULATION_BYTES:]

    @staticmethod
    def split(body: bytes) -> tuple[bytes, int, int]:
        """(body without header, client, number). ValueError when it is too short."""
        end = _ENCAPSULATION_BYTES + _HEADER_BYTES
        if len(body) < end:
            raise ValueError(f"{len(body)} bytes are no request or reply of rmw_cyclonedds")
        client, number = _layout(body).unpack_from(body, _ENCAPSULATION_BYTES)
        return body[:_ENCAPSULATION_BYTES] + body[end:], client, number


def _layout(body: bytes) -> struct.Struct:
    return struct.Struct("<Qq" if body[1] & 1 else ">Qq")


def new_service_id() -> str:
    """A new id by which rmw_cyclonedds pairs a client's reader with its writer, written as it does."""
    return ".".join(f"{byte:x}" for byte in secrets.token_bytes(16))


async def _matched(side: Reader | Writer) -> None:
    """Wait until a writer has a reader, or a reader a writer."""
    while not side.matched:  # noqa: ASYNC110  DDS says so by status only
        await asyncio.sleep(MATCH_POLL_S)


@dataclass(slots=True)
class _Client:
    info: ServiceInfo
    ident: int
    writer: Writer
    reader: Reader
    pending: PendingCalls
    number: int = 0
    met_s: float | None = None

    def close(self) -> None:
        self.writer.close()
        self.reader.close()
        self.pending.fail_all(f"{self.info.name}: the service is gone")


@dataclass(slots=True, eq=False)
class _Server:
    """`close` withdraws the service and gives up the calls under way."""

    owner: "DdsServices"
    info: ServiceInfo
    handler: ServiceHandler
    closed: bool = False
    writer: Writer | None = None
    reader: Reader | None = None
    tasks: Tasks = field(default_factory=lambda: Tasks(MAX_CALLS))

    def close(self) -> None:
        if self.closed:
            return
        self.closed = True
        self.owner.forget(self)
        if self.reader is not None:
            self.reader.close()
        # A call that has just been told that it fails may still have an answer to give.
        asyncio.get_running_loop().call_soon(self._end)

    def _end(self) -> None:
        if self.writer is not None:
            self.writer.close()
        self.tasks.cancel()


class DdsServices:
    """The services of one endpoint."""

    def __init__(self, entities: Entities, types: Definitions, say_once: SayOnce) -> None:
        self._entities = entities
        self._types = types
        self._say_once = say_once
        self._events: ServiceEvents | None = None
        self._known: dict[TopicName, ServiceInfo] = {}
        self._clients: dict[TopicName, _Client] = {}
        self._servers: list[_Server] = []

    def watch(self, events: ServiceEvents) -> None:
        self._events = events
        for info in self._known.values():
            events.service_added(info)

    async def stop(self) -> None:
        servers = list(self._servers)
        for server in servers:
            server.close()
        for client in self._clients.values():
            client.close()
        self._clients.clear()
        for server in servers:
            await server.tasks.ended()

    def forget(self, server: _Server) -> None:
        if server in self._servers:
            self._servers.remove(server)

    # What is there

    def changed(self, name: TopicName) -> None:
        """A reader or writer of the service's topics came or went."""
        info = self._find(name)
        before = self._known.get(name)
        if info == before:
            return
        if before is not None:
            del self._known[name]
            client = self._clients.pop(name, None)
            if client is not None:
                client.close()
            if self._events is not None:
                self._events.service_removed(name)
        if info is not None:
            self._known[name] = info
            if self._events is not None:
                self._events.service_added(info)

    def _find(self, name: TopicName) -> ServiceInfo | None:
        """A service is there when one participant reads its requests and writes its replies."""
        graph = self._entities.graph
        repliers = {writer.participant for writer in graph.writers(names.to_dds(name, Role.REPLY))}
        unknown: set[tuple[str, str]] = set()
        wanted = self._events is not None and self._events.wants_service(name)
        for reader in graph.readers(names.to_dds(name, Role.REQUEST)):
            if reader.participant not in repliers:
                continue
            type_name = names.type_from_dds(reader.type_name)
            if type_name is None or not type_name.endswith("_Request"):
                continue
            if not self._understood(name, reader, wanted=wanted):
                continue
            type_name = type_name.removesuffix("_Request")
            kind = type_name, reader.qos.type_hash
            if kind in unknown:
                continue
            try:
                text = self._types.service(*kind)
            except ConfigError as error:
                unknown.add(kind)
                if wanted:
                    line = partial(self._left_alone, name, reader, names.cut(str(error), 600))
                    graph.when_named(reader, partial(self._say_once, line, name, kind), name, kind)
                continue
            return ServiceInfo(name, type_name, Encoding.CDR, text.type_hash, text.definition)
        return None

    def _left_alone(self, name: TopicName, remote: Remote, why: str) -> str:
        return f"service {name} of {self._entities.graph.owner(remote)} is left alone: {why}"

    def _understood(self, name: TopicName, remote: Remote, *, wanted: bool) -> bool:
        if puts_header(remote):
            return True
        if wanted:
            line = partial(self._not_understood, name, remote)
            about = "rmw_fastrtps", name
            self._entities.graph.when_named(remote, partial(self._say_once, line, *about), *about)
        return False

    def _not_understood(self, name: TopicName, remote: Remote) -> str:
        return (
            f"service {name}: {self._entities.graph.owner(remote)} uses rmw_fastrtps, whose calls Cyclone DDS "
            "cannot carry; an endpoint of kind rclpy beside this one (services_only) bridges them, or run "
            "that node with RMW_IMPLEMENTATION=rmw_cyclonedds_cpp"
        )

    # Client

    async def call(self, name: TopicName, request: bytes, *, timeout_s: float) -> bytes:
        """ServiceError when there is no such service or no answer in time."""
        info = self._known.get(name)
        if info is None:
            raise ServiceError(f"{name}: no such service in this domain")
        if len(request) < _ENCAPSULATION_BYTES:
            raise ServiceError(f"{name}: a request of {len(request)} bytes is none")
        client = self._clients.get(name)
        if client is None:
            client = self._clients[name] = self._open(info)
        client.number += 1
        number = client.number
        with client.pending.call(number) as answer:
            async with within(timeout_s, f"{name}: no answer within {timeout_s:g} s"):
                await self._met(client)
                client.writer.publish(Wrapped.join(request, client.ident, number), 0)
                return await answer

    async def _met(self, client: _Client) -> None:
        """Wait until a new client and its server know each other.

        That the server has found our reader too, nothing tells us; its answer would be lost. So there is a pause after
        the first match.
        """
        await _matched(client.writer)
        await _matched(client.reader)
        loop = asyncio.get_running_loop()
        if client.met_s is None:
            client.met_s = loop.time()
        await asyncio.sleep(max(0.0, client.met_s + SETTLE_S - loop.time()))

    def _open(self, info: ServiceInfo) -> _Client:
        client_id = secrets.randbits(64)
        pending = PendingCalls()

        def deliver(sample: Sample) -> None:
            try:
                body, client, number = Wrapped.split(sample.body)
            except ValueError:
                self._entities.counters.unreadable += 1
                return
            if client == client_id:
                pending.answer(number, body)

        try:
            writer, reader = self._pair(info, deliver, new_service_id(), serve=False)
        except ConfigError as error:
            raise ServiceError(str(error)) from None
        return _Client(info, client_id, writer, reader, pending)

    def _pair(
        self, info: ServiceInfo, deliver: Callable[[Sample], None], ident: str, *, serve: bool
    ) -> tuple[Writer, Reader]:
        """Writer and reader of one side of a service."""
        resolved = ros_services.resolve(info.type_name, info.definition, Encoding.CDR)
        request = names.to_dds(info.name, Role.REQUEST), resolved.request
        reply = names.to_dds(info.name, Role.REPLY), resolved.response
        (out_topic, out_type), (in_topic, in_type) = (reply, request) if serve else (request, reply)
        key = "serviceid" if serve else "clientid"
        qos = EndpointQos(reliable=True, type_hash=in_type.text.type_hash, service_id=ident)
        reader = self._entities.open_reader(in_topic, in_type, qos, deliver, header=True, id_key=key)
        qos = replace(qos, type_hash=out_type.text.type_hash)
        try:
            writer = self._entities.open_writer(out_topic, out_type, qos, depth=DEPTH, header=True, id_key=key)
        except ConfigError:
            reader.close()
            raise
        return writer, reader

    # Server

    def serve(self, info: ServiceInfo, handler: ServiceHandler) -> _Server:
        """ConfigError when the type is not known or another service here has the name."""
        if info.encoding is not Encoding.CDR:
            raise ConfigError(f"service {info.name}: {info.encoding} bodies cannot be served in ROS 2")
        if any(server.info.name == info.name for server in self._servers):
            raise UsageError(f"service {info.name} is served already")
        text = self._types.service(info.type_name) if not info.definition else None
        if text is not None:
            info = ServiceInfo(info.name, info.type_name, info.encoding, text.type_hash, text.definition)
        server = _Server(self, info, handler)

        def deliver(sample: Sample) -> None:
            self._asked(server, sample)

        server.writer, server.reader = self._pair(info, deliver, new_service_id(), serve=True)
        self._servers.append(server)
        return server

    def _asked(self, server: _Server, sample: Sample) -> None:
        caller = self._entities.graph.writer(sample.handle)
        if caller is not None and not self._understood(server.info.name, caller, wanted=True):
            return
        try:
            request, client, number = Wrapped.split(sample.body)
        except ValueError as error:
            self._entities.counters.unreadable += 1
            self._say_once(f"service {server.info.name}: {error}")
            return
        if server.tasks.full:
            self._entities.counters.calls += 1
            self._say_once(f"service {server.info.name}: more than {MAX_CALLS} calls at a time; some fail")
            return
        server.tasks.begin(self._answer(server, request, client, number))

    async def _answer(self, server: _Server, request: bytes, client: int, number: int) -> None:
        try:
            response = await server.handler(request)
        except ServiceError as error:
            # ROS 2 has no way to say so: the caller's own timeout ends its call.
            _log.warning("service %s: a call fails without an answer: %s", server.info.name, error)
            return
        if server.writer is None:
            return
        with suppress(TimeoutError):
            async with asyncio.timeout(REPLY_WAIT_S):
                await _matched(server.writer)
        server.writer.publish(Wrapped.join(response, client, number), 0)
