"""The feed in front of real clients: plain ZeroMQ programs see what a robot sends, and drive it."""

import struct
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import zmq

from sern_client.endpoints.synthetic import SyntheticEndpoint
from sern_core.stream.prices import MESSAGE_OVERHEAD_BYTES
from sern_core.vocabulary.types import ClientName, DropReason, Encoding, PriorityClass, TopicName
from sern_relay.daemon import RelayDaemon
from sern_relay.feed import InjectCounters, RelayFeed
from sern_runtime import ros_types
from sern_runtime.feed import HEADER, FeedHeader
from sern_tools.ports import free_ports
from tests.daemons import Lab, endpoint_of
from tests.support import until

TWIST = struct.Struct("<6d")
CMD = TopicName("/jackal1/cmd_vel")
UNITY: dict[str, Any] = {
    "name": "unity",
    "subscribe": ["/jackal1/.*", "/hello"],
    "publish": ["/jackal1/.*", "/hello"],
    "allow_control": True,
    "types": [
        {"match": "/jackal1/cmd_vel", "type": "geometry_msgs/Twist"},
        {
            "match": "/jackal1/goal",
            "type": "geometry_msgs/PoseStamped",
            "class": "state",
            "durability": "transient_local",
        },
    ],
}
ROBOT = {
    "kind": "synthetic",
    "role": "robot",
    "topics": ["/odometry/filtered", "/tf"],
    "cloud_rate_hz": 0,
    "map_rate_hz": 0,
}


class Programs:
    """Plain sockets around a relay's feed."""

    def __init__(self) -> None:
        self.context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self.publish_port, self.ingest_port = free_ports(2)
        self._sockets: list[zmq.Socket[bytes]] = []

    def close(self) -> None:
        for socket in self._sockets:
            socket.close(linger=0)
        self.context.term()

    def _socket(self, kind: int) -> "zmq.Socket[bytes]":
        socket = self.context.socket(kind)
        self._sockets.append(socket)
        return socket

    def role(self, **more: object) -> dict[str, Any]:
        return {
            **UNITY,
            "publish_endpoint": f"tcp://127.0.0.1:{self.publish_port}",
            "ingest_endpoint": f"tcp://127.0.0.1:{self.ingest_port}",
            **more,
        }

    def subscriber(self, *prefixes: bytes) -> "zmq.Socket[bytes]":
        socket = self._socket(zmq.SUB)
        for prefix in prefixes:
            socket.subscribe(prefix)
        socket.connect(f"tcp://127.0.0.1:{self.publish_port}")
        return socket

    async def publisher(self) -> "zmq.Socket[bytes]":
        """An XPUB, to see when the relay listens; for the relay it is no different from PUB."""
        socket = self._socket(zmq.XPUB)
        socket.connect(f"tcp://127.0.0.1:{self.ingest_port}")
        await until(partial(socket.poll, 0), "heard")
        assert socket.recv() == b"\1"
        return socket


@pytest.fixture
def programs() -> Iterator[Programs]:
    programs = Programs()
    yield programs
    programs.close()


def feed_of(relay: RelayDaemon) -> RelayFeed:
    assert relay.readers.feed is not None
    return relay.readers.feed


def counters(relay: RelayDaemon) -> InjectCounters:
    return feed_of(relay).counters["unity"]


def dropped(relay: RelayDaemon, name: str, reason: DropReason) -> int:
    found = relay.hub.received.topics.get(TopicName(name))
    return found.by_reason[reason] if found is not None else 0


def send(socket: "zmq.Socket[bytes]", name: str, body: bytes, header: bytes = b"") -> None:
    socket.send_multipart([name.encode() + b"\0", header, body])


