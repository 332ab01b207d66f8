"""What a stranger at the ports of a node, or in place of one, can make us hold, log and compute."""

import threading
from dataclasses import replace
from typing import Any

import pytest

from sern_client.endpoints.base import ServiceInfo
from sern_client.endpoints.ros1 import graph, server, xmlrpc
from sern_client.endpoints.ros1.frames import LENGTH
from sern_client.endpoints.ros1.xmlrpc import CallError, UnreachableError, XmlRpcClient, XmlRpcServer
from sern_core.vocabulary.types import Encoding, TopicName
from tests.sern_client.endpoints.ros1.fakes import HOST, STRING, FakeMaster, FakePublisher, frame, listening, running
from tests.sern_client.endpoints.ros1.fakes import text as string
from tests.support import until

CHAT = TopicName("/chat")
LAMP = ServiceInfo(TopicName("/lamp"), "std_srvs/srv/SetBool", Encoding.ROS1, "5" * 32)


async def echo(request: bytes) -> bytes:
    return request


@pytest.mark.parametrize("said", [LENGTH.pack(64 * 2**20), frame(b"x"), frame(b"")])
async def test_a_subscriber_that_sends_something_is_cut_off(
    master: FakeMaster, caplog: pytest.LogCaptureFixture, said: bytes
) -> None:
    async with running(master) as (endpoint, _):
        stream = endpoint.advertise(STRING)
        async with listening(endpoint, topic="/chat") as quiet, listening(endpoint, topic="/chat") as loud:
            await quiet.header()
            await loud.header()
            loud.writer.write(said)
            assert await loud.reader.read() == b""
            stream.publish(string("still here"), 0)
            assert await quiet.frame() == string("still here")
    assert "a subscriber has nothing to say" in caplog.text


async def test_a_request_that_does_not_become_complete_ends_its_connection(
    master: FakeMaster, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "REQUEST_S", 0.05)
    async with running(master) as (endpoint, _):
        endpoint.serve(LAMP, echo)
        async with (
            listening(endpoint, service="/lamp", persistent="1") as idle,
            listening(endpoint, service="/lamp", persistent="1") as slow,
        ):
            await idle.header()
            await slow.header()
            slow.writer.write(LENGTH.pack(1000) + b"x")
            assert await slow.reader.read() == b""
            (left,) = endpoint._tcpros.connections  # who asks nothing for a while is not meant
            left.frame_s = 60.0  # a busy machine must not make its request too slow
            idle.writer.write(frame(b"x" * 300_000))
            assert await idle.reader.readexactly(1) == b"\x01"
            assert await idle.frame() == b"x" * 300_000
    assert "a message that is not complete within 0.05 s" in caplog.text


@pytest.mark.parametrize("asked", [{"topic": "/chat"}, {"service": "/lamp"}])
async def test_a_complaint_shows_the_beginning_of_what_a_stranger_says(
    master: FakeMaster, caplog: pytest.LogCaptureFixture, asked: dict[str, str]
) -> None:
    long = {name: name[0] * 300_000 for name in ("callerid", "type", "md5sum")}
    async with running(master) as (endpoint, _):
        endpoint.advertise(STRING)
        endpoint.serve(LAMP, echo)
        async with listening(endpoint, **{**asked, **long}) as refused:
            error = (await refused.header())["error"]
        assert "m" * 200 in error and len(error) < 1000
        (line,) = [record.getMessage() for record in caplog.records if record.levelname == "ERROR"]
        assert line == error


async def test_a_subscriber_is_known_by_the_beginning_of_its_name(master: FakeMaster) -> None:
    async with running(master) as (endpoint, _):
        endpoint.advertise(STRING)
        async with listening(endpoint, topic="/chat", callerid="/" + "n" * 300_000) as named:
            await named.header()
            await until(endpoint.bus_links)
            (link,) = endpoint.bus_links()
            assert link.peer == "/" + "n" * 199


@pytest.mark.parametrize("name", ["type", "md5sum"])
async def test_a_publisher_with_a_field_without_end_is_not_announced(
    master: FakeMaster, caplog: pytest.LogCaptureFixture, name: str
) -> None:
    fields: dict[str, str] = {"type": "std_msgs/String", name: "a/" + "B" * 100_000}
    async with running(master) as (_, events), FakePublisher(master, **fields):
        await until(lambda: "publisher /talker: " in caplog.text)
        assert CHAT not in events.infos
    assert f"its {name} has 100002 characters" in caplog.text and len(caplog.text) < 10_000


async def test_a_service_with_a_field_without_end_is_not_announced(
    master: FakeMaster, caplog: pytest.LogCaptureFixture
) -> None:
    """Another endpoint's, for it serves whatever hash it is told."""
    async with (
        running(master) as (endpoint, events),
        running(master, "other", accept_bridged=True) as (other, seen),
    ):
        watched: Any = seen
        other.watch_services(watched)
        endpoint.serve(replace(LAMP, type_hash="5" * 100_000), echo)
        await until(lambda: "/lamp: service of /sern: its md5sum has 100000 characters" in caplog.text)
        assert LAMP.name not in seen.services and not events.services


# The node API, and the master


async def test_a_request_to_the_node_api_is_small() -> None:
    server = XmlRpcServer(lambda method, params: (1, "", len(params[0])))
    port = await server.start(HOST)
    client = XmlRpcClient(f"http://{HOST}:{port}")
    try:
        assert await client.call("length", "x" * 60_000) == 60_000
        with pytest.raises(CallError, match="HTTP 400"):
            await client.call("length", "x" * 2**16)
    finally:
        client.close()
        await server.stop()


async def test_an_answer_of_a_node_is_small() -> None:
    server = XmlRpcServer(lambda method, params: (1, "", "x" * params[0]))
    port = await server.start(HOST)
    node = XmlRpcClient(f"http://{HOST}:{port}", max_answer_bytes=xmlrpc.MAX_REQUEST_BYTES)
    master = XmlRpcClient(f"http://{HOST}:{port}")
    try:
        assert await node.call("text", 60_000) == "x" * 60_000
        with pytest.raises(UnreachableError, match="Content-Length"):
            await node.call("text", 2**16)
        assert len(await master.call("text", 2**20)) == 2**20
    finally:
        node.close()
        master.close()
        await server.stop()


async def test_a_large_state_is_read_beside_the_loop(master: FakeMaster, monkeypatch: pytest.MonkeyPatch) -> None:
    async with running(master) as (endpoint, events), FakePublisher(master) as talker:
        await until(lambda: CHAT in events.infos)
        original, threads = endpoint._master.read_state, list[tuple[bool, bool]]()

        def noted(answer: bytes) -> Any:
            threads.append((len(answer) > graph.THREAD_BYTES, threading.current_thread() is threading.main_thread()))
            return original(answer)

        monkeypatch.setattr(endpoint._master, "read_state", noted)
        for number in range(1000):
            master.add(1, f"/many/topic_{number}", "/listener", master.nodes[talker.name])
        await until(lambda: threads)
        assert threads == [(True, False)]
        endpoint.advertise(STRING)  # what is registered meanwhile is registered all the same
        await until(lambda: master.tables[0]["/chat"] == [talker.name, "/sern"] and not endpoint._graph.unlisted)
        for number in range(1000):
            master.remove(1, f"/many/topic_{number}", "/listener")
        await until(lambda: (False, True) in threads)
        assert (True, True) not in threads and (False, False) not in threads
