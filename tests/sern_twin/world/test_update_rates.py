"""How often each block of a scene is told."""

import math

import numpy as np
import pytest

from sern_core.vocabulary.errors import UsageError
from sern_twin.detail import Level
from sern_twin.world.grid import Grid
from sern_twin.world.patches import OCCUPIED
from sern_twin.world.scene import Scene
from sern_twin.world.update_rates import UpdateRateOptions, UpdateRates

GRID = Grid(0.0, 0.0, 0.5, 160, 16, block_cells=8)
"""20 blocks of 4 m in a row from west to east, in two rows."""
OPTIONS = UpdateRateOptions(important_m=8.0, near_m=8.0, far_m=12.0, medium_s=0.5, low_s=2.0)
NOTHING = np.zeros(GRID.shape, np.bool_)


def row(rates: UpdateRates) -> list[int]:
    """The levels of the southern row, from west to east."""
    return [int(level) for level in rates.levels[:20]]


def test_levels_fall_with_the_distance_from_the_robot() -> None:
    rates = UpdateRates(GRID, OPTIONS)
    rates.look([(2.0, 2.0)], NOTHING, now=0.0)
    high, medium, low = Level.HIGH, Level.MEDIUM, Level.LOW
    assert row(rates) == [high] * 3 + [medium] + [low] * 16, "4 m from the last important one; 8 is not below 8"


def test_where_somebody_added_something_is_important_too() -> None:
    rates = UpdateRates(GRID, OPTIONS)
    added = NOTHING.copy()
    added[3, 100] = True
    rates.look([], added, now=0.0)
    assert row(rates)[12] == Level.HIGH and row(rates)[11] == row(rates)[13] == Level.MEDIUM
    assert row(rates).count(Level.HIGH) == 1


def test_a_block_is_due_as_often_as_its_level_says() -> None:
    rates = UpdateRates(GRID, OPTIONS)
    rates.look([(2.0, 2.0)], NOTHING, now=0.0)
    assert rates.due(0.0).all(), "what was never told is"
    for block in range(20):
        rates.told(block, 10.0)
    assert np.flatnonzero(rates.due(10.1)[:20]).tolist() == [0, 1, 2]
    assert np.flatnonzero(rates.due(10.5)[:20]).tolist() == [0, 1, 2, 3]
    assert rates.due(12.0).all()


def test_a_scene_tells_far_blocks_less_often_and_loses_no_change() -> None:
    """All of the world changes ten times a second for ten seconds, and stands still then."""
    scene, rates = Scene(GRID, "robot"), UpdateRates(GRID, OPTIONS)
    other = Scene(GRID, "site")
    cells = np.full(GRID.shape, -1, np.int8)
    told = np.zeros(GRID.blocks, np.int64)
    for step in range(130):
        now = 0.1 * step
        if step < 100:
            cells[:] = step % 2 * OCCUPIED
            scene.set_cells("live", cells)
        rates.look([(2.0, 2.0)], NOTHING, now=now)
        for key in scene.publish({"live": rates.due(now + 1e-9)}):
            rates.told(key.block, now)
            told[key.block] += 1
            other.apply(scene.encode_block(key))
    assert told[0] == 100 and 18 <= told[3] <= 22 and 5 <= told[10] <= 7
    assert np.array_equal(other.merged("live"), cells), "the last change of each block came"


@pytest.mark.parametrize(
    "wrong",
    [{"near_m": 12.0}, {"near_m": 0.0}, {"important_m": -1.0}, {"medium_s": math.nan}, {"low_s": math.inf}],
    ids=str,
)
def test_rates_that_are_none(wrong: dict[str, float]) -> None:
    with pytest.raises(UsageError):
        UpdateRateOptions(**wrong)
