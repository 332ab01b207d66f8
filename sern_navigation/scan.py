"""The obstacle scan of a cloud: what stands in the way at each bearing, and where the ground ends.

The paper's S_2D(r, θ) = min_z L_3D(r, θ, z) collapses the height of a cloud. Here the ground is taken out first, by
bearing: from the robot outwards a point is ground where the way to it from the ground before is not too steep
(Himmelsbach et al., IV 2010, with a walk in place of fitted lines), so that hills are no obstacles and low things are.
Ground that drops away, or that no ray meets where one should, is an obstacle too: its edge is.

A ray shows only what it passes: a log of 20 cm that is below all rays is not gone. So a scan also says how low the
lowest ray passed, for each bearing and distance.
"""

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sern_core.vocabulary.errors import UsageError
from sern_twin.world.grid import Floats
from sern_twin.world.occupancy import MOST_RAD

Indices = NDArray[np.intp]

MOST_POINTS: Final = 1_000_000
VLP16_RAD: Final = tuple(math.radians(degrees) for degrees in range(-15, 16, 2))
"""Elevations of the 16 rings that Velodyne's VLP-16 and the simulated robot have."""
_FINE_M: Final = 0.05
_BEFORE_M: Final = 0.12
"""An edge is said to be so far before a hole that is sure: rays are a quarter of a metre apart where it matters."""
_OVER: Final = np.float32(1e-3)
"""A ray that passes over another is so much steeper."""
_TURN: Final = 2 * math.pi
_ARCTAN: Final = tuple(
    np.float32(factor) for factor in (-0.01171906, 0.05264717, -0.11642635, 0.19354035, -0.33262283, 0.99997723)
)
"""Factors of x¹¹ to x of the odd polynomial that is nearest to arctan between 0 and 1 (found by least squares that were
weighted anew until all its maxima were alike): within 1.8e-6."""
_ARCTAN_ERROR_RAD: Final = 5e-6
"""More than that, and what float32 rounds."""
_LEAST: Final = np.finfo(np.float32).tiny
_MOST_TILT_RAD: Final = 0.7
_MOST_M: Final = 1e4
"""Nothing is so far away, and its square is a number still."""


class Unusable(StrEnum):
    """Why a cloud makes no scan."""

    FIELDS = "fields"
    """It has names for its columns, and x, y or z is none of them."""
    SHAPE = "shape"
    EMPTY = "empty"
    NOT_FINITE = "not_finite"
    """No point of it has three finite numbers, or its time is none."""
    TOO_FEW = "too_few"
    """Fewer than `min_points` are of its surroundings: the scanner is covered, or sees the robot alone."""
    TOO_LARGE = "too_large"
    OTHER_FRAME = "other_frame"


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """Points of one turn of a scanner in the robot's own frame: x forward, y left, z up from the ground below it [m].

    `points_m` is (n, 3) or wider, or an array with fields x, y and z. Missing returns are NaN. Roll and pitch (REP 103:
    nose down is positive) are those of the robot, where they are known: one with its front wheels on a step looks up,
    and level ground ahead of it seems to fall.
    """

    points_m: NDArray[Any]
    stamp_s: float
    frame_id: str = "base_link"
    roll_rad: float = 0.0
    pitch_rad: float = 0.0


@dataclass(frozen=True, slots=True)
class Refused:
    """A cloud that makes no scan, and a line for people."""

    reason: Unusable
    message: str


