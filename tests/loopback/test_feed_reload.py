"""SIGHUP and the feed: roles come, change and go while a robot publishes and a plain program listens."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zmq

from sern_client.daemon import ClientDaemon
from sern_core.types import TopicName
from sern_relay.daemon import RelayDaemon
from sern_tools.ports import free_ports
from tests.daemons import Lab
from tests.loopback.test_feed_clients import ROBOT, Programs
from tests.support import until

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
    """As SIGHUP does, with these roles in the file."""
    lab.relay_file(feed={"roles": list(roles)})
    relay.reload()


def sends(robot: ClientDaemon) -> bool | None:
    """Whether the relay has said that somebody wants the robot's odometry; None: it has not said anything yet."""
    for channel in robot.core.link.channels.values():
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
        assert relay.feed is None
        robot = await lab.connected(lab.client_file("jackal1", ROBOT))
        await until(lambda: sends(robot) is False, "nobody wants its odometry")
        subscriber = programs.subscriber(b"")
        for _ in range(2):
            reload(lab, relay, programs.role(**VIEWER))
            await comes(subscriber, FRAME)
            reload(lab, relay)
            await until(lambda: sends(robot) is False, "it sends for nobody any more")
            await until(lambda: relay.feed is None, "the feed is gone")
        await lab.end(robot)
        await lab.end(relay)


async def test_what_a_role_may_see_is_told_to_the_robots(tmp_path: Path, programs: Programs) -> None:
    async with Lab(tmp_path, "jackal1") as lab:
        relay = await lab.relay(lab.relay_file(feed={"roles": [programs.role(**VIEWER, subscribe=["/hello"])]}))
        robot = await lab.connected(lab.client_file("jackal1", ROBOT))
        subscriber = programs.subscriber(b"")
        await until(lambda: relay.feed is not None and relay.feed.feed.prefixes()["viewer"] == (b"",), "subscribed")
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
