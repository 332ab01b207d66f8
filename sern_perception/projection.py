"""Clouds as range images: rows of elevations from top to bottom, columns of bearings from behind over left, ahead and
right. The middle of column c is at a bearing of half a turn less c steps, so that a scanner whose first ray looks
straight back has each ray in the middle of a pixel, and none on the edge between two.

The spherical projection of SqueezeSeg (Wu et al., ICRA 2018) over the whole circle. Where several points fall into one
pixel the nearest is kept: what is behind it is not in the way first.
"""

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sern_core.vocabulary.errors import BodyError, UsageError

CHANNELS: Final = 5
"""x, y, z, intensity and range, as the network takes them. Intensity is in per cent, as the stand-in's."""
MOST_POINTS: Final = 1_000_000
NEAR_M: Final = 0.05
FAR_M: Final = 200.0
"""What is nearer is the robot itself, or noise; what is further, no scanner of a ground robot sees."""


@dataclass(frozen=True, slots=True)
class ImageShape:
    """`low_rad` and `high_rad` are the elevations of the lowest and the highest ring.

    UsageError: fewer than 2 rows or 8 columns, or elevations that do not rise between straight down and straight up.
    """

    rows: int
    columns: int
    low_rad: float
    high_rad: float

    def __post_init__(self) -> None:
        if self.rows < 2 or self.columns < 8:
            raise UsageError(f"a range image of {self.rows} x {self.columns}: give 2 rows and 8 columns at least")
        if not -math.pi / 2 < self.low_rad < self.high_rad < math.pi / 2:
            raise UsageError(f"elevations from {self.low_rad} to {self.high_rad} rad: they rise, within half a turn")


VLP16: Final = ImageShape(16, 900, math.radians(-15.0), math.radians(15.0))
"""Velodyne VLP-16, the stand-in's scanner."""
HDL64: Final = ImageShape(64, 512, math.radians(-24.9), math.radians(2.0))
"""Velodyne HDL-64, as SqueezeSeg crops it, over the whole circle."""


class RangeImage(NamedTuple):
    """`channels`: (5, rows, columns) of x, y, z [m], intensity and range [m], 0 where nothing is. `points`: which point
    of the cloud each pixel is, (rows, columns), -1 for none. `unused`: how many points are in no pixel, by reason."""

    channels: NDArray[np.float32]
    points: NDArray[np.int32]
    unused: dict[str, int]

    @property
    def seen(self) -> NDArray[np.bool_]:
        found: NDArray[np.bool_] = self.points >= 0
        return found


def project(cloud: ArrayLike, shape: ImageShape = VLP16) -> RangeImage:
    """The image of a cloud in the scanner's frame, (n, 3) x, y, z or (n, 4) with intensity; more columns are ignored.

    Points that are not finite (`nan`), too near or too far (`range`), above or below the rings by more than half of
    their distance (`elevation`), or behind a nearer one (`hidden`) are counted. BodyError: another shape, too many.
    """
    points = np.asarray(cloud, np.float32)
    if points.ndim != 2 or points.shape[1] < 3 or len(points) > MOST_POINTS:
        raise BodyError(f"a cloud of {points.shape}: give at most {MOST_POINTS} rows of x, y, z and intensity")
    finite = np.asarray(np.isfinite(points[:, :3]).all(axis=1))
    x_m, y_m, z_m = np.where(finite[:, None], points[:, :3], 0.0).T
    with np.errstate(over="ignore"):  # infinite is too far
        flat_m = np.hypot(x_m, y_m)
        ranges_m = np.hypot(flat_m, z_m)
    within = finite & (ranges_m >= NEAR_M) & (ranges_m <= FAR_M)
    ring = (shape.high_rad - shape.low_rad) / (shape.rows - 1)
    rows = np.rint((shape.high_rad - np.arctan2(z_m, flat_m)) / ring).astype(np.int32)
    on_rings = within & (rows >= 0) & (rows < shape.rows)
    columns = np.rint((0.5 - np.arctan2(y_m, x_m) / math.tau) * shape.columns).astype(np.int32) % shape.columns
    order = np.flatnonzero(on_rings)
    order = order[np.argsort(-ranges_m[order], kind="stable")]  # the nearest is written last
    numbers = np.full((shape.rows, shape.columns), -1, np.int32)
    numbers[rows[order], columns[order]] = order
    there = numbers >= 0
    kept = numbers[there]
    channels = np.zeros((CHANNELS, shape.rows, shape.columns), np.float32)
    channels[:3, there] = points[kept, :3].T
    if points.shape[1] > 3:
        channels[3, there] = np.nan_to_num(points[kept, 3], nan=0.0, posinf=0.0, neginf=0.0)
    channels[4, there] = ranges_m[kept]
    unused = {
        "nan": int(np.count_nonzero(~finite)),
        "range": int(np.count_nonzero(finite & ~within)),
        "elevation": int(np.count_nonzero(within & ~on_rings)),
        "hidden": int(len(order) - len(kept)),
    }
    return RangeImage(channels, numbers, unused)


def of_points(image: RangeImage, pixels: NDArray[np.uint8], points: int) -> NDArray[np.uint8]:
    """What an image of classes says of each of so many points of its cloud, (points,); 0 for those in no pixel."""
    found = np.zeros(points, np.uint8)
    there = image.seen
    found[image.points[there]] = pixels[there]
    return found
