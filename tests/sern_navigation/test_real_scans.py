"""Two scans of a real scanner with 32 rings, half a metre apart: what stands there, and where the second one was taken.

Its height and its tilt are what its lowest rings say: they meet ground 2 m below it that falls by 8 % ahead.
"""

import math
from typing import Final

import numpy as np
import pytest
from numpy.typing import NDArray

from sern_client.endpoints.clouds import read_ply
from sern_navigation.mapping import Mapper, Placed, ends_m
from sern_navigation.matching import Match, MatchOptions, NoMatch, match
from sern_navigation.scan import Cloud, ObstacleScan, ScanOptions, obstacle_scan
from sern_twin.world.grid import Grid
from sern_twin.world.occupancy import Pose
from sern_twin.world.patches import UNKNOWN
from tests.daemons import recording

HEIGHT_M: Final = 2.0
PITCH_RAD: Final = -0.08
RINGS_RAD: Final = tuple(math.radians(-30.67 + 4 / 3 * number) for number in range(32))
OPTIONS: Final = ScanOptions(origin_m=(0.0, 0.0, HEIGHT_M), ring_elevations_rad=RINGS_RAD)
GRID: Final = Grid(-15.0, -15.0, 0.1, 300, 300)
B_ON_A: Final[Pose] = (-0.487, -0.127, 0.0122)
"""The place of b, seen from a, as those who recorded them state it. GICP of the clouds finds that within 2 cm
and a quarter of a degree."""


def points_of(name: str) -> NDArray[np.float32]:
    """Points in the frame of the ground below the scanner; rays that met nothing are at the scanner itself."""
    points = read_ply(recording(f"lidar_scan_{name}.ply"))[:, :3].copy()
    points[:, 2] += HEIGHT_M
    return points


def scan_of(name: str) -> ObstacleScan:
    found = obstacle_scan(Cloud(points_of(name), 0.0, pitch_rad=PITCH_RAD), OPTIONS)
    assert isinstance(found, ObstacleScan)
    return found


def standing_m(points: NDArray[np.float32]) -> NDArray[np.float64]:
    """The nearest thing at each bearing, without any walk over the ground: columns of 20 cm in which points are half a
    metre above each other, and of those what is 30 cm above their lowest."""
    ranges = np.hypot(points[:, 0], points[:, 1])
    points = points[(ranges > OPTIONS.range_min_m) & (ranges < OPTIONS.range_max_m) & (points[:, 2] < 1.9)]
    cells = np.floor(points[:, :2] / 0.2).astype(np.int64) + 1000
    _, column = np.unique(cells[:, 0] * 10_000 + cells[:, 1], return_inverse=True)
    low, high = np.full(column.max() + 1, np.inf), np.full(column.max() + 1, -np.inf)
    np.minimum.at(low, column, points[:, 2])
    np.maximum.at(high, column, points[:, 2])
    stands = (high - low >= 0.5)[column] & (points[:, 2] >= low[column] + 0.3)
    x, y = points[stands, 0], points[stands, 1]
    sector = ((np.arctan2(y, x) + math.pi) * (OPTIONS.sectors / math.tau)).astype(np.int64) % OPTIONS.sectors
    found = np.full(OPTIONS.sectors, np.inf)
    np.minimum.at(found, sector, np.hypot(x, y))
    return found


@pytest.mark.parametrize("name", ["a", "b"])
def test_the_scan_ends_where_things_stand_and_not_on_the_ground(name: str) -> None:
    scan, standing = scan_of(name), standing_m(points_of(name))
    known = np.isfinite(standing)
    behind_m, before_m = scan.ranges_m[known] - standing[known], standing[known] - scan.ranges_m[known]
    assert known.sum() > 300
    assert np.mean(behind_m > 0.3) < 0.02, "what stands is seen"
    assert np.mean(before_m > 0.3) < 0.2, "low things are before walls: of them that reference knows nothing"
    assert np.count_nonzero(scan.drops) < 10 and np.isfinite(scan.ranges_m).sum() > 320
    ground_m = np.median(scan.ground_m[:, 1] - scan.ground_m[:, 0])
    assert ground_m > 0.5 and scan.tops_m.max() <= OPTIONS.max_obstacle_height


def test_without_its_tilt_falling_ground_before_a_wall_is_taken_for_a_ditch() -> None:
    """Why a cloud says how its robot stands."""
    level = obstacle_scan(Cloud(points_of("a"), 0.0), OPTIONS)
    assert isinstance(level, ObstacleScan)
    assert np.count_nonzero(level.drops) > 4 * np.count_nonzero(scan_of("a").drops)


def test_the_second_scan_is_laid_where_it_was_taken() -> None:
    """The predictions are off by what a search of 0.3 m and 0.2 rad allows."""
    mapper, ends = Mapper(GRID), ends_m(scan_of("b"))
    assert mapper.add((0.0, 0.0, 0.0), scan_of("a")).placed is Placed.PREDICTED
    cells, draw = mapper.occupancy.cells(), np.random.default_rng(1)
    found = []
    for _ in range(10):
        off = draw.uniform(-1, 1, 3) * (0.25, 0.25, 0.15)
        prediction = (B_ON_A[0] + float(off[0]), B_ON_A[1] + float(off[1]), B_ON_A[2] + float(off[2]))
        matched = match(GRID, cells >= 65, cells != UNKNOWN, prediction, ends)
        assert isinstance(matched, Match), matched
        found.append(matched.pose)
        error = np.array(matched.pose) - B_ON_A
        assert math.hypot(error[0], error[1]) < 0.06 and abs(error[2]) < math.radians(0.6)
        assert error @ np.linalg.inv(matched.covariance) @ error < 16.3
    assert np.ptp(np.array(found), axis=0).max() < 0.03, "wherever the search begins"


def test_the_second_scan_does_not_fit_a_metre_off() -> None:
    mapper, ends = Mapper(GRID), ends_m(scan_of("b"))
    mapper.add((0.0, 0.0, 0.0), scan_of("a"))
    cells = mapper.occupancy.cells()
    for pose in ((1.0, 1.0, 0.0), (-0.5, 1.2, 0.0), (-0.49, -0.13, 0.8)):
        found = match(GRID, cells >= 65, cells != UNKNOWN, pose, ends, MatchOptions(search_m=0.3))
        assert found in (NoMatch.LOW_SCORE, NoMatch.RAN_AWAY, NoMatch.LITTLE_OVERLAP), (pose, found)


def test_a_map_of_both_keeps_the_robot_in_its_place() -> None:
    """They come in turns: the map gets no worse by it."""
    mapper, scans = Mapper(GRID), {name: scan_of(name) for name in "ab"}
    places: dict[str, Pose] = {"a": (0.0, 0.0, 0.0), "b": B_ON_A}
    for turn in range(8):
        name = "ab"[turn % 2]
        mapped = mapper.add(places[name], scans[name])
        error = np.array(mapped.pose) - places[name]
        assert math.hypot(error[0], error[1]) < 0.06 and abs(error[2]) < math.radians(0.6)
    assert mapper.counts == {Placed.MATCHED: 7, Placed.PREDICTED: 1, Placed.REFUSED: 0}
    occupied = np.count_nonzero(mapper.occupancy.classes() == 100)
    assert 250 < occupied < 700, "walls stay thin"
