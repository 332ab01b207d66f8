"""Which cells a ray goes through, what a scan and a cloud say, and readings that say nothing."""

import math
from random import Random

import numpy as np
import pytest

from sern_core.vocabulary.errors import UsageError
from sern_twin.world.grid import Grid
from sern_twin.world.occupancy import MOST_BEAMS, Ignored, Occupancy, OccupancyOptions
from sern_twin.world.rays import crossed

GRID = Grid(-5.0, -4.0, 0.25, 40, 32)


def goes_through(start: tuple[float, float], end: tuple[float, float], low: tuple[float, float], size: float) -> float:
    """How much of a ray, as a share, lies in a square (Liang and Barsky), 0 for a touch."""
    begin, stop = 0.0, 1.0
    for axis in (0, 1):
        along = end[axis] - start[axis]
        if along == 0:
            if not low[axis] <= start[axis] <= low[axis] + size:
                return -1.0
            continue
        bounds = sorted([(low[axis] - start[axis]) / along, (low[axis] + size - start[axis]) / along])
        begin, stop = max(begin, bounds[0]), min(stop, bounds[1])
    return stop - begin


@pytest.mark.parametrize("seed", range(4))
def test_a_ray_goes_through_the_cells_that_it_cuts(seed: int) -> None:
    random = Random(seed)
    for _ in range(25):
        start = random.uniform(-7, 7), random.uniform(-6, 6)
        end = random.uniform(-7, 7), random.uniform(-6, 6)
        found = crossed(GRID, np.array(start), np.array([end]))
        for (row, column), seen in np.ndenumerate(found):
            low = GRID.west_m + column * GRID.cell_m, GRID.south_m + row * GRID.cell_m
            share = goes_through(start, end, low, GRID.cell_m)
            if abs(share) > 1e-9:
                assert seen == (share > 0), (start, end, row, column)


@pytest.mark.parametrize("end", [(3.1, 0.1), (-3.1, 0.1), (0.1, 3.1), (0.1, -3.1), (0.1, 0.1), (90.0, 0.1)])
def test_rays_along_the_axes_and_of_no_length(end: tuple[float, float]) -> None:
    found = crossed(GRID, np.array([0.1, 0.1]), np.array([end]))
    rows, columns = np.nonzero(found)
    reach = min(end[0], 4.9) if end[0] != 0.1 else end[1]
    assert len(rows) == abs(math.floor(reach / 0.25) - math.floor(0.1 / 0.25)) + 1
    assert len({*rows.tolist()}) == 1 or len({*columns.tolist()}) == 1


def test_many_rays_over_a_long_grid_are_the_same_as_each_alone() -> None:
    grid = Grid(0.0, 0.0, 1.0, 2000, 50)
    random = np.random.default_rng(2)
    ends = random.uniform((0, 0), (2000, 50), (1500, 2))
    together = crossed(grid, np.array([1000.0, 25.0]), ends)
    alone = np.zeros(grid.shape, np.bool_)
    for end in ends:
        alone |= crossed(grid, np.array([1000.0, 25.0]), end[None])
    assert (together == alone).all()


def test_a_scan_frees_its_rays_and_fills_their_ends() -> None:
    world = Occupancy(GRID)
    for _ in range(15):
        seen = world.fuse((0.1, 0.1, math.pi / 2), [0.0, -math.pi / 2], [2.0, math.inf], 3.0)
    assert seen.cells == 7 + 1 + 12, "just before its end a ray says nothing"
    classes = world.classes()
    assert classes[24, 20] == 100, "2 m to the north"
    assert (classes[16:23, 20] == 0).all() and classes[23, 20] == -1
    assert (classes[16, 20:33] == 0).all(), "nothing is there up to 3 m to the east"
    assert np.count_nonzero(classes != -1) == seen.cells
    cells = world.cells()
    assert (cells[24, 20], cells[20, 20], cells[0, 0]) == (97, 12, -1), "clamped"
    assert world.probabilities()[24, 20] == pytest.approx(0.97)
    assert math.isnan(world.probabilities()[0, 0])


def test_an_obstacle_that_goes_is_forgotten_and_a_single_reading_turns_nothing() -> None:
    world = Occupancy(GRID)
    for _ in range(20):
        world.fuse((0.1, 0.1, 0.0), [0.0], [2.0], 3.0)
    assert world.classes()[16, 28] == 100
    classes = []
    for _ in range(27):
        world.fuse((0.1, 0.1, 0.0), [0.0], [math.inf], 3.0)
        classes.append(int(world.classes()[16, 28]))
    assert classes[0] == 100 and classes[-1] == 0
    assert classes == sorted(classes, reverse=True), "once from occupied to free, with nothing between"


def test_what_ends_where_another_ray_passes_is_occupied() -> None:
    world = Occupancy(GRID)
    world.fuse((0.1, 0.1, 0.0), [0.0, 0.0], [1.0, 2.0], 3.0)
    assert world.cells()[16, [20, 24, 28]].tolist() == [45, 70, 70]


