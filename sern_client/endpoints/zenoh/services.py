"""Services through zenoh, as rmw_zenoh does it: a server is a queryable, a call a query with the request as payload."""

import asyncio
import itertools
import logging
import time
from typing import Any, Final

from sern_client.endpoints.base import ServiceEvents, ServiceHandler, ServiceInfo, ServiceServer
from sern_client.endpoints.common.calls import PendingCalls, Tasks, within
from sern_client.endpoints.zenoh import names
from sern_client.endpoints.zenoh.names import Entity, Kind, Qos
from sern_client.endpoints.zenoh.node import Declared, Node
from sern_client.endpoints.zenoh.presence import Presence
from sern_core.vocabulary.errors import ConfigError, ServiceError, WireError
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime.ros_files import TypeFiles

CDR: Final = "application/cdr"
BEHIND: Final = "the bridge is behind with what has arrived"
MAX_REQUESTS: Final = 256
"""Requests of one service that may be under way; more are refused."""

_log = logging.getLogger(__name__)


class Services:
    """The services of one session, ours and those of others."""

    def __init__(self, node: Node, types: TypeFiles) -> None:
        self.node = node
        self._types = types
        self._events: ServiceEvents | None = None
        self._servers: dict[TopicName, dict[str, ServiceInfo]] = {}  # of others, by their key in the graph
        self._present: dict[str, Presence] = {}  # by data key, of services that were called
        self._numbers = itertools.count(1)
        self._pending = PendingCalls()
        self._gid = node.new_gid()
        self._serving: list[_Server] = []

    def watch(self, events: ServiceEvents) -> None:
        self._events = events
        for servers in self._servers.values():
            events.service_added(next(iter(servers.values())))

    @property
    def known(self) -> frozenset[TopicName]:
        """The services of others."""
        return frozenset(self._servers)

    @property
    def watched(self) -> int:
        """How many services are watched: whether requests would reach a server is known of them."""
        return len(self._present)

    def server_changed(self, entity: Entity, alive: bool) -> None:
        """A token of a service server of another session came or went. ConfigError, WireError: it is left out."""
        servers = self._servers.setdefault(entity.name, {})
        if alive:
            type_name = names.ros_type(entity.dds_type)
            definition = self._types.service(type_name) or ""
            info = ServiceInfo(entity.name, type_name, Encoding.CDR, entity.type_hash, definition)
            servers[entity.key] = info
            if len(servers) == 1 and self._events is not None:
                self._events.service_added(info)
            return
        gone = servers.pop(entity.key, None)
        if gone is not None and all(self._key(gone) != self._key(info) for info in servers.values()):
            present = self._present.pop(self._key(gone), None)
            if present is not None:
                present.close()
        if not servers:
            del self._servers[entity.name]
            if gone is not None and self._events is not None:
                self._events.service_removed(entity.name)

    def _key(self, info: ServiceInfo) -> str:
        """What requests of a service are sent to."""
        return self.node.key(info.name, names.dds_type(info.type_name), info.type_hash)

    async def call(self, name: TopicName, request: bytes, *, timeout_s: float) -> bytes:
        servers = self._servers.get(name)
        if not servers:
            raise ServiceError(f"no service {name}")
        key = self._key(next(iter(servers.values())))
        session, pending, number = self.node.session, self._pending, next(self._numbers)
        zenoh, handover = session.zenoh, session.handover
        heard = False

        def replied(reply: Any) -> None:
            nonlocal heard
            if heard:  # one answer is what a call has: a server that says more keeps nothing here
                return
            heard = True
            if reply.ok is not None:
                body = reply.ok.payload.to_bytes()
                handover.news(lambda: pending.answer(number, body))
            else:
                text = reply.err.payload.to_bytes()[:512].decode(errors="replace")
                handover.news(lambda: pending.fail(number, f"{name}: {text or 'refused'}"))

        def ended() -> None:
            handover.news(lambda: pending.fail(number, f"{name} did not answer"))

        if key not in self._present:
            self._present[key] = Presence(session, key)
        with pending.call(number) as answer:
            async with within(timeout_s, f"{name} did not answer within {timeout_s:g} s"):
                if not await self._present[key].wait():
                    raise ServiceError(f"{name} has ended")
                session.opened.get(
                    key,
                    zenoh.handlers.Callback(replied, ended),
                    target=zenoh.QueryTarget.BEST_MATCHING,
                    consolidation=zenoh.ConsolidationMode.NONE,
                    timeout=timeout_s,
                    payload=request,
                    encoding=CDR,
                    attachment=names.pack_attachment(number, time.time_ns(), self._gid),
                )
                return await answer

    def serve(self, info: ServiceInfo, handler: ServiceHandler) -> ServiceServer:
        if not info.type_hash:
            raise ConfigError(f"{info.name}: the hash of {info.type_name} is not known")
        if info.name in self._servers:
            raise ConfigError(f"{info.name}: a node here serves it already")
        server = _Server(self, info, handler)
        self._serving.append(server)
        return server

    async def stop(self) -> None:
        for present in self._present.values():
            present.close()
        self._present.clear()
        for server in list(self._serving):
            server.close()
            await server.ended()

    def forget(self, server: "_Server") -> None:
        if server in self._serving:
            self._serving.remove(server)


