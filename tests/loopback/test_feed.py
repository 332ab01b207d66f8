"""The feed, as a program without SERN code sees it: plain PUB and SUB sockets."""

import socket as socketlib
from collections.abc import AsyncIterator, Iterable
from dataclasses import replace
from functools import partial

import pytest
import zmq
from hypothesis import given
from hypothesis import strategies as st

from sern_core.topics.patterns import compile_pattern
from sern_core.topics.rules import FeedRole
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.types import PriorityClass, TopicName
from sern_runtime.feed import Feed, FeedHeader, parse_topic, topic_frame
from tests.support import until

Context = zmq.Context[zmq.Socket[bytes]]
ANY = compile_pattern(".*")
ODOM = TopicName("/r/odom")
HEADER = FeedHeader(PriorityClass.STATE, 7, 1_700_000_000_000_000_000, 1500)


def role(
    name: str = "viewer",
    *,
    see: str = ".*",
    publish: str | None = None,
    allow_control: bool = False,
    publish_endpoint: str = "tcp://127.0.0.1:*",
) -> FeedRole:
    return FeedRole(
        name,
        publish_endpoint,
        ingest_endpoint=None if publish is None else "tcp://127.0.0.1:*",
        subscribe=(compile_pattern(see),),
        publish=() if publish is None else (compile_pattern(publish),),
        allow_control=allow_control,
    )


class World:
    """A feed, and the plain sockets around it."""

    def __init__(self, context: Context) -> None:
        self.context = context
        self.came_in: list[tuple[str, str, FeedHeader, bytes]] = []
        self.changes = 0
        self.feed: Feed | None = None
        self.sockets: list[zmq.Socket[bytes]] = []

    def start(self, roles: Iterable[FeedRole], **options: object) -> Feed:
        self.feed = Feed(
            self.context,
            roles,
            on_publish=lambda role, name, header, body: self.came_in.append((role.name, name, header, body)),
            on_interest=self._changed,
            wall_ns=lambda: 99,
            **options,  # type: ignore[arg-type]
        )
        return self.feed

    def _changed(self) -> None:
        self.changes += 1

    async def subscriber(self, feed: Feed, name: str, *prefixes: bytes) -> "zmq.Socket[bytes]":
        socket = self.context.socket(zmq.SUB)
        self.sockets.append(socket)
        for prefix in prefixes:
            socket.subscribe(prefix)
        socket.connect(feed.endpoints()[name][0])
        await until(lambda: set(prefixes) <= set(feed.prefixes()[name]), "subscribed")
        return socket

    async def publisher(self, feed: Feed, name: str) -> "zmq.Socket[bytes]":
        """A PUB that the feed hears: a socket of type XPUB, to see when the feed's subscription is there."""
        endpoint = feed.endpoints()[name][1]
        assert endpoint is not None
        socket = self.context.socket(zmq.XPUB)
        self.sockets.append(socket)
        socket.connect(endpoint)
        await until(partial(socket.poll, 0), "heard")
        assert socket.recv() == b"\1"
        return socket

    def close(self) -> None:
        for socket in self.sockets:
            socket.close(linger=0)
        if self.feed is not None:
            self.feed.close()


@pytest.fixture
async def world(zmq_context: Context) -> AsyncIterator[World]:
    world = World(zmq_context)
    yield world
    world.close()


async def received(socket: "zmq.Socket[bytes]") -> list[bytes]:
    await until(partial(socket.poll, 0), "a message")
    return socket.recv_multipart()


async def test_a_message_reaches_a_plain_subscriber(world: World) -> None:
    feed = world.start([role()])
    subscriber = await world.subscriber(feed, "viewer", b"/r/odom\0")
    await until(lambda: world.changes == 1, "told")
    assert feed.publish(ODOM, HEADER, b"body") == 1
    frames = await received(subscriber)
    assert frames == [b"/r/odom\0", HEADER.pack(), b"body"]
    assert FeedHeader.parse(frames[1]) == HEADER


