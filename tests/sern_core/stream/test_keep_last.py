"""A best-effort channel: what a newer message takes the place of, and what is sent again."""

from sern_core.vocabulary.types import DropReason
from tests.sern_core.stream.sending import Sender
from tests.world import spec


def test_keep_last_drops_the_oldest_that_has_not_begun() -> None:
    sender = Sender(spec(depth=2))
    sender.submit(1, 5000)
    assert sender.take() is not None  # 1 has begun
    sender.submit(3)
    assert sender.waiting == [3, 4] and sender.drops == [(2, DropReason.SUPERSEDED)]
    head = sender.channel.head(0.0)
    assert head is not None and head.seq == 1, "what has begun goes on"
    sender.check()


def test_a_lost_sample_is_not_sent_again_behind_a_fresher_one() -> None:
    sender = Sender(spec())
    sender.submit()
    first = sender.take()
    sender.submit()
    second = sender.take()
    assert first is not None and second is not None
    assert sender.channel.fragment_lost(first[0], first[1], 0, 100, now=0.1) is False
    assert sender.drops == [(1, DropReason.UNCONFIRMED)]
    assert sender.channel.fragment_lost(second[0], second[1], 0, 100, now=0.1) is True, "the newest is"
    sender.check()


def test_a_lost_sample_of_a_queue_is_not_sent_again_once_a_newer_one_has_arrived() -> None:
    sender = Sender(spec(depth=10))
    sender.submit(3)
    parts = [sender.take() for _ in range(3)]
    assert parts[0] is not None and parts[1] is not None
    assert sender.channel.fragment_lost(parts[0][0], parts[0][1], 0, 100, now=0.1) is True
    sender.channel.fragment_acked(parts[1][0], parts[1][1])
    head = sender.channel.head(0.1)
    assert head is None and sender.drops == [(1, DropReason.UNCONFIRMED)]
    sender.check()


def test_a_large_sample_of_which_most_arrived_is_completed() -> None:
    sender = Sender(spec())
    sender.submit(1, 3000)
    parts = [sender.take() for _ in range(3)]
    sender.submit(1, 3000)
    assert all(parts)
    for part in parts[:2]:
        assert part is not None
        sender.channel.fragment_acked(part[0], part[1])
    lost = parts[2]
    assert lost is not None
    assert sender.channel.fragment_lost(lost[0], lost[1], lost[2], lost[3], now=0.1) is True
    again = sender.take()
    assert again is not None and again[0].seq == 1 and again[2:] == (2000, 3000)
    sender.check()


def test_a_message_past_its_lifespan_is_neither_begun_nor_continued() -> None:
    sender = Sender(spec(lifespan_s=1.0, depth=5))
    sender.submit(2, 3000)
    assert sender.take() is not None
    sender.submit(1, now=1.5)
    head = sender.channel.head(2.0)
    assert head is not None and head.seq == 3
    assert sender.drops == [(1, DropReason.LIFESPAN), (2, DropReason.LIFESPAN)]
    sender.check()


def test_the_uncertainty_of_an_age_counts_against_it() -> None:
    sender = Sender(spec(lifespan_s=1.0))
    message = sender.message(1)
    message.error_s = 0.6
    sender.channel.submit(message, now=0.0)
    assert sender.channel.head(0.5) is None and sender.drops == [(1, DropReason.LIFESPAN)]


def test_what_may_have_arrived_is_a_run_of_its_own() -> None:
    sender = Sender(spec(reliable=False, depth=10))
    sender.submit(5)
    for out in list(sender.channel.queue)[:2]:
        out.exposed = True
    sender.channel.clear(DropReason.SHUTDOWN)
    assert sender.told == [(1, 2, DropReason.UNCONFIRMED), (3, 5, DropReason.SHUTDOWN)]
    sender.check()


def test_what_waited_too_long_on_a_best_effort_stream_goes_together() -> None:
    sender = Sender(spec(depth=100, lifespan_s=1.0))
    sender.submit(50)
    sender.submit(50, now=1.5)
    head = sender.channel.head(2.0)
    assert head is not None and head.seq == 51 and sender.told == [(1, 50, DropReason.LIFESPAN)]
    sender.channel.sweep(3.0, up=False)
    assert sender.told[1:] == [(51, 100, DropReason.LIFESPAN)] and sender.channel.counters.dropped == 100
    sender.check()
