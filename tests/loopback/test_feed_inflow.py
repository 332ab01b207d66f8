"""A program on the feed that sends a message without end is cut off; those with large messages are not."""

from collections.abc import AsyncIterator

import pytest
import zmq

from sern_core.topics.patterns import compile_pattern
from sern_core.topics.rules import FeedRole
from sern_core.vocabulary.types import PriorityClass
from sern_runtime import feed_inflow
from sern_runtime.feed import Feed, FeedHeader
from tests.loopback import test_inflow
from tests.loopback.test_inflow import Endless
from tests.support import until

Context = zmq.Context[zmq.Socket[bytes]]
ANY = compile_pattern(".*")
HEADER = FeedHeader(PriorityClass.STATE, 7, 1)
LIMIT_BYTES = 2**20


@pytest.fixture
def came_in() -> list[bytes]:
    return []


@pytest.fixture
async def feed(zmq_context: Context, came_in: list[bytes]) -> AsyncIterator[Feed]:
    role = FeedRole("unity", "tcp://127.0.0.1:*", ingest_endpoint="tcp://127.0.0.1:*", subscribe=(ANY,), publish=(ANY,))
    feed = Feed(
        zmq_context,
        [role],
        on_publish=lambda _role, _name, _header, body: came_in.append(body),
        max_message_bytes=LIMIT_BYTES,
    )
    yield feed
    feed.close()


def ready_as(kind: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    body = b"\x05READY\x0bSocket-Type" + len(kind).to_bytes(4, "big") + kind
    monkeypatch.setattr(test_inflow, "READY", body)


@pytest.mark.parametrize("kind", [b"PUB", b"SUB"])
async def test_a_message_without_end_is_cut_and_others_are_served(
    kind: bytes, zmq_context: Context, feed: Feed, came_in: list[bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    ready_as(kind, monkeypatch)
    subscribers, publishers = feed.endpoints()["unity"]
    assert publishers is not None
    honest = zmq_context.socket(zmq.PUB)
    honest.connect(publishers)
    peer = Endless(int((publishers if kind == b"PUB" else subscribers).rpartition(":")[2]))
    peer.start()

    def served() -> bool:
        honest.send_multipart([b"/unity/head\0", HEADER.pack(), b"pose"])
        return bool(came_in)

    await until(served, "others are served")
    await until(lambda: feed.counters()["unity"].endless == 1, "cut")
    peer.stop()
    came_in.clear()
    await until(served, "others are served still")
    assert feed.counters()["unity"].endless == 1
    honest.close(linger=0)


@pytest.mark.parametrize("size", [1000, LIMIT_BYTES // 2])
async def test_messages_that_come_out_are_no_reason(
    size: int, zmq_context: Context, feed: Feed, came_in: list[bytes]
) -> None:
    publishers = feed.endpoints()["unity"][1]
    assert publishers is not None
    honest = zmq_context.socket(zmq.PUB)
    honest.connect(publishers)
    watch = feed._inlets["unity"].inflow
    looks = 0

    def sent() -> bool:
        nonlocal looks
        looks += watch.watching
        for _ in range(max(1, 20_000 // size)):
            honest.send_multipart([b"/unity/map\0", HEADER.pack(), bytes(size)])
        return sum(map(len, came_in)) > 8 * LIMIT_BYTES and (looks > 0 or size >= feed_inflow.TOLD_BYTES)

    await until(sent, "much more than a message without end may bring")
    assert feed.counters()["unity"].endless == 0
    honest.close(linger=0)
