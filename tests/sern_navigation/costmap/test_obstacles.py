"""What real scans mark and clear, with heights, and what they do not see."""

import math

import numpy as np
import pytest

from sern_core.vocabulary.errors import UsageError
from sern_navigation.costmap.costs import FREE_SPACE, LETHAL_OBSTACLE, NO_INFORMATION, whole
from sern_navigation.costmap.obstacles import ObstacleLayer, ObstacleOptions
from sern_navigation.scan import Cloud, ObstacleScan, ScanOptions, obstacle_scan
from sern_twin.world.grid import Floats, Grid
from tests.sern_navigation.worlds import Heights, level, looking_at

GRID = Grid(-6.0, -6.0, 0.1, 120, 120)
FAR = ObstacleOptions(obstacle_max_range=5.0, raytrace_max_range=5.5)


def scan_of(ground: Heights) -> ObstacleScan:
    found = obstacle_scan(Cloud(looking_at(ground), 0.0), ScanOptions())
    assert isinstance(found, ObstacleScan)
    return found


def thing(east_m: float, height_m: float) -> Heights:
    """A wall 1 m long across the way, 0.3 m thick."""

    def ground(x: Floats, y: Floats) -> Floats:
        return np.where((x > east_m) & (x < east_m + 0.3) & (np.abs(y) < 0.5), height_m, 0.0)

    return ground


def cost(layer: ObstacleLayer, x_m: float, y_m: float) -> int:
    row, column = GRID.index(np.array([x_m, y_m]))
    return int(layer.costs(whole(GRID))[row, column])


def marked(layer: ObstacleLayer, x_m: float, y_m: float) -> bool:
    row, column = GRID.index(np.array([x_m, y_m]))
    return bool(layer.lethal[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2].any())


def test_a_scan_marks_what_stands_and_frees_what_is_seen() -> None:
    layer = ObstacleLayer(GRID, FAR)
    assert (layer.costs(whole(GRID)) == NO_INFORMATION).all()
    layer.observe((0.0, 0.0, 0.0), scan_of(thing(2.0, 1.0)))
    assert marked(layer, 2.05, 0.0) and cost(layer, 1.5, 0.0) == FREE_SPACE and cost(layer, -3.0, 0.0) == FREE_SPACE
    assert cost(layer, 3.5, 0.0) == NO_INFORMATION, "behind it"
    assert cost(layer, 5.9, 5.9) == NO_INFORMATION, "beyond the range"
    assert not (layer.lethal & layer.seen_free).any()


@pytest.mark.parametrize("yaw_rad", [0.0, 1.0, math.pi, -2.5])
def test_places_are_the_robots_turned_and_moved(yaw_rad: float) -> None:
    layer = ObstacleLayer(GRID, FAR)
    layer.observe((1.0, -2.0, yaw_rad), scan_of(thing(2.0, 1.0)))
    assert marked(layer, 1.0 + 2.05 * math.cos(yaw_rad), -2.0 + 2.05 * math.sin(yaw_rad))
    assert not marked(layer, 1.0 - 2.05 * math.cos(yaw_rad), -2.0 - 2.05 * math.sin(yaw_rad))


def test_only_what_is_near_is_marked_and_cleared() -> None:
    """With Nav2's ranges: marks to 2.5 m, clears to 3 m."""
    layer = ObstacleLayer(GRID)
    layer.observe((0.0, 0.0, 0.0), scan_of(thing(2.7, 1.0)))
    assert not layer.lethal.any()
    far = ObstacleLayer(GRID, ObstacleOptions(obstacle_max_range=4.0, raytrace_max_range=3.0))
    far.observe((0.0, 0.0, 0.0), scan_of(thing(3.5, 1.0)))
    far.observe((0.0, 0.0, 0.0), scan_of(level))
    assert marked(far, 3.55, 0.0), "beyond the rays' range"


def test_what_goes_is_cleared_by_what_is_seen_behind_it() -> None:
    layer = ObstacleLayer(GRID, FAR)
    layer.observe((0.0, 0.0, 0.0), scan_of(thing(2.0, 1.0)))
    layer.observe((0.0, 0.0, 0.0), scan_of(level))
    assert not layer.lethal.any() and cost(layer, 2.05, 0.0) == FREE_SPACE


def test_what_is_below_all_rays_stays() -> None:
    """A log of 16 cm at 2 m is seen; at 0.5 m the lowest ray passes 27 cm above the ground."""
    layer = ObstacleLayer(GRID, FAR)
    layer.observe((0.0, 0.0, 0.0), scan_of(thing(2.0, 0.16)))
    assert marked(layer, 2.05, 0.0)
    nearer = scan_of(thing(0.5, 0.16))
    assert not np.isfinite(nearer.ranges_m[180]), "it is not seen from here"
    for _ in range(5):
        layer.observe((1.5, 0.0, 0.0), nearer)
    assert marked(layer, 2.05, 0.0)
    layer.observe((-1.0, 0.0, 0.0), scan_of(level))
    assert not marked(layer, 2.05, 0.0), "from further away one sees that it is gone"


def test_something_tall_that_was_near_is_cleared_by_rays_above_the_ground() -> None:
    """A person walks by at 0.8 m: the rays that pass there afterwards would have met them."""
    layer = ObstacleLayer(GRID, FAR)
    layer.observe((0.0, 0.0, 0.0), scan_of(thing(0.8, 1.7)))
    assert marked(layer, 0.85, 0.0)
    layer.observe((0.0, 0.0, 0.0), scan_of(level))
    assert not layer.lethal.any()


