"""The zenoh endpoint with a router and an independent ROS 2 implementation over zenoh, zenoh-ros2-sdk, as its peer."""

import asyncio
import json
import sys
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any, Self

import pytest

from sern_client.endpoints.base import Endpoint, Held, ServiceEndpoint, ServiceInfo
from sern_client.endpoints.common import first_messages
from sern_client.endpoints.zenoh import names
from sern_client.endpoints.zenoh.endpoint import ZenohEndpoint
from sern_client.endpoints.zenoh.options import ZenohOptions
from sern_client.endpoints.zenoh.session import SessionOptions
from sern_core.vocabulary.errors import ConfigError, ServiceError, UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import ros_services, ros_types
from sern_tools.ports import free_ports
from tests.daemons import Lab, bodies, endpoint_of, under, write_bag
from tests.support import DEADLINE_S, Events, Patience, until

zenoh = pytest.importorskip("zenoh", reason="the library eclipse-zenoh is missing: pip install eclipse-zenoh")
pytest.importorskip("zenoh_ros2_sdk", reason="the peer zenoh-ros2-sdk is missing: pip install zenoh-ros2-sdk")

DOMAIN = 7
CHAT = TopicName("/robot/chatter")
MODE, OTHER_MODE = TopicName("/set_mode"), TopicName("/other_mode")


def text(data: str) -> bytes:
    return ros_types.serialise(
        ros_types.new("std_msgs/msg/String", Encoding.CDR, data=data), "std_msgs/msg/String", Encoding.CDR
    )


def chat(**fields: Any) -> TopicInfo:
    return ros_types.topic_info(CHAT, "std_msgs/msg/String", Encoding.CDR, **fields)


class Router:
    """What rmw_zenohd is for ROS 2 nodes: they find each other through it."""

    def __init__(self) -> None:
        self.port = free_ports(1)[0]
        self.session: Any = None

    def start(self) -> None:
        config = zenoh.Config()
        config.insert_json5("mode", '"router"')
        config.insert_json5("listen/endpoints", f'["tcp/127.0.0.1:{self.port}"]')
        config.insert_json5("scouting/multicast/enabled", "false")
        self.session = zenoh.open(config)

    def stop(self) -> None:
        if self.session is not None:
            self.session.close()
            self.session = None

    @property
    def locator(self) -> str:
        return f"tcp/127.0.0.1:{self.port}"

    @property
    def options(self) -> SessionOptions:
        return SessionOptions(connect=(self.locator,), listen=("tcp/127.0.0.1:0",))


class Peer:
    """The process of tests/peers/zenoh_peer.py."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self.process = process
        self.got: list[tuple[str, str]] = []
        self._answers: asyncio.Queue[dict[str, Any]] = asyncio.Queue()
        self._reader = asyncio.create_task(self._read())

    @classmethod
    async def start(cls, port: int) -> Self:
        program = Path(__file__).with_name("zenoh_peer.py")
        return cls(
            await asyncio.create_subprocess_exec(
                sys.executable, str(program), str(port), str(DOMAIN),
                stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE,
            )
        )  # fmt: skip

    async def _read(self) -> None:
        assert self.process.stdout is not None
        async for line in self.process.stdout:
            said = json.loads(line)
            if "got" in said:
                self.got.append((said["got"], said["data"]))
            else:
                await self._answers.put(said)
        await self._answers.put({"done": False})

    async def do(self, what: str, **order: Any) -> dict[str, Any]:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps({"do": what, **order}).encode() + b"\n")
        async with asyncio.timeout(60):
            answer = await self._answers.get()
        assert answer["done"], f"the peer ended with {self.process.returncode}"
        return answer

    async def sees(self, kind: str, name: str, *, there: bool = True) -> None:
        """Wait until the peer's own graph has it, or not: it asks for what is latched, and calls services, once."""
        async with asyncio.timeout(60):
            while (await self.do("sees", kind=kind, name=name.replace("/", "%")))["sees"] is not there:
                pass

    async def kill(self) -> None:
        if self.process.returncode is None:
            self.process.kill()
        await self.process.wait()
        await self._reader


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """A subscriber that a busy machine lets connect late misses nothing."""
    monkeypatch.setattr(first_messages, "FIRST_MESSAGES_S", DEADLINE_S)


@pytest.fixture
async def router() -> AsyncIterator[Router]:
    made = Router()
    made.start()
    yield made
    made.stop()


