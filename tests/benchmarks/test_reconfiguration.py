"""What the benchmarks of a stream that comes and goes, and of more and more robots, make of what they see."""

import pytest

from benchmarks import recordings
from benchmarks.paper.published import LEVELS
from benchmarks.reconfiguration import FIRST, RATE_HZ, Arrival, Outcome, curve, loads, longest_pause, summary
from benchmarks.scaling import LINKS, SIZES, Case, cases
from benchmarks.scaling import summary as scaling_summary
from sern_core.vocabulary.errors import SernError


def test_a_pause_is_what_is_longer_than_the_period() -> None:
    times = [0.0, 0.1, 0.2, 0.55, 0.6]
    arrivals = [Arrival(FIRST[0], at, at) for at in times] + [Arrival(FIRST[1], 0.0, 0.0)]
    assert longest_pause(arrivals, FIRST[0], 0.0, 1.0) == pytest.approx(0.35 - 1 / RATE_HZ)
    assert longest_pause(arrivals, FIRST[0], 0.0, 0.25) == pytest.approx(0.1 - 1 / RATE_HZ)
    with pytest.raises(SernError, match="has stopped: 1 messages"):
        longest_pause(arrivals, FIRST[1], 0.0, 1.0)


def test_load_is_told_over_that_of_two_streams() -> None:
    load = [(at / 10 + 0.05, 0.2 if at < 20 or at > 80 else 0.3) for at in range(120)]
    found = loads(load, 2.0, 8.0)
    assert found["load_during_1"] == pytest.approx(1.5) and found["load_after_1"] == pytest.approx(1.0)
    assert found["cpu_percent"] == pytest.approx(20.0)
    points = curve([Outcome(found, load), Outcome(found, load)])
    assert len(points) == 120 and max(value for _, value in points) == pytest.approx(1.5)


def test_a_summary_has_medians_and_intervals() -> None:
    runs = [{"detected_s": value, "forwarded_s": 0.1, "removed_s": 0.2} for value in (0.1, 0.2, 0.6)]
    found = summary(runs)
    assert found["detected_s"] == 0.2 and found["detected_half_s"] > 0.2 and found["removed_half_s"] == 0.0
    assert "detected_half_s" not in summary(runs[:1])


def test_points_are_as_many_bytes_as_are_wanted() -> None:
    for nbytes in (160, 10_000, 200_000, 5_000_000):
        found = recordings.points(nbytes)
        assert len(found) == nbytes // 16 * 16
        assert len(set(found[:16])) > 1


def test_every_level_is_played_with_both_sizes_on_both_links() -> None:
    assert len({case.name for case in cases(quick=False)}) == len(LEVELS) * len(SIZES) * len(LINKS)
    case = Case(3, "small", "full")
    assert case.topics == [f"/bench/robot{number}/points" for number in (1, 2, 3)]
    nbytes, rate_hz = SIZES["small"]
    assert case.model().rate_bps == pytest.approx(0.6 * 8 * nbytes * rate_hz * 3)


def test_rows_of_many_runs_have_intervals() -> None:
    runs = [{"latency_ms": value, "far_percent": 10.0} for value in (1.0, 2.0, 4.0)]
    found = scaling_summary(runs)
    assert found["latency_ms"] == 2.0 and found["latency_half_ms"] > 1.0 and found["far_half_percent"] == 0.0
