"""A scene from a client's file: the ground and the map of a real site."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sern_client.endpoints.synthetic import SyntheticEndpoint, SyntheticOptions
from sern_client.scene.making import make_scene
from sern_client.scene.node import SceneNode
from sern_client.site import Site
from sern_core.topics.rules import RuleSet
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.types import Encoding
from sern_runtime.config.client import load_client
from sern_twin.world.patches import OCCUPIED

DATA = Path(__file__).resolve().parents[4] / "shared" / "data"
needs_data = pytest.mark.skipif(
    not (DATA / "streets.osm").exists(), reason="the recordings (shared/data beside the checkout) are not there"
)
AREA = {"name": "site", "west_m": -150, "south_m": -150, "width_m": 300, "length_m": 300, "cell_m": 1.0}


class NoObjects:
    def put(self, *_: object, **__: object) -> None: ...

    def delete(self, _object_id: str) -> bool:
        return False

    def listen(self, _listener: object) -> None: ...


def scene_of(tmp_path: Path, **section: Any) -> SceneNode | None:
    config = tmp_path / "site.yaml"
    content = {
        "client": {"name": "site"},
        "relay": {"endpoint": "tcp://127.0.0.1:5555", "insecure": True},
        "endpoint": {"kind": "synthetic", "role": "operator"},
        "scene": {**AREA, **section} if section else None,
    }
    config.write_text(json.dumps(content))
    endpoint = SyntheticEndpoint(SyntheticOptions(role="operator"))
    site = Site(endpoint, RuleSet(()), "/", kick=lambda: None)
    return make_scene(load_client(config), endpoint, site, NoObjects(), Encoding.CDR)


def origin_of_streets() -> dict[str, float]:
    from sern_runtime.geodata import read_osm

    shapes = [each.geometry for each in read_osm(DATA / "streets.osm").features if each.geometry is not None]
    middles = np.array([(shape.centroid.x, shape.centroid.y) for shape in shapes])
    longitude_deg, latitude_deg = np.median(middles, axis=0).tolist()
    return {"latitude_deg": latitude_deg, "longitude_deg": longitude_deg}


def test_without_a_section_there_is_no_scene(tmp_path: Path) -> None:
    assert scene_of(tmp_path) is None
    plain = scene_of(tmp_path, frame_id="odom")
    assert plain is not None and plain.ground is None and plain.grid.frame_id == "odom"


@needs_data
def test_a_map_of_streets_is_the_base_and_its_buildings_stand_on_the_ground(tmp_path: Path) -> None:
    pytest.importorskip("pyogrio", reason="the Python package pyogrio (extra geo) is not installed")
    node = scene_of(tmp_path, base=str(DATA / "streets.osm"), origin=origin_of_streets())
    assert node is not None
    node.tick(seen=False)
    base = node.scene.merged("base")
    assert (base == 0).sum() > 100, "roads and paths are free"
    assert (base == OCCUPIED).any() == (node.ground is not None and len(node.ground.faces) > 0)


@needs_data
def test_an_elevation_model_is_the_ground(tmp_path: Path) -> None:
    rasterio = pytest.importorskip("rasterio", reason="the Python package rasterio (extra geo) is not installed")
    with rasterio.open(DATA / "dem_1arcsec.tif") as raster:
        middle = raster.xy(raster.height // 2, raster.width // 2)
    where = {"longitude_deg": float(middle[0]), "latitude_deg": float(middle[1])}
    node = scene_of(tmp_path, terrain=str(DATA / "dem_1arcsec.tif"), origin=where)
    assert node is not None and node.ground is not None
    heights_m = node.ground.vertices[:, 2]
    assert len(node.ground.faces) > 10_000 and heights_m.max() - heights_m.min() > 0.5
    far = {"longitude_deg": where["longitude_deg"] + 40, "latitude_deg": where["latitude_deg"]}
    with pytest.raises(ConfigError, match=r"dem_1arcsec.tif"):
        scene_of(tmp_path, terrain=str(DATA / "dem_1arcsec.tif"), origin=far)
