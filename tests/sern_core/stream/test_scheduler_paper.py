"""Ordering `paper`: Alg. prioritize as printed, against a direct transcription."""

from dataclasses import dataclass

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sern_core.stream.scheduler import Scheduler, WaitReason
from sern_core.vocabulary.params import SchedulerParams
from sern_core.vocabulary.types import CLASSES, Ordering, PriorityClass
from tests.exploring import cases

CONTROL, STATE, BULK = CLASSES
T0 = 1000.0
PARAMS = SchedulerParams(ordering=Ordering.PAPER, interval_s=0.05)
RATE_BPS = 1e6
BUDGET_BYTES = 6_250.0  # B·Δt


def paper_scheduler(rate_bps: float | None = RATE_BPS) -> Scheduler:
    scheduler = Scheduler(PARAMS, now=T0)
    scheduler.set_rate(rate_bps, now=T0)
    return scheduler


@dataclass(frozen=True)
class Pending:
    priority: PriorityClass
    weight: float
    size_bytes: float
    since_s: float
    lifespan_s: float | None


def transcription(pending: dict[int, Pending], now: float, available_bytes: float) -> tuple[list[int], list[int]]:
    """Lines 1-12 of Alg. prioritize: what is transmitted, in order, and what is dropped. Equals: lower id first."""
    scored = []
    for channel_id, m in pending.items():
        age_s = min(now - m.since_s, PARAMS.a_max_s)
        p = m.weight / (m.size_bytes + PARAMS.epsilon_bytes) * (1.0 + PARAMS.eta * age_s)
        scored.append((-p, channel_id))
    scored.sort()
    used_bytes = 0.0
    transmit, drop = [], []
    for _, channel_id in scored:
        m = pending[channel_id]
        stale = m.lifespan_s is not None and now - m.since_s > m.lifespan_s
        if used_bytes + m.size_bytes <= available_bytes:
            transmit.append(channel_id)
            used_bytes += m.size_bytes
        elif stale and m.priority is BULK:
            drop.append(channel_id)
    return transmit, drop


def drain(scheduler: Scheduler, now: float, sizes: dict[int, float]) -> list[int]:
    """Send everything marked, in fragments of up to 1200 bytes; the channels in the order they were finished."""
    sent = []
    while (channel_id := scheduler.pick(now=now)) is not None:
        standing = scheduler.explain(channel_id, now)
        assert standing is not None and standing.waits_for is None
        left = sizes[channel_id]
        while left > 0:
            assert scheduler.pick(now=now) == channel_id, "a marked message is sent whole"
            fragment = min(left, 1200.0)
            scheduler.charge(standing.priority, int(fragment), now=now)
            left -= fragment
            if left > 0:
                scheduler.offer(
                    channel_id,
                    priority=standing.priority,
                    weight=standing.weight,
                    size_bytes=left,
                    since_s=now - standing.age_s,
                )
        scheduler.withdraw(channel_id)
        sent.append(channel_id)
    return sent


messages = st.builds(
    Pending,
    priority=st.sampled_from(CLASSES),
    weight=st.sampled_from([1.0, 3.0, 10.0]),
    size_bytes=st.integers(0, 8_000).map(float),
    since_s=st.integers(0, 40).map(lambda quarters: T0 - quarters / 4.0),
    lifespan_s=st.none() | st.sampled_from([0.3, 1.0, 5.0]),
)


@settings(max_examples=cases(60))
@given(rounds=st.lists(st.lists(messages, max_size=12), min_size=1, max_size=5))
def test_each_interval_does_what_the_algorithm_says(rounds: list[list[Pending]]) -> None:
    scheduler = paper_scheduler()
    pending: dict[int, Pending] = {}
    next_id = 0
    for number, arrivals in enumerate(rounds):
        now = T0 + number * 0.05 + 0.001
        for message in arrivals:
            pending[next_id] = message
            scheduler.offer(
                next_id,
                priority=message.priority,
                weight=message.weight,
                size_bytes=message.size_bytes,
                since_s=message.since_s,
                stale_after_s=message.lifespan_s,
            )
            next_id += 1
        transmit, drop = transcription(pending, now, BUDGET_BYTES)
        assert sorted(scheduler.take_stale(now)) == sorted(drop)
        assert scheduler.take_stale(now) == [], "each is named once an interval"
        for channel_id in drop:
            scheduler.withdraw(channel_id)
            del pending[channel_id]
        sent = drain_in_whole(scheduler, now, pending)
        assert sent == transmit
        scheduler.validate()


