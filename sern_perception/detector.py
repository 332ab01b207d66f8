"""What stands in the way, whatever it is: clusters that rise from the ground of a range image, without any learning.

Ground is followed from the lowest ring up, column by column, while it does not rise too steeply; what is left is joined
where neighbouring rays meet one surface by their angle (Bogoslavskyi and Stachniss, IROS 2016).
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import csgraph

from sern_perception.projection import ImageShape, RangeImage

STEEPEST_RAD: Final = math.radians(20.0)
"""Ground that rises more is none: twice as much as a Jackal climbs, so that an edge that is hit once counts."""
ABOVE_M: Final = 0.08
"""What is no higher above the ground before it is a stone to drive over."""
TALL_M: Final = 0.7
"""What is higher above the ground than a robot is not in its way."""
SAME_RAD: Final = math.radians(10.0)
"""Two rays meet one surface where the line between the two points makes so much with the longer ray."""
SAME_M: Final = 0.3
"""Or where the two points are so near: the side of a thing is met at a sharp angle."""
FEWEST: Final = 3
GAP: Final = 2
"""Rays that far apart are neighbours where no ray between them came back: scanners lose single points, and two rays of
one that is not in step with the columns may share a pixel."""
SOFT_M: Final = 0.03
"""Two points of one ring are on the ground within so much of each other, whatever the angle: it is noisy."""


@dataclass(frozen=True, slots=True)
class Cluster:
    """`pixels`: (n, 2) rows and columns. `middle_m`: x, y, z. `size_m`: along x, y and z. `above_m`: how high over the
    ground before it."""

    pixels: NDArray[np.int64]
    middle_m: tuple[float, float, float]
    size_m: tuple[float, float, float]
    above_m: float


def ground_of(image: RangeImage) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
    """Which pixels are ground, and how high each is above the ground before it in its column [m], (rows, columns).

    Where nothing is ground yet, the ground is that below the scanner, as the lowest ring in the median has it.
    """
    x_m, y_m, z_m = image.channels[:3]
    flat_m, seen = np.hypot(x_m, y_m), image.seen
    rows, columns = seen.shape
    lowest = seen[-1] if seen[-1].any() else seen.any(axis=0)
    under_m = float(np.median(z_m[-1][lowest])) if seen[-1].any() else float(z_m[seen].min(initial=0.0))
    at_m, high_m = np.zeros(columns, np.float32), np.full(columns, under_m, np.float32)
    ground, above_m = np.zeros(seen.shape, np.bool_), np.zeros(seen.shape, np.float32)
    for row in range(rows - 1, -1, -1):
        on_m = np.maximum(flat_m[row] - at_m, 1e-3)
        rises_m = z_m[row] - high_m
        flat = np.abs(rises_m) <= np.maximum(on_m * math.tan(STEEPEST_RAD), SOFT_M)
        here = seen[row] & flat & (flat_m[row] > at_m - SOFT_M)
        ground[row] = here
        above_m[row] = np.where(seen[row], rises_m, 0.0)
        at_m = np.where(here, flat_m[row], at_m)
        high_m = np.where(here, z_m[row], high_m)
    return ground, above_m


def clusters(image: RangeImage, shape: ImageShape) -> list[Cluster]:
    """What stands on the ground, the largest first."""
    ground, above_m = ground_of(image)
    stands = image.seen & ~ground & (above_m > ABOVE_M) & (above_m < TALL_M)
    numbers = np.full(stands.shape, -1, np.int64)
    places = np.argwhere(stands)
    numbers[stands] = np.arange(len(places))
    if not len(places):
        return []
    ring_rad, column_rad = (shape.high_rad - shape.low_rad) / (shape.rows - 1), math.tau / shape.columns
    joined = [
        _joined(image, numbers, axis, gap, gap * step_rad)
        for axis, step_rad in ((1, column_rad), (0, ring_rad))
        for gap in range(1, GAP + 1)
    ]
    ends = np.concatenate(joined)
    edges = sparse.coo_matrix((np.ones(len(ends), np.int8), (ends[:, 0], ends[:, 1])), shape=(len(places),) * 2)
    count, which = csgraph.connected_components(edges, directed=False)
    sizes = np.bincount(which, minlength=count)
    found = []
    for label in np.argsort(-sizes, kind="stable"):
        if sizes[label] < FEWEST:
            break
        pixels = places[which == label]
        points_m = image.channels[:3, pixels[:, 0], pixels[:, 1]]
        low, high = points_m.min(axis=1), points_m.max(axis=1)
        middle, size = (low + high) / 2, high - low
        found.append(
            Cluster(
                pixels,
                (float(middle[0]), float(middle[1]), float(middle[2])),
                (float(size[0]), float(size[1]), float(size[2])),
                float(above_m[pixels[:, 0], pixels[:, 1]].max()),
            )
        )
    return found


def standing(image: RangeImage, shape: ImageShape) -> NDArray[np.bool_]:
    """Pixels of all clusters, (rows, columns)."""
    found = np.zeros(image.points.shape, np.bool_)
    for cluster in clusters(image, shape):
        found[cluster.pixels[:, 0], cluster.pixels[:, 1]] = True
    return found


def _joined(image: RangeImage, numbers: NDArray[np.int64], axis: int, gap: int, apart_rad: float) -> NDArray[np.int64]:
    """Pairs of numbers, (n, 2), of neighbours in a column (axis 0) or a ring (axis 1, which is round) that are one
    surface, `gap` pixels apart with nothing seen between them."""
    ranges_m = image.channels[4]
    there, far_m = np.roll(numbers, -gap, axis=axis), np.roll(ranges_m, -gap, axis=axis)
    both = (numbers >= 0) & (there >= 0)
    for between in range(1, gap):
        both &= ~np.roll(image.seen, -between, axis=axis)
    if axis == 0:
        both[-gap:] = False
    longer, shorter = np.maximum(ranges_m, far_m)[both], np.minimum(ranges_m, far_m)[both]
    angle = np.arctan2(shorter * math.sin(apart_rad), longer - shorter * math.cos(apart_rad))
    apart_m = np.sqrt(longer**2 + shorter**2 - 2 * longer * shorter * math.cos(apart_rad))
    one = (angle > SAME_RAD) | (apart_m <= SAME_M)
    return np.stack((numbers[both][one], there[both][one]), axis=1)
