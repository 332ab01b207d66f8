"""The endpoint against a master and nodes of plain sockets: what real ones do seldom, and what strangers try."""

import asyncio
import os
from dataclasses import replace
from typing import Any

import pytest

from sern_client.endpoints.base import ServiceEndpoint, ServiceInfo
from sern_client.endpoints.ros1 import Ros1Endpoint, Ros1Options
from sern_client.endpoints.ros1.frames import LENGTH
from sern_client.endpoints.ros1.header import BRIDGE_FIELD, encode_header
from sern_client.endpoints.ros1.xmlrpc import CallError, UnreachableError, XmlRpcClient, XmlRpcServer
from sern_core.vocabulary.errors import ConfigError, ServiceError, UsageError
from sern_core.vocabulary.types import DropReason, Encoding, TopicName
from sern_runtime import ros_types
from tests.sern_client.endpoints.ros1.fakes import (
    HOST,
    STRING,
    FakeMaster,
    FakePublisher,
    collect,
    frame,
    listening,
    running,
    text,
)
from tests.support import until

CHAT = TopicName("/chat")


async def test_announces_what_the_header_says_and_passes_bytes_on(master: FakeMaster) -> None:
    async with running(master) as (endpoint, events), FakePublisher(master, latching="1") as talker:
        await until(lambda: CHAT in events.infos)
        assert events.infos[CHAT] == replace(STRING, latched=True)
        got = collect(endpoint)
        await until(lambda: len(talker.writers) == 2)  # the first connection was only to learn what it is
        stream = b"".join(frame(text(f"{n}" * n)) for n in range(50))
        for at in range(0, len(stream), 13):
            talker.send(stream[at : at + 13])
        await until(lambda: len(got) == 50)
        assert got == [text(f"{n}" * n) for n in range(50)]
        assert talker.requests[-1]["md5sum"] == "*" and talker.requests[-1]["callerid"] == "/sern"
    await until(lambda: not master.tables[1].get("/chat"))  # unregistered when it stopped


async def test_a_connection_is_shown_once_its_publisher_has_accepted_it(master: FakeMaster) -> None:
    """The kernel completes a connection that a busy publisher knows nothing of yet, and it sends nothing there."""
    async with running(master) as (endpoint, events), FakePublisher(master) as talker:
        await until(lambda: CHAT in events.infos and not endpoint.bus_links())
        talker.greeting = b""
        collect(endpoint)
        await until(lambda: len(talker.writers) == 2)
        assert endpoint.bus_links() == []
        talker.send(encode_header(talker.fields))
        await until(endpoint.bus_links)
        (link,) = endpoint.bus_links()
        assert (link.direction, link.topic) == ("i", "/chat")


async def test_a_connection_that_a_publisher_refuses_is_never_shown(master: FakeMaster) -> None:
    async with running(master) as (endpoint, events), FakePublisher(master) as talker:
        await until(lambda: CHAT in events.infos and not endpoint.bus_links())
        talker.greeting = b""
        collect(endpoint)
        await until(lambda: len(talker.writers) == 2)
        talker.greeting = encode_header({"error": "no"})
        shown: list[object] = []

        def tried_again() -> bool:
            shown.extend(endpoint.bus_links())
            return len(talker.requests) >= 4

        talker.hang_up()
        await until(tried_again)
        assert shown == []


async def test_a_publisher_that_hangs_up_is_connected_again(master: FakeMaster) -> None:
    async with running(master) as (endpoint, events), FakePublisher(master) as talker:
        await until(lambda: CHAT in events.infos)
        got = collect(endpoint)
        for number in range(3):
            connections = len(talker.requests)

            def sent(number: int = number) -> bool:
                talker.send(frame(text(f"{number}")))
                return text(f"{number}") in got

            await until(sent)
            talker.hang_up()

            def returned(connections: int = connections) -> bool:
                return len(talker.requests) > connections

            await until(returned)
        assert events.removed == []  # the node lives, so its topic stays


async def test_a_dead_publisher_is_withdrawn_though_the_master_lists_it(master: FakeMaster) -> None:
    async with running(master) as (_, events):
        async with FakePublisher(master):
            await until(lambda: CHAT in events.infos)
        await until(lambda: events.removed == [CHAT])
        assert master.tables[0] == {"/chat": ["/talker"]}
        async with FakePublisher(master):  # the same name, another port
            await until(lambda: CHAT in events.infos)


