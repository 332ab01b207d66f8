"""Reassembly: pieces in any order, repeated, overlapping; order, once, limits and drop markers."""

import random
import tracemalloc
from collections.abc import Sequence
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sern_core.stream.in_stream import (
    HELD_OVERHEAD_BYTES,
    MAX_PARTIALS,
    MAX_PIECES,
    PARTIAL_IDLE_S,
    PIECE_BYTES,
    InStream,
    Partial,
    Reassembly,
)
from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.limits import LIMITS
from sern_core.vocabulary.message import Message, StreamId, StreamInfo, TopicInfo
from sern_core.vocabulary.types import DROP_CODES, ClientName, DropReason, Encoding, TopicName
from sern_core.wire.framing import FLAG_DROP_MARKER
from tests.exploring import cases
from tests.world import spec


class Receiver:
    """An `InStream` with a record of what it did."""

    def __init__(
        self, *, reliable: bool = False, lifespan_s: float | None = None, limit_bytes: int = 10**6, first: int = 1
    ) -> None:
        info = TopicInfo(TopicName("/t"), "", Encoding.RAW)
        stream = StreamInfo(
            StreamId(ClientName("a"), 1, info.name), info, spec(reliable=reliable, lifespan_s=lifespan_s)
        )
        self.room = Reassembly(limit_bytes)
        self.turns: list[Message] = []
        self.drops: list[tuple[DropReason, int]] = []
        self.stream = InStream(stream, self.room, self._turn, self._drop, first=first)

    def _turn(self, stream: InStream, message: Message) -> None:
        self.turns.append(message)

    def _drop(self, stream: InStream, reason: DropReason, nbytes: int, seqs: Sequence[int], reported: bool) -> None:
        assert seqs and min(seqs) > 0
        self.drops += [(reason, seq if reported else 0) for seq in seqs]

    def piece(self, seq: int, start: int, end: int, total: int, *, now: float = 0.0, born_s: float = 0.0) -> None:
        self.stream.fragment(0, seq, start, total, _body(seq, total)[start:end], 7, born_s, 0.0, now)
        self.check()

    def whole(self, seq: int, *, now: float = 0.0, born_s: float = 0.0, error_s: float = 0.0) -> None:
        self.stream.fragment(0, seq, 0, 8, _body(seq, 8), 7, born_s, error_s, now)
        self.check()

    def skip_to(self, first: int) -> int:
        self.stream.skip_to(first, 0.0)
        assert self.stream not in self.room.behind, "more than one slice"
        self.room.work_us = 0
        self.check()
        return self.stream.left_out

    def drop_marker(self, seq: int, reason: DropReason) -> None:
        self.stream.fragment(FLAG_DROP_MARKER, seq, 0, 1, bytes([DROP_CODES[reason]]), 0, 0.0, 0.0, 0.0)
        self.check()

    def check(self) -> None:
        def check(ok: bool, text: str) -> None:
            assert ok, text

        self.stream.validate(check)
        assert self.room.held_bytes == self.stream.held_bytes

    @property
    def seqs(self) -> list[int]:
        return [message.seq for message in self.turns]


