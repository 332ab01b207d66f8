"""Peers, endpoints and recorders for the tests of ROS 2 over DDS."""

from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("cyclonedds", reason="the dds endpoint needs cyclonedds: pip install cyclonedds==11.0.1")

from sern_client.endpoints.dds.domain import DomainOptions
from sern_client.endpoints.dds.endpoint import DdsEndpoint, DdsOptions
from tests.peers.dds.peer import LEASE_S, Peer, build_peer, free_domain
from tests.support import Events


class Recorder(Events):
    """And a sink that keeps everything."""

    def __init__(self) -> None:
        super().__init__()
        self.got: list[tuple[bytes, int]] = []
        self.accepts = True

    def sink(self, body: bytes, stamp_ns: int) -> bool:
        self.got.append((body, stamp_ns))
        return self.accepts


MakePeer = Callable[..., Coroutine[Any, Any, Peer]]
MakeEndpoint = Callable[..., Coroutine[Any, Any, tuple[DdsEndpoint, Recorder]]]


@pytest.fixture(scope="session")
def peer_program() -> Path:
    return build_peer()


@pytest.fixture
def domain() -> int:
    return free_domain()


@pytest.fixture
def other_domain() -> int:
    """One more, for the other side of a link."""
    return free_domain()


@pytest.fixture
async def stack() -> AsyncIterator[AsyncExitStack]:
    async with AsyncExitStack() as stack:
        yield stack


@pytest.fixture
def make_peer(peer_program: Path, stack: AsyncExitStack) -> MakePeer:
    """`await make_peer(domain, **options)`: a peer that ends with the test."""

    async def make(domain: int, **options: Any) -> Peer:
        return await stack.enter_async_context(Peer(peer_program, domain, **options))

    return make


@pytest.fixture
def make_endpoint(stack: AsyncExitStack) -> MakeEndpoint:
    """`await make_endpoint(domain, **options)`: a started endpoint and its recorder."""

    async def make(domain: int, **options: Any) -> tuple[DdsEndpoint, Recorder]:
        settings = DomainOptions(domain, localhost_only=True, lease_s=LEASE_S)
        endpoint, recorder = DdsEndpoint(DdsOptions(settings, **options)), Recorder()
        endpoint.watch_services(recorder)
        await endpoint.start(recorder)
        stack.push_async_callback(endpoint.stop)
        return endpoint, recorder

    return make