async def test_the_nul_keeps_a_longer_name_apart_unless_asked(world: World) -> None:
    feed = world.start([role()])
    exact = await world.subscriber(feed, "viewer", b"/r/odom\0")
    prefix = await world.subscriber(feed, "viewer", b"/r/odom")
    assert feed.publish(TopicName("/r/odom_filtered"), HEADER, b"filtered") == 1
    assert feed.publish(ODOM, HEADER, b"raw") == 1
    assert (await received(exact))[2] == b"raw"
    assert [(await received(prefix))[2] for _ in range(2)] == [b"filtered", b"raw"]


async def test_interest_is_tracked_and_ends(world: World) -> None:
    feed = world.start([role()])
    assert not feed.wants(ODOM)
    assert feed.publish(ODOM, HEADER, b"nobody") == 0
    first = await world.subscriber(feed, "viewer", b"/r/", b"/s/scan\0")
    second = await world.subscriber(feed, "viewer", b"/r/")
    assert feed.prefixes() == {"viewer": (b"/r/", b"/s/scan\0")}
    assert feed.wants(ODOM)
    assert feed.wants(TopicName("/s/scan"))
    assert not feed.wants(TopicName("/s/scan_2"))
    first.close(linger=0)
    await until(lambda: feed.prefixes() == {"viewer": (b"/r/",)})
    assert feed.wants(ODOM)
    second.unsubscribe(b"/r/")
    await until(lambda: not feed.wants(ODOM))


async def test_a_role_sees_only_what_it_may(world: World) -> None:
    feed = world.start([role("guest", see="/public/.*"), role("staff")])
    guest = await world.subscriber(feed, "guest", b"")
    staff = await world.subscriber(feed, "staff", b"")
    assert feed.publish(TopicName("/secret/plan"), HEADER, b"secret") == 1
    assert feed.publish(TopicName("/public/news"), HEADER, b"news") == 2
    assert (await received(guest))[2] == b"news"
    assert (await received(staff))[2] == b"secret"
    assert feed.counters()["guest"].sent == 1


async def test_publishing_is_off_by_default(world: World) -> None:
    feed = world.start([role()])
    assert feed.endpoints()["viewer"][1] is None


async def test_what_comes_in_is_handed_over_and_fans_out(world: World) -> None:
    feed = world.start([role("unity", publish="/unity/.*"), role("guest", see="/public/.*")])
    subscriber = await world.subscriber(feed, "unity", b"/unity/")
    guest = await world.subscriber(feed, "guest", b"")
    publisher = await world.publisher(feed, "unity")
    publisher.send_multipart([b"/unity/head\0", HEADER.pack(), b"pose"])
    publisher.send_multipart([b"/unity/head\0", b"", b"no header"])
    assert await received(subscriber) == [b"/unity/head\0", HEADER.pack(), b"pose"]
    default = FeedHeader(PriorityClass.BULK, 0, 99)
    assert await received(subscriber) == [b"/unity/head\0", default.pack(), b"no header"]
    assert world.came_in == [
        ("unity", "/unity/head", HEADER, b"pose"),
        ("unity", "/unity/head", default, b"no header"),
    ]
    assert not guest.poll(0)
    counters = feed.counters()["unity"]
    assert (counters.received, counters.received_bytes, counters.sent) == (2, 13, 2)


async def test_what_may_not_come_in_is_refused_and_counted(world: World) -> None:
    feed = world.start([role("unity", publish="/unity/.*")])
    publisher = await world.publisher(feed, "unity")
    control = FeedHeader(PriorityClass.CONTROL, 1, 1)
    publisher.send_multipart([b"/robot/cmd_vel\0", HEADER.pack(), b"not its topic"])
    publisher.send_multipart([b"/unity/cmd_vel\0", control.pack(), b"class control"])
    publisher.send_multipart([b"/unity/last\0", HEADER.pack(), b"fine"])
    await until(lambda: world.came_in)
    assert [body for *_, body in world.came_in] == [b"fine"]
    assert feed.counters()["unity"].forbidden == 2


