"""Who gets in, who may do what, and what an attacker achieves: nothing, counted, and nobody else notices.

`Bystanders` is a robot whose numbered stream runs to a site the whole time; after each attack it must have gone on
without a gap, a duplicate or a reconnection.
"""

import json
import re
import shutil
import socket as socketlib
import time
from collections.abc import AsyncIterator, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import zmq

import sern_relay.admission
from sern_client.daemon import ClientDaemon
from sern_core.vocabulary.types import ClientName, TopicName
from sern_core.wire import framing
from sern_relay.daemon import RelayDaemon
from sern_relay.hub_news import REFUSAL_CODES
from sern_relay.relay_metrics import refused_connections
from sern_relay.server import MAX_PORTS
from sern_runtime.config.keys import (
    PublicKey,
    PublicKeys,
    SecretKey,
    generate,
    load_secret,
    write_public,
)
from sern_runtime.udp import UdpSession
from sern_tools.harness.files import ALLOW_ALL
from tests.daemons import HOST, Lab, bodies, write_bag
from tests.strangers import BAD, Stranger, hello, oversize
from tests.support import until

CLIENTS = ("robot1", "robot2", "site")
DEAD_ENDS = {"kind": "synthetic", "role": "robot", "topics": 1}


class Bystanders:
    """A relay, a site, and a robot that plays a loop at 1 kHz to it."""

    def __init__(self, lab: Lab, relay: RelayDaemon, site: ClientDaemon, robot: ClientDaemon) -> None:
        self.lab = lab
        self.relay = relay
        self.site = site
        self.robot = robot

    @property
    def arrived(self) -> int:
        return sum(counters.delivered for counters in self.site.core.received.topics.values())

    async def go_on(self) -> None:
        """The stream is alive now."""
        count = self.arrived
        await until(lambda: self.arrived > count + 50, "the stream goes on")

    async def refused(self, reason: str) -> None:
        transports = self.relay.transports
        await until(lambda: dict(refused_connections(transports.server))[reason,] > 0, f"the relay counts {reason}")


@asynccontextmanager
async def bystanders(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> AsyncIterator[Bystanders]:
    caplog.set_level("INFO")
    bag = write_bag(tmp_path / "loop.bag", {"/count": 500})
    async with Lab(tmp_path, *CLIENTS) as lab:
        relay = await lab.relay()
        site = await lab.connected(lab.recorder_file("site", "/robot1/.*"))
        robot = await lab.connected(lab.player_file("robot1", bag, play={"rate": 1, "loop": True}))
        world = Bystanders(lab, relay, site, robot)
        await world.go_on()
        yield world
        await world.go_on()
        for daemon in (robot, site, relay):
            await lab.end(daemon)
        connections = [m for m in caplog.messages if m.startswith(("site connected", "robot1 connected"))]
        assert [m.partition(",")[0] for m in connections] == ["site connected", "robot1 connected"], (
            "a bystander had to connect again"
        )
    played = bodies(bag)["/count"]
    arrived = bodies(tmp_path / "site.bag")["/robot1/count"]
    assert arrived == [played[index % len(played)] for index in range(len(arrived))]


async def test_a_stranger_and_a_client_without_keys_are_counted_and_shut_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, stranger_keys: SecretKey
) -> None:
    async with bystanders(tmp_path, caplog) as world:
        zap = world.relay.zap
        assert zap is not None
        async with Stranger(world.lab, stranger_keys) as stranger:
            await until(lambda: zmq.Event.HANDSHAKE_FAILED_AUTH in stranger.events)
        assert zap.counters.unknown_key == 1
        assert sum("unknown key" in message for message in caplog.messages) == 1
        (tmp_path / "plain").mkdir()
        async with Lab(tmp_path / "plain", secure=False, relay_port=world.lab.port) as plain:
            client = await plain.client(plain.client_file("robot2", DEAD_ENDS))
            await until(lambda: "one side has keys configured and the other has not" in client.news.reason)
        await world.refused("handshake")


