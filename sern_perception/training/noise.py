"""Noise that scans show, put on others: SqueezeSegV2's dropout noise, by distance, and that of ranges.

Neither needs labels, so that labelled scans can be given the noise of another scanner.
"""

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sern_perception.training.scans import Scans

INTENSITY: Final = 3
RANGE: Final = 4
"""The channels."""
LOST_BINS_M: Final = np.linspace(0.0, 30.0, 11)
"""Ranges over which the share of lost points is counted apart."""
LEVEL: Final = 0.1
"""Two neighbours are of one surface if their ranges differ by no more of themselves."""


class Noise(NamedTuple):
    """`range_m`: standard deviation of ranges. `lost`: share of points that are missing, by `LOST_BINS_M`."""

    range_m: float
    lost: NDArray[np.float64]


def noise_of(channels: NDArray[np.float32]) -> Noise:
    """Noise that scans show, (n, 5, rows, columns). A point is lost where both of its neighbours on the ring are there
    and of one surface; noise is the bend of a ring at three points in a row, in the median, so that edges of things do
    not count."""
    ranges_m = channels[:, RANGE]
    before_m, after_m = np.roll(ranges_m, 1, axis=2), np.roll(ranges_m, -1, axis=2)
    middle_m = (before_m + after_m) / 2
    level = (before_m > 0) & (after_m > 0) & (np.abs(before_m - after_m) <= LEVEL * middle_m)
    which = np.clip(np.digitize(middle_m[level], LOST_BINS_M) - 1, 0, len(LOST_BINS_M) - 2)
    there = ranges_m[level] > 0
    all_of = np.bincount(which, minlength=len(LOST_BINS_M) - 1)
    gone = np.bincount(which[~there], minlength=len(LOST_BINS_M) - 1)
    bends_m = (ranges_m - middle_m)[level & (ranges_m > 0)]
    spread_m = 1.4826 * float(np.median(np.abs(bends_m))) if bends_m.size else 0.0
    return Noise(spread_m / math.sqrt(1.5), gone / np.maximum(1, all_of))


def noised(scans: Scans, wanted: Noise, draw: np.random.Generator) -> Scans:
    """The same scans with as much noise as `wanted`; what they have themselves counts towards it."""
    own = noise_of(scans.channels)
    more_m = math.sqrt(max(0.0, wanted.range_m**2 - own.range_m**2))
    more = np.clip(1.0 - (1.0 - wanted.lost) / np.maximum(1e-9, 1.0 - own.lost), 0.0, 1.0)
    ranges_m = scans.channels[:, RANGE]
    middles_m = (LOST_BINS_M[1:] + LOST_BINS_M[:-1]) / 2
    kept = (ranges_m > 0) & (draw.random(ranges_m.shape) >= np.interp(ranges_m, middles_m, more))
    nearer = 1.0 + draw.normal(0.0, more_m, ranges_m.shape) / np.maximum(ranges_m, 0.1)
    channels = scans.channels * kept[:, None]
    channels[:, [0, 1, 2, RANGE]] *= nearer[:, None].astype(np.float32)
    return Scans(channels, scans.labels * kept)