def test_readings_that_say_nothing_are_counted() -> None:
    world = Occupancy(GRID)
    angles = [0.0, 0.0, 0.0, 0.0, 0.0, math.nan, math.inf, 1e300]
    ranges = [math.nan, -1.0, -math.inf, 0.01, 3.1, 1.0, 1.0, 1.0]
    assert world.fuse((0.0, 0.0, 0.0), angles, ranges, 3.0, range_min_m=0.05).cells == 0
    counted = {reason: count for reason, count in world.ignored.items() if count}
    assert counted == {
        Ignored.NAN: 1, Ignored.NEGATIVE: 2, Ignored.TOO_NEAR: 1, Ignored.TOO_FAR: 1, Ignored.ANGLE: 3,
    }  # fmt: skip
    for pose in ((math.nan, 0.0, 0.0), (0.0, math.inf, 0.0), (0.0, 0.0, math.nan), (1e300, 0.0, 0.0)):
        assert world.fuse(pose, [0.0, 1.0], [1.0, 1.0], 3.0).cells == 0
    assert world.ignored[Ignored.POSE] == 8
    assert (world.cells() == -1).all()
    assert world.fuse((0.0, 0.0, 0.0), [], [], 3.0).cells == 0


def test_a_scanner_outside_the_grid_sees_what_is_on_it() -> None:
    world = Occupancy(GRID)
    assert world.fuse((-6.0, 0.1, 0.0), [0.0, math.pi], [3.0, 3.0], 10.0).cells == 8
    assert world.cells()[16, 8] == 70
    assert world.fuse((-60.0, 0.1, 0.0), [0.0], [3.0], 10.0).cells == 0


def test_a_scan_that_is_none_is_refused() -> None:
    world = Occupancy(GRID)
    for angles, ranges in (([0.0], [1.0, 2.0]), ([[0.0]], [[1.0]]), (np.zeros(MOST_BEAMS + 1),) * 2):
        with pytest.raises(UsageError, match="as many of each"):
            world.fuse((0.0, 0.0, 0.0), angles, ranges, 3.0)
    for least_m, most_m in ((0.0, 0.0), (1.0, 0.5), (0.0, math.inf), (0.0, math.nan), (-1.0, 3.0)):
        with pytest.raises(UsageError, match="0 <= range_min < range_max"):
            world.fuse((0.0, 0.0, 0.0), [0.0], [1.0], most_m, range_min_m=least_m)


def test_a_cloud_fills_what_stands_on_the_ground() -> None:
    world = Occupancy(GRID)
    points = [
        (0.1, 0.1, 10.02), (1.1, 0.1, 10.5), (1.1, 0.1, 10.9), (1.1, 0.1, 10.0),  # ground; a thing on the ground
        (2.1, 0.1, 13.0), (3.1, 0.1, 9.0), (90.0, 0.1, 10.5), (math.nan, 0.1, 10.5), (0.1, 0.1, math.inf),
    ]  # fmt: skip
    for _ in range(9):
        assert world.fuse_points(points, ground_m=10.0).cells == 2
    classes = world.classes()
    assert (classes[16, 20], classes[16, 24]) == (0, 100)
    assert np.count_nonzero(classes != -1) == 2
    assert world.tops_m()[16, 24] == pytest.approx(0.9)
    assert np.count_nonzero(np.isfinite(world.tops_m())) == 1
    counted = {reason: count for reason, count in world.ignored.items() if count}
    assert counted == {Ignored.ABOVE: 9, Ignored.BELOW: 9, Ignored.OUTSIDE: 9, Ignored.NAN: 18}


def test_the_ground_of_a_cloud_may_differ_and_be_unknown() -> None:
    world = Occupancy(GRID)
    points = [(0.1, 0.1, 10.5), (1.1, 0.1, 20.0), (2.1, 0.1, 0.0)]
    assert world.fuse_points(points, ground_m=[10.0, 20.0, math.nan]).cells == 2
    assert world.cells()[16, [20, 24, 28]].tolist() == [70, 45, -1]
    assert world.ignored[Ignored.NAN] == 1
    assert world.fuse_points(np.empty((0, 3))).cells == 0
    assert world.fuse_points([(0.1, 0.1, 1e308), (0.1, 0.1, math.inf)], ground_m=[-1e308, math.inf]).cells == 0
    with pytest.raises(UsageError, match=r"a ground of \(2,\) below 3 points"):
        world.fuse_points(points, ground_m=[1.0, 2.0])
    with pytest.raises(UsageError, match="a row of x, y, z"):
        world.fuse_points([[0.0, 0.0]])
    with pytest.raises(UsageError, match="0 < low < high"):
        world.fuse_points(points, low_m=2.0, high_m=1.0)


@pytest.mark.parametrize("change", [{"hit": 0.4}, {"miss": 0.6}, {"least": 0.5}, {"most": 1.0}, {"hit": math.nan}])
def test_probabilities_that_turn_nothing_are_refused(change: dict[str, float]) -> None:
    with pytest.raises(UsageError, match="0 < least < miss"):
        OccupancyOptions(**change)


@pytest.mark.parametrize("change", [{"free": 0.1}, {"occupied": 0.98}, {"free": 0.95}])
def test_classes_that_are_never_reached_are_refused(change: dict[str, float]) -> None:
    with pytest.raises(UsageError, match="least < free < occupied < most"):
        OccupancyOptions(**change)