@dataclass(frozen=True, slots=True)
class ScanOptions:
    """UsageError: numbers that do not fit together."""

    frame_id: str = "base_link"
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.4)
    """Where the scanner is in that frame."""
    sectors: int = 360
    range_min_m: float = 0.35
    """What is nearer is the robot itself."""
    range_max_m: float = 10.0
    min_points: int = 30
    """A cloud of fewer is none."""
    min_obstacle_height: float = 0.10
    max_obstacle_height: float = 2.0
    """[m] above the ground, where Nav2 has them above the frame's zero."""
    max_slope_rad: float = 0.35
    max_rise_rad: float = 0.26
    """How much steeper than the ground before it ground may be."""
    max_fall_rad: float = 0.17
    """The same downwards, up to `drop_range_m`: behind an edge the next ray meets ground far away, little lower. Ground
    that falls a third as much and then rises steeply is a ditch."""
    step_m: float = 0.06
    """A step up that is driven over, and half as much more downwards."""
    drop_range_m: float = 4.0
    ring_elevations_rad: tuple[float, ...] = VLP16_RAD
    """Rings that meet the ground within `drop_range_m` must be there. None: missing ground is not looked for."""

    def __post_init__(self) -> None:
        if not (8 <= self.sectors <= 3600 and self.min_points >= 1):
            raise UsageError(
                f"a scan of {self.sectors} sectors from {self.min_points} points: give 8 to 3600, and 1 or more"
            )
        if not (0 <= self.range_min_m < self.range_max_m <= 100 and 0 < self.origin_m[2] < math.inf):
            raise UsageError(
                f"a scan from {self.range_min_m} m to {self.range_max_m} m, {self.origin_m[2]} m above the ground: "
                "0 <= range_min_m < range_max_m <= 100, and above 0"
            )
        if not 0 < self.step_m <= self.min_obstacle_height < self.max_obstacle_height:
            raise UsageError(
                f"obstacles from {self.min_obstacle_height} m to {self.max_obstacle_height} m, steps of {self.step_m} m"
                ": 0 < step_m <= min_obstacle_height < max_obstacle_height"
            )
        if not (math.isfinite(self.origin_m[0]) and math.isfinite(self.origin_m[1])):
            raise UsageError(f"a scanner at {self.origin_m} m: give finite numbers")
        if not all(0 < angle < 1.5 for angle in (self.max_slope_rad, self.max_rise_rad, self.max_fall_rad)):
            raise UsageError("max_slope_rad, max_rise_rad and max_fall_rad lie between 0 and 1.5")


@dataclass(frozen=True, slots=True, eq=False)
class ObstacleScan:
    """What a scan says of its surroundings, in bearings from the scanner, counter-clockwise from -π.

    `ranges_m` (sectors,): S_2D, the nearest obstacle or edge; inf where none is. `drops` (sectors,): it is an edge.
    `ground_m` (sectors, 2): from where to where ground was seen without an edge in it; 0, 0 where it was not.
    `points_m` (n, 2): all obstacles and edges in the robot's frame; `tops_m` (n,): how high they reach above
    the ground, 0 for edges. `lowest_m` (bins, sectors): how low the lowest ray passed above the ground; inf where none
    did. `bins_m` (bins + 1,): where the bins begin and end.
    """

    stamp_s: float
    origin_m: tuple[float, float]
    ranges_m: Floats
    drops: NDArray[np.bool_]
    ground_m: Floats
    points_m: Floats
    tops_m: Floats
    lowest_m: NDArray[np.float32]
    bins_m: Floats

    @property
    def bearings_rad(self) -> Floats:
        """(sectors,): the middles of the sectors."""
        return middles(len(self.ranges_m))


def middles(sectors: int) -> Floats:
    """The bearings of the middles of so many sectors, from -π on."""
    found: Floats = (np.arange(sectors, dtype=np.float64) + 0.5) * (_TURN / sectors) - math.pi
    return found


def turned(points: Floats, yaw_rad: float) -> Floats:
    """Points (..., 2) turned about the origin, counter-clockwise."""
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    found: Floats = points @ np.array([[cos, sin], [-sin, cos]])
    return found


def bin_edges_m(range_max_m: float) -> Floats:
    """The edges of the bins of distance: a tenth of a metre wide, two from 2.5 m on, four from 5 m on."""
    edges = [*(0.1 * number for number in range(25)), *(2.5 + 0.2 * number for number in range(12)), 4.9]
    while edges[-1] < range_max_m:
        edges.append(edges[-1] + 0.4)
    kept = [edge for edge in edges if edge < range_max_m]
    return np.array([*kept, range_max_m])