class _Server:
    def __init__(self, owner: Services, info: ServiceInfo, handler: ServiceHandler) -> None:
        node, dds_name = owner.node, names.dds_type(info.type_name)
        self._owner = owner
        self._session = node.session
        self._key = node.key(info.name, dds_name, info.type_hash)
        self._handler = handler
        self._tasks = Tasks(MAX_REQUESTS)
        self._closed = False
        queryable = self._session.opened.declare_queryable(self._key, self._asked, complete=True)
        self._declared = Declared(
            self._session, queryable, node.token(Kind.SERVER, info.name, dds_name, info.type_hash, Qos())
        )

    def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        self._owner.forget(self)
        # A call that has just been told that it fails may still have an answer to give.
        asyncio.get_running_loop().call_soon(self._end)

    def _end(self) -> None:
        self._tasks.cancel()
        self._declared.end()

    async def ended(self) -> None:
        await self._tasks.ended()

    def _asked(self, query: Any) -> None:
        """Runs in a thread of zenoh's."""
        payload = b"" if query.payload is None else query.payload.to_bytes()
        attachment = b"" if query.attachment is None else query.attachment.to_bytes()
        self._session.handover.put(
            lambda: self._begin(query, payload, attachment), len(payload) + len(attachment), lambda: self._shed(query)
        )

    def _shed(self, query: Any) -> None:
        """More wait than the loop serves. Runs in a thread of zenoh's."""
        try:
            query.reply_err(BEHIND)
        except self._session.zenoh.ZError as error:  # its session has ended, or ours
            _log.debug("%s: a request could not be refused: %s", self._key, error)
        finally:
            query.drop()

    def _begin(self, query: Any, request: bytes, attachment: bytes) -> None:
        if self._closed:
            query.drop()
        elif self._tasks.full:
            query.reply_err(f"{MAX_REQUESTS} calls are under way already")
            query.drop()
        else:
            self._tasks.begin(self._serve(query, request, attachment))

    async def _serve(self, query: Any, request: bytes, attachment: bytes) -> None:
        try:
            # The answer carries the request's number and client, which is how a ROS client knows it for its own.
            asked = names.unpack_attachment(attachment)
            response = await self._handler(request)
            own = names.pack_attachment(asked.seq, time.time_ns(), asked.gid)
            query.reply(self._key, response, encoding=CDR, attachment=own)
        except (ServiceError, WireError) as error:
            query.reply_err(str(error))
        finally:
            query.drop()  # tells the caller that no more will come
