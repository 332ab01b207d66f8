"""What a program on the feed may subscribe to: what may name topics, and not more than a table of it may take."""

import asyncio
import socket as socketlib
from collections.abc import AsyncIterator, Callable, Collection, Iterable
from typing import cast

import pytest
import zmq

from sern_core.relay.hub import Hub
from sern_core.topics.patterns import compile_pattern
from sern_core.topics.rules import FeedRole
from sern_core.vocabulary.types import PriorityClass, TopicName
from sern_relay.feed import INTEREST_STREAMS, MOST_FAR, RelayFeed
from sern_runtime import feed_inflow, feed_subscriptions
from sern_runtime.feed import MAX_SUBSCRIPTION_BYTES, MAX_TOPIC_BYTES, Feed, FeedHeader, topic_frame
from sern_runtime.feed_subscriptions import ENTRY_BYTES, Subscriptions
from sern_runtime.monitor import Connection
from tests.loopback.test_inflow import GREETING
from tests.support import until

Context = zmq.Context[zmq.Socket[bytes]]
ANY = compile_pattern(".*")
READY = b"\x05READY\x0bSocket-Type\x00\x00\x00\x03SUB"
HEADER = FeedHeader(PriorityClass.STATE, 7, 1)
LONGEST = TopicName("/" + "a" * (MAX_TOPIC_BYTES - 2))


@pytest.fixture
async def feed(zmq_context: Context) -> AsyncIterator[Feed]:
    feed = Feed(zmq_context, [FeedRole("unity", "tcp://127.0.0.1:*", subscribe=(ANY,))])
    yield feed
    feed.close()


def port_of(feed: Feed) -> int:
    return int(feed.endpoints()["unity"][0].rpartition(":")[2])


class Raw:
    """A program that speaks ZMTP 3.0 as a SUB does, and says what it likes."""

    def __init__(self, port: int) -> None:
        self.connection = socketlib.create_connection(("127.0.0.1", port))
        self.ended = False

    async def greet(self) -> None:
        """Greet as a SUB: it says nothing more before it has heard that it may."""
        await self.send(GREETING)
        await asyncio.to_thread(self._read, 64)
        await self.send(b"\x04" + bytes([len(READY)]) + READY)
        head = await asyncio.to_thread(self._read, 2)
        await asyncio.to_thread(self._read, head[1])

    def _read(self, size: int) -> bytes:
        data = b""
        while len(data) < size:
            more = self.connection.recv(size - len(data))
            assert more, "the feed has closed the connection"
            data += more
        return data

    async def subscribe(self, prefixes: Iterable[bytes]) -> None:
        for prefix in prefixes:
            await self.send(b"\x02" + (1 + len(prefix)).to_bytes(8, "big") + b"\1" + prefix)

    async def send(self, data: bytes) -> None:
        def send() -> None:
            try:
                self.connection.sendall(data)
            except OSError:
                self.ended = True

        if not self.ended:
            await asyncio.to_thread(send)

    def cut(self) -> bool:
        """Whether the feed has closed the connection."""
        self.connection.setblocking(False)
        try:
            while not self.ended:
                self.ended = not self.connection.recv(4096)
        except BlockingIOError:
            return False
        except OSError:
            self.ended = True
        return True

    def close(self) -> None:
        self.connection.close()


async def test_the_longest_topic_can_be_subscribed_to(zmq_context: Context, feed: Feed) -> None:
    prefix = topic_frame(LONGEST)
    assert len(prefix) == MAX_TOPIC_BYTES
    subscriber = zmq_context.socket(zmq.SUB)
    subscriber.subscribe(prefix)
    subscriber.connect(feed.endpoints()["unity"][0])
    await until(lambda: feed.prefixes()["unity"] == (prefix,), "subscribed")
    assert feed.publish(LONGEST, HEADER, b"body") == 1
    await until(lambda: subscriber.poll(0), "a message")
    assert subscriber.recv_multipart()[0] == prefix
    subscriber.close(linger=0)


