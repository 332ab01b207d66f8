"""The place of `sern demo-navigation`, its files, and what is made of its drives."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sern_core.vocabulary.errors import SernError
from sern_runtime.config.base import FileModel
from sern_runtime.config.client import ClientFile
from sern_runtime.config.load import check_bytes
from sern_runtime.config.navigation import NavigationFile
from sern_runtime.config.relay import RelayFile
from sern_runtime.geodata import read_geojson
from sern_runtime.profiles import load_profile
from sern_sim.terrain import Label
from sern_tools import demo_campus as course
from sern_tools import demo_navigation as demo
from sern_tools.demo_navigation_report import Drive, Ended, Place, as_html, judged, write
from sern_twin.world.patches import LASTING, OCCUPIED
from sern_twin.world.primitives import base_cells, primitives, rasterised

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"
GONE = ((20.0, 35.0),)


@pytest.fixture(scope="module")
def place() -> course.Campus:
    return course.campus(1)


def test_the_way_over_the_street_is_closed_and_the_one_over_the_bridge_is_not(place: course.Campus) -> None:
    occupied = place.terrain.occupancy(400) > 0

    def blocked(x_m: float, y_m: float) -> bool:
        return bool(occupied[int((y_m + course.HALF_M) * 10), int((x_m + course.HALF_M) * 10)])

    assert blocked(course.STREET_X_M, course.DITCH_Y_M) and not blocked(course.BRIDGE_X_M, course.DITCH_Y_M)
    assert blocked(0.0, course.DITCH_Y_M - 0.6), "the ditch"
    for x_m, y_m in ((course.START.x_m, course.START.y_m), course.GOAL_M):
        assert not blocked(x_m, y_m)
    assert not any(block.label is Label.LOG for block in place.terrain.blocks), "logs are in the twin alone"


def test_its_map_has_what_stands_there_but_the_car(place: course.Campus) -> None:
    read = read_geojson(place.base_map().encode(), "campus.geojson")
    grid = replace(course.GRID, plane=place.plane)
    cells = base_cells(rasterised(primitives(read.features, place.plane).found, grid))
    assert cells[tuple(grid.index(np.array([0.0, course.DITCH_Y_M])))] == LASTING
    assert cells[tuple(grid.index(np.array([course.STREET_X_M, course.DITCH_Y_M])))] == 0
    assert cells[tuple(grid.index(np.array([course.BRIDGE_X_M, course.DITCH_Y_M])))] == 0
    assert (cells == OCCUPIED).sum() > 1000
    assert [name for name, _, _ in place.added()] == ["car", "logs", "logs"]


@pytest.mark.skipif(not (SHARED / "streets.osm").is_file(), reason="no real map or elevation model beside the checkout")
def test_ground_and_buildings_come_from_files() -> None:
    pytest.importorskip("rasterio", reason="needs rasterio: pip install 'sern[geo]'")
    found = course.campus(1, SHARED / "dem_1arcsec.tif", SHARED / "streets.osm")
    assert len(found.buildings) == 6 + 3 and any("dem_1arcsec.tif" in note for note in found.notes)
    step_m = 2 * course.HALF_M / (course.POINTS - 1)
    ground = found.terrain.heights_m[:50]
    assert np.ptp(ground) > 0.5 and np.hypot(*np.gradient(ground, step_m)).max() <= course.STEEPEST + 0.02


@pytest.mark.parametrize("mode", demo.MODES)
def test_its_files_are_right(mode: str, place: course.Campus, tmp_path: Path) -> None:
    options = demo.Options(
        load_profile("demo-navigation", None), None, 1, None, None, demo.MODES, tmp_path, False, None, ""
    )
    web = {name: 20_000 + number for number, name in enumerate((*demo.DAEMONS, demo.JACKAL))}
    made = demo.contents(options, mode, 19_999, web, place.plane)
    for name, content in made.items():
        kinds: dict[str, type[FileModel]] = {demo.RELAY: RelayFile, demo.NAVIGATION: NavigationFile}
        kind = kinds.get(name, ClientFile)
        checked = check_bytes(json.dumps(content).encode(), tmp_path / f"{name}.yaml", kind)
        assert checked.loaded is not None, checked.errors
        if isinstance(checked.loaded.model, NavigationFile):
            topics = checked.loaded.model.topics
            assert (topics.twin is not None, topics.map is not None) == (mode == demo.SERN, mode == demo.SIM_ONLY)


def drive(mode: str, *, took_s: float, how: str = "succeeded", touched: int = 0, phantoms: int = 1) -> Drive:
    way = np.linspace((course.START.x_m, course.START.y_m), course.GOAL_M, 50)
    places = tuple(Place(took_s * k / 49, float(x), float(y), "following") for k, (x, y) in enumerate(way))
    flagged = tuple({"kind": "phantom", "id": str(number), "at_s": 1.0} for number in range(phantoms))
    return Drive(mode, Ended(how, ""), took_s, places, touched, 20.0, 0, 9.0, flagged)


def broken(*drives: Drive) -> list[str]:
    report = judged(drives, course.campus(1), GONE, "sern demo-navigation")
    return [verdict.name for verdict in report.verdicts if not verdict.kept]


def test_promises_that_were_kept() -> None:
    assert broken(drive("Real Only", took_s=120.0), drive("SERN", took_s=60.0)) == []


@pytest.mark.parametrize(
    ("changed", "name"),
    [
        ({"touched": 1}, "SERN: things that were run into"),
        ({"how": "aborted"}, "SERN: the goal, as its client was told"),
        ({"phantoms": 0}, "SERN: logs that are not there, flagged"),
        ({"took_s": 130.0}, "SERN: time to the goal"),
    ],
)
def test_promises_that_were_broken(changed: dict[str, float], name: str) -> None:
    given = {"took_s": 60.0, **changed}
    assert broken(drive("Real Only", took_s=120.0), drive("SERN", **given)) == [name]  # type: ignore[arg-type]


def test_nothing_seen_is_an_error() -> None:
    with pytest.raises(SernError, match="nothing was seen"):
        judged((), course.campus(1), GONE, "")


def test_what_it_leaves_behind(tmp_path: Path, place: course.Campus) -> None:
    report = judged((drive("SERN", took_s=60.0),), place, GONE, "sern demo-navigation --seed <1>")
    assert "&lt;1&gt;" in as_html(report, None)
    paths = write(report, tmp_path)
    assert json.loads(paths[0].read_text())["drives"][0]["mode"] == "SERN"
    if len(paths) == 3:  # where matplotlib is
        assert paths[2].read_bytes().startswith(b"\x89PNG")
