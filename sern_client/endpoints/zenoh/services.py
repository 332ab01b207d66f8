"""Services through zenoh, as rmw_zenoh does it: a server is a queryable, a call a query with the request as payload."""

import asyncio
import itertools
import logging
import secrets
import time
from abc import ABC, abstractmethod
from typing import Any, Final

from sern_client.endpoints.base import ServiceEvents, ServiceHandler, ServiceInfo, ServiceServer
from sern_client.endpoints.zenoh import names
from sern_client.endpoints.zenoh.names import Entity, Kind, Qos
from sern_client.endpoints.zenoh.options import ZenohOptions
from sern_client.endpoints.zenoh.presence import Presence
from sern_client.endpoints.zenoh.session import ZenohSession
from sern_core.vocabulary.errors import ConfigError, ServiceError, WireError
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime.ros_files import TypeFiles

CDR: Final = "application/cdr"
BEHIND: Final = "the bridge is behind with what has arrived"
MAX_REQUESTS: Final = 256
"""Requests of one service that may be under way; more are refused."""

_log = logging.getLogger(__name__)


class Services(ABC):
    """The half of the endpoint that knows services."""

    options: ZenohOptions
    session: ZenohSession
    types: TypeFiles
    _loop: asyncio.AbstractEventLoop

    def __init__(self) -> None:
        self._service_events: ServiceEvents | None = None
        self._servers: dict[TopicName, dict[str, ServiceInfo]] = {}  # of others, by their key in the graph
        self._present: dict[str, Presence] = {}  # by data key, of services that were called
        self._calls = itertools.count(1)
        self._gid = secrets.token_bytes(names.GID_BYTES)
        self._serving: list[_Server] = []

    @abstractmethod
    def _declare_token(self, kind: Kind, name: TopicName, dds_name: str, type_hash: str, qos: Qos) -> Any: ...

    def watch_services(self, events: ServiceEvents) -> None:
        self._service_events = events
        for servers in self._servers.values():
            events.service_added(next(iter(servers.values())))

    def server_changed(self, entity: Entity, alive: bool) -> None:
        """A token of a service server of another session came or went. ConfigError, WireError: it is left out."""
        servers = self._servers.setdefault(entity.name, {})
        if alive:
            type_name = names.ros_type(entity.dds_type)
            definition = self.types.service(type_name) or ""
            info = ServiceInfo(entity.name, type_name, Encoding.CDR, entity.type_hash, definition)
            servers[entity.key] = info
            if len(servers) == 1 and self._service_events is not None:
                self._service_events.service_added(info)
            return
        gone = servers.pop(entity.key, None)
        if gone is not None and all(self._data_key(gone) != self._data_key(info) for info in servers.values()):
            present = self._present.pop(self._data_key(gone), None)
            if present is not None:
                present.close()
        if not servers:
            del self._servers[entity.name]
            if gone is not None and self._service_events is not None:
                self._service_events.service_removed(entity.name)

    def _data_key(self, info: ServiceInfo) -> str:
        """What requests of a service are sent to."""
        dds_name = names.dds_type(info.type_name)
        return names.data_key(self.options.domain, info.name, dds_name, info.type_hash)

    def service_definition(self, type_name: str, encoding: Encoding) -> str | None:
        """The type of a service, as `KnowsServiceTypes` has it."""
        return self.types.service(type_name, encoding)

    async def call(self, name: TopicName, request: bytes, *, timeout_s: float) -> bytes:
        servers = self._servers.get(name)
        if not servers:
            raise ServiceError(f"no service {name}")
        info = next(iter(servers.values()))
        key = self._data_key(info)
        zenoh, handover = self.session.zenoh, self.session.handover
        answer: asyncio.Future[bytes] = asyncio.get_running_loop().create_future()
        heard = False

        def settle(body: bytes | None, problem: str) -> None:
            if answer.done():
                return
            if body is None:
                answer.set_exception(ServiceError(problem))
            else:
                answer.set_result(body)

        def replied(reply: Any) -> None:
            nonlocal heard
            if heard:  # one answer is what a call has: a server that says more keeps nothing here
                return
            heard = True
            if reply.ok is not None:
                body = reply.ok.payload.to_bytes()
                handover.news(lambda: settle(body, ""))
            else:
                text = reply.err.payload.to_bytes()[:512].decode(errors="replace")
                handover.news(lambda: settle(None, f"{name}: {text or 'refused'}"))

        def ended() -> None:
            handover.news(lambda: settle(None, f"{name} did not answer"))

        if key not in self._present:
            self._present[key] = Presence(self.session, key)
        try:
            async with asyncio.timeout(timeout_s):
                if not await self._present[key].wait():
                    raise ServiceError(f"{name} has ended")
                self.session.opened.get(
                    key,
                    zenoh.handlers.Callback(replied, ended),
                    target=zenoh.QueryTarget.BEST_MATCHING,
                    consolidation=zenoh.ConsolidationMode.NONE,
                    timeout=timeout_s,
                    payload=request,
                    encoding=CDR,
                    attachment=names.pack_attachment(next(self._calls), time.time_ns(), self._gid),
                )
                return await answer
        except TimeoutError:
            raise ServiceError(f"{name} did not answer within {timeout_s:g} s") from None

    def serve(self, info: ServiceInfo, handler: ServiceHandler) -> ServiceServer:
        type_hash = info.type_hash
        if not type_hash:
            raise ConfigError(f"{info.name}: the hash of {info.type_name} is not known")
        if info.name in self._servers:
            raise ConfigError(f"{info.name}: a node here serves it already")
        dds_name = names.dds_type(info.type_name)
        key = names.data_key(self.options.domain, info.name, dds_name, type_hash)
        server = _Server(self, key, handler)
        server.declare(self._declare_token(Kind.SERVER, info.name, dds_name, type_hash, Qos()))
        self._serving.append(server)
        return server

    async def end_services(self) -> None:
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
    def __init__(self, owner: Services, key: str, handler: ServiceHandler) -> None:
        self._owner = owner
        self._key = key
        self._handler = handler
        self._tasks: set[asyncio.Task[None]] = set()
        self._closed = False
        self._token: Any = None
        self._queryable = owner.session.opened.declare_queryable(key, self._asked, complete=True)

    def declare(self, token: Any) -> None:
        self._token = token

    def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        self._owner.forget(self)
        # A call that has just been told that it fails may still have an answer to give.
        asyncio.get_running_loop().call_soon(self._end)

    def _end(self) -> None:
        for task in self._tasks:
            task.cancel()
        token, queryable = self._token, self._queryable

        def undeclare() -> None:
            token.undeclare()
            queryable.undeclare()

        self._owner.session.put(undeclare, 0)

    async def ended(self) -> None:
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def _asked(self, query: Any) -> None:
        """Runs in a thread of zenoh's."""
        payload = b"" if query.payload is None else query.payload.to_bytes()
        attachment = b"" if query.attachment is None else query.attachment.to_bytes()
        self._owner.session.handover.put(
            lambda: self._begin(query, payload, attachment), len(payload) + len(attachment), lambda: self._shed(query)
        )

    def _shed(self, query: Any) -> None:
        """More wait than the loop serves. Runs in a thread of zenoh's."""
        try:
            query.reply_err(BEHIND)
        except self._owner.session.zenoh.ZError as error:  # its session has ended, or ours
            _log.debug("%s: a request could not be refused: %s", self._key, error)
        finally:
            query.drop()

    def _begin(self, query: Any, request: bytes, attachment: bytes) -> None:
        if self._closed:
            query.drop()
            return
        if len(self._tasks) >= MAX_REQUESTS:
            query.reply_err(f"{MAX_REQUESTS} calls are under way already")
            query.drop()
            return
        task = asyncio.create_task(self._serve(query, request, attachment))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

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
