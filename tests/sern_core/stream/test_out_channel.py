"""The sending side of one stream: whatever happens in whatever order, the counters always add up."""

from itertools import pairwise
from random import Random

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from sern_core.stream.out_message import OutMessage
from sern_core.stream.prices import CLIENT_OVERHEAD_BYTES
from sern_core.vocabulary.ledger import LOSSES
from sern_core.vocabulary.types import DropReason
from tests.exploring import cases, seeds
from tests.sern_core.stream.sending import Sender, whole_at_the_peer
from tests.world import spec


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
    def submit_a_drop_marker(self) -> None:
        channel = self.sender.channel
        self.lost_before.add(channel.next_seq)
        channel.submit(self.sender.drop_marker(channel.next_seq), now=self.now, forced=True)

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
            assert not lapsed or out.message.drop_marker, "what has lapsed is sent"

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


TestChannel.settings = settings(max_examples=cases(50), stateful_step_count=40)


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


@pytest.mark.parametrize("reason", [*LOSSES, DropReason.UNWANTED])
def test_what_nobody_wants_any_more_is_no_loss_though_it_was_not_confirmed(reason: DropReason) -> None:
    sender = whole_at_the_peer(3)
    sender.submit(2, 2, now=0.0)
    sender.channel.clear(reason)
    counters = sender.channel.counters
    assert (counters.by_reason[DropReason.UNCONFIRMED], counters.by_reason[reason]) == (3, 2)
    assert counters.reliable_unconfirmed == (3 if reason in LOSSES else 0)
