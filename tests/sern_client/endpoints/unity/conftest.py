"""A running endpoint on a free port."""

from collections.abc import AsyncIterator, Awaitable, Callable

import pytest

from sern_client.endpoints.unity.endpoint import UnityEndpoint
from sern_client.endpoints.unity.options import UnityOptions
from sern_tools.ports import free_ports
from tests.sern_client.endpoints.unity.scene import FakeViewed
from tests.support import Events

Started = Callable[..., Awaitable[UnityEndpoint]]


@pytest.fixture
def viewed() -> FakeViewed:
    return FakeViewed()


@pytest.fixture
def port() -> int:
    return next(iter(free_ports(1)))


@pytest.fixture
async def started(port: int, events: Events, viewed: FakeViewed) -> AsyncIterator[Started]:
    """`await started(protocol=...)`: an endpoint with these options, which ends with the test."""
    running: list[UnityEndpoint] = []

    async def start(**given: object) -> UnityEndpoint:
        given.setdefault("publish", ("/.*",))
        endpoint = UnityEndpoint(UnityOptions(listen=f"127.0.0.1:{port}", **given))  # type: ignore[arg-type]
        endpoint.use_viewed(viewed)
        endpoint.watch_services(events)
        await endpoint.start(events)
        running.append(endpoint)
        return endpoint

    yield start
    for endpoint in running:
        await endpoint.stop()
