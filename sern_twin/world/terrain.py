"""The ground of a site: heights of an elevation raster on a grid, their normals, and a mesh for a viewer."""

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from sern_core.vocabulary.errors import UsageError
from sern_twin.geodesy import TangentPlane
from sern_twin.world.grid import Floats, Grid
from sern_twin.world.mesh import Mesh, no_mesh

Fill = Literal["nearest", "none"]

MOST_PIXELS: Final = 4_000_000
LOWEST_M: Final = -12_000.0
HIGHEST_M: Final = 9_000.0
"""The Earth's surface lies within. What lies beyond is a raster's word for no height, such as -32768."""
_FIT_PIXELS: Final = 10_000
_STEPS: Final = 5
"""To the pixel of a place. A map projection is so nearly straight that each step is a thousand times nearer."""
_LEAST_WEIGHT: Final = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class ElevationRaster:
    """Heights [m] and where the middles of the pixels are [rad], each (rows, columns); NaN: no data.

    Rows and columns may lie in any direction, so that a raster of any map projection fits, but for sharp bends.

    UsageError: shapes that differ, fewer than two pixels either way, more than `MOST_PIXELS`, places that are none.
    """

    heights_m: Floats
    latitudes_rad: Floats
    longitudes_rad: Floats

    def __post_init__(self) -> None:
        shape = self.heights_m.shape
        if len(shape) != 2 or min(shape) < 2 or not shape == self.latitudes_rad.shape == self.longitudes_rad.shape:
            raise UsageError(
                f"an elevation raster of {shape}: give heights, latitudes, longitudes of two pixels or more"
            )
        if self.heights_m.size > MOST_PIXELS:
            raise UsageError(f"an elevation raster of {self.heights_m.size} pixels: {MOST_PIXELS} are the most")
        if not ((np.abs(self.latitudes_rad) < np.pi / 2).all() and (np.abs(self.longitudes_rad) <= 2 * np.pi).all()):
            raise UsageError("an elevation raster with places that are none: give latitudes and longitudes in radians")


@dataclass(frozen=True, slots=True)
class Resampling:
    """How many cells did not get their height from four pixels."""

    partial: int = 0
    """From those of the four around that have data."""
    no_data: int = 0
    """None of them has."""
    outside: int = 0
    """The raster does not reach there."""


class Terrain:
    """Heights [m] above the plane of the site, at the middles of a grid's cells. NaN: not known.

    UsageError: heights of another shape.
    """

    def __init__(self, grid: Grid, heights_m: Floats, resampling: Resampling | None = None) -> None:
        if heights_m.shape != grid.shape:
            raise UsageError(f"a terrain of {heights_m.shape} for a grid of {grid.shape}")
        self.grid: Final = grid
        self.heights_m: Final = heights_m
        self.resampling: Final = resampling or Resampling()

    def height_m(self, east_m: ArrayLike, north_m: ArrayLike) -> Floats:
        """The height [m] at places, between the middles of cells; NaN outside the grid and where none is known."""
        east, north = np.broadcast_arrays(np.asarray(east_m, np.float64), np.asarray(north_m, np.float64))
        grid = self.grid
        rows, _columns = grid.index(np.stack((east, north), axis=-1))
        inside = rows >= 0
        along = np.where(inside, (north - grid.south_m) / grid.cell_m - 0.5, 0.0)
        across = np.where(inside, (east - grid.west_m) / grid.cell_m - 0.5, 0.0)
        heights, _weight = _between(self.heights_m, along, across)
        found: Floats = np.where(inside, heights, np.nan)
        return found

    def normals(self) -> Floats:
        """Unit vectors that stand on the ground, (rows, columns, 3); NaN beside heights that are not known."""
        slopes = [
            np.gradient(self.heights_m, self.grid.cell_m, axis=axis)
            if self.heights_m.shape[axis] > 1
            else np.zeros(self.grid.shape)
            for axis in (1, 0)
        ]
        normals = np.stack((-slopes[0], -slopes[1], np.ones(self.grid.shape)), axis=-1)
        found: Floats = normals / np.linalg.norm(normals, axis=-1, keepdims=True)
        return found

    def mesh(self, step: int = 1) -> Mesh:
        """Triangles between the middles of every `step`-th cell, and of the last ones, so that it reaches as far.

        There are none where a height is not known. UsageError: a step below 1.
        """
        if step < 1:
            raise UsageError(f"a mesh of every {step}-th cell: give 1 or more")
        rows, columns = (np.unique([*range(0, size, step), size - 1]) for size in self.grid.shape)
        if len(rows) < 2 or len(columns) < 2:
            return no_mesh()
        heights = self.heights_m[np.ix_(rows, columns)]
        places = self.grid.centres(rows[:, None], columns)
        vertices = np.concatenate((places, heights[..., None]), axis=-1).reshape(-1, 3)
        numbers = np.arange(heights.size).reshape(heights.shape)
        south_west, south_east, north_east, north_west = (
            numbers[:-1, :-1].ravel(), numbers[:-1, 1:].ravel(), numbers[1:, 1:].ravel(), numbers[1:, :-1].ravel(),
        )  # fmt: skip
        faces = np.concatenate(
            (
                np.stack((south_west, south_east, north_east), axis=1),
                np.stack((south_west, north_east, north_west), axis=1),
            )
        )
        faces = faces[np.isfinite(vertices[:, 2])[faces].all(axis=1)]
        used, numbered = np.unique(faces, return_inverse=True)
        return Mesh(vertices[used].astype(np.float32), numbered.reshape(faces.shape).astype(np.int32))


