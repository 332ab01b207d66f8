"""Accounting: the balance holds at every instant, sums are sums, and quantiles lie in the right bin."""

import json
import math
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

from sern_core.counters import (
    DROP_KEYS,
    LATENCY_EDGES_S,
    OTHER,
    HopCounters,
    LatencyHistogram,
    TopicCounters,
    merged,
)
from sern_core.errors import UsageError
from sern_core.types import CLASSES, DropReason, PriorityClass, TopicName

PURE = settings(deadline=None, derandomize=True, database=None)
ODOM = TopicName("/odom")
REASONS = st.sampled_from(DropReason)
SIZES = st.integers(0, 10**6)


def test_every_drop_counter_exists_from_the_start() -> None:
    row = HopCounters().topic(ODOM, PriorityClass.CONTROL)
    assert row.to_json()["dropped"] == {reason.value: 0 for reason in DropReason if reason is not DropReason.REFUSED}
    assert set(row.dropped.values()) == set(row.dropped_bytes.values()) == {0}
    row.validate()


def test_one_message_through_a_hop() -> None:
    row = TopicCounters(ODOM, PriorityClass.CONTROL)
    row.queue(100)
    row.send(100)
    row.requeue(100)
    row.send(100)
    row.wire_bytes += 320
    row.ack(100)
    assert (row.offered, row.sent, row.delivered, row.in_queue, row.in_flight) == (1, 2, 1, 0, 0)
    assert (row.offered_bytes, row.sent_bytes, row.delivered_bytes, row.wire_bytes) == (100, 200, 100, 320)
    row.validate()


@pytest.mark.parametrize("call", ["drop_new", "drop_queued", "drop_in_flight"])
def test_a_refusal_is_counted_as_such_wherever_it_happens(call: str) -> None:
    row = TopicCounters(ODOM, PriorityClass.STATE)
    if call != "drop_new":
        row.queue(5)
    if call == "drop_in_flight":
        row.send(5)
    getattr(row, call)(DropReason.REFUSED, 5)
    assert (row.refused, row.refused_bytes, row.offered) == (1, 5, 1)
    row.validate()


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("offered", "1 messages, 0 bytes"),
        ("offered_bytes", "0 messages, 1 bytes"),
        ("in_flight", "-1 messages"),
        ("delivered_bytes", "-1 bytes"),
        ("replayed", "more replays"),
    ],
)
def test_a_wrong_count_is_found(name: str, words: str) -> None:
    hop = HopCounters()
    row = hop.topic(ODOM, PriorityClass.BULK)
    setattr(row, name, 1)
    with pytest.raises(AssertionError, match=f"/odom: .*{words}"):
        hop.validate()


def test_negative_counts_are_found() -> None:
    row = TopicCounters(ODOM, PriorityClass.BULK)
    row.in_queue, row.in_flight = -1, 1
    with pytest.raises(AssertionError, match="negative"):
        row.validate()


def test_rows_are_handed_out_once_and_bounded() -> None:
    hop = HopCounters(max_topics=2)
    row = hop.topic(ODOM, PriorityClass.CONTROL)
    assert hop.topic(ODOM, PriorityClass.CONTROL) is row
    assert hop.topic(ODOM, PriorityClass.BULK) is not row
    beyond = hop.topic(TopicName("/a"), PriorityClass.BULK)
    assert beyond.topic == OTHER and hop.topic(TopicName("/b"), PriorityClass.BULK) is beyond
    assert hop.topic(TopicName("/b"), PriorityClass.STATE) is not beyond
    assert hop.topic(ODOM, PriorityClass.CONTROL) is row


def test_snapshot() -> None:
    hop = HopCounters()
    hop.topic(TopicName("/b"), PriorityClass.CONTROL).deliver_new(10)
    hop.topic(TopicName("/a"), PriorityClass.CONTROL).drop_new(DropReason.RATE_CAP, 20)
    hop.topic(TopicName("/map"), PriorityClass.STATE).queue_replay(30)
    hop.latency[PriorityClass.CONTROL].observe(0.003)
    view = json.loads(json.dumps(hop.snapshot()))
    assert [row["topic"] for row in view["topics"]] == ["/a", "/b", "/map"]
    assert list(view["classes"]) == ["control", "state", "bulk"]
    control = view["classes"]["control"]
    assert (control["offered"], control["offered_bytes"], control["delivered"]) == (2, 30, 1)
    assert control["dropped"]["rate_cap"] == 1 and control["dropped_bytes"]["rate_cap"] == 20
    assert control["latency"]["count"] == 1 and control["latency"]["p50_s"] is not None
    assert view["classes"]["state"]["replayed"] == 1 and view["classes"]["state"]["in_queue"] == 1
    assert view["classes"]["bulk"]["latency"]["p99_s"] is None
    hop.validate()


