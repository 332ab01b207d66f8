"""The obstacle scan: ground on slopes, low things, edges and holes, what rays show, and clouds that are none."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sern_core.vocabulary.errors import UsageError
from sern_navigation.scan import (
    Cloud,
    ObstacleScan,
    Refused,
    ScanOptions,
    Unusable,
    _sectors_of,
    bin_edges_m,
    obstacle_scan,
    planar_scan,
)
from sern_sim.robot import Pose2
from sern_twin.world.grid import Floats
from tests.exploring import seeds
from tests.sern_navigation.worlds import Heights, box, jackal, level, looking_at, seen, world_of

OPTIONS = ScanOptions()


def scan_of(ground: Heights, options: ScanOptions = OPTIONS) -> ObstacleScan:
    return used(obstacle_scan(Cloud(looking_at(ground), 1.0), options))


def used(scan: ObstacleScan | Refused) -> ObstacleScan:
    assert isinstance(scan, ObstacleScan), scan
    return scan


def ahead(scan: ObstacleScan, half_rad: float = 0.1) -> NDArray[np.bool_]:
    return np.abs(scan.bearings_rad) < half_rad


def lifted(where: NDArray[np.bool_], height_m: float) -> Floats:
    return np.where(where, height_m, 0.0)


def test_nothing_stands_on_level_ground() -> None:
    scan = scan_of(level)
    assert not np.isfinite(scan.ranges_m).any() and not scan.drops.any()
    assert len(scan.points_m) == 0 and (scan.ground_m[:, 1] > 7.0).all() and (scan.ground_m[:, 0] < 1.6).all()
    assert scan.bearings_rad[0] == pytest.approx(-math.pi + math.pi / 360)


@pytest.mark.parametrize("degrees", [-10.0, -5.0, 5.0, 10.0])
@pytest.mark.parametrize("begins_m", [0.7, 1.0, 1.6, 2.2, 3.0])
def test_a_slope_is_no_obstacle(degrees: float, begins_m: float) -> None:
    """The robot stands on level ground, and a slope of 2 m begins somewhere ahead."""
    rise = math.tan(math.radians(degrees))
    scan = scan_of(lambda x, y: rise * np.clip(np.hypot(x, y) - begins_m, 0.0, 2.0))
    near = scan.ranges_m < 5.0
    assert not near.any(), scan.ranges_m[near]


def test_hills_are_no_obstacles() -> None:
    scan = scan_of(lambda x, y: 0.25 * np.sin(x / 1.8) * np.cos(y / 1.8))
    assert np.count_nonzero(scan.ranges_m < 6.0) == 0


@pytest.mark.parametrize("distance_m", [1.6, 2.5, 3.5])
def test_a_steep_bank_is_an_obstacle(distance_m: float) -> None:
    scan = scan_of(lambda x, y: 1.2 * np.clip(x - distance_m, 0.0, 1.0))
    assert scan.ranges_m[ahead(scan)] == pytest.approx(distance_m, abs=0.35)


@pytest.mark.parametrize(
    ("distance_m", "height_m"), [(0.7, 0.5), (1.2, 0.2), (2.0, 0.2), (3.0, 0.25), (4.0, 0.3), (6.0, 0.6)]
)
def test_what_stands_on_the_ground_is_where_it_stands(distance_m: float, height_m: float) -> None:
    scan = scan_of(lambda x, y: lifted((x > distance_m) & (x < distance_m + 0.3) & (np.abs(y) < 1.0), height_m))
    found = scan.ranges_m[ahead(scan)]
    assert found == pytest.approx(distance_m, abs=0.05)
    assert not np.isfinite(scan.ranges_m[np.abs(scan.bearings_rad) > 2.0]).any()


def test_what_is_on_a_slope_stands_on_that() -> None:
    def ground(x: Floats, y: Floats) -> Floats:
        return 0.15 * np.maximum(x, 0.0) + lifted((x > 3.0) & (x < 3.3) & (np.abs(y) < 1.0), 0.4)

    scan = scan_of(ground)
    assert scan.ranges_m[ahead(scan)] == pytest.approx(3.0, abs=0.1)
    assert not np.isfinite(scan.ranges_m[(np.abs(scan.bearings_rad) > 0.6) & (np.abs(scan.bearings_rad) < 2.5)]).any()


def test_what_is_above_the_robot_is_not_in_the_way() -> None:
    bearings = np.linspace(-math.pi, math.pi, 360, endpoint=False) + math.pi / 360
    ceiling = np.stack((2 * np.cos(bearings), 2 * np.sin(bearings), np.full(360, 2.2)), axis=1)
    scan = used(obstacle_scan(Cloud(np.concatenate((looking_at(level), ceiling)), 0.0), OPTIONS))
    assert not np.isfinite(scan.ranges_m).any()
    lower = used(obstacle_scan(Cloud(np.concatenate((looking_at(level), ceiling - [0, 0, 0.5])), 0.0), OPTIONS))
    assert lower.ranges_m == pytest.approx(2.0, abs=0.01)


@pytest.mark.parametrize("edge_m", [1.6, 2.2, 3.0])
def test_a_ditch_is_an_edge_before_it_begins(edge_m: float) -> None:
    """0.8 m deep, 1.8 m wide, with steep sides: as in the simulated robot's world."""
    scan = scan_of(lambda x, y: -np.clip((0.9 - np.abs(x - edge_m - 0.9)) / 0.5, 0.0, 1.0) * 0.8)
    found = scan.ranges_m[ahead(scan)]
    assert (found < edge_m + 0.3).all() and (found > edge_m - 0.45).all(), found
    assert scan.drops[ahead(scan)].all()
    assert (scan.ground_m[ahead(scan), 1] <= found).all(), "and ground is said to be there up to it"
    assert not scan.drops[np.abs(scan.bearings_rad) > 2.0].any()