def flat(grid: Grid, height_m: float = 0.0) -> Terrain:
    """The same height everywhere."""
    return Terrain(grid, np.full(grid.shape, height_m, np.float64))


def resampled(raster: ElevationRaster, grid: Grid, *, fill: Fill = "nearest") -> Terrain:
    """The terrain of a grid out of an elevation raster, bilinear between the middles of its pixels.

    Where there is no data it is the height of the nearest pixel that has some, or NaN with `fill` none; both are
    counted in `resampling`. Height is that of the raster less the plane's: both above the same zero (ellipsoid, geoid).

    UsageError: the grid has no plane, nothing in the raster is a height, its pixels lie in one line.
    """
    if grid.plane is None:
        raise UsageError("the grid does not say where on the Earth it is: give it a plane")
    known = (raster.heights_m >= LOWEST_M) & (raster.heights_m <= HIGHEST_M)  # and no NaN
    if not known.any():
        raise UsageError("the elevation raster has no heights, only pixels without data")
    heights_m = np.where(known, raster.heights_m, np.nan)
    rows, columns = _pixels(raster, grid.plane, grid.all_centres())
    last = np.array(heights_m.shape) - 1
    outside = (rows < -0.5) | (rows > last[0] + 0.5) | (columns < -0.5) | (columns > last[1] + 0.5)
    rows, columns = np.clip(rows, 0, last[0]), np.clip(columns, 0, last[1])
    found, weight = _between(heights_m, rows, columns)
    found[outside] = np.nan
    lacking = np.isnan(found)
    counts = Resampling(
        partial=int(np.count_nonzero(~lacking & (weight < 1 - _LEAST_WEIGHT))),
        no_data=int(np.count_nonzero(lacking & ~outside)),
        outside=int(np.count_nonzero(outside)),
    )
    if fill == "nearest":
        near = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
        row, column = np.rint(rows[lacking]).astype(np.int64), np.rint(columns[lacking]).astype(np.int64)
        found[lacking] = heights_m[near[0][row, column], near[1][row, column]]
    return Terrain(grid, found - grid.plane.height_m, counts)


def _pixels(raster: ElevationRaster, plane: TangentPlane, places_m: Floats) -> tuple[Floats, Floats]:
    """Rows and columns, with fractions, of places: an affine map fitted to the raster, then Newton's steps."""
    geodetic = np.stack((raster.latitudes_rad, raster.longitudes_rad, np.zeros(raster.heights_m.shape)), axis=-1)
    local = plane.to_local(geodetic)[..., :2]
    middle = local.mean(axis=(0, 1))
    local = local - middle
    targets = places_m - middle
    every = max(1, int(np.sqrt(local[..., 0].size / _FIT_PIXELS)))
    numbers = np.stack(np.meshgrid(*map(np.arange, raster.heights_m.shape), indexing="ij"), axis=-1)
    sample, pixels = local[::every, ::every].reshape(-1, 2), numbers[::every, ::every].reshape(-1, 2)
    fit, _rest, rank, _singular = np.linalg.lstsq(np.column_stack((sample, np.ones(len(sample)))), pixels, rcond=1e-9)
    if rank < 3:
        raise UsageError("the pixels of the elevation raster lie in one line")
    found = targets @ fit[:2] + fit[2]
    for _ in range(_STEPS):
        at = np.stack([_straight(local[..., axis], found[..., 0], found[..., 1]) for axis in (0, 1)], axis=-1)
        found = found + (targets - at) @ fit[:2]
    return found[..., 0], found[..., 1]


def _corner(values: NDArray[np.float64], rows: Floats, columns: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The lower of the pixels around; the last but one beyond the end."""
    return (
        np.clip(np.floor(rows), 0, max(values.shape[0] - 2, 0)).astype(np.int64),
        np.clip(np.floor(columns), 0, max(values.shape[1] - 2, 0)).astype(np.int64),
    )


def _straight(values: Floats, rows: Floats, columns: Floats) -> Floats:
    """Bilinear, and on in a straight line beyond the edges."""
    row, column = _corner(values, rows, columns)
    down, right = rows - row, columns - column
    upper = values[row, column] * (1 - right) + values[row, column + 1] * right
    lower = values[row + 1, column] * (1 - right) + values[row + 1, column + 1] * right
    found: Floats = upper * (1 - down) + lower * down
    return found


def _between(values: Floats, rows: Floats, columns: Floats) -> tuple[Floats, Floats]:
    """Bilinear among the known ones of four, and their weight; NaN where it is 0. Constant beyond the edges."""
    row, column = _corner(values, rows, columns)
    down, right = np.clip(rows - row, 0, 1), np.clip(columns - column, 0, 1)
    total, weight = np.zeros(rows.shape), np.zeros(rows.shape)
    for below, beside in ((0, 0), (0, 1), (1, 0), (1, 1)):
        share = (down if below else 1 - down) * (right if beside else 1 - right)
        value = values[np.minimum(row + below, values.shape[0] - 1), np.minimum(column + beside, values.shape[1] - 1)]
        known = ~np.isnan(value)
        total += np.where(known, share * np.where(known, value, 0.0), 0.0)
        weight += np.where(known, share, 0.0)
    enough = weight > _LEAST_WEIGHT
    return np.where(enough, total / np.where(enough, weight, 1.0), np.nan), weight