@pytest.fixture
async def endpoint(router: Router) -> AsyncIterator[tuple[ZenohEndpoint, Events]]:
    made, events = ZenohEndpoint(ZenohOptions(router.options, DOMAIN)), Events()
    made.watch_services(events)
    await made.start(events)
    yield made, events
    await made.stop()


@pytest.fixture
async def peer(router: Router) -> AsyncIterator[Peer]:
    made = await Peer.start(router.port)
    yield made
    await made.kill()


def test_is_an_endpoint_with_services() -> None:
    endpoint: Endpoint = ZenohEndpoint(ZenohOptions())
    assert isinstance(endpoint, ServiceEndpoint)


async def test_a_node_is_heard_while_it_publishes(endpoint: tuple[ZenohEndpoint, Events], peer: Peer) -> None:
    ours, events = endpoint
    told = await peer.do("publisher", name=CHAT)
    await until(lambda: CHAT in events.infos, "the topic is announced")
    info = events.infos[CHAT]
    assert info == chat(reliable=True), "name, type, definition, and the hash that the peer worked out by itself"
    assert info.type_hash == told["hash"]

    got: list[bytes] = []

    def take(body: bytes, _stamp_ns: int) -> bool:
        got.append(body)
        return True

    subscription = ours.subscribe(CHAT, take)

    async def heard() -> None:
        number = 0
        while not got:  # until the subscription has reached the peer
            await peer.do("publish", name=CHAT, data=f"hello {(number := number + 1)}")
            await asyncio.sleep(0)
        assert got[0].startswith(text("hello ")[:4])

    await asyncio.wait_for(heard(), DEADLINE_S)
    first = len(got)
    for number in range(50):
        await peer.do("publish", name=CHAT, data=f"number {number}")
    await until(lambda: text("number 49") in got, "all arrive")
    assert [body for body in got[first:] if b"number" in body] == [text(f"number {number}") for number in range(50)]

    subscription.close()
    await peer.do("close", thing="pub" + CHAT)
    await until(lambda: CHAT not in events.infos, "the topic has ended")


async def test_a_topic_that_nobody_wants_has_no_subscriber(endpoint: tuple[ZenohEndpoint, Events], peer: Peer) -> None:
    ours, events = endpoint
    await peer.do("publisher", name=CHAT)
    await until(lambda: CHAT in events.infos, "the topic is announced")
    got: list[bytes] = []

    def take(body: bytes, _stamp_ns: int) -> bool:
        got.append(body)
        return True

    ours.subscribe(CHAT, take)
    await peer.sees("MS", CHAT)
    ours.interest(CHAT, False)
    await peer.sees("MS", CHAT, there=False)
    await peer.do("publish", name=CHAT, data="unwanted")
    await peer.do("publisher", name="/later")
    await until(lambda: "/later" in events.infos, "told after what was published")
    assert CHAT in events.infos and got == []
    ours.interest(CHAT, True)
    await peer.sees("MS", CHAT)

    async def heard() -> None:
        while not got:  # until the subscriber has reached the peer
            await peer.do("publish", name=CHAT, data="wanted")

    await asyncio.wait_for(heard(), DEADLINE_S)
    assert set(got) == {text("wanted")}


async def test_what_is_published_here_reaches_a_node(endpoint: tuple[ZenohEndpoint, Events], peer: Peer) -> None:
    ours, events = endpoint
    publisher = ours.advertise(chat())
    await peer.do("subscriber", name=CHAT)

    async def heard() -> None:
        while not peer.got:
            publisher.publish(text("hello"), 1)
            await until(lambda: not publisher.waits, "first messages wait no more")  # only so many may
            await asyncio.sleep(0.01)

    await asyncio.wait_for(heard(), DEADLINE_S)
    for number in range(50):
        publisher.publish(text(f"number {number}"), number)
    await until(lambda: (CHAT, "number 49") in peer.got, "all arrive")
    assert [data for _, data in peer.got if data.startswith("number")] == [f"number {number}" for number in range(50)]
    assert events.infos == {}, "our own publisher is not announced to us"
    publisher.close()
    assert ours.drops == {}


