"""What is in flight, what has arrived, and when either is given up or acknowledged."""

from collections.abc import Iterable
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sern_core.path.flight import (
    ACK_DELAY_S,
    ACK_SPACING_S,
    FIRST_LOSS_TIMEOUT_S,
    MAX_WAITING_ACKS,
    REORDER_MEMORY_S,
    SACK_BITS,
    SPACED_BYTES,
    SPARSE_ACK_DATAGRAMS,
    Ack,
    Arrivals,
    Flight,
)
from sern_core.vocabulary.types import PriorityClass
from tests.exploring import cases

CONTROL, STATE, BULK = PriorityClass


def flight(count: int, *, lossless: bool = False, rtt_s: float | None = 0.1) -> Flight:
    result = Flight(lossless=lossless)
    if rtt_s is not None:
        result.rtt.sample(rtt_s, now=0.0)
    for number in range(count):
        result.sent(now=0.01 * number, nbytes=100, items=[number], app_limited=False)
    return result


def valid(subject: Flight) -> None:
    def check(ok: bool, text: str) -> None:
        assert ok, text

    subject.validate(check)


def test_a_stream_acknowledges_everything_up_to_the_highest() -> None:
    subject = flight(5, lossless=True)
    assert [p.number for p in subject.acked(3, 0, now=1.0)] == [1, 2, 3]
    assert subject.inflight_bytes == 200 and subject.lost(now=100.0) == [] and subject.loss_deadline() is None
    valid(subject)


def test_datagrams_acknowledge_what_the_map_says() -> None:
    subject = flight(6)
    assert [p.number for p in subject.acked(5, 0b0101, now=0.1)] == [2, 4, 5]
    assert [p.number for p in subject.acked(5, 0b0101, now=0.1)] == []
    assert list(subject.packets) == [1, 3, 6]
    valid(subject)


def test_lost_when_three_later_ones_have_arrived() -> None:
    subject = flight(6)
    subject.acked(4, 0b11, now=0.05)  # 4, 3, 2
    assert [p.number for p in subject.lost(now=0.05)] == [1]
    assert list(subject.packets) == [5, 6]


def test_after_one_came_late_the_next_has_as_long_to_come_and_a_quarter_more() -> None:
    subject = flight(6)
    subject.acked(4, 0b11, now=0.05)  # 4, 3, 2
    assert [p.number for p in subject.lost(now=0.05)] == [1] and subject.reorder_s == 0.0
    subject.acked(4, 0b111, now=0.07)  # 1, after all
    assert subject.reorder_s == pytest.approx(1.25 * 0.02)
    for number in (7, 8, 9):
        subject.sent(now=0.08, nbytes=100, items=[number], app_limited=False)
    subject.acked(9, 0b1111, now=0.2)  # 9, and 8 to 5
    for number in (10, 11, 12, 13):
        subject.sent(now=0.2, nbytes=100, items=[number], app_limited=False)
    subject.acked(13, 0b11, now=0.25)  # 13, 12, 11; 10 is behind
    assert subject.lost(now=0.25) == []
    deadline_s = subject.loss_deadline()
    assert deadline_s is not None and deadline_s == pytest.approx(0.25 + 1.25 * 0.02, abs=1e-5)
    assert subject.lost(now=0.26) == []
    assert [p.number for p in subject.lost(now=deadline_s)] == [10]
    valid(subject)


def test_no_packet_has_more_than_a_round_trip_to_come_late_and_a_path_is_forgiven() -> None:
    subject = flight(6, rtt_s=0.1)
    subject.acked(4, 0b11, now=0.05)
    assert len(subject.lost(now=0.05)) == 1
    subject.acked(4, 0b111, now=5.0)
    assert subject.reorder_s == pytest.approx(0.1)
    subject.lost(now=5.0 + REORDER_MEMORY_S + 0.1)
    assert subject.reorder_s == 0.0


def test_what_is_kept_of_packets_that_were_given_up_is_bounded() -> None:
    subject = flight(2000)
    for highest in range(4, 2000, 4):
        subject.acked(highest, 0b11, now=0.01)
        subject.lost(now=0.01)
        valid(subject)


