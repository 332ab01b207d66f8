"""Things of a map at the site: what they are, where, on a grid and as meshes, and what becomes nothing."""

import math
from typing import Any

import numpy as np
import pytest

pytest.importorskip("scipy", reason="the Python package scipy (extra twin) is not installed")
pytest.importorskip("shapely", reason="the Python package shapely (extra geo) is not installed")

import shapely

from sern_twin.geodesy import TangentPlane
from sern_twin.world.grid import Grid
from sern_twin.world.patches import LASTING
from sern_twin.world.primitives import (
    MOST_POINTS,
    Feature,
    Primitive,
    Unread,
    base_cells,
    building_mesh,
    primitives,
    rasterised,
)
from sern_twin.world.tags import Kind, height_m, kind_of, number, width_m
from sern_twin.world.terrain import resampled
from tests.sern_twin.world.test_terrain import GRID as SLOPE_GRID
from tests.sern_twin.world.test_terrain import raster

PLANE = TangentPlane.from_degrees(47.0, 11.0, 500.0)
GRID = Grid(-20.0, -20.0, 0.5, 80, 80, plane=PLANE)


def degrees(*places_m: tuple[float, float]) -> list[tuple[float, float]]:
    """Longitude and latitude of places at the site."""
    geodetic = np.degrees(PLANE.to_geodetic([(east, north, 0.0) for east, north in places_m]))
    return [(longitude, latitude) for latitude, longitude, _height in geodetic.tolist()]


def feature(geometry: Any, **tags: str) -> Feature:
    return Feature("way/1", tags, geometry)


def only(geometry: Any, **tags: str) -> Primitive:
    made = primitives([feature(geometry, **tags)], PLANE)
    assert made.unread == {}
    return made.found[0]


HOUSE = shapely.Polygon(degrees((0, 0), (10, 0), (10, 8), (0, 8)), [degrees((3, 3), (3, 5), (6, 5), (6, 3))])
LANE = shapely.LineString(degrees((-15, -15), (15, -15)))


@pytest.mark.parametrize(
    ("tags", "kind"),
    [
        ({"building": "yes"}, Kind.BUILDING),
        ({"building:part": "yes", "highway": "service"}, Kind.BUILDING),
        ({"building": "no", "barrier": "wall"}, Kind.BARRIER),
        ({"highway": "residential"}, Kind.ROAD),
        ({"highway": "footway"}, Kind.PATH),
        ({"highway": "turning_circle"}, Kind.OTHER),
        ({"waterway": "river"}, Kind.WATER),
        ({"natural": "water"}, Kind.WATER),
        ({"landuse": "basin"}, Kind.WATER),
        ({"natural": "wood"}, Kind.VEGETATION),
        ({"leisure": "park"}, Kind.VEGETATION),
        ({"kind": "road"}, Kind.ROAD),
        ({"kind": "nonsense", "landuse": "grass"}, Kind.VEGETATION),
        ({}, Kind.OTHER),
    ],
)
def test_tags_say_the_kind(tags: dict[str, str], kind: Kind) -> None:
    assert kind_of(tags) is kind


def test_tags_say_width_and_height_and_nonsense_leaves_the_default() -> None:
    assert width_m(Kind.ROAD, {"highway": "residential"}) == 5.5
    assert width_m(Kind.ROAD, {"highway": "residential", "width": "4,2 m"}) == 4.2
    for width in ("0", "-3", "1e9", "999", "12'", "wide", "", "9" * 400):
        assert width_m(Kind.PATH, {"highway": "steps", "width": width}) == 1.5
    assert height_m(Kind.BUILDING, {"height": "12.5"}) == (12.5, False)
    assert height_m(Kind.BUILDING, {"building:levels": "2"}) == (6.0, False)
    assert height_m(Kind.BUILDING, {"building:levels": "2", "roof:levels": "1"}) == (9.0, False)
    for tags in ({}, {"height": "40'"}, {"building:levels": "-1"}, {"building:levels": "900"}, {"height": "nan"}):
        assert height_m(Kind.BUILDING, tags) == (6.0, True)
    assert height_m(Kind.BARRIER, {"barrier": "fence"}) == (1.5, True)
    assert height_m(Kind.ROAD, {"height": "4"}) == (0.0, False)
    assert number("٣") is None, "digits are ASCII"


def test_geometry_is_in_metres_of_the_site() -> None:
    house = only(HOUSE, building="yes", name="Depot")
    assert (house.kind, house.name, house.feature_id) == (Kind.BUILDING, "Depot", "way/1")
    assert shapely.area(house.geometry) == pytest.approx(80 - 6, abs=1e-6)
    np.testing.assert_allclose(shapely.bounds(house.geometry), (0, 0, 10, 8), atol=1e-8)


def test_a_class_layer_has_the_highest_thing_of_each_cell() -> None:
    things = [
        only(HOUSE, building="yes"),
        only(shapely.Polygon(degrees((-5, -5), (12, -5), (12, 12), (-5, 12))), landuse="grass"),
        only(LANE, highway="residential"),
        only(shapely.LineString(degrees((-15, 15), (15, 16))), barrier="fence"),
        only(shapely.Point(degrees((-10, 10))[0]), natural="tree"),
    ]
    layer = rasterised(things, GRID)
    assert (layer == rasterised(things[::-1], GRID)).all()
    counts = np.bincount(layer.ravel(), minlength=8)
    assert counts[Kind.BUILDING] == (80 - 6) * 4
    assert counts[Kind.ROAD] == 60 * 11, "5.5 m wide"
    assert counts[Kind.VEGETATION] == 17 * 17 * 4 - counts[Kind.BUILDING] + 4
    _rows, columns = np.nonzero(layer == Kind.BARRIER)
    assert {*columns.tolist()} == set(range(10, 70)), "the fence is thinner than a cell, and has no hole"
    cells = base_cells(layer)
    assert (cells[layer == Kind.BUILDING] == 100).all() and (cells[layer == Kind.ROAD] == 0).all()
    assert base_cells(np.array([[Kind.WATER]], np.uint8)).tolist() == [[LASTING]], "scans do not see it"
    assert (cells[layer == Kind.VEGETATION] == -1).all() and (cells[layer == 0] == -1).all()