async def test_the_first_messages_wait_for_the_subscribers_there_are(
    endpoint: tuple[ZenohEndpoint, Events], peer: Peer
) -> None:
    ours, _ = endpoint
    await peer.do("subscriber", name=CHAT)
    kind = names.dds_type("std_msgs/msg/String"), chat().type_hash
    await until(lambda: ours.readers(CHAT, *kind), "the subscriber is known")
    for number in range(3):  # each time a stream of a moment
        publisher = ours.advertise(chat())
        for letter in "abc":
            publisher.publish(text(f"{number}{letter}"), 1)
        publisher.close()
    await until(lambda: len(peer.got) == 9, "all arrive")
    got = " ".join(data for _, data in peer.got)
    for number in range(3):  # in order within each: between two publishers there is none
        assert [word[1] for word in got.split() if word[0] == str(number)] == ["a", "b", "c"], got
    assert ours.drops == {} and ours.validate(Held()) == []


async def test_late_joiners_get_what_is_latched(endpoint: tuple[ZenohEndpoint, Events], peer: Peer) -> None:
    ours, events = endpoint
    name = TopicName("/map")  # the peer looks for latched topics of one part only
    publisher = ours.advertise(ros_types.topic_info(name, "std_msgs/msg/String", Encoding.CDR, latched=True))
    publisher.publish(text("map"), 1)
    static = TopicName("/static")
    await peer.do("publisher", name=static, latched=True, depth=1)
    await until(lambda: static in events.infos, "announced")
    assert events.infos[static].latched and events.infos[static].reliable
    await peer.sees("MP", name)
    async with asyncio.timeout(60):
        while (
            not peer.got
        ):  # it asks just once, when it is made, and its first direct connection to us may be under way
            await peer.do("subscriber", name=name, latched=True)
    assert set(peer.got) == {(name, "map")}
    publisher.close()


async def test_a_late_site_gets_what_another_site_latched(router: Router) -> None:
    first, second = (ZenohEndpoint(ZenohOptions(router.options, DOMAIN, accept_bridged=True)) for _ in range(2))
    nothing, events = Events(), Events()
    await first.start(nothing)
    await second.start(events)
    try:
        publisher = first.advertise(chat(latched=True))
        publisher.publish(text("one"), 7)
        publisher.publish(text("two"), 8)
        await until(lambda: CHAT in events.infos, "announced")
        got: list[tuple[bytes, int]] = []

        def take(body: bytes, stamp_ns: int) -> bool:
            got.append((body, stamp_ns))
            return True

        second.subscribe(CHAT, take)
        await until(lambda: len(got) == 2, "what was published before is there, with its stamps")
        assert got == [(text("one"), 7), (text("two"), 8)]
    finally:
        await first.stop()
        await second.stop()


async def test_what_came_over_a_link_is_not_taken(router: Router, peer: Peer) -> None:
    """Two SERN endpoints side by side: of a topic that a node has too, only the node's messages are taken."""
    ours, chained, theirs = (
        ZenohEndpoint(ZenohOptions(router.options, DOMAIN, name, accept_bridged=name == "chained"))
        for name in ("ours", "chained", "theirs")
    )
    events, all_events = Events(), Events()
    async with AsyncExitStack() as stack:
        for endpoint, heard in ((ours, events), (chained, all_events), (theirs, Events())):
            endpoint.watch_services(heard)
            await endpoint.start(heard)
            stack.push_async_callback(endpoint.stop)
        publisher = theirs.advertise(chat())
        await until(lambda: CHAT in all_events.infos, "a chain of two links takes it")
        await peer.do("publisher", name=CHAT)
        await until(lambda: CHAT in events.infos, "the node's")
        got: list[bytes] = []

        def take(body: bytes, _stamp_ns: int) -> bool:
            got.append(body)
            return True

        ours.subscribe(CHAT, take)
        everything: list[bytes] = []

        def take_all(body: bytes, _stamp_ns: int) -> bool:
            everything.append(body)
            return True

        chained.subscribe(CHAT, take_all)
        patience = Patience()
        while not got or text("over the link") not in everything:
            assert not patience.over()
            publisher.publish(text("over the link"), 7)
            await peer.do("publish", name=CHAT, data="of the node")
        assert set(got) == {text("of the node")}
        await peer.do("close", thing="pub" + CHAT)
        await until(lambda: CHAT not in events.infos, "only the other endpoint has it")
        assert CHAT in all_events.infos


