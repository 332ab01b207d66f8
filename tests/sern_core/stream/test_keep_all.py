"""A reliable channel: what is kept, confirmed, left out and told, and the gaps of the stream."""

import pytest

from sern_core.stream.prices import CLIENT_OVERHEAD_BYTES
from sern_core.vocabulary.types import DropReason
from tests.sern_core.stream.sending import Sender
from tests.steps import steps
from tests.world import spec


def test_a_reported_message_is_dropped_once_and_not_sent_to_a_new_peer() -> None:
    sender = Sender(spec(reliable=True))
    sender.submit(2)
    parts = [sender.take(), sender.take()]
    for part in parts:
        assert part is not None
        sender.channel.fragment_acked(part[0], part[1])
    sender.channel.reported(1, DropReason.RATE_CAP)
    sender.channel.reported(1, DropReason.RATE_CAP)
    assert sender.drops == [(1, DropReason.RATE_CAP)]
    sender.check()
    sender.channel.peer_restarted()
    assert [bool(out.message.drop_marker) for out in sender.channel.queue] == [True, False]
    sender.check()


def test_a_new_peer_gets_everything_that_is_not_confirmed_again() -> None:
    sender = Sender(spec(reliable=True))
    sender.submit(4, 3000)
    for _ in range(5):
        assert sender.take() is not None
    sender.channel.delivered_to(1)
    sender.channel.peer_restarted()
    assert sender.waiting == [2, 3, 4] and not sender.channel.flying
    sender.check()


def test_a_watermark_may_lie_beyond_what_was_submitted() -> None:
    """The peer had more from an earlier run of this relay."""
    sender = Sender(spec(reliable=True), first=5)
    sender.channel.delivered_to(7)
    assert sender.submit(5) == [True] * 5
    assert sender.waiting == [8, 9] and sender.channel.counters.delivered == 3
    sender.channel.reject(sender.message(10), DropReason.TOO_LARGE)
    assert sender.drops == [(10, DropReason.TOO_LARGE)]
    sender.check()


def test_gaps_are_told_in_their_turn() -> None:
    sender = Sender(spec(reliable=True))
    sender.submit(2)
    sender.channel.skip_to(10)
    sender.submit(1)
    assert sender.waiting == [1, 2, 10] and sender.channel.next_gap() is None
    sender.channel.delivered_to(2)
    assert sender.channel.next_gap() == 10 and sender.channel.watermark == 9 and sender.channel.next_gap() is None
    sender.check()


def test_what_makes_room_leaves_nothing_behind_but_one_gap() -> None:
    sender = Sender(spec(reliable=True))
    channel = sender.channel
    sender.submit(2, 3000)
    assert sender.take() is not None  # 1 has begun
    sender.submit(3)
    kept_bytes = channel.kept_bytes
    freed_bytes = [channel.shed(1, DropReason.QUEUE_FULL) for _ in range(3)]
    assert freed_bytes == [100 + CLIENT_OVERHEAD_BYTES] * 3 and channel.kept_bytes == kept_bytes - sum(freed_bytes)
    assert sender.waiting == [2] and list(channel.gaps) == [(2, 6)]
    channel.leave_out(sender.message(6), DropReason.QUEUE_FULL)
    sender.submit(1)
    assert sender.waiting == [2, 7] and list(channel.gaps) == [(2, 7)]
    assert channel.shed(1, DropReason.QUEUE_FULL) and channel.shed(1, DropReason.QUEUE_FULL)
    assert list(channel.gaps) == [(1, 8)] and sender.waiting == []
    assert channel.shed(1, DropReason.QUEUE_FULL) == 0, "what has begun goes on"
    assert sorted(seq for seq, _ in sender.drops) == [2, 3, 4, 5, 6, 7]
    assert channel.next_gap() is None
    channel.delivered_to(1)
    assert channel.next_gap() == 8 and channel.watermark == 7
    sender.check()


def test_what_makes_room_and_was_reported_before_is_not_reported_again() -> None:
    sender = Sender(spec(reliable=True, lifespan_s=1.0), first=5)
    channel = sender.channel
    sender.submit(3)
    channel.reported(6, DropReason.RATE_CAP)
    assert channel.abandon(7, DropReason.UNWANTED) and not channel.abandon(7, DropReason.UNWANTED)
    assert [bool(out.message.drop_marker) for out in channel.queue] == [False, False, True]
    for size in (1, 100, 100):
        assert channel.shed(1, DropReason.QUEUE_FULL) == size + CLIENT_OVERHEAD_BYTES
    assert sender.drops == [(6, DropReason.RATE_CAP), (7, DropReason.UNWANTED), (5, DropReason.QUEUE_FULL)]
    assert channel.next_gap() == 8 and channel.kept_bytes == 0
    sender.check()


