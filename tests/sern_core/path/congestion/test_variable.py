"""Links whose rate goes up and down all the time: how they are known, and how they are followed, in virtual time."""

from functools import cache
from itertools import pairwise
from math import inf
from random import Random

import pytest

from benchmarks.flows import Cubic, World
from sern_core.path.capacity import AckSample
from sern_core.path.congestion.hybrid import HybridWindow
from sern_core.path.congestion.params import DEFAULT_HYBRID, HybridParams
from sern_core.path.congestion.variable import Variability, VariableWindow
from sern_sim.models import LinkModel, RateStep
from tests.exploring import also
from tests.sern_core.path.congestion.test_hybrid import at, carries_bps, floor_ms

QUEUE_S = 0.010
PARAMS = DEFAULT_HYBRID
NEVER = HybridParams(variable_queue_s=None)
"""A window that never takes a link for one whose rate swings."""
SPAN_S = PARAMS.variable_span_s
MBIT = 1e6 / 8


class Measured:
    """A `Variability` that is told what a full link carries, one span after the other."""

    def __init__(self) -> None:
        self.it = Variability(PARAMS)
        self.now = 100.0
        self._bytes = 0.0

    def full(self, *rates_bps: float) -> bool:
        """The link was full for a span with each of these; whether it swings."""
        for rate_bps in rates_bps:
            for _ in range(20):  # the first begins a span, and the rest fills it
                self.now += 1.05 * SPAN_S / 20
                self._bytes += rate_bps / 8 * 1.05 * SPAN_S / 20
                self.it.queued(self.now, self.now, int(self._bytes), 0.0)
        return self.it.swings(self.now)

    def pause(self, seconds: float) -> None:
        self.it.passed()
        self.now += seconds


def rising() -> Measured:
    """A link that was found to be faster than at first."""
    link = Measured()
    assert not link.full(2e6, 2e6, 8e6, 8e6)
    return link


def test_a_link_that_fades_and_comes_back_at_once_swings() -> None:
    link = rising()
    assert not link.full(3e6, 3e6)
    assert link.full(8e6, 8e6)


def test_a_link_that_got_slower_and_later_faster_does_not() -> None:
    link = rising()
    assert not link.full(1e6, 1e6)
    link.pause(8.0)
    assert not link.full(1e6, 4e6, 4e6)
    link.pause(8.0)
    assert link.full(4e6, 1e6, 1e6), "a third turn within the time that is remembered"


def test_what_it_did_long_ago_is_forgotten() -> None:
    link = rising()
    assert link.full(3e6, 3e6, 8e6, 8e6)
    link.pause(PARAMS.variable_memory_s - 2.0)
    assert link.full(8e6, 8e6)
    link.pause(3.0)
    assert not link.full(8e6, 8e6)


def test_rates_that_hardly_differ_are_one() -> None:
    link = rising()
    low, high = 8e6 / (PARAMS.variable_times - 0.1), 8e6
    assert not link.full(*[low, high] * 50)


def test_what_was_carried_shows_that_it_can_but_not_that_it_cannot_do_more() -> None:
    link = rising()
    for rate_bps in (8e6, 1e6, 8e6, 1e6, 8e6):  # what was offered, perhaps
        link.pause(0.2)
        link.it.at_least(link.now, rate_bps / 8)
    assert not link.it.swings(link.now)
    assert not link.full(2e6, 2e6), "it fell once"
    link.it.at_least(link.now, 4 * MBIT)
    assert link.it.swings(link.now)


def test_a_rival_is_no_swing_of_the_link() -> None:
    link = rising()
    assert link.full(3e6, 3e6, 8e6, 8e6)
    link.it.forget()
    assert not link.full(8e6, 8e6)


def acked(now: float, cum_bytes: int, *, app_limited: bool = False) -> AckSample:
    return AckSample(now, 0.06, 1260, 12_600, now, cum_bytes, app_limited, now - 0.03, 1260)


def steered(window: float, queue_s: float, *, rate_bps: float = 4e6, app_limited: bool = False) -> float:
    """The window after 0.2 s of acknowledgements with that queue."""
    it, now, cum_bytes = VariableWindow(PARAMS), 50.0, 0
    for _ in range(int(0.2 * rate_bps / 8 / 1260)):
        now += 8 * 1260 / rate_bps
        cum_bytes += 1260
        sample = acked(now, cum_bytes, app_limited=app_limited)
        window = it.steer(window, queue_s, sample, rtt_s=0.05, fragment=1260)
    return window


def test_the_window_grows_while_the_queue_is_short_and_there_is_more_to_send() -> None:
    assert steered(20_000, 0.0) > 1.3 * 20_000
    assert steered(20_000, 0.0, app_limited=True) == 20_000
    assert steered(20_000, QUEUE_S) == 20_000


def test_it_does_not_run_away_from_what_arrives() -> None:
    product = 4 * MBIT * (0.05 + QUEUE_S)
    most = PARAMS.variable_ahead * product + PARAMS.variable_ahead_packets * 1260
    assert steered(most, 0.0) == pytest.approx(most, rel=0.1)


def test_a_longer_queue_cuts_it_to_what_arrives() -> None:
    product = 4 * MBIT * (0.05 + QUEUE_S)
    assert steered(200_000, 5 * QUEUE_S) == pytest.approx(product + 1260, rel=0.05)