def drain_in_whole(scheduler: Scheduler, now: float, pending: dict[int, Pending]) -> list[int]:
    sent = []
    while (channel_id := scheduler.pick(now=now)) is not None:
        message = pending.pop(channel_id)
        scheduler.charge(message.priority, int(message.size_bytes), now=now)
        scheduler.withdraw(channel_id)
        sent.append(channel_id)
    return sent


def test_classes_are_mixed_and_messages_sent_whole() -> None:
    scheduler = paper_scheduler()
    sizes = {1: 6_000.0, 2: 100.0, 3: 120.0}
    scheduler.offer(1, priority=CONTROL, weight=10.0, size_bytes=sizes[1], since_s=T0)
    scheduler.offer(2, priority=BULK, weight=1.0, size_bytes=sizes[2], since_s=T0)
    scheduler.offer(3, priority=STATE, weight=3.0, size_bytes=sizes[3], since_s=T0)
    assert drain(scheduler, T0, sizes) == [3, 2, 1]
    scheduler.validate()


def test_message_larger_than_the_budget_is_never_sent() -> None:
    """The known consequence of the printed algorithm; ordering `class` sends it in fragments."""
    scheduler = paper_scheduler()
    scheduler.offer(1, priority=CONTROL, weight=10.0, size_bytes=BUDGET_BYTES + 1, since_s=T0)
    for interval in range(200):
        assert scheduler.pick(now=T0 + interval * 0.05 + 1e-3) is None
    standing = scheduler.explain(1, T0 + 10.0)
    assert standing is not None and standing.waits_for is WaitReason.INTERVAL
    by_class = Scheduler(SchedulerParams(), now=T0)
    by_class.set_rate(RATE_BPS, now=T0)
    by_class.offer(1, priority=CONTROL, weight=10.0, size_bytes=BUDGET_BYTES + 1, since_s=T0)
    assert by_class.pick(now=T0) == 1


def test_unknown_capacity_sends_everything() -> None:
    scheduler = paper_scheduler(rate_bps=None)
    scheduler.offer(1, priority=BULK, weight=1.0, size_bytes=1e9, since_s=T0)
    assert scheduler.pick(now=T0) == 1


def test_newcomer_waits_for_the_next_interval() -> None:
    scheduler = paper_scheduler()
    assert scheduler.pick(now=T0) is None  # the algorithm ran on an empty list
    scheduler.offer(1, priority=CONTROL, weight=10.0, size_bytes=100, since_s=T0 + 0.01)
    assert scheduler.pick(now=T0 + 0.01) is None
    deadline = scheduler.next_deadline(now=T0 + 0.01, window_open=True)
    assert deadline == pytest.approx(T0 + 0.05)
    assert deadline is not None
    assert scheduler.pick(now=deadline) == 1
    assert scheduler.next_deadline(now=deadline, window_open=True) is None


def test_intervals_keep_their_grid_after_silence() -> None:
    scheduler = paper_scheduler()
    assert scheduler.pick(now=T0 + 123.456) is None
    scheduler.offer(1, priority=CONTROL, weight=10.0, size_bytes=100, since_s=T0 + 123.456)
    assert scheduler.next_deadline(now=T0 + 123.456, window_open=True) == pytest.approx(T0 + 123.5)


def test_new_head_of_a_marked_slot_waits_but_the_rest_of_its_message_does_not() -> None:
    scheduler = paper_scheduler()

    def offer(size_bytes: float, since_s: float) -> None:
        scheduler.offer(1, priority=STATE, weight=3.0, size_bytes=size_bytes, since_s=since_s)

    offer(3_000, T0)
    assert scheduler.pick(now=T0) == 1
    offer(1_800, T0)
    assert scheduler.pick(now=T0) == 1
    offer(3_000, T0 + 0.01)
    assert scheduler.pick(now=T0 + 0.02) is None
    scheduler.validate()


