"""Nodes whose addresses nobody can resolve, and errors of ours: neither is the end of what a node offers."""

import asyncio
from collections import Counter
from typing import Any

import pytest

from sern_client.endpoints.base import Held
from sern_client.endpoints.ros1 import Ros1Endpoint, Ros1Options
from sern_client.endpoints.ros1.frames import LENGTH
from sern_client.endpoints.ros1.graph import Node
from sern_client.endpoints.ros1.header import encode_header
from sern_client.endpoints.ros1.services import Provider
from sern_client.endpoints.ros1.subscription import Source
from sern_client.endpoints.ros1.xmlrpc import CallError, split_uri
from sern_core.vocabulary.errors import ConfigError, ServiceError
from sern_core.vocabulary.types import TopicName
from tests.sern_client.endpoints.ros1.fakes import HOST, FakeMaster, FakePublisher, collect, frame, running, text
from tests.steps import steps
from tests.support import until

CHAT = TopicName("/chat")
HOSTS = (".local", "robot..local", "x" * 64, ".".join(["ä" * 40] * 20))
"""What ROS_HOSTNAME=$HOST.local gives where HOST is not set, and the like."""


@pytest.mark.parametrize("host", HOSTS)
def test_a_host_that_no_resolver_takes_is_a_call_error(host: str) -> None:
    for scheme in ("http", "rosrpc"):
        with pytest.raises(CallError, match="is no name of a host"):
            split_uri(f"{scheme}://{host}:1234/", scheme)
    with pytest.raises(ConfigError, match=r"host: .* is no name of a host"):
        Ros1Endpoint(Ros1Options(host=host), environ={})
    with pytest.raises(ConfigError, match="ROS_HOSTNAME"):
        Ros1Endpoint(Ros1Options(), environ={"ROS_HOSTNAME": host})


@pytest.mark.parametrize("uri", ["http://" + ".".join(["ä" * 40] * 700) + ":80/", "http://host:1/" + "x" * 1_000_000])
def test_a_long_address_is_not_looked_into(uri: str) -> None:
    def refused() -> None:
        with pytest.raises(CallError, match="is not http://host:port"):
            split_uri(uri)

    assert steps(refused) < 20_000


@pytest.mark.parametrize("host", HOSTS)
async def test_a_node_that_registers_with_a_good_address_is_found_again(
    master: FakeMaster, caplog: pytest.LogCaptureFixture, host: str
) -> None:
    async with FakePublisher(master) as talker:
        good, master.nodes[talker.name] = master.nodes[talker.name], f"http://{host}:1234/"
        async with running(master) as (endpoint, events):
            await until(lambda: "is no name of a host" in caplog.text)
            asked = master.calls["lookupNode"]
            await until(lambda: master.calls["lookupNode"] > asked, "it is asked for again")
            assert CHAT not in events.infos and caplog.text.count("is no name of a host") == 1
            assert endpoint.validate(Held()) == []
            master.nodes[talker.name] = good
            await until(lambda: CHAT in events.infos)


def fail_at_first(monkeypatch: pytest.MonkeyPatch, owner: type, name: str) -> None:
    """Has the method ``name`` of ``owner`` raise in its first three calls what nobody expects."""
    original = getattr(owner, name)
    failures = 3

    async def failing(self: object) -> Any:
        nonlocal failures
        if failures:
            failures -= 1
            raise KeyError("nobody expected this")
        return await original(self)

    monkeypatch.setattr(owner, name, failing)


async def test_a_publisher_that_names_a_bad_host_is_asked_again(
    master: FakeMaster, caplog: pytest.LogCaptureFixture
) -> None:
    async with FakePublisher(master) as talker:
        talker.host = HOSTS[0]
        async with running(master) as (_, events):
            await until(lambda: "/chat: publisher /talker: '.local' is no name of a host" in caplog.text)
            talker.host = HOST
            await until(lambda: CHAT in events.infos)