async def test_what_is_longer_than_a_topic_ends_the_connection(zmq_context: Context, feed: Feed) -> None:
    peer = Raw(port_of(feed))
    await peer.greet()
    await peer.subscribe([b"/" * MAX_SUBSCRIPTION_BYTES])
    await until(peer.cut, "cut")
    assert feed.prefixes()["unity"] == ()
    peer.close()


async def test_a_connection_has_so_many_bytes_of_subscriptions(feed: Feed) -> None:
    scene, endless = Raw(port_of(feed)), Raw(port_of(feed))
    await scene.greet()
    await scene.subscribe(b"/jackal%d/%s\0" % (number, b"x" * 80) for number in range(400))
    await until(lambda: len(feed.prefixes()["unity"]) == 400, "a scene of some hundred topics is served")
    await endless.greet()
    more = feed_inflow.SUBSCRIBER_BYTES // 400
    await endless.subscribe(b"/%d/%s" % (number, b"y" * 450) for number in range(more))
    await until(endless.cut, "cut")
    await until(lambda: len(feed.prefixes()["unity"]) == 400, "what it subscribed to is gone")
    assert feed.counters()["unity"].endless == 1 and not scene.cut()
    scene.close()
    endless.close()


async def test_a_flood_of_subscriptions_ends_long_before_its_end(feed: Feed, monkeypatch: pytest.MonkeyPatch) -> None:
    outlet = feed._outlets["unity"]
    subscribed = outlet._subscribed
    taken_bytes = 0

    def count(prefix: bytes, fd: int | None) -> None:
        nonlocal taken_bytes
        taken_bytes += len(prefix)
        subscribed(prefix, fd)

    monkeypatch.setattr(outlet, "_subscribed", count)
    peer = Raw(port_of(feed))
    await peer.greet()
    frames = (b"\x00\xc9\x01" + (b"/%d/" % number).ljust(200, b"z") for number in range(75_000))
    await peer.send(b"".join(frames))
    await until(peer.cut, "cut")
    await until(lambda: not feed.prefixes()["unity"], "what it subscribed to is gone")
    assert feed_inflow.SUBSCRIBER_BYTES // 2 < taken_bytes < 4 * 2**20
    peer.close()


def room_for(feed: Feed, *, kept_bytes: int, role_bytes: int, max_connections: int = 4) -> Subscriptions:
    """The feed has only so much room from now on."""
    outlet = feed._outlets["unity"]
    outlet.subscriptions = Subscriptions(
        "unity",
        outlet.inflow.connections,
        kept_bytes=kept_bytes,
        role_bytes=role_bytes,
        max_connections=max_connections,
    )
    return outlet.subscriptions


def somebody(feed: Feed) -> int:
    """The number of a connection of which only the feed's list knows."""
    fd = 10**6
    feed._outlets["unity"].inflow.connections._connections[fd] = Connection(None, "", 0.0)
    return fd


async def joined(feed: Feed, prefixes: Iterable[bytes]) -> Raw:
    peer = Raw(port_of(feed))
    await peer.greet()
    wanted = set(prefixes)
    await peer.subscribe(sorted(wanted))
    await until(lambda: peer.cut() or wanted <= set(feed.prefixes()["unity"]), "subscribed")
    return peer


def names(tag: str, count: int) -> list[bytes]:
    """Make so many prefixes, each of 100 bytes with what it counts."""
    return [(b"/%s/%d/" % (tag.encode(), number)).ljust(100 - ENTRY_BYTES, b"z") for number in range(count)]


