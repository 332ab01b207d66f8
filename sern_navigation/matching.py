"""Where a scan fits on the map: a correlative search (Olson, ICRA 2009), then Gauss-Newton (Kohlbrecher et al., 2011).

The map is seen as a likelihood field (Thrun, Burgard, Fox: Probabilistic Robotics, 6.4): how near something occupied
is. Why not small_gicp: it aligns two clouds in six degrees, where here a scan of some hundred bearings is laid on the
map that planner and twin share. The search needs no good first guess, so it works after a gap, and it can say that
nothing fits; it is as accurate, and quicker (docs/navigation.md); and the package stays with numpy and scipy.
"""

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sern_core.vocabulary.errors import UsageError
from sern_navigation.costmap.costs import Mask, Window, around
from sern_twin.motion import MOST_M
from sern_twin.world.grid import Floats, Grid
from sern_twin.world.occupancy import MOST_RAD, Pose

_FAR_M: Final = 1.0
"""Beyond this distance from all that is occupied a point fits nowhere."""
_STOP_M: Final = 1e-4


class NoMatch(StrEnum):
    """Why a scan fits nowhere."""

    POSE = "pose"
    """The prediction is not finite, or not on the grid."""
    FEW_POINTS = "few_points"
    """There is too little to see."""
    EMPTY_MAP = "empty_map"
    """Nothing is occupied around."""
    LITTLE_OVERLAP = "little_overlap"
    """Most of what is seen is where the map knows nothing yet."""
    LOW_SCORE = "low_score"
    """What is seen does not look like the map."""
    RAN_AWAY = "ran_away"
    """The best place lies outside of what was searched."""


@dataclass(frozen=True, slots=True)
class MatchOptions:
    """UsageError: a number that is not above 0, or a share that is none."""

    search_m: float = 0.3
    """How far the prediction may be off, in each axis."""
    search_rad: float = 0.2
    step_rad: float = math.radians(2.0)
    sigma_m: float = 0.12
    """How far off a point may be for the likelihood of exp(-1/2)."""
    reach_m: float = 10.0
    """Points further away are not looked at."""
    most_points: int = 180
    """So many of a scan are searched with; all are refined with."""
    min_points: int = 30
    min_overlap: float = 0.5
    """The share of points that lie where the map knows something."""
    min_score: float = 0.55
    """The mean likelihood of those."""
    iterations: int = 15
    noise: float = 1.0
    """One sigma of the likelihood's residuals, for the covariance; large, since neighbouring bearings err together."""

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            if not 0 < getattr(self, name) < math.inf:
                raise UsageError(f"matching with {name} {getattr(self, name)}: give a number above 0")
        if self.min_overlap > 1 or self.min_score > 1:
            raise UsageError("matching: min_overlap and min_score are shares, of 0 to 1")


@dataclass(frozen=True, slots=True, eq=False)
class Match:
    """Where the robot is: `covariance` (3, 3) of east, north [m] and yaw [rad]; `score` is the mean likelihood.

    Along what the scan does not see, such as a corridor, the place is that of the prediction and as unsure.
    """

    pose: Pose
    covariance: Floats
    score: float


