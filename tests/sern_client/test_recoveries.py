"""Who was told of a loss is told of its end: at the same level, once, and with how long it took. What is fine from the
start is no recovery, and no more than INFO."""

import asyncio
import logging
import re
import sys
from asyncio.subprocess import Process
from collections.abc import Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final, NamedTuple

import pytest

from sern_client import guard, priority_lane, relay_name
from sern_client.checks import CHECK_S, CONFIRM_S, TableCheck
from sern_client.daemon import ClientDaemon
from sern_client.endpoints.ros1 import services, subscription
from sern_client.endpoints.ros1.header import encode_header
from sern_client.guard import Guard
from sern_client.link_news import SILENT
from sern_client.link_topics import LinkTopics
from sern_client.priority_lane import ClientPriorityLane
from sern_client.relay_name import RelayName, UnresolvedError
from sern_client.withdrawal import Withdrawal
from sern_core.path.lanes import LANE_PRIORITY, LANE_ZMQ
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.message import StreamId
from sern_core.vocabulary.params import Redundancy
from sern_core.vocabulary.types import ClientName, Encoding, TopicName
from sern_relay.daemon import RelayDaemon
from sern_runtime import clock, datagram_watch
from sern_runtime.config.client import load_client
from sern_runtime.config.relay import load_relay
from sern_runtime.config.shared import LogSection
from sern_runtime.datagram_watch import DatagramWatch
from sern_runtime.sdnotify import Notifier, Watchdog
from sern_tools.ports import free_ports
from tests.daemons import Lab
from tests.sern_client.endpoints.ros1.fakes import HOST, FakeMaster, FakePublisher, running
from tests.sern_client.test_checks import ODOM, Tables
from tests.sern_client.test_link_state import STAMP_NS, VIEWS, Endpoint, Site, Stream, _close
from tests.support import Events, until
from tests.views import IDLE

Said = Callable[[str], list[logging.LogRecord]]


class Scene(NamedTuple):
    """What a case has: a folder, patches, and the lines so far that hold some words."""

    folder: Path
    patch: pytest.MonkeyPatch
    said: Said

    def clock(self) -> "Clock":
        return Clock(self.patch)

    async def until_said(self, words: str, times: int = 1) -> None:
        await until(lambda: len(self.said(words)) >= times, f"says {words!r}")


