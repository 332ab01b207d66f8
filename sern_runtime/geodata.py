"""Reads what maps a site: elevation rasters, OpenStreetMap extracts, GeoJSON (RFC 7946). All by the extra `geo`.

Each gives what `sern_twin.world` takes. They read whole files and take as long: at start, not on the event loop.
The world's parts and the libraries are imported where a file is read, since a site without a map needs none of them.
"""

import importlib.util
import json
import re
import sys
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_twin.world.grid import Grid

if TYPE_CHECKING:
    from sern_twin.world.primitives import Feature
    from sern_twin.world.terrain import ElevationRaster

MOST_FILE_BYTES: Final = 64_000_000
"""GeoJSON and extracts are no larger: a site is a few streets, and both become many times as large in memory."""
MOST_FEATURES: Final = 200_000
MARGIN_PIXELS: Final = 2
"""Around a grid, for what lies between the middles of pixels."""
_METRES: Final = frozenset({"m", "metre", "metres", "meter", "meters"})
_DEGREES: Final = "EPSG:4326"
_OSM_IDS: Final = {
    "points": (("node", "osm_id"),),
    "lines": (("way", "osm_id"),),
    "multilinestrings": (("relation", "osm_id"),),
    "multipolygons": (("way", "osm_way_id"), ("relation", "osm_id")),
}
"""Layers of GDAL's OSM driver that are read, and whose id is in which field."""
_NO_TAGS: Final = frozenset({"osm_id", "osm_way_id", "z_order", "other_tags"})
_HSTORE: Final = re.compile(r'"((?:[^"\\]|\\.)*)"=>"((?:[^"\\]|\\.)*)"')
_ESCAPED: Final = re.compile(r"\\(.)")
_WGS84_NAMES: Final = ("CRS84", "EPSG::4326", "EPSG:4326")


@dataclass(frozen=True, slots=True)
class MapFeatures:
    """The features of a file. `unread` counts those of layers that are not read, and what is no feature at all.

    `warnings` is what the library said of the file, such as areas that an extract cut.
    """

    features: list["Feature"] = field(default_factory=list)
    unread: dict[str, int] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    def count(self, reason: str, number: int = 1) -> None:
        self.unread[reason] = self.unread.get(reason, 0) + number


def read_elevation(path: Path, *, crs: str | None = None, near: Grid | None = None) -> "ElevationRaster":
    """A raster of heights that GDAL reads, in any reference system; of a large one only what lies `near` a grid.

    `crs` is the reference system of a file that has none, such as EPSG:4326; it does not overrule one. Heights stay
    above the zero that they have. ConfigError: not there, no raster, no reference system, several bands, not in
    metres, too large, not near.
    """
    _need("elevation", path, "rasterio", "pyproj", "scipy")
    import rasterio
    import rasterio.errors
    from rasterio.windows import Window

    from sern_twin.world.terrain import MOST_PIXELS, ElevationRaster

    file = str(path)
    _need_file(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)  # refused below
            with rasterio.open(path) as source:
                if source.transform.is_identity or source.transform.is_degenerate:
                    raise ConfigError("does not say where its pixels are: give a georeferenced raster", file=file)
                if source.count != 1:
                    raise ConfigError(f"has {source.count} bands: give a raster of heights alone", file=file)
                if (source.units[0] or "m").lower() not in _METRES:
                    raise ConfigError(f"has heights in {source.units[0]}: turn them into metres", file=file)
                system = _system(source.crs.to_wkt() if source.crs else crs, file)
                window = Window(0, 0, source.width, source.height)
                if near is not None:
                    window = _window(near, system, source, file)
                if window.width * window.height > MOST_PIXELS:
                    raise ConfigError(
                        f"has {window.width} x {window.height} pixels here, {MOST_PIXELS} are the most: "
                        "cut it to the site, or make them larger",
                        file=file,
                    )
                stored = source.read(1, window=window, masked=True).astype(np.float64).filled(np.nan)
                heights = stored * source.scales[0] + source.offsets[0]
                transform = source.transform
    except rasterio.errors.RasterioError as error:
        raise ConfigError(f"is no raster that can be read: {_first_line(error)}", file=file) from error
    columns, rows = np.meshgrid(
        window.col_off + np.arange(window.width) + 0.5, window.row_off + np.arange(window.height) + 0.5
    )
    across, along = (
        transform.a * columns + transform.b * rows + transform.c,
        transform.d * columns + transform.e * rows + transform.f,
    )
    longitudes, latitudes = _to_degrees(system, file).transform(across, along)
    try:
        return ElevationRaster(heights, np.radians(latitudes), np.radians(longitudes))
    except UsageError as error:
        raise ConfigError(f"is no elevation raster of a site: {error}", file=file) from error


