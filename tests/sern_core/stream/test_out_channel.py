"""The sending side of one stream: what is kept, dropped, resent and reported, and that the counters always add up."""

from collections.abc import Sequence
from itertools import pairwise
from math import inf
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from sern_core.stream.out_channel import CLIENT_OVERHEAD_BYTES, OutChannel
from sern_core.stream.out_message import OutMessage
from sern_core.vocabulary.ledger import LOSSES, SendLedger
from sern_core.vocabulary.message import Message, StreamId, StreamInfo, TopicInfo, TopicSpec
from sern_core.vocabulary.types import ClientName, DropReason, Encoding, TopicName
from tests.exploring import cases, seeds
from tests.steps import steps
from tests.world import spec


class Sender:
    """A channel with a record of its drops; it is announced and wanted from the start."""

    def __init__(self, topic_spec: TopicSpec, *, first: int = 1) -> None:
        info = TopicInfo(TopicName("/t"), "", Encoding.RAW)
        self.stream = StreamInfo(StreamId(ClientName("a"), 1, info.name), info, topic_spec)
        self.ledger = SendLedger()
        self.drops: list[tuple[int, DropReason]] = []
        self.told: list[tuple[int, int, DropReason]] = []  # the spans: first, last, why
        counters = self.ledger.topic(info.name, topic_spec.priority)
        self.channel = OutChannel(1, self.stream, counters, self._drop, first=first)
        self.channel.wanted = self.channel.ready = True

    def _drop(self, _channel: OutChannel, outs: Sequence[OutMessage], reason: DropReason) -> None:
        self.drops += [(out.seq, reason) for out in outs]
        self.told.append((outs[0].seq, outs[-1].seq, reason))

    def message(self, seq: int, size: int = 100, *, now: float = 0.0, replay: bool = False) -> Message:
        return Message(self.stream.id, seq, bytes(size), 0, now, 0, replay)

    def tombstone(self, seq: int) -> Message:
        return Message(self.stream.id, seq, b"\x01", 0, 0.0, 1)

    def submit(self, count: int = 1, size: int = 100, *, now: float = 0.0) -> list[bool]:
        channel = self.channel
        return [channel.submit(self.message(channel.next_seq, size, now=now), now=now) for _ in range(count)]

    def take(self, room: int = 1000, *, now: float = 0.0) -> tuple[OutMessage, int, int, int] | None:
        out = self.channel.head(now)
        if out is None:
            return None
        return (out, out.generation, *self.channel.take(out, room, now))

    def send_all(self, *, now: float = 0.0) -> None:
        """The peer has each whole and confirms none."""
        while (sent := self.take(now=now)) is not None:
            out, generation, _start, _end = sent
            self.channel.fragment_acked(out, generation)

    def check(self) -> None:
        def check(ok: bool, text: str) -> None:
            assert ok, text

        self.channel.validate(check)
        self.ledger.validate([(self.channel.counters, *self.channel.held())], check)

    @property
    def waiting(self) -> list[int]:
        return [out.seq for out in self.channel.queue]


def test_keep_last_drops_the_oldest_that_has_not_begun() -> None:
    sender = Sender(spec(depth=2))
    sender.submit(1, 5000)
    assert sender.take() is not None  # 1 has begun
    sender.submit(3)
    assert sender.waiting == [3, 4] and sender.drops == [(2, DropReason.SUPERSEDED)]
    head = sender.channel.head(0.0)
    assert head is not None and head.seq == 1, "what has begun goes on"
    sender.check()


def test_a_rate_cap_lets_the_right_number_pass_in_spite_of_jitter() -> None:
    sender = Sender(spec(depth=1000, max_rate_hz=10.0))
    random = Random(1)
    for index in range(1000):
        sender.submit(now=0.02 * index + random.uniform(-0.005, 0.005))
    passed = 1000 - sender.channel.counters.by_reason[DropReason.RATE_CAP]
    assert passed == pytest.approx(200, abs=3)
    sender.check()