def obstacle_scan(cloud: Cloud, options: ScanOptions) -> ObstacleScan | Refused:
    """The scan of a cloud, or why it makes none. Whatever the cloud is, nothing is raised."""
    if cloud.frame_id != options.frame_id:
        return Refused(
            Unusable.OTHER_FRAME,
            f"a cloud in frame {cloud.frame_id!r}: transform it to {options.frame_id!r} first",
        )
    points = _columns(cloud.points_m)
    if isinstance(points, Refused):
        return points
    x, y = points[0] - np.float32(options.origin_m[0]), points[1] - np.float32(options.origin_m[1])
    z = points[2] - np.float32(options.origin_m[2])
    with np.errstate(over="ignore"):
        ranges_m = np.sqrt(x * x + y * y)
    # What is not finite is not so near either.
    usable = (ranges_m >= options.range_min_m) & (ranges_m <= _MOST_M) & (np.abs(z) <= _MOST_M)
    within = ranges_m < options.range_max_m
    near = np.flatnonzero(usable & within)
    used = np.concatenate((near, np.flatnonzero(usable & ~within)))
    if not math.isfinite(cloud.stamp_s) or not (len(used) or np.isfinite(points).all(axis=0).any()):
        return Refused(Unusable.NOT_FINITE, f"a cloud of {len(x)} points, none of them finite, or without a time")
    if len(used) < options.min_points:
        return Refused(
            Unusable.TOO_FEW,
            f"a cloud of {len(used)} points of the surroundings: {options.min_points} are the least; "
            "see whether the scanner is covered",
        )
    places = x.take(used), y.take(used), z.take(used)
    return _Reading(places, ranges_m.take(used), len(near), _level(cloud, options), options).scan(cloud.stamp_s)


def planar_scan(
    ranges_m: ArrayLike, angles_rad: ArrayLike, stamp_s: float, options: ScanOptions
) -> ObstacleScan | Refused:
    """The same of a planar scanner, whose ranges are as in sensor_msgs/LaserScan: inf where nothing is.

    It is believed to see whatever is in the way, as Nav2 does; NaN, and what is too near or far, says nothing.
    """
    ranges, angles = np.asarray(ranges_m, np.float64), np.asarray(angles_rad, np.float64)
    if ranges.ndim != 1 or ranges.shape != angles.shape or len(ranges) > MOST_POINTS:
        return Refused(Unusable.SHAPE, f"a scan of {ranges.shape} ranges, {angles.shape} angles: give as many of each")
    if not len(ranges):
        return Refused(Unusable.EMPTY, "a scan without ranges")
    used = (np.abs(angles) <= MOST_RAD) & (ranges >= options.range_min_m)  # and no NaN
    if not used.any() or not math.isfinite(stamp_s):
        return Refused(Unusable.NOT_FINITE, f"a scan of {len(ranges)} ranges of which none says anything")
    ranges, angles = ranges[used], angles[used]
    sectors = _sectors(angles, options.sectors)
    nearest = np.full(options.sectors, np.inf)
    np.minimum.at(nearest, sectors, np.where(ranges <= options.range_max_m, ranges, np.inf))
    seen_m = np.zeros(options.sectors)
    np.maximum.at(seen_m, sectors, np.minimum(ranges, options.range_max_m))
    seen_m = np.minimum(seen_m, nearest)
    bins_m = bin_edges_m(options.range_max_m)
    lowest = np.where(bins_m[1:, None] <= seen_m, 0.0, np.inf).astype(np.float32)
    ends = ranges <= options.range_max_m
    directions = np.stack((np.cos(angles[ends]), np.sin(angles[ends])), axis=1)
    points = ranges[ends, None] * directions + options.origin_m[:2]
    tops = np.full(len(points), options.origin_m[2])
    no_drops = np.zeros(options.sectors, np.bool_)
    ground = np.stack((np.zeros(options.sectors), seen_m), axis=1)
    return ObstacleScan(stamp_s, options.origin_m[:2], nearest, no_drops, ground, points, tops, lowest, bins_m)


