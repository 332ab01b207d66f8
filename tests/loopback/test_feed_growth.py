"""A program on the feed cannot make the relay keep many times what it sends, as tiny frames of one message would."""

import asyncio
from collections.abc import AsyncIterator
from typing import cast

import pytest
import zmq

from sern_core.topics.patterns import compile_pattern
from sern_core.topics.rules import FeedRole
from sern_runtime.feed import Feed
from sern_runtime.feed_inflow import GROWTH_BYTES, GROWTH_MULTIPLE, FeedInflow
from sern_runtime.inflow import LIMIT_BYTES, Inflow, resident_bytes
from sern_runtime.monitor import TcpHandle
from tests.loopback import test_inflow
from tests.loopback.test_inflow import Endless
from tests.support import until

Context = zmq.Context[zmq.Socket[bytes]]
ANY = compile_pattern(".*")
MIB = 2**20
READY = b"\x05READY\x0bSocket-Type\x00\x00\x00\x03PUB"


@pytest.fixture
async def feed(zmq_context: Context) -> AsyncIterator[Feed]:
    role = FeedRole("unity", "tcp://127.0.0.1:*", ingest_endpoint="tcp://127.0.0.1:*", subscribe=(ANY,), publish=(ANY,))
    feed = Feed(zmq_context, [role], on_publish=lambda _role, _name, _header, _body: None)
    yield feed
    feed.close()


class Connection:
    """A connection that has brought so much."""

    def __init__(self, fd: int) -> None:
        self.fd = fd
        self.peer = ("192.0.2.1", 1)
        self.count = 0
        self.was_cut = False

    def read_bytes(self) -> int:
        return self.count

    def cut(self) -> bool:
        self.was_cut = True
        return True


class Socket:
    messages = 0
    emptied = 0

    def drain(self) -> None:
        self.emptied += 1


class Watched:
    """The watch of a publisher's socket, with connections and a memory that do as they are told."""

    def __init__(self, watch: FeedInflow, connections: list[Connection]) -> None:
        self.watch = watch
        self.connections = connections
        self.memory_bytes = 100 * MIB

    def look(self) -> set[Connection]:
        self.watch._taken = {each.fd: self.watch._taken.get(each.fd, 0) for each in self.connections}
        self.watch._look(cast("list[TcpHandle]", self.connections), self.memory_bytes)
        return cast("set[Connection]", self.watch._inflow.suspects)


@pytest.fixture
def watched(feed: Feed) -> Watched:
    watch = feed._inlets["unity"].inflow
    watch._inflow.close()  # nobody looks but the test
    return Watched(watch, [Connection(1000), Connection(1001)])


async def test_a_large_message_explains_its_memory(watched: Watched) -> None:
    assert not watched.look()
    for _ in range(16):
        watched.connections[0].count += MIB
        watched.memory_bytes += MIB
        assert not watched.look()
    watched.memory_bytes += 2 * 16 * MIB + GROWTH_BYTES  # and what the rest needs meanwhile
    assert not watched.look()
    watched.memory_bytes += 1
    assert watched.look() == {watched.connections[0]}


async def test_memory_that_grew_before_is_not_its_doing(watched: Watched) -> None:
    watched.look()
    watched.memory_bytes += 10 * GROWTH_BYTES
    watched.look()
    watched.connections[0].count += MIB
    assert not watched.look()
    watched.memory_bytes += GROWTH_BYTES + GROWTH_MULTIPLE * MIB + 1
    assert watched.look() == {watched.connections[0]}
    watched.watch.came(1000)  # its message was a message
    assert not watched.look()


async def test_whoever_has_little_under_way_is_no_suspect(watched: Watched) -> None:
    watched.look()
    watched.connections[0].count += MIB
    watched.connections[1].count += LIMIT_BYTES // 4
    watched.memory_bytes += 10 * GROWTH_BYTES
    assert watched.look() == {watched.connections[0]}


async def test_a_suspect_is_cut_where_others_may_go_on() -> None:
    one, other = Connection(1), Connection(2)
    told: list[Connection] = []
    inflow = Inflow(Socket(), lambda: [(one, 0), (other, 0)], told.append, limit_bytes=16 * MIB, period_s=3600.0)
    inflow.suspects = {one}
    for number in range(4):
        one.count = other.count = number * LIMIT_BYTES
        inflow.look(now=float(number))
    inflow.close()
    assert told == [one] and one.was_cut and not other.was_cut


async def test_tiny_frames_are_cut_long_before_a_large_frame_would_be(
    feed: Feed, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(test_inflow, "READY", READY)
    publishers = feed.endpoints()["unity"][1]
    assert publishers is not None
    inflow = feed._inlets["unity"].inflow._inflow
    told = inflow._on_endless
    read_bytes: list[int | None] = []

    def endless(handle: TcpHandle) -> None:
        read_bytes.append(handle.read_bytes())  # what it has sent beside lies with the kernel
        told(handle)

    monkeypatch.setattr(inflow, "_on_endless", endless)
    before_bytes = resident_bytes()
    highest_bytes = 0
    peer = Endless(int(publishers.rpartition(":")[2]), 50 * MIB, body=b"")
    peer.start()

    def cut() -> bool:
        nonlocal highest_bytes
        highest_bytes = max(highest_bytes, resident_bytes())
        return feed.counters()["unity"].endless == 1

    await until(cut, "cut")
    await asyncio.to_thread(peer.stop)
    (came_bytes,) = read_bytes
    assert came_bytes is not None and came_bytes < feed.max_message_bytes
    assert highest_bytes - before_bytes < GROWTH_BYTES + 200 * MIB
