"""Class order, floors, the class-0 bucket, ageing and explanations of the scheduler."""

from dataclasses import dataclass, field
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sern_core.stream.pending import FEW, PendingClass
from sern_core.stream.scheduler import BURST_BYTES, CREDIT_QUANTA, DEFAULT_QUANTUM_BYTES, Scheduler, WaitReason
from sern_core.vocabulary.errors import UsageError
from sern_core.vocabulary.params import SchedulerParams
from sern_core.vocabulary.types import CLASSES, Ordering, PriorityClass
from tests.exploring import cases

CONTROL, STATE, BULK = CLASSES
T0 = 1000.0  # monotonic clocks do not start at zero
FRAGMENT_BYTES = 1200


def offer(
    scheduler: Scheduler, channel_id: int, priority: PriorityClass, size_bytes: float, since_s: float = T0
) -> None:
    scheduler.offer(channel_id, priority=priority, weight=1.0, size_bytes=size_bytes, since_s=since_s)


@dataclass
class Traffic:
    """Saturated topics on a link of constant rate: who gets how many bytes, fragment by fragment."""

    scheduler: Scheduler
    rate_bps: float
    fragment_bytes: dict[PriorityClass, int] = field(default_factory=dict)
    now: float = T0
    sent_bytes: dict[int, int] = field(default_factory=dict)
    order: list[int] = field(default_factory=list)

    def run(self, fragments: int, message_bytes: dict[int, int], classes: dict[int, PriorityClass]) -> None:
        left = dict(message_bytes)
        since = dict.fromkeys(message_bytes, self.now)
        for channel_id, size in left.items():
            offer(self.scheduler, channel_id, classes[channel_id], size, since[channel_id])
        for _ in range(fragments):
            picked = self.scheduler.pick(now=self.now)
            assert picked is not None, "work conservation: something is pending and the window is open"
            channel_id = picked
            nbytes = min(left[channel_id], self.fragment_bytes.get(classes[channel_id], FRAGMENT_BYTES))
            self.scheduler.charge(classes[channel_id], nbytes, now=self.now)
            self.now += nbytes * 8.0 / self.rate_bps
            left[channel_id] -= nbytes
            if left[channel_id] == 0:
                left[channel_id], since[channel_id] = message_bytes[channel_id], self.now
            offer(self.scheduler, channel_id, classes[channel_id], left[channel_id], since[channel_id])
            self.sent_bytes[channel_id] = self.sent_bytes.get(channel_id, 0) + nbytes
            self.order.append(channel_id)
        self.scheduler.validate()

    def share(self, channel_id: int) -> float:
        return self.sent_bytes.get(channel_id, 0) / sum(self.sent_bytes.values())


def test_nothing_pending() -> None:
    scheduler = Scheduler(SchedulerParams(), now=T0)
    assert scheduler.pick(now=T0) is None
    assert scheduler.next_deadline(now=T0, window_open=True) is None
    assert scheduler.explain(1, T0) is None
    assert scheduler.take_stale(T0) == []
    scheduler.withdraw(1)
    scheduler.withdraw(1, encoding=True)
    scheduler.validate()


def test_more_urgent_class_goes_first_whatever_its_size() -> None:
    scheduler = Scheduler(SchedulerParams(), now=T0)
    offer(scheduler, 3, BULK, 10)
    offer(scheduler, 2, STATE, 4_000)
    offer(scheduler, 1, CONTROL, 20_000)
    served = []
    while (channel_id := scheduler.pick(now=T0)) is not None:
        served.append(channel_id)
        scheduler.withdraw(channel_id)
    assert served == [1, 2, 3]
    scheduler.validate()


def test_newcomer_preempts_a_larger_message_at_its_next_fragment() -> None:
    scheduler = Scheduler(SchedulerParams(), now=T0)
    offer(scheduler, 7, STATE, 50_000)
    assert scheduler.pick(now=T0) == 7
    scheduler.charge(STATE, FRAGMENT_BYTES, now=T0)
    offer(scheduler, 7, STATE, 50_000 - FRAGMENT_BYTES)
    offer(scheduler, 8, STATE, 300, since_s=T0 + 0.001)
    assert scheduler.pick(now=T0 + 0.001) == 8


