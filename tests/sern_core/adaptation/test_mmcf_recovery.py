"""After a link returns, what fits on it flows again within seconds, and looking for that harms no thin link."""

from itertools import product
from math import inf
from random import Random

import pytest

from sern_core.adaptation.cost import Ranges
from sern_core.adaptation.model import ClassOutcome, Configuration
from sern_core.adaptation.policy import Mmcf
from sern_core.adaptation.predict import Grid
from sern_core.adaptation.trial import REST_INTERVALS, TIMED_GAIN, TIMED_INTERVALS, TRIED, CapacityTrial
from sern_core.vocabulary.params import LinkParams
from sern_sim.models import LinkModel, RateStep, Window
from tests.adapting import ALL_RAW, BULK, CONTROL, GRID, LEVELS, TEXT, WEIGHTS, Rig, Thinned, rig
from tests.exploring import also
from tests.world import spec

FLOORS = (1.0, 1.0, 1.0)
LOW_BPS = 0.3e6
SETTLED_S, FALLS_S, RETURNS_S, END_S = 5.0, 10.0, 20.0, 28.0
BODY = (TEXT + TEXT)[:100_000]


def flowing(model: LinkModel, *, rate_hz: float, lossless: bool, summaries: bool) -> Rig:
    """Poses at 50 Hz and clouds of 100 kB, which may have a summary of a twentieth."""
    items: list[Thinned] = []
    policy = Mmcf(
        LEVELS if summaries else GRID,
        weights=WEIGHTS,
        ranges=Ranges(),
        floors=FLOORS,
        initial=Configuration(queues=(10, 10, 10), summaries=ALL_RAW if summaries else None),
    )
    r = rig(policy, model, lossless=lossless, link=LinkParams(), summaries=items)
    pose = r.robot.publish("/robot/pose", spec(CONTROL, lifespan_s=1.0))
    cloud = r.robot.publish("/robot/points", spec(BULK, depth=4))
    item = Thinned(r.robot, cloud, cloud, part=0.05)
    if summaries:
        items.append(item)
    r.feed(pose, 50.0, 120)
    r.world.network.after(
        0.05, lambda _now: r.world.network.every(1.0 / rate_hz, lambda now: item.offer(BODY, now), node=r.robot)
    )
    return r


def clouds_in(r: Rig, from_s: float, to_s: float) -> int:
    """Raw clouds that arrived in that time."""
    start_s = r.world.network.start_s
    return sum(from_s <= got.at_s - start_s < to_s for got in r.site.on("/robot/points") if len(got.body) == len(BODY))


def _half(*, odd: bool) -> list[tuple[bool, float, float, bool, bool]]:
    """Of all ways to choose, every second one: any three of the choices are there in all their ways."""
    return [
        (gone, high_bps, rate_hz, lossless, summaries)
        for gone, (high_bps, rate_hz), lossless, summaries in product(
            (False, True), ((4e6, 2.5), (20e6, 5.0)), (False, True), (False, True)
        )
        if (gone + (high_bps > 4e6) + lossless + summaries) % 2 == odd
    ]