async def test_services_both_ways(endpoint: tuple[ZenohEndpoint, Events], peer: Peer) -> None:
    ours, events = endpoint
    told = await peer.do("server", name=MODE)
    await until(lambda: MODE in events.services, "the service is announced")
    info = events.services[MODE]
    known = ros_services.resolve("std_srvs/srv/SetBool", "", Encoding.CDR).text
    assert (info.type_name, info.definition) == ("std_srvs/srv/SetBool", known.definition)
    assert info.type_hash == told["hash"]
    request = b"\0\x01\0\0\x01"
    answer = await ours.call(MODE, request, timeout_s=DEADLINE_S)
    assert answer[4:5] == b"\0" and b"as you say\0" in answer
    with pytest.raises(ServiceError, match="no service /other"):
        await ours.call(TopicName("/other"), request, timeout_s=1)
    with pytest.raises(ConfigError, match="serves it already"):
        ours.serve(info, lambda _request: asyncio.sleep(0, b""))

    async def handler(asked: bytes) -> bytes:
        if asked[4]:
            return b"\0\x01\0\0\x01\0\0\0\x05\0\0\0sure\0"
        raise ServiceError("never")

    offered = ServiceInfo(TopicName("/ours"), info.type_name, Encoding.CDR, info.type_hash, info.definition)
    server = ours.serve(offered, handler)
    await peer.sees("SS", "/ours")
    assert (await peer.do("call", name="/ours", hash=info.type_hash, data=True))["answer"] == [True, "sure"]
    assert (await peer.do("call", name="/ours", hash=info.type_hash, data=False))["answer"] is None
    server.close()
    await peer.do("close", thing="server" + MODE)
    await until(lambda: MODE not in events.services, "the service has ended")
    assert "/ours" not in events.services


async def test_a_server_that_is_known_before_it_can_be_reached_is_waited_for(
    router: Router, endpoint: tuple[ZenohEndpoint, Events]
) -> None:
    ours, events = endpoint
    theirs = ZenohEndpoint(ZenohOptions(router.options, DOMAIN, enclave="/"))  # a node as others are
    await theirs.start(Events())
    try:
        dds_name, type_hash = names.dds_type("std_srvs/srv/SetBool"), "RIHS01_" + 64 * "0"
        token = theirs.node.token(names.Kind.SERVER, MODE, dds_name, type_hash, names.Qos())
        await until(lambda: MODE in events.services, "the service is announced")
        with pytest.raises(ServiceError, match=f"{MODE} did not answer within 0.1 s"):
            await ours.call(MODE, b"", timeout_s=0.1)
        call = asyncio.create_task(ours.call(MODE, b"hello", timeout_s=60))

        async def handler(asked: bytes) -> bytes:
            return asked[::-1]

        server = theirs.serve(ServiceInfo(MODE, "std_srvs/srv/SetBool", Encoding.CDR, type_hash), handler)
        assert await call == b"olleh"
        token.undeclare()
        server.close()
        await until(lambda: MODE not in events.services, "the service has ended")
        assert ours.services.watched == 0
        alone = theirs.node.token(names.Kind.SERVER, OTHER_MODE, dds_name, type_hash, names.Qos())
        await until(lambda: OTHER_MODE in events.services, "a token alone")
        call = asyncio.create_task(ours.call(OTHER_MODE, b"hello", timeout_s=60))
        await until(lambda: ours.services.watched, "the call waits")
        alone.undeclare()
        with pytest.raises(ServiceError, match=f"{OTHER_MODE} has ended"):
            await call
    finally:
        await theirs.stop()


async def test_a_node_that_dies_takes_its_topics_with_it(endpoint: tuple[ZenohEndpoint, Events], peer: Peer) -> None:
    _, events = endpoint
    await peer.do("publisher", name=CHAT)
    await until(lambda: CHAT in events.infos, "announced")
    await peer.kill()
    await until(lambda: CHAT not in events.infos, "gone with its session")


async def test_another_type_under_the_same_name_is_left_out(
    endpoint: tuple[ZenohEndpoint, Events], peer: Peer, caplog: pytest.LogCaptureFixture
) -> None:
    ours, events = endpoint
    await peer.do("publisher", name=CHAT)
    await until(lambda: CHAT in events.infos, "announced")
    first = events.infos[CHAT]
    await peer.do("publisher", name=CHAT, type="std_msgs/msg/Bool", definition="bool data\n")
    await until(lambda: "is left out" in caplog.text, "said")
    (line,) = [record.message for record in caplog.records if "left out" in record.message]
    assert "std_msgs/msg/Bool RIHS01_" in line and f"std_msgs/msg/String {first.type_hash}" in line
    assert events.infos[CHAT] == first
    with pytest.raises(
        ConfigError, match=r"what comes is std_msgs/msg/Bool RIHS01_.* nodes here publish std_msgs/msg/String"
    ):
        ours.advertise(ros_types.topic_info(CHAT, "std_msgs/msg/Bool", Encoding.CDR))