def test_a_slot_may_change_class() -> None:
    scheduler = Scheduler(SchedulerParams(), now=T0)
    offer(scheduler, 1, BULK, 100)
    offer(scheduler, 2, STATE, 100_000)
    offer(scheduler, 1, CONTROL, 100)
    assert scheduler.pick(now=T0) == 1
    assert [scheduler.pending(priority) for priority in CLASSES] == [1, 1, 0]
    scheduler.validate()


def test_message_being_encoded_is_passed_over() -> None:
    scheduler = Scheduler(SchedulerParams(), now=T0)
    offer(scheduler, 1, CONTROL, 100)
    offer(scheduler, 2, BULK, 100)
    scheduler.withdraw(1, encoding=True)
    assert scheduler.pick(now=T0) == 2
    standing = scheduler.explain(1, T0)
    assert standing is not None and standing.waits_for is WaitReason.ENCODING
    offer(scheduler, 1, CONTROL, 60)
    assert scheduler.pick(now=T0) == 1
    scheduler.validate()


@pytest.mark.parametrize("floor", [0.05, 0.1, 0.2])
def test_lower_classes_get_their_floor_beside_saturating_control(floor: float) -> None:
    scheduler = Scheduler(SchedulerParams(floor=floor, class0_share=1.0), now=T0)
    traffic = Traffic(scheduler, rate_bps=4e6)
    traffic.run(40_000, {1: 2_000, 2: 30_000, 3: 200_000}, {1: CONTROL, 2: STATE, 3: BULK})
    assert traffic.share(2) == pytest.approx(floor, rel=0.01)
    assert traffic.share(3) == pytest.approx(floor, rel=0.01)


def test_bulk_gets_its_floor_beside_saturating_state() -> None:
    traffic = Traffic(Scheduler(SchedulerParams(), now=T0), rate_bps=4e6)
    traffic.run(20_000, {2: 900, 3: 200_000}, {2: STATE, 3: BULK})
    assert traffic.share(3) == pytest.approx(0.1, rel=0.01)
    longest_wait = max(
        second - first
        for first, second in zip(
            (i for i, channel_id in enumerate(traffic.order) if channel_id == 3),
            [i for i, channel_id in enumerate(traffic.order) if channel_id == 3][1:],
            strict=False,
        )
    )
    assert longest_wait <= 16, "the floor comes in single fragments, not in bursts"


def test_floor_holds_with_fragments_larger_than_the_quantum() -> None:
    scheduler = Scheduler(SchedulerParams(class0_share=1.0), now=T0)
    traffic = Traffic(scheduler, rate_bps=20e6, fragment_bytes={CONTROL: 1200, STATE: 8192, BULK: 8192})
    traffic.run(40_000, {1: 1_200, 2: 8_192, 3: 80_000}, {1: CONTROL, 2: STATE, 3: BULK})
    assert traffic.share(2) == pytest.approx(0.1, rel=0.02)
    assert traffic.share(3) == pytest.approx(0.1, rel=0.02)


def test_no_floor_means_strict_classes() -> None:
    traffic = Traffic(Scheduler(SchedulerParams(floor=0.0, class0_share=1.0), now=T0), rate_bps=4e6)
    traffic.run(2_000, {1: 2_000, 2: 100, 3: 100}, {1: CONTROL, 2: STATE, 3: BULK})
    assert set(traffic.order[4:]) == {1}


def test_a_debt_outlives_the_backlog_that_made_it() -> None:
    """Single large messages of a lower class do not get more than the floor by emptying their class each time."""
    scheduler = Scheduler(SchedulerParams(class0_share=1.0), now=T0)
    offer(scheduler, 1, CONTROL, 1200)
    sent = {CONTROL: 0, BULK: 0}
    for i in range(20_000):
        if i % 5 == 0:
            offer(scheduler, 3, BULK, 8192)
        priority, nbytes = (BULK, 8192) if scheduler.pick(now=T0) == 3 else (CONTROL, 1200)
        scheduler.charge(priority, nbytes, now=T0)
        sent[priority] += nbytes
        if priority is BULK:
            scheduler.withdraw(3)
    assert sent[BULK] / sum(sent.values()) == pytest.approx(0.1, rel=0.1)
    scheduler.validate()