@pytest.mark.parametrize(
    "greeting",
    [
        b"HTTP/1.1 400 Bad Request\r\n\r\n",
        b"\xff\xff\xff\xff",
        b"\x04\x00\x00\x00\xff\xff\xff\xff",
        encode_header({"error": "go away"}),
        encode_header({"type": "not a type", "md5sum": "x"}),
        encode_header({"type": "*", "md5sum": "*"}),
        encode_header({}),
    ],
)
async def test_hostile_publishers_are_not_announced_and_disturb_nobody(master: FakeMaster, greeting: bytes) -> None:
    async with (
        running(master) as (endpoint, events),
        FakePublisher(master, "/evil") as evil,
        FakePublisher(master, "/good") as good,
    ):
        evil.greeting = greeting
        await until(lambda: CHAT in events.infos and evil.requests)
        got = collect(endpoint)

        def sent() -> bool:
            evil.send(frame(text("evil")))
            good.send(frame(text("good")))
            return len(got) > 5

        await until(sent)
        assert set(got) == {text("good")}


async def test_another_hash_is_refused_once_with_both(master: FakeMaster, caplog: pytest.LogCaptureFixture) -> None:
    async with running(master) as (endpoint, events), FakePublisher(master, "/right"):
        await until(lambda: CHAT in events.infos)
        int32 = ros_types.topic_info("/chat", "std_msgs/msg/Int32", Encoding.ROS1)
        fields = {"type": "std_msgs/Int32", "md5sum": int32.type_hash, "message_definition": int32.definition}
        async with FakePublisher(master, "/wrong", **fields) as wrong:
            await until(lambda: endpoint.counters.mismatches == 1)
            (line,) = [r.getMessage() for r in caplog.records if r.levelname == "ERROR"]
            assert STRING.type_hash in line and int32.type_hash in line and "/wrong" in line and "/chat" in line
            # Alone, it is as good as any.
            master.remove(0, "/chat", "/right")
            await until(lambda: events.infos.get(CHAT, STRING).type_hash == int32.type_hash)
            assert events.removed == [CHAT] and wrong.requests


async def test_a_definition_that_is_not_of_its_hash_is_not_passed_on(master: FakeMaster) -> None:
    async with running(master) as (_, events), FakePublisher(master, message_definition="int32 number\n"):
        await until(lambda: CHAT in events.infos)
        assert events.infos[CHAT] == replace(STRING, definition="")


async def test_a_publisher_without_definition_is_given_the_known_one(master: FakeMaster) -> None:
    async with running(master) as (_, events), FakePublisher(master, message_definition=""):
        await until(lambda: CHAT in events.infos)
        assert events.infos[CHAT] == STRING


async def test_what_another_sern_endpoint_publishes_is_not_announced(master: FakeMaster) -> None:
    async with running(master) as (_, events), FakePublisher(master, **{BRIDGE_FIELD: "/x"}) as bridged:
        await until(lambda: bridged.requests)
        async with FakePublisher(master, "/local"):
            await until(lambda: CHAT in events.infos)
            assert len(bridged.requests) == 1  # asked once, and believed
        await until(lambda: events.removed == [CHAT])


async def test_a_chain_of_two_links_accepts_what_is_bridged(master: FakeMaster) -> None:
    async with running(master, accept_bridged=True) as (_, events), FakePublisher(master, **{BRIDGE_FIELD: "/x"}):
        await until(lambda: CHAT in events.infos)


async def test_without_a_host_we_can_be_reached(master: FakeMaster) -> None:
    async with running(master, host=None) as (endpoint, _):
        endpoint.advertise(STRING)
        async with listening(endpoint, topic="/chat") as listener:
            assert (await listener.header())["md5sum"] == STRING.type_hash
        assert endpoint.host and endpoint._master.caller_api.startswith(f"http://{endpoint.host}:")


async def test_a_slow_subscriber_loses_its_oldest_messages_and_holds_up_nobody(master: FakeMaster) -> None:
    async with running(master, queue_messages=5) as (endpoint, _):
        stream = endpoint.advertise(STRING)
        async with listening(endpoint, topic="/chat") as slow, listening(endpoint, topic="/chat") as quick:
            await slow.header()
            await quick.header()
            await until(lambda: len(endpoint.bus_links()) == 2)
            sent = [text(f"{n:08}" + "x" * 1_000_000) for n in range(40)]
            for body in sent:
                stream.publish(body, 0)
                assert await quick.frame() == body
            assert endpoint.drops[DropReason.QUEUE_FULL] > 0
            got: list[bytes] = []
            while not got or got[-1] != sent[-1]:
                got.append(await slow.frame())
            assert got == [body for body in sent if body in got]  # in order, each once
            assert got[-5:] == sent[-5:]
            assert len(got) + endpoint.drops[DropReason.QUEUE_FULL] == len(sent)


