"""What is on the map where the twin and the scans differ."""

import numpy as np
import pytest

from sern_twin.world.correction import corrected, map_cells, twin_cells
from sern_twin.world.grid import Grid
from sern_twin.world.patches import CLEARED, FREE, LASTING, OCCUPIED, UNKNOWN, BlockKey, Cells
from sern_twin.world.scene import Outcome, Scene

GRID = Grid(0.0, 0.0, 0.1, 16, 16)


def cell(value: int) -> Cells:
    return np.array([[value]], np.int8)


@pytest.mark.parametrize(
    ("base", "live", "twin_only", "on_the_map"),
    [
        (UNKNOWN, UNKNOWN, UNKNOWN, UNKNOWN),
        (OCCUPIED, UNKNOWN, UNKNOWN, OCCUPIED),
        (OCCUPIED, FREE, UNKNOWN, FREE),
        (FREE, OCCUPIED, UNKNOWN, OCCUPIED),
        (FREE, FREE, OCCUPIED, OCCUPIED),
        (FREE, OCCUPIED, OCCUPIED, OCCUPIED),
        (FREE, CLEARED, OCCUPIED, FREE),
        (OCCUPIED, CLEARED, UNKNOWN, FREE),
        (FREE, CLEARED, LASTING, OCCUPIED),
        (LASTING, FREE, UNKNOWN, OCCUPIED),
        (LASTING, CLEARED, UNKNOWN, OCCUPIED),
        (FREE, UNKNOWN, LASTING, OCCUPIED),
        (UNKNOWN, 40, UNKNOWN, 40),
    ],
)
def test_what_is_seen_through_is_free_unless_nobody_can_see_it(
    base: int, live: int, twin_only: int, on_the_map: int
) -> None:
    assert map_cells(cell(base), cell(live), cell(twin_only)).item() == on_the_map


def test_the_twin_by_itself_is_what_was_added_over_the_map() -> None:
    assert [twin_cells(cell(OCCUPIED), cell(value)).item() for value in (UNKNOWN, FREE, LASTING)] == [100, 0, LASTING]


def test_a_correction_goes_into_what_is_seen() -> None:
    seen = np.array([[UNKNOWN, FREE, OCCUPIED], [UNKNOWN, FREE, OCCUPIED], [UNKNOWN, FREE, OCCUPIED]], np.int8)
    before = seen.copy()
    correction = np.array([[UNKNOWN] * 3, [FREE] * 3, [OCCUPIED] * 3], np.int8)
    found = corrected(seen, correction)
    assert found.tolist() == [[UNKNOWN, FREE, OCCUPIED], [CLEARED] * 3, [OCCUPIED] * 3]
    assert np.array_equal(seen, before)


@pytest.mark.parametrize(
    ("first", "then", "together"),
    [
        (CLEARED, FREE, CLEARED),
        (FREE, CLEARED, CLEARED),
        (CLEARED, OCCUPIED, OCCUPIED),
        (OCCUPIED, CLEARED, CLEARED),
        (CLEARED, UNKNOWN, CLEARED),
    ],
)
def test_of_two_robots_the_newer_one_counts_and_free_is_no_objection(first: int, then: int, together: int) -> None:
    one, other = Scene(GRID, "one"), Scene(GRID, "other")
    for scene, value, told in ((one, first, other), (other, then, one)):
        scene.set_cells("live", np.full(GRID.shape, value, np.int8))
        for key in scene.publish():
            assert told.apply(scene.encode_block(key)) is Outcome.TAKEN
    for scene in (one, other):
        assert (scene.merged("live") == together).all()
    if then != UNKNOWN:
        other.withdraw(BlockKey("one", "live", 0))
        assert (other.merged("live") == then).all(), "it is gone with its writer"