@pytest.mark.parametrize("lower", [STATE, BULK])
def test_credit_survives_encoding_and_ends_with_the_backlog(lower: PriorityClass) -> None:
    scheduler = Scheduler(SchedulerParams(class0_share=1.0), now=T0)
    for encoding, expected in ((True, 3), (False, 1)):
        offer(scheduler, 1, CONTROL, 1e6)
        offer(scheduler, 3, lower, 1e6)
        scheduler.charge(CONTROL, 12_000, now=T0)
        assert scheduler.pick(now=T0) == 3
        scheduler.withdraw(3, encoding=encoding)
        assert scheduler.pick(now=T0) == 1
        offer(scheduler, 3, lower, 1e6)
        assert scheduler.pick(now=T0) == expected
        scheduler.withdraw(3)
        scheduler.withdraw(1)
        scheduler.validate()


@pytest.mark.parametrize("lower", [STATE, BULK])
def test_a_class_earns_credit_while_its_message_is_encoded(lower: PriorityClass) -> None:
    scheduler = Scheduler(SchedulerParams(class0_share=1.0), now=T0)
    offer(scheduler, 1, CONTROL, 1e6)
    offer(scheduler, 3, lower, 1e6)
    scheduler.withdraw(3, encoding=True)
    scheduler.charge(CONTROL, 12_000, now=T0)
    offer(scheduler, 3, lower, 1e6)
    assert scheduler.pick(now=T0) == 3


@pytest.mark.parametrize("lower", [STATE, BULK])
def test_credit_is_lost_when_an_encoding_is_given_up(lower: PriorityClass) -> None:
    scheduler = Scheduler(SchedulerParams(class0_share=1.0), now=T0)
    offer(scheduler, 1, CONTROL, 1e6)
    offer(scheduler, 3, lower, 1e6)
    scheduler.charge(CONTROL, 12_000, now=T0)
    scheduler.withdraw(3, encoding=True)
    scheduler.withdraw(3)
    scheduler.validate()
    offer(scheduler, 3, lower, 1e6)
    assert scheduler.pick(now=T0) == 1


def test_saved_credit_is_bounded() -> None:
    """A window that stays closed for long must not give the lower classes a long run ahead of class 0."""
    scheduler = Scheduler(SchedulerParams(class0_share=1.0), now=T0)
    offer(scheduler, 1, CONTROL, 1e9)
    offer(scheduler, 3, BULK, 1e9)
    for _ in range(1000):
        assert scheduler.pick(now=T0, window_open=False) == 1
        scheduler.charge(CONTROL, FRAGMENT_BYTES, now=T0)
    run = 0
    while scheduler.pick(now=T0) == 3:
        scheduler.charge(BULK, DEFAULT_QUANTUM_BYTES, now=T0)
        run += 1
    assert 1 <= run <= CREDIT_QUANTA + 1
    scheduler.validate()


@pytest.mark.parametrize("rate_bps", [256e3, 4e6, 50e6])
def test_class_0_is_capped_while_others_wait(rate_bps: float) -> None:
    scheduler = Scheduler(SchedulerParams(), now=T0)
    scheduler.set_rate(rate_bps, now=T0)
    traffic = Traffic(scheduler, rate_bps)
    traffic.run(20_000, {1: 20_000, 2: 100_000, 3: 100_000}, {1: CONTROL, 2: STATE, 3: BULK})
    assert traffic.share(1) == pytest.approx(0.5, abs=0.01)
    assert traffic.share(3) == pytest.approx(0.1, rel=0.02)


def test_class_0_takes_a_whole_link_that_nobody_else_wants() -> None:
    scheduler = Scheduler(SchedulerParams(), now=T0)
    scheduler.set_rate(1e6, now=T0)
    traffic = Traffic(scheduler, 1e6)
    traffic.run(2_000, {1: 20_000}, {1: CONTROL})
    assert traffic.share(1) == 1.0
    tokens = scheduler.class0_tokens_bytes(now=traffic.now)
    assert -max(BURST_BYTES, 0.05 * 0.5 * 1e6 / 8) <= tokens < 0, "the debt is bounded"


