"""Features of a map as things at the site: in metres of its plane, on a grid, and as meshes of buildings.

Geometry is shapely's: lon/lat in degrees (RFC 7946) in a `Feature`, east and north in metres in a `Primitive`.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Final

import numpy as np
import shapely
from numpy.typing import NDArray

from sern_twin.geodesy import TangentPlane
from sern_twin.world.grid import Floats, Grid
from sern_twin.world.mesh import Mesh, joined
from sern_twin.world.patches import FREE, LASTING, OCCUPIED, UNKNOWN, Cells
from sern_twin.world.tags import Kind, Tags, height_m, kind_of, width_m
from sern_twin.world.terrain import Terrain

Geometry = Any
"""A shapely geometry: the library has no types."""
MOST_POINTS: Final = 100_000
"""One feature has no more of them."""
LEAST_M2: Final = 1e-4
FAR_M: Final = 100_000.0
"""The tangent plane is none so far from its point."""
_AREAS: Final = frozenset({"Polygon", "MultiPolygon"})
_LINES: Final = frozenset({"LineString", "MultiLineString", "LinearRing"})
_POINTS: Final = frozenset({"Point", "MultiPoint"})
_ROOT_HALF: Final = 0.5**0.5
_BLOCKED: Final = frozenset({Kind.BUILDING, Kind.BARRIER, Kind.WATER})
_FREE: Final = frozenset({Kind.ROAD, Kind.PATH})


class Unread(Enum):
    """Why a feature is no primitive."""

    NO_GEOMETRY = "no_geometry"
    COLLECTION = "collection"
    """A geometry that is neither points, lines nor areas."""
    COORDINATES = "coordinates"
    """Not finite, or no longitude and latitude in degrees."""
    FAR = "far"
    TOO_LARGE = "too_large"
    INVALID = "invalid"
    """An area that has none, or of which nothing is left where it crosses itself."""
    NO_AREA = "no_area"
    """A building, or land of one use, that is no area: often one that an extract cut."""


@dataclass(frozen=True, slots=True, eq=False)
class Feature:
    """What a map has: an id such as way/123, tags, and a geometry in degrees, if any."""

    feature_id: str
    tags: Tags
    geometry: Geometry | None


@dataclass(frozen=True, slots=True, eq=False)
class Primitive:
    """A thing at the site. `width_m` is that of lines and points; an `assumed_height` is a guess by the kind."""

    feature_id: str
    kind: Kind
    name: str
    geometry: Geometry
    width_m: float
    height_m: float
    assumed_height: bool


@dataclass(frozen=True, slots=True)
class Primitives:
    """What was made of features, and how many became nothing and why."""

    found: list[Primitive] = field(default_factory=list)
    unread: dict[Unread, int] = field(default_factory=dict)

    def of(self, kind: Kind) -> list[Primitive]:
        return [one for one in self.found if one.kind is kind]


def primitives(features: Iterable[Feature], plane: TangentPlane) -> Primitives:
    """The features as things at the site, in their order. Whatever a feature is, it is found or counted."""
    made = Primitives()
    for feature in features:
        one = _primitive(feature, plane)
        if isinstance(one, Unread):
            made.unread[one] = made.unread.get(one, 0) + 1
        else:
            made.found.append(one)
    return made


def rasterised(things: Sequence[Primitive], grid: Grid) -> NDArray[np.uint8]:
    """The kind of what is in each cell, (rows, columns): the highest of several, 0 nothing.

    An area has the cells whose middles it holds, at least one. Lines are at least so wide that their cells touch.
    """
    layer = np.zeros(grid.shape, np.uint8)
    for thing in things:
        footprint = _footprint(thing, grid.cell_m * _ROOT_HALF)
        rows, columns, inside = _covered(footprint, grid)
        window = layer[rows, columns]
        np.maximum(window, np.uint8(thing.kind), out=window, where=inside)
    return layer


def base_cells(layer: NDArray[np.uint8]) -> Cells:
    """A class layer as a scene's base: buildings and barriers OCCUPIED, water LASTING, roads and paths FREE, else
    UNKNOWN. Scans see over water, and over a ditch, and do not make it free by that."""
    cells = np.full(layer.shape, UNKNOWN, np.int8)
    cells[np.isin(layer, list(_BLOCKED))] = OCCUPIED
    cells[layer == Kind.WATER] = LASTING
    cells[np.isin(layer, list(_FREE))] = FREE
    return cells


def building_mesh(things: Iterable[Primitive], terrain: Terrain | None = None) -> Mesh:
    """Walls and flat roofs of the buildings, without floors. Each stands on the lowest ground below its corners.

    The ground is at 0 without a terrain, and where it knows no height.
    """
    return joined(
        _extruded(area, thing.height_m, terrain)
        for thing in things
        if thing.kind is Kind.BUILDING
        for area in shapely.get_parts(thing.geometry)
    )


def _primitive(feature: Feature, plane: TangentPlane) -> Primitive | Unread:
    geometry = feature.geometry
    if geometry is None or shapely.is_empty(geometry):
        return Unread.NO_GEOMETRY
    if geometry.geom_type not in _AREAS | _LINES | _POINTS:
        return Unread.COLLECTION
    if shapely.get_num_coordinates(geometry) > MOST_POINTS:
        return Unread.TOO_LARGE
    degrees = shapely.get_coordinates(geometry)
    if not ((np.abs(degrees[:, 0]) <= 360) & (np.abs(degrees[:, 1]) <= 90)).all():  # and no NaN
        return Unread.COORDINATES
    geometry = shapely.transform(shapely.force_2d(geometry), lambda points: _local(points, plane))
    if (np.abs(shapely.get_coordinates(geometry)) > FAR_M).any():
        return Unread.FAR
    kind = kind_of(feature.tags)
    if geometry.geom_type not in _AREAS:
        if _needs_area(kind, feature.tags, geometry.geom_type):
            return Unread.NO_AREA
    elif kind is Kind.BARRIER:
        geometry = shapely.boundary(geometry)  # a fence around a garden does not fill it
    else:
        if not shapely.is_valid(geometry):
            geometry = _areas_of(shapely.make_valid(geometry))
        if shapely.area(geometry) < LEAST_M2:
            return Unread.INVALID
    height, assumed = height_m(kind, feature.tags)
    return Primitive(
        feature.feature_id, kind, feature.tags.get("name", ""), geometry, width_m(kind, feature.tags), height, assumed
    )


def _local(degrees: Floats, plane: TangentPlane) -> Floats:
    geodetic = np.column_stack((np.radians(degrees[:, ::-1]), np.zeros(len(degrees))))
    return plane.to_local(geodetic)[:, :2]


def _areas_of(geometry: Geometry) -> Geometry:
    parts = [
        area for part in shapely.get_parts(geometry) for area in shapely.get_parts(part) if area.geom_type == "Polygon"
    ]
    return shapely.union_all(parts)


def _needs_area(kind: Kind, tags: Tags, shape: str) -> bool:
    """Whether a line or point of this kind says nothing of where the thing is."""
    if kind is Kind.BUILDING:
        return True
    if kind is Kind.VEGETATION:
        return tags.get("natural") not in ({"tree_row"} if shape in _LINES else {"tree", "shrub"})
    return kind is Kind.WATER and not (shape in _LINES and "waterway" in tags)


def _footprint(thing: Primitive, least_m: float) -> Geometry:
    if thing.geometry.geom_type in _AREAS:
        return thing.geometry
    if thing.geometry.geom_type in _LINES:
        # A line without length has no sides, only ends.
        ends = "flat" if shapely.length(thing.geometry) > 0 else "round"
        return shapely.buffer(thing.geometry, max(thing.width_m / 2, least_m), cap_style=ends)
    return shapely.buffer(thing.geometry, thing.width_m / 2)


def _covered(area: Geometry, grid: Grid) -> tuple[slice, slice, NDArray[np.bool_]]:
    """A rectangle of cells around an area, and which of them have their middles in it; one of the area where none."""
    west_m, south_m, east_m, north_m = shapely.bounds(area)
    low = np.floor([(south_m - grid.south_m) / grid.cell_m, (west_m - grid.west_m) / grid.cell_m])
    high = np.ceil([(north_m - grid.south_m) / grid.cell_m, (east_m - grid.west_m) / grid.cell_m])
    rows, columns = (
        slice(*np.clip([low[axis], high[axis]], 0, size).astype(np.int64).tolist())
        for axis, size in enumerate(grid.shape)
    )
    centres = grid.centres(np.arange(rows.start, rows.stop)[:, None], np.arange(columns.start, columns.stop))
    shapely.prepare(area)
    inside: NDArray[np.bool_] = shapely.contains_xy(area, centres[..., 0], centres[..., 1])
    if inside.size and not inside.any():
        point = shapely.get_coordinates(shapely.point_on_surface(area))[0]
        row, column = (int(number) for number in grid.index(point))
        if rows.start <= row < rows.stop and columns.start <= column < columns.stop:
            inside[row - rows.start, column - columns.start] = True
    return rows, columns, inside


def _extruded(area: Geometry, height_m: float, terrain: Terrain | None) -> Mesh:
    """Walls outward of rings with the inside on their left, and the roof's triangles."""
    rings = [
        shapely.get_coordinates(ring) for ring in shapely.get_rings(shapely.orient_polygons(area, exterior_cw=False))
    ]
    corners = np.concatenate(rings)
    ground_m = 0.0
    if terrain is not None:
        heights = terrain.height_m(corners[:, 0], corners[:, 1])
        known = heights[np.isfinite(heights)]
        ground_m = float(known.min()) if known.size else 0.0
    walls = [_wall(ring, ground_m, ground_m + height_m) for ring in rings]
    triangles = shapely.get_parts(shapely.constrained_delaunay_triangles(area))
    roof = shapely.get_coordinates(shapely.orient_polygons(triangles, exterior_cw=False)).reshape(-1, 4, 2)[:, :3]
    points = np.column_stack((roof.reshape(-1, 2), np.full(3 * len(roof), ground_m + height_m)))
    faces = np.arange(len(points), dtype=np.int32).reshape(-1, 3)
    return joined([*walls, Mesh(points.astype(np.float32), faces)])


def _wall(ring: Floats, bottom_m: float, top_m: float) -> Mesh:
    """Two triangles for each side of a closed ring."""
    count = len(ring) - 1
    below = np.column_stack((ring[:-1], np.full(count, bottom_m)))
    above = np.column_stack((ring[:-1], np.full(count, top_m)))
    here = np.arange(count, dtype=np.int32)
    after = np.roll(here, -1)
    faces = np.concatenate(
        (np.stack((here, after, after + count), axis=1), np.stack((here, after + count, here + count), axis=1))
    )
    return Mesh(np.concatenate((below, above)).astype(np.float32), faces.astype(np.int32))