def test_a_more_urgent_packet_that_overtakes_shows_no_loss() -> None:
    """A network that heeds the marks of the classes lets class control pass; what waits there is not lost."""
    subject = flight(0)
    for number, priority in enumerate((BULK, BULK, CONTROL, CONTROL, CONTROL, STATE, BULK, BULK)):
        subject.sent(now=0.001 * number, nbytes=100, items=[], app_limited=False, priority=priority)
    subject.acked(6, 0b111, now=0.05)  # 6, 5, 4, 3: two of class bulk wait
    assert subject.lost(now=0.05) == []
    subject.acked(8, 0b11110, now=0.06)  # a later one of their own class
    assert [p.number for p in subject.lost(now=0.06)] == [1, 2]
    assert list(subject.packets) == [7]


def test_a_less_urgent_packet_that_arrives_first_shows_a_loss() -> None:
    subject = flight(0)
    for priority in (CONTROL, BULK, BULK, BULK):
        subject.sent(now=0.0, nbytes=100, items=[], app_limited=False, priority=priority)
    subject.acked(4, 0b11, now=0.05)
    assert [p.number for p in subject.lost(now=0.05)] == [1]


def test_lost_when_older_than_the_timeout_and_not_before() -> None:
    subject = flight(2, rtt_s=0.1)
    timeout_s = subject.loss_timeout_s()
    assert timeout_s >= 0.23
    due_s = subject.loss_deadline()
    assert due_s is not None and subject.lost(now=due_s - 2e-6) == []
    assert [p.number for p in subject.lost(now=due_s)] == [1]


def test_a_path_slower_than_the_first_guess_is_measured_all_the_same() -> None:
    """Its packets are given up before their acknowledgements come; those still tell that something arrives."""
    subject = flight(3, rtt_s=None)
    assert subject.loss_timeout_s() == FIRST_LOSS_TIMEOUT_S
    assert len(subject.lost(now=10.0)) == 3
    assert subject.waiting_since_s is not None, "still nothing has been heard"
    subject.acked(3, 0b11, now=10.5)
    assert subject.highest_acked == 3 and subject.waiting_since_s is None


def test_a_stall_is_counted_from_the_first_unanswered_packet() -> None:
    subject = Flight(lossless=False)
    subject.sent(now=0.0, nbytes=10, items=[], app_limited=True)
    for at_s in (5.0, 10.0, 15.0):  # lost one by one, so that nothing is in flight in between
        assert subject.lost(now=at_s)
        subject.sent(now=at_s, nbytes=10, items=[], app_limited=True)
    assert subject.waiting_since_s == 0.0
    subject.acked(4, 0, now=16.0)
    assert subject.waiting_since_s is None


def test_abandoned_packets_come_back_in_order_and_numbers_go_on() -> None:
    subject = flight(3)
    assert [p.items for p in subject.abandon()] == [[0], [1], [2]]
    assert subject.next_number == 4 and subject.inflight_bytes == 0
    valid(subject)


def test_acknowledged_at_once_on_a_gap_and_every_second_time_else() -> None:
    arrivals = Arrivals()
    told = []
    for at, number in enumerate((1, 2, 4, 3)):
        assert arrivals.arrived(number, 10 * number, 100, now=float(at))
        told.append((arrivals.due, arrivals.highest, arrivals.mask, arrivals.echo_us, arrivals.cum_bytes))
        if arrivals.due:
            arrivals.flushed(float(at))
    assert told == [
        (False, 1, 0, 10, 100),
        (True, 2, 0b1, 20, 200),
        (True, 4, 0b110, 40, 300),
        (True, 4, 0b111, 40, 400),
    ]


def test_large_datagrams_of_a_fast_stream_are_acknowledged_together() -> None:
    arrivals = Arrivals(lossless=True)
    told = []
    for number in range(1, 13):
        now = 0.0002 * number
        arrivals.arrived(number, 0, SPACED_BYTES, now=now)
        if arrivals.due:
            told.append(number)
            arrivals.flushed(now)
        elif told:
            deadlines = (now + ACK_DELAY_S, 0.0002 * told[-1] + ACK_SPACING_S)
            assert arrivals.deadline_s() == pytest.approx(deadlines[arrivals.unacked > 1])
    assert told == [2, 7, 12]
    for number in (13, 14):  # small ones are of a link that is slow, or not known yet
        arrivals.arrived(number, 0, SPACED_BYTES - 1, now=0.0002 * 12)
    assert arrivals.due