def test_class_0_within_its_bucket_passes_a_closed_window() -> None:
    scheduler = Scheduler(SchedulerParams(), now=T0)
    scheduler.set_rate(1e6, now=T0)
    offer(scheduler, 1, CONTROL, 1e6)
    offer(scheduler, 3, BULK, 1e6)
    now = T0
    sent = 0
    while scheduler.pick(now=now, window_open=False) == 1:
        scheduler.charge(CONTROL, 500, now=now)
        sent += 500
    assert scheduler.pick(now=now, window_open=False) is None
    assert BURST_BYTES <= sent <= BURST_BYTES + 500
    deadline = scheduler.next_deadline(now=now, window_open=False)
    assert deadline is not None and deadline > now
    assert scheduler.pick(now=deadline - 1e-6, window_open=False) is None
    assert scheduler.pick(now=deadline, window_open=False) == 1
    assert scheduler.next_deadline(now=deadline, window_open=False) is None
    assert scheduler.next_deadline(now=now, window_open=True) is None, "an open window serves bulk at once"


def test_lower_classes_never_pass_a_closed_window() -> None:
    scheduler = Scheduler(SchedulerParams(), now=T0)
    offer(scheduler, 2, STATE, 100)
    offer(scheduler, 3, BULK, 100)
    assert scheduler.pick(now=T0, window_open=False) is None
    assert scheduler.next_deadline(now=T0, window_open=False) is None


@settings(max_examples=cases(60))
@given(
    rates=st.lists(st.none() | st.floats(0, 1e8), min_size=1, max_size=5),
    steps=st.lists(st.tuples(st.integers(0, 5000), st.floats(0, 0.1)), min_size=1, max_size=40),
)
def test_bucket_against_a_plain_token_count(rates: list[float | None], steps: list[tuple[int, float]]) -> None:
    scheduler = Scheduler(SchedulerParams(), now=T0)
    now = T0
    offer(scheduler, 1, CONTROL, 1e9)
    for rate_bps in rates:
        known = scheduler.class0_tokens_bytes(now=now) != float("inf")
        before = scheduler.class0_tokens_bytes(now=now)
        scheduler.set_rate(rate_bps, now=now)
        if rate_bps is None:
            assert scheduler.class0_tokens_bytes(now=now) == float("inf")
            continue
        rate = max(rate_bps * 0.5 / 8, 1.0)
        burst = max(BURST_BYTES, 0.05 * rate)
        tokens = min(max(before, -burst), burst) if known else burst
        for nbytes, wait_s in steps:
            tokens = max(tokens - nbytes, -burst)
            scheduler.charge(CONTROL, nbytes, now=now)
            now += wait_s
            tokens = min(tokens + rate * wait_s, burst)
            assert scheduler.class0_tokens_bytes(now=now) == pytest.approx(tokens, rel=1e-6, abs=1e-6 * rate + 1e-3)
            if abs(tokens) > 1e-6 * rate + 1e-3:
                assert (scheduler.pick(now=now, window_open=False) == 1) == (tokens > 0)


def test_a_stalled_link_still_names_the_best_of_a_class() -> None:
    scheduler = Scheduler(SchedulerParams(), now=T0)
    scheduler.set_rate(0.0, now=T0)
    offer(scheduler, 1, CONTROL, 1e6)
    scheduler.charge(CONTROL, 5_000, now=T0)
    assert scheduler.pick(now=T0 + 1, window_open=False) is None
    assert scheduler.best(CONTROL, now=T0 + 1) == 1
    assert scheduler.best(BULK, now=T0 + 1) is None


