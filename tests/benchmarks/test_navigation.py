"""What the benchmark of navigation says of paired runs, and the campuses that it drives on."""

from concurrent.futures import Future, ProcessPoolExecutor
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from benchmarks.common import Report
from benchmarks.navigation import episode
from benchmarks.navigation.campus import GRID, cells_of
from benchmarks.navigation.campus import campus as campus_of
from benchmarks.navigation.drives import Drive, Drives, accuracies, links
from benchmarks.navigation.episode import PROFILES, LinkProfile, Mode, Result
from benchmarks.navigation.statistics import mcnemar, wilson
from sern_core.vocabulary.errors import ConfigError
from sern_tools.checkout import commit
from sern_twin.world.patches import OCCUPIED


def test_the_interval_of_a_share_is_wilsons() -> None:
    """Of 20 of 25: Brown, Cai and DasGupta (2001) have 0.609 to 0.911."""
    assert wilson(20, 25) == pytest.approx((0.6087, 0.9114), abs=1e-3)
    assert wilson(0, 10)[0] == 0.0 and wilson(10, 10)[1] == pytest.approx(1.0)
    assert wilson(0, 0) == (0.0, 1.0)


def test_pairs_that_agree_say_nothing_and_many_that_differ_one_way_do() -> None:
    both = [True, False] * 20
    assert mcnemar(both, both) == 1.0
    better, worse = [True] * 10 + both, [False] * 10 + both
    assert mcnemar(better, worse) == mcnemar(worse, better) == pytest.approx(2 / 2**10)
    assert mcnemar([True, False], [False, True]) == 1.0


def test_a_campus_is_the_same_for_one_seed_and_its_start_and_goal_are_free() -> None:
    one, same, other = campus_of(3), campus_of(3), campus_of(4)
    assert one == same and one != other
    real = cells_of(one.real)
    for place in (one.start_m, one.goal_m):
        row, column = (int(number) for number in GRID.index(np.array(place)))
        assert (real[row - 4 : row + 5, column - 4 : column + 5] != OCCUPIED).all()
    assert one.shortest_m >= np.hypot(*np.subtract(one.start_m, one.goal_m)) - 1e-6


def test_a_twin_that_is_all_right_is_the_world_and_one_that_is_all_wrong_has_nothing_of_it() -> None:
    found = campus_of(5)
    right, wrong = found.twin(1.0), found.twin(0.0)
    real = cells_of(found.real) == OCCUPIED
    assert (right[real] == OCCUPIED).all()
    phantoms = cells_of(found.phantoms) == OCCUPIED
    assert (wrong[phantoms] == OCCUPIED).all() and not (wrong[real & ~phantoms] == OCCUPIED).any()
    half = found.twin(0.5) == OCCUPIED
    assert 0 < (half & real).sum() < real.sum()


def test_what_a_link_that_is_gone_brings_is_from_before() -> None:
    gone = LinkProfile("gone", 0.1, 5.0, 20.0)
    assert gone.stamp_s(19.9) == pytest.approx(19.8)
    assert gone.stamp_s(24.9) == pytest.approx(19.9)
    assert gone.stamp_s(25.0) == pytest.approx(24.9)
    assert all(profile.stamp_s(59.0) <= 59.0 for profile in PROFILES)


def test_success_is_weighted_by_the_way_that_it_took() -> None:
    def result(*, reached: bool, travelled_m: float) -> Result:
        return Result(1, Mode.SERN, reached, 50.0, travelled_m, 30.0, 0, 0, "")

    assert result(reached=True, travelled_m=60.0).spl == 0.5
    assert result(reached=True, travelled_m=29.0).spl == 1.0, "a smoothed way may be a little shorter than the cells'"
    assert result(reached=False, travelled_m=30.0).spl == 0.0


class Pool:
    """Drives at once, without a robot."""

    def __init__(self) -> None:
        self.driven: list[Drive] = []

    def submit(self, _driven: object, one: Drive) -> "Future[Result]":
        self.driven.append(one)
        future: Future[Result] = Future()
        future.set_result(Result(one.seed, one.mode, one.seed % 2 == 0, 50.0, 30.0, 30.0, 0, 0, "succeeded none"))
        return future


def known(pool: Pool, kept: Path | None = None) -> Drives:
    return Drives(cast("ProcessPoolExecutor", pool), kept)


def test_a_drive_that_several_tables_want_is_driven_once() -> None:
    pool = Pool()
    drives, report = known(pool), Report("navigation")
    links(4, report, drives)
    accuracies(4, report, drives)
    asked = [one for one in pool.driven if one.mode is Mode.SERN and one.accuracy == 0.9 and one.link is PROFILES[0]]
    assert len(pool.driven) == len(set(pool.driven)) == 4 * (1 + 4 + 5) and len(asked) == 4
    rows = [row for row in report.rows if row.system == "100% right"]
    assert [row.metrics["success_percent"] for row in rows] == [50.0]


def test_what_was_driven_before_is_not_driven_again(tmp_path: Path) -> None:
    kept, asked = tmp_path / "drives.jsonl", [Drive(seed, Mode.SERN, 0.5, PROFILES[2]) for seed in range(3)]
    first = known(Pool(), kept).results(asked[:2])
    pool = Pool()
    again = known(pool, kept)
    assert again.results(asked)[:2] == first and pool.driven == asked[2:]
    assert len(kept.read_text().splitlines()) == 3 and again.commits == {commit()}


def test_a_file_that_has_other_lines_is_refused_by_its_line(tmp_path: Path) -> None:
    kept = tmp_path / "drives.jsonl"
    known(Pool(), kept).results([Drive(1, Mode.SERN)])
    kept.write_text(kept.read_text() + '{"seed": 2}\n')
    with pytest.raises(ConfigError, match="line 2 is no drive"):
        known(Pool(), kept)


def test_a_link_that_is_gone_for_good_brings_nothing_new() -> None:
    dies = LinkProfile("dies", 0.1, dies_s=20.0)
    assert [dies.stamp_s(now_s) for now_s in (5.0, 20.0, 99.0)] == pytest.approx([4.9, 19.9, 19.9])


def test_a_link_that_is_late_and_never_stale_changes_no_drive(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its drives are those of the first profile."""
    found, (first, late, *gone) = campus_of(3), PROFILES
    assert late.always_fresh and not any(link.always_fresh for link in gone)
    monkeypatch.setattr(episode, "MOST_S", 4.0)
    assert episode.drive(3, found, Mode.SERN, link=first) == episode.drive(3, found, Mode.SERN, link=late)