def _columns(points: NDArray[Any]) -> NDArray[np.float32] | Refused:
    """The coordinates of a cloud, (3, n): a row each, since most of what is done with them goes along one."""
    if points.dtype.names is not None:
        missing = [name for name in ("x", "y", "z") if name not in points.dtype.names]
        if missing:
            return Refused(Unusable.FIELDS, f"a cloud without the field {missing[0]}: it has {points.dtype.names}")
        columns = [points[name].reshape(-1) for name in ("x", "y", "z")]
        if any(column.dtype.kind not in "fiu" or len(column) != points.size for column in columns):
            return Refused(Unusable.SHAPE, f"a cloud of {points.dtype}: x, y and z are a number each")
        points = np.stack(columns, axis=1)
    if points.dtype.kind not in "fiu" or points.ndim != 2 or points.shape[1] < 3:
        return Refused(Unusable.SHAPE, f"a cloud of {points.shape} {points.dtype}: give rows of x, y, z")
    if not len(points):
        return Refused(Unusable.EMPTY, "a cloud without points")
    if len(points) > MOST_POINTS:
        return Refused(Unusable.TOO_LARGE, f"a cloud of {len(points)} points: {MOST_POINTS} are the most")
    with np.errstate(over="ignore"):  # beyond float32 is infinite, and that is not finite
        return np.ascontiguousarray(points[:, :3].T, np.float32)


def _level(cloud: Cloud, options: ScanOptions) -> NDArray[np.float32]:
    """How level ground rises in the robot's frame at each bearing, (sectors,); none where its attitude is no use."""
    roll, pitch = cloud.roll_rad, cloud.pitch_rad
    if not (abs(roll) <= _MOST_TILT_RAD and abs(pitch) <= _MOST_TILT_RAD):  # and no NaN
        return np.zeros(options.sectors, np.float32)
    bearings = middles(options.sectors)
    rise = math.tan(pitch) / math.cos(roll) * np.cos(bearings) - math.tan(roll) * np.sin(bearings)
    return rise.astype(np.float32)


def _sectors(bearings_rad: NDArray[np.floating[Any]], sectors: int) -> Indices:
    turns = (bearings_rad + math.pi) * (sectors / _TURN)
    found: Indices = np.floor(turns, out=turns).astype(np.intp)
    beyond = (found < 0) | (found >= sectors)
    if beyond.any():  # few are, and whole numbers are slow to divide
        found[beyond] %= sectors
    return found


def _sectors_of(x: NDArray[np.float32], y: NDArray[np.float32], sectors: int) -> Indices:
    """The sectors of places, those that arctan2 gives, which alone takes a fifth of a scan.

    An odd polynomial of the lesser over the greater side says all of them but those so near to a border of two that its
    error counts; arctan2 says these.
    """
    across, along = np.abs(x), np.abs(y)
    steep = along > across
    share = np.minimum(across, along)
    share /= np.maximum(np.maximum(across, along), _LEAST)
    square = share * share
    turn = np.full(len(x), _ARCTAN[0], np.float32)
    for factor in _ARCTAN[1:]:
        turn *= square
        turn += factor
    turn *= share
    np.subtract(np.float32(math.pi / 2), turn, out=turn, where=steep)
    np.subtract(np.float32(math.pi), turn, out=turn, where=x < 0)
    np.copysign(turn, y, out=turn)
    turn += np.float32(math.pi)
    turn *= np.float32(sectors / _TURN)
    near = np.floor(turn)
    turn -= near
    turn -= np.float32(0.5)
    unsure = np.flatnonzero(np.abs(turn) > np.float32(0.5 - _ARCTAN_ERROR_RAD * sectors / _TURN))
    found: Indices = near.astype(np.intp)
    found[unsure] = _sectors(np.arctan2(y.take(unsure), x.take(unsure)), sectors)
    return found