async def test_what_grows_for_ever_ends(feed: Feed, monkeypatch: pytest.MonkeyPatch) -> None:
    """However slowly: the trickle that a connection may bring is no way round what it may keep."""
    kept = room_for(feed, kept_bytes=1000, role_bytes=100_000)
    peer = await joined(feed, names("slow", 10))
    assert kept.total_bytes == 1000 and not peer.cut()
    await peer.subscribe(names("slow", 10) * 20)
    await peer.send(b"".join(b"\x00\x05\x00/no%d" % number for number in range(9)))  # ends that are none
    await peer.subscribe([b"/one-too-many"])
    await until(peer.cut, "cut")
    await until(lambda: not feed.prefixes()["unity"], "what it subscribed to is gone")
    assert feed.counters()["unity"].crowded == 1 and feed.counters()["unity"].endless == 0
    assert kept.total_bytes == 0
    peer.close()


async def test_the_newest_above_its_share_makes_room(feed: Feed, caplog: pytest.LogCaptureFixture) -> None:
    kept = room_for(feed, kept_bytes=3000, role_bytes=4000)  # a share is 1000
    old = await joined(feed, names("old", 18))
    evil = await joined(feed, names("evil", 20))
    small = await joined(feed, names("small", 2))
    assert kept.total_bytes == 4000
    await old.subscribe(names("late", 1))
    await until(evil.cut, "cut")
    await until(lambda: set(feed.prefixes()["unity"]) == {*names("old", 18), *names("late", 1), *names("small", 2)})
    assert kept.total_bytes == 2100 and not old.cut() and not small.cut()
    assert feed.counters()["unity"].crowded == 1
    assert caplog.text.count("connection of feed role unity from 127.0.0.1 closed") == 1
    again = await joined(feed, names("evil", 20))
    assert again.cut() and feed.counters()["unity"].crowded == 2
    for peer in (old, small, evil, again):
        peer.close()


async def test_one_prefix_of_many_counts_for_each(feed: Feed) -> None:
    kept = room_for(feed, kept_bytes=3000, role_bytes=4000)
    peers = [await joined(feed, names("same", 10)) for _ in range(3)]
    await until(lambda: kept.total_bytes == 3000)
    assert len(kept) == 10
    peers[0].close()
    await until(lambda: kept.total_bytes == 2000)
    assert len(kept) == 10
    for peer in peers[1:]:
        peer.close()
    await until(lambda: kept.total_bytes == 0 and not feed.prefixes()["unity"])


async def test_a_role_may_have_what_its_connections_share(feed: Feed) -> None:
    outlet = feed._outlets["unity"].subscriptions
    assert outlet._role_bytes == feed_subscriptions.ROLE_BYTES
    assert outlet._share_bytes * feed_inflow.MAX_CONNECTIONS <= feed_subscriptions.ROLE_BYTES
    assert feed_inflow.SUBSCRIBER_BYTES < outlet._kept_bytes < feed_subscriptions.ROLE_BYTES // 4


async def test_a_role_has_so_many_connections(feed: Feed) -> None:
    connections = feed._outlets["unity"].inflow.connections
    assert connections.max_connections == feed_inflow.MAX_CONNECTIONS > 0
    connections.max_connections = 3
    peers = [Raw(port_of(feed)) for _ in range(5)]
    await until(lambda: sum(peer.cut() for peer in peers) == 2, "those above the cap are cut")
    assert feed.counters()["unity"].capped == 2
    for peer in peers:
        peer.close()


async def test_many_subscriptions_are_told_once(zmq_context: Context) -> None:
    changes: list[tuple[bytes, ...]] = []
    plain = Feed(
        zmq_context,
        [FeedRole("unity", "tcp://127.0.0.1:*", subscribe=(ANY,))],
        on_interest=lambda: changes.append(plain.prefixes()["unity"]),
    )
    outlet = plain._outlets["unity"]
    fd = somebody(plain)
    for number in range(1000):
        outlet._subscribed(b"/t%03d" % number, fd)
    assert changes == []
    await until(lambda: changes, "told")
    assert len(changes[0]) == 1000 and len(outlet.subscriptions._lengths) == 1
    for number in range(1000):
        outlet._unsubscribed(b"/t%03d" % number, fd)
    await until(lambda: changes[-1] == (), "told of the end")
    assert len(changes) == 2 and not outlet.subscriptions._lengths
    outlet._subscribed(b"/late", fd)
    telling = plain._telling
    assert telling is not None
    plain.close()
    assert telling.cancelled(), "nothing is told after the end"