@pytest.mark.parametrize(("queues_s", "rival"), [([0.3, 0.3, 0.3, 0.3, 0.0], True), ([0.3, 0.0, 0.0, 0.0, 0.0], False)])
def test_it_makes_way_for_a_queue_that_stays_and_tells_whose_it_is(queues_s: list[float], rival: bool) -> None:
    """A queue much longer than wanted, epoch after epoch; `queues_s`: what then becomes of it, again and again."""
    it, now, cum_bytes, rtt_s = VariableWindow(PARAMS), 50.0, 0, 0.05

    def window() -> float:
        return it.steer(20_000, 0.0, acked(now, cum_bytes), rtt_s=rtt_s, fragment=1260)

    def epoch(queue_s: float) -> bool:
        nonlocal now, cum_bytes
        now, cum_bytes = now + 0.05, cum_bytes + 1260
        return it.close_epoch(now, queue_s, high_s=0.012, rtt_s=rtt_s)

    while window() > 0:
        assert not epoch(0.3)
    assert now > 50.0 + PARAMS.variable_patience_s
    until_s, judged = now + rtt_s + 0.3 + 2 * PARAMS.variable_patience_s, False
    while now <= until_s:
        assert window() == 0, "it makes way all the time"
        judged = epoch(queues_s[round(now / 0.05) % len(queues_s)])
    assert judged is rival
    assert window() > 0, "and then no longer"


def swinging(seed: int, until_s: float) -> LinkModel:
    """1 to 10 Mbit/s, another rate every 0.1 to 0.6 s until then, and 4 Mbit/s after it."""
    random, steps, at_s = Random(seed), [], 0.0
    while (at_s := at_s + random.uniform(0.1, 0.6)) < until_s:
        steps.append(RateStep(at_s, 1e6 * 10 ** random.random()))
    steps.append(RateStep(until_s, 4e6))
    return LinkModel(rate_bps=4e6, delay_s=0.025, overhead_bytes=60, rate_steps=tuple(steps), queue_packets=1000)


def carried(model: LinkModel, params: HybridParams, until_s: float) -> tuple[float, list[float], World]:
    """Share of the link that bulk used, ages of the poses in ms, sorted, and the world."""
    world = World(model, LinkModel(delay_s=0.025))
    world.flow(HybridWindow(params=params))
    world.run(until_s)
    share = world.goodput_bps(0.0, until_s) * until_s / (model.capacity_bits(0.0, until_s) * (1200 - 56) / 1260)
    return share, world.poses_ms(0.0, until_s - 1.0), world


@cache
def swung(seed: int) -> tuple[float, list[float], World]:
    """A minute of a link that swings, followed. Several tests look at it, and change nothing."""
    return carried(swinging(seed, 60.0), PARAMS, 60.0)


@pytest.mark.parametrize("seed", [1, 2, *also(3)])
def test_a_link_that_swings_is_used_with_a_short_queue(seed: int) -> None:
    """Without it the link is used for .61 to .66."""
    share, ages_ms, world = swung(seed)
    assert share > 0.80
    assert at(ages_ms, 0.5) < 45.0 and at(ages_ms, 0.95) < 170.0
    assert world.flows[0].estimator.snapshot()["varying"] == 1.0


@pytest.mark.parametrize("seed", [1, 2, *also(3)])
def test_following_the_swings_uses_more_of_the_link(seed: int) -> None:
    share, _, _ = swung(seed)
    without, _, world = carried(swinging(seed, 60.0), NEVER, 60.0)
    assert share > without + 0.15
    assert world.flows[0].estimator.snapshot()["varying"] == 0.0


def test_when_the_link_keeps_a_rate_again_the_queue_goes() -> None:
    _, _, world = carried(swinging(1, 20.0), PARAMS, 52.0)
    assert world.flows[0].estimator.snapshot()["varying"] == 0.0
    assert at(world.poses_ms(45.0), 0.5) < 1.15 * floor_ms(4e6, 0.05)
    assert world.goodput_bps(45.0, 52.0) > 0.97 * carries_bps(4e6)


@pytest.mark.parametrize(
    ("change", "until_s"),
    [
        ({}, 24.0),
        ({"loss": 0.05}, 24.0),
        ({"jitter_s": 0.005}, 40.0),
        ({"reorder": 0.02, "reorder_delay_s": 0.005}, 24.0),
    ],
)
def test_a_link_of_one_rate_is_never_taken_for_one_that_swings(change: dict[str, float], until_s: float) -> None:
    model = LinkModel(rate_bps=4e6, delay_s=0.025, overhead_bytes=60, **change)  # type: ignore[arg-type]
    _, ages_ms, _ = carried(model, PARAMS, until_s)
    _, without_ms, _ = carried(model, NEVER, until_s)
    assert ages_ms == without_ms


@pytest.mark.parametrize(("rate_bps", "seed"), [(4e6, 1), (20e6, 6), *also((20e6, 1))])
def test_a_rival_still_leaves_us_a_share(rate_bps: float, seed: int) -> None:
    """With seed 6 the rival cuts its window twice just as we make way: its queue is short then, but there."""
    world = World(LinkModel(rate_bps=rate_bps, delay_s=0.02, overhead_bytes=60), seed=seed)
    world.flow(HybridWindow(params=PARAMS))
    world.flow(Cubic(), poses=False, start_s=3.0)
    world.run(40.0)
    ours, theirs = (world.goodput_bps(20.0, 40.0, index) for index in (0, 1))
    assert 0.15 < ours / (ours + theirs) < 0.85


def test_a_model_of_cubic_keeps_a_real_window_on_a_link_that_swings() -> None:
    world = World(swinging(4, 30.0), LinkModel(delay_s=0.025))
    world.flow(Cubic())
    world.run(30.0)
    windows = [window for _, window in world.windows()]
    assert all(0.0 < window < inf for window in windows) and len(windows) > 1000
    assert any(after < before for before, after in pairwise(windows)), "it was cut"
