"""However sessions and streams follow each other: in the end what is published here is what the robot publishes."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from random import Random
from typing import Any

import pytest

from sern_client.endpoints.composite import CompositeEndpoint
from sern_client.endpoints.rclpy import RclpyEndpoint, RclpyOptions
from sern_client.endpoints.record import RecordEndpoint, RecordOptions
from sern_client.endpoints.ros1 import Ros1Endpoint, Ros1Options
from sern_client.endpoints.ros1.xmlrpc import XmlRpcClient
from sern_client.endpoints.synthetic import SyntheticEndpoint, SyntheticOptions
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_types
from tests.exploring import seeds
from tests.sern_client.endpoints.ros1.fakes import HOST, FakeMaster
from tests.sern_client.endpoints.test_rclpy import Graph, graph
from tests.sern_client.sessions import Changes
from tests.support import Events, until

SEEDS = seeds(6)

__all__ = ["graph"]


@asynccontextmanager
async def started(endpoint: Any) -> AsyncIterator[Any]:
    await endpoint.start(Events())
    try:
        yield endpoint
    finally:
        await endpoint.stop()


@asynccontextmanager
async def changed(endpoint: Any, seed: int, encoding: Encoding) -> AsyncIterator[Changes]:
    """After random changes, at rest."""
    changes = Changes(endpoint, seed, encoding=encoding)
    try:
        await changes.run()
        await changes.at_rest()
        yield changes
    finally:
        changes.close()


def at_the_master(endpoint: Ros1Endpoint, master: FakeMaster, changes: Changes) -> bool:
    """What everybody there sees: the table of publishers, their types, and what the node says of itself."""
    types = {name: ros_types.ros1_name(info.type_name) for name, info in changes.wanted.items()}
    return (
        master.tables[0] == {name: ["/sern"] for name in types}
        and {name: master.types[name] for name in types} == types
        and dict(endpoint.published()) == types
    )


@pytest.mark.parametrize("slow", [False, True])
@pytest.mark.parametrize("seed", SEEDS)
async def test_ros1(master: FakeMaster, seed: int, slow: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if slow:
        delays, request = Random(seed), XmlRpcClient.request

        async def late(client: XmlRpcClient, method: str, *params: Any) -> bytes:
            await asyncio.sleep(delays.choice((0.0, 0.001, 0.02)))
            answer = await request(client, method, *params)
            await asyncio.sleep(delays.choice((0.0, 0.001, 0.02)))
            return answer

        monkeypatch.setattr(XmlRpcClient, "request", late)
    master.add(1, "/robot/t0", "/listener", "http://127.0.0.1:1/")  # one that is known and never connects
    options = Ros1Options(master_uri=master.uri, host=HOST, node_name="sern", poll_hz=50.0)
    async with (
        started(Ros1Endpoint(options, environ={})) as endpoint,
        changed(endpoint, seed, Encoding.ROS1) as changes,
    ):
        await until(lambda: at_the_master(endpoint, master, changes), "the master has what is wanted")


@pytest.mark.parametrize("seed", SEEDS)
async def test_rclpy(graph: Graph, seed: int) -> None:
    async with started(RclpyEndpoint(RclpyOptions(poll_hz=50.0))) as endpoint:
        async with changed(endpoint, seed, Encoding.CDR) as changes:
            wanted = {name: [info.type_name] for name, info in changes.wanted.items()}
            await until(lambda: graph.types() == wanted, "those that have ended have written their first messages")
        await until(lambda: not graph.publishers)


@pytest.mark.parametrize("seed", SEEDS)
async def test_record(tmp_path: Path, seed: int) -> None:
    async with started(RecordEndpoint(RecordOptions(tmp_path / "all"))) as endpoint:
        async with changed(endpoint, seed, Encoding.ROS1) as changes:
            assert +endpoint.publishers == dict.fromkeys(changes.wanted, 1)
        assert not +endpoint.publishers


@pytest.mark.parametrize("seed", SEEDS)
async def test_several_at_once(tmp_path: Path, master: FakeMaster, seed: int) -> None:
    ros1 = Ros1Endpoint(Ros1Options(master_uri=master.uri, host=HOST, node_name="sern", poll_hz=50.0), environ={})
    recorder = RecordEndpoint(RecordOptions(tmp_path / "all"))
    synthetic = SyntheticEndpoint(SyntheticOptions(role="operator"))
    async with started(CompositeEndpoint([ros1, recorder, synthetic])) as endpoint:
        async with changed(endpoint, seed, Encoding.ROS1) as changes:
            await until(lambda: at_the_master(ros1, master, changes), "the master has what is wanted")
            assert +recorder.publishers == dict.fromkeys(changes.wanted, 1)
        assert not +recorder.publishers