def read_osm(path: Path) -> MapFeatures:
    """The nodes, ways and multipolygons with tags of an OpenStreetMap extract (.osm, .pbf).

    ConfigError: not there, no extract, larger than `MOST_FILE_BYTES` or of more than `MOST_FEATURES`.
    """
    _need("a map", path, "pyogrio", "shapely", "scipy")
    import pyogrio
    import pyogrio.raw

    file = str(path)
    _need_file(path)
    if path.stat().st_size > MOST_FILE_BYTES:
        raise ConfigError(f"has more than {MOST_FILE_BYTES} bytes: cut it to the site", file=file)
    found = MapFeatures()
    try:
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            layers = [str(name) for name, _shape in pyogrio.list_layers(path)]
            if "lines" not in layers or "multipolygons" not in layers:
                raise ConfigError(f"has the layers {', '.join(layers)}: give an OpenStreetMap extract", file=file)
            for layer in layers:
                meta, _ids, shapes, columns = pyogrio.raw.read(path, layer=layer, max_features=MOST_FEATURES + 1)
                if len(shapes) + len(found.features) > MOST_FEATURES:
                    raise ConfigError(f"has more than {MOST_FEATURES} features: cut it to the site", file=file)
                if layer in _OSM_IDS:
                    found.features.extend(_osm_features(layer, [str(name) for name in meta["fields"]], shapes, columns))
                elif len(shapes):
                    found.count(layer, len(shapes))
    except _errors() as error:
        raise ConfigError(f"is no map that can be read: {_first_line(error)}", file=file) from error
    found.warnings.extend(sorted({_first_line(warning.message) for warning in said}))
    return found


def read_geojson(data: bytes, file: str) -> MapFeatures:
    """The features of a GeoJSON text: a FeatureCollection, a Feature or a geometry. Properties are the tags.

    ConfigError names `file`: no GeoJSON, another reference system than WGS 84, too large as in `read_osm`.
    """
    _need("a map", Path(file), "shapely", "scipy")
    from sern_twin.world.primitives import Feature

    if len(data) > MOST_FILE_BYTES:
        raise ConfigError(f"has more than {MOST_FILE_BYTES} bytes: cut it to the site", file=file)
    try:
        said = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"is no GeoJSON: {_first_line(error)}", file=file) from error
    if not isinstance(said, dict):
        raise ConfigError("is no GeoJSON: give a FeatureCollection", file=file)
    system = said.get("crs")
    if system is not None and not any(name in json.dumps(system) for name in _WGS84_NAMES):
        raise ConfigError("has a crs that is not WGS 84: give longitude and latitude (RFC 7946)", file=file)
    kind = said.get("type")
    members = said.get("features") if kind == "FeatureCollection" else [said]
    if not isinstance(members, list):
        raise ConfigError("is a FeatureCollection without features: give a list of them", file=file)
    if len(members) > MOST_FEATURES:
        raise ConfigError(f"has more than {MOST_FEATURES} features: cut it to the site", file=file)
    found = MapFeatures()
    for number, member in enumerate(members):
        if kind != "FeatureCollection" and kind != "Feature":
            member = {"type": "Feature", "geometry": member}
        if not isinstance(member, dict) or member.get("type") != "Feature":
            found.count("no_feature")
            continue
        properties = member.get("properties")
        tags = {
            key: str(value)
            for key, value in (properties.items() if isinstance(properties, dict) else ())
            if isinstance(value, str | int | float) and not isinstance(value, bool)
        }
        name = str(member.get("id", tags.get("@id", number)))
        found.features.append(Feature(name, tags, _geojson_geometry(member.get("geometry"))))
    return found


def _errors() -> tuple[type[Exception], ...]:
    """What pyogrio raises of a file; they have no base of their own."""
    from pyogrio import errors

    return errors.DataSourceError, errors.DataLayerError, errors.FeatureError, errors.FieldError, errors.GeometryError


def _need(what: str, path: Path, *packages: str) -> None:
    lacking = [name for name in packages if name not in sys.modules and importlib.util.find_spec(name) is None]
    if lacking:
        raise ConfigError(
            f"{what} needs the Python package {lacking[0]}, which is not on this machine: install SERN with the extras "
            "geo and twin ('.[geo,twin]')",
            file=str(path),
        )


