"""How starts of the window are reckoned."""

import pytest

from benchmarks.window import cases, link, play, summary


def test_the_worst_is_the_least_of_what_is_to_be_much() -> None:
    row = summary([{"over_ms": 3.0, "share_percent": 90.0}, {"over_ms": 5.0, "share_percent": 80.0}])
    assert row == {"over_ms": 4.0, "over_worst_ms": 5.0, "share_percent": 85.0, "share_worst_percent": 80.0}


def test_a_full_link_without_jitter_is_full_and_its_poses_wait_for_little() -> None:
    found = play(link(8e6, 0.0), 5.0, 8.0, 1)
    assert found["share_percent"] == pytest.approx(99, abs=2) and 0 < found["over_ms"] < 10


def test_every_case_says_its_path() -> None:
    names = list(cases())
    assert len(names) == len(set(names)) > 20 and all("±" in name for name in names)
