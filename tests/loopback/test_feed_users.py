"""Who subscribes to what at the feed, exactly: nobody ends or hides what another one subscribes to, or he himself."""

import asyncio
import socket as socketlib
from collections.abc import AsyncIterator, Iterable, Sequence
from pathlib import Path

import pytest
import zmq

from sern_core.topics.patterns import compile_pattern
from sern_core.topics.rules import FeedRole
from sern_core.vocabulary.types import PriorityClass, TopicName
from sern_runtime import feed as feed_module
from sern_runtime.feed import Feed, FeedHeader, topic_frame
from sern_runtime.zmq_setup import bind_all
from tests.loopback.test_feed_subscriptions import Raw, joined, names, port_of, room_for
from tests.support import until

Context = zmq.Context[zmq.Socket[bytes]]
ANY = compile_pattern(".*")
HEADER = FeedHeader(PriorityClass.STATE, 7, 1)
ODOM = TopicName("/r/odom")
FRAME = topic_frame(ODOM)
GREETING_2 = b"\xff" + bytes(8) + b"\x7f" + b"\x01" + b"\x02" + b"\0\0"
"""The greeting of a SUB that speaks ZMTP 2.0, with its empty identity."""


@pytest.fixture
async def feed(zmq_context: Context) -> AsyncIterator[Feed]:
    feed = Feed(zmq_context, [FeedRole("unity", "tcp://127.0.0.1:*", subscribe=(ANY,))])
    yield feed
    feed.close()


def subscriber(context: Context, feed: Feed, *prefixes: bytes) -> "zmq.Socket[bytes]":
    socket = context.socket(zmq.SUB)
    for prefix in prefixes:
        socket.subscribe(prefix)
    socket.connect(feed.endpoints()["unity"][0])
    return socket


async def unsubscribe(feed: Feed, peer: Raw, prefixes: Iterable[bytes]) -> None:
    """Until the feed has heard all of it."""
    for prefix in prefixes:
        await peer.send(b"\x02" + (1 + len(prefix)).to_bytes(8, "big") + b"\0" + prefix)
    await peer.subscribe([b"/heard"])
    await until(lambda: b"/heard" in feed.prefixes()["unity"], "heard")


async def served(feed: Feed, socket: "zmq.Socket[bytes]", body: bytes) -> None:
    assert feed.wants(ODOM)
    assert feed.publish(ODOM, HEADER, body) == 1
    await until(lambda: socket.poll(0), "a message")
    assert socket.recv_multipart() == [FRAME, HEADER.pack(), body]


class Old(Raw):
    """A program that speaks ZMTP 2.0, in which messages have no name of the connection."""

    async def greet(self) -> None:
        await self.send(GREETING_2)

    async def say(self, kind: bytes, prefixes: Iterable[bytes]) -> None:
        for prefix in prefixes:
            await self.send(b"\0" + bytes([1 + len(prefix)]) + kind + prefix)


async def test_what_another_one_unsubscribes_counts_still(feed: Feed) -> None:
    kept = room_for(feed, kept_bytes=1000, role_bytes=100_000)
    growing, other = await joined(feed, names("a", 10)), await joined(feed, [])
    await unsubscribe(feed, other, names("a", 10))
    assert set(feed.prefixes()["unity"]) == {*names("a", 10), b"/heard"}
    assert kept.total_bytes == 1000 + len(b"/heard") + 16
    assert not growing.cut()
    await growing.subscribe(names("b", 1))
    await until(growing.cut, "cut")
    assert feed.counters()["unity"].crowded == 1 and not other.cut()
    growing.close()
    other.close()


async def test_nobody_ends_what_another_one_subscribes_to(zmq_context: Context, feed: Feed) -> None:
    honest = subscriber(zmq_context, feed, FRAME)
    await until(lambda: feed.wants(ODOM), "subscribed")
    hostile = await joined(feed, [])
    await unsubscribe(feed, hostile, [FRAME])
    await served(feed, honest, b"once")
    hostile.close()
    twice = await joined(feed, [])
    await twice.subscribe([FRAME])
    await until(lambda: len(feed._outlets["unity"].subscriptions._prefixes[FRAME]) == 2, "subscribed")
    await unsubscribe(feed, twice, [FRAME, FRAME, FRAME])
    await served(feed, honest, b"twice")
    twice.close()
    await until(lambda: feed.prefixes()["unity"] == (FRAME,), "the end of the connection is seen")
    await served(feed, honest, b"at its end")
    honest.unsubscribe(FRAME)
    await until(lambda: not feed.wants(ODOM), "the last one unsubscribes")
    honest.close(linger=0)


async def test_the_end_of_a_connection_ends_what_it_alone_subscribes_to(zmq_context: Context, feed: Feed) -> None:
    kept = feed._outlets["unity"].subscriptions
    stays, ends = subscriber(zmq_context, feed, FRAME), await joined(feed, [FRAME, b"/alone", b"/too"])
    await until(lambda: kept.total_bytes == 2 * (len(FRAME) + 16) + len(b"/alone/too") + 32, "all subscribe")
    ends.close()
    await until(lambda: feed.prefixes()["unity"] == (FRAME,), "ended")
    assert kept.total_bytes == len(FRAME) + 16
    for _ in range(20):  # whoever has its number now inherits nothing
        again = await joined(feed, [b"/again"])
        assert feed.prefixes()["unity"] == (b"/again", FRAME)
        again.close()
        await until(lambda: feed.prefixes()["unity"] == (FRAME,), "ended")
    await served(feed, stays, b"body")
    stays.close(linger=0)
    await until(lambda: not feed.prefixes()["unity"], "ended")
    assert kept.total_bytes == 0 and not kept._by_fd and not kept._bytes and not kept._named