class AccountingMachine(RuleBasedStateMachine):
    """Messages moved about at random over a few rows; the model keeps them in lists."""

    @initialize()
    def start(self) -> None:
        self.hop = HopCounters(max_topics=3)
        self.waiting: list[tuple[TopicCounters, int]] = []
        self.flying: list[tuple[TopicCounters, int]] = []
        self.dropped = dict.fromkeys(DropReason, 0)
        self.offered = self.delivered = 0

    @rule(name=st.sampled_from("abcd"), priority=st.sampled_from(CLASSES), size_bytes=SIZES, replay=st.booleans())
    def queue(self, name: str, priority: PriorityClass, size_bytes: int, replay: bool) -> None:
        row = self.hop.topic(TopicName("/" + name), priority)
        (row.queue_replay if replay else row.queue)(size_bytes)
        self.waiting.append((row, size_bytes))
        self.offered += 1

    @rule(name=st.sampled_from("abcd"), priority=st.sampled_from(CLASSES), size_bytes=SIZES, reason=REASONS)
    def drop_new(self, name: str, priority: PriorityClass, size_bytes: int, reason: DropReason) -> None:
        self.hop.topic(TopicName("/" + name), priority).drop_new(reason, size_bytes)
        self.dropped[reason] += 1
        self.offered += 1

    @rule(name=st.sampled_from("abcd"), priority=st.sampled_from(CLASSES), size_bytes=SIZES)
    def deliver_new(self, name: str, priority: PriorityClass, size_bytes: int) -> None:
        self.hop.topic(TopicName("/" + name), priority).deliver_new(size_bytes)
        self.delivered += 1
        self.offered += 1

    @precondition(lambda self: self.waiting)
    @rule(data=st.data(), how=st.sampled_from(["send", "deliver", "drop"]), reason=REASONS)
    def take_waiting(self, data: st.DataObject, how: str, reason: DropReason) -> None:
        row, size_bytes = self.waiting.pop(data.draw(st.integers(0, len(self.waiting) - 1)))
        if how == "send":
            row.send(size_bytes)
            self.flying.append((row, size_bytes))
        elif how == "deliver":
            row.deliver_queued(size_bytes)
            self.delivered += 1
        else:
            row.drop_queued(reason, size_bytes)
            self.dropped[reason] += 1

    @precondition(lambda self: self.flying)
    @rule(data=st.data(), how=st.sampled_from(["ack", "requeue", "drop"]), reason=REASONS)
    def take_flying(self, data: st.DataObject, how: str, reason: DropReason) -> None:
        row, size_bytes = self.flying.pop(data.draw(st.integers(0, len(self.flying) - 1)))
        if how == "ack":
            row.ack(size_bytes)
            self.delivered += 1
        elif how == "requeue":
            row.requeue(size_bytes)
            self.waiting.append((row, size_bytes))
        else:
            row.drop_in_flight(reason, size_bytes)
            self.dropped[reason] += 1

    @invariant()
    def balances(self) -> None:
        self.hop.validate()
        total = TopicCounters(ODOM, PriorityClass.BULK)
        for row in self.hop.by_class().values():
            row.validate()
            total.add(row)
        assert total.imbalance() == (0, 0)
        assert (total.offered, total.delivered) == (self.offered, self.delivered)
        assert (total.in_queue, total.in_flight) == (len(self.waiting), len(self.flying))
        assert total.in_queue_bytes == sum(size_bytes for _, size_bytes in self.waiting)
        assert total.in_flight_bytes == sum(size_bytes for _, size_bytes in self.flying)
        assert total.refused == self.dropped[DropReason.REFUSED]
        assert {reason: total.dropped[reason] for reason in DROP_KEYS} == {
            reason: self.dropped[reason] for reason in DROP_KEYS
        }


def test_the_balance_holds_at_every_instant() -> None:
    run_state_machine_as_test(
        AccountingMachine,
        settings=settings(deadline=None, derandomize=True, database=None, max_examples=60, stateful_step_count=40),
    )


# Histograms ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value_s", "index"), [(-1.0, 0), (0.0, 0), (0.001, 0), (0.0011, 1), (0.03, 5), (30.0, 13), (31.0, 14)]
)
def test_bins(value_s: float, index: int) -> None:
    histogram = LatencyHistogram()
    histogram.observe(value_s)
    assert histogram.counts.index(1) == index and histogram.count == 1
    assert histogram.sum_s == max(0.0, value_s)


def test_quantiles_by_hand() -> None:
    histogram = LatencyHistogram()
    assert histogram.quantile(0.5) is None
    for value_s in (0.012, 0.014, 0.016, 0.020):
        histogram.observe(value_s)
    assert histogram.quantile(0.0) == 0.01
    assert histogram.quantile(0.5) == pytest.approx(0.015)
    assert histogram.quantile(1.0) == 0.02
    histogram.observe(60.0)
    assert histogram.quantile(1.0) == 60.0
    assert histogram.quantile(0.9) == pytest.approx(45.0)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_senseless_values(bad: float) -> None:
    with pytest.raises(UsageError, match="not a latency"):
        LatencyHistogram().observe(bad)
    with pytest.raises(UsageError, match="not between"):
        LatencyHistogram().quantile(bad)


@PURE
@given(
    st.lists(st.floats(0, 60), min_size=1, max_size=60),
    st.lists(st.floats(0, 60), max_size=20),
    st.lists(st.floats(0, 1), min_size=2, max_size=5).map(sorted),
)
def test_quantiles_lie_in_the_bin_of_the_true_ones(values: list[float], more: list[float], qs: list[float]) -> None:
    one, two, both = LatencyHistogram(), LatencyHistogram(), LatencyHistogram()
    for value_s in values:
        one.observe(value_s)
        both.observe(value_s)
    for value_s in more:
        two.observe(value_s)
        both.observe(value_s)
    total = merged([one, two])
    assert total.counts == both.counts and total.max_s == both.max_s
    assert total.sum_s == pytest.approx(both.sum_s)
    ordered = sorted([*values, *more])
    estimates = []
    for q in qs:
        estimate = total.quantile(q)
        assert estimate is not None
        estimates.append(estimate)
        true = ordered[max(0, math.ceil(q * len(ordered)) - 1)]
        low_s = max((edge for edge in (0.0, *LATENCY_EDGES_S) if edge < true), default=0.0)
        high_s = min((edge for edge in LATENCY_EDGES_S if edge >= true), default=total.max_s)
        assert low_s <= estimate <= high_s + 1e-12
    assert all(a <= b + 1e-12 for a, b in pairwise(estimates))
