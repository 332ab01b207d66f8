"""SIGHUP and the feed: roles come, change and go while a robot publishes and a plain program listens."""

import socket as socketlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zmq

from sern_client.daemon import ClientDaemon
from sern_core.topics.patterns import compile_pattern
from sern_core.topics.rules import FeedRole
from sern_core.vocabulary.types import TopicName
from sern_relay.daemon import RelayDaemon
from sern_runtime import clock
from sern_runtime import feed as feed_module
from sern_runtime.feed import Feed
from sern_tools.ports import free_ports
from tests.daemons import Lab
from tests.loopback.test_feed_clients import ROBOT, Programs, send
from tests.support import DEADLINE_S, until

ODOMETRY = TopicName("/jackal1/odometry/filtered")
FRAME = b"/jackal1/odometry/filtered\0"
VIEWER: dict[str, Any] = {
    "name": "viewer",
    "publish": [],
    "ingest_endpoint": None,
    "allow_control": False,
    "types": [],
}


@pytest.fixture
def programs() -> Iterator[Programs]:
    programs = Programs()
    yield programs
    programs.close()


def reload(lab: Lab, relay: RelayDaemon, *roles: dict[str, Any]) -> None:
    """Reload as SIGHUP does, with these roles in the file."""
    lab.relay_file(feed={"roles": list(roles)})
    relay.reload()


def sends(robot: ClientDaemon) -> bool | None:
    """Whether the relay has said that somebody wants the robot's odometry; None: it has not said anything yet."""
    for channel in robot.core.link.sender.channels.values():
        if channel.stream.id.topic == ODOMETRY:
            return channel.wanted
    return None


async def comes(socket: "zmq.Socket[bytes]", frame: bytes) -> None:
    """Wait for a message of the topic."""

    def has_come() -> bool:
        while socket.poll(0):
            if socket.recv_multipart()[0] == frame:
                return True
        return False

    await until(has_come, f"a message of {frame!r}")


async def test_the_first_role_of_a_relay_may_come_and_the_last_may_go(tmp_path: Path, programs: Programs) -> None:
    async with Lab(tmp_path, "jackal1") as lab:
        relay = await lab.relay()
        assert relay.readers.feed is None
        robot = await lab.connected(lab.client_file("jackal1", ROBOT))
        await until(lambda: sends(robot) is False, "nobody wants its odometry")
        subscriber = programs.subscriber(b"")
        for _ in range(2):
            reload(lab, relay, programs.role(**VIEWER))
            await comes(subscriber, FRAME)
            reload(lab, relay)
            await until(lambda: sends(robot) is False, "it sends for nobody any more")
            await until(lambda: relay.readers.feed is None, "the feed is gone")
        await lab.end(robot)
        await lab.end(relay)


async def test_what_a_role_may_see_is_told_to_the_robots(tmp_path: Path, programs: Programs) -> None:
    async with Lab(tmp_path, "jackal1") as lab:
        relay = await lab.relay(lab.relay_file(feed={"roles": [programs.role(**VIEWER, subscribe=["/hello"])]}))
        robot = await lab.connected(lab.client_file("jackal1", ROBOT))
        subscriber = programs.subscriber(b"")
        await until(
            lambda: relay.readers.feed is not None and relay.readers.feed.feed.prefixes()["viewer"] == (b"",),
            "subscribed",
        )
        await until(lambda: sends(robot) is False, "nobody may see its odometry")
        reload(lab, relay, programs.role(**VIEWER, subscribe=["/jackal1/.*"]))
        await comes(subscriber, FRAME)
        assert sends(robot)
        reload(lab, relay, programs.role(**VIEWER, subscribe=["/jackal1/tf"]))
        await until(lambda: sends(robot) is False, "nobody may see it any more")
        reload(lab, relay, programs.role(**VIEWER))
        await comes(subscriber, FRAME)
        [elsewhere] = free_ports(1)
        reload(lab, relay, programs.role(**VIEWER, publish_endpoint=f"tcp://127.0.0.1:{elsewhere}"))
        await until(lambda: sends(robot) is False, "its subscriber is gone with the endpoint")
        await lab.end(robot)
        await lab.end(relay)


