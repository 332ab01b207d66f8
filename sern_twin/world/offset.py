"""How far off an object is in another world: the error of a patch that was added in one and seen in the other.

Where an object is, is the mean of its cells, weighted by how occupied they are: finer than a cell. A scanner sees the
near side of an object alone, which draws the mean to it by up to half of the object's depth.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import ndimage

from sern_core.vocabulary.errors import UsageError
from sern_twin.world.grid import Floats, Grid, need_cells
from sern_twin.world.patches import Cells

THRESHOLD: Final = 65
"""Per cent from which a cell counts as occupied: that of ROS's map server."""
_ALL_AROUND: Final = np.ones((3, 3), np.bool_)


@dataclass(frozen=True, slots=True)
class Sighting:
    """An object on a grid: its middle and how many cells it has."""

    east_m: float
    north_m: float
    cells: int


@dataclass(frozen=True, slots=True)
class ObjectOffset:
    """From where the object is in the first world to where it is in the second."""

    east_m: float
    north_m: float
    first: Sighting
    second: Sighting

    @property
    def distance_m(self) -> float:
        return math.hypot(self.east_m, self.north_m)


def find(
    grid: Grid,
    cells: Cells,
    place_m: tuple[float, float],
    radius_m: float,
    *,
    threshold: int = THRESHOLD,
    before: Cells | None = None,
) -> Sighting | None:
    """The object whose middle is nearest to a place: cells at or above `threshold` that touch, corners too.

    `before` is the same world without the object: what was occupied in it is no part of the object, such as a wall
    that it stands at. None: no object has its middle within the radius.

    UsageError: cells that are not the grid's, a place or radius that is not finite, a threshold that is not 1 to 100.
    """
    need_cells(cells, grid.shape, "a world")
    if not (all(map(math.isfinite, place_m)) and math.isfinite(radius_m) and radius_m > 0):
        raise UsageError(f"an object within {radius_m} m of {place_m}: give metres, and a radius above 0")
    if not 1 <= threshold <= 100:
        raise UsageError(f"a threshold of {threshold}: give 1 to 100 per cent")
    occupied = cells >= threshold
    if before is not None:
        need_cells(before, grid.shape, "the world before")
        occupied &= before < threshold
    labels, count = ndimage.label(occupied, _ALL_AROUND)
    if not count:
        return None
    numbers = np.arange(1, count + 1)
    middles: Floats = np.array(ndimage.center_of_mass(np.maximum(cells, 0).astype(np.float64), labels, numbers))
    places = grid.centres(middles[:, 0], middles[:, 1])
    distances_m = np.hypot(*(places - place_m).T)
    nearest = int(np.argmin(distances_m))
    if distances_m[nearest] > radius_m:
        return None
    east_m, north_m = places[nearest].tolist()
    return Sighting(east_m, north_m, int(np.count_nonzero(labels == numbers[nearest])))


def object_offset(
    first: tuple[Grid, Cells],
    second: tuple[Grid, Cells],
    place_m: tuple[float, float],
    radius_m: float,
    *,
    threshold: int = THRESHOLD,
    before: tuple[Cells | None, Cells | None] = (None, None),
) -> ObjectOffset | None:
    """How far the object near a place is off between two worlds, each with a grid of its own in one frame.

    In the second it is looked for around where it is in the first, within the radius. None: one of them has none.

    UsageError: as `find`, or grids of different frames.
    """
    if (first[0].frame_id, first[0].plane) != (second[0].frame_id, second[0].plane):
        raise UsageError(f"two worlds in the frames {first[0].frame_id} and {second[0].frame_id}: give both in one")
    one = find(*first, place_m, radius_m, threshold=threshold, before=before[0])
    if one is None:
        return None
    other = find(*second, (one.east_m, one.north_m), radius_m, threshold=threshold, before=before[1])
    if other is None:
        return None
    return ObjectOffset(other.east_m - one.east_m, other.north_m - one.north_m, one, other)