def test_an_edge_is_lethal_and_stays_while_one_looks_over_it() -> None:
    layer = ObstacleLayer(GRID, FAR)
    ditch = scan_of(lambda x, y: np.where((x > 2.0) & (x < 4.0), -2.0, 0.0))
    for _ in range(3):
        layer.observe((0.0, 0.0, 0.0), ditch)
    edge = [x_m for x_m in np.arange(1.5, 2.5, 0.1) if marked(layer, float(x_m), 0.0)]
    assert edge and cost(layer, 1.2, 0.0) == FREE_SPACE
    assert cost(layer, 3.0, 0.0) != FREE_SPACE, "nobody saw ground in the ditch"


def test_an_edge_stays_until_ground_is_seen_in_its_place() -> None:
    """Beside a robot, where no ray meets the ground; not because of rays above it, nor of the robot that is near."""
    layer = ObstacleLayer(GRID, FAR)
    layer.observe((0.0, 0.0, 0.0), scan_of(lambda x, y: np.where((x > 2.0) & (x < 4.0), -2.0, 0.0)))
    nearer = scan_of(lambda x, y: np.where((x > 0.5) & (x < 2.5), -2.0, 0.0))
    for _ in range(3):
        layer.observe((1.5, 0.0, 0.0), nearer)
        layer.observe((1.5, 0.0, 1.5), nearer)
        layer.clear()
    assert marked(layer, 2.0, 0.0)
    layer.observe((1.7, 0.0, 0.0), nearer)
    assert marked(layer, 2.0, 0.0)
    assert cost(layer, 1.7, 0.0) == FREE_SPACE, "its own middle is on firm ground"
    layer.observe((-0.5, 0.0, 0.0), scan_of(level))
    assert not marked(layer, 2.0, 0.0), "it was none"


def test_nothing_is_where_the_robot_is() -> None:
    layer = ObstacleLayer(GRID, FAR, robot_radius_m=0.33)
    layer.observe((0.0, 0.0, 0.0), scan_of(thing(1.0, 1.0)))
    layer.observe((1.05, 0.0, 0.0), scan_of(level))
    assert cost(layer, 1.05, 0.0) == FREE_SPACE
    without = ObstacleLayer(GRID, ObstacleOptions(footprint_clearing_enabled=False))
    without.observe((0.0, 0.0, 0.0), scan_of(thing(1.0, 0.14)))
    assert cost(without, 0.05, 0.05) == NO_INFORMATION


def test_marks_are_told_in_the_robots_frame() -> None:
    layer = ObstacleLayer(GRID, FAR)
    layer.observe((0.0, 0.0, 0.0), scan_of(thing(2.0, 1.0)))
    near = layer.marks_near((2.05, -1.0, math.pi / 2), 1.5)
    assert near[:, 0] == pytest.approx(1.0, abs=0.65) and near[:, 1] == pytest.approx(0.0, abs=0.35)
    assert len(layer.marks_near((-4.0, 0.0, 0.0), 1.5)) == 0
    assert len(layer.marks_near((400.0, 0.0, 0.0), 1.5)) == 0


def test_clearing_forgets_all_and_scans_off_the_grid_do_no_harm() -> None:
    layer = ObstacleLayer(GRID, FAR)
    layer.observe((0.0, 0.0, 0.0), scan_of(thing(2.0, 1.0)))
    layer.clear()
    assert (layer.costs(whole(GRID)) == NO_INFORMATION).all()
    layer.observe((100.0, 100.0, 0.0), scan_of(thing(2.0, 1.0)))
    assert not layer.lethal.any()
    layer.observe((-7.0, 0.0, 0.0), scan_of(thing(2.0, 1.0)))
    assert marked(layer, -4.95, 0.0), "a robot beside the grid sees what is on it"
    assert int((layer.costs(whole(GRID)) == LETHAL_OBSTACLE).sum()) == int(layer.lethal.sum())


@pytest.mark.parametrize(
    "change", [{"obstacle_max_range": 0.0}, {"raytrace_max_range": math.inf}, {"obstacle_min_range": -1.0}]
)
def test_ranges_that_are_none_are_refused(change: dict[str, float]) -> None:
    with pytest.raises(UsageError):
        ObstacleOptions(**change)  # type: ignore[arg-type]


def test_a_wall_that_the_robot_drives_along_is_not_forgotten() -> None:
    """Rays that graze it pass through the near half of its cells, whose middles they are before or behind."""

    def past(robot_m: float) -> Heights:
        def ground(x: Floats, y: Floats) -> Floats:
            return np.where((np.abs(x + robot_m) < 2.0) & (y > 1.03) & (y < 1.5), 1.4, 0.0)

        return ground

    layer = ObstacleLayer(GRID)
    noise = np.random.default_rng(1)
    for robot_m in np.arange(-3.0, 4.0, 0.1):
        off_m = noise.normal(0.0, 0.01, 2)
        layer.observe((robot_m + off_m[0], off_m[1], noise.normal(0.0, 0.002)), scan_of(past(robot_m)))
    row, _ = GRID.index(np.array([0.0, 1.05]))
    columns = slice(GRID.index(np.array([-1.8, 0.0]))[1], GRID.index(np.array([1.8, 0.0]))[1])
    gaps = ~layer.lethal[row - 1 : row + 2, columns].any(axis=0)
    assert np.count_nonzero(gaps) == 0