def at(name: str, endpoint: str, ingest_endpoint: str | None = None) -> FeedRole:
    everything = (compile_pattern(".*"),)
    return FeedRole(name, endpoint, ingest_endpoint, everything, () if ingest_endpoint is None else everything)


@pytest.mark.parametrize("transport", ["tcp", "ipc"])
async def test_endpoints_move_from_role_to_role(
    tmp_path: Path, programs: Programs, transport: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """libzmq lets go of an address on its own thread, and takes the file of an ipc address away then."""
    monkeypatch.setattr(feed_module, "RELEASE_S", DEADLINE_S)  # that thread may have no processor for a while
    first, second = (
        [f"tcp://127.0.0.1:{port}" for port in free_ports(2)]
        if transport == "tcp"
        else [f"ipc://{tmp_path}/{number}" for number in range(2)]
    )
    feed = Feed(programs.context, [at("a", first), at("b", second)])
    try:
        for number in range(60):
            here, there = (second, first) if number % 2 == 0 else (first, second)
            feed.update([at("a", here), at("b", there)])
            assert {name: endpoint for name, (endpoint, _) in feed.endpoints().items()} == {"a": here, "b": there}
        feed.update([at("c", first), at("d", second)])
        for role, endpoint in (("c", first), ("d", second)):
            socket = programs.context.socket(zmq.SUB)
            socket.subscribe(b"/r/")
            socket.connect(endpoint)
            await until(lambda role=role: feed.prefixes()[role] == (b"/r/",), f"{role} is reached")  # type: ignore[misc]
            socket.close(linger=0)
    finally:
        feed.close()


async def test_a_role_counts_on_where_one_of_its_endpoints_moves(programs: Programs) -> None:
    one, ingest, other = (
        f"tcp://127.0.0.1:{port}" for port in (programs.publish_port, programs.ingest_port, *free_ports(1))
    )
    feed = Feed(programs.context, [at("a", one, ingest)])
    try:
        publisher = await programs.publisher()
        send(publisher, "/hello", b"one")
        await until(lambda: feed.counters()["a"].received == 1, "one")
        feed.update([at("a", other, ingest)])
        send(publisher, "/hello", b"two")
        await until(lambda: feed.counters()["a"].received == 2, "two")
    finally:
        feed.close()


async def test_an_endpoint_that_is_in_use_is_taken_when_it_is_free(
    tmp_path: Path, programs: Programs, caplog: pytest.LogCaptureFixture
) -> None:
    async with Lab(tmp_path, "jackal1") as lab:
        relay = await lab.relay()
        robot = await lab.connected(lab.client_file("jackal1", ROBOT))
        [free] = free_ports(1)
        viewer = programs.role(**VIEWER)
        other = programs.role(**VIEWER | {"name": "other"}, publish_endpoint=f"tcp://127.0.0.1:{free}")
        with socketlib.create_server(("127.0.0.1", programs.publish_port)):
            reload(lab, relay, viewer, other)
            assert relay.readers.feed is not None
            assert list(relay.readers.feed.feed.endpoints()) == ["other"], "what can be had is in force"
            for _ in range(3):
                relay.feed_roles.look(now=clock.now())
            assert list(relay.readers.feed.feed.endpoints()) == ["other"]
            assert "not all of feed.roles are in force" in relay._status()
        await comes(programs.subscriber(b""), FRAME)
        assert set(relay.readers.feed.feed.endpoints()) == {"viewer", "other"}
        assert "in force" not in relay._status()
        assert relay.reloads.failures == 1
        assert caplog.text.count("not all of them are in force") == 1
        assert caplog.text.count("what had failed before is in force") == 1
        await lab.end(robot)
        await lab.end(relay)
