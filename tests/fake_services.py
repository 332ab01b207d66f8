"""An endpoint with services under the test's hand, and no topics."""

import asyncio
from collections.abc import Awaitable, Callable

from sern_client.endpoints.base import (
    Difference,
    Held,
    Publisher,
    ServiceEvents,
    ServiceHandler,
    ServiceInfo,
    Sink,
    Subscription,
    TopicEvents,
)
from sern_core.vocabulary.errors import ConfigError, ServiceError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding, TopicName


class Served:
    def __init__(self, services: "Services", info: ServiceInfo, handler: ServiceHandler) -> None:
        self.services = services
        self.info = info
        self.handler = handler

    def close(self) -> None:
        del self.services.served[self.info.name]


class Services:
    """`answer` is what a call of a service of its own does, `refuse` why it serves nothing of others."""

    def __init__(self) -> None:
        self.served: dict[TopicName, Served] = {}
        self.calls: list[tuple[TopicName, bytes]] = []
        self.answer: Callable[[bytes], Awaitable[bytes]] = self.echo
        self.refuse = ""
        self.definitions: dict[str, str] = {}
        self.exhausted = False
        self.encoding: Encoding | None = None
        self.events: ServiceEvents | None = None

    async def echo(self, request: bytes) -> bytes:
        return b"re: " + request

    async def start(self, events: TopicEvents) -> None:
        del events

    async def stop(self) -> None:
        assert not self.served, "what was served must be withdrawn before the endpoint stops"

    def subscribe(self, name: TopicName, sink: Sink) -> Subscription:
        raise AssertionError(f"no topic {name} here, {sink}")

    def advertise(self, info: TopicInfo) -> Publisher:
        raise ConfigError(f"{info.name}: no topics here")

    def validate(self, held: Held) -> list[Difference]:
        del held
        return []

    def interest(self, name: TopicName, wanted: bool) -> None:
        raise AssertionError(f"no topic {name} here, {wanted}")

    def watch_services(self, events: ServiceEvents) -> None:
        self.events = events

    def service_definition(self, type_name: str, encoding: Encoding) -> str | None:
        del encoding
        return self.definitions.get(type_name)

    async def call(self, name: TopicName, request: bytes, *, timeout_s: float) -> bytes:
        self.calls.append((name, request))
        try:
            async with asyncio.timeout(timeout_s):
                return await self.answer(request)
        except TimeoutError:
            raise ServiceError(f"{name} took too long") from None

    def serve(self, info: ServiceInfo, handler: ServiceHandler) -> Served:
        if self.refuse:
            raise ConfigError(self.refuse)
        self.served[info.name] = Served(self, info, handler)
        return self.served[info.name]