@pytest.mark.parametrize(
    ("gone", "high_bps", "rate_hz", "lossless", "summaries"), [*_half(odd=False), *also(*_half(odd=True))]
)
def test_within_five_seconds_of_its_return_a_link_carries_what_it_did(
    *, gone: bool, high_bps: float, rate_hz: float, lossless: bool, summaries: bool
) -> None:
    steps = () if gone else (RateStep(FALLS_S, LOW_BPS), RateStep(RETURNS_S, high_bps))
    blackouts = (Window(FALLS_S, RETURNS_S),) if gone else ()
    model = LinkModel(rate_bps=high_bps, delay_s=0.005, rate_steps=steps, blackouts=blackouts)
    r = flowing(model, rate_hz=rate_hz, lossless=lossless, summaries=summaries)
    r.world.run(END_S)
    before_hz = clouds_in(r, SETTLED_S, FALLS_S) / (FALLS_S - SETTLED_S)
    assert before_hz > 0.95 * rate_hz, "a wide link is not starved: everything fits, so everything goes"
    assert clouds_in(r, FALLS_S + 3.0, RETURNS_S) < 0.3 * before_hz * (RETURNS_S - FALLS_S - 3.0)
    assert clouds_in(r, RETURNS_S + 5.0, END_S) >= 0.8 * before_hz * (END_S - RETURNS_S - 5.0)
    if not gone:
        start_s = r.world.network.start_s
        thin = [got for got in r.site.on("/robot/pose") if FALLS_S + 5.0 < got.at_s - start_s < RETURNS_S]
        in_time = sum(got.age_s < 0.3 for got in thin)
        assert in_time >= 0.9 * 50.0 * (RETURNS_S - FALLS_S - 5.0), "commands go on"
    r.world.validate()


@pytest.mark.parametrize(
    ("falls_s", "thin_s", "thin_bps"),
    [(2.0, 5.5, 0.3e6), (4.2, 9.4, 0.2e6), (4.1, 15.9, 0.2e6), *also((2.3, 12.1, 0.2e6), (4.5, 22.6, 0.3e6))],
)
def test_what_summaries_alone_fill_is_found_to_be_wide_again(falls_s: float, thin_s: float, thin_bps: float) -> None:
    """Nothing but a cloud, over a stream: the packets of its summary are all that there is to see the link by, and they
    are smaller than those of the clouds, which had a queue of seconds."""
    high_bps, rate_hz = 20e6, 10.0
    steps = (RateStep(falls_s, thin_bps), RateStep(falls_s + thin_s, high_bps))
    model = LinkModel(rate_bps=high_bps, delay_s=0.005, rate_steps=steps)
    items: list[Thinned] = []
    policy = Mmcf(
        LEVELS,
        weights=WEIGHTS,
        ranges=Ranges(),
        floors=FLOORS,
        initial=Configuration(queues=(10, 10, 10), summaries=ALL_RAW),
    )
    r = rig(policy, model, link=LinkParams(), summaries=items)
    cloud = r.robot.publish("/robot/points", spec(BULK, depth=1, lifespan_s=1.0))
    item = Thinned(r.robot, cloud, cloud, part=0.1)
    items.append(item)
    r.world.network.every(1.0 / rate_hz, lambda now: item.offer(BODY, now), node=r.robot)
    back_s = falls_s + thin_s
    r.world.run(back_s + 10.0)
    rtprop_s = r.robot.core.link.lanes.lane.estimator.rtprop_s
    assert rtprop_s is not None and rtprop_s < 0.03, "the path is as short as before"
    assert clouds_in(r, back_s + 5.0, back_s + 10.0) >= 0.8 * rate_hz * 5.0
    r.world.validate()


@pytest.mark.parametrize("lossless", [False, True], ids=["datagrams", "stream"])
def test_a_wide_link_that_was_never_full_is_not_taken_to_be_as_narrow_as_what_was_offered(*, lossless: bool) -> None:
    """Many small messages, one after the other: there is never more to send than the link takes."""
    policy = Mmcf(
        Grid.of(
            rates=[(1.0,), (1.0, 0.5), (1.0, 0.4, 0.1)],
            queues=[(10,), (1, 10), (1, 10)],
            codecs=("none",),  # it must fit as it is
            redundancy=(0, 1),
        ),
        weights=WEIGHTS,
        ranges=Ranges(),
        floors=FLOORS,
        initial=Configuration(queues=(10, 10, 10)),
    )
    r = rig(policy, LinkModel(rate_bps=1e9, delay_s=1e-4), lossless=lossless, link=LinkParams())
    r.feed(r.robot.publish("/robot/pose", spec(CONTROL, lifespan_s=1.0)), 250.0, 380)
    r.feed(r.robot.publish("/robot/images", spec(BULK, depth=1)), 100.0, 10_700)
    r.world.run(4.0)
    assert [step.decision.chosen.rates for step in r.steps] == [(1.0, 1.0, 1.0)] * len(r.steps)
    assert len(r.site.on("/robot/images")) >= 0.99 * 4.0 * 100.0
    r.world.validate()


