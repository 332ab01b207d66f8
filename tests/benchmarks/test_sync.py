"""The synchroniser's benchmark: a run as quick as it gets, whose figures are those of the promise."""

from pathlib import Path
from random import Random

from benchmarks.common import Report
from benchmarks.sync import bounds, cases
from benchmarks.sync.playing import play, ways
from benchmarks.sync.recording import record
from benchmarks.sync.robot import plan
from sern_sim.models import LinkModel


def test_a_blackout_with_a_shared_trajectory_and_without() -> None:
    report = Report("sync")
    cases.blackout(1, report)
    case = "blackout 30 s"
    assert report.value(case, "shared trajectory", "median_cm") < 7
    assert report.value(case, "fixed gains, no prediction", "median_cm") > 20
    assert report.value(case, "constant twist", "median_cm") > 100, "a site without the plan cannot know"


def test_a_stop_is_flagged_and_never_smoothed_over() -> None:
    report = Report("sync")
    cases.stop(1, report)
    for before in ("0.5", "1", "2", "10"):
        assert report.value("stop in the gap", f"{before} s before its end", "flagged_percent") == 100
    assert report.value("stop in the gap", "1 s before its end", "snapped_percent") == 0
    assert report.value("stop in the gap", "10 s before its end", "snapped_percent") == 100


def test_the_bound() -> None:
    report = Report("sync")
    bounds.bound(30, report)
    for kept in ("violated_gaps", "speed_violated_gaps", "state_violated_gaps"):
        assert report.value("bound", "ā holds", kept) == 0
    assert 0 < report.value("bound", "ā holds", "largest_over_bound") <= 1
    assert report.value("bound", "ā holds", "state_over_position_bound") > 10, "it grows exponentially"
    assert report.value("bound", "three times ā, one way", "violated_gaps") == 3


def test_a_run_is_the_same_again() -> None:
    way = plan(Random(3), 12.0)
    first, second = (record(3, way, 10.0, LinkModel(delay_s=0.1, jitter_s=0.02, loss=0.05)) for _ in range(2))
    assert first.heard == second.heard and first.truth == second.truth
    assert 0.9 * first.sent < len(first.heard) < first.sent
    name = "shared trajectory"
    assert play(first, ways(first)[name]).twins == play(second, ways(second)[name]).twins


def test_without_recordings_it_says_so(tmp_path: Path) -> None:
    report = Report("sync")
    cases.recorded(tmp_path, report)
    assert any("missing" in note for note in report.notes)
