"""Levels of detail, against the paper's algorithm written out block by block, and in time."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("scipy", reason="the Python package scipy (extra twin) is not installed")

from sern_core.vocabulary.errors import UsageError
from sern_twin.detail import DetailOptions, Level, LevelOfDetail, proximity_m

OPTIONS = DetailOptions(near_m=3.0, far_m=5.0, dwell_s=0.0)


def region(shape: tuple[int, int], *blocks: tuple[int, int]) -> NDArray[np.bool_]:
    found = np.zeros(shape, np.bool_)
    for block in blocks:
        found[block] = True
    return found


def literal(important: NDArray[np.bool_], before: NDArray[np.int8], block_m: float) -> NDArray[np.int8]:
    """Algorithm lod_hyst, one block after the other."""
    levels = before.copy()
    inside = [tuple(block) for block in np.argwhere(important)]
    for block in np.ndindex(important.shape):
        distance_m = min((math.dist(block, other) * block_m for other in inside), default=math.inf)
        if important[block]:
            levels[block] = Level.HIGH
        elif distance_m < OPTIONS.near_m or (distance_m < OPTIONS.far_m and before[block] != Level.LOW):
            levels[block] = Level.MEDIUM
        else:
            levels[block] = Level.LOW
    return levels


def test_without_dwell_it_is_the_algorithm() -> None:
    random = np.random.default_rng(5)
    detail = LevelOfDetail((9, 7), 0.9, OPTIONS)
    wanted = detail.levels
    seen: set[int] = set()
    for now in range(60):
        important = random.random((9, 7)) < random.choice([0.0, 0.02, 0.1])
        before, wanted = wanted, literal(important, wanted, 0.9)
        changed = detail.update(important, now=now)
        assert (detail.levels == wanted).all()
        assert (changed == (wanted != before)).all()
        seen |= {*wanted.flat}
    assert seen == {*Level}, "and no grid was all there is to it"


def test_nothing_important_is_infinitely_far() -> None:
    assert np.isinf(proximity_m(region((2, 3)), 1.0)).all()
    detail = LevelOfDetail((2, 3), 1.0, OPTIONS)
    assert not detail.update(region((2, 3)), now=0.0).any()
    assert (detail.levels == Level.LOW).all()


def test_finer_at_once_and_coarser_after_the_dwell() -> None:
    detail = LevelOfDetail((1, 2), 1.0, DetailOptions(near_m=1.5, far_m=2.5, dwell_s=0.5))
    edge, nothing = region((1, 2), (0, 0)), region((1, 2))
    assert detail.update(edge, now=0.0).tolist() == [[True, True]]
    assert detail.levels.tolist() == [[Level.HIGH, Level.MEDIUM]]
    for now in (0.1, 0.3, 0.5):
        assert not detail.update(nothing, now=now).any(), "due since 0.1"
    assert not detail.update(edge, now=0.55).any(), "due no more"
    for now in (0.6, 1.0):
        assert not detail.update(nothing, now=now).any()
    assert detail.update(nothing, now=1.1).all()
    assert (detail.levels == Level.LOW).all()


def test_the_edge_of_the_region_does_not_flicker() -> None:
    """A region that comes and goes ten times a second leaves the block at one level."""
    detail = LevelOfDetail((1, 3), 1.0, DetailOptions(near_m=1.5, far_m=2.5))
    changes = 0
    for step in range(100):
        changes += int(detail.update(region((1, 3), (0, step % 2)), now=step * 0.1).sum())
    assert changes == 4, "each block once, and the one that was outside at first once more"


def test_a_clock_that_goes_back() -> None:
    """It makes nothing coarser before its time."""
    detail = LevelOfDetail((1, 1), 1.0, DetailOptions(near_m=1.0, far_m=2.0, dwell_s=0.5))
    detail.update(region((1, 1), (0, 0)), now=100.0)
    for now in (100.1, 3.0, 3.4):
        assert not detail.update(region((1, 1)), now=now).any()
    assert detail.update(region((1, 1)), now=3.6).all()


@pytest.mark.parametrize(
    ("near_m", "far_m", "dwell_s"), [(0.0, 1.0, 0.5), (2.0, 2.0, 0.5), (1.0, 2.0, -0.1), (math.nan, 2.0, 0.5)]
)
def test_options_that_cannot_be(near_m: float, far_m: float, dwell_s: float) -> None:
    with pytest.raises(UsageError, match="levels of detail"):
        DetailOptions(near_m, far_m, dwell_s)


def test_another_grid_or_no_blocks() -> None:
    with pytest.raises(UsageError, match=r"\(2, 2\) blocks for a grid of \(2, 3\)"):
        LevelOfDetail((2, 3), 1.0, OPTIONS).update(region((2, 2)), now=0.0)
    with pytest.raises(UsageError, match="blocks of 0"):
        LevelOfDetail((2, 3), 0.0, OPTIONS)
