"""Rasters and maps as files have them: a real site, files that are made for it, and files that are none."""

import importlib.util
import json
import math
import sys
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest

pytest.importorskip("scipy", reason="the Python package scipy (extra twin) is not installed")
pytest.importorskip("shapely", reason="the Python package shapely (extra geo) is not installed")
pytest.importorskip("rasterio", reason="the Python package rasterio (extra geo) is not installed")
pytest.importorskip("pyogrio", reason="the Python package pyogrio (extra geo) is not installed")

import pyproj
import rasterio
import rasterio.errors
from rasterio.transform import Affine

from benchmarks.recordings import DATA
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_runtime import geodata
from sern_runtime.geodata import read_elevation, read_geojson, read_osm
from sern_twin.geodesy import TangentPlane
from sern_twin.world.grid import Grid
from sern_twin.world.primitives import Unread, primitives, rasterised
from sern_twin.world.tags import Kind
from sern_twin.world.terrain import resampled

DEM: Final = DATA / "dem_1arcsec.tif"
STREETS: Final = DATA / "streets.osm"
needs_dem = pytest.mark.skipif(not DEM.exists(), reason=f"{DEM.name} is not beside the checkout")
needs_streets = pytest.mark.skipif(not STREETS.exists(), reason=f"{STREETS.name} is not beside the checkout")
HILL: Final = TangentPlane.from_degrees(37.7953, -122.406)
ALPS: Final = TangentPlane.from_degrees(47.0, 11.0, 500.0)


def write_raster(path: Path, heights: Any, transform: Affine, crs: str | None, **more: Any) -> Path:
    heights = np.asarray(heights, np.float32)
    with rasterio.open(
        path, "w", driver="GTiff", width=heights.shape[1], height=heights.shape[0], count=1, dtype="float32", crs=crs,
        transform=transform, **more,
    ) as target:  # fmt: skip
        target.write(heights, 1)
    return path


def slope(path: Path, crs: str, pixel: float, size: int = 60, *, declared: bool = True) -> Path:
    """A raster around the Alpine point whose heights rise a metre in each thousandth of a degree to the north."""
    to_degrees = pyproj.Transformer.from_crs(crs, "EPSG:4326", always_xy=True)
    across, along = to_degrees.transform(11.0, 47.0, direction="INVERSE")
    transform = Affine(pixel, 0, across - size / 2 * pixel, 0, -pixel, along + size / 2 * pixel)
    columns, rows = np.meshgrid(np.arange(size) + 0.5, np.arange(size) + 0.5)
    _longitudes, latitudes = to_degrees.transform(transform.c + pixel * columns, transform.f - pixel * rows)
    return write_raster(path, 1000 + (np.asarray(latitudes) - 47) * 1000, transform, crs if declared else None)


@needs_dem
def test_a_real_elevation_model_lies_where_it_is() -> None:
    raster = read_elevation(DEM)
    assert raster.heights_m.shape == (37, 24)
    assert (float(np.nanmin(raster.heights_m)), float(np.nanmax(raster.heights_m))) == (10, 98)
    assert np.count_nonzero(np.isnan(raster.heights_m)) == 96
    # By the file's header: its corner and pixels of one second of arc.
    assert math.degrees(raster.latitudes_rad[0, 0]) == pytest.approx(37.80041666666667 - 0.5 / 3600)
    assert math.degrees(raster.longitudes_rad[0, 0]) == pytest.approx(-122.40930555555555 + 0.5 / 3600)
    grid = Grid(-100.0, -200.0, 2.0, 100, 200, plane=HILL)
    terrain = resampled(raster, grid)
    assert terrain.resampling.no_data == terrain.resampling.outside == 0
    row, column = 18, 12
    local = HILL.to_local([raster.latitudes_rad[row, column], raster.longitudes_rad[row, column], 0.0])
    assert terrain.height_m(local[0], local[1]) == pytest.approx(raster.heights_m[row, column], abs=0.3)
    mesh = terrain.mesh(4)
    assert 10 <= mesh.vertices[:, 2].min() < mesh.vertices[:, 2].max() <= 98