async def test_late_subscribers_get_the_last_message_of_every_stream(master: FakeMaster) -> None:
    async with running(master) as (endpoint, _):
        info = replace(STRING, latched=True)
        one, two = endpoint.advertise(info), endpoint.advertise(info)
        await until(lambda: endpoint.waited_for == 0)  # the master knows no subscriber yet
        one.publish(text("one, old"), 0)
        one.publish(text("one"), 0)
        two.publish(text("two"), 0)
        async with listening(endpoint, topic="/chat") as late:
            assert (await late.header())["latching"] == "1"
            assert [await late.frame(), await late.frame()] == [text("one"), text("two")]
        two.close()
        async with listening(endpoint, topic="/chat", md5sum=STRING.type_hash, type="std_msgs/String") as later:
            await later.header()
            one.publish(text("live"), 0)
            assert [await later.frame(), await later.frame()] == [text("one"), text("live")]
            one.publish(text("stop"), 0)
            one.close()
            assert await later.frame() == text("stop")  # written before the end is still sent
            assert await later.reader.read() == b""
        await until(lambda: not master.tables[0])


@pytest.mark.parametrize(
    ("fields", "problem"),
    [
        ({"topic": "/chat", "md5sum": "0" * 32, "type": "a/B"}, f"a/B with md5sum {'0' * 32}"),
        ({"topic": "/nowhere"}, "does not publish"),
        ({"service": "/nowhere"}, "does not serve"),
        ({}, "does not publish"),
    ],
)
async def test_refusals_say_why(master: FakeMaster, fields: dict[str, str], problem: str) -> None:
    async with running(master) as (endpoint, _):
        endpoint.advertise(STRING)
        async with listening(endpoint, **fields) as refused:
            assert problem in (await refused.header())["error"]
            assert await refused.reader.read() == b""


async def test_garbage_on_both_ports_ends_only_its_own_connection(master: FakeMaster) -> None:
    async with running(master) as (endpoint, _):
        stream = endpoint.advertise(STRING)
        async with listening(endpoint, topic="/chat") as listener:
            await listener.header()
            api = (HOST, int(endpoint._master.caller_api.rpartition(":")[2].strip("/")))
            for address in (endpoint.tcpros_address(), api):
                for garbage in (
                    b"\xff" * 100,
                    b"GET / HTTP/1.1\r\n\r\n",
                    b"POST / HTTP/1.1\r\nContent-Length: 1\r\n\r\n<",
                ):
                    reader, writer = await asyncio.open_connection(*address)
                    writer.write(garbage)
                    writer.write_eof()
                    await reader.read()
                    writer.transport.abort()
            stream.publish(text("still here"), 0)
            assert await listener.frame() == text("still here")


async def test_the_node_api_answers_as_nodes_do(master: FakeMaster) -> None:
    async with running(master) as (endpoint, events), FakePublisher(master):
        await until(lambda: CHAT in events.infos)
        endpoint.subscribe(CHAT, lambda *_: True)
        stream = endpoint.advertise(replace(STRING, name=TopicName("/back")))
        client = XmlRpcClient(endpoint._master.caller_api)
        try:
            async with listening(endpoint, topic="/back") as listener:
                await listener.header()
                stream.publish(text("x"), 0)
                await until(lambda: {link.direction for link in endpoint.bus_links()} == {"i", "o"})
                assert await client.call("getPid", "/t") == os.getpid()
                assert await client.call("getMasterUri", "/t") == master.uri
                assert await client.call("getSubscriptions", "/t") == [["/chat", "std_msgs/String"]]
                assert await client.call("getPublications", "/t") == [["/back", "std_msgs/String"]]
                rows = await client.call("getBusInfo", "/t")
                assert [row[2:6] for row in rows] == [
                    ["i", "TCPROS", "/chat", True], ["o", "TCPROS", "/back", True],
                ]  # fmt: skip
                published, subscribed, _ = await client.call("getBusStats", "/t")
                assert published[0][0] == "/back" and published[0][2][0][2] == 1 and subscribed[0][0] == "/chat"
            host, port = endpoint.tcpros_address()
            ask = ("requestTopic", "/t", "/back", [["UDPROS"], ["TCPROS"]])
            assert await client.call(*ask) == ["TCPROS", host, port]
            assert await client.call("paramUpdate", "/t", "/a", 1) == 0
            assert await client.call("publisherUpdate", "/t", "/chat", ["http://127.0.0.1:1/"]) == 0
            for wrong, said in (
                (("requestTopic", "/t", "/nowhere", [["TCPROS"]]), "not a publisher"),
                (("requestTopic", "/t", "/back", [["UDPROS"]]), "no supported protocol"),
                (("requestTopic", "/t", 5, 5), "list of protocols"),
                (("publisherUpdate", "/t", "/chat", [5]), "list of URIs"),
                (("getPid",), "caller"),
                (("getPid", "/t", "more"), "1 parameters, not 2"),
                (("noSuchThing", "/t"), "no such method"),
            ):
                with pytest.raises(CallError, match=said):
                    await client.call(*wrong)
        finally:
            client.close()


