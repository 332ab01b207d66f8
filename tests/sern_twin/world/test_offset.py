"""How far off an object is between two worlds, finer than a cell."""

import math

import numpy as np
import pytest

pytest.importorskip("scipy", reason="the Python package scipy (extra twin) is not installed")

from sern_core.vocabulary.errors import UsageError
from sern_twin.world.grid import Grid
from sern_twin.world.offset import find, object_offset
from sern_twin.world.patches import Cells

FINE = Grid(-5.0, -5.0, 0.1, 100, 100)
COARSE = Grid(-5.0, -5.0, 0.2, 50, 50)


def box(grid: Grid, east_m: float, north_m: float, side_m: float = 1.0) -> Cells:
    """A box whose cells are occupied by the share that it covers of them."""
    centres = grid.all_centres()
    low = np.maximum(centres - grid.cell_m / 2, np.array([east_m, north_m]) - side_m / 2)
    high = np.minimum(centres + grid.cell_m / 2, np.array([east_m, north_m]) + side_m / 2)
    share = np.prod(np.maximum(high - low, 0) / grid.cell_m, axis=2)
    cells: Cells = np.rint(100 * share).astype(np.int8)
    return cells


@pytest.mark.parametrize("shift_m", [(0.0, 0.0), (0.3, 0.0), (0.03, -0.07), (-0.45, 0.22)])
def test_a_shift_is_found_finer_than_a_cell(shift_m: tuple[float, float]) -> None:
    first, second = box(FINE, 1.0, 2.0), box(COARSE, 1.0 + shift_m[0], 2.0 + shift_m[1])
    found = object_offset((FINE, first), (COARSE, second), (1.1, 1.9), 1.0, threshold=1)
    assert found is not None
    assert (found.east_m, found.north_m) == pytest.approx(shift_m, abs=0.002)
    assert found.distance_m == pytest.approx(math.hypot(*shift_m), abs=0.002)
    assert found.first.cells == 100


def test_the_nearest_of_several_is_meant() -> None:
    cells = np.maximum(box(FINE, -2.0, 0.0), box(FINE, 1.0, 0.0, 0.4))
    for place_m, middle_m in (((-1.8, 0.0), -2.0), ((0.5, 0.0), 1.0)):
        found = find(FINE, cells, place_m, 1.0)
        assert found is not None
        assert found.east_m == pytest.approx(middle_m)


def test_what_is_not_seen_has_no_offset() -> None:
    seen, nothing = box(FINE, 1.0, 2.0), np.full(FINE.shape, -1, np.int8)
    assert find(FINE, nothing, (1.0, 2.0), 1.0) is None
    assert find(FINE, seen, (3.0, 2.0), 1.0) is None, "it is too far away"
    for first, second in ((seen, nothing), (nothing, seen), (seen, box(FINE, 3.0, 2.0))):
        assert object_offset((FINE, first), (FINE, second), (1.0, 2.0), 1.0) is None
    assert find(FINE, np.minimum(seen, 60), (1.0, 2.0), 1.0) is None, "not occupied enough"


def test_a_wall_that_was_there_before_is_no_part_of_the_object() -> None:
    wall = np.full(FINE.shape, -1, np.int8)
    wall[:, 50:53] = 100
    cells = np.maximum(wall, box(FINE, 0.8, 0.0))
    merged, alone = find(FINE, cells, (0.8, 0.0), 0.3), find(FINE, cells, (0.8, 0.0), 0.3, before=wall)
    assert merged is None, "the middle of wall and object is elsewhere"
    assert alone is not None
    assert (alone.east_m, alone.north_m) == pytest.approx((0.8, 0.0))


def test_misuse_is_refused() -> None:
    cells = box(FINE, 1.0, 2.0)
    with pytest.raises(UsageError, match="a world: cells"):
        find(COARSE, cells, (1.0, 2.0), 1.0)
    for place_m, radius_m in (((math.nan, 0.0), 1.0), ((0.0, 0.0), 0.0), ((0.0, 0.0), math.inf)):
        with pytest.raises(UsageError, match="a radius above 0"):
            find(FINE, cells, place_m, radius_m)
    with pytest.raises(UsageError, match="1 to 100 per cent"):
        find(FINE, cells, (1.0, 2.0), 1.0, threshold=0)
    with pytest.raises(UsageError, match="give both in one"):
        object_offset((FINE, cells), (Grid(-5.0, -5.0, 0.1, 100, 100, frame_id="odom"), cells), (1.0, 2.0), 1.0)