def _need_file(path: Path) -> None:
    if not path.is_file():
        raise ConfigError("there is no such file: give its path", file=str(path))


def _first_line(error: object) -> str:
    return next(iter(str(error).splitlines()), type(error).__name__)


def _system(said: str | None, file: str) -> Any:
    """The reference system as pyproj knows it."""
    import pyproj
    import pyproj.exceptions

    if said is None:
        raise ConfigError(
            "has no reference system: give it as crs, such as EPSG:4326 for latitude and longitude", file=file
        )
    try:
        system = pyproj.CRS.from_user_input(said)
    except pyproj.exceptions.CRSError as error:
        raise ConfigError(f"the crs {said[:40]!r} is unknown: give one such as EPSG:4326", file=file) from error
    if not (system.is_geographic or system.is_projected):
        raise ConfigError(f"its reference system {system.name} is not of places on the Earth: reproject it", file=file)
    return system


def _to_degrees(system: Any, file: str) -> Any:
    """A transformer from places in a reference system to longitude and latitude."""
    import pyproj
    import pyproj.exceptions

    try:
        return pyproj.Transformer.from_crs(system, _DEGREES, always_xy=True)
    except pyproj.exceptions.ProjError as error:
        raise ConfigError(
            f"its reference system {system.name} cannot be turned into latitude and longitude: reproject it", file=file
        ) from error


def _window(near: Grid, system: Any, source: Any, file: str) -> Any:
    """The pixels around a grid."""
    from rasterio.windows import Window

    if near.plane is None:
        raise UsageError("the grid does not say where on the Earth it is: give it a plane")
    # Along the edges, since they are bent in a map projection.
    share = np.linspace(0, 1, 9)
    across, along = (
        (near.west_m + share * (near.east_m - near.west_m)),
        near.south_m + share * (near.north_m - near.south_m),
    )
    east, north = np.meshgrid(across, along)
    geodetic = near.to_geodetic(np.stack((east, north, np.zeros(east.shape)), axis=-1))
    longitudes, latitudes = np.degrees(geodetic[..., 1]).ravel(), np.degrees(geodetic[..., 0]).ravel()
    places = _to_degrees(system, file).transform(longitudes, latitudes, direction="INVERSE")
    inverse = ~source.transform
    columns = inverse.a * places[0] + inverse.b * places[1] + inverse.c
    rows = inverse.d * places[0] + inverse.e * places[1] + inverse.f
    ends = [
        (max(0, int(low)), min(size, int(high)))
        for low, high, size in (
            (np.floor(columns.min()) - MARGIN_PIXELS, np.ceil(columns.max()) + MARGIN_PIXELS, source.width),
            (np.floor(rows.min()) - MARGIN_PIXELS, np.ceil(rows.max()) + MARGIN_PIXELS, source.height),
        )
        if np.isfinite((low, high)).all()
    ]
    if len(ends) < 2 or any(high - low < 2 for low, high in ends):
        raise ConfigError("does not reach the site: give one that covers it", file=file)
    (left, right), (top, bottom) = ends
    return Window(left, top, right - left, bottom - top)


def _osm_features(layer: str, names: list[str], shapes: Any, columns: Any) -> Iterator["Feature"]:
    import shapely

    from sern_twin.world.primitives import Feature

    geometries = shapely.from_wkb(shapes, on_invalid="ignore")
    for number, geometry in enumerate(geometries):
        said = {name: str(column[number]) for name, column in zip(names, columns, strict=True) if column[number]}
        tags = {_plain(key): _plain(value) for key, value in _HSTORE.findall(said.get("other_tags", ""))}
        tags |= {key: value for key, value in said.items() if key not in _NO_TAGS}
        ids = [f"{kind}/{said[name]}" for kind, name in _OSM_IDS[layer] if said.get(name)]
        yield Feature(ids[0] if ids else f"{layer}/{number}", tags, geometry)


def _plain(text: str) -> str:
    return _ESCAPED.sub(r"\1", text)


def _geojson_geometry(said: object) -> Any:
    """None where it is none."""
    import shapely

    try:
        with np.errstate(all="ignore"):  # a number too large becomes infinite, which no place is
            return shapely.from_geojson(json.dumps(said), on_invalid="ignore") if isinstance(said, dict) else None
    except RecursionError:
        return None
