"""Reliable messages whose time is over: each is given up once, and a sweep looks at few."""

from random import Random

import pytest

from sern_core.stream.lapses import lapsed
from sern_core.stream.out_message import OutMessage
from sern_core.vocabulary.types import DropReason
from tests.exploring import seeds
from tests.sern_core.stream.sending import Sender, whole_at_the_peer
from tests.steps import steps
from tests.world import spec


def test_an_expired_reliable_message_becomes_a_drop_marker_and_is_reported_once() -> None:
    sender = Sender(spec(reliable=True, lifespan_s=1.0, retention_s=5.0))
    sender.submit(2, 3000)
    taken = sender.take()
    assert taken is not None
    head = sender.channel.head(2.0)
    assert head is not None and head.message.drop_marker and head.unsent_bytes == 1
    sender.channel.fragment_acked(taken[0], taken[1])  # of the body that is no more
    assert sender.channel.head(2.0) is head
    for at_s in (2.0, 3.0, 10.0):
        sender.channel.sweep(at_s, up=True)
        sender.check()
    assert sender.drops == [(1, DropReason.LIFESPAN), (2, DropReason.LIFESPAN)]
    assert [out.seq for out in sender.channel.retained] == [1, 2], "kept until the peer's watermark passes them"


def test_what_the_peer_has_whole_does_not_hide_what_has_expired_behind_it() -> None:
    sender = Sender(spec(reliable=True, lifespan_s=1.0))
    sender.submit(3)
    taken = sender.take()
    assert taken is not None
    sender.channel.fragment_acked(taken[0], taken[1])
    sender.channel.sweep(2.0, up=False)
    assert sender.drops == [(2, DropReason.LIFESPAN), (3, DropReason.LIFESPAN)]
    sender.check()


def test_without_a_link_what_lapsed_is_left_behind() -> None:
    sender = Sender(spec(reliable=True, retention_s=1.0))
    sender.submit(3)
    sender.channel.sweep(2.0, up=False)
    assert sender.channel.watermark == 3 and not sender.channel.retained and sender.channel.first_seq == 4
    sender.check()


def test_what_lapses_in_a_sweep_is_bounded_and_the_rest_is_not_sent_meanwhile() -> None:
    sender = Sender(spec(reliable=True, retention_s=1.0))
    channel = sender.channel
    sender.submit(30, 3000)
    begun = sender.take()
    assert begun is not None
    assert channel.sweep(2.0, up=True, room=10) == 10
    assert sender.told == [(1, 10, DropReason.RETENTION)], "begun or not, in one span"
    sender.check()
    for _ in range(15):
        part = sender.take(now=2.0)
        assert part is not None and part[0].message.drop_marker
    assert [channel.sweep(2.0, up=True, room=10) for _ in range(3)] == [10, 5, 0]
    assert [span[:2] for span in sender.told] == [(1, 10), *((seq, seq) for seq in range(11, 16)), (16, 25), (26, 30)]
    assert {reason for _, reason in sender.drops} == {DropReason.RETENTION} and channel.kept == 30
    sender.check()


def test_what_lapses_around_a_message_that_goes_on_is_told_around_it() -> None:
    sender = Sender(spec(reliable=True, lifespan_s=1.0))
    sender.submit(5)
    parts = [sender.take() for _ in range(3)]
    assert parts[2] is not None
    sender.channel.fragment_acked(parts[2][0], parts[2][1])
    assert sender.channel.sweep(2.0, up=True) == 4
    may_have, has_not = DropReason.UNCONFIRMED, DropReason.LIFESPAN
    assert sender.told == [(1, 2, may_have), (4, 5, has_not)], "the peer has 3 and watches it"
    sender.check()


def test_without_a_link_what_has_lapsed_goes_together_and_becomes_no_drop_marker_first() -> None:
    sender = Sender(spec(reliable=True, retention_s=10.0, lifespan_s=100.0))
    channel = sender.channel
    sender.submit(8)
    channel.submit(sender.drop_marker(9), now=0.0, forced=True)
    sender.submit(8)
    sender.submit(3, now=9.0)
    part = sender.take()
    assert part is not None
    assert channel.sweep(11.0, up=False) == 16
    assert sender.told == [(1, 1, DropReason.UNCONFIRMED), (2, 17, DropReason.RETENTION)] and sender.waiting == [
        18,
        19,
        20,
    ] == [out.seq for out in channel.retained]
    assert channel.watermark == 17 and channel.first_seq == 18 and not channel.flying and not channel.active
    assert channel.counters.dropped == 17 and not part[0].message.drop_marker
    sender.check()


