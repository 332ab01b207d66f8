"""Clock synchronisation against simulated clocks: offset, skew, asymmetric jitter, steps; and the RTT estimator."""

import math
from dataclasses import dataclass
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sern_core.path.clocksync import MAX_SKEW_PPM, MIN_RTO_S, ClockSync, RttEstimator
from sern_core.vocabulary.errors import UsageError
from tests.exploring import cases

PURE = settings(max_examples=cases(60))


@dataclass
class Clocks:
    """A peer whose clock is `offset_s` ahead at local time 0 and runs `skew_ppm` fast, behind a jittery path."""

    offset_s: float = 0.0
    skew_ppm: float = 0.0
    out_s: float = 0.01
    back_s: float = 0.01
    out_jitter_s: float = 0.0
    back_jitter_s: float = 0.0
    processing_s: float = 0.0001

    def offset_at(self, local_s: float) -> float:
        return self.offset_s + self.skew_ppm * 1e-6 * local_s

    def ping(self, sync: ClockSync, t1: float, random: Random) -> float:
        """One ping at local time t1; returns t4. One in four meets empty queues."""
        jitter = random.random() < 0.75
        arrive = t1 + self.out_s + jitter * random.random() * self.out_jitter_s
        answer = arrive + self.processing_s
        t4 = answer + self.back_s + jitter * random.random() * self.back_jitter_s
        assert sync.sample(t1, arrive + self.offset_at(arrive), answer + self.offset_at(answer), t4)
        return t4


def test_before_the_first_sample_nothing_is_known() -> None:
    sync = ClockSync()
    assert not sync.ready
    assert (sync.offset_s, sync.error_s, sync.skew_ppm, sync.skew_error_ppm) == (0.0, math.inf, 0.0, MAX_SKEW_PPM)
    assert sync.one_way_delay_s(5.0, 6.0) == (0.0, math.inf)


def test_the_formula() -> None:
    sync = ClockSync()
    assert sync.sample(10.0, 110.03, 110.04, 10.05)
    assert sync.offset_s == pytest.approx(100.01)
    assert sync.error_s == pytest.approx(0.02)
    assert sync.rtt.latest_s == pytest.approx(0.04)
    delay = sync.one_way_delay_s(110.0, 10.02)
    assert delay.delay_s == pytest.approx(0.03)
    assert delay.uncertainty_s == pytest.approx(0.02, abs=1e-4)
    assert sync.one_way_delay_s(120.0, 10.02).delay_s == 0.0  # never negative


def test_the_least_round_trip_of_the_last_eight_counts() -> None:
    sync = ClockSync()
    sync.sample(0.0, 0.010, 0.010, 0.020)
    for number in range(1, 8):
        sync.sample(float(number), number + 0.09, number + 0.09, number + 0.1)
        assert sync.error_s == pytest.approx(0.01)
        assert sync.offset_s == pytest.approx(0.0)
    sync.sample(8.0, 8.09, 8.09, 8.1)  # the ninth pushes the first out
    assert sync.error_s == pytest.approx(0.05)
    assert sync.offset_s == pytest.approx(0.04)


def test_a_burst_of_acknowledgements_counts_as_one_sample() -> None:
    sync = ClockSync()
    clocks = Clocks(offset_s=3.0, skew_ppm=60.0)
    random = Random(2)
    now = 0.0
    for number in range(31_000):
        # For 0.8 s of each second a queue of up to 60 ms stands on the way out; 500 acknowledgements a second.
        clocks.out_jitter_s = 0.06 if number % 500 < 400 else 0.0
        clocks.out_s = 0.03 if number % 500 < 400 else 0.01
        clocks.ping(sync, now, random)
        now += 0.002
        if number > 500:
            assert sync.error_s < 0.011
            assert abs(sync.offset_s - clocks.offset_at(now)) < 0.001
    assert len(sync._fit) <= 256  # and the first second, all queue, has left the window
    assert sync.skew_ppm == pytest.approx(60.0, abs=5.0)


def test_a_sample_older_than_the_window_no_longer_counts() -> None:
    sync = ClockSync()
    sync.sample(0.0, 0.001, 0.001, 0.002)
    sync.sample(600.0, 600.05, 600.05, 600.1)
    assert sync.error_s == pytest.approx(0.05)


@pytest.mark.parametrize(
    "times",
    [
        (0.0, 5.0, 4.9, 0.1),  # the peer's clock ran backwards
        (1.0, 5.0, 5.0, 0.9),  # ours did
        (0.0, 5.0, 5.5, 0.1),  # answered after it arrived
        (0.0, math.nan, 5.0, 0.1),
        (0.0, math.inf, math.inf, 0.1),
        (0.0, 1.7e308, 1.7e308, 0.1),
        (math.nan, 5.0, 5.0, 0.1),
    ],
)
def test_impossible_samples_are_rejected(times: tuple[float, float, float, float]) -> None:
    sync = ClockSync()
    assert not sync.sample(*times)
    assert sync.rejected == 1 and not sync.ready and sync.rtt.samples == 0