async def test_a_message_of_a_connection_that_has_ended_leaves_nothing(feed: Feed) -> None:
    outlet = feed._outlets["unity"]
    peer = await joined(feed, [b"/a"])
    (fd,) = outlet.subscriptions._by_fd
    peer.close()
    await until(lambda: not feed.prefixes()["unity"], "ended")
    outlet._subscribed(b"/late", fd)
    outlet._subscribed(b"/nameless", None)
    outlet._unsubscribed(b"/late", fd)
    assert not feed.prefixes()["unity"] and not outlet.subscriptions._by_fd


async def test_programs_at_a_socket_in_the_file_system(zmq_context: Context, tmp_path: Path) -> None:
    changes: list[Sequence[bytes]] = []
    local = Feed(
        zmq_context,
        [FeedRole("unity", f"ipc://{tmp_path}/feed", subscribe=(ANY,))],
        on_interest=lambda: changes.append(local.prefixes()["unity"]),
    )
    kept = room_for(local, kept_bytes=1000, role_bytes=1000)
    stays, ends = subscriber(zmq_context, local, FRAME), subscriber(zmq_context, local, FRAME, b"/alone")
    await until(
        lambda: len(kept._prefixes.get(FRAME, ())) == 2 and b"/alone" in local.prefixes()["unity"], "subscribed"
    )
    ends.close(linger=0)
    await until(lambda: local.prefixes()["unity"] == (FRAME,), "ended")
    await served(local, stays, b"body")
    for prefix in names("many", 20):
        stays.subscribe(prefix)
    await until(lambda: len(local.prefixes()["unity"]) == 21, "nobody can cut it")
    await served(local, stays, b"many")
    assert kept.crowded == 0 and kept.total_bytes == 0
    stays.close(linger=0)
    await until(lambda: changes and changes[-1] == (), "all have ended")
    local.close()


async def test_a_subscription_among_other_frames_counts(feed: Feed) -> None:
    """libzmq takes it for one, wherever it stands."""
    room_for(feed, kept_bytes=1000, role_bytes=100_000)
    peer = await joined(feed, [])
    await peer.send(b"\x01\x01x" * 20 + b"\x00\x07\x01/among")
    await until(lambda: feed.prefixes()["unity"] == (b"/among",), "subscribed")
    for name in names("among", 10):
        await peer.send(b"\x01\x01x\x00" + bytes([1 + len(name)]) + b"\1" + name)
    await until(peer.cut, "cut")
    assert feed.counters()["unity"].crowded == 1
    peer.close()


async def test_who_speaks_an_older_protocol_is_served_and_bounded(zmq_context: Context, feed: Feed) -> None:
    room_for(feed, kept_bytes=1000, role_bytes=100_000)
    new, old = await joined(feed, [b"/new"]), Old(port_of(feed))
    await old.greet()
    await old.say(b"\1", [FRAME])
    await until(lambda: feed.wants(ODOM), "subscribed")
    ends = subscriber(zmq_context, feed, FRAME, b"/ends")
    await until(lambda: b"/ends" in feed.prefixes()["unity"], "subscribed")
    ends.close(linger=0)
    await until(lambda: b"/ends" not in feed.prefixes()["unity"], "ended")
    assert feed.publish(ODOM, HEADER, b"body") == 1
    old.connection.settimeout(30)
    data = b""
    while b"body" not in data:
        data += await asyncio.to_thread(old.connection.recv, 4096)
    old.connection.close()
    await until(lambda: feed.prefixes()["unity"] == (b"/new",), "its end is seen")
    endless = Old(port_of(feed))
    await endless.greet()
    await endless.say(b"\1", names("endless", 11))
    await until(endless.cut, "cut")
    await until(lambda: feed.prefixes()["unity"] == (b"/new",), "what it subscribed to is gone")
    assert feed.counters()["unity"].crowded == 1 and not new.cut()
    new.close()
    endless.close()


async def test_a_connection_that_is_made_at_once_is_known(
    zmq_context: Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[socketlib.socket] = []

    def bind(socket: "zmq.Socket[bytes]", endpoints: Sequence[str]) -> tuple[str, ...]:
        bound = bind_all(socket, endpoints)
        made.append(socketlib.create_connection(("127.0.0.1", int(bound[0].rpartition(":")[2]))))
        assert made[-1].recv(1) == b"\xff"  # it is accepted
        return bound

    monkeypatch.setattr(feed_module, "bind_all", bind)
    role = FeedRole("unity", "tcp://127.0.0.1:*", ingest_endpoint="tcp://127.0.0.1:*", subscribe=(ANY,), publish=(ANY,))
    feed = Feed(zmq_context, [role])
    for part in (feed._outlets["unity"], feed._inlets["unity"]):
        part.inflow.connections._monitor.drain()
        assert len(part.inflow.connections) == 1
    for connection in made:
        connection.close()
    feed.close()