def test_what_a_rate_cap_holds_back_goes_when_its_time_comes() -> None:
    sender = Sender(spec(depth=1, max_rate_hz=10.0))
    channel = sender.channel
    sender.submit(now=0.0)
    assert sender.take() is not None
    for now in (0.02, 0.04, 0.06):
        sender.submit(now=now)
        sender.check()
    assert sender.waiting == [] and channel.newest is not None and channel.newest.seq == 4
    assert channel.newest_due_s == pytest.approx(0.1) and channel.counters.by_reason[DropReason.RATE_CAP] == 2
    assert not channel.release(0.09) and channel.release(0.1) and sender.waiting == [4]
    sender.check()
    sender.submit(now=0.15)  # the one that was let in has used the turn
    assert channel.newest_due_s == pytest.approx(0.2)
    sender.submit(now=0.2)  # and a newer one at its time takes its place
    assert sender.waiting == [6] and channel.newest_due_s == inf
    sender.check()


def test_what_is_held_back_has_a_lifespan_and_an_end() -> None:
    for end, reason in (
        (lambda sender: sender.channel.sweep(0.35, up=True), DropReason.LIFESPAN),
        (lambda sender: sender.channel.release(1.0), DropReason.LIFESPAN),
        (lambda sender: sender.channel.clear(DropReason.SHUTDOWN), DropReason.SHUTDOWN),
        (lambda sender: sender.channel.set_wanted(False), DropReason.UNWANTED),
        (lambda sender: sender.channel.shed(1, DropReason.QUEUE_FULL), DropReason.QUEUE_FULL),
    ):
        sender = Sender(spec(depth=1, max_rate_hz=1.0, lifespan_s=0.3))
        sender.submit(now=0.0)
        assert sender.take() is not None
        sender.submit(now=0.01)
        end(sender)  # type: ignore[no-untyped-call]
        assert sender.channel.newest is None and (2, reason) in sender.drops
        sender.check()


def test_what_a_share_leaves_out_goes_when_nothing_newer_comes() -> None:
    sender = Sender(spec(depth=1))
    sender.channel.adapt(share=0.5, depth_max=10)
    for index in range(10):
        sender.submit(now=0.1 * index)
        sender.channel.release(0.1 * index)
        sender.check()
    assert sender.channel.thinned == 5 or sender.channel.newest is not None
    sender.channel.release(10.0)
    assert sender.channel.newest is None and sender.waiting == [10]
    assert sender.channel.thinned == sender.channel.counters.by_reason[DropReason.RATE_CAP]
    sender.check()


@given(
    gaps=st.lists(st.floats(0.0, 0.5), min_size=1, max_size=60),
    rate_hz=st.sampled_from([1.0, 7.0, 20.0]),
    share=st.sampled_from([1.0, 0.5, 0.1]),
)
def test_the_last_of_any_series_is_let_in_and_no_more_than_the_rate_allows(
    gaps: list[float], rate_hz: float, share: float
) -> None:
    sender = Sender(spec(depth=1, lifespan_s=None, max_rate_hz=rate_hz))
    channel = sender.channel
    channel.adapt(share=share, depth_max=10)
    let_in: list[tuple[float, int]] = []

    def look(now: float) -> None:
        taken = sender.take(now=now)
        if taken is not None:
            let_in.append((now, taken[0].seq))
            channel.fragment_acked(taken[0], taken[1])
        sender.check()

    now = 0.0
    for gap_s in gaps:
        while channel.newest_due_s <= now + gap_s:
            due_s = channel.newest_due_s
            channel.release(due_s)
            look(due_s)
        now += gap_s
        sender.submit(now=now)
        look(now)
    while channel.newest is not None:
        due_s = channel.newest_due_s
        channel.release(due_s)
        look(due_s)
    assert let_in[-1][1] == len(gaps)
    assert [seq for _, seq in let_in] == sorted({seq for _, seq in let_in})
    if share == 1.0:
        elapsed_s = let_in[-1][0] - let_in[0][0]
        assert len(let_in) <= elapsed_s * rate_hz + 2.0


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


def test_an_expired_reliable_message_becomes_a_tombstone_and_is_reported_once() -> None:
    sender = Sender(spec(reliable=True, lifespan_s=1.0, retention_s=5.0))
    sender.submit(2, 3000)
    taken = sender.take()
    assert taken is not None
    head = sender.channel.head(2.0)
    assert head is not None and head.message.tombstone and head.unsent_bytes == 1
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
    assert [bool(out.message.tombstone) for out in sender.channel.queue] == [True, False]
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
    assert [bool(out.message.tombstone) for out in channel.queue] == [False, False, True]
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