def test_a_round_trip_of_nothing_is_possible() -> None:
    sync = ClockSync()
    assert sync.sample(0.0, 5.0, 5.001 + 1e-7, 0.001)
    assert sync.error_s == 0.0


@pytest.mark.parametrize("step_s", [3600.0, -3600.0, 0.2])
def test_a_step_resets_cleanly(step_s: float) -> None:
    random = Random(1)
    clocks = Clocks(offset_s=50.0, skew_ppm=40.0, out_jitter_s=0.01)
    sync = ClockSync()
    now = 0.0
    for _ in range(100):
        clocks.ping(sync, now, random)
        now += 1.0
    assert sync.steps == 0 and abs(sync.skew_ppm - 40.0) < 30.0
    clocks.offset_s += step_s
    clocks.ping(sync, now, random)
    assert sync.steps == 1
    assert abs(sync.offset_s - clocks.offset_at(now)) < 0.02
    assert sync.skew_ppm == 0.0 and sync.skew_error_ppm == MAX_SKEW_PPM
    for _ in range(20):
        now += 1.0
        clocks.ping(sync, now, random)
    assert sync.steps == 1 and abs(sync.offset_s - clocks.offset_at(now)) < 0.02


def test_a_step_inside_the_bounds_is_followed_by_the_filter() -> None:
    clocks = Clocks(offset_s=1.0)
    sync = ClockSync()
    for number in range(8):
        clocks.ping(sync, float(number), Random(1))
    clocks.offset_s += 0.005
    for number in range(8, 17):
        clocks.ping(sync, float(number), Random(1))
    assert sync.steps == 0 and sync.offset_s == pytest.approx(1.005, abs=1e-6)


def test_reset_forgets_but_keeps_the_counters() -> None:
    sync = ClockSync()
    sync.sample(0.0, 5.0, 5.0, 0.1)
    sync.sample(1.0, 50.0, 50.0, 1.1)
    sync.reset()
    assert not sync.ready and sync.rtt.samples == 0 and sync.steps == 1
    assert sync.one_way_delay_s(5.0, 6.0).uncertainty_s == math.inf


def test_a_quiet_path_gives_the_skew_to_a_few_ppm() -> None:
    clocks = Clocks(offset_s=-7.0, skew_ppm=-85.0, out_s=0.3, back_s=0.01)  # the asymmetry does not touch the skew
    sync = ClockSync()
    for number in range(120):
        clocks.ping(sync, number / 2.0, Random(1))
    assert sync.skew_ppm == pytest.approx(-85.0, abs=0.5)
    assert sync.skew_error_ppm < 20.0
    offset_s, uncertainty_s = sync.offset_at(90.0)  # half a minute after the last ping
    assert offset_s - clocks.offset_at(90.0) == pytest.approx(-0.145 + 0.29, abs=0.001)
    assert uncertainty_s < 0.16


@PURE
@given(
    offset_s=st.floats(-1e6, 1e6),
    skew_ppm=st.floats(-400, 400),
    out_s=st.floats(0.0005, 0.3),
    back_s=st.floats(0.0005, 0.3),
    out_jitter_s=st.floats(0, 0.2),
    back_jitter_s=st.floats(0, 0.2),
    every_s=st.floats(0.0, 5.0),
    seed=st.integers(0, 2**32),
)
def test_the_truth_is_always_within_the_bounds(
    offset_s: float,
    skew_ppm: float,
    out_s: float,
    back_s: float,
    out_jitter_s: float,
    back_jitter_s: float,
    every_s: float,
    seed: int,
) -> None:
    random = Random(seed)
    clocks = Clocks(offset_s, skew_ppm, out_s, back_s, out_jitter_s, back_jitter_s)
    sync = ClockSync()
    now = 0.0
    for number in range(80):
        t4 = clocks.ping(sync, now, random)
        assert sync.steps == 0 and sync.rejected == 0
        best = sync._best
        assert best is not None
        assert abs(sync.offset_s - clocks.offset_at(best.at_s)) <= best.bound_s + 1e-6
        assert sync.error_s <= best.bound_s
        for later_s in (0.0, every_s):
            at = t4 + later_s
            estimate_s, uncertainty_s = sync.offset_at(at)
            assert abs(estimate_s - clocks.offset_at(at)) <= uncertainty_s + 1e-6
            # A message that left the peer 0.05 s before.
            sent = at - 0.05
            delay = sync.one_way_delay_s(sent + clocks.offset_at(sent), at)
            assert abs(delay.delay_s - 0.05) <= delay.uncertainty_s + 1e-6
            assert delay.delay_s >= 0.0
        if number > 10:
            assert abs(sync.skew_ppm - skew_ppm) <= sync.skew_error_ppm + 1.0 or sync.skew_ppm == 0.0
        now = t4 + every_s