def test_a_replay_lapses_where_others_had_lapsed_before_it() -> None:
    sender = Sender(spec(reliable=True, retention_s=10.0, latched=True, depth=20))
    channel = sender.channel
    sender.submit(10, now=0.0)
    sender.send_all()
    channel.sweep(10.5, up=True)
    channel.sweep(10.8, up=True)
    channel.delivered_to(10)
    channel.peer_restarted()
    channel.prime([sender.message(seq, now=0.0, replay=True) for seq in range(3, 11)], now=11.0)
    for now in (11.0, 33.0):
        sender.send_all(now=now)
        assert [out.message.drop_marker for out in channel.retained] == [0] * 8
        channel.sweep(now + 11.0, up=True)
        assert len(channel.retained) == 8 and all(out.message.drop_marker for out in channel.retained)
        channel.delivered_to(10)
        channel.peer_restarted()
        channel.prime([sender.message(seq, now=0.0, replay=True) for seq in range(3, 11)], now=33.0)


def test_a_sweep_looks_at_no_more_than_it_has_room_for_and_once_at_what_the_peer_has_whole() -> None:
    def cost(count: int) -> tuple[int, int, int]:
        sender = whole_at_the_peer(count)
        channel = sender.channel
        first = steps(lambda: channel.sweep(11.0, up=True, room=10))
        turns = 1
        while channel.sweep(11.0, up=True, room=10):
            turns += 1
        assert not sender.drops and channel.kept == count
        return first, turns, steps(lambda: channel.sweep(11.25, up=True))

    few, many = cost(200), cost(3000)
    assert many[0] <= 1.2 * few[0] and many[2] <= 1.2 * few[2]
    assert (few[1], many[1]) == (3, 38), "eight that stay are looked at for one that is given up"


def test_drop_markers_behind_one_that_stays_are_not_looked_at_in_each_sweep() -> None:
    def cost(count: int) -> int:
        sender = Sender(spec(reliable=True, lifespan_s=10.0, retention_s=3600.0))
        sender.submit(count, 2, now=0.0)
        part = sender.take()
        assert part is not None
        sender.channel.fragment_acked(part[0], part[1])
        while sender.channel.sweep(11.0, up=True, room=100):
            pass
        assert [out.seq for out in sender.channel.retained if not out.message.drop_marker] == [1]
        return steps(lambda: sender.channel.sweep(11.25, up=True))

    assert cost(3000) <= 1.2 * cost(200)


def test_what_lapses_without_a_link_is_bounded_by_messages_not_by_runs() -> None:
    sender = Sender(spec(reliable=True, retention_s=10.0))
    channel = sender.channel
    sender.submit(35)
    turns = [(channel.sweep(11.0, up=False, room=10), channel.kept) for _ in range(5)]
    assert turns == [(10, 25), (10, 15), (10, 5), (5, 0), (0, 0)]
    assert sender.told == [(first, min(first + 9, 35), DropReason.RETENTION) for first in (1, 11, 21, 31)]
    sender.check()


def test_what_the_peer_had_whole_lapses_when_a_new_process_takes_its_place() -> None:
    sender = whole_at_the_peer(5)
    channel = sender.channel
    assert channel.sweep(11.0, up=True) == 0 and not sender.drops
    channel.peer_restarted()
    assert channel.sweep(11.5, up=True) == 5
    assert sender.told == [(1, 5, DropReason.UNCONFIRMED)] and all(out.message.drop_marker for out in channel.retained)
    sender.check()


def test_what_the_peer_has_whole_lapses_with_its_retention() -> None:
    sender = whole_at_the_peer(5)
    channel = sender.channel
    for second in range(11, 3600, 500):
        assert channel.sweep(float(second), up=True) == 0
    assert channel.sweep(3601.0, up=True) == 5 and sender.told == [(1, 5, DropReason.UNCONFIRMED)]
    assert channel.counters.reliable_unconfirmed == 5
    sender.check()