class Clock:
    """Stands still until it is told to go on."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.now = 1000.0
        patch.setattr(clock, "now", lambda: self.now)

    def go_on(self, seconds: float = 12.0) -> None:
        self.now += seconds


# --- what is lost and comes back --------------------------------------------------------------------------------------


async def peer(scene: Scene) -> None:
    site = Site()
    for up in (True, False, True):
        site.told("jackal1", up=up)
    site.state.close()


async def peer_that_was_let_go(scene: Scene) -> None:
    """The relay gives a client up some time: whoever was told that it is gone still waits for word of it."""
    site = Site()
    for up in (True, False):
        site.told("jackal1", up=up)
    site.core.peers.told({"t": "peers", "peers": [{"name": "jackal1"}]}, now=clock.now())
    site.state.look()
    site.told("jackal1", up=True)
    site.state.close()


async def ros_master(scene: Scene) -> None:
    master = FakeMaster()
    await master.start()
    try:
        async with running(master):
            await scene.until_said("connected to the ROS master")
            master.mute = "getSystemState"
            await scene.until_said("does not answer like a ROS master")
            master.mute = ""
            await scene.until_said("connected to the ROS master", 2)
    finally:
        await master.stop()


async def publisher_of_ros1(scene: Scene) -> None:
    scene.patch.setattr(subscription, "BACKOFF_S", (0.01, 0.01))
    master = FakeMaster()
    await master.start()
    try:
        async with FakePublisher(master) as publisher:
            publisher.greeting = encode_header({"error": "not now"})
            async with running(master) as (_, events):
                await scene.until_said("refused: not now")
                publisher.greeting = None
                await until(lambda: events.infos, "its topic is there")
    finally:
        await master.stop()


async def service_of_ros1(scene: Scene) -> None:
    scene.patch.setattr(services, "PROBE_AGAIN_S", (0.01, 0.01))
    fields = {"error": "not now"}

    async def probed(_reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(encode_header(fields))
        writer.close()

    master = FakeMaster()
    await master.start()
    server = await asyncio.start_server(probed, HOST, 0)
    try:
        async with FakePublisher(master) as node:  # a node that lives
            master.add(2, "/set_mode", node.name, master.nodes[node.name])
            master.services["/set_mode"] = f"rosrpc://{HOST}:{server.sockets[0].getsockname()[1]}"
            async with running(master) as (endpoint, events):
                endpoint.watch_services(events)
                await scene.until_said("refused: not now")
                fields = {"type": "std_srvs/SetBool", "md5sum": "09fb03525b03e7ea1fd3992bafd87e16"}
                await scene.until_said("service of /talker answers again")
                assert list(events.services) == ["/set_mode"]
    finally:
        server.close()
        await master.stop()


async def guard_process(scene: Scene) -> None:
    scene.patch.setattr(guard, "AGAIN_S", (0.0, 0.0))
    spawn = guard._spawn
    scripts = iter(("", "import sys; sys.stdin.read()"))  # the first ends at once, the second with its client

    async def spawned(*_: str) -> Process:
        script = "print('{\"ready\": true}', flush=True);" + next(scripts)
        return await spawn(sys.executable, "-c", script)

    scene.patch.setattr(guard, "_spawn", spawned)
    watched = Guard([], scene.folder, LogSection())
    watched.start()
    await until(lambda: watched.restarts == 1 and watched.ready, "runs again")
    await watched.stop()


def _withdrawn(scene: Scene) -> tuple[Clock, Withdrawal, Any]:
    endpoint, now = Endpoint(), scene.clock()
    streams: dict[StreamId, Any] = {
        StreamId(ClientName("jackal1"), 1, TopicName(name)): Stream(endpoint, name)
        for name in ("/jackal1/a", "/jackal1/b")
    }
    withdrawal = Withdrawal(streams, endpoint.advertise, _close, used=True)
    withdrawal.withdraw(ClientName("jackal1"))
    now.go_on()
    return now, withdrawal, streams


async def withdrawn_topics(scene: Scene) -> None:
    _, withdrawal, _ = _withdrawn(scene)
    for _ in range(2):
        withdrawal.restore(ClientName("jackal1"))


async def withdrawn_topics_one_by_one(scene: Scene) -> None:
    now, withdrawal, streams = _withdrawn(scene)
    first, second = streams.values()
    withdrawal.restore_one(first)
    assert not scene.said("here again")
    withdrawal.restore_one(second)
    withdrawal.restore(ClientName("jackal1"))
    now.go_on()


async def difference_of_tables(scene: Scene) -> None:
    tables = Tables()
    tables.found = [ODOM]
    check = TableCheck(tables, now=0.0)
    for turn in range(3):
        check.tick(now=CHECK_S + turn * CONFIRM_S)
    tables.found = []
    for turn in range(3, 5):
        check.tick(now=CHECK_S + turn * CONFIRM_S)


class Link:
    """A session over the stream lane, as the priority lane sees it."""

    def __init__(self) -> None:
        self.established = True
        self.dirty = False
        self.handshake = SimpleNamespace(reads=True, join=lambda _now: b"join")
        self.plane = SimpleNamespace(may_copy=lambda _nbytes: False)
        self.lane = SimpleNamespace(id=LANE_ZMQ)
        self.lanes = SimpleNamespace(by_id={LANE_ZMQ}, priority_lane=None)

    def open_lane(self, *, now: float, lane_id: int) -> None:
        self.lanes.by_id.add(lane_id)

    def close_lane(self, *, now: float, lane_id: int) -> None:
        self.lanes.by_id.discard(lane_id)

    def receive(self, data: bytes, *, now: float, lane: int) -> None:
        assert lane == LANE_PRIORITY


class Dialed:
    """A connection that takes everything."""

    def __init__(self) -> None:
        self.closed = False

    def open(self) -> None: ...

    def send(self, datagram: bytes) -> int:
        return 0

    def close(self) -> None:
        self.closed = True


class Transport:
    """Makes connections, or says why there are none."""

    def __init__(self) -> None:
        self.problem = ""
        self.made: list[Any] = []

    def another(self, events: Any) -> Dialed:
        if self.problem:
            raise ConfigError(self.problem)
        self.made.append(events)
        return Dialed()


async def _priority_connections(scene: Scene, lose: Callable[[Transport], None]) -> None:
    link, transport, now = Link(), Transport(), scene.clock()
    core: Any = SimpleNamespace(link=link)
    any_transport: Any = transport
    lane = ClientPriorityLane(core, any_transport, Redundancy.OFF, datagrams=False, kick=lambda: None)
    lane.begin()
    lose(transport)
    lane.tick()
    if transport.made:
        for _ in range(priority_lane.ATTEMPTS):
            for connection in transport.made:
                connection.up(None)
                connection.down("closed")
        await asyncio.sleep(0)  # it gives up outside their calls
    assert LANE_PRIORITY not in link.lanes.by_id
    transport.problem = ""
    transport.made.clear()
    now.go_on(priority_lane.ASK_AGAIN_S)
    lane.tick()
    for connection in transport.made:
        connection.up(None)
    assert not scene.said("again, after")  # so far nobody has answered
    for _ in range(2):
        for connection in transport.made:
            connection.received(b"")
    lane.close()


async def no_priority_connections(scene: Scene) -> None:
    def lose(transport: Transport) -> None:
        transport.problem = "out of file descriptors"

    await _priority_connections(scene, lose)


async def refused_priority_connections(scene: Scene) -> None:
    await _priority_connections(scene, lambda _transport: None)


async def state_on_ros(scene: Scene) -> None:
    endpoint, now = Endpoint(), scene.clock()
    endpoint.refused = {"/jackal1/sern/link"}
    topics = LinkTopics("site", Encoding.ROS1, endpoint.advertise, diagnostics=False)
    for _ in range(2):
        topics.publish(VIEWS, STAMP_NS)
    now.go_on()
    endpoint.refused.clear()
    for _ in range(2):
        topics.publish(VIEWS, STAMP_NS)
    topics.close()


async def watchdog(scene: Scene) -> None:
    now, socket = scene.clock(), 0
    watched = Watchdog(Notifier(None, watchdog_s=30.0), {"socket": lambda: socket})
    for step in (1, 0, 0, 1, 1):
        socket += step
        now.go_on()
        watched.check()


async def zenoh_router(scene: Scene) -> None:
    pytest.importorskip("zenoh", reason="the library eclipse-zenoh is missing: pip install 'sern[zenoh]'")
    from sern_client.endpoints.zenoh import endpoint as module
    from sern_client.endpoints.zenoh.options import ZenohOptions
    from sern_client.endpoints.zenoh.session import SessionOptions, ZenohSession

    scene.patch.setattr(module, "ROUTER_WAIT_S", 0.0)
    scene.patch.setattr(module, "LOOK_S", 0.02)
    there = f"tcp/127.0.0.1:{free_ports(1)[0]}"
    zenoh = module.ZenohEndpoint(ZenohOptions(SessionOptions(connect=(there,))))
    other = ZenohSession(SessionOptions(connect=(), listen=(there,)))
    await zenoh.start(Events())
    try:
        await scene.until_said("nobody answers at")
        await other.open()
        await scene.until_said("somebody answers at")
    finally:
        await zenoh.stop()  # it would say that the other has gone
        await other.close()


async def name_of_the_relay(scene: Scene) -> None:
    now, found = scene.clock(), iter((UnresolvedError("name or service not known"), "192.0.2.1"))

    async def resolve(_host: str, _port: int) -> str:
        answer = next(found)
        if isinstance(answer, UnresolvedError):
            raise answer
        return answer

    scene.patch.setattr(relay_name, "resolve", resolve)
    name = RelayName("tcp://relay.example:5555", "relay.example", 5555)
    for _ in range(2):
        name.tick(connected=False)
        await asyncio.sleep(0)
        now.go_on()
    name.tick(connected=False)
    name.close()


async def datagrams(scene: Scene) -> None:
    now = scene.clock()
    link: Any = SimpleNamespace(peer="relay", observe=lambda *, now: IDLE)
    passes = iter((False, False, True))
    scene.patch.setattr(datagram_watch, "datagrams_pass", lambda _link: next(passes))
    watched = DatagramWatch(lambda: [link], lambda _link, _within_s: "no datagram gets through", lambda _link: "relay")
    for _ in range(3):
        watched.tick()
        now.go_on()


@asynccontextmanager
async def _client(scene: Scene) -> Any:
    """A client's daemon that is not started, and knows of its link what it is told."""
    lab = Lab(scene.folder, "robot1")
    daemon = ClientDaemon(load_client(lab.client_file("robot1", {"kind": "synthetic", "role": "robot"})))
    try:
        yield daemon
    finally:
        await daemon.stop()


