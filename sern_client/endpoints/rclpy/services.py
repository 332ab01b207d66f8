"""Services through rclpy, both ways. Those of an action are services with types of their own.

Bodies cross as bytes; rclpy wants objects, so each request and response is read once. rclpy answers a call when its
callback returns. Ours has the answer later: it returns a `_Later`, for which `send_response` of the service is not
called before there is one. A coroutine in its place would be resumed again and again while it waits.
"""

import asyncio
import itertools
import logging
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

from sern_client.endpoints.base import ServiceEvents, ServiceHandler, ServiceInfo
from sern_client.endpoints.common.calls import PendingCalls, Tasks, within
from sern_client.endpoints.common.saying import SayOnce
from sern_client.endpoints.rclpy.domain import Domain, refused
from sern_client.endpoints.rclpy.graph import EVERY, Graph
from sern_client.endpoints.rclpy.interfaces import Interfaces
from sern_core.vocabulary.errors import ConfigError, ServiceError, UsageError
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import ros_types

if TYPE_CHECKING:
    from rclpy.client import Client
    from rclpy.task import Future

MATCH_POLL_S: Final = 0.005
"""How often a call that waits for its server looks whether it is there: rclpy has no sign of it."""
AGAIN: Final = 20
"""One look in so many asks nodes for their services though all seems to be as it was."""
MAX_CALLS: Final = 100
"""Calls of one service under way here at a time; more are not answered."""

_log = logging.getLogger(__name__)


class Services:
    """The services of one domain, of its nodes and of ours."""

    def __init__(self, domain: Domain, graph: Graph, interfaces: Interfaces, say_once: SayOnce) -> None:
        self.refused = 0
        """Requests that were not answered because too many were under way."""
        self._domain = domain
        self._graph = graph
        self._interfaces = interfaces
        self._say_once = say_once
        self._events: ServiceEvents | None = None
        self._known: dict[TopicName, ServiceInfo] = {}
        self._clients: dict[TopicName, _Client] = {}
        self._servers: dict[TopicName, _Server] = {}
        self._seen: object = None
        self._looks = 0
        self._unnamed = False
        """Whether the node of some service is not known yet, and so not whose it is."""

    def watch(self, events: ServiceEvents) -> None:
        self._events = events
        for info in self._known.values():
            events.service_added(info)

    def look(self) -> None:
        """Tell of services that came and went; whose they are is asked only when something is not as it was."""
        there = sorted(self._domain.node.get_service_names_and_types())
        seen = (there, self._graph.nodes, sorted(self._servers))
        self._looks += 1
        if seen == self._seen and self._looks % (EVERY if self._unnamed else AGAIN):
            return
        found, named = self._graph.services()
        self._seen = seen
        self._unnamed = any(name not in named for name, _ in there)
        for name, info in list(self._known.items()):
            if info.type_name not in found.get(name, {}):
                self._gone(name)
        for name, types in found.items():
            if name not in self._known:
                self._found(name, types)

    def _found(self, name: TopicName, types: dict[str, str]) -> None:
        type_name, node = next(iter(types.items()))
        if name in self._servers:
            self._say_once(f"service {name} of {node} is left alone: it is served here from the far side")
            return
        definition = type_hash = ""
        try:
            definition, type_hash = self._interfaces.service_text(type_name)
        except ConfigError as error:
            if self._events is None or self._events.wants_service(name):
                self._say_once(f"service {name} of {node}: {error}")
        info = self._known[name] = ServiceInfo(name, type_name, Encoding.CDR, type_hash, definition)
        if self._events is not None:
            self._events.service_added(info)

    def _gone(self, name: TopicName) -> None:
        del self._known[name]
        client = self._clients.pop(name, None)
        if client is not None:
            client.close(f"{name}: the service is gone")
        if self._events is not None:
            self._events.service_removed(name)

    def domain_ended(self) -> None:
        """Nothing is called or served any more."""
        self._seen = None
        for name in list(self._known):
            self._gone(name)

    async def stop(self) -> None:
        servers = list(self._servers.values())
        for server in servers:
            server.close()
        for name, client in self._clients.items():
            client.close(f"{name}: this endpoint stops")
        self._clients.clear()
        for server in servers:
            await server.ended()

    # --- calls ------------------------------------------------------------------------------------------------------

    async def call(self, name: TopicName, request: bytes, *, timeout_s: float) -> bytes:
        """ServiceError when there is no such service, or no answer in time."""
        info = self._known.get(name)
        if info is None:
            raise ServiceError(f"{name}: no such service in {self._domain.name}")
        client = self._clients.get(name)
        if client is None:
            try:
                client = self._clients[name] = _Client(self._domain, self._interfaces, info)
            except ConfigError as error:
                raise ServiceError(str(error)) from None
        async with within(timeout_s, f"{name}: no answer within {timeout_s:g} s"):
            return await client.call(request)

    # --- what is served ---------------------------------------------------------------------------------------------

    def serve(self, info: ServiceInfo, handler: ServiceHandler) -> "_Server":
        """ConfigError when the type is not installed or is another version, or a node here has the service."""
        if info.encoding is not Encoding.CDR:
            raise ConfigError(f"service {info.name}: {info.encoding} bodies cannot be served in ROS 2")
        if info.name in self._servers:
            raise UsageError(f"service {info.name} is served already")
        if info.name in self._known:
            raise ConfigError(f"service {info.name}: a node here serves it already")
        if not self._domain.alive:
            raise ConfigError(f"service {info.name}: {self._domain.problem}")
        _, type_hash = self._interfaces.service_text(info.type_name)
        if info.type_hash and type_hash and info.type_hash != type_hash:
            raise ConfigError(
                f"service {info.name}: {info.type_name} came with hash {info.type_hash}, but this installation has "
                f"{type_hash}; both sides need the same version of the type"
            )
        server = self._servers[info.name] = _Server(self, self._domain, self._interfaces, info, handler)
        return server

    def forget(self, server: "_Server") -> None:
        if self._servers.get(server.name) is server:
            del self._servers[server.name]

    def refuse(self, server: "_Server") -> None:
        """A request is not answered: too many are under way."""
        self.refused += 1
        self._say_once(f"service {server.name}: more than {MAX_CALLS} calls at a time; some fail")


