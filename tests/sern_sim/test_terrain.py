"""Ground with hills: what it refuses, how high it is, and where a robot cannot be."""

import math
from random import Random

import numpy as np
import pytest

from sern_sim.terrain import BRIDGE_WIDTH_M, DITCH_DEPTH_M, DITCH_X_M, FREE_RADIUS_M, HALF_SIZE_M, Label, Terrain
from tests.exploring import seeds


@pytest.mark.parametrize(
    ("heights", "said"),
    [
        (np.zeros((3, 4)), r"\(n, n\)"),
        (np.zeros(9), r"\(n, n\)"),
        (np.zeros((1, 1)), "from 2"),
        (np.zeros((1002, 1002)), "to 1001"),
        (np.full((5, 5), math.nan), "finite"),
        (np.full((5, 5), math.inf), "finite"),
        (np.array([[0.0, 0.0], [0.0, 100.0]]), "steeper than 2 in 1"),
    ],
)
def test_heights_that_are_no_ground_are_refused(heights: np.ndarray, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        Terrain(heights)
    with pytest.raises(ValueError, match=said):
        Terrain.of_heights(heights, Random(0))


@pytest.mark.parametrize("size_m", [math.nan, math.inf, 0.0, -20.0, 5.0])
def test_a_size_that_is_none_is_refused(size_m: float) -> None:
    with pytest.raises(ValueError, match="reaches more than"):
        Terrain(np.zeros((5, 5)), half_size_m=size_m)


def test_a_height_is_between_those_around_it() -> None:
    heights = np.array([[0.0, 4.0], [2.0, 10.0]])
    ground = Terrain(heights)
    assert [ground.height_m(x, y) for x, y in ((-20, -20), (20, -20), (-20, 20), (20, 20))] == [0.0, 4.0, 2.0, 10.0]
    assert ground.height_m(0.0, 0.0) == 4.0
    assert ground.height_m(99.0, 99.0) == 10.0


def test_heights_that_were_handed_in_are_its_own() -> None:
    heights = np.zeros((5, 5))
    ground = Terrain(heights)
    heights[:] = 7.0
    assert ground.height_m(0.0, 0.0) == 0.0


@pytest.mark.parametrize("seed", seeds(6))
def test_hills_leave_the_middle_free_and_have_what_a_robot_may_meet(seed: int) -> None:
    ground = Terrain.hills(Random(seed))
    again = Terrain.hills(Random(seed))
    assert np.array_equal(ground.heights_m, again.heights_m) and ground.blocks == again.blocks
    count = {label: sum(block.label is label for block in ground.blocks) for label in Label}
    assert (count[Label.CAR], count[Label.BRIDGE], count[Label.LOG], count[Label.OTHER]) == (2, 1, 3, 4)
    cells = 200
    grid = ground.occupancy(cells)
    axis = (np.arange(cells) + 0.5) / cells * 2 * HALF_SIZE_M - HALF_SIZE_M
    x, y = np.meshgrid(axis, axis)
    assert not grid[np.hypot(x, y) < FREE_RADIUS_M].any()
    assert grid[0].all() and grid[-1].all() and grid[:, 0].all() and grid[:, -1].all()
    on_bridge = (np.abs(x - DITCH_X_M) < 0.9) & (np.abs(y) < BRIDGE_WIDTH_M / 2)
    beside = (np.abs(np.abs(x - DITCH_X_M) - 0.65) < 0.1) & (np.abs(y) > 1.0)
    assert not grid[on_bridge].any() and grid[beside].all()
    assert ground.height_m(DITCH_X_M, 3.0) == pytest.approx(-DITCH_DEPTH_M, abs=0.01)


def test_ground_that_is_handed_in_has_no_ditch_and_no_bridge() -> None:
    ground = Terrain.of_heights(np.full((11, 11), 3.0), Random(1))
    assert {block.label for block in ground.blocks} == {Label.CAR, Label.LOG, Label.OTHER}
    assert all(block.z_m > 3.0 for block in ground.blocks if block.label is not Label.OTHER)
