"""What the benchmark of navigation says of paired runs, and the campuses that it drives on."""

import numpy as np
import pytest

from benchmarks.navigation.campus import GRID, cells_of
from benchmarks.navigation.campus import campus as campus_of
from benchmarks.navigation.episode import PROFILES, LinkProfile, Mode, Result
from benchmarks.navigation.statistics import mcnemar, wilson
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