MIXED = ((5.0, 200_000), (5.0, 3_400), (50.0, 112), (20.0, 70), (10.0, 61), (5.0, 120), (1.0, 500), (1.0, 200))
"""Rates and sizes of what a robot has in class bulk where no rule names it: clouds among many small topics."""


@pytest.mark.parametrize("lossless", [False, True], ids=["datagrams", "stream"])
def test_a_class_of_large_and_small_messages_is_not_thinned_on_a_link_that_has_room_for_it(*, lossless: bool) -> None:
    """The formulas know a class by the mean and the spread of its sizes, and foresee that a queue of such sizes is
    overrun. What arrives says otherwise."""
    policy = Mmcf(GRID, weights=WEIGHTS, ranges=Ranges(), floors=FLOORS, initial=Configuration(queues=(10, 10, 10)))
    r = rig(policy, LinkModel(rate_bps=1e9, delay_s=1e-4), lossless=lossless, link=LinkParams())
    body = Random(7).randbytes(200_000)
    r.feed(r.robot.publish("/robot/pose", spec(CONTROL, lifespan_s=1.0)), 250.0, 380)
    for number, (rate_hz, size) in enumerate(MIXED):
        r.feed(r.robot.publish(f"/robot/{number}", spec(BULK, lifespan_s=1.0)), rate_hz, size, body=body)
    r.world.run(6.0)
    assert [step.decision.chosen.rates for step in r.steps] == [(1.0, 1.0, 1.0)] * len(r.steps)
    assert r.adapter.switches <= 1
    r.world.validate()


@pytest.mark.parametrize("lossless", [False, True], ids=["datagrams", "stream"])
def test_looking_for_a_better_link_takes_a_tenth_of_a_thin_one_at_most(*, lossless: bool) -> None:
    """Half a minute on a link that never gets better, and one look in it: what raw messages take beside summaries."""
    steps = (RateStep(10.0, LOW_BPS),)
    model = LinkModel(rate_bps=4e6, delay_s=0.005, rate_steps=steps)
    r = flowing(model, rate_hz=2.5, lossless=lossless, summaries=True)
    from_s, to_s = 15.0, 45.0
    r.world.run(to_s)
    raw_bits = 8.0 * 0.6 * len(BODY) * clouds_in(r, from_s, to_s)  # Zstandard leaves 0.6
    assert raw_bits <= 0.1 * LOW_BPS * (to_s - from_s)
    poses = sum(from_s < got.at_s - r.world.network.start_s < to_s for got in r.site.on("/robot/pose"))
    assert poses >= 0.95 * 50.0 * (to_s - from_s)
    summarised = [step.decision.chosen.summaries == (False, False, True) for step in r.steps[16:]]
    assert sum(summarised) >= 0.9 * len(summarised)


# --- the trial by itself ----------------------------------------------------------------------------------------------


def outcome(on_time: int, admitted: int = 10) -> tuple[ClassOutcome, ...]:
    return (ClassOutcome(BULK, 10, admitted, on_time, on_time, 0.1),)


class Driven:
    """A trial with an estimate that the test sets, judged once a second."""

    def __init__(self, estimate_bps: float | None) -> None:
        self.trial = CapacityTrial(1.0, assumed_min_bps=8e6)
        self.estimate_bps = estimate_bps
        self.eased_s = -inf
        self.now = 0.0

    def second(self, *, on_time: int = 10, thinned: bool = True, summarised: bool = False) -> float | None:
        """The capacity to go by afterwards."""
        self.now += 1.0
        self.trial.read(self.estimate_bps)
        self.trial.judge(
            self.estimate_bps, self.eased_s, outcome(on_time), thinned=thinned, summarised=summarised, now=self.now
        )
        return self.trial.read(self.estimate_bps)