@needs_dem
def test_only_what_is_near_the_grid_is_read() -> None:
    grid = Grid(-50.0, -50.0, 1.0, 100, 100, plane=HILL)
    part = read_elevation(DEM, near=grid)
    assert max(part.heights_m.shape) < 12
    np.testing.assert_array_equal(
        resampled(part, grid).heights_m.round(6), resampled(read_elevation(DEM), grid).heights_m.round(6)
    )
    with pytest.raises(ConfigError, match=r"dem_1arcsec\.tif: does not reach the site"):
        read_elevation(DEM, near=Grid(-50.0, -50.0, 1.0, 100, 100, plane=ALPS))
    with pytest.raises(UsageError, match="give it a plane"):
        read_elevation(DEM, near=Grid(-50.0, -50.0, 1.0, 100, 100))


@pytest.mark.parametrize(
    ("crs", "pixel"), [("EPSG:4326", 1 / 3600), ("EPSG:32632", 20.0), ("EPSG:2056", 20.0), ("EPSG:3857", 30.0)]
)
def test_any_reference_system_gives_the_same_ground(tmp_path: Path, crs: str, pixel: float) -> None:
    path = slope(tmp_path / "dem.tif", crs, pixel)
    grid = Grid(-200.0, -200.0, 10.0, 40, 40, plane=ALPS)
    for near in (None, grid):
        terrain = resampled(read_elevation(path, near=near), grid)
        latitudes = np.degrees(ALPS.to_geodetic(np.pad(grid.all_centres(), ((0, 0), (0, 0), (0, 1))))[..., 0])
        np.testing.assert_allclose(terrain.heights_m, 500 + (latitudes - 47) * 1000, atol=0.002)


def test_a_raster_without_a_reference_system_is_refused_until_it_is_given(tmp_path: Path) -> None:
    path = slope(tmp_path / "dem.tif", "EPSG:4326", 1 / 3600, declared=False)
    with pytest.raises(ConfigError) as refused:
        read_elevation(path)
    assert str(refused.value) == (
        f"{path}: has no reference system: give it as crs, such as EPSG:4326 for latitude and longitude"
    )
    assert read_elevation(path, crs="EPSG:4326").heights_m.shape == (60, 60)
    with pytest.raises(ConfigError, match="the crs 'EPSG:nonsense' is unknown"):
        read_elevation(path, crs="EPSG:nonsense")
    with pytest.raises(ConfigError, match="is not of places on the Earth"):
        read_elevation(path, crs="EPSG:4978")
    with pytest.raises(ConfigError, match="cannot be turned into latitude and longitude"):
        read_elevation(path, crs="+proj=ortho +lat_0=90 +lon_0=0 +R=3")


def test_a_raster_that_is_none_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"away\.tif: there is no such file"):
        read_elevation(tmp_path / "away.tif")
    text = tmp_path / "text.tif"
    text.write_text("no raster")
    with pytest.raises(ConfigError, match=r"text\.tif: is no raster that can be read"):
        read_elevation(text)
    with pytest.warns(rasterio.errors.NotGeoreferencedWarning):
        picture = write_raster(tmp_path / "picture.tif", np.zeros((4, 4)), Affine(1, 0, 0, 0, 1, 0), None)
    with pytest.raises(ConfigError, match="does not say where its pixels are"):
        read_elevation(picture, crs="EPSG:4326")
    large = slope(tmp_path / "large.tif", "EPSG:32632", 1.0, size=2001)
    with pytest.raises(ConfigError, match="2001 x 2001 pixels here, 4000000 are the most"):
        read_elevation(large)
    for said, change in (("in ft: turn", {"units": ("ft",)}), ("2 bands", {})):
        path = tmp_path / f"{len(change)}.tif"
        with rasterio.open(
            path, "w", driver="GTiff", width=4, height=4, count=2 - len(change), dtype="int16", crs="EPSG:4326",
            transform=Affine(0.1, 0, 11, 0, -0.1, 47),
        ) as target:  # fmt: skip
            target.units = change.get("units", ("m", "m"))
        with pytest.raises(ConfigError, match=said):
            read_elevation(path)
    cut = slope(tmp_path / "cut.tif", "EPSG:32632", 1.0, size=600)
    cut.write_bytes(cut.read_bytes()[:9000])
    with pytest.raises(ConfigError, match=r"cut\.tif: is no raster that can be read"):
        read_elevation(cut)