@pytest.mark.parametrize(
    ("rate_hz", "bytes_per_s", "taken"),
    [(3.0, None, 3), (None, 40.0, 4), (100.0, 1e6, 8)],
    ids=["messages", "bytes", "ample"],
)
async def test_a_role_is_kept_to_its_limits(
    world: World, rate_hz: float | None, bytes_per_s: float | None, taken: int
) -> None:
    now = [100.0]
    unity = role("unity", publish="/unity/.*")
    limited = replace(unity, max_rate_hz=rate_hz, max_bytes_per_s=bytes_per_s)
    feed = world.start([limited], clock=lambda: now[0])
    subscriber = await world.subscriber(feed, "unity", b"")
    publisher = await world.publisher(feed, "unity")
    counters = feed.counters()["unity"]
    for number in range(8):
        publisher.send_multipart([b"/unity/head\0", HEADER.pack(), b"%010d" % number])
    await until(lambda: counters.received + counters.limited == 8)
    assert counters.received == taken
    assert [body for *_, body in world.came_in] == [b"%010d" % number for number in range(taken)]
    for number in range(taken):  # nor does the feed's own subscriber get more
        assert (await received(subscriber))[2] == b"%010d" % number
    assert not subscriber.poll(0)
    now[0] += 10.0  # the buckets are full again, and roles that are read anew with the same limits keep them
    feed.update([replace(limited)])
    publisher.send_multipart([b"/unity/head\0", HEADER.pack(), b"later"])
    await until(lambda: world.came_in[-1][3] == b"later")
    feed.update([unity])
    for _ in range(20):
        publisher.send_multipart([b"/unity/head\0", HEADER.pack(), b"no limit"])
    await until(lambda: counters.received == taken + 21)


async def test_class_control_needs_a_rule_of_its_own(world: World) -> None:
    feed = world.start([role("pilot", publish="/cmd_vel", allow_control=True)])
    publisher = await world.publisher(feed, "pilot")
    control = FeedHeader(PriorityClass.CONTROL, 1, 1)
    publisher.send_multipart([b"/cmd_vel\0", control.pack(), b"go"])
    await until(lambda: world.came_in)
    assert world.came_in == [("pilot", "/cmd_vel", control, b"go")]


async def test_ownership_is_asked_once_a_topic_until_refreshed(world: World) -> None:
    asked: list[str] = []
    answers = [True, False]

    def accept(_role: FeedRole, name: TopicName) -> bool:
        asked.append(name)
        return answers[len(asked) - 1]

    feed = world.start([role("unity", publish=".*")], accept=accept)
    publisher = await world.publisher(feed, "unity")
    for _ in range(3):
        publisher.send_multipart([b"/a\0", HEADER.pack(), b"x"])
    await until(lambda: len(world.came_in) == 3)
    assert asked == ["/a"]
    feed.refresh()
    publisher.send_multipart([b"/a\0", HEADER.pack(), b"x"])
    await until(lambda: feed.counters()["unity"].forbidden == 1)
    assert asked == ["/a", "/a"]


BAD = [
    [b"x"],
    [b"/a\0"],
    [b"/a\0", HEADER.pack()],
    [b"/a\0", HEADER.pack(), b"body", b"more"],
    [b"/a\0"] * 5,
    [b"/a\0", HEADER.pack(), b"body"] * 30,
    [b"/a", HEADER.pack(), b"no NUL"],
    [b"a\0", HEADER.pack(), b"no slash"],
    [b"/a\0b\0", HEADER.pack(), b"two NULs"],
    [b"/\xff\0", HEADER.pack(), b"no UTF-8"],
    [b"/a\nb\0", HEADER.pack(), b"not printable"],
    [b"/" + b"a" * 600 + b"\0", HEADER.pack(), b"long name"],
    [b"/a\0", b"short", b"header"],
    [b"/a\0", b"\2" + HEADER.pack()[1:], b"version 2"],
    [b"/a\0", b"\1\3" + HEADER.pack()[2:], b"class 3"],
    [b"/a\0", b"\1\1\0\1" + HEADER.pack()[4:], b"reserved"],
]


