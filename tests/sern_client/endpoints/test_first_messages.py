"""First messages of a publisher, against subscribers that come when the test says so."""

import asyncio
from math import inf

import pytest

from sern_client.endpoints.common import first_messages
from sern_client.endpoints.common.first_messages import FirstMessages, Readers
from sern_core.vocabulary.types import DropReason
from tests.support import until


class Topic:
    """`now` is how many subscribers are known and connected."""

    def __init__(self, known: int, connected: int, *, learning_s: float = 0.0, messages: int = 3) -> None:
        self.now = Readers(known, connected)
        self.written: list[bytes] = []
        self.dropped: list[DropReason] = []
        self.ended = 0
        self.first = FirstMessages(
            "/chat", readers=lambda: self.now, write=lambda body, _stamp_ns: self.written.append(body),
            dropped=self.dropped.append, max_messages=messages, max_bytes=100, overflow=DropReason.QUEUE_FULL,
            learning_s=learning_s,
        )  # fmt: skip

    def publish(self, *bodies: bytes, left_s: float = inf) -> None:
        for body in bodies:
            self.first.publish(body, 0, left_s)

    def end(self) -> None:
        self.ended += 1


@pytest.fixture(autouse=True)
def unhurried(monkeypatch: pytest.MonkeyPatch) -> None:
    """Times out when a test says so only."""
    monkeypatch.setattr(first_messages, "FIRST_MESSAGES_S", 600.0)
    monkeypatch.setattr(first_messages, "SETTLE_S", 0.0)


async def test_without_subscribers_nothing_waits() -> None:
    topic = Topic(0, 0)
    topic.publish(b"one", b"two")
    assert topic.written == [b"one", b"two"] and topic.first.over


async def test_all_that_are_known_are_waited_for_and_order_is_kept() -> None:
    topic = Topic(2, 0)
    topic.publish(b"one", b"two")
    topic.now = Readers(2, 1)
    await asyncio.sleep(0)
    assert topic.written == []
    topic.now = Readers(2, 2)
    topic.publish(b"three")
    assert topic.written == [b"one", b"two", b"three"] and topic.dropped == []


async def test_one_that_leaves_is_not_waited_for() -> None:
    topic = Topic(2, 1)
    topic.publish(b"one")
    topic.now = Readers(1, 1)
    await until(lambda: topic.written == [b"one"])
    assert topic.dropped == []


async def test_while_the_graph_is_learned_it_waits() -> None:
    topic = Topic(0, 0, learning_s=600.0)
    topic.publish(b"one")
    assert topic.written == []
    topic.now = Readers(1, 1)
    await until(lambda: topic.written == [b"one"])


async def test_a_stream_that_ends_ends_after_its_messages() -> None:
    topic = Topic(1, 0)
    topic.publish(b"stop")
    topic.first.end(topic.end)
    assert topic.ended == 0
    topic.now = Readers(1, 1)
    await until(lambda: topic.ended == 1)
    assert topic.written == [b"stop"]
    empty = Topic(1, 0)
    empty.first.end(empty.end)
    assert empty.ended == 1 and empty.first.over


async def test_what_is_kept_is_bounded_and_every_drop_counted() -> None:
    topic = Topic(1, 0)
    topic.publish(b"0", b"1", b"2", b"3")
    assert topic.dropped == [DropReason.QUEUE_FULL]
    topic.publish(bytes(90), bytes(20))
    assert topic.dropped == [DropReason.QUEUE_FULL] * 5 and len(topic.first) == 1
    late = Topic(1, 0)
    late.publish(b"old", left_s=0.0)
    late.publish(b"new")
    assert not late.first.over and late.dropped == []
    late.first._give_up_s = 0.0  # its subscriber has crashed: FIRST_MESSAGES_S is over
    await until(lambda: late.first.over)
    assert late.written == [b"new"]
    assert late.dropped == [DropReason.LIFESPAN]  # the other was written: it is in no count of what was not


async def test_one_that_cannot_be_written_costs_none_behind_it(caplog: pytest.LogCaptureFixture) -> None:
    topic = Topic(1, 0, messages=9)
    written = topic.written

    def write(body: bytes, _stamp_ns: int) -> None:
        if body.startswith(b"bad"):
            raise OSError("no message")
        written.append(body)

    topic.first._write = write
    topic.publish(b"bad", b"one", b"bad too", b"stop")
    topic.first.end(topic.end)
    topic.now = Readers(1, 1)
    await until(lambda: topic.ended == 1)
    assert written == [b"one", b"stop"] and len(topic.first) == 0
    assert topic.dropped == [DropReason.FAULT] * 2
    assert [record.message for record in caplog.records] == ["/chat: a message could not be published here"]
