"""Makes the scene of a client from its file. Without the section nothing of it is imported."""

import logging
from typing import TYPE_CHECKING

from sern_client.endpoints.base import Endpoint, SiteObjects
from sern_client.site import Site
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.types import Encoding
from sern_runtime.config.client import ClientFile
from sern_runtime.config.endpoints import installing
from sern_runtime.config.load import Loaded
from sern_runtime.config.scene import SceneSection
from sern_runtime.config.twin import TwinEndpoint

if TYPE_CHECKING:
    from sern_client.scene.node import SceneNode
    from sern_twin.world.grid import Grid
    from sern_twin.world.patches import Cells

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
    scanners = tuple(ScannerOptions(**each.model_dump()) for each in section.scanners)
    twins_alone = all(isinstance(each, TwinEndpoint) for each in loaded.model.endpoints)  # which take no map
    publish = None if twins_alone else section.publish
    options = SceneOptions(section.name, scanners, section.obstacles, publish)
    return SceneNode(
        options,
        grid,
        loaded.model.name,
        base=_base(loaded, section, grid),
        encoding=encoding,
        subscribe=endpoint.subscribe,
        advertise=site.advertise,
        objects=objects,
    )


def _base(loaded: Loaded[ClientFile], section: SceneSection, grid: "Grid") -> "Cells | None":
    """The map of the site on its grid."""
    if section.base is None or grid.plane is None:
        return None
    from sern_runtime.geodata import read_geojson, read_osm

    path = loaded.resolve(section.base)
    geojson = path.name.endswith("json")
    read = read_geojson(path.read_bytes(), str(path)) if geojson else read_osm(path)
    from sern_twin.world.primitives import base_cells, primitives, rasterised

    made = primitives(read.features, grid.plane)
    left_out = {**read.unread, **{reason.value: count for reason, count in made.unread.items()}}
    _log.info("scene: %d things of %s, left out: %s", len(made.found), path.name, left_out or "nothing")
    return base_cells(rasterised(made.found, grid))