def _body(seq: int, total: int) -> bytes:
    return (b"%08d" % seq * (total // 8 + 1))[:total]


@settings(max_examples=cases(120))
@given(st.data())
def test_pieces_in_any_order_repeated_and_overlapping(data: st.DataObject) -> None:
    total = data.draw(st.integers(2, 300))
    cuts = sorted({0, total, *data.draw(st.lists(st.integers(1, total - 1), max_size=8))})
    pieces = [*pairwise(cuts)]
    pieces += data.draw(st.lists(st.sampled_from(pieces), max_size=5))
    starts = data.draw(st.lists(st.integers(0, total - 1), max_size=5))
    pieces += [(start, data.draw(st.integers(start + 1, total))) for start in starts]
    receiver = Receiver(reliable=data.draw(st.booleans()))
    for start, end in data.draw(st.permutations(pieces)):
        receiver.piece(1, start, end, total)
    assert [(message.seq, message.body) for message in receiver.turns] == [(1, _body(1, total))]
    assert receiver.room.held_bytes == 0


@settings(max_examples=cases(120))
@given(st.lists(st.tuples(st.integers(1, 20), st.booleans()), max_size=60))
def test_reliable_is_once_and_in_order_best_effort_rises(arrivals: list[tuple[int, bool]]) -> None:
    reliable, best = Receiver(reliable=True), Receiver()
    for seq, dead in arrivals:
        best.whole(seq)
        if dead:
            reliable.drop_marker(seq, DropReason.LIFESPAN)
        else:
            reliable.whole(seq)
    arrived = {seq for seq, _ in arrivals}
    expected = 0
    while expected + 1 in arrived:
        expected += 1
    assert reliable.seqs == list(range(1, expected + 1))
    assert best.seqs == sorted(set(best.seqs)) and (not arrived or best.seqs[-1] == max(arrived))


def test_an_older_sample_and_a_repeated_one_are_told_apart() -> None:
    receiver = Receiver()
    for seq in (1, 4, 2, 2, 4):
        receiver.whole(seq)
    assert receiver.seqs == [1, 4]
    assert [reason for reason, _ in receiver.drops] == [
        DropReason.SUPERSEDED,
        DropReason.DUPLICATE,
        DropReason.DUPLICATE,
    ]


def test_a_far_jump_of_seqs_costs_nothing() -> None:
    receiver = Receiver()
    receiver.whole(2**40)
    assert receiver.seqs == [2**40]


@pytest.mark.parametrize("reliable", [True, False])
def test_late_as_far_as_can_be_known_is_late(reliable: bool) -> None:
    receiver = Receiver(reliable=reliable, lifespan_s=0.3)
    receiver.whole(1, now=0.2)
    receiver.whole(2, now=0.2, error_s=0.15)
    assert receiver.drops == [(DropReason.LIFESPAN, 2 if reliable else 0)]
    assert receiver.seqs == ([1, 2] if reliable else [1])
    if reliable:
        assert receiver.turns[1].drop_reason is DropReason.LIFESPAN


def test_a_message_that_grew_old_waiting_for_the_one_before_it_is_late() -> None:
    receiver = Receiver(reliable=True, lifespan_s=1.0)
    receiver.whole(2, now=0.1)
    receiver.whole(1, now=5.0, born_s=4.9)
    assert [bool(message.drop_marker) for message in receiver.turns] == [False, True]


def test_a_drop_marker_takes_the_place_of_what_is_half_received() -> None:
    receiver = Receiver(reliable=True)
    receiver.piece(1, 0, 50, 100)
    receiver.drop_marker(1, DropReason.RETENTION)
    receiver.piece(1, 50, 100, 100)
    assert receiver.seqs == [1] and receiver.turns[0].drop_reason is DropReason.RETENTION
    assert receiver.room.held_bytes == 0


def test_a_reliable_message_without_room_is_given_up_in_its_turn() -> None:
    """Its sender believes the pieces have arrived: without this the stream would wait for ever."""
    receiver = Receiver(reliable=True, limit_bytes=200 + HELD_OVERHEAD_BYTES)
    receiver.piece(1, 0, 100, 1000)
    receiver.whole(2)
    assert receiver.drops == [(DropReason.REASSEMBLY, 1)]
    assert receiver.seqs == [1, 2] and receiver.turns[0].drop_reason is DropReason.REASSEMBLY


def test_best_effort_makes_way_when_memory_is_short() -> None:
    receiver = Receiver(limit_bytes=3 * (100 + HELD_OVERHEAD_BYTES))
    for seq in range(1, 6):
        receiver.piece(seq, 0, 50, 100, now=float(seq))
    assert [reason for reason, _ in receiver.drops] == [DropReason.REASSEMBLY] * 2
    receiver.piece(5, 50, 100, 100)
    assert receiver.seqs == [5]
    for seq in range(10, 12 + MAX_PARTIALS):
        receiver.piece(seq, 0, 1, 2)
    assert len(receiver.stream._partials) <= MAX_PARTIALS


def test_the_newest_half_received_message_is_waited_for() -> None:
    receiver = Receiver()
    receiver.piece(1, 0, 50, 100)
    receiver.piece(2, 0, 50, 100)
    receiver.stream.sweep(PARTIAL_IDLE_S + 1, 0.0)
    assert receiver.drops == [(DropReason.LOST, 0)]
    receiver.piece(2, 50, 100, 100, now=10 * PARTIAL_IDLE_S)
    assert receiver.seqs == [2]


def test_a_link_that_was_down_is_no_reason_to_give_up() -> None:
    receiver = Receiver()
    receiver.piece(1, 0, 50, 100)
    receiver.piece(2, 0, 50, 100)
    receiver.stream.sweep(100.0, 99.0)
    assert receiver.drops == []


def test_half_received_and_too_old_is_given_up() -> None:
    receiver = Receiver(lifespan_s=1.0)
    receiver.piece(1, 0, 50, 100)
    receiver.stream.sweep(2.0, 0.0)
    assert receiver.drops == [(DropReason.LOST, 0)] and receiver.room.held_bytes == 0


def test_skipping_delivers_what_waited_and_counts_the_rest() -> None:
    receiver = Receiver(reliable=True)
    receiver.whole(3)
    receiver.whole(6)
    receiver.piece(4, 0, 50, 100)
    assert receiver.skip_to(6) == 4
    assert receiver.seqs == [3, 6] and receiver.stream.delivered == 6 and receiver.room.held_bytes == 0
    assert receiver.skip_to(2**60) == 2**60 - 7
    assert receiver.skip_to(5) == 0


@pytest.mark.parametrize("whole", [True, False])
def test_skipping_one_of_many_looks_at_no_more_than_it_leaves_out(whole: bool) -> None:
    receiver = Receiver(reliable=True, limit_bytes=10**9)
    stream, count = receiver.stream, 20_000
    for seq in range(1_000_000, 1_000_000 + count):
        stream.fragment(0, seq, 0, 8, bytes(8 if whole else 4), 7, 0.0, 0.0, 0.0)
    for first in range(2, 500):
        stream.skip_to(first, 0.0)
        assert stream.left_out == 1
    assert receiver.room.work_us == 0 and stream not in receiver.room.behind
    receiver.check()


def test_many_half_received_messages_are_left_out_in_slices() -> None:
    receiver = Receiver(reliable=True, limit_bytes=10**9)
    stream, room, count = receiver.stream, receiver.room, 20_000
    for seq in range(1000, 1000 + count):
        stream.fragment(0, seq, 0, 8, bytes(8 if seq % 1000 == 999 else 4), 7, 0.0, 0.0, 0.0)
    stream.skip_to(1000 + count, 0.0)
    slices = 1
    while stream in room.behind:
        assert room.work_us < 2 * LIMITS.slice_us
        room.work_us = 0
        stream.go_on(0.0)
        slices += 1
        receiver.check()
    assert slices > 3 and room.held_bytes == 0
    assert stream.delivered == 999 + count and stream.left_out == stream.delivered - count // 1000
    assert receiver.seqs == list(range(1999, 1000 + count, 1000))


@settings(max_examples=cases(60), deadline=None)
@given(st.lists(st.tuples(st.integers(1, 40), st.sampled_from(["whole", "piece", "first"])), max_size=40))
def test_skipping_whatever_has_arrived(steps: list[tuple[int, str]]) -> None:
    receiver = Receiver(reliable=True)
    arrived: set[int] = set()
    left_out = first = 0
    for seq, what in steps:
        if what == "first":
            left_out += receiver.skip_to(seq)
            first = max(first, seq)
        elif what == "whole":
            if seq > receiver.stream.delivered:
                arrived.add(seq)
            receiver.whole(seq)
        else:
            receiver.piece(seq, 0, 4, 8)
        receiver.check()
    turns = receiver.seqs
    assert turns == sorted(arrived & set(range(1, receiver.stream.delivered + 1)))
    assert receiver.stream.delivered >= first - 1 and len(turns) + left_out == receiver.stream.delivered


def test_closing_lets_go_of_everything() -> None:
    receiver = Receiver(reliable=True)
    receiver.whole(3)
    receiver.piece(2, 0, 50, 100)
    receiver.stream.close()
    assert receiver.room.held_bytes == 0


@pytest.mark.parametrize("cuts", [(0, 40), (0, 16, 40)])
def test_bodies_are_kept_as_bytes_of_their_own(cuts: tuple[int, ...]) -> None:
    receiver = Receiver()
    buffer = bytearray(_body(1, 40))
    for start, end in pairwise(cuts):
        receiver.stream.fragment(0, 1, start, 40, memoryview(buffer)[start:end], 7, 0.0, 0.0, 0.0)
    buffer[:] = bytes(40)  # the lane takes its memory back
    assert [message.body for message in receiver.turns] == [_body(1, 40)]
    assert type(receiver.turns[0].body) is bytes
    receiver.check()


def _orders(count: int) -> dict[str, list[int]]:
    shuffled = list(range(count))
    random.Random(3).shuffle(shuffled)
    return {
        "in order": list(range(count)),
        "in reverse": list(reversed(range(count))),
        "the odd ones first": [*range(1, count, 2), *range(0, count, 2)],
        "the odd ones first, then back": [*range(1, count, 2), *reversed(range(0, count, 2))],
        "shuffled": shuffled,
    }


@pytest.mark.parametrize("order", list(_orders(1)))
def test_a_byte_is_moved_a_logarithmic_number_of_times(order: str, monkeypatch: pytest.MonkeyPatch) -> None:
    size, count = 100, 1200
    moved = 0

    def count_moved(partial: Partial, index: int) -> None:
        nonlocal moved
        before = len(partial._pieces[index])
        join(partial, index)
        moved += len(partial._pieces[index]) - before

    join = Partial._join
    monkeypatch.setattr(Partial, "_join", count_moved)
    partial = Partial(size * count)
    whole = _body(1, size * count)
    most = 0
    for number in _orders(count)[order]:
        partial.add(number * size, whole[number * size : (number + 1) * size])
        most = max(most, partial.pieces)
    partial.born_s = 0.0
    assert partial.complete
    assert partial.body() == whole
    assert moved <= 18 * size * count  # log of 1200 to the base 1.5
    assert most <= count // 2 + 20


def test_what_is_only_claimed_costs_nothing() -> None:
    receiver = Receiver(limit_bytes=128 * 2**20)
    tracemalloc.start()
    try:
        for seq in range(1, 5):
            receiver.piece(seq, 0, 10, 30_000_000)
            receiver.stream.fragment(0, seq, 29_000_000, 30_000_000, b"x" * 10, 7, 0.0, 0.0, 0.0)
        held, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert receiver.room.held_bytes > 120e6  # there is room for them when they come
    assert held < 50_000


def test_pieces_are_bounded_and_taken_into_account() -> None:
    receiver = Receiver(reliable=True, limit_bytes=10**9)
    total = 10**6
    for number in range(MAX_PIECES - 1):
        receiver.stream.fragment(0, 1, 2 + 2 * number, total, b"x", 7, 0.0, 0.0, 0.0)
    assert receiver.room.held_bytes >= total + MAX_PIECES * PIECE_BYTES
    receiver.check()
    with pytest.raises(WireError, match="pieces"):
        receiver.stream.fragment(0, 1, total - 1, total, b"x", 7, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("reliable", [True, False])
def test_a_message_whose_pieces_find_no_room_is_given_up(reliable: bool) -> None:
    receiver = Receiver(reliable=reliable, limit_bytes=1000 + HELD_OVERHEAD_BYTES)
    for start in range(2, 100, 2):
        receiver.piece(1, start, start + 1, 1000)
    assert receiver.drops[0] == (DropReason.REASSEMBLY, 1 if reliable else 0)
    assert receiver.seqs == ([1] if reliable else [])
    receiver.whole(2)
    assert receiver.seqs[-1] == 2


def test_the_stream_untouched_for_longest_makes_way_whatever_there_are() -> None:
    """Finding the first of a thousand streams with half a message each costs no search."""
    streams = [Receiver() for _ in range(4)]
    room = Reassembly(3 * (100 + HELD_OVERHEAD_BYTES))
    for receiver in streams:
        receiver.room = receiver.stream._reassembly = room
    for receiver in streams[:3]:
        receiver.stream.fragment(0, 1, 0, 100, b"x" * 10, 7, 0.0, 0.0, 0.0)
    streams[0].stream.fragment(0, 1, 10, 100, b"x" * 10, 7, 0.0, 0.0, 0.0)
    streams[3].stream.fragment(0, 1, 0, 100, b"x" * 10, 7, 0.0, 0.0, 0.0)
    assert [bool(receiver.drops) for receiver in streams] == [False, True, False, False]
    for receiver in streams:
        receiver.stream.close()
    assert room.held_bytes == 0 and not room.holders and room.latest is None