async def link(scene: Scene) -> None:
    now = scene.clock()
    async with _client(scene) as daemon:
        daemon.link_up()
        for _ in range(2):
            daemon.link_down("the connection to the relay was lost")
        now.go_on()
        daemon.link_up()


async def silent_relay(scene: Scene) -> None:
    now = scene.clock()
    async with _client(scene) as daemon:
        daemon.core.link.end.established = True
        for stalled in (False, True, True, False, False):
            daemon.core.link.lane.stalled = stalled
            daemon.news.look()
            now.go_on()
        daemon.core.link.end.established = False


@asynccontextmanager
async def _relay(scene: Scene) -> Any:
    """The same of a relay."""
    lab = Lab(scene.folder, "robot1")
    daemon = RelayDaemon(load_relay(lab.relay_file()))
    try:
        yield daemon
    finally:
        await daemon.stop()


async def client_at_the_relay(scene: Scene) -> None:
    now = scene.clock()
    async with _relay(scene) as daemon:
        daemon.news.client_up(ClientName("robot1"), resumed=False)
        daemon.news.client_down(ClientName("robot1"), "connection lost")
        now.go_on()
        daemon.news.client_up(ClientName("robot1"), resumed=True)


async def reload_of_the_relay(scene: Scene) -> None:
    now = scene.clock()
    async with _relay(scene) as daemon:
        config = daemon.loaded.path
        good = config.read_text()
        for text in ("relay: {", good, good):
            config.write_text(text)
            daemon.reload()
            now.go_on()