@pytest.mark.parametrize(("roll_rad", "pitch_rad"), [(0.0, -0.19), (0.0, 0.19), (0.19, 0.0), (-0.13, -0.15)])
def test_a_robot_that_stands_askew_on_a_step_sees_that_the_ground_is_level(roll_rad: float, pitch_rad: float) -> None:
    """Level ground is a plane that is askew in its frame."""
    forward, left = math.tan(pitch_rad) / math.cos(roll_rad), -math.tan(roll_rad)
    points = looking_at(lambda x, y: forward * x + left * y)
    blind = used(obstacle_scan(Cloud(points, 0.0), OPTIONS))
    assert blind.drops.any(), "otherwise this says nothing"
    scan = used(obstacle_scan(Cloud(points, 0.0, roll_rad=roll_rad, pitch_rad=pitch_rad), OPTIONS))
    assert not scan.drops.any() and not (scan.ranges_m < 6.0).any()
    for wrong in (math.nan, math.inf, 2.0):
        same = used(obstacle_scan(Cloud(points, 0.0, roll_rad=wrong), OPTIONS))
        assert (same.ranges_m == blind.ranges_m).all(), "an attitude that is none is not used"


@pytest.mark.parametrize("deep_m", [0.2, 0.3, 0.5, 1.0])
def test_a_step_down_is_an_edge_before_it_is_too_near_to_be_seen(deep_m: float) -> None:
    """The lowest ray meets the ground 1.49 m ahead. What is seen of a small step from further away is as of a slope."""
    found = []
    for edge_m in np.arange(1.5, 1.75, 0.05).tolist():
        scan = scan_of(lambda x, y, edge_m=edge_m: lifted(x > edge_m, -deep_m))  # type: ignore[misc]
        seen_m = scan.ranges_m[ahead(scan) & scan.drops]
        assert seen_m == pytest.approx(edge_m, abs=0.3)
        assert not (scan.ranges_m[np.abs(scan.bearings_rad) > 2.0] < 6.0).any()
        found.append(len(seen_m) == np.count_nonzero(ahead(scan)))
    assert sum(found) >= 3, "from most of these places"


def test_a_bridge_over_a_ditch_is_free() -> None:
    def ground(x: Floats, y: Floats) -> Floats:
        ditch = np.clip((0.9 - np.abs(x - 2.9)) / 0.5, 0.0, 1.0) * 0.8
        return np.where(np.abs(y) < 0.5, 0.0, -ditch)

    scan = scan_of(ground)
    assert not (scan.ranges_m[ahead(scan, 0.08)] < 6.0).any()
    assert scan.drops[(scan.bearings_rad > 0.5) & (scan.bearings_rad < 0.9)].all()


