"""Services of other sites, as viewers call them."""

import asyncio
from typing import TYPE_CHECKING, Final

from sern_client.endpoints.base import ServiceHandler, ServiceInfo
from sern_client.endpoints.common.calls import within
from sern_client.endpoints.foxglove import definitions
from sern_client.endpoints.foxglove.definitions import Described
from sern_client.endpoints.foxglove.server import Server
from sern_core.vocabulary.errors import ConfigError, ServiceError
from sern_core.vocabulary.types import Encoding, TopicName

if TYPE_CHECKING:
    import foxglove

CALL_S: Final = 600.0
"""A call that is not answered within so long has failed. The rule of its service usually says less."""
_THREAD_S: Final = 5.0
"""How much longer the SDK's thread waits, in case the event loop is not there any more."""


class Services:
    """Those that are served. The SDK runs each call in a thread of its own, 32 of one viewer at a time."""

    def __init__(self, server: Server) -> None:
        self._server = server
        self._served: dict[TopicName, Served] = {}

    def serve(self, info: ServiceInfo, handler: ServiceHandler) -> "Served":
        """ConfigError where viewers cannot be told of it."""
        if info.name in self._served:
            raise ConfigError(f"{info.name}: viewers have a service of that name already")
        import foxglove

        served = Served(self, info.name, info.encoding, handler)
        name, *halves = definitions.of_service(info.type_name, info.definition, info.encoding)
        request, response = (_schema(each, info.encoding) for each in halves)
        schema = foxglove.ServiceSchema(name, request=request, response=response)
        self._server.add_service(foxglove.Service(info.name, schema=schema, handler=served.answer))
        self._served[info.name] = served
        return served

    def ended(self, served: "Served") -> None:
        if self._served.get(served.name) is served:
            del self._served[served.name]
            self._server.remove_service(served.name)

    def close(self) -> None:
        for served in list(self._served.values()):
            served.close()


class Served:
    """A `ServiceServer`."""

    def __init__(self, owner: Services, name: TopicName, encoding: Encoding, handler: ServiceHandler) -> None:
        self.name = name
        self._owner = owner
        self._encoding = encoding
        self._handler = handler
        self._loop = asyncio.get_running_loop()
        self._calls: set[asyncio.Task[bytes]] = set()
        self._closed = False

    def answer(self, request: "foxglove.ServiceRequest") -> bytes:
        """Called in a thread of the SDK. What it raises is what the viewer is told."""
        if request.encoding != self._encoding:
            raise ServiceError(f"{self.name} takes requests in {self._encoding}, not in {request.encoding[:40]}")
        call = asyncio.run_coroutine_threadsafe(self._call(request.payload), self._loop)
        try:
            return call.result(CALL_S + _THREAD_S)
        except TimeoutError:
            call.cancel()
            raise ServiceError(f"{self.name} was not answered: this end of the bridge stops") from None

    async def _call(self, request: bytes) -> bytes:
        if self._closed:
            raise ServiceError(f"{self.name} is gone")
        task = asyncio.current_task()
        assert task is not None
        self._calls.add(task)
        try:
            async with within(CALL_S, f"{self.name} did not answer within {CALL_S:g} s"):
                return await self._handler(request)
        except asyncio.CancelledError:
            if not self._closed:
                raise
            raise ServiceError(f"{self.name} went while it was called") from None
        finally:
            self._calls.discard(task)

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            self._owner.ended(self)
            for task in self._calls:
                task.cancel()


def _schema(described: Described, encoding: Encoding) -> "foxglove.MessageSchema":
    import foxglove

    schema = foxglove.Schema(name=described.name, encoding=described.schema_encoding, data=described.text)
    return foxglove.MessageSchema(encoding=str(encoding), schema=schema)