async def test_a_master_that_forgot_us_is_told_again(master: FakeMaster) -> None:
    async with running(master) as (endpoint, _):
        endpoint.advertise(STRING)
        await until(lambda: master.tables[0].get("/chat") == ["/sern"])
        master.forget()
        await until(lambda: master.tables[0].get("/chat") == ["/sern"])


async def test_an_idle_master_is_read_once(master: FakeMaster, monkeypatch: pytest.MonkeyPatch) -> None:
    async with running(master) as (endpoint, _), FakePublisher(master):
        read = 0
        original = endpoint._master.read_state

        def counted(answer: bytes) -> Any:
            nonlocal read
            read += 1
            return original(answer)

        monkeypatch.setattr(endpoint._master, "read_state", counted)
        await until(lambda: read == 1)
        polls = master.calls["getSystemState"]
        await until(lambda: master.calls["getSystemState"] > polls + 5)
        assert read == 1


async def test_a_thing_that_is_no_master_is_asked_on(caplog: pytest.LogCaptureFixture) -> None:
    server = XmlRpcServer(lambda method, params: (1, "", "what?"))
    port = await server.start(HOST)
    endpoint = Ros1Endpoint(Ros1Options(f"http://{HOST}:{port}", HOST, poll_hz=20))
    try:
        await endpoint.start(None)  # type: ignore[arg-type]  # nothing is ever announced
        await until(lambda: "does not answer like a ROS master" in caplog.text)
        assert not endpoint.connected
    finally:
        await endpoint.stop()
        await server.stop()


async def test_advertise_refuses_in_one_line(master: FakeMaster) -> None:
    async with running(master, namespace="/robot1/") as (endpoint, events):
        inside = replace(STRING, name=TopicName("/robot1/chat"))
        endpoint.advertise(inside)
        int32 = ros_types.topic_info("/robot1/chat", "std_msgs/msg/Int32", Encoding.ROS1)
        for info, problem in (
            (STRING, "outside /robot1"),
            (replace(inside, encoding=Encoding.CDR), "cdr messages cannot"),
            (replace(inside, type_hash="0" * 32), f"came with md5sum {'0' * 32}"),
            (replace(inside, type_name="a/msg/B", type_hash="", definition=""), "md5sum of a/msg/B is not known"),
            (int32, f"{STRING.type_hash}"),
        ):
            with pytest.raises(ConfigError, match=problem):
                endpoint.advertise(info)
        assert endpoint.published() == [("/chat", "std_msgs/String")]
        with pytest.raises(UsageError, match="/nothing"):
            endpoint.subscribe(TopicName("/nothing"), lambda *_: True)
        assert events.infos == {} and isinstance(endpoint, ServiceEndpoint) and not endpoint.exhausted


def test_the_environment_gives_the_defaults() -> None:
    environ = {"ROS_MASTER_URI": "http://robot:11311", "ROS_IP": "10.0.0.7"}
    endpoint = Ros1Endpoint(Ros1Options(), environ=environ)
    assert (endpoint.master_uri, endpoint.host, endpoint.caller) == ("http://robot:11311", "10.0.0.7", "/sern")
    named = Ros1Endpoint(Ros1Options("http://a:1", "b", "x/y"), environ=environ | {"ROS_HOSTNAME": "me"})
    assert (named.master_uri, named.host, named.caller) == ("http://a:1", "b", "/x/y")
    assert Ros1Endpoint(Ros1Options(), environ=environ | {"ROS_HOSTNAME": "me"}).host == "me"
    assert Ros1Endpoint(Ros1Options(), environ={}).master_uri == "http://localhost:11311"
    for options in (Ros1Options("robot"), Ros1Options(node_name="a b"), Ros1Options(node_name="1")):
        with pytest.raises(ConfigError):
            Ros1Endpoint(options, environ={})


# Services


