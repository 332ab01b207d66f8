"""What a link carries is known from bursts, too, where it is idle in between: a cloud now and again."""

from statistics import median

import pytest

from sern_core.path.congestion.link_rate import BURST_BYTES, BURSTS, LinkRate
from sern_core.path.congestion.params import DEFAULT_HYBRID
from sern_core.vocabulary.types import PriorityClass
from sern_sim.models import LinkModel
from tests.world import World, spec

RATE = 1e6
"""Bytes/s."""
NBYTES = 2 * BURST_BYTES
DELAY_S, JITTER_S = 0.00375, 0.00125


def burst(rate: LinkRate, at_s: float, *, took_s: float, nbytes: int = NBYTES, spread_s: float = 0.0) -> None:
    """The first and the last acknowledgement of one."""
    before = int(at_s * RATE)
    rate.note_burst(at_s, at_s, before, app_limited=False, spread_s=spread_s, rtt_s=0.01)
    end_s = at_s + took_s
    rate.note_burst(end_s, end_s, before + nbytes, app_limited=True, spread_s=spread_s, rtt_s=0.01)


def test_how_fast_a_burst_came_is_what_the_link_carried() -> None:
    rate = LinkRate(DEFAULT_HYBRID)
    burst(rate, 1.0, took_s=NBYTES / RATE)
    assert rate.value == pytest.approx(RATE) and not rate.saturated
    burst(rate, 1.2, took_s=0.5 * NBYTES / RATE, spread_s=0.5 * NBYTES / RATE)
    assert rate.value == pytest.approx(RATE), "jitter may have made it so short"


def test_what_comes_in_a_short_burst_or_in_no_time_tells_nothing() -> None:
    rate = LinkRate(DEFAULT_HYBRID)
    burst(rate, 1.0, took_s=0.01, nbytes=BURST_BYTES - 1)
    burst(rate, 2.0, took_s=0.0)
    rate.note_burst(3.0, 3.0, NBYTES, app_limited=True, spread_s=0.0, rtt_s=0.01)  # a lone packet
    assert rate.value is None


def test_a_capacity_that_is_known_gives_way_to_several_bursts_that_were_faster() -> None:
    rate = LinkRate(DEFAULT_HYBRID)
    rate.saturate()
    rate.note(1.0, RATE, 0.01)
    for number in range(BURSTS - 1):
        burst(rate, 2.0 + number, took_s=0.5 * NBYTES / RATE)
    burst(rate, 5.0, took_s=NBYTES / RATE)
    assert rate.value == RATE, "they were not in a row"
    for number in range(BURSTS):
        burst(rate, 6.0 + number, took_s=0.5 * NBYTES / RATE)
    assert rate.value == pytest.approx(2 * RATE)


def test_what_bursts_showed_is_forgotten_once_the_link_is_full() -> None:
    rate = LinkRate(DEFAULT_HYBRID)
    burst(rate, 1.0, took_s=0.5 * NBYTES / RATE)
    rate.saturate()
    rate.note(1.1, RATE, 0.01)
    assert rate.value == RATE


@pytest.mark.parametrize(("robots", "nbytes", "rate_hz"), [(1, 10_000, 20.0), (5, 10_000, 20.0), (2, 200_000, 10.0)])
def test_clouds_over_a_link_that_carries_three_times_as_much_come_as_soon_as_it_can(
    robots: int, nbytes: int, rate_hz: float
) -> None:
    """They come together, so that the last of them waits for all others: a pace below the capacity shows most there."""
    capacity_bps = 3 * 8 * robots * nbytes * rate_hz
    takes_s = 8 * robots * nbytes / capacity_bps
    late_s = [_late_s(robots, nbytes, rate_hz, capacity_bps, seed) for seed in range(1, 4)]
    assert median(late_s) < 1.25 * (takes_s + DELAY_S + JITTER_S)


def _late_s(robots: int, nbytes: int, rate_hz: float, capacity_bps: float, seed: int) -> float:
    """How old nine of ten clouds are at most, of those that come from 5 to 9 s; most of them must."""
    world = World(lossless=False, seed=seed)
    robot = world.client(
        "robot", LinkModel(rate_bps=capacity_bps, delay_s=DELAY_S, jitter_s=JITTER_S, overhead_bytes=28)
    )
    site = world.client("site", patterns=["/robot/.*"])
    for number in range(robots):
        robot.every(1 / rate_hz, robot.publish(f"/robot/points{number}", spec(PriorityClass.STATE)), bytes(nbytes))
    world.run(9.0)
    ages_s = sorted(
        got.at_s - robot.sent[f"/robot/points{number}", got.seq][0]
        for number in range(robots)
        for got in site.on(f"/robot/points{number}")
        if got.at_s - world.network.start_s > 5.0
    )
    assert len(ages_s) >= 0.98 * robots * rate_hz * 4
    world.validate()
    return ages_s[int(0.9 * len(ages_s))]