def test_encoding_keeps_the_place_in_the_interval_whatever_size_comes_of_it() -> None:
    scheduler = paper_scheduler()
    scheduler.offer(1, priority=STATE, weight=3.0, size_bytes=1_000, since_s=T0)
    scheduler.offer(2, priority=STATE, weight=3.0, size_bytes=2_000, since_s=T0)
    assert scheduler.pick(now=T0) == 1
    scheduler.withdraw(1, encoding=True)
    assert scheduler.pick(now=T0) == 2
    scheduler.validate()
    scheduler.offer(1, priority=STATE, weight=3.0, size_bytes=1_300, since_s=T0)
    assert scheduler.pick(now=T0 + 0.01) == 1
    scheduler.withdraw(1)
    scheduler.offer(1, priority=STATE, weight=3.0, size_bytes=1_000, since_s=T0)
    assert scheduler.pick(now=T0 + 0.01) == 2
    scheduler.validate()


def test_unfinished_message_stays_marked_into_the_next_interval() -> None:
    scheduler = paper_scheduler()
    scheduler.offer(1, priority=BULK, weight=1.0, size_bytes=6_000, since_s=T0)
    assert scheduler.pick(now=T0) == 1
    scheduler.offer(2, priority=CONTROL, weight=10.0, size_bytes=100, since_s=T0)
    scheduler.offer(1, priority=BULK, weight=1.0, size_bytes=4_800, since_s=T0)
    assert scheduler.pick(now=T0 + 0.06) == 1
    scheduler.withdraw(1)
    assert scheduler.pick(now=T0 + 0.06) == 2


def test_only_stale_bulk_that_does_not_fit_is_reported() -> None:
    scheduler = paper_scheduler()
    for channel_id, (priority, size_bytes, lifespan_s) in enumerate(
        [(BULK, 9_000, 1.0), (STATE, 9_000, 1.0), (BULK, 9_000, 5.0), (BULK, 9_000, None), (BULK, 100, 1.0)]
    ):
        scheduler.offer(
            channel_id, priority=priority, weight=1.0, size_bytes=size_bytes, since_s=T0 - 2.0, stale_after_s=lifespan_s
        )
    assert scheduler.take_stale(T0) == [0]
    assert scheduler.take_stale(T0 + 0.01) == []
    assert scheduler.take_stale(T0 + 0.06) == [0], "still there at the next interval"
    scheduler.validate()


def test_fresh_head_clears_the_stale_report() -> None:
    scheduler = paper_scheduler()
    scheduler.offer(1, priority=BULK, weight=1.0, size_bytes=9_000, since_s=T0 - 2.0, stale_after_s=1.0)
    assert scheduler.pick(now=T0) is None
    scheduler.offer(1, priority=BULK, weight=1.0, size_bytes=9_000, since_s=T0, stale_after_s=1.0)
    assert scheduler.take_stale(T0) == []


def test_closed_window_lets_only_marked_control_within_its_bucket_pass() -> None:
    scheduler = paper_scheduler()
    scheduler.offer(1, priority=BULK, weight=100.0, size_bytes=10, since_s=T0)
    scheduler.offer(2, priority=CONTROL, weight=10.0, size_bytes=1_000, since_s=T0)
    assert scheduler.pick(now=T0) == 1
    assert scheduler.pick(now=T0, window_open=False) == 2
    scheduler.charge(CONTROL, 5_000, now=T0)
    assert scheduler.pick(now=T0, window_open=False) is None
    reasons = []
    for channel_id in (1, 2):
        standing = scheduler.explain(channel_id, T0, window_open=False)
        assert standing is not None
        reasons.append(standing.waits_for)
    assert reasons == [WaitReason.WINDOW, WaitReason.BUCKET]
    deadline = scheduler.next_deadline(now=T0, window_open=False)
    assert deadline is not None
    assert scheduler.pick(now=deadline, window_open=False) == 2
    standing = scheduler.explain(1, deadline)
    assert standing is not None and standing.waits_for is None and standing.rank == 0
    standing = scheduler.explain(2, deadline)
    assert standing is not None and standing.waits_for is WaitReason.OUTRANKED and standing.rank == 1