def eased(estimate_bps: float) -> Driven:
    """One of a link that carried 20 Mbit/s, got thin, and eased a moment ago."""
    driven = Driven(20e6)
    driven.second()
    driven.estimate_bps = estimate_bps
    driven.second()
    driven.eased_s = driven.now
    return driven


def test_a_link_that_eased_is_taken_to_be_as_good_as_it_was_until_it_fails() -> None:
    d = Driven(20e6)
    assert d.second() == 20e6
    d.estimate_bps = 1e6
    assert [d.second() for _ in range(5)] == [1e6] * 5
    d.eased_s = d.now
    assert d.second() == 20e6
    assert [d.second(on_time=0) for _ in range(TRIED - 1)] == [20e6] * (TRIED - 1), "the estimate has time to grow"
    assert d.second(on_time=0) == 1e6
    d.eased_s = d.now
    assert d.second() == 1e6, "it rests"


def test_it_is_not_judged_while_the_estimate_comes_up() -> None:
    """On a long round trip that takes longer than the two intervals."""
    d = eased(0.3e6)
    assert d.second() == 20e6
    for estimate_bps in (0.4e6, 0.8e6, 1.6e6, 3.2e6):
        d.estimate_bps = estimate_bps
        assert d.second(on_time=0) == 20e6
    assert d.second(on_time=0) == 3.2e6, "it rises no more"


def test_one_that_succeeds_stays_until_the_estimate_has_come_up_or_seen_the_link_get_slower() -> None:
    d = eased(1e6)
    assert [d.second() for _ in range(30)] == [20e6] * 30
    d.estimate_bps = 5e6
    assert d.second() == 20e6
    d.estimate_bps = 1e6
    assert d.second() == 1e6
    d.eased_s = d.now
    assert d.second() == 20e6
    d.estimate_bps = 19e6
    assert d.second() == 19e6


def test_failures_rest_longer_each_time_so_that_trials_have_a_tenth_of_the_time() -> None:
    d = Driven(1e6)
    tried = []
    for _ in range(600):
        d.eased_s = d.now  # the evidence errs all the time
        tried.append(d.second(on_time=0) != 1e6)
    assert 0.0 < sum(tried) / len(tried) < 0.1
    assert sum(tried[:60]) <= 2 * TRIED + TRIED * len(REST_INTERVALS)


def test_an_estimate_that_grew_is_reason_enough_whatever_failed_before() -> None:
    d = eased(1e6)
    assert [d.second(on_time=0) for _ in range(TRIED + 1)][-1] == 1e6
    d.estimate_bps = 1.7e6
    assert d.second() == 20e6


def test_in_time_a_little_more_is_tried_where_messages_are_left_out() -> None:
    d = Driven(1e6)
    capacities = [d.second() for _ in range(TIMED_INTERVALS + 1 + 2 * TRIED)]
    assert capacities[:TIMED_INTERVALS] == [1e6] * TIMED_INTERVALS
    assert capacities[TIMED_INTERVALS] == TIMED_GAIN * 1e6
    assert capacities[-1] == TIMED_GAIN**3 * 1e6, "step by step while it goes well"
    whole = Driven(1e6)
    assert {whole.second(thinned=False) for _ in range(50)} == {1e6}, "nothing is left out, so nothing is missing"
    summarised = Driven(1e6)
    assert {summarised.second(summarised=True) for _ in range(50)} == {1e6}, "raw messages are probed one by one"


def test_nothing_is_assumed_of_a_link_that_nothing_comes_through() -> None:
    d = eased(1e6)
    assert d.second() == 20e6
    d.estimate_bps = None
    assert d.second() is None
    d.estimate_bps = 1e6
    assert d.second() == 1e6