async def test_a_program_without_sern_code_sees_odometry_and_drives(tmp_path: Path, programs: Programs) -> None:
    async with Lab(tmp_path, "jackal1") as lab:
        relay = await lab.relay(lab.relay_file(feed={"roles": [programs.role()]}))
        robot = await lab.connected(
            lab.client_file(
                "jackal1",
                ROBOT,
                client={"frame_prefix": "jackal1/"},
                topics=[{"match": "/cmd_vel", "class": "control", "direction": "receive"}],
            )
        )
        odometry = programs.subscriber(b"/jackal1/odometry/filtered\0")
        await until(partial(odometry.poll, 0), "odometry")
        before_ns = time.time_ns()
        topic, header, body = odometry.recv_multipart()
        assert topic == b"/jackal1/odometry/filtered\0"
        version, priority, zero, seq, stamp_ns, age_us = HEADER.unpack(header)
        assert (version, zero) == (1, 0)
        assert priority == PriorityClass.BULK
        assert seq >= 1
        assert 0 <= before_ns - stamp_ns < 30e9
        assert age_us < 30e6
        message = ros_types.deserialise(body, "nav_msgs/msg/Odometry", Encoding.ROS1)
        assert (message.header.frame_id, message.child_frame_id) == ("jackal1/odom", "jackal1/base_link")

        start_x_m = endpoint_of(robot, SyntheticEndpoint).state().pose.x_m
        publisher = await programs.publisher()
        own = programs.subscriber(b"/jackal1/cmd_vel\0")
        await until(lambda: b"/jackal1/cmd_vel\0" in feed_of(relay).feed.prefixes()["unity"], "subscribed")
        go = TWIST.pack(0.5, 0, 0, 0, 0, 0)
        count = 0

        def driven() -> bool:
            return bool(abs(endpoint_of(robot, SyntheticEndpoint).state().pose.x_m - start_x_m) > 0.2)

        def drive() -> bool:
            nonlocal count
            if driven():
                return True
            send(publisher, CMD, go)
            count += 1
            return False

        await until(drive, "the robot moves")
        owner = ClientName("feed_unity")
        assert relay.hub.routing.owners(CMD) == (owner,)
        await until(lambda: counters(relay).injected == count, "all have come in")
        held = relay.hub.objects.get(f"{CMD}@feed_unity")
        assert held is not None
        assert (held.kind, held.value) == ("command", go)
        got: list[list[bytes]] = []
        await until(lambda: drained(own, got) == count, "the role's own subscribers see each message once")
        assert {frames[2] for frames in got} == {go}
        relay.hub.validate()


def drained(socket: "zmq.Socket[bytes]", into: list[list[bytes]]) -> int:
    while socket.poll(0):
        into.append(socket.recv_multipart())
    return len(into)


async def test_old_commands_do_not_reach_the_robot(tmp_path: Path, programs: Programs) -> None:
    async with Lab(tmp_path, "site") as lab:
        relay = await lab.relay(lab.relay_file(feed={"roles": [programs.role()]}))
        publisher = await programs.publisher()
        wall_ns = time.time_ns()
        send(publisher, CMD, TWIST.pack(*[0.0] * 6), FeedHeader(PriorityClass.CONTROL, 1, wall_ns - 10**9).pack())
        send(publisher, CMD, TWIST.pack(*[0.0] * 6), FeedHeader(PriorityClass.CONTROL, 2, 0, 400_000).pack())
        await until(lambda: dropped(relay, CMD, DropReason.LIFESPAN) == 2, "two late commands")
        assert counters(relay).injected == 0
        send(publisher, CMD, TWIST.pack(*[0.0] * 6), FeedHeader(PriorityClass.CONTROL, 3, 0, 100_000).pack())
        await until(lambda: counters(relay).injected == 1, "a fresh one")


async def test_a_name_that_a_client_owns_is_refused(tmp_path: Path, programs: Programs) -> None:
    async with Lab(tmp_path, "jackal1") as lab:
        access = [{"client": ".*", "publish": [".*"], "subscribe": [".*"]}]
        relay = await lab.relay(lab.relay_file(feed={"roles": [programs.role()]}, access=access))
        operator = {"kind": "synthetic", "role": "operator", "goal_rate_hz": 0}
        await lab.connected(lab.client_file("jackal1", operator, topics=[{"match": "/cmd_vel", "class": "control"}]))
        await until(lambda: relay.hub.routing.owners(CMD) == ("jackal1",), "the client owns the name")
        publisher = await programs.publisher()
        for _ in range(3):
            send(publisher, CMD, TWIST.pack(*[0.0] * 6))
        await until(lambda: feed_of(relay).feed.counters()["unity"].forbidden == 3, "refused")
        assert {code: count for code, count in relay.news.refusals.items() if count} == {"name_taken": 1}
        assert counters(relay).injected == 0
        assert relay.hub.routing.owners(CMD) == ("jackal1",)