@pytest.mark.parametrize("reliable", [True, False])
def test_replays_go_first_and_gaps_between_them_are_known(reliable: bool) -> None:
    sender = Sender(spec(reliable=reliable, latched=True, depth=3), first=8)
    sender.submit(1)
    sender.channel.prime([sender.message(seq, replay=True) for seq in (2, 4, 7, 8)], now=100.0)
    assert sender.waiting == ([2, 4, 7, 8] if reliable else [4, 7, 8])
    if reliable:
        assert sender.channel.watermark == 1 and list(sender.channel.gaps) == [(2, 4), (4, 7)]
        sender.channel.sweep(120.0, up=True)
        assert not sender.drops, "retention counts from the replay"
    sender.check()


class CountedSeq(int):
    """A seq that counts how often it is compared."""

    compared = 0

    def __lt__(self, other: int) -> bool:
        CountedSeq.compared += 1
        return int(self) < other

    __hash__ = int.__hash__


@pytest.mark.parametrize("order", [1, -1])
def test_what_a_lost_connection_held_is_taken_back_without_a_walk_for_each(order: int) -> None:
    sender = Sender(spec(reliable=True))
    channel = sender.channel
    for seq in range(1, 2001):
        message = sender.message(seq)
        message.seq = CountedSeq(seq)
        channel.submit(message, now=0.0, forced=True)
    parts = [part for part in (sender.take() for _ in range(2000)) if part is not None]
    assert len(parts) == len(channel.flying) == 2000
    CountedSeq.compared = 0
    assert len(channel.fragments_lost(parts[::order], now=0.1)) == 2000
    assert CountedSeq.compared <= 2000 * 2
    assert [out.seq for out in channel.active] == list(range(1, 2001))
    sender.check()


def retention_s_of(sender: Sender) -> float:
    return sender.stream.spec.retention_s