async def test_prefixes_match_as_they_do_at_libzmq(feed: Feed) -> None:
    outlet = feed._outlets["unity"]
    fd = somebody(feed)
    names = [TopicName(name) for name in ("/a", "/ab", "/a/b", "/a/bc", "/b", "/b/" + "c" * 100)]
    prefixes = [b"", b"/", b"/a", b"/a\0", b"/a/b", b"/a/b\0", b"/b/ccc", b"/b\0", b"/a/bcd", b"/b/" + b"c" * 200]
    for prefix in prefixes:
        outlet._subscribed(prefix, fd)
        outlet._subscribed(b"/zz", fd)
        for name in names:
            assert outlet.wants(topic_frame(name), name) == topic_frame(name).startswith(prefix)
        outlet._unsubscribed(prefix, fd)
        outlet._unsubscribed(b"/zz", fd)


class Streams:
    """What `RelayFeed` asks of a hub with so many streams."""

    def __init__(self, count: int) -> None:
        self.relayed = dict.fromkeys(range(count))
        self.local_owners: set[str] = set()
        self.streams = self.exchange = self.peers = self.far = self
        self.topics: dict[str, int] = {}  # of other relays
        self.on_topic: Callable[[TopicName], None] = lambda _topic: None
        self.also: Callable[[], Collection[str]] = tuple
        self.tap: object = None
        self.told: list[list[int]] = []

    def refresh_interest(self, streams: list[int], *, now: float) -> None:
        self.told.append(streams)


async def test_the_origins_are_told_in_slices(zmq_context: Context) -> None:
    count = 3 * INTEREST_STREAMS + 7
    hub = Streams(count)
    role = FeedRole("unity", "tcp://127.0.0.1:*", subscribe=(ANY,))
    feed = RelayFeed(
        zmq_context, cast("Hub", hub), (role,), after=lambda: None, refused=lambda *_refusal: None, clock=lambda: 0.0
    )
    feed._interest()
    assert [len(each) for each in hub.told] == [INTEREST_STREAMS]
    feed._interest()  # it changes again and again before all have heard
    feed._interest()
    assert len(hub.told) == 1
    await until(lambda: feed._going_on is None, "all have heard")
    assert all(len(each) <= INTEREST_STREAMS for each in hub.told)
    heard = [stream for each in hub.told for stream in each]
    assert sorted(heard[:count]) == sorted(heard[count:]) == list(range(count))
    feed.close()


async def test_topics_of_other_relays_are_asked_for_by_name_and_very_many_by_what_the_role_may_see(
    zmq_context: Context,
) -> None:
    hub = Streams(0)
    role = FeedRole("unity", "tcp://127.0.0.1:*", subscribe=(compile_pattern("/robot/.*"),))
    feed = RelayFeed(
        zmq_context, cast("Hub", hub), (role,), after=lambda: None, refused=lambda *_refusal: None, clock=lambda: 0.0
    )

    async def there_are(*names: str) -> set[str]:
        changed = {*names} ^ hub.topics.keys()
        hub.topics = dict.fromkeys(names, 1)
        for name in changed:
            hub.on_topic(TopicName(name))
        await until(lambda: feed._going_on is None, "looked at")
        return set(hub.also())

    feed.feed._outlets["unity"]._subscribed(b"/robot/a", somebody(feed.feed))
    assert await there_are("/robot/a", "/robot/ab", "/robot/b", "/other/a") == {"/robot/a", "/robot/ab"}
    assert await there_are(*(f"/robot/a{each}" for each in range(MOST_FAR + 1))) == {"/robot/.*"}
    assert await there_are("/robot/a0", "/robot/b") == {"/robot/a0"}
    assert await there_are() == set()
    feed.close()
    assert hub.also() == ()