async def test_a_type_nobody_defines_passes_as_it_is(
    endpoint: tuple[ZenohEndpoint, Events], peer: Peer, caplog: pytest.LogCaptureFixture
) -> None:
    ours, events = endpoint
    await peer.do(
        "publisher", name=CHAT, type="my_msgs/msg/Text", definition="string data\n", hash="RIHS01_" + "ab" * 32
    )
    await until(lambda: CHAT in events.infos, "announced")
    assert events.infos[CHAT] == TopicInfo(
        CHAT, "my_msgs/msg/Text", Encoding.CDR, "RIHS01_" + "ab" * 32, "", False, True
    )
    assert "type_paths" in caplog.text
    with pytest.raises(UsageError, match="no such topic"):
        ours.subscribe(TopicName("/nothing"), lambda _body, _stamp: True)


async def test_the_router_may_come_later_and_go() -> None:
    router = Router()
    endpoint, events = ZenohEndpoint(ZenohOptions(router.options, DOMAIN)), Events()
    await endpoint.start(events)
    try:
        router.start()
        peer = await Peer.start(router.port)
        try:
            await peer.do("publisher", name=CHAT)
            await until(lambda: CHAT in events.infos, "found through the router that came later", deadline_s=60)
        finally:
            await peer.kill()
    finally:
        await endpoint.stop()
        router.stop()


async def test_a_locator_that_is_none_is_one_line() -> None:
    with pytest.raises(ConfigError, match=r"^zenoh does not accept this: [^\n]+$"):
        ZenohEndpoint(ZenohOptions(SessionOptions(connect=("nonsense",))))


async def test_from_a_ros_1_recording_to_a_ros_2_node(tmp_path: Path, router: Router, peer: Peer) -> None:
    bag = write_bag(tmp_path / "in.bag", {"/chatter": 20})
    async with Lab(tmp_path, "robot1", "site") as lab:
        await lab.relay()
        section = {
            "kind": "zenoh", "connect": [router.locator], "listen": ["tcp/127.0.0.1:0"], "domain": DOMAIN,
        }  # fmt: skip
        file = lab.client_file("site", section, client={"namespace": "/"}, subscribe=["/robot1/.*"])
        site = endpoint_of(await lab.connected(file), ZenohEndpoint)
        name = TopicName("/robot1/chatter")
        await peer.do("subscriber", name=name, latched=True, depth=100)
        kind = names.dds_type("std_msgs/msg/String"), chat().type_hash
        # What nobody is known to read is written at once, and reaches nobody.
        await until(lambda: site.readers(name, *kind), "the subscriber is known")
        await lab.connected(lab.player_file("robot1", bag))
        await until(lambda: len(peer.got) == 20, "all of the recording is there")
    expected = [body[4:].decode() for body in under("robot1", bodies(bag))["/robot1/chatter"]]
    assert [data for _, data in peer.got] == expected


async def test_a_missing_router_is_said(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    monkeypatch.setattr("sern_client.endpoints.zenoh.endpoint.ROUTER_WAIT_S", 0.0)
    router = Router()
    endpoint = ZenohEndpoint(ZenohOptions(session=router.options, domain=DOMAIN))
    await endpoint.start(Events())
    try:
        await until(lambda: f"nobody answers at tcp/127.0.0.1:{router.port}; is the router" in caplog.text, "said")
    finally:
        await endpoint.stop()


async def test_a_start_that_fails_leaves_no_session(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sern_client.endpoints.zenoh.names.node_token", lambda *_args: "@ros2_lv//two slashes")
    endpoint = ZenohEndpoint(ZenohOptions(session=Router().options, domain=DOMAIN))
    with pytest.raises(ConfigError, match=r"^zenoh: [^\n]+$"):
        await endpoint.start(Events())
    with pytest.raises(AssertionError):
        _ = endpoint.session.opened