def test_coalesced_topic_that_ages_since_it_was_last_sent_is_not_starved() -> None:
    """Each new sample replaces the head of the large topic; its age goes on counting, so that its turn comes."""

    def first_service_s(*, by_last_sent: bool) -> float | None:
        scheduler = Scheduler(SchedulerParams(eta=1.0), now=T0)
        for step in range(4_000):
            now = T0 + step * 0.002
            offer(scheduler, 1, BULK, 1_000, since_s=now)  # always another small one, newly born
            offer(scheduler, 2, BULK, 4_000, since_s=T0 if by_last_sent else now)  # sampled again each time
            channel_id = scheduler.pick(now=now)
            if channel_id == 2:
                return now - T0
        return None

    assert first_service_s(by_last_sent=False) is None
    served_s = first_service_s(by_last_sent=True)
    # It overtakes when 1 + η·a is the ratio of the sizes, ε added to each.
    assert served_s == pytest.approx((4_064 / 1_064 - 1.0), abs=0.004)


def test_no_topic_starves_within_its_class() -> None:
    """Ageing is clipped, yet every topic within the ratio 1 + η·a_max of the strongest is served."""
    random = Random(5)
    sizes = {channel_id: random.randint(100, 1_000) for channel_id in range(60)}
    traffic = Traffic(Scheduler(SchedulerParams(a_max_s=30.0), now=T0), rate_bps=1e6)
    traffic.run(20_000, sizes, dict.fromkeys(sizes, BULK))
    assert set(traffic.order[-5_000:]) == set(sizes)


@settings(max_examples=cases(60))
@given(
    sizes=st.lists(st.integers(1, 10_000), min_size=1, max_size=40),
    weights=st.lists(st.floats(0.1, 10.0), min_size=40, max_size=40),
    waited_s=st.floats(0, 100),
)
def test_eta_zero_is_smiths_rule(sizes: list[int], weights: list[float], waited_s: float) -> None:
    params = SchedulerParams(eta=0.0)
    scheduler = Scheduler(params, now=T0)
    for channel_id, (size, weight) in enumerate(zip(sizes, weights, strict=False)):
        scheduler.offer(channel_id, priority=BULK, weight=weight, size_bytes=size, since_s=T0 - channel_id)
    ratios = [w / (s + params.epsilon_bytes) for s, w in zip(sizes, weights, strict=False)]
    served = []
    while (id_or_none := scheduler.pick(now=T0 + waited_s)) is not None:
        served.append(ratios[id_or_none])
        scheduler.withdraw(id_or_none)
    assert served == pytest.approx(sorted(ratios, reverse=True), rel=1e-6)


@pytest.mark.parametrize("count", [2, FEW, 3 * FEW])
def test_equals_are_served_oldest_first_without_ageing(count: int) -> None:
    """Twenty robots send the same type: with η = 0 all scores are equal, and none may starve the others."""
    scheduler = Scheduler(SchedulerParams(eta=0.0), now=T0)
    for channel_id in range(count):
        offer(scheduler, channel_id, STATE, 300, since_s=T0 + channel_id * 1e-3)
    served = []
    for step in range(3 * count):
        now = T0 + 1.0 + step * 1e-3
        id_or_none = scheduler.pick(now=now)
        assert id_or_none is not None
        served.append(id_or_none)
        offer(scheduler, id_or_none, STATE, 300, since_s=now)
    assert served == list(range(count)) * 3


@settings(max_examples=cases(60))
@given(
    messages=st.lists(
        st.tuples(st.sampled_from(CLASSES), st.integers(100, 2_000), st.floats(0, 40)), min_size=1, max_size=40
    ),
    eta=st.floats(0, 5),
    a_max_s=st.floats(0, 30),
)
def test_class_order_is_the_plain_formula_when_the_weights_are_far_enough_apart(
    messages: list[tuple[PriorityClass, int, float]], eta: float, a_max_s: float
) -> None:
    """(class, −P) sorts as P does if κ_i/κ_{i+1} > (1 + η·a_max)(s_max + ε)/(s_min + ε)."""
    params = SchedulerParams(eta=eta, a_max_s=a_max_s, floor=0.0)
    epsilon = params.epsilon_bytes
    ratio = 1.01 * (1.0 + eta * a_max_s) * (2_000 + epsilon) / (100 + epsilon)
    scheduler = Scheduler(params, now=T0)
    scores = []
    for channel_id, (priority, size, age_s) in enumerate(messages):
        weight = ratio ** (BULK - priority)
        scheduler.offer(channel_id, priority=priority, weight=weight, size_bytes=size, since_s=T0 - age_s)
        scores.append(weight * (1.0 + eta * min(age_s, a_max_s)) / (size + epsilon))
    served = []
    while (id_or_none := scheduler.pick(now=T0)) is not None:
        served.append(scores[id_or_none])
        scheduler.withdraw(id_or_none)
    assert served == pytest.approx(sorted(scores, reverse=True), rel=1e-6)