def match(
    grid: Grid, occupied: Mask, known: Mask, prediction: Pose, points_m: Floats, options: MatchOptions | None = None
) -> Match | NoMatch:
    """Lay points (n, 2) [m] of the robot's frame on a map, (rows, columns), near where the robot is thought to be."""
    options = options or MatchOptions()
    x_m, y_m, yaw_rad = prediction
    if not (abs(x_m) <= MOST_M and abs(y_m) <= MOST_M and abs(yaw_rad) <= MOST_RAD):
        return NoMatch.POSE
    if int(grid.flat(np.array([x_m, y_m]))) < 0:
        return NoMatch.POSE
    points = points_m[np.isfinite(points_m).all(axis=1)]
    points = points[np.hypot(points[:, 0], points[:, 1]) <= options.reach_m]
    if len(points) < options.min_points:
        return NoMatch.FEW_POINTS
    window = around(grid, x_m, y_m, float(np.hypot(*points.T).max()) + options.search_m + _FAR_M)
    if not occupied[window.slices].any():
        return NoMatch.EMPTY_MAP
    field = _Field(grid, window, occupied, known, options)
    coarse = field.searched(prediction, points[:: max(1, -(-len(points) // options.most_points))])
    pose, information = field.refined(coarse, prediction, points)
    off_m = max(abs(pose[0] - x_m), abs(pose[1] - y_m))
    if off_m > 1.5 * options.search_m or abs(pose[2] - yaw_rad) > 1.5 * options.search_rad:
        return NoMatch.RAN_AWAY
    overlap, score = field.fit(pose, points)
    if overlap < options.min_overlap:
        return NoMatch.LITTLE_OVERLAP
    if score < options.min_score:
        return NoMatch.LOW_SCORE
    covariance: Floats = np.linalg.inv(information).astype(np.float64)
    return Match((pose[0], pose[1], math.remainder(pose[2], 2 * math.pi)), covariance, score)


class _Field:
    """The likelihood of each cell of a window that a scan's point lies there, at the cells' middles."""

    def __init__(self, grid: Grid, window: Window, occupied: Mask, known: Mask, options: MatchOptions) -> None:
        self._options = options
        self._cell_m = grid.cell_m
        self._corner = np.array(
            [grid.west_m + window.first_column * grid.cell_m, grid.south_m + window.first_row * grid.cell_m]
        )
        self._pad = math.ceil(options.search_m / grid.cell_m) + 1
        distances_m = ndimage.distance_transform_edt(~occupied[window.slices]) * grid.cell_m
        likelihood = np.exp(-((distances_m / options.sigma_m) ** 2) / 2)
        self._likelihood = np.pad(likelihood, self._pad).astype(np.float32)
        self._known = np.pad(known[window.slices], self._pad)

    def searched(self, prediction: Pose, points: Floats) -> Pose:
        """The best of all places around, by cells and steps of yaw."""
        options, shifts = self._options, self._pad - 1
        turns = round(options.search_rad / options.step_rad)
        yaws = prediction[2] + np.arange(-turns, turns + 1) * options.step_rad
        cos, sin = np.cos(yaws)[:, None], np.sin(yaws)[:, None]
        across = self._index(prediction[0] + cos * points[:, 0] - sin * points[:, 1], 0)
        along = self._index(prediction[1] + sin * points[:, 0] + cos * points[:, 1], 1)
        rows, columns = self._likelihood.shape
        # What is outside of the window lies on its rim, where nothing is likely.
        across = np.clip(np.floor(across).astype(np.int64), shifts, columns - 1 - shifts)
        along = np.clip(np.floor(along).astype(np.int64), shifts, rows - 1 - shifts)
        moves = np.arange(-shifts, shifts + 1)
        offsets = (moves[:, None] * columns + moves).reshape(-1)
        cells = (along * columns + across)[:, None, :] + offsets[None, :, None]
        scores = self._likelihood.reshape(-1)[cells].sum(axis=-1)
        # Of places that fit as well, the nearest to the prediction.
        away = np.hypot(moves[:, None], moves).reshape(-1) + np.abs(yaws - prediction[2])[:, None] / options.step_rad
        turn, move = np.unravel_index(int(np.argmax(scores - 1e-3 * away)), scores.shape)
        up, right = divmod(int(move), len(moves))
        return (
            prediction[0] + float(moves[right]) * self._cell_m,
            prediction[1] + float(moves[up]) * self._cell_m,
            float(yaws[turn]),
        )

    def refined(self, pose: Pose, prediction: Pose, points: Floats) -> tuple[Pose, Floats]:
        """The best place between cells, and the information (3, 3) about it, the prediction's included."""
        options = self._options
        prior = np.diag([(options.search_m / 2) ** -2, (options.search_m / 2) ** -2, (options.search_rad / 2) ** -2])
        place, began = np.array(pose), np.array(prediction)
        information = prior
        for _ in range(options.iterations):
            cos, sin = math.cos(place[2]), math.sin(place[2])
            east = cos * points[:, 0] - sin * points[:, 1]
            north = sin * points[:, 0] + cos * points[:, 1]
            values, to_east, to_north = self._at(place[0] + east, place[1] + north)
            slopes = np.stack((to_east, to_north, to_north * east - to_east * north), axis=1) / options.noise
            information = slopes.T @ slopes + prior
            pull = slopes.T @ ((1 - values) / options.noise) - prior @ (place - began)
            step = np.linalg.solve(information, pull)
            step = step / max(1.0, float(np.hypot(step[0], step[1])) / self._cell_m)
            place = place + step
            if np.abs(step).max() < _STOP_M:
                break
        return (float(place[0]), float(place[1]), float(place[2])), information

    def fit(self, pose: Pose, points: Floats) -> tuple[float, float]:
        """The share of points where the map knows something, and the mean likelihood of those."""
        cos, sin = math.cos(pose[2]), math.sin(pose[2])
        x, y = pose[0] + cos * points[:, 0] - sin * points[:, 1], pose[1] + sin * points[:, 0] + cos * points[:, 1]
        values, _to_east, _to_north = self._at(x, y)
        rows, columns = self._known.shape
        row = np.clip(self._index(y, 1).astype(np.int64), 0, rows - 1)
        column = np.clip(self._index(x, 0).astype(np.int64), 0, columns - 1)
        counted = self._known[row, column] | (values > math.exp(-2))
        if not counted.any():
            return 0.0, 0.0
        return float(counted.mean()), float(values[counted].mean())

    def _index(self, places_m: Floats, axis: int) -> Floats:
        """Places in cells from the padded corner."""
        found: Floats = (places_m - self._corner[axis]) / self._cell_m + self._pad
        return found

    def _at(self, x_m: Floats, y_m: Floats) -> tuple[NDArray[np.float64], Floats, Floats]:
        """Bilinear likelihoods at places, and how they change [1/m] to the east and to the north."""
        rows, columns = self._likelihood.shape
        across, along = self._index(x_m, 0) - 0.5, self._index(y_m, 1) - 0.5
        column = np.clip(np.floor(across).astype(np.int64), 0, columns - 2)
        row = np.clip(np.floor(along).astype(np.int64), 0, rows - 2)
        right, up = np.clip(across - column, 0, 1), np.clip(along - row, 0, 1)
        field = self._likelihood
        a, b = field[row, column].astype(np.float64), field[row, column + 1].astype(np.float64)
        c, d = field[row + 1, column].astype(np.float64), field[row + 1, column + 1].astype(np.float64)
        low, high = a + right * (b - a), c + right * (d - c)
        to_east = ((b - a) * (1 - up) + (d - c) * up) / self._cell_m
        return low + up * (high - low), to_east, (high - low) / self._cell_m