def test_stored_numbers_have_a_scale_and_an_offset(tmp_path: Path) -> None:
    path = tmp_path / "dem.tif"
    with rasterio.open(
        path, "w", driver="GTiff", width=3, height=2, count=1, dtype="int16", crs="EPSG:4326", nodata=-1,
        transform=Affine(0.001, 0, 11, 0, -0.001, 47),
    ) as target:  # fmt: skip
        target.write(np.array([[100, 200, 300], [-1, 500, 600]], np.int16), 1)
        target.scales, target.offsets = (0.1,), (400.0,)
    wanted = np.array([[410, 420, 430], [math.nan, 450, 460]])
    np.testing.assert_allclose(read_elevation(path).heights_m, wanted)


@needs_streets
def test_a_real_extract_becomes_streets_and_houses() -> None:
    read = read_osm(STREETS)
    assert len(read.features) == 49 and read.unread == {}
    assert len(read.warnings) == 1, "GDAL says that an area is cut"
    plane = TangentPlane.from_degrees(48.136, 10.0695)
    made = primitives(read.features, plane)
    kinds = {kind: len(made.of(kind)) for kind in Kind if made.of(kind)}
    assert kinds == {Kind.BUILDING: 32, Kind.ROAD: 14, Kind.OTHER: 2}
    assert made.unread == {Unread.NO_AREA: 1}, "farmland that the extract cut"
    assert {one.name for one in made.of(Kind.ROAD)} == {"", "Goethestraße", "Haydnstraße", "Richard-Wagner-Straße"}
    assert sum(not one.assumed_height for one in made.of(Kind.BUILDING)) == 9, "those whose levels are known"
    assert {one.feature_id.split("/")[0] for one in made.found} == {"way", "node"}
    layer = rasterised(made.found, Grid(-150.0, -150.0, 0.5, 600, 600, plane=plane))
    built_m2 = np.count_nonzero(layer == Kind.BUILDING) / 4
    assert built_m2 == pytest.approx(sum(one.geometry.area for one in made.of(Kind.BUILDING)), rel=0.05)


def test_an_extract_that_is_none_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="there is no such file"):
        read_osm(tmp_path / "away.osm")
    text = tmp_path / "text.osm"
    text.write_text("no map")
    with pytest.raises(ConfigError, match=r"text\.osm: is no map that can be read"):
        read_osm(text)
    cut = tmp_path / "cut.osm"
    cut.write_text('<?xml version="1.0"?><osm version="0.6"><node id="1" lat="48.1" lon=')
    with pytest.raises(ConfigError, match=r"cut\.osm: is no map that can be read"):
        read_osm(cut)
    other = tmp_path / "other.geojson"
    other.write_text('{"type": "FeatureCollection", "features": []}')
    with pytest.raises(ConfigError, match="give an OpenStreetMap extract"):
        read_osm(other)


def test_tags_of_an_extract_may_have_quotes(tmp_path: Path) -> None:
    path = tmp_path / "one.osm"
    path.write_text(
        '<?xml version="1.0"?><osm version="0.6"><node id="7" lat="48.1" lon="10.1">'
        '<tag k="natural" v="tree"/><tag k="inscription" v="a &quot;fine&quot;=&gt;tree \\ oak"/></node></osm>'
    )
    found = read_osm(path).features
    assert [one.feature_id for one in found] == ["node/7"]
    assert found[0].tags == {"natural": "tree", "inscription": 'a "fine"=>tree \\ oak'}


