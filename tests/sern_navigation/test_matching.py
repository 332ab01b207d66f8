"""Where a scan fits on the map, how sure that is, and when it fits nowhere."""

import math
from typing import Any

import numpy as np
import pytest

from sern_core.vocabulary.errors import UsageError
from sern_navigation.costmap.costs import Mask
from sern_navigation.mapping import ends_m
from sern_navigation.matching import Match, MatchOptions, NoMatch, match
from sern_navigation.scan import ObstacleScan, ScanOptions, planar_scan
from sern_sim.world import World
from sern_twin.world.grid import Floats, Grid
from sern_twin.world.occupancy import Pose
from tests.exploring import seeds
from tests.sern_navigation.worlds import box, world_of

GRID = Grid(-8.0, -8.0, 0.1, 160, 160)
KNOWN = np.ones(GRID.shape, np.bool_)
ROOM = world_of([*box(2.05, -1.05, 3.05, 1.05), *box(-4.05, 2.05, -3.05, 5.05), *box(-2.05, -5.05, 0.05, -4.05)], 5.95)
"""Its walls go through the middles of cells."""


def occupied(world: World) -> Mask:
    """The cells that its walls go through."""
    found = np.zeros(GRID.shape, np.bool_)
    for x0, y0, x1, y1, _height in world.walls:
        places = np.linspace((x0, y0), (x1, y1), 2 + int(50 * math.hypot(x1 - x0, y1 - y0)))
        rows, columns = GRID.index(places)
        found[rows, columns] = True
    return found


def points(world: World, pose: Pose, seed: int = 0) -> Floats:
    """What a planar scanner there sees, in the robot's frame."""
    bearings = np.linspace(-math.pi, math.pi, 360, endpoint=False)
    ranges = world.cast(pose[0], pose[1], pose[2] + bearings).range_m
    bearings, ranges = bearings[np.isfinite(ranges)], ranges[np.isfinite(ranges)]
    ranges = ranges + np.random.default_rng(seed).normal(0.0, 0.01, len(ranges))
    found: Floats = ranges[:, None] * np.stack((np.cos(bearings), np.sin(bearings)), axis=1)
    return found


def off(one: Pose, other: Pose) -> tuple[float, float]:
    return math.dist(one[:2], other[:2]), abs(math.remainder(one[2] - other[2], 2 * math.pi))


@pytest.mark.parametrize("seed", seeds(25))
def test_a_scan_is_laid_where_the_robot_is(seed: int) -> None:
    """Better than half a cell: what single points are off averages out."""
    random = np.random.default_rng(seed)
    pose = (float(random.uniform(-2, 1)), float(random.uniform(-3, 1)), float(random.uniform(-3, 3)))
    prediction = (
        pose[0] + float(random.uniform(-0.28, 0.28)),
        pose[1] + float(random.uniform(-0.28, 0.28)),
        pose[2] + float(random.uniform(-0.18, 0.18)),
    )
    found = match(GRID, occupied(ROOM), KNOWN, prediction, points(ROOM, pose, seed))
    assert isinstance(found, Match), found
    away_m, turned_rad = off(found.pose, pose)
    assert away_m < 0.04 and turned_rad < 0.01
    error = np.array(
        [found.pose[0] - pose[0], found.pose[1] - pose[1], math.remainder(found.pose[2] - pose[2], math.tau)]
    )
    assert error @ np.linalg.inv(found.covariance) @ error < 16.3, "within the 99.9 % of three dimensions"
    assert np.linalg.eigvalsh(found.covariance).min() > 0
    assert math.sqrt(found.covariance[0, 0]) < 0.12 and 0.7 < found.score <= 1.0