@pytest.mark.parametrize("edge_m", [1.6, 2.2, 3.0])
def test_ground_that_no_ray_meets_is_an_edge(edge_m: float) -> None:
    """A platform above nothing."""
    scan = scan_of(lambda x, y: lifted(x > edge_m, -100.0))
    found = scan.ranges_m[ahead(scan)]
    assert found == pytest.approx(edge_m, abs=0.5) and scan.drops[ahead(scan)].all()
    assert not scan.drops[np.abs(scan.bearings_rad) > 2.0].any()
    without = scan_of(lambda x, y: lifted(x > edge_m, -100.0), ScanOptions(ring_elevations_rad=()))
    assert not np.isfinite(without.ranges_m[ahead(without)]).any(), "nobody said which rays should have met it"


def test_bearings_that_see_nothing_at_all_are_no_holes() -> None:
    """A scanner does not see through what it is mounted on."""
    points = looking_at(level)
    points[np.arctan2(points[:, 1], points[:, 0]) > 2.0] = np.nan
    scan = used(obstacle_scan(Cloud(points, 0.0), OPTIONS))
    assert not scan.drops.any()
    assert (scan.ground_m[scan.bearings_rad > 2.1] == 0).all()
    assert np.isinf(scan.lowest_m[:, scan.bearings_rad > 2.1]).all(), "and nothing is known there"


def test_rays_show_how_low_they_pass() -> None:
    """The lowest ray meets level ground at 1.49 m: before, it falls from 0.4 m to it."""
    scan = scan_of(level)
    middles_m = (scan.bins_m[1:] + scan.bins_m[:-1]) / 2
    lowest = scan.lowest_m[:, 180]
    for number, middle_m in enumerate(middles_m):
        if middle_m < 1.4:
            assert lowest[number] == pytest.approx(0.4 * (1 - middle_m / 1.4928), abs=0.01)
    assert (lowest[(middles_m > 1.45) & (middles_m < 2.0)] < 0.07).all()


def test_rays_over_a_hole_do_not_show_ground() -> None:
    scan = scan_of(lambda x, y: lifted(x > 2.2, -3.0))
    middles_m = (scan.bins_m[1:] + scan.bins_m[:-1]) / 2
    beyond = scan.lowest_m[middles_m > 4.0][:, ahead(scan)]
    assert np.isinf(beyond).all()


def test_a_yard_looks_as_it_is() -> None:
    """Against the ranges of the simulated robot's own world, in bearings that have one thing in them."""
    robot = jackal(world_of([*box(2.0, -1.0, 3.0, 1.0), *box(-4.0, 2.0, -3.0, 5.0, 1.0)], 8.0))
    scan = used(obstacle_scan(seen(robot), OPTIONS))
    sides = [robot.world.cast(0.0, 0.0, scan.bearings_rad + off).range_m for off in (-0.009, 0.0, 0.009)]
    alone = np.ptp(sides, axis=0) < 0.2
    assert np.count_nonzero(alone) > 300
    assert scan.ranges_m[alone & (sides[1] < 9.5)] == pytest.approx(sides[1][alone & (sides[1] < 9.5)], abs=0.15)


@pytest.mark.parametrize("seed", seeds(5))
def test_level_ground_before_a_wall_has_no_edge(seed: int) -> None:
    """A scanner trembles: a ring may meet a wall a bin before those below it do, and that is no ground that ends."""
    robot = jackal(world_of([(1.0, -5.0, 1.0, 5.0, 3.0)]), seed)
    for number in range(10):
        here_m = 0.04 * number - 0.2
        robot.state = replace(robot.state, pose=Pose2(here_m, 0.1 * number, 0.7 * number + seed))
        scan = used(obstacle_scan(seen(robot, 5_760), OPTIONS))
        assert not scan.drops.any() and scan.ranges_m.min() == pytest.approx(1.0 - here_m, abs=0.05)