def collection(*features: object) -> bytes:
    return json.dumps({"type": "FeatureCollection", "features": features}).encode()


def test_geojson_becomes_features_with_tags() -> None:
    point = {"type": "Point", "coordinates": [10.1, 48.1]}
    read = read_geojson(
        collection(
            {"type": "Feature", "id": 5, "geometry": point, "properties": {"natural": "tree", "height": 4, "ok": True}},
            {"type": "Feature", "geometry": None, "properties": None},
            {"type": "Feature", "geometry": {"type": "Point", "coordinates": "here"}, "properties": {"@id": "node/3"}},
            {"type": "Nonsense"},
            "nonsense",
        ),
        "site.geojson",
    )
    assert [(one.feature_id, one.tags) for one in read.features] == [
        ("5", {"natural": "tree", "height": "4"}), ("1", {}), ("node/3", {"@id": "node/3"}),
    ]  # fmt: skip
    assert read.unread == {"no_feature": 2}
    made = primitives(read.features, TangentPlane.from_degrees(48.1, 10.1))
    assert len(made.found) == 1 and made.unread == {Unread.NO_GEOMETRY: 2}
    for alone in (point, {"type": "Feature", "geometry": point}):
        assert len(primitives(read_geojson(json.dumps(alone).encode(), "a").features, ALPS).found) == 0
        assert read_geojson(json.dumps(alone).encode(), "a").features[0].geometry is not None


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"", "is no GeoJSON"),
        (b"\xff\xfe\xfd", "is no GeoJSON"),
        (b"[" * 100_000, "is no GeoJSON"),
        (b"[]", "give a FeatureCollection"),
        (b'{"type": "FeatureCollection"}', "without features"),
        (b'{"type": "FeatureCollection", "features": [], "crs": {"name": "EPSG:25832"}}', "is not WGS 84"),
    ],
)
def test_geojson_that_is_none_is_refused(data: bytes, said: str) -> None:
    with pytest.raises(ConfigError, match=rf"site\.geojson: .*{said}"):
        read_geojson(data, "site.geojson")


def test_hostile_numbers_become_no_things() -> None:
    places: list[object] = [[math.nan, 1], [1e999, 1], [True, None], [[1]], {}, [1], [10**400, 1]]
    data = collection(*({"type": "Feature", "geometry": {"type": "Point", "coordinates": one}} for one in places))
    read = read_geojson(data, "site.geojson")
    made = primitives(read.features, ALPS)
    assert made.found == [] and sum(made.unread.values()) == len(places)


def test_what_is_too_large_is_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(geodata, "MOST_FEATURES", 1)
    with pytest.raises(ConfigError, match="more than 1 features"):
        read_geojson(collection({}, {}), "site.geojson")
    path = tmp_path / "two.osm"
    nodes = "".join(f'<node id="{n}" lat="48.{n}" lon="10.1"><tag k="natural" v="tree"/></node>' for n in (1, 2))
    path.write_text(f'<?xml version="1.0"?><osm version="0.6">{nodes}</osm>')
    with pytest.raises(ConfigError, match="more than 1 features"):
        read_osm(path)
    monkeypatch.setattr(geodata, "MOST_FILE_BYTES", 10)
    with pytest.raises(ConfigError, match="more than 10 bytes"):
        read_geojson(collection({}), "site.geojson")
    with pytest.raises(ConfigError, match="more than 10 bytes"):
        read_osm(path)


def test_without_the_extra_it_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "modules", {})
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    for read in (
        lambda: read_elevation(Path("a.tif")),
        lambda: read_osm(Path("a.tif")),
        lambda: read_geojson(b"", "a.tif"),
    ):
        with pytest.raises(ConfigError, match=r"^a\.tif: .* needs the Python package .* extras geo and twin"):
            read()