async def test_what_has_no_type_stays_within_the_feed(tmp_path: Path, programs: Programs) -> None:
    async with Lab(tmp_path, "site") as lab:
        relay = await lab.relay(lab.relay_file(feed={"roles": [programs.role()]}))
        subscriber = programs.subscriber(b"/hello\0")
        publisher = await programs.publisher()
        await until(lambda: feed_of(relay).feed.prefixes()["unity"], "subscribed")
        send(publisher, "/hello", b"anything")
        got: list[list[bytes]] = []
        await until(lambda: drained(subscriber, got) == 1, "the feed has it")
        await until(lambda: counters(relay).untyped == 1, "counted")
        assert not relay.hub.relayed


async def test_a_role_without_the_right_cannot_command(tmp_path: Path, programs: Programs) -> None:
    async with Lab(tmp_path, "site") as lab:
        role = programs.role(allow_control=False, types=[])
        relay = await lab.relay(lab.relay_file(feed={"roles": [role]}))
        publisher = await programs.publisher()
        send(publisher, CMD, TWIST.pack(*[0.0] * 6), FeedHeader(PriorityClass.CONTROL, 1, 0).pack())
        await until(lambda: feed_of(relay).feed.counters()["unity"].forbidden == 1, "refused")
        send(publisher, CMD, TWIST.pack(*[0.0] * 6))
        await until(lambda: counters(relay).untyped == 1, "within the feed only")
        assert not relay.hub.relayed


async def test_a_quiet_topic_gives_its_name_back_and_latched_state_does_not(tmp_path: Path, programs: Programs) -> None:
    async with Lab(tmp_path, "site") as lab:
        relay = await lab.relay(lab.relay_file(feed={"roles": [programs.role()]}))
        publisher = await programs.publisher()
        goal = ros_types.serialise(
            ros_types.new("geometry_msgs/msg/PoseStamped", Encoding.ROS1),
            "geometry_msgs/msg/PoseStamped",
            Encoding.ROS1,
        )
        send(publisher, CMD, TWIST.pack(*[0.0] * 6))
        send(publisher, "/jackal1/goal", goal)
        await until(lambda: counters(relay).injected == 2, "both came in")
        last_s = feed_of(relay)._sources["unity", CMD].last_s
        feed_of(relay).sweep(now=last_s + 29.0)
        assert len(relay.hub.relayed) == 2
        feed_of(relay).sweep(now=last_s + 31.0)
        assert [identity.topic for identity in relay.hub.relayed] == ["/jackal1/goal"]
        assert relay.hub.streams.replays.held_bytes == len(goal) + MESSAGE_OVERHEAD_BYTES
        send(publisher, CMD, TWIST.pack(*[0.0] * 6))
        await until(lambda: counters(relay).injected == 3, "and it may speak again")
        assert len(relay.hub.relayed) == 2


async def test_new_access_rules_end_what_a_role_publishes(tmp_path: Path, programs: Programs) -> None:
    async with Lab(tmp_path, "site") as lab:
        relay = await lab.relay(lab.relay_file(feed={"roles": [programs.role()]}))
        publisher = await programs.publisher()
        send(publisher, CMD, TWIST.pack(*[0.0] * 6))
        await until(lambda: counters(relay).injected == 1, "it came in")
        lab.relay_file(feed={"roles": [programs.role(publish=["/hello"], allow_control=False, types=[])]})
        relay.reload()
        assert not relay.hub.relayed
        send(publisher, CMD, TWIST.pack(*[0.0] * 6))
        await until(lambda: feed_of(relay).feed.counters()["unity"].forbidden == 1, "refused")