class Pair(NamedTuple):
    """A case, and the lines that it is to say: of the loss, and of its end. `first`: how it is said that all is well
    where nothing was lost."""

    case: Callable[[Scene], Awaitable[None]]
    level: int
    loss: str
    end: str
    first: str = ""


PAIRS: Final = (
    Pair(peer, logging.WARNING, "jackal1 is gone", "jackal1 is back", "jackal1 is there"),
    Pair(peer_that_was_let_go, logging.WARNING, "jackal1 is gone", "jackal1 is back", "jackal1 is there"),
    Pair(ros_master, logging.WARNING, "like a ROS master", " again, after", "connected to the ROS master"),
    Pair(publisher_of_ros1, logging.WARNING, "/talker: refused: not now", "publisher /talker answers again"),
    Pair(service_of_ros1, logging.WARNING, "/talker: refused: not now", "service of /talker answers again"),
    Pair(guard_process, logging.ERROR, "command topics has ended", "runs again as", "command topics runs as"),
    Pair(withdrawn_topics, logging.WARNING, "2 of its topics end here", "jackal1 is there again"),
    Pair(withdrawn_topics_one_by_one, logging.WARNING, "2 of its topics end here", "jackal1 is there again"),
    Pair(difference_of_tables, logging.ERROR, "not what should be: /odom", "what should be again: /odom"),
    Pair(no_priority_connections, logging.WARNING, "no connection of its own", "connections of its own again"),
    Pair(refused_priority_connections, logging.WARNING, "takes no connection", "connections of its own again"),
    Pair(state_on_ros, logging.WARNING, "the state of the link is not published", "is published now"),
    Pair(watchdog, logging.ERROR, "no progress in socket", "progress again everywhere"),
    Pair(zenoh_router, logging.WARNING, "nobody answers at", "somebody answers at"),
    Pair(name_of_the_relay, logging.WARNING, "does not resolve", "resolves again"),
    Pair(datagrams, logging.WARNING, "no datagram gets through", "datagrams pass now"),
    Pair(link, logging.WARNING, "connection to the relay was lost", "the link is there again"),
    Pair(silent_relay, logging.WARNING, SILENT, "the relay answers again"),
    Pair(client_at_the_relay, logging.INFO, "robot1 is away", "robot1 connected again", "robot1 connected"),
    Pair(reload_of_the_relay, logging.ERROR, "reload failed", "the reload works again"),
)  # fmt: skip


@pytest.mark.parametrize("pair", PAIRS, ids=[pair.case.__name__ for pair in PAIRS])
async def test_a_recovery_is_said_like_its_loss(
    pair: Pair, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)

    def said(words: str) -> list[logging.LogRecord]:
        return [record for record in caplog.records if words in record.getMessage()]

    await pair.case(Scene(tmp_path, monkeypatch, said))
    levels = [[record.levelno for record in said(words)] for words in (pair.loss, pair.end)]
    assert levels == [[pair.level], [pair.level]], caplog.text
    (end,) = said(pair.end)
    assert re.search(r" after \d+(\.\d)? s", end.getMessage()), end.getMessage()
    assert end.created >= said(pair.loss)[0].created
    if pair.first:
        first = next(record for record in caplog.records if pair.first in record.getMessage())
        assert first.levelno == logging.INFO and first.created <= said(pair.loss)[0].created