async def test_an_error_of_ours_does_not_end_a_publisher(
    master: FakeMaster, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    fail_at_first(monkeypatch, Source, "_session")
    async with running(master) as (endpoint, events), FakePublisher(master) as talker:
        await until(lambda: CHAT in events.infos)
        got = collect(endpoint)

        def sent() -> bool:
            talker.send(frame(text("hello")))
            return bool(got)

        await until(sent)
    assert caplog.text.count("internal error: 'nobody expected this'") == 1
    assert "KeyError" in caplog.text, "where it came from is in the log"


async def test_a_source_whose_task_has_ended_starts_anew(master: FakeMaster) -> None:
    async with running(master) as (endpoint, events), FakePublisher(master) as talker:
        await until(lambda: CHAT in events.infos)
        source = endpoint._topics["/chat"].sources[talker.name]
        task = source._task
        assert task is not None
        source.up(source.uri)
        assert source._task is task, "it lives: nothing is to be done"
        task.cancel()
        await asyncio.wait([task])
        source.up(source.uri)
        await until(lambda: CHAT in events.infos and source.fields is not None)
        assert source._task is not None and not source._task.done()


async def test_an_error_of_ours_does_not_end_the_watching_of_a_node(
    master: FakeMaster, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    fail_at_first(monkeypatch, Node, "_watch")
    async with running(master) as (_, events), FakePublisher(master):
        await until(lambda: CHAT in events.infos)
    assert caplog.text.count("/talker: the watching of this node failed") == 1


async def test_a_node_that_nobody_watches_is_named(master: FakeMaster) -> None:
    async with running(master) as (endpoint, events), FakePublisher(master) as talker:
        await until(lambda: CHAT in events.infos)
        endpoint.subscribe(CHAT, lambda *_: True)
        await until(lambda: master.tables[1].get("/chat") == ["/sern"] and not endpoint._graph.unlisted)
        held = Held(subscriptions=Counter({CHAT: 1}))
        assert endpoint.validate(held) == []
        task = endpoint._graph.nodes[talker.name]._task
        task.cancel()
        await asyncio.wait([task])
        (found,) = endpoint.validate(held)
        assert str(found) == f"/talker at {master.uri} is not watched any more"


async def test_services_at_a_bad_host_are_probed_again_and_calls_say_why(
    master: FakeMaster, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sern_client.endpoints.ros1.services.PROBE_AGAIN_S", (0.02, 0.02))
    original = Provider._probe
    failures = 2

    async def failing(self: Provider) -> dict[str, str]:
        nonlocal failures
        if failures:
            failures -= 1
            raise KeyError("nobody expected this")
        return await original(self)

    monkeypatch.setattr(Provider, "_probe", failing)

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        (size,) = LENGTH.unpack(await reader.readexactly(4))
        await reader.readexactly(size)
        writer.write(encode_header({"callerid": "/talker", "md5sum": "1" * 32, "type": "std_srvs/SetBool"}))
        await reader.read()
        writer.close()

    server = await asyncio.start_server(serve, HOST, 0)
    port = server.sockets[0].getsockname()[1]
    try:
        async with FakePublisher(master) as talker, running(master) as (endpoint, events):
            master.services["/lamp"] = f"rosrpc://{HOSTS[1]}:{port}"
            master.add(2, "/lamp", talker.name, master.nodes[talker.name])
            watched: Any = events
            endpoint.watch_services(watched)
            await until(lambda: "/lamp: service of /talker: 'robot..local' is no name of a host" in caplog.text)
            assert caplog.text.count("internal error: 'nobody expected this'") == 1
            with pytest.raises(ServiceError, match=r"/lamp: 'robot\.\.local' is no name of a host"):
                await endpoint.call(TopicName("/lamp"), b"", timeout_s=5)
            assert TopicName("/lamp") not in events.services
            master.services["/lamp"] = f"rosrpc://{HOST}:{port}"
            await until(lambda: TopicName("/lamp") in events.services)
    finally:
        server.close()
        await server.wait_closed()