def test_the_scanner_need_not_be_in_the_middle() -> None:
    """0.2 m forward: what it sees 1.8 m ahead is 2 m ahead of the robot."""
    options = ScanOptions(origin_m=(0.2, 0.0, 0.4))
    points = looking_at(lambda x, y: lifted(x > 1.8, 1.0)) + np.array([0.2, 0.0, 0.0])
    scan = used(obstacle_scan(Cloud(points, 0.0), options))
    assert scan.ranges_m[ahead(scan, 0.02)] == pytest.approx(1.8, abs=0.03)
    assert scan.points_m[:, 0].min() == pytest.approx(2.0, abs=0.03)
    middle = np.abs(scan.points_m[:, 1]) < 0.1
    assert scan.tops_m[middle].max() == pytest.approx(0.88, abs=0.05), "as high as the highest ray met it"


@pytest.mark.parametrize(
    ("points", "reason"),
    [
        (np.empty((0, 3)), Unusable.EMPTY),
        (np.full((10, 3), np.nan), Unusable.NOT_FINITE),
        (np.full((10, 3), np.inf), Unusable.NOT_FINITE),
        (np.full((10, 3), 1e300), Unusable.NOT_FINITE),
        (np.zeros((100, 3)), Unusable.TOO_FEW),
        (np.eye(3), Unusable.TOO_FEW),
        (np.full((100, 3), 3e38), Unusable.TOO_FEW),
        (np.zeros((10, 2)), Unusable.SHAPE),
        (np.zeros(10), Unusable.SHAPE),
        (np.zeros((4, 4, 4)), Unusable.SHAPE),
        (np.array([["a", "b", "c"]]), Unusable.SHAPE),
        (np.zeros((3, 3), np.complex128), Unusable.SHAPE),
        (np.zeros(5, [("x", "<f4"), ("y", "<f4")]), Unusable.FIELDS),
        (np.zeros(5, [("x", "<f4"), ("y", "<f4"), ("z", "<f4", (2,))]), Unusable.SHAPE),
        (np.zeros(5, [("x", "<f4"), ("y", "<f4"), ("z", "U3")]), Unusable.SHAPE),
        (np.zeros((5, 3), np.bool_), Unusable.SHAPE),
        (np.full((5, 3), None), Unusable.SHAPE),
        (np.zeros(0, [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]), Unusable.EMPTY),
    ],
)  # fmt: skip
def test_a_cloud_that_is_none_says_why(points: NDArray[Any], reason: Unusable) -> None:
    found = obstacle_scan(Cloud(points, 0.0), OPTIONS)
    assert isinstance(found, Refused) and found.reason is reason and "\n" not in found.message


def test_a_cloud_of_another_frame_or_without_a_time_says_so() -> None:
    cloud = looking_at(level)
    other = obstacle_scan(Cloud(cloud, 0.0, "velodyne"), OPTIONS)
    assert isinstance(other, Refused) and other.reason is Unusable.OTHER_FRAME and "'base_link'" in other.message
    for stamp_s in (math.nan, math.inf):
        found = obstacle_scan(Cloud(cloud, stamp_s), OPTIONS)
        assert isinstance(found, Refused) and found.reason is Unusable.NOT_FINITE


def test_fields_by_name_are_as_good_as_columns() -> None:
    points = looking_at(lambda x, y: lifted(x > 2.0, 1.0)).astype(np.float32)
    named = np.zeros(len(points), [("intensity", "<f4"), ("z", "<f4"), ("x", "<f4"), ("y", "<f4")])
    named["x"], named["y"], named["z"] = points.T
    one, other = used(obstacle_scan(Cloud(points, 0.0), OPTIONS)), used(obstacle_scan(Cloud(named, 0.0), OPTIONS))
    assert (one.ranges_m == other.ranges_m).all() and np.isfinite(one.ranges_m).any()


@pytest.mark.parametrize("seed", seeds(20))
def test_any_points_make_a_scan_or_a_reason(seed: int) -> None:
    """Random numbers of any size, with holes: what comes out has its shape, and no NaN."""
    random = np.random.default_rng(seed)
    scale = 10.0 ** random.integers(-3, 12)
    points = random.normal(0, scale, (int(random.integers(1, 900)), int(random.integers(3, 6))))
    points[random.random(points.shape) < 0.1] = random.choice([np.nan, np.inf, -np.inf])
    found = obstacle_scan(Cloud(points, 0.0), OPTIONS)
    if isinstance(found, Refused):
        assert found.reason in (Unusable.NOT_FINITE, Unusable.TOO_FEW)
        return
    assert found.ranges_m.shape == (360,) and not np.isnan(found.ranges_m).any()
    assert (found.ranges_m >= OPTIONS.range_min_m - 1e-6).all()
    assert np.isfinite(found.points_m).all() and np.isfinite(found.tops_m).all()
    assert not np.isnan(found.lowest_m).any() and (found.lowest_m >= 0).all()