async def test_what_a_stranger_sends_before_the_handshake_hurts_nobody(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    garbage = [
        b"GET / HTTP/1.1\r\nHost: relay\r\n\r\n",
        bytes(range(256)) * 64,
        b"\xff\0\0\0\0\0\0\0\x01\x7f\x03\x01NULL" + bytes(50),  # a greeting of the plain mechanism
        b"\xff\0\0\0\0\0\0\0\x01\x7f\x03\x01CURVE" + bytes(47) + b"\x06\xff" + b"\x7f" * 8,  # a frame of 2^63 bytes
        b"",
    ]
    async with bystanders(tmp_path, caplog) as world:
        connections = [socketlib.create_connection((HOST, world.lab.port)) for _ in garbage]
        try:
            for connection, data in zip(connections, garbage, strict=True):
                connection.setblocking(False)
                connection.sendall(data)
            await world.refused("handshake")
            await world.go_on()
            assert "Traceback" not in caplog.text
        finally:
            for connection in connections:
                connection.close()


async def test_a_name_that_is_not_the_keys_is_refused_to_the_client(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with bystanders(tmp_path, caplog) as world:
        async with Stranger(world.lab, load_secret(world.lab.directory / "robot2.key")) as impostor:
            await impostor.send(hello("robot1"))
            await until(lambda: impostor.received)
            assert framing.decode_header(impostor.received[0]).kind == framing.Kind.REFUSE
            answer = framing.decode_handshake(impostor.received[0])
            assert answer == {"code": "name", "why": "your key belongs to robot2, not to robot1"}
        assert "robot2" not in world.relay.hub.clients.port_of


async def test_a_claimed_routing_id_is_never_heard(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    async with bystanders(tmp_path, caplog) as world:
        server = world.relay.transports.server
        assert server is not None
        [victim] = [each.routing_id for each, _served in server.clients.sessions() if each.client == "robot1"]
        keys = load_secret(world.lab.directory / "robot2.key")
        for identity in (b"robot1", victim + b"\0"):
            async with Stranger(world.lab, keys, identity=identity) as impostor:
                before = server.socket.refused_routing_ids
                await impostor.send(hello("robot2"))
                await until(lambda before=before: server.socket.refused_routing_ids > before)  # type: ignore[misc]
                await impostor.cut()
                assert impostor.received == []


async def test_nobody_joins_the_session_of_another(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    async with bystanders(tmp_path, caplog) as world:
        server = world.relay.transports.server
        assert server is not None
        said = world.robot.core.link.handshake.join(0.0)  # as if it had been overheard
        assert said is not None
        envelope = framing.decode_handshake(said) | {"name": "robot2"}
        own_name = framing.encode_handshake(framing.Kind.JOIN, framing.decode_header(said).tag, 0, envelope)
        keys = load_secret(world.lab.directory / "robot2.key")
        for number, datagram in enumerate((said, own_name), start=1):
            async with Stranger(world.lab, keys) as impostor:
                await impostor.send(datagram)
                await impostor.cut()
                assert impostor.received == []
            assert server.priority_lanes.refused == number
        await world.refused("join")
        assert not any(joined.client == "robot2" for joined in server.priority_lanes.joined)


async def test_one_client_has_a_few_connections(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    async with bystanders(tmp_path, caplog) as world, AsyncExitStack() as stack:
        server = world.relay.transports.server
        assert server is not None
        keys = load_secret(world.lab.directory / "robot2.key")
        stray = framing.encode_header(framing.Kind.DATA, 1, 1, 0)
        strangers = [await stack.enter_async_context(Stranger(world.lab, keys)) for _ in range(MAX_PORTS + 4)]
        await strangers[0].send(hello("robot2"))
        await until(lambda: strangers[0].received, "one has a session")
        for stranger in strangers[1:]:
            await stranger.send(stray)
            await until(lambda each=stranger: each.received, "it is told that there is none")  # type: ignore[misc]
        for stranger in strangers[1:5]:
            await stranger.cut()
        # Both ends notice a cut for themselves, in threads of their own.
        await until(lambda: len(server.connections.handles_of("robot2")) == MAX_PORTS, "the relay has noticed")
        assert zmq.Event.DISCONNECTED not in strangers[0].events, "the one with the session stays"
        assert server.surplus == 4
        await world.refused("surplus")
        assert sum("robot2 has more than" in message for message in caplog.messages) == 1


async def test_connections_for_class_control_count_over_all_sessions(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with bystanders(tmp_path, caplog) as world, AsyncExitStack() as stack:
        server = world.relay.transports.server
        assert server is not None
        keys = load_secret(world.lab.directory / "robot2.key")
        lane = await stack.enter_async_context(Stranger(world.lab, keys))
        priority_lanes = server.priority_lanes
        for tag in range(1, 4):
            await lane.send(hello("robot2", tag))
            await until(lambda: "robot2" in world.relay.hub.links, "a session")
            envelope: framing.Envelope = {"name": "robot2", "boot": 7, "relay": world.relay.hub.boot}
            join = framing.encode_handshake(framing.Kind.JOIN, tag, 0, envelope)

            def joined(count: int) -> bool:
                lanes = priority_lanes._lanes
                lane = lanes.get(ClientName("robot2"))
                return lane is not None and len(lane.paths) == count

            for count in (1, 2):
                another = await stack.enter_async_context(Stranger(world.lab, keys))
                await another.send(join)
                await until(partial(joined, count), "it has joined")
            await lane.send(framing.encode_handshake(framing.Kind.CLOSE, tag, 0, {"code": "bye", "why": "bye"}))
            await until(lambda: "robot2" not in world.relay.hub.links, "it is forgotten")
            assert sum(each.client == "robot2" for each in server.priority_lanes.joined) <= 2
        assert server.priority_lanes.refused == 0


async def test_a_client_is_given_a_lane_now_and_then(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async with Lab(tmp_path, *CLIENTS) as lab:
        relay = await lab.relay()
        robot = await lab.connected(lab.client_file("robot1", DEAD_ENDS))
        lanes = relay.transports.lanes
        assert lanes is not None
        name = ClientName("robot1")
        await until(lambda: name in lanes._lanes and name not in lanes._resting, "it has a lane, and has rested")
        opened: list[Sequence[str]] = []
        open_session = lanes.server.open_session

        def counted(client: ClientName, offered: Sequence[str], *, port: int) -> UdpSession:
            opened.append(offered)
            return open_session(client, offered, port=port)

        monkeypatch.setattr(lanes.server, "open_session", counted)
        ciphers = list(lanes._ciphers[name])
        for number in range(100):
            lanes.asked(name, [*ciphers, f"of the future {number}"])
        assert opened == [[*ciphers, "of the future 0"]]
        await until(lambda: len(opened) > 1, "it is given the newest it has asked for")
        assert opened[1] == (*ciphers, "of the future 99")
        lanes.asked(name, ciphers)
        lanes.closed(name)  # with its session
        assert not lanes._waiting
        for daemon in (robot, relay):
            await lab.end(daemon)


@pytest.mark.parametrize("kind", BAD)
async def test_a_bad_frame_of_a_known_client_ends_its_connection_only(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, kind: str
) -> None:
    async with bystanders(tmp_path, caplog) as world:
        server = world.relay.transports.server
        assert server is not None
        async with Stranger(world.lab, load_secret(world.lab.directory / "robot2.key")) as stranger:
            for datagram in BAD[kind]():
                await stranger.send(datagram)
            await stranger.cut()
        assert server.bad_frames == 1
        assert sum("bad frame" in message for message in caplog.messages) == 1


async def test_oversize_and_multipart_messages_do_not_get_through(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with bystanders(tmp_path, caplog) as world:
        keys = load_secret(world.lab.directory / "robot2.key")
        async with Stranger(world.lab, keys) as stranger:
            await stranger.send(*oversize())
            await stranger.cut()
        async with Stranger(world.lab, keys) as stranger:
            await stranger.send(*[hello("robot2")] * 20)
            await world.refused("multipart")
            await stranger.cut()
            assert stranger.received == []


async def test_access_rules_hold_and_name_what_they_refuse(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    bag = write_bag(tmp_path / "run.bag", {"/mine": 20, "/secret": 20})
    rules = [
        {"client": "robot1", "publish": ["/{self}/mine"]},
        {"client": "site", "subscribe": ["/robot1/mine"]},
    ]
    async with Lab(tmp_path, *CLIENTS) as lab:
        relay = await lab.relay(lab.relay_file(access=rules))
        site = await lab.connected(lab.recorder_file("site", "/robot1/.*", "/robot2/.*"))
        robot = await lab.connected(lab.player_file("robot1", bag, play={"wait_for": ["/mine"]}))
        await until(lambda: robot.bridge.outbound.refusals == 1)
        await until(lambda: sum(c.delivered for c in site.core.received.topics.values()) == 20)
        assert "the relay refuses /robot1/secret (forbidden): robot1 may not publish /robot1/secret" in caplog.text
        assert {code: count for code, count in relay.news.refusals.items() if count} == {"forbidden": 1}
        await lab.end(robot)
        summary = json.loads((tmp_path / "robot1.summary.json").read_text())["topics"]
        assert summary["/robot1/secret"]["delivered"] == 0
        # Somebody whom no rule names may connect, and do nothing.
        other = await lab.connected(lab.player_file("robot2", bag, play={"wait_for": []}))
        await until(lambda: other.bridge.outbound.refusals == 2)
        for daemon in (other, site, relay):
            await lab.end(daemon)
    assert set(bodies(tmp_path / "site.bag")) == {"/robot1/mine"}


async def test_a_second_owner_of_a_global_name_is_refused_by_name(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    bag = write_bag(tmp_path / "run.bag", {"/odom": 20})
    everywhere = {"client": {"namespace": "/"}}
    async with Lab(tmp_path, *CLIENTS) as lab:
        relay = await lab.relay()
        site = await lab.connected(lab.recorder_file("site", "/.*"))
        first = await lab.connected(lab.player_file("robot1", bag, **everywhere))
        await until(lambda: sum(c.delivered for c in site.core.received.topics.values()) == 20)
        second = await lab.connected(lab.player_file("robot2", bag, play={"wait_for": []}, **everywhere))
        await until(lambda: second.bridge.outbound.refusals == 1)
        [line] = [m for m in caplog.messages if m.startswith("the relay refuses /odom")]
        assert "robot1" in line
        for daemon in (second, first, site, relay):
            await lab.end(daemon)
    assert bodies(tmp_path / "site.bag") == bodies(bag)


async def test_a_revoked_key_is_cut_off_both_ways_and_comes_back_when_allowed(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with bystanders(tmp_path, caplog) as world:
        lab, relay = world.lab, world.relay
        assert relay.transports.server is not None and relay.zap is not None
        bag = write_bag(tmp_path / "other.bag", {"/count": 500})
        loop: dict[str, Any] = {"rate": 1, "loop": True}
        config = lab.player_file("robot2", bag, play=loop, subscribe=["/robot1/.*"])
        content = json.loads(config.read_text())
        content["endpoint"] = [content["endpoint"], {"kind": "record", "path": "robot2"}]
        config.write_text(json.dumps(content))
        relay.hub.streams.tap = lambda _stream: True
        second = await lab.connected(config)
        heard, topic = relay.hub.received.topics, TopicName("/robot2/count")
        await until(lambda: topic in heard and heard[topic].delivered > 50)
        await until(lambda: second.core.received.topics)

        key = lab.clients_dir / "robot2.pub"
        away = key.rename(tmp_path / "robot2.pub")
        relay.reload()
        assert [each for each, _served in relay.transports.server.clients.sessions() if each.client == "robot2"] == []
        before = heard[topic].delivered
        await until(lambda: "refused our key" in second.news.reason)
        refused = relay.zap.counters.unknown_key
        assert refused > 0
        taken = sum(c.delivered for c in second.core.received.topics.values())
        await world.go_on()
        assert heard[topic].delivered == before
        assert sum(c.delivered for c in second.core.received.topics.values()) == taken
        assert not second.core.link.established

        shutil.copy(away, key)
        relay.reload()
        await until(lambda: second.core.link.established, "robot2 is back by itself")
        await until(lambda: heard[topic].delivered > before)
        # It is stopped after the robot, which would wait for its confirmations.


async def test_a_rotated_key_ends_the_connections_of_the_old_one(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with Lab(tmp_path, *CLIENTS) as lab:
        relay = await lab.relay()
        robot = await lab.connected(lab.client_file("robot1", DEAD_ENDS))
        lab.make_keys("robot1")  # the new pair is at the relay; the client runs with the old one
        relay.reload()
        await until(lambda: "refused our key" in robot.news.reason)
        assert "robot1 lost a key; 1 connections cut" in caplog.text
        await lab.end(robot)
        robot = await lab.connected(tmp_path / "robot1.yaml")
        await lab.end(robot)
        await lab.end(relay)


@pytest.mark.parametrize("transport", ["tcp", "ipc"])
async def test_a_silent_connection_does_not_outlive_its_key(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, transport: str
) -> None:
    async with Lab(tmp_path, *CLIENTS) as lab:
        if transport == "ipc":
            lab.endpoint = f"ipc://{tmp_path}/relay.ipc"
        old, new = load_secret(tmp_path / "robot2.key"), generate(ClientName("robot2"))
        end_s = int(time.time()) + 3600
        keys = (PublicKey(old.public_key, None, end_s), PublicKey(new.public_key))
        write_public(lab.clients_dir / "robot2.pub", PublicKeys(old.name, keys), replace=True)
        relay = await lab.relay()
        assert relay.transports.server is not None
        async with Stranger(lab, old) as silent, Stranger(lab, old) as loud:
            await loud.send(hello("robot2"))
            await until(lambda: loud.received, "it has a session")
            await until(lambda: zmq.Event.HANDSHAKE_SUCCEEDED in silent.events, "admitted by its key, that holds")
            relay.enforcement.end_lapsed()
            assert zmq.Event.DISCONNECTED not in (*silent.events, *loud.events)
            wall = SimpleNamespace(time=lambda: end_s + 1.0, time_ns=time.time_ns)
            monkeypatch.setattr(sern_relay.admission, "time", wall)
            table = relay.transports.server.connections._connections
            assert len(table) == 2 and not any(connection.ended for connection in table.values())
            relay.enforcement.end_lapsed()
            assert all(connection.ended for connection in table.values())
            assert list(relay.transports.server.clients.sessions()) == []
            await loud.cut()
            await silent.cut()
            monkeypatch.undo()
        await lab.end(relay)


async def test_a_bad_file_at_reload_keeps_the_old_rules(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    async with bystanders(tmp_path, caplog) as world:
        config, good = world.relay.loaded.path, world.relay.loaded.path.read_text()
        config.write_text("relay: [")
        world.relay.reload()
        config.write_text(good.replace(json.dumps(ALLOW_ALL[0]["client"]), '"*"'))
        world.relay.reload()
        assert world.relay.reloads.failures == 2
        told = [m for m in caplog.messages if m.startswith("reload failed, the old configuration stays: ")]
        assert len(told) == 2
        assert all(str(config) in message for message in told)
        config.write_text(good)
        (world.lab.clients_dir / "robot2.pub").write_text("nonsense")
        world.relay.reload()
        assert world.relay.reloads.failures == 3
        await world.go_on()


async def test_a_rule_taken_away_ends_the_stream_and_given_back_restores_it(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    bag = write_bag(tmp_path / "run.bag", {"/count": 500})
    async with Lab(tmp_path, *CLIENTS) as lab:
        relay = await lab.relay()
        site = await lab.connected(lab.recorder_file("site", "/robot1/.*"))
        robot = await lab.connected(lab.player_file("robot1", bag, play={"rate": 1, "loop": True}))
        counters = site.core.received.topics
        await until(lambda: counters and next(iter(counters.values())).delivered > 10)
        lab.relay_file(access=[{"client": "site", "subscribe": [".*"]}], http={"listen": None})
        relay.reload()
        await until(lambda: robot.bridge.outbound.refusals == 1)
        assert "robot1 may no longer publish /robot1/count: the access rules have changed" in caplog.text
        assert robot.core.link.established and site.core.link.established
        for daemon in (robot, site, relay):
            await lab.end(daemon)


def test_every_refusal_of_the_core_has_a_counter() -> None:
    core = Path(__file__).parents[2] / "sern_core"
    codes = {code for file in core.rglob("*.py") for code in re.findall(r'RefusedError\(\s*"(\w+)"', file.read_text())}
    assert codes <= REFUSAL_CODES
    assert "forbidden" in codes


async def test_half_open_connections_are_bounded(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    async with bystanders(tmp_path, caplog) as world:
        server = world.relay.transports.server
        assert server is not None
        connections = [socketlib.create_connection((HOST, world.lab.port)) for _ in range(100)]
        try:
            await world.refused("capped")
            await until(lambda: server.connections.half_open <= server.connections.max_half_open_per_source)
            await world.go_on()
        finally:
            for connection in connections:
                connection.close()