def test_what_is_given_up_as_it_goes_is_a_loss_once() -> None:
    sender = Sender(spec(reliable=True, retention_s=10.0))
    sender.submit(1, now=0.0)
    sender.send_all()
    sender.channel.peer_restarted()
    head = sender.channel.head(11.0)
    assert head is not None and head.message.drop_marker and sender.drops == [(1, DropReason.UNCONFIRMED)]
    sender.channel.clear(DropReason.SHUTDOWN)
    counters = sender.channel.counters
    assert counters.reliable_unconfirmed == counters.by_reason[DropReason.UNCONFIRMED] == 1


@pytest.mark.parametrize("seed", seeds(40))
def test_sweeps_that_look_once_give_up_what_a_look_at_all_would(seed: int) -> None:
    random = Random(seed)
    lifespan_s = random.choice([None, 2.0, 20.0])
    sender = Sender(spec(reliable=True, latched=True, depth=50, lifespan_s=lifespan_s, retention_s=8.0), first=20)
    channel = sender.channel
    sent: list[tuple[OutMessage, int, int, int]] = []
    now, primed_below = 0.0, 20
    given_up = 0
    for _ in range(150):
        now += random.choice([0.0, 0.1, 1.0])
        action = random.choice(
            ["submit", "submit", "take", "take", "ack", "lose", "confirm", "restart", "sweep", "down"]
        )
        if action == "submit":
            sender.submit(random.randint(1, 5), random.choice([1, 1500]), now=now)
        elif action == "take":
            sent += [part for _ in range(random.randint(1, 6)) if (part := sender.take(now=now)) is not None]
        elif action in ("ack", "lose") and sent:
            random.shuffle(sent)
            parts, sent = sent[: len(sent) // 2], sent[len(sent) // 2 :]
            for part in parts:
                if action == "ack":
                    channel.fragment_acked(part[0], part[1])
                else:
                    channel.fragment_lost(*part, now=now)
        elif action == "confirm" and channel.retained and random.random() < 0.3:
            channel.delivered_to(channel.retained[random.randrange(min(4, len(channel.retained)))].seq)
        elif action == "restart" and random.random() < 0.3:
            sent.clear()
            channel.peer_restarted()
            if primed_below and random.random() < 0.5:
                count = random.randint(1, 4)
                primed_below = max(0, primed_below - count)
                seqs = range(max(1, primed_below), max(1, primed_below) + count)
                channel.prime([sender.message(seq, now=0.01 * seq - 1.0, replay=True) for seq in seqs], now=now)
        elif action in ("sweep", "down"):
            before = channel.counters.dropped
            while channel.sweep(now, up=action == "sweep", room=3) >= 3:
                sender.check()
            given_up += channel.counters.dropped - before
            left = [out for out in channel.retained if not out.message.drop_marker]
            replays = [out for out in left if out.message.replay]
            over = [(out, reason) for out in left if (reason := lapsed(out, channel.spec, now)) is not None]
            # Of replays the newer ones may be ahead: the retention of the older ends behind them.
            late = [out.seq for out, why in over if out not in replays[1:] or why is DropReason.LIFESPAN]
            assert not late, f"still kept at {now}: {late}"
        sender.check()
    assert given_up


def test_what_may_have_arrived_is_unconfirmed_whatever_its_time_and_its_drop_marker_says_why() -> None:
    """Begun and sent whole is not the same, and the next place takes the drop marker for what it did not get."""
    for up in (True, False):
        sender = Sender(spec(reliable=True, retention_s=10.0))
        channel = sender.channel
        sender.submit(4, 1500)
        for _ in range(3):
            assert sender.take() is not None  # 1 is sent whole, 2 in part
        outs = list(channel.retained)
        assert channel.sweep(11.0, up=up) == 4
        assert sender.told == [(1, 1, DropReason.UNCONFIRMED), (2, 4, DropReason.RETENTION)]
        assert channel.kept == (4 if up else 0)
        if up:
            assert {out.message.drop_reason for out in outs} == {DropReason.RETENTION}
        sender.check()


def test_what_may_have_arrived_is_unconfirmed_when_its_turn_comes_too_late() -> None:
    sender = Sender(spec(reliable=True, lifespan_s=1.0))
    channel = sender.channel
    sender.submit(2)
    first = sender.take()
    assert first is not None and channel.fragment_lost(*first, now=0.5)
    for _ in range(2):
        part = sender.take(now=2.0)
        assert part is not None and part[0].message.drop_reason is DropReason.LIFESPAN
    assert sender.drops == [(1, DropReason.UNCONFIRMED), (2, DropReason.LIFESPAN)]
    sender.check()