def test_a_planar_scan_is_one_as_well() -> None:
    angles = np.linspace(-math.pi / 2, math.pi / 2, 361)
    ranges = np.full(361, np.inf)
    ranges[170:190], ranges[:20], ranges[20:30] = 2.0, np.nan, -1.0
    scan = used(planar_scan(ranges, angles, 3.0, OPTIONS))
    assert scan.ranges_m[np.abs(scan.bearings_rad) < 0.05] == pytest.approx(2.0)
    assert np.isinf(scan.ranges_m[(scan.bearings_rad > 0.2) & (scan.bearings_rad < 1.5)]).all()
    assert (scan.ground_m[np.abs(scan.bearings_rad) > 1.6] == 0).all()
    middles_m = (scan.bins_m[1:] + scan.bins_m[:-1]) / 2
    before = scan.lowest_m[:, 180]
    assert (before[middles_m < 1.9] == 0).all() and np.isinf(before[middles_m > 2.1]).all()
    assert scan.points_m == pytest.approx(np.stack((2 * np.cos(angles[170:190]), 2 * np.sin(angles[170:190])), axis=1))


@pytest.mark.parametrize(
    ("ranges", "angles", "reason"),
    [
        ([1.0], [0.0, 1.0], Unusable.SHAPE),
        ([[1.0]], [[0.0]], Unusable.SHAPE),
        ([], [], Unusable.EMPTY),
        ([math.nan, -1.0], [0.0, 1.0], Unusable.NOT_FINITE),
        ([1.0], [math.nan], Unusable.NOT_FINITE),
        ([1.0], [1e300], Unusable.NOT_FINITE),
    ],
)
def test_a_planar_scan_that_is_none_says_why(ranges: list[float], angles: list[float], reason: Unusable) -> None:
    found = planar_scan(ranges, angles, 0.0, OPTIONS)
    assert isinstance(found, Refused) and found.reason is reason


@pytest.mark.parametrize("range_max_m", [0.5, 2.5, 3.0, 4.9, 5.0, 10.0, 30.0])
def test_bins_reach_as_far_as_a_scan(range_max_m: float) -> None:
    edges = bin_edges_m(range_max_m)
    assert edges[0] == 0 and edges[-1] == range_max_m and (np.diff(edges) > 0).all()


@pytest.mark.parametrize(
    "change",
    [
        {"sectors": 2}, {"min_points": 0}, {"range_min_m": 11.0}, {"range_max_m": math.nan},
        {"origin_m": (0.0, 0.0, 0.0)}, {"origin_m": (math.nan, 0.0, 0.4)},
        {"min_obstacle_height": 3.0}, {"step_m": 0.0}, {"step_m": 0.5}, {"max_slope_rad": 2.0}, {"max_fall_rad": 0.0},
    ],
)  # fmt: skip
def test_options_that_do_not_fit_are_refused(change: dict[str, Any]) -> None:
    with pytest.raises(UsageError):
        ScanOptions(**change)


@pytest.mark.parametrize("sectors", [8, 360, 3600])
def test_the_sectors_of_places_are_those_of_arctan2(sectors: int) -> None:
    draw = np.random.default_rng(sectors)
    bearings = draw.uniform(-np.pi, np.pi, 50_000)
    borders = draw.integers(0, sectors, 10_000)
    bearings[: len(borders)] = borders * (2 * np.pi / sectors) - np.pi
    ranges_m = draw.uniform(0.01, 1e4, len(bearings))
    x, y = (ranges_m * np.cos(bearings)).astype(np.float32), (ranges_m * np.sin(bearings)).astype(np.float32)
    x[-6:], y[-4:] = (0, 0, 3, -3, 0, -0.0), (0, -0.0, 0, 0)
    turns = (np.arctan2(y, x) + np.float32(np.pi)) * np.float32(sectors / (2 * np.pi))
    assert (_sectors_of(x, y, sectors) == np.floor(turns).astype(np.intp) % sectors).all()