class _Client:
    """Calls of one service here. ConfigError where rclpy gives no client."""

    def __init__(self, domain: Domain, interfaces: Interfaces, info: ServiceInfo) -> None:
        self._domain = domain
        self._name = info.name
        self._type = interfaces.service(info.name, info.type_name)
        self._closed = ""
        self._calls = itertools.count(1)
        self._pending = PendingCalls()
        with refused(f"{info.name}: rclpy gives no client"):
            self._client: Client = domain.node.create_client(self._type, info.name)

    async def call(self, body: bytes) -> bytes:
        from rclpy.serialization import deserialize_message, serialize_message

        try:
            with refused(f"{self._name}: the request cannot be read"):
                request = deserialize_message(body, self._type.Request)
        except ConfigError as error:
            raise ServiceError(str(error)) from None
        while not self._ready():  # noqa: ASYNC110  (rclpy has nothing to wait for)
            await asyncio.sleep(MATCH_POLL_S)
        handover, number = self._domain.handover, next(self._calls)

        def done(future: "Future") -> None:  # in the thread that executes callbacks
            try:
                response = serialize_message(future.result())
            except Exception as error:  # noqa: BLE001  (told to the caller)
                problem = f"{self._name}: the answer cannot be read: {ros_types.one_line(error)}"
                handover.news(lambda: self._pending.fail(number, problem))
            else:
                handover.news(lambda: self._pending.answer(number, response))

        with self._pending.call(number) as answer:
            asked = self._client.call_async(request)
            asked.add_done_callback(done)
            try:
                return await answer
            finally:
                if not asked.done():
                    self._client.remove_pending_request(asked)

    def close(self, problem: str) -> None:
        """Calls under way fail with this."""
        self._closed = problem
        self._pending.fail_all(problem)
        if self._domain.alive:
            self._domain.node.destroy_client(self._client)

    def _ready(self) -> bool:
        if self._closed:
            raise ServiceError(self._closed)
        return self._client.service_is_ready()


class _Later:
    """Stands for the answer of one call, until `header` is known to whoever has it."""

    def __init__(self, began: "Callable[[Any], None]") -> None:
        self.began = began


class _Server:
    """A service of the far side that is served here."""

    def __init__(
        self, owner: Services, domain: Domain, interfaces: Interfaces, info: ServiceInfo, handler: ServiceHandler
    ) -> None:
        self.name = info.name
        self._owner = owner
        self._domain = domain
        self._handler = handler
        self._type = interfaces.service(info.name, info.type_name)
        self._tasks = Tasks(MAX_CALLS)
        self._closed = False
        with refused(f"{info.name}: rclpy gives no service"):
            self._service = domain.node.create_service(self._type, info.name, self._asked)
        self._respond = self._service.send_response
        self._service.send_response = self._send

    def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        self._owner.forget(self)
        # A call that has just been told that it fails may still have an answer to give.
        asyncio.get_running_loop().call_soon(self._end)

    async def ended(self) -> None:
        await asyncio.sleep(0)
        await self._tasks.ended()

    def _end(self) -> None:
        self._tasks.cancel()
        if self._domain.alive:
            self._domain.node.destroy_service(self._service)

    # In the thread that executes callbacks

    def _asked(self, request: Any, response: Any) -> Any:
        from rclpy.serialization import serialize_message

        del response
        body = serialize_message(request)
        handover = self._domain.handover
        return _Later(lambda header: handover.put(lambda: self._begin(body, header), len(body)))

    def _send(self, response: Any, header: Any) -> None:
        if isinstance(response, _Later):
            response.began(header)
        else:
            self._respond(response, header)

    # On the event loop

    def _begin(self, body: bytes, header: Any) -> None:
        if self._closed:
            return
        if self._tasks.full:
            self._owner.refuse(self)
        else:
            self._tasks.begin(self._answer(body, header))

    async def _answer(self, body: bytes, header: Any) -> None:
        from rclpy.serialization import deserialize_message

        try:
            answer = await self._handler(body)
        except ServiceError as error:
            # ROS 2 has no way to say so: the caller's own timeout ends its call.
            _log.warning("service %s: a call fails without an answer: %s", self.name, error)
            return
        if not self._domain.alive:
            return
        try:
            self._respond(deserialize_message(answer, self._type.Response), header)
        except Exception as error:  # noqa: BLE001  (of one answer)
            _log.error("service %s: an answer could not be given: %s", self.name, ros_types.one_line(error))
