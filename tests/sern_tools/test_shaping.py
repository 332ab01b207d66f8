"""The proxy's arithmetic in virtual time: rate, queue, delay, blackout."""

import math
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sern_sim.models import Flap, Jitter, LinkModel, RateStep, Window
from sern_tools.shaping import SLOT_BYTES, UNLIMITED_BPS, RateSchedule, Shaper
from tests.exploring import cases


def shaper(model: LinkModel, *, origin_s: float = 0.0) -> Shaper:
    return Shaper(model, rng=Random(1), origin_s=origin_s)


def test_a_schedule_follows_the_model() -> None:
    model = LinkModel(rate_bps=4e6, rate_steps=(RateStep(12, 1e6), RateStep(24, 4e6)), blackouts=(Window(32, 42),))
    schedule = RateSchedule.of(model)
    assert list(schedule.steps) == [(0.0, 4e6), (12, 1e6), (24, 4e6), (32, 0.0), (42, 4e6)]
    assert schedule.blackouts(60) == [(32, 42)]
    assert schedule.blackouts(35) == [(32, 35)]
    assert schedule.carried_bytes(0, 60) == model.capacity_bits(0, 60) / 8


def test_a_model_without_a_rate_is_fast_and_a_flapping_one_is_unrolled() -> None:
    assert list(RateSchedule.of(LinkModel()).steps) == [(0.0, UNLIMITED_BPS)]
    schedule = RateSchedule.of(LinkModel(rate_bps=1e6, flap=Flap(1, 1)), until_s=4)
    assert list(schedule.steps) == [(0.0, 1e6), (1, 0.0), (2, 1e6), (3, 0.0)]


@pytest.mark.parametrize("steps", [(), ((1.0, 5.0),), ((0.0, 1.0), (0.0, 2.0)), ((0.0, -1.0),), ((0.0, math.inf),)])
def test_a_schedule_that_makes_no_sense_is_refused(steps: tuple[tuple[float, float], ...]) -> None:
    with pytest.raises(ValueError):
        RateSchedule(steps)


def test_a_packet_that_spans_a_step_and_a_blackout_takes_both_into_account() -> None:
    schedule = RateSchedule(((0.0, 8000.0), (1.0, 0.0), (3.0, 4000.0)))
    assert schedule.finish(0.5, 500) == 1.0
    assert schedule.finish(0.5, 1000) == pytest.approx(4.0)  # 500 bytes, 2 s of nothing, 500 bytes at half the rate
    assert schedule.advance(0.5, 1.0) == pytest.approx(3.5)
    assert schedule.advance(-5.0, 1.0) == -4.0
    assert schedule.carried_bytes(0.5, 4.0) == pytest.approx(1000)


def test_a_link_that_never_comes_back() -> None:
    schedule = RateSchedule(((0.0, 8000.0), (1.0, 0.0)))
    assert math.isinf(schedule.finish(0.5, 1000))
    assert math.isinf(schedule.advance(2.0, 0.1))
    link = shaper(LinkModel(rate_bps=8000.0, blackouts=(Window(1, 1e9),)))
    assert math.isinf(link.admit(SLOT_BYTES, 0.5))
    assert math.isinf(link.admit(1, 0.6))


def test_an_idle_packet_arrives_after_its_serialisation_and_the_delay() -> None:
    link = shaper(LinkModel(rate_bps=4e6, delay_s=0.025, overhead_bytes=28))
    assert link.admit(100, 10.0) == pytest.approx(10.0 + 128 * 8 / 4e6 + 0.025)


def test_the_queue_holds_its_packets_and_empties_at_the_rate() -> None:
    link = shaper(LinkModel(rate_bps=1.2e6, queue_packets=3))
    for _ in range(3):
        link.admit(1500, 0.0)  # 10 ms each
    assert link.free_slots(0.0) == 0
    assert link.when_free(1, 0.0) == pytest.approx(0.010)
    assert link.when_free(2, 0.0) == pytest.approx(0.020)
    assert link.free_slots(0.015) == 1
    assert link.when_free(1, 0.015) == 0.015


def test_bytes_on_their_way_freeze_in_a_blackout_and_go_on_after_it() -> None:
    link = shaper(LinkModel(rate_bps=8e6, delay_s=0.1, blackouts=(Window(1, 11),)), origin_s=100.0)
    assert link.admit(1000, 100.95) == pytest.approx(111.051)
    assert link.after(0.2, 100.9) == pytest.approx(111.1)


@pytest.mark.parametrize("jitter", list(Jitter))
def test_jitter_keeps_the_order_and_is_seeded(jitter: Jitter) -> None:
    model = LinkModel(rate_bps=1e9, delay_s=0.03, jitter_s=0.01, jitter=jitter)

    def arrivals() -> list[float]:
        link = shaper(model)
        return [link.admit(100, i * 0.1) for i in range(500)]

    times = arrivals()
    assert times == sorted(times) == arrivals()
    delays = [t - i * 0.1 for i, t in enumerate(times)]
    assert 0.029 < sum(delays) / len(delays) < 0.031
    assert max(delays) - min(delays) > 0.015


@settings(max_examples=cases(100))
@given(
    gaps=st.lists(st.tuples(st.floats(0.001, 3.0), st.floats(0.0, 1e6)), min_size=1, max_size=6),
    sizes=st.lists(st.integers(1, 1500), min_size=1, max_size=50),
    start=st.floats(-2.0, 10.0),
)
def test_packets_back_to_back_leave_exactly_at_the_capacity(
    gaps: list[tuple[float, float]], sizes: list[int], start: float
) -> None:
    steps, at = [], 0.0
    for gap, rate in gaps:
        steps.append((at, rate))
        at += gap
    steps.append((at, 1e5))
    schedule = RateSchedule(tuple(steps))
    t = start
    for size in sizes:
        later = schedule.finish(t, size)
        assert later >= t
        t = later
    assert schedule.carried_bytes(start, t) == pytest.approx(sum(sizes), rel=1e-6)