def test_in_a_corridor_the_way_along_it_stays_unsure() -> None:
    """Two walls to the north and south, longer than what is looked at."""
    corridor = World(
        np.array([(-50.0, 1.05, 50.0, 1.05, 2.0), (-50.0, -1.05, 50.0, -1.05, 2.0)]), np.zeros((0, 4)), 50.0
    )
    bearings = np.linspace(-math.pi, math.pi, 360, endpoint=False)
    ranges = corridor.cast(0.0, 0.0, bearings).range_m
    bearings, ranges = bearings[ranges < 5.0], ranges[ranges < 5.0]
    seen = ranges[:, None] * np.stack((np.cos(bearings), np.sin(bearings)), axis=1)
    found = match(GRID, occupied(corridor), KNOWN, (0.15, 0.2, 0.05), seen)
    assert isinstance(found, Match)
    along, across, _turned = np.sqrt(np.diag(found.covariance))
    assert found.pose[1] == pytest.approx(0.0, abs=0.05) and found.pose[2] == pytest.approx(0.0, abs=0.01)
    assert found.pose[0] == pytest.approx(0.15, abs=0.05), "nothing says where along it"
    assert along > 0.13 and across < 0.08


def test_what_does_not_look_like_the_map_fits_nowhere() -> None:
    random = np.random.default_rng(3)
    nonsense = random.uniform(-5, 5, (300, 2))
    assert match(GRID, occupied(ROOM), KNOWN, (0.0, 0.0, 0.0), nonsense) is NoMatch.LOW_SCORE
    elsewhere = points(ROOM, (0.0, 0.0, 0.0)) + np.array([1.0, 0.7])
    assert match(GRID, occupied(ROOM), KNOWN, (0.0, 0.0, 0.0), elsewhere) in (NoMatch.LOW_SCORE, NoMatch.RAN_AWAY)


def test_where_the_map_knows_nothing_a_scan_says_nothing() -> None:
    known = np.zeros(GRID.shape, np.bool_)
    known[:40] = True
    some = occupied(ROOM) & known
    assert match(GRID, some, known, (0.0, 0.0, 0.0), points(ROOM, (0.0, 0.0, 0.0))) is NoMatch.LITTLE_OVERLAP
    nothing = np.zeros(GRID.shape, np.bool_)
    assert match(GRID, nothing, nothing, (0.0, 0.0, 0.0), points(ROOM, (0.0, 0.0, 0.0))) is NoMatch.EMPTY_MAP


@pytest.mark.parametrize(
    ("prediction", "seen", "reason"),
    [
        ((math.nan, 0.0, 0.0), np.ones((50, 2)), NoMatch.POSE),
        ((0.0, 0.0, math.inf), np.ones((50, 2)), NoMatch.POSE),
        ((90.0, 0.0, 0.0), np.ones((50, 2)), NoMatch.POSE),
        ((0.0, 0.0, 0.0), np.empty((0, 2)), NoMatch.FEW_POINTS),
        ((0.0, 0.0, 0.0), np.full((50, 2), np.nan), NoMatch.FEW_POINTS),
        ((0.0, 0.0, 0.0), np.full((50, 2), 1e9), NoMatch.FEW_POINTS),
    ],
)
def test_there_is_a_reason_for_each_scan_that_fits_nowhere(prediction: Pose, seen: Floats, reason: NoMatch) -> None:
    assert match(GRID, occupied(ROOM), KNOWN, prediction, seen) is reason


def test_a_robot_at_the_edge_of_the_map_is_found_too() -> None:
    pose = (5.6, 5.6, 0.3)
    found = match(GRID, occupied(ROOM), KNOWN, (5.5, 5.7, 0.2), points(ROOM, pose))
    assert isinstance(found, Match) and off(found.pose, pose)[0] < 0.06


def test_ends_are_of_what_stands() -> None:
    scan = planar_scan([2.0, math.inf], [0.0, 1.5], 0.0, ScanOptions(origin_m=(0.5, 0.0, 0.4)))
    assert isinstance(scan, ObstacleScan)
    assert ends_m(scan) == pytest.approx(np.array([[2.5, 0.0]]), abs=0.02)


@pytest.mark.parametrize(
    "change", [{"search_m": 0.0}, {"sigma_m": math.nan}, {"min_score": 1.5}, {"min_overlap": -1.0}]
)
def test_options_that_are_none_are_refused(change: dict[str, Any]) -> None:
    with pytest.raises(UsageError):
        MatchOptions(**change)