# Round trips ---------------------------------------------------------------------------------------------------------


def test_rfc_6298() -> None:
    rtt = RttEstimator()
    assert (rtt.srtt_s, rtt.rttvar_s, rtt.min_s, rtt.rto_s) == (0.0, 0.0, math.inf, 1.0)
    rtt.sample(0.1, now=0.0)
    assert (rtt.srtt_s, rtt.rttvar_s) == (0.1, 0.05)
    assert rtt.rto_s == pytest.approx(0.3)
    rtt.sample(0.2, now=1.0)
    assert rtt.srtt_s == pytest.approx(7 / 8 * 0.1 + 1 / 8 * 0.2)
    assert rtt.rttvar_s == pytest.approx(3 / 4 * 0.05 + 1 / 4 * 0.1)
    for number in range(200):
        rtt.sample(0.01, now=2.0 + number)
    assert rtt.rto_s == MIN_RTO_S
    rtt.reset()
    assert (rtt.samples, rtt.min_s) == (0, math.inf)


@pytest.mark.parametrize("bad", [-0.1, math.nan, math.inf])
def test_impossible_round_trips(bad: float) -> None:
    with pytest.raises(UsageError, match="cannot be"):
        RttEstimator().sample(bad, now=0.0)


def test_a_window_must_be_positive() -> None:
    with pytest.raises(UsageError, match="window_s"):
        RttEstimator(window_s=0.0)


@PURE
@given(st.lists(st.tuples(st.floats(0, 6), st.floats(0, 1)), min_size=1, max_size=60))
def test_the_least_of_the_window_against_brute_force(steps: list[tuple[float, float]]) -> None:
    rtt = RttEstimator(window_s=10.0)
    now, seen = 0.0, []
    for gap_s, rtt_s in steps:
        now += gap_s
        rtt.sample(rtt_s, now=now)
        seen.append((now, rtt_s))
        assert rtt.min_s == min(value for at, value in seen if at >= now - 10.0)
        assert rtt.min_s <= max(value for _, value in seen) and 0.0 <= rtt.srtt_s <= 1.0 and rtt.rttvar_s >= 0.0


def ping(sync: ClockSync, at_s: float, offset_s: float, rtt_s: float = 0.02) -> None:
    """One round trip that is as long each way, of a peer that answers at once."""
    middle_s = at_s + rtt_s / 2 + offset_s
    assert sync.sample(at_s, middle_s, middle_s, at_s + rtt_s)


def test_what_the_peer_had_before_its_clock_stood_still_is_older_than_it_says() -> None:
    sync = ClockSync()
    for number in range(8):
        ping(sync, 10.0 + number, 100.0)
    assert sync.behind_s(117.0) == 0.0
    ping(sync, 20.0, 97.0)  # it stood still for 3 s, some time after 117 s on it
    assert sync.steps == 1
    assert 3.0 <= sync.behind_s(117.0) <= 3.1
    assert sync.behind_s(118.0) == 0.0, "born after the sample that showed it"
    ping(sync, 30.0, 95.0)
    assert 5.0 <= sync.behind_s(117.0) <= 5.2 and 2.0 <= sync.behind_s(118.0) <= 2.1


def test_a_pause_that_hides_in_the_bounds_counts_as_well() -> None:
    sync = ClockSync()
    for number in range(8):
        ping(sync, 10.0 + number, 100.0, 0.4)
    ping(sync, 20.0, 99.7, 0.35)
    assert sync.steps == 0 and sync.offset_s == pytest.approx(99.7)
    assert sync.behind_s(117.0) == pytest.approx(0.3)


@pytest.mark.parametrize("late_s", [0.0, 0.5, 1e6])
def test_what_comes_late_is_no_sign_of_a_pause(late_s: float) -> None:
    sync = ClockSync()
    ping(sync, 10.0, 100.0)
    sync.witness(110.5, 10.5 + late_s)
    assert sync.ready and sync.steps == 0


def test_what_comes_from_the_future_tells_that_our_clock_stood_still() -> None:
    sync = ClockSync()
    ping(sync, 10.0, 100.0)
    assert sync.ahead_s == pytest.approx(100.01, abs=1e-4)
    known = []
    for sent_s in (110.505, 111.0):  # within the bounds, and beyond
        sync.witness(sent_s, 10.5)
        known.append((sync.ready, sync.steps))
    assert known == [(True, 0), (False, 1)]
    assert sync.ahead_s == math.inf
    assert sync.one_way_delay_s(111.0, 10.5).uncertainty_s == math.inf
    ping(sync, 10.6, 100.5)
    assert sync.offset_s == pytest.approx(100.5)