class Channel(RuleBasedStateMachine):
    """Whatever happens to a channel in whatever order, everything adds up and nothing is delivered twice."""

    @initialize(
        reliable=st.booleans(),
        depth=st.integers(1, 4),
        lifespan_s=st.sampled_from([None, 1.0]),
        retention_s=st.sampled_from([100.0, 2.0]),
    )
    def begin(self, reliable: bool, depth: int, lifespan_s: float | None, retention_s: float) -> None:
        self.now = 0.0
        self.sender = Sender(spec(reliable=reliable, depth=depth, lifespan_s=lifespan_s, retention_s=retention_s))
        self.flying: list[tuple[OutMessage, int, int, int]] = []
        self.lost_before: set[int] = set()

    @rule(size=st.sampled_from([0, 1, 100, 3000]))
    def submit(self, size: int) -> None:
        self.sender.submit(1, size, now=self.now)

    @precondition(lambda self: self.sender.channel.reliable)
    @rule()
    def submit_a_tombstone(self) -> None:
        channel = self.sender.channel
        self.lost_before.add(channel.next_seq)
        channel.submit(self.sender.tombstone(channel.next_seq), now=self.now, forced=True)

    @precondition(lambda self: self.sender.channel.reliable)
    @rule(ahead=st.integers(1, 3))
    def skip(self, ahead: int) -> None:
        channel = self.sender.channel
        self.lost_before.update(range(channel.next_seq, channel.next_seq + ahead))
        channel.skip_to(channel.next_seq + ahead)

    @rule(room=st.sampled_from([64, 1000]))
    def take(self, room: int) -> None:
        part = self.sender.take(room, now=self.now)
        if part is not None:
            self.flying.append(part)
            out = part[0]
            lapsed = self.sender.channel.reliable and self.now - out.retain_from_s > retention_s_of(self.sender)
            assert not lapsed or out.message.tombstone, "what has lapsed is sent"

    @precondition(lambda self: bool(self.flying))
    @rule(data=st.data(), lost=st.booleans())
    def outcome(self, data: st.DataObject, lost: bool) -> None:
        out, generation, start, end = self.flying.pop(data.draw(st.integers(0, len(self.flying) - 1)))
        if lost:
            self.sender.channel.fragment_lost(out, generation, start, end, now=self.now)
        else:
            self.sender.channel.fragment_acked(out, generation)

    @precondition(lambda self: self.sender.channel.reliable)
    @rule(ahead=st.integers(0, 3))
    def confirm(self, ahead: int) -> None:
        channel = self.sender.channel
        channel.delivered_to(min(channel.watermark + ahead, channel.next_seq - 1))

    @precondition(lambda self: self.sender.channel.reliable)
    @rule(seq=st.integers(1, 10), count=st.integers(1, 10))
    def report(self, seq: int, count: int) -> None:
        self.sender.channel.reported(seq, DropReason.RATE_CAP, "", count)

    @rule(seconds=st.sampled_from([0.1, 0.6, 3.0]), up=st.booleans(), room=st.sampled_from([0, 1, 2, 1000]))
    def wait(self, seconds: float, up: bool, room: int) -> None:
        self.now += seconds
        assert self.sender.channel.sweep(self.now, up=up, room=room) <= room

    @rule()
    def lose_session(self) -> None:
        self.sender.channel.fragments_lost(self.flying, now=self.now)
        self.flying.clear()

    @rule()
    def meet_a_new_peer(self) -> None:
        self.lose_session()
        self.sender.channel.peer_restarted()

    @rule(wanted=st.booleans())
    def answer(self, wanted: bool) -> None:
        self.sender.channel.set_wanted(wanted)

    @rule()
    def drop_head(self) -> None:
        self.sender.channel.drop_head(DropReason.STALE, self.now)

    @rule(room_bytes=st.integers(1, 3 * CLIENT_OVERHEAD_BYTES))
    def shed(self, room_bytes: int) -> None:
        channel = self.sender.channel
        kept_bytes, kept = channel.kept_bytes, channel.kept
        freed_bytes = channel.shed(room_bytes, DropReason.QUEUE_FULL)
        assert channel.kept_bytes == kept_bytes - freed_bytes
        assert freed_bytes >= room_bytes or not (channel.queue or channel.newest)
        assert kept - channel.kept <= -(-room_bytes // CLIENT_OVERHEAD_BYTES)

    @precondition(lambda self: self.sender.channel.reliable)
    @rule()
    def leave_out(self) -> None:
        channel = self.sender.channel
        channel.leave_out(self.sender.message(channel.next_seq, now=self.now), DropReason.QUEUE_FULL)

    @rule()
    def tell_a_gap(self) -> None:
        channel = self.sender.channel
        first = channel.next_gap()
        assert first is None or channel.watermark >= first - 1

    @invariant()
    def adds_up(self) -> None:
        if hasattr(self, "sender"):
            self.sender.check()
            dropped = [seq for seq, _ in self.sender.drops]
            assert len(dropped) == len(set(dropped)), "reported twice"

    @invariant()
    def who_is_told_of_spans_may_believe_them(self) -> None:
        """Nothing lies in them that is still to come, or has come."""
        if hasattr(self, "sender") and self.sender.channel.reliable:
            dropped = {seq for seq, _ in self.sender.drops} | self.lost_before
            for first, last, _ in self.sender.told:
                assert dropped.issuperset(range(first, last + 1)), "told of what was not dropped"
            self.sender.told.clear()

    @invariant()
    def the_peer_waits_for_nothing(self) -> None:
        if hasattr(self, "sender") and self.sender.channel.reliable:
            channel = self.sender.channel
            coming = {out.seq for out in channel.retained}
            for last_seq, first in channel.gaps:
                coming.update(range(last_seq + 1, first))
            assert coming.issuperset(range(channel.watermark + 1, channel.next_seq)), "neither kept nor in a gap"
            assert all(a[1] <= b[0] + 1 and a[0] < b[0] for a, b in pairwise(channel.gaps)), "gaps out of order"
            seqs = [out.seq for out in channel.retained if out.seq > channel.watermark]
            assert not any(last_seq < seq < first for last_seq, first in channel.gaps for seq in seqs)


TestChannel = Channel.TestCase
TestChannel.settings = settings(max_examples=cases(75), stateful_step_count=40)


@pytest.mark.parametrize("reliable", [False, True])
def test_at_the_end_what_may_have_arrived_is_told_from_what_was_never_sent(reliable: bool) -> None:
    sender = Sender(spec(depth=10, reliable=reliable))
    sender.submit(1)
    sender.submit(1, 3000)
    sender.submit(1)
    assert sender.take() is not None and sender.take() is not None
    sender.channel.clear(DropReason.SHUTDOWN)
    assert sender.drops == [(1, DropReason.UNCONFIRMED), (2, DropReason.SHUTDOWN), (3, DropReason.SHUTDOWN)]
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


def test_a_backlog_of_tombstones_and_gaps_ends_as_one_span() -> None:
    sender = Sender(spec(reliable=True))
    channel = sender.channel
    for _ in range(100):
        sender.submit()
        channel.submit(sender.tombstone(channel.next_seq), now=0.0, forced=True)
        channel.skip_to(channel.next_seq + 3)
    assert channel.kept == 200 and channel.counters.dropped == 100
    channel.clear(DropReason.DISCONNECTED)
    assert sender.told == [(1, 496, DropReason.DISCONNECTED)] and len(sender.drops) == 100
    assert channel.counters.offered == channel.counters.dropped == 200 and channel.watermark == channel.next_seq - 1
    sender.check()


def test_what_lies_between_replays_is_not_told_of() -> None:
    """It was never owed to who joined late, and others may have it yet."""
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


def test_what_may_have_arrived_is_a_run_of_its_own() -> None:
    sender = Sender(spec(reliable=False, depth=10))
    sender.submit(5)
    for out in list(sender.channel.queue)[:2]:
        out.exposed = True
    sender.channel.clear(DropReason.SHUTDOWN)
    assert sender.told == [(1, 2, DropReason.UNCONFIRMED), (3, 5, DropReason.SHUTDOWN)]
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
        assert part is not None and part[0].message.tombstone
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


def test_without_a_link_what_has_lapsed_goes_together_and_becomes_no_tombstone_first() -> None:
    sender = Sender(spec(reliable=True, retention_s=10.0, lifespan_s=100.0))
    channel = sender.channel
    sender.submit(8)
    channel.submit(sender.tombstone(9), now=0.0, forced=True)
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
    assert channel.counters.dropped == 17 and not part[0].message.tombstone
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


@pytest.mark.parametrize("seed", seeds(20))
@pytest.mark.parametrize(("reliable", "depth"), [(True, 1), (False, 1), (False, 30)])
def test_many_fragments_that_are_lost_together_are_lost_as_one_by_one(seed: int, reliable: bool, depth: int) -> None:
    random = Random(seed)
    left: list[tuple[list[int], list[int], list[tuple[int, DropReason]], list[int]]] = []
    draw = [(random.choice((1, 100, 2500)), random.random() < 0.3) for _ in range(30)]
    order = [random.random() for _ in range(200)]
    for together in (True, False):
        sender = Sender(spec(reliable=reliable, depth=depth, lifespan_s=5.0))
        parts = []
        for index, (size, acked) in enumerate(draw):
            sender.submit(1, size, now=0.3 * index)
            while (part := sender.take(now=0.3 * index)) is not None:
                if acked:
                    sender.channel.fragment_acked(part[0], part[1])
                else:
                    parts.append(part)
        sender.submit(1, now=9.0)
        parts = [part for _, part in sorted(zip(order, parts, strict=False), key=lambda pair: pair[0])]
        if together:
            again = [out.seq for out in sender.channel.fragments_lost(parts, now=9.0)]
        else:
            again = [part[0].seq for part in parts if sender.channel.fragment_lost(*part, now=9.0)]
        sender.check()
        channel = sender.channel
        left.append(([out.seq for out in channel.active], sorted(channel.flying), sender.drops, again))
    assert left[0] == left[1] and (left[0][0] or not reliable)


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
        assert [out.message.tombstone for out in channel.retained] == [0] * 8
        channel.sweep(now + 11.0, up=True)
        assert len(channel.retained) == 8 and all(out.message.tombstone for out in channel.retained)
        channel.delivered_to(10)
        channel.peer_restarted()
        channel.prime([sender.message(seq, now=0.0, replay=True) for seq in range(3, 11)], now=33.0)


def test_confirming_twenty_costs_the_same_however_many_are_in_flight() -> None:
    def cost(flying: int) -> int:
        sender = Sender(spec(reliable=True))
        sender.submit(flying, now=0.0)
        while sender.take() is not None:
            pass
        assert len(sender.channel.flying) == flying
        return steps(lambda: sender.channel.delivered_to(20))

    assert cost(2000) <= 1.2 * cost(100)


def _whole_at_the_peer(count: int) -> Sender:
    sender = Sender(spec(reliable=True, lifespan_s=10.0, retention_s=3600.0))
    sender.submit(count, 2, now=0.0)
    sender.send_all()
    return sender


def test_a_sweep_looks_at_no_more_than_it_has_room_for_and_once_at_what_the_peer_has_whole() -> None:
    def cost(count: int) -> tuple[int, int, int]:
        sender = _whole_at_the_peer(count)
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


def test_tombstones_behind_one_that_stays_are_not_looked_at_in_each_sweep() -> None:
    def cost(count: int) -> int:
        sender = Sender(spec(reliable=True, lifespan_s=10.0, retention_s=3600.0))
        sender.submit(count, 2, now=0.0)
        part = sender.take()
        assert part is not None
        sender.channel.fragment_acked(part[0], part[1])
        while sender.channel.sweep(11.0, up=True, room=100):
            pass
        assert [out.seq for out in sender.channel.retained if not out.message.tombstone] == [1]
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
    sender = _whole_at_the_peer(5)
    channel = sender.channel
    assert channel.sweep(11.0, up=True) == 0 and not sender.drops
    channel.peer_restarted()
    assert channel.sweep(11.5, up=True) == 5
    assert sender.told == [(1, 5, DropReason.UNCONFIRMED)] and all(out.message.tombstone for out in channel.retained)
    sender.check()


def test_what_the_peer_has_whole_lapses_with_its_retention() -> None:
    sender = _whole_at_the_peer(5)
    channel = sender.channel
    for second in range(11, 3600, 500):
        assert channel.sweep(float(second), up=True) == 0
    assert channel.sweep(3601.0, up=True) == 5 and sender.told == [(1, 5, DropReason.UNCONFIRMED)]
    assert channel.counters.reliable_unconfirmed == 5
    sender.check()


@pytest.mark.parametrize("reason", [*LOSSES, DropReason.UNWANTED])
def test_what_nobody_wants_any_more_is_no_loss_though_it_was_not_confirmed(reason: DropReason) -> None:
    sender = _whole_at_the_peer(3)
    sender.submit(2, 2, now=0.0)
    sender.channel.clear(reason)
    counters = sender.channel.counters
    assert (counters.by_reason[DropReason.UNCONFIRMED], counters.by_reason[reason]) == (3, 2)
    assert counters.reliable_unconfirmed == (3 if reason in LOSSES else 0)


def test_what_is_given_up_as_it_goes_is_a_loss_once() -> None:
    sender = Sender(spec(reliable=True, retention_s=10.0))
    sender.submit(1, now=0.0)
    sender.send_all()
    sender.channel.peer_restarted()
    head = sender.channel.head(11.0)
    assert head is not None and head.message.tombstone and sender.drops == [(1, DropReason.UNCONFIRMED)]
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
            left = [out for out in channel.retained if not out.message.tombstone]
            replays = [out for out in left if out.message.replay]
            lapsed = [(out, reason) for out in left if (reason := channel._lapsed(out, now)) is not None]
            # Of replays the newer ones may be ahead: the retention of the older ends behind them.
            late = [out.seq for out, why in lapsed if out not in replays[1:] or why is DropReason.LIFESPAN]
            assert not late, f"still kept at {now}: {late}"
        sender.check()
    assert given_up


def test_what_may_have_arrived_is_unconfirmed_whatever_its_time_and_its_tombstone_says_why() -> None:
    """Begun and sent whole is not the same, and the next place takes the tombstone for what it did not get."""
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
