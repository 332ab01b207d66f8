"""However sessions and streams follow each other: others of the domain see in the end what the robot publishes."""

import pytest

from sern_client.endpoints.base import Endpoint
from sern_client.endpoints.dds.domain import DomainOptions
from sern_client.endpoints.dds.endpoint import DdsEndpoint, DdsOptions
from sern_client.endpoints.zenoh.endpoint import ZenohEndpoint
from sern_client.endpoints.zenoh.options import ZenohOptions
from sern_client.endpoints.zenoh.session import SessionOptions
from sern_core.vocabulary.types import Encoding
from sern_tools.ports import free_ports
from tests.exploring import seeds
from tests.peers.dds.peer import LEASE_S, free_domain
from tests.sern_client.sessions import Changes
from tests.support import Events, until

SEEDS = seeds(3)


def seen(changes: Changes, others: Events) -> bool:
    """What is announced at another endpoint is what the robot publishes, with its types."""
    wanted = {name: info.type_name for name, info in changes.wanted.items()}
    return {str(name): info.type_name for name, info in others.infos.items()} == wanted


async def agree(endpoint: Endpoint, events: Events, seed: int) -> None:
    """After random changes, what `events` were told of is what is wanted."""
    changes = Changes(endpoint, seed, encoding=Encoding.CDR)
    try:
        await changes.run()
        await changes.at_rest()
        await until(lambda: seen(changes, events), "the other endpoint sees what is wanted")
    finally:
        changes.close()


@pytest.mark.parametrize("seed", SEEDS)
async def test_dds(seed: int) -> None:
    domain = DomainOptions(free_domain(), localhost_only=True, lease_s=LEASE_S)
    endpoint, observer = DdsEndpoint(DdsOptions(domain)), DdsEndpoint(DdsOptions(domain, accept_bridged=True))
    events = Events()
    await endpoint.start(Events())
    await observer.start(events)
    try:
        await agree(endpoint, events, seed)
    finally:
        await observer.stop()
        await endpoint.stop()


@pytest.mark.parametrize("seed", SEEDS)
async def test_zenoh(seed: int) -> None:
    port = free_ports(1)[0]
    locator = f"tcp/127.0.0.1:{port}"
    observer = ZenohEndpoint(ZenohOptions(SessionOptions(connect=(), listen=(locator,)), 7, accept_bridged=True))
    endpoint = ZenohEndpoint(ZenohOptions(SessionOptions(connect=(locator,), listen=("tcp/127.0.0.1:0",)), 7))
    events = Events()
    await observer.start(events)
    await endpoint.start(Events())
    try:
        await agree(endpoint, events, seed)
    finally:
        await endpoint.stop()
        await observer.stop()