def test_class_order_differs_from_the_plain_formula_with_default_weights() -> None:
    """What the reading repairs: a 20 kB plan against 100-byte bulk samples, κ = 10 against 1."""
    scheduler = Scheduler(SchedulerParams(), now=T0)
    scheduler.offer(1, priority=CONTROL, weight=10.0, size_bytes=20_000, since_s=T0)
    scheduler.offer(2, priority=BULK, weight=1.0, size_bytes=100, since_s=T0)
    plan, sample = scheduler.explain(1, T0), scheduler.explain(2, T0)
    assert plan is not None and sample is not None
    assert plan.score < sample.score
    assert (plan.rank, sample.rank) == (0, 1)
    assert scheduler.pick(now=T0) == 1


def test_explanations_name_the_reason() -> None:
    scheduler = Scheduler(SchedulerParams(), now=T0)
    scheduler.set_rate(1e6, now=T0)

    def reason(channel_id: int, *, window_open: bool = True) -> WaitReason | None:
        standing = scheduler.explain(channel_id, T0, window_open=window_open)
        assert standing is not None
        return standing.waits_for

    offer(scheduler, 1, CONTROL, 1_000)
    offer(scheduler, 2, CONTROL, 2_000, since_s=T0 - 0.5)
    offer(scheduler, 3, BULK, 500, since_s=T0 - 20.0)
    assert [reason(channel_id) for channel_id in (1, 2, 3)] == [None, WaitReason.OUTRANKED, WaitReason.CLASS]
    assert reason(3, window_open=False) is WaitReason.WINDOW
    standing = scheduler.explain(3, T0)
    assert standing is not None
    assert (standing.channel_id, standing.priority, standing.weight) == (3, BULK, 1.0)
    assert (standing.age_s, standing.size_bytes, standing.rank) == (20.0, 500, 2)
    assert standing.score == pytest.approx(11.0 / 564)
    offer(scheduler, 4, STATE, 500)
    for _ in range(3):
        scheduler.charge(STATE, 4_200, now=T0)  # more than its credit: only bulk has a floor to use
    assert [reason(channel_id) for channel_id in (1, 3, 4)] == [WaitReason.FLOOR, None, WaitReason.FLOOR]
    scheduler.charge(CONTROL, 10_000, now=T0)
    scheduler.charge(BULK, 10_000, now=T0)
    assert [reason(channel_id) for channel_id in (1, 3)] == [WaitReason.BUCKET, WaitReason.CLASS]
    assert reason(1, window_open=False) is WaitReason.BUCKET


@pytest.mark.parametrize(
    ("weight", "size_bytes", "since_s"),
    [
        (0.0, 100.0, T0),
        (-1.0, 100.0, T0),
        (float("nan"), 100.0, T0),
        (float("inf"), 100.0, T0),
        (1.0, -64.0, T0),
        (1.0, float("nan"), T0),
        (1.0, float("inf"), T0),
        (1.0, 100.0, float("nan")),
        (1.0, 100.0, float("-inf")),
    ],
)
def test_offers_that_cannot_be_ranked_are_refused(weight: float, size_bytes: float, since_s: float) -> None:
    scheduler = Scheduler(SchedulerParams(), now=T0)
    with pytest.raises(UsageError, match=r"Scheduler\.offer: channel 9"):
        scheduler.offer(9, priority=BULK, weight=weight, size_bytes=size_bytes, since_s=since_s)
    assert scheduler.pick(now=T0) is None
    scheduler.validate()