async def test_requests_are_answered_in_turn_and_errors_are_told(master: FakeMaster) -> None:
    info = ServiceInfo(TopicName("/lamp"), "std_srvs/srv/SetBool", Encoding.ROS1, "5" * 32)
    async with running(master) as (endpoint, _):

        async def handler(request: bytes) -> bytes:
            if not request:
                raise ServiceError("nothing asked")
            return request * 2

        served = endpoint.serve(info, handler)
        with pytest.raises(ConfigError, match="served here already"):
            endpoint.serve(info, handler)
        async with listening(endpoint, service="/lamp", md5sum="5" * 32, persistent="1") as caller:
            header = await caller.header()
            assert (header["type"], header["request_type"]) == ("std_srvs/SetBool", "std_srvs/SetBoolRequest")
            caller.writer.write(frame(b"ab") + frame(b"") + frame(b"cd"))
            answers = [(await caller.reader.readexactly(1), await caller.frame()) for _ in range(3)]
            assert answers == [(b"\x01", b"abab"), (b"\x00", b"nothing asked"), (b"\x01", b"cdcd")]
        async with listening(endpoint, service="/lamp", md5sum="6" * 32) as wrong:
            assert "6" * 32 in (await wrong.header())["error"]
        async with listening(endpoint, service="/lamp") as once:
            await once.header()
            once.writer.write(frame(b"x"))
            assert await once.reader.read() == b"\x01" + frame(b"xx")  # and the connection is closed
        async with listening(endpoint, service="/lamp", persistent="1") as flood:
            await flood.header()
            flood.writer.write(LENGTH.pack(0) * 1000)
            data = await flood.reader.read()
            assert data.count(b"nothing asked") < 1000  # it does not wait for its answers: cut off
        served.close()
        async with listening(endpoint, service="/lamp") as late:
            assert "does not serve" in (await late.header())["error"]


async def test_calls_that_end_badly_say_how(master: FakeMaster) -> None:
    answers = {"/half": b"\x01\x05\x00\x00\x00ab", "/huge": b"\x01\xff\xff\xff\x7f", "/no": b"\x00" + frame(b"broken")}

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        (size,) = LENGTH.unpack(await reader.readexactly(4))
        name = (await reader.readexactly(size)).partition(b"service=")[2].partition(b"\x0a")[0][:5].decode()
        writer.write(encode_header({"callerid": "/s", "md5sum": "1", "type": "a/B"}))
        writer.write(next(data for key, data in answers.items() if name.startswith(key)))
        writer.close()

    server = await asyncio.start_server(serve, HOST, 0)
    uri = f"rosrpc://{HOST}:{server.sockets[0].getsockname()[1]}"
    try:
        async with running(master) as (endpoint, _):
            for name, problem in (
                ("/half", "ended before"), ("/huge", "2147483647 bytes"), ("/no", "broken"), ("/none", "no provider"),
            ):  # fmt: skip
                if name in answers:
                    master.services[name] = uri
                with pytest.raises(ServiceError, match=f"{name}: .*{problem}"):
                    await endpoint.call(TopicName(name), b"?", timeout_s=5)
            master.services["/closed"] = "rosrpc://127.0.0.1:1"
            with pytest.raises(ServiceError, match="connection refused"):
                await endpoint.call(TopicName("/closed"), b"?", timeout_s=5)
    finally:
        server.close()
        await server.wait_closed()


# XML-RPC


async def test_a_connection_is_kept_and_made_anew_when_it_is_gone() -> None:
    server = XmlRpcServer(lambda method, params: (1, "", [method, *params]))
    port = await server.start(HOST)
    client = XmlRpcClient(f"http://{HOST}:{port}")
    try:
        assert await client.call("echo", 1, "ä<&>", [True, 2.5]) == ["echo", 1, "ä<&>", [True, 2.5]]
        (kept,) = server.connections
        assert await asyncio.gather(*(client.call("n", n) for n in range(5))) == [["n", n] for n in range(5)]
        assert server.connections == {kept}
        kept.close()
        assert await client.call("again") == ["again"]
    finally:
        client.close()
        await server.stop()
    with pytest.raises(UnreachableError, match="connection refused"):
        await client.call("late")


async def test_a_server_that_never_answers_is_given_up() -> None:
    async def silent(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.read()
        writer.close()

    server = await asyncio.start_server(silent, HOST, 0)
    client = XmlRpcClient(f"http://{HOST}:{server.sockets[0].getsockname()[1]}", timeout_s=0.05)
    try:
        with pytest.raises(UnreachableError, match=r"no answer within 0\.05 s"):
            await client.call("hello")
    finally:
        client.close()
        server.close()
        await server.wait_closed()