def test_what_an_earlier_process_may_have_makes_room_as_unconfirmed() -> None:
    sender = Sender(spec(reliable=True))
    sender.submit(2)
    assert sender.take() is not None
    sender.channel.peer_restarted()
    assert sender.channel.shed(1, DropReason.QUEUE_FULL) and sender.channel.shed(1, DropReason.QUEUE_FULL)
    assert sender.drops == [(2, DropReason.QUEUE_FULL), (1, DropReason.UNCONFIRMED)]
    sender.check()


def test_many_that_are_dropped_at_once_are_told_as_one_span() -> None:
    """The span goes over what was dropped and told of before; that is counted no more."""
    sender = Sender(spec(reliable=True))
    sender.submit(10)
    assert sender.channel.reported(4, DropReason.LIFESPAN, "site", 2) > 0
    assert sender.channel.reported(3, DropReason.LIFESPAN, "site", 4) > 0
    assert sender.told == [(4, 5, DropReason.LIFESPAN), (3, 6, DropReason.LIFESPAN)]
    assert sorted(seq for seq, _ in sender.drops) == [3, 4, 5, 6]
    sender.check()
    sender.told.clear()
    sender.channel.set_wanted(False)
    assert sender.told == [(1, 10, DropReason.UNWANTED)]
    assert sorted(seq for seq, _ in sender.drops) == list(range(1, 11))
    assert sender.channel.counters.by_reason[DropReason.UNWANTED] == 6 and sender.channel.watermark == 10
    sender.check()


def test_a_backlog_of_drop_markers_and_gaps_ends_as_one_span() -> None:
    sender = Sender(spec(reliable=True))
    channel = sender.channel
    for _ in range(100):
        sender.submit()
        channel.submit(sender.drop_marker(channel.next_seq), now=0.0, forced=True)
        channel.skip_to(channel.next_seq + 3)
    assert channel.kept == 200 and channel.counters.dropped == 100
    channel.clear(DropReason.DISCONNECTED)
    assert sender.told == [(1, 496, DropReason.DISCONNECTED)] and len(sender.drops) == 100
    assert channel.counters.offered == channel.counters.dropped == 200 and channel.watermark == channel.next_seq - 1
    sender.check()


def test_what_lies_between_replays_is_not_told_of() -> None:
    """Who joined late was never to get it, and others may have it yet."""
    sender = Sender(spec(reliable=True, latched=True, depth=3), first=12)
    sender.channel.prime([sender.message(seq, replay=True) for seq in (2, 3, 6, 9)], now=0.0)
    sender.submit()
    sender.channel.skip_to(20)
    sender.submit()
    assert sender.take() is not None
    sender.channel.reported(1, DropReason.LIFESPAN, "site", 2**61)
    assert sender.told == [
        (2, 3, DropReason.LIFESPAN),
        *((seq, seq, DropReason.LIFESPAN) for seq in (6, 9)),
        (12, 20, DropReason.LIFESPAN),
    ]
    sender.check()


def test_one_number_confirms_all_that_is_kept() -> None:
    sender = Sender(spec(reliable=True))
    sender.submit(20)
    taken = sender.take()
    assert taken is not None
    sender.channel.reported(5, DropReason.LIFESPAN, "site")
    assert sender.channel.delivered_to(20) == 20
    counters = sender.channel.counters
    assert counters.delivered == 19 and counters.dropped == 1 and sender.channel.kept == 0
    assert sender.channel.watermark == 20 and sender.channel.head(0.0) is None
    sender.check()


@pytest.mark.parametrize("watermark", [1, 19, 39, 40])
def test_a_number_confirms_what_is_kept_up_to_it(watermark: int) -> None:
    """At once or one by one, begun or waiting: the same is left."""
    sender = Sender(spec(reliable=True))
    channel = sender.channel
    sender.submit(40)
    parts = [part for part in (sender.take() for _ in range(30)) if part is not None]
    for part in parts[5:25]:
        channel.fragment_lost(*part, now=0.0)
    channel.reported(15, DropReason.LIFESPAN, "site", 10)
    assert channel.delivered_to(watermark) == watermark
    assert [out.seq for out in channel.retained] == list(range(watermark + 1, 41))
    assert [out.seq for out in channel.active] == list(range(max(watermark + 1, 6), 26))
    assert sorted(channel.flying) == list(range(watermark + 1, 31))
    lost = len(range(15, min(watermark, 24) + 1))
    assert channel.counters.delivered == watermark - lost and channel.counters.dropped == 10
    sender.check()


def test_confirming_twenty_costs_the_same_however_many_are_in_flight() -> None:
    def cost(flying: int) -> int:
        sender = Sender(spec(reliable=True))
        sender.submit(flying, now=0.0)
        while sender.take() is not None:
            pass
        assert len(sender.channel.flying) == flying
        return steps(lambda: sender.channel.delivered_to(20))

    assert cost(2000) <= 1.2 * cost(100)