def test_what_is_smaller_than_a_cell_has_one_and_what_is_elsewhere_none() -> None:
    post = only(shapely.Point(degrees((1.26, 1.26))[0]), barrier="bollard", width="0.1")
    assert np.count_nonzero(rasterised([post], GRID)) == 1
    assert rasterised([post], GRID)[42, 42] == Kind.BARRIER
    assert not rasterised([only(shapely.Point(degrees((90, 90))[0]), barrier="bollard")], GRID).any()


def test_a_line_of_no_length_is_a_spot() -> None:
    line = shapely.LineString(degrees((1.25, 1.25), (1.25, 1.25)))
    layer = rasterised([only(line, barrier="wall"), only(line, highway="service")], GRID)
    assert layer[42, 42] == Kind.BARRIER
    assert np.count_nonzero(layer) == np.count_nonzero(layer[39:46, 39:46]) == 37, "a circle 3.5 m wide"


def test_a_fence_around_a_garden_does_not_fill_it() -> None:
    garden = shapely.Polygon(degrees((-10, -10), (10, -10), (10, 10), (-10, 10)))
    layer = rasterised([only(garden, barrier="fence")], GRID)
    assert (layer[25:55, 25:55] == 0).all()
    assert (layer[20, 20:60] == Kind.BARRIER).all() or (layer[19, 20:60] == Kind.BARRIER).all()


def test_a_building_is_a_closed_shell_above_its_floor() -> None:
    mesh = building_mesh([only(HOUSE, building="yes", height="5"), only(LANE, highway="service")])
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    areas = np.linalg.norm(normals, axis=1)
    roof = normals[:, 2] > 1e-3 * areas
    assert normals[roof].sum(axis=0) == pytest.approx([0, 0, 74], abs=1e-4)
    assert areas[~roof].sum() == pytest.approx(5 * (36 + 10), abs=1e-3)
    # The divergence of (x, y, 0) / 2 is 1: outward walls alone give the volume.
    outward = (normals[~roof, :2] * corners[~roof].mean(axis=1)[:, :2]).sum() / 2
    assert outward == pytest.approx(74 * 5, abs=1e-3), "walls face outside, those of the yard too"
    assert {*mesh.vertices[:, 2].tolist()} == {0.0, 5.0}
    assert len(building_mesh([]).faces) == 0


def test_a_building_stands_on_its_lowest_corner() -> None:
    terrain = resampled(raster(), SLOPE_GRID)
    mesh = building_mesh([only(HOUSE, building="yes", height="5")], terrain)
    assert mesh.vertices[:, 2].min() == pytest.approx(100 - 0.1 * 8, abs=0.01)
    assert mesh.vertices[:, 2].max() == pytest.approx(100 - 0.1 * 8 + 5, abs=0.01)


def test_an_area_that_crosses_itself_is_mended() -> None:
    bow = shapely.Polygon(degrees((0, 0), (10, 10), (10, 0), (0, 10)))
    assert shapely.area(only(bow, building="yes").geometry) == pytest.approx(50, abs=1e-6)
    assert len(building_mesh([only(bow, building="yes")]).faces) == 2 * 6 + 2


@pytest.mark.parametrize(
    ("geometry", "tags", "reason"),
    [
        (None, {}, Unread.NO_GEOMETRY),
        (shapely.Point(), {}, Unread.NO_GEOMETRY),
        (shapely.GeometryCollection([LANE]), {}, Unread.COLLECTION),
        (shapely.Point(2_600_000.0, 1_200_000.0), {}, Unread.COORDINATES),
        (shapely.Point(math.inf, 47.0), {}, Unread.COORDINATES),
        (shapely.Point(11.0, 91.0), {}, Unread.COORDINATES),
        (shapely.LineString([(11.0, 47.0), (13.0, 47.0)]), {"highway": "track"}, Unread.FAR),
        (shapely.LineString(np.full((MOST_POINTS + 1, 2), 11.0)), {}, Unread.TOO_LARGE),
        (shapely.Polygon(degrees((0, 0), (1, 1), (2, 2))), {"building": "yes"}, Unread.INVALID),
        (LANE, {"building": "yes"}, Unread.NO_AREA),
        (LANE, {"landuse": "farmland"}, Unread.NO_AREA),
        (LANE, {"natural": "water"}, Unread.NO_AREA),
        (shapely.Point(11.0, 47.0), {"natural": "tree_row"}, Unread.NO_AREA),
    ],
)
def test_what_is_no_thing_is_counted(geometry: Any, tags: dict[str, str], reason: Unread) -> None:
    made = primitives([feature(geometry, **tags), feature(LANE, highway="track")], PLANE)
    assert made.unread == {reason: 1}
    assert [one.kind for one in made.found] == [Kind.ROAD]
    assert made.of(Kind.ROAD) == made.found and made.of(Kind.WATER) == []