@pytest.mark.parametrize("bad", BAD, ids=lambda bad: repr(bad)[:30])
async def test_a_malformed_message_costs_no_well_formed_one(world: World, bad: list[bytes]) -> None:
    feed = world.start([role("unity", publish=".*")])
    publisher = await world.publisher(feed, "unity")
    honest = await world.publisher(feed, "unity")
    count = 50
    for number in range(count):
        publisher.send_multipart(bad)
        honest.send_multipart([b"/honest\0", HEADER.pack(), b"%d" % number])
    await until(lambda: sum(name == "/honest" for _, name, _, _ in world.came_in) == count)
    bodies = [body for _, name, _, body in world.came_in if name == "/honest"]
    assert bodies == [b"%d" % number for number in range(count)]
    await until(lambda: feed.counters()["unity"].malformed > 0)
    assert {header for _, name, header, _ in world.came_in if name == "/honest"} == {HEADER}


async def test_a_frame_above_the_limit_closes_the_connection(world: World) -> None:
    feed = world.start([role("unity", publish=".*")], max_message_bytes=1000)
    publisher = await world.publisher(feed, "unity")
    publisher.send_multipart([b"/a\0", HEADER.pack(), bytes(1000)])
    await until(lambda: world.came_in)
    publisher.send_multipart([b"/a\0", HEADER.pack(), bytes(1001)])

    def reconnected() -> bool:
        publisher.send_multipart([b"/a\0", HEADER.pack(), b"after"])
        return len(world.came_in) > 1

    await until(reconnected)
    assert {len(body) for *_, body in world.came_in} == {1000, 5}


async def test_new_rules_hold_at_once_for_old_subscriptions(world: World) -> None:
    feed = world.start([role(publish=".*", publish_endpoint="tcp://127.0.0.1:*")])
    subscriber = await world.subscriber(feed, "viewer", b"")
    assert feed.publish(ODOM, HEADER, b"before") == 1
    feed.update([role(see="/public/.*", publish="/public/.*")])
    assert feed.publish(ODOM, HEADER, b"revoked") == 0
    assert feed.publish(TopicName("/public/x"), HEADER, b"after") == 1
    assert [(await received(subscriber))[2] for _ in range(2)] == [b"before", b"after"]
    feed.update([])
    assert feed.endpoints() == {}
    assert feed.publish(TopicName("/public/x"), HEADER, b"gone") == 0


async def test_a_port_in_use_is_one_line_and_leaves_nothing_open(world: World) -> None:
    with socketlib.create_server(("127.0.0.1", 0)) as taken:
        endpoint = f"tcp://127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(ConfigError, match="the port is in use"):
            world.start([role("fine"), role("clash", publish_endpoint=endpoint)])


headers = st.builds(
    FeedHeader,
    st.sampled_from(PriorityClass),
    st.integers(0, 2**32 - 1),
    st.integers(-(2**63), 2**63 - 1),
    st.integers(0, 2**64 - 1),
)


@given(headers)
def test_headers_survive_the_wire(header: FeedHeader) -> None:
    raw = header.pack()
    assert len(raw) == 24
    assert FeedHeader.parse(raw) == header


@given(st.binary(max_size=40))
def test_any_bytes_are_a_header_or_none(raw: bytes) -> None:
    header = FeedHeader.parse(raw)
    assert header is None or header.pack() == raw


@given(st.binary(max_size=40))
def test_any_bytes_are_a_topic_or_none(raw: bytes) -> None:
    name = parse_topic(raw)
    assert name is None or topic_frame(name) == raw


def test_the_layout_is_the_documented_one() -> None:
    raw = FeedHeader(PriorityClass.STATE, 0x01020304, -1, 2).pack()
    assert raw.hex() == "0101000001020304ffffffffffffffff0000000000000002"
    assert FeedHeader(PriorityClass.STATE, 2**32 + 5, 0).pack()[4:8] == b"\0\0\0\5"