def test_small_datagrams_between_relays_are_acknowledged_together() -> None:
    arrivals = Arrivals(sparse=True)
    told = []
    for number in range(1, 2 * SPARSE_ACK_DATAGRAMS + 1):
        arrivals.arrived(number, 0, 100, now=0.0001 * number)
        if arrivals.due:
            told.append(number)
            arrivals.flushed(0.0001 * number)
        else:  # however many they are, none waits longer than a lone one
            first = told[-1] + 1 if told else 1
            assert arrivals.deadline_s() == pytest.approx(0.0001 * first + ACK_DELAY_S)
    assert told == [SPARSE_ACK_DATAGRAMS, 2 * SPARSE_ACK_DATAGRAMS]
    arrivals.arrived(100, 0, 100, now=0.01)
    assert arrivals.due  # a gap, at once


def test_no_acknowledgement_of_datagrams_that_may_be_lost_waits() -> None:
    arrivals = Arrivals(lossless=False)
    for number in range(1, 9):
        arrivals.arrived(number, 0, SPACED_BYTES, now=0.0)
        assert arrivals.due is (number % 2 == 0)
        if arrivals.due:
            arrivals.flushed(0.0)


def named(acks: Iterable[Ack]) -> set[int]:
    """Numbers that they say have arrived."""
    found = set()
    for ack in acks:
        found |= {ack.highest} | {ack.highest - 1 - bit for bit in range(SACK_BITS) if ack.mask >> bit & 1}
    return found


@settings(max_examples=cases(60))
@given(st.integers(1, 400), st.integers(0, 2**16))
def test_what_comes_faster_than_it_is_acknowledged_is_named_all_the_same(count: int, seed: int) -> None:
    """A busy end reads hundreds of datagrams before it can send anything: one acknowledgement names 65."""
    chance, arrivals, sender = Random(seed), Arrivals(), flight(2 * count)
    numbers = [number for number in range(1, 2 * count + 1) if chance.random() < 0.5]
    for number in numbers:
        arrivals.arrived(number, number, 100, now=0.01)
    most, rounds = 4, 0
    while arrivals.acks:
        acks = arrivals.take(most, 0.02)
        assert 0 < len(acks) <= most and arrivals.due is (arrivals.acks > 0)
        for ack in acks:
            numbers = [number for number in numbers if number not in named([ack])]
            sender.acked(ack.highest, ack.mask, now=0.03)
        rounds += 1
    assert numbers == [] and rounds <= count // (most * SACK_BITS // 2) + 1
    valid(sender)


def test_an_end_that_never_gets_to_acknowledge_keeps_a_bounded_number() -> None:
    arrivals = Arrivals()
    for number in range(1, 100 * SACK_BITS * MAX_WAITING_ACKS, SACK_BITS):
        arrivals.arrived(number, 0, 100, now=0.0)
    assert arrivals.acks == MAX_WAITING_ACKS + 1


def test_a_stream_needs_one_acknowledgement_for_all() -> None:
    arrivals = Arrivals(lossless=True)
    for number in range(1, 10 * SACK_BITS):
        arrivals.arrived(number, 0, 100, now=0.0)
    assert arrivals.acks == 1


def test_a_far_jump_of_numbers_costs_nothing() -> None:
    arrivals = Arrivals()
    arrivals.arrived(1, 0, 1, now=0.0)
    assert arrivals.arrived(0xFFFFFFFF, 0, 1, now=0.0)
    assert arrivals.mask == 0 and arrivals.highest == 0xFFFFFFFF


@settings(max_examples=cases(120))
@given(
    st.lists(st.integers(1, 40), max_size=60),
    st.integers(0, 2**16),
)
def test_the_map_says_what_has_arrived(numbers: list[int], seed: int) -> None:
    arrivals = Arrivals()
    seen: set[int] = set()
    for number in numbers:
        assert arrivals.arrived(number, number, 10, now=0.0) is (number not in seen)
        seen.add(number)
    if not seen:
        return
    assert arrivals.highest == max(seen) and arrivals.cum_bytes == 10 * len(seen)
    told = {arrivals.highest} | {arrivals.highest - 1 - bit for bit in range(SACK_BITS) if arrivals.mask >> bit & 1}
    assert told == seen
    sender = Flight(lossless=False)
    for _ in range(40):
        sender.sent(now=0.0, nbytes=1, items=[], app_limited=False)
    assert {packet.number for packet in sender.acked(arrivals.highest, arrivals.mask, now=0.0)} == seen