class _Reading:
    """One cloud, x, y and z (n,) from the scanner on, first those within range: its walks outwards, all bearings at
    once."""

    def __init__(
        self,
        places: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]],
        ranges_m: NDArray[np.float32],
        within: int,
        level: NDArray[np.float32],
        options: ScanOptions,
    ) -> None:
        self._options = options
        self._level = level
        self._height_m = options.origin_m[2]
        self._bins_m = bin_edges_m(options.range_max_m)
        self._shape = len(self._bins_m) - 1, options.sectors
        self._r = ranges_m
        self._x, self._y, self._z = places[0], places[1], places[2] + np.float32(self._height_m)
        self._sector = _sectors_of(self._x, self._y, options.sectors)
        fine = np.arange(math.ceil(options.range_max_m / _FINE_M) + 1) * _FINE_M + 1e-6
        table = np.searchsorted(self._bins_m[1:-1], fine, side="right")
        self._near, self._far = slice(0, within), slice(within, None)
        number = table.take((self._r[self._near] / np.float32(_FINE_M)).astype(np.intp))
        self._key = number * options.sectors + self._sector[self._near]

    def scan(self, stamp_s: float) -> ObstacleScan:
        options, near, key = self._options, self._near, self._key
        r, z = self._r[near], self._z[near]
        ground = self._walk(r, z, key)
        over = z - (ground.z_m.take(key) + ground.slope.take(key) * (r - ground.r_m.take(key)))
        obstacle = np.flatnonzero((over >= options.min_obstacle_height) & (over <= options.max_obstacle_height))
        nearest = np.full(options.sectors, np.inf, np.float32)
        np.minimum.at(nearest, self._sector[obstacle], r[obstacle])
        ranges_m = nearest.astype(np.float64)
        edges_m = np.minimum(ground.edges_m, self._missing(ground, ranges_m))
        edges_m[edges_m >= ranges_m] = np.inf
        points_m, tops_m = self._marks(key[obstacle], over[obstacle], self._x[obstacle], self._y[obstacle])
        at_edge = np.isfinite(edges_m)
        bearings = middles(options.sectors)[at_edge]
        edge_points = edges_m[at_edge, None] * np.stack((np.cos(bearings), np.sin(bearings)), axis=1)
        points_m = np.concatenate((points_m, edge_points)) + options.origin_m[:2]
        tops_m = np.concatenate((tops_m, np.zeros(len(edge_points))))
        return ObstacleScan(
            stamp_s,
            options.origin_m[:2],
            np.minimum(ranges_m, edges_m),
            at_edge,
            self._extent(ground, edges_m),
            points_m,
            tops_m,
            self._lowest(ground),
            self._bins_m,
        )

    def _walk(self, r: NDArray[np.float32], z: NDArray[np.float32], key: Indices) -> "_Ground":
        """Walk outwards by the lowest point of each bin: ground, or too steep for it, or an edge before."""
        options, cells = self._options, self._shape[0] * self._shape[1]
        low_z = np.full(cells, np.inf, np.float32)
        np.minimum.at(low_z, key, z)
        up = z - low_z.take(key)
        lowest = np.flatnonzero(up <= 0)
        low_r = np.zeros(cells, np.float32)
        low_r[key.take(lowest)] = r.take(lowest)
        stands = self._stands(up, np.abs(r - low_r.take(key)), key).reshape(self._shape)
        low_z, low_r = low_z.reshape(self._shape), low_r.reshape(self._shape)
        ground = _Ground(self._shape)
        steepest, rise, fall = (
            np.float32(math.tan(angle)) for angle in (options.max_slope_rad, options.max_rise_rad, options.max_fall_rad)
        )
        at_r, at_z, slope = (np.zeros(options.sectors, np.float32) for _ in range(3))
        ditch_m = np.full(options.sectors, np.inf)  # the edge of one, if what comes next is its other side
        ditches = False
        least_m, full_m, one = np.float32(1e-3), np.float32(0.2), np.float32(1)
        step, sinks = np.float32(options.step_m), np.float32(-1.5 * options.step_m)
        height = np.float32(self._height_m)
        seen = np.isfinite(low_z)
        anything = np.asarray(seen.any(axis=1))
        low_z[~seen] = 0  # as good as any: what comes of it is not asked for
        may_be_ground = seen & ~stands
        unbegun = np.flatnonzero(seen.any(axis=0))
        for number in range(self._shape[0]):
            if not anything[number]:
                ground.z_m[number], ground.r_m[number], ground.slope[number] = at_z, at_r, slope
                continue
            there, r_m, z_m = seen[number], low_r[number], low_z[number]
            along = np.maximum(r_m - at_r, least_m)
            up = z_m - at_z
            tilt = up / along
            before = slope
            begins = unbegun[there[unbegun]] if len(unbegun) else unbegun
            if len(begins):
                # At first it goes on as the robot stands, or level, whichever is nearer to what is seen.
                first, level = tilt[begins], self._level[begins]
                before = slope.copy()
                before[begins] = np.where(np.abs(first - level) < np.abs(first), level, 0)
            bend = tilt - before
            too_steep = (up > step) & ((tilt > steepest) | (bend > rise))
            is_ground = np.greater(may_be_ground[number], too_steep)  # may be, and is not too steep
            sunk = there & (bend * along < sinks)
            dips = None
            if np.count_nonzero(sunk):
                # What the ray to the ground before is above has not sunk: that was no ground, but a part of a wall.
                over = (z_m - height) * at_r > (at_z - height + _OVER * at_r) * r_m
                is_ground &= over | ~sunk
                sunk &= over
                close = at_r <= options.drop_range_m
                falls = sunk & ((tilt < -steepest) | ((bend < -fall) & close))
                dips = sunk & (bend < -fall / 3) & close
                at = np.flatnonzero(dips | falls)
                if len(at):
                    edges_m = self._edges_m(at_r[at], at_z[at], before[at], r_m[at], z_m[at])
                    falling = falls[at]
                    ground.edges_m[at[falling]] = np.minimum(ground.edges_m[at], edges_m)[falling]
                    dipping = dips[at]
                    ditch_m[at[dipping]] = edges_m[dipping]
                    is_ground &= ~falls
                    ditches = True
            if ditches:
                other_side = there & too_steep
                if dips is not None:
                    other_side |= dips & stands[number]
                ground.edges_m = np.where(other_side, np.minimum(ground.edges_m, ditch_m), ground.edges_m)
                ditch_m[is_ground if dips is None else is_ground & ~dips] = np.inf
                ditches = bool(ditch_m.min() < np.inf)
            np.copyto(at_z, z_m, where=is_ground)
            np.copyto(at_r, r_m, where=is_ground)
            # Two points close to each other say little of a slope.
            limited = np.minimum(np.maximum(tilt, -steepest), steepest) * np.minimum(along / full_m, one)
            np.copyto(slope, limited, where=is_ground)
            if len(begins):
                unbegun = unbegun[~is_ground[unbegun]]
            ground.seen[number] = is_ground
            ground.z_m[number], ground.r_m[number], ground.slope[number] = at_z, at_r, slope
        return ground

    def _stands(self, up: NDArray[np.float32], away: NDArray[np.float32], key: Indices) -> NDArray[np.bool_]:
        """Bins in which something rises too steeply above the lowest point, which is then its foot and no ground.

        `up`, `away`: how far points are above it and from it.
        """
        along = away * np.float32(math.tan(self._options.max_slope_rad))
        steep = (up > np.maximum(along, self._options.step_m)) & (up <= self._options.max_obstacle_height)
        found = np.zeros(self._shape[0] * self._shape[1], np.bool_)
        found[key[np.flatnonzero(steep)]] = True
        return found

    def _edges_m(
        self,
        at_r: NDArray[np.float32],
        at_z: NDArray[np.float32],
        slope: NDArray[np.float32],
        low_r: NDArray[np.float32],
        low_z: NDArray[np.float32],
    ) -> Floats:
        """Where the ground ends that goes on from a place with a slope, if a ray that passes it ends lower.

        The edge lies between the last ground and where the ray goes below it. The middle is the least off; where the
        two are far apart it is said late rather than where ground is, and better when the robot is nearer.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            ray = (self._height_m - low_z) / low_r
            ahead = (self._height_m - at_z + slope * at_r) / (slope + ray)
            edges = np.maximum((at_r + ahead) / 2, ahead - _BEFORE_M)
        return np.maximum(edges.astype(np.float64), self._options.range_min_m)

    def _missing(self, ground: "_Ground", ranges_m: Floats) -> Floats:
        """Where ground is missing, (sectors,): two rings that should meet it meet nothing, and all below them do.

        They should meet it where it would be if it went on as it was last seen.
        """
        options = self._options
        edges_m = np.full(options.sectors, np.inf)
        rings = np.array(sorted(angle for angle in options.ring_elevations_rad if angle < 0))
        if len(rings) < 3:
            return edges_m
        # Only rings that should meet it so near are asked about, and the one above them: few points are of those.
        meeting = int(np.count_nonzero(self._height_m / np.tan(-rings) <= options.drop_range_m))
        gap_rad = float(np.diff(rings).min())
        highest = np.float32(math.tan(rings[min(meeting, len(rings) - 1)] + gap_rad))
        low = np.flatnonzero(self._z - np.float32(self._height_m) < highest * self._r)
        elevations = np.arctan2(self._z[low] - np.float32(self._height_m), self._r[low])
        there, sector = np.zeros((len(rings), options.sectors), np.bool_), self._sector[low]
        for number in range(min(meeting + 1, len(rings))):
            there[number, sector[np.abs(elevations - np.float32(rings[number])) < np.float32(gap_rad / 2)]] = True
        # A scanner with few bearings leaves some sectors out, by chance other ones in each ring.
        there |= np.roll(there, 1, axis=1) | np.roll(there, -1, axis=1)
        below = np.logical_and.accumulate(there, axis=0)
        last_m, z_m, slope = ground.r_m[-1], ground.z_m[-1], ground.slope[-1]
        for number in range(1, min(meeting, len(rings) - 1)):
            with np.errstate(divide="ignore", invalid="ignore"):
                meets_m = (self._height_m - z_m + slope * last_m) / (slope + np.float32(math.tan(-rings[number])))
            gone = below[number - 1] & ~there[number] & ~there[number + 1]
            gone &= (last_m < meets_m) & (meets_m <= options.drop_range_m) & (meets_m < ranges_m)
            edges_m = np.where(gone, np.minimum(edges_m, (last_m + meets_m) / 2), edges_m)
        return edges_m

    def _extent(self, ground: "_Ground", edges_m: Floats) -> Floats:
        """Where ground begins and ends, (sectors, 2): from the first that was seen on, up to an edge."""
        starts, ends = self._bins_m[:-1, None], self._bins_m[1:, None]
        seen = ground.seen & (starts < edges_m)
        first = np.where(seen, starts, np.inf).min(axis=0)
        last = np.where(seen, np.minimum(ends, edges_m), 0.0).max(axis=0)
        return np.stack((np.where(last > 0, first, 0.0), last), axis=1)

    def _marks(
        self, key: Indices, over: NDArray[np.float32], x: NDArray[np.float32], y: NDArray[np.float32]
    ) -> tuple[Floats, Floats]:
        """One point for each bin of a sector that has an obstacle, and how high it is there."""
        tops = np.full(self._shape[0] * self._shape[1], -np.inf, np.float32)
        np.maximum.at(tops, key, over)
        at_x, at_y = np.empty(len(tops), np.float32), np.empty(len(tops), np.float32)
        at_x[key], at_y[key] = x, y
        there = np.flatnonzero(np.isfinite(tops))
        places = np.stack((at_x[there], at_y[there]), axis=1)
        return places.astype(np.float64), tops[there].astype(np.float64)

    def _lowest(self, ground: "_Ground") -> NDArray[np.float32]:
        """How low the lowest ray beyond each bin passes; one that ends on the ground shows all of it."""
        flattest = np.full(self._shape[0] * self._shape[1], np.inf, np.float32)
        inclination = (self._z - np.float32(self._height_m)) / self._r
        np.minimum.at(flattest, self._key, inclination[self._near])
        np.minimum.at(flattest[-self._shape[1] :], self._sector[self._far], inclination[self._far])
        beyond = np.minimum.accumulate(flattest.reshape(self._shape)[::-1], axis=0)[::-1]
        lowest = np.full(self._shape, np.inf, np.float32)
        middle = ((self._bins_m[1:] + self._bins_m[:-1]) / 2).astype(np.float32)[:-1, None]
        level = ground.z_m[:-1] + ground.slope[:-1] * (middle - ground.r_m[:-1])
        lowest[:-1] = np.float32(self._height_m) + middle * beyond[1:] - level
        lowest[lowest < -1.5 * self._options.step_m] = np.inf  # a ray below the ground goes over a hole
        lowest[ground.seen] = 0.0
        return np.maximum(lowest, 0)


class _Ground:
    """The ground by bin and sector (bins, sectors): its height where it was last seen, at which range, how steep."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self.z_m = np.zeros(shape, np.float32)
        self.r_m = np.zeros(shape, np.float32)
        self.slope = np.zeros(shape, np.float32)
        self.seen = np.zeros(shape, np.bool_)
        self.edges_m = np.full(shape[1], np.inf)
