"""Makes the scene of a client from its file. Without the section nothing of it is imported."""

import logging
import math
from typing import TYPE_CHECKING, Final

from sern_client.endpoints.base import Endpoint, OfferingEndpoint, SiteObjects
from sern_client.site import Site
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.types import Encoding
from sern_runtime.config.client import ClientFile
from sern_runtime.config.endpoints import installing
from sern_runtime.config.load import Loaded
from sern_runtime.config.scene import SceneSection

if TYPE_CHECKING:
    from sern_client.scene.node import SceneNode
    from sern_twin.world.grid import Grid
    from sern_twin.world.mesh import Mesh
    from sern_twin.world.patches import Cells
    from sern_twin.world.primitives import Primitive
    from sern_twin.world.terrain import Terrain

PUBLISHED: Final = {"publish": "map", "discrepancies": "discrepancies"}
"""What a scene publishes, by the key of the file that names its topic; what sern-twin calls it."""
GROUND_CELLS: Final = 200
"""The ground is shown with so many cells along a side: 80,000 triangles at the most."""

_log = logging.getLogger(__name__)


def make_scene(
    loaded: Loaded[ClientFile], endpoint: Endpoint, site: Site, objects: SiteObjects, encoding: Encoding
) -> "SceneNode | None":
    """ConfigError: a package is missing, or the map of the site cannot be read."""
    section = loaded.model.scene
    if section is None:
        return None
    try:
        from sern_client.scene.node import SceneNode
        from sern_client.scene.options import ScannerOptions, SceneOptions
        from sern_twin.geodesy import TangentPlane
        from sern_twin.world.grid import Grid
        from sern_twin.world.update_rates import UpdateRateOptions
    except ImportError as error:
        raise ConfigError(f"a scene needs more packages: {installing('sern[twin]')} ({error})", key="scene") from error
    at = section.origin
    try:
        plane = None if at is None else TangentPlane.from_degrees(at.latitude_deg, at.longitude_deg, at.height_m)
        grid = Grid(
            section.west_m,
            section.south_m,
            section.cell_m,
            section.columns,
            section.rows,
            section.block_cells,
            plane,
            section.frame_id,
        )
    except UsageError as error:
        raise ConfigError(str(error), file=str(loaded.path), key="scene") from error
    things = _things(loaded, section, grid)
    ground, terrain = _ground(loaded, section, grid, things or [])
    scanners = tuple(ScannerOptions(**each.model_dump()) for each in section.scanners)
    names, advertise = {key: getattr(section, key) for key in PUBLISHED}, site.advertise
    if isinstance(endpoint, OfferingEndpoint):  # the twins', which publishes for all sites
        advertise = endpoint.offer
        names = {key: f"{endpoint.prefix}/scene/{part}" for key, part in PUBLISHED.items()}
        for key in sorted(names.keys() & section.model_fields_set):
            raise ConfigError(
                f"sern-twin publishes it as {names[key]}: remove the line", file=str(loaded.path), key=f"scene.{key}"
            )
    rates = UpdateRateOptions(**section.rates.model_dump())
    options = SceneOptions(
        section.name,
        scanners,
        section.obstacles,
        **names,
        rates=rates,
        corrects=section.corrects,
        lasting=section.lasting,
    )
    return SceneNode(
        options,
        grid,
        loaded.model.name,
        base=None if things is None else _base(things, grid),
        ground=ground,
        terrain=terrain,
        encoding=encoding,
        subscribe=endpoint.subscribe,
        advertise=advertise,
        objects=objects,
    )


def _things(loaded: Loaded[ClientFile], section: SceneSection, grid: "Grid") -> "list[Primitive] | None":
    """What the map of the site has; None: there is no map."""
    if section.base is None or grid.plane is None:
        return None
    from sern_runtime.geodata import read_geojson, read_osm

    path = loaded.resolve(section.base)
    geojson = path.name.endswith("json")
    read = read_geojson(path.read_bytes(), str(path)) if geojson else read_osm(path)
    from sern_twin.world.primitives import primitives

    made = primitives(read.features, grid.plane)
    left_out = {**read.unread, **{reason.value: count for reason, count in made.unread.items()}}
    _log.info("scene: %d things of %s, left out: %s", len(made.found), path.name, left_out or "nothing")
    return made.found


def _base(things: "list[Primitive]", grid: "Grid") -> "Cells":
    """The map of the site on its grid."""
    from sern_twin.world.primitives import base_cells, rasterised

    return base_cells(rasterised(things, grid))


def _ground(
    loaded: Loaded[ClientFile], section: SceneSection, grid: "Grid", things: "list[Primitive]"
) -> "tuple[Mesh | None, Terrain | None]":
    """The ground of the site and the buildings on it, to be looked at, and its heights; None: not known."""
    if section.terrain is None and not things:
        return None, None
    from sern_twin.world.mesh import joined
    from sern_twin.world.primitives import building_mesh

    if section.terrain is None:
        return building_mesh(things), None
    from sern_runtime.geodata import read_elevation
    from sern_twin.world.terrain import resampled

    path = loaded.resolve(section.terrain)
    try:
        terrain = resampled(read_elevation(path, near=grid), grid)
    except UsageError as error:
        raise ConfigError(str(error), file=str(path)) from error
    left_out = terrain.resampling
    _log.info("scene: the ground of %s, %d cells of it outside", path.name, left_out.outside)
    step = max(1, math.ceil(max(grid.shape) / GROUND_CELLS))
    return joined([terrain.mesh(step), building_mesh(things, terrain)]), terrain