@pytest.mark.parametrize("rate_bps", [-1.0, float("nan"), float("inf")])
def test_impossible_rates_are_refused(rate_bps: float) -> None:
    with pytest.raises(UsageError, match="rate_bps"):
        Scheduler(SchedulerParams(), now=T0).set_rate(rate_bps, now=T0)


def test_impossible_quantum_is_refused() -> None:
    with pytest.raises(UsageError, match="quantum_bytes"):
        Scheduler(SchedulerParams(), now=T0, quantum_bytes=0)


def test_clip_times_do_not_pile_up() -> None:
    """A day of messages must not leave a day of heap entries."""
    table = PendingClass(eta=1.0, a_max_s=1e9, origin_s=0.0)
    for step in range(5_000):
        table.put(step % 100, 0.01, float(step))
    for channel_id in range(0, 100, 3):
        table.remove(channel_id)
    table.validate()
    assert table._lines is not None
    assert len(table._lines._clips) <= 64 + 4 * 100


# In the background


def in_background(scheduler: Scheduler, channel_id: int = 9) -> None:
    scheduler.offer(channel_id, priority=BULK, weight=1e6, size_bytes=10.0, since_s=T0 - 100.0, background=True)


@pytest.mark.parametrize("priority", CLASSES)
def test_what_is_in_the_background_waits_for_every_class(priority: PriorityClass) -> None:
    """However light, old and weighty it is, and however heavy the other."""
    scheduler = Scheduler(SchedulerParams(), now=T0)
    in_background(scheduler)
    assert scheduler.pick(now=T0) == scheduler.pick_rest(now=T0) == 9
    offer(scheduler, 1, priority, 1e6)
    assert scheduler.pick(now=T0) == 1
    assert scheduler.waits_for(9, T0) == (WaitReason.CLASS, 1)
    scheduler.withdraw(1)
    assert scheduler.pick(now=T0) == 9
    assert scheduler.pick(now=T0, window_open=False) is None
    assert scheduler.waits_for(9, T0, window_open=False) == (WaitReason.WINDOW, None)
    scheduler.validate()


def test_what_is_in_the_background_has_no_floor() -> None:
    """Class state has more than the link carries: class bulk gets its tenth, the background nothing."""
    scheduler = Scheduler(SchedulerParams(floor=0.1), now=T0)
    in_background(scheduler)
    traffic = Traffic(scheduler, 1e6)
    traffic.run(2000, {1: 1200, 2: 1200}, {1: STATE, 2: BULK})
    assert 9 not in traffic.order
    assert traffic.share(2) == pytest.approx(0.1, abs=0.02)


def test_what_the_background_sends_costs_and_earns_nobody_anything() -> None:
    scheduler = Scheduler(SchedulerParams(class0_share=0.5, floor=0.1), now=T0)
    scheduler.set_rate(1e6, now=T0)
    in_background(scheduler)
    before = scheduler.class0_tokens_bytes(now=T0)
    for _ in range(100):
        scheduler.charge(BULK, FRAGMENT_BYTES, now=T0, background=True)
    assert scheduler.class0_tokens_bytes(now=T0) == before
    offer(scheduler, 1, STATE, 1200)
    offer(scheduler, 2, BULK, 1200)
    assert scheduler.pick(now=T0) == 1
    scheduler.validate()


def test_the_background_waits_while_it_is_encoded_and_under_ordering_paper() -> None:
    scheduler = Scheduler(SchedulerParams(), now=T0)
    in_background(scheduler)
    scheduler.withdraw(9, encoding=True)
    scheduler.validate()
    assert scheduler.pick(now=T0) is None
    in_background(scheduler)
    scheduler.validate()
    assert scheduler.pick(now=T0) == 9
    paper = Scheduler(SchedulerParams(ordering=Ordering.PAPER), now=T0)
    in_background(paper)
    assert paper.pick(now=T0) == 9
    offer(paper, 1, BULK, 1200)
    assert paper.pick(now=T0 + 1.0) == 1
    paper.withdraw(1)
    assert paper.pick(now=T0 + 1.0) == 9
    paper.validate()
