"""Heights of a raster on a grid, whatever way its pixels lie, and what has no height."""

import math

import numpy as np
import pytest

pytest.importorskip("scipy", reason="the Python package scipy (extra twin) is not installed")

from sern_core.vocabulary.errors import UsageError
from sern_twin.geodesy import TangentPlane
from sern_twin.world.grid import Floats, Grid
from sern_twin.world.mesh import joined
from sern_twin.world.terrain import ElevationRaster, Resampling, Terrain, flat, resampled

PLANE = TangentPlane.from_degrees(47.0, 11.0, 500.0)
GRID = Grid(-40.0, -30.0, 2.0, 40, 30, plane=PLANE)


def hill_m(east: Floats, north: Floats) -> Floats:
    return 600 + 0.3 * east - 0.1 * north


def raster(turn_rad: float = 0.0, bend: float = 0.0, pixel_m: float = 10.0, size: int = 25) -> ElevationRaster:
    """A slope, in pixels that lie turned and in bent rows as those of a map projection do; row 0 is in the north."""
    rows, columns = np.mgrid[:size, :size].astype(np.float64) - (size - 1) / 2
    across, along = columns * pixel_m, -rows * pixel_m
    along = along + bend * across**2 / 1000
    east = across * math.cos(turn_rad) - along * math.sin(turn_rad)
    north = across * math.sin(turn_rad) + along * math.cos(turn_rad)
    geodetic = PLANE.to_geodetic(np.stack((east, north, np.zeros(east.shape)), axis=-1))
    return ElevationRaster(hill_m(east, north), geodetic[..., 0], geodetic[..., 1])


@pytest.mark.parametrize(("turn_rad", "bend"), [(0.0, 0.0), (0.4, 0.0), (math.pi, 0.0), (2.0, 0.3)])
def test_a_slope_comes_over_from_pixels_that_lie_anyhow(turn_rad: float, bend: float) -> None:
    terrain = resampled(raster(turn_rad, bend), GRID)
    centres = GRID.all_centres()
    wanted = hill_m(centres[..., 0], centres[..., 1]) - 500
    np.testing.assert_allclose(terrain.heights_m, wanted, atol=1e-4 if not bend else 0.02)
    assert terrain.resampling == Resampling()
    normal = np.array([-0.3, 0.1, 1.0]) / math.sqrt(1.1)
    np.testing.assert_allclose(terrain.normals().mean(axis=(0, 1)), normal, atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(terrain.normals(), axis=-1), 1)


def holed() -> ElevationRaster:
    """Without data in the north-west, by the words that rasters have for it."""
    whole = raster()
    heights = whole.heights_m.copy()
    heights[:11, :11] = np.nan
    heights[0, 0], heights[1, 1], heights[2, 2] = -32768.0, math.inf, 3.4e38
    return ElevationRaster(heights, whole.latitudes_rad, whole.longitudes_rad)


def test_what_has_no_data_is_counted_and_filled_or_left() -> None:
    filled, left = resampled(holed(), GRID), resampled(holed(), GRID, fill="none")
    assert filled.resampling == left.resampling
    lacking = np.isnan(left.heights_m)
    assert left.resampling.no_data == np.count_nonzero(lacking) > 0
    assert left.resampling.partial > 0 and left.resampling.outside == 0
    rows, columns = np.nonzero(lacking)
    assert (rows > GRID.rows / 2).all() and (columns < GRID.columns / 2).all(), "in the north-west"
    assert np.isfinite(filled.heights_m).all()
    assert (filled.heights_m[~lacking] == left.heights_m[~lacking]).all()
    known = holed().heights_m[(holed().heights_m > 0) & (holed().heights_m < 9000)] - 500
    assert all(np.isclose(known, height).any() for height in filled.heights_m[lacking]), "that of a pixel"


def test_what_the_raster_does_not_reach_is_counted() -> None:
    small = raster(size=5, pixel_m=9.0)  # 45 m from edge to edge
    left = resampled(small, GRID, fill="none")
    centres = np.abs(GRID.all_centres())
    beyond = (centres > 22.5).any(axis=-1)
    assert left.resampling.outside == np.count_nonzero(beyond)
    assert (np.isnan(left.heights_m) == beyond).all()
    filled = resampled(small, GRID)
    assert np.isfinite(filled.heights_m).all()
    assert filled.heights_m.max() <= small.heights_m.max() - 500


def test_the_height_at_a_place_lies_between_those_of_the_cells() -> None:
    terrain = resampled(raster(), GRID)
    east, north = np.array([0.0, 3.3, -38.0]), np.array([0.0, -7.1, 28.0])
    np.testing.assert_allclose(terrain.height_m(east, north), hill_m(east, north) - 500, atol=1e-3)
    assert np.isnan(terrain.height_m([-40.1, 41.0, math.nan, math.inf], 0.0)).all()
    assert terrain.height_m(-39.9, -29.9) == terrain.heights_m[0, 0], "beyond the last middle it stays"
    assert flat(GRID, 3.0).height_m(0.0, 0.0) == 3.0
    assert (flat(Grid(0.0, 0.0, 1.0, 1, 1), 3.0).normals() == [0, 0, 1]).all()


def test_a_mesh_faces_the_sky_and_covers_the_grid() -> None:
    terrain = resampled(raster(), GRID)
    for step in (1, 4, 7, 1000):
        mesh = terrain.mesh(step)
        corners = mesh.vertices[mesh.faces].astype(np.float64)
        doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert (doubled[:, 2] > 0).all()
        assert doubled[:, 2].sum() / 2 == pytest.approx((GRID.columns - 1) * (GRID.rows - 1) * 4, rel=1e-5)
        assert (mesh.vertices.dtype.name, mesh.faces.dtype.name) == ("float32", "int32")
        assert len(np.unique(mesh.faces)) == len(mesh.vertices)
    assert len(terrain.mesh(4).faces) < len(terrain.mesh(1).faces) / 10
    with pytest.raises(UsageError, match="give 1 or more"):
        terrain.mesh(0)
    assert len(flat(Grid(0.0, 0.0, 1.0, 5, 1)).mesh().faces) == 0


def test_a_mesh_has_a_hole_where_no_height_is_known() -> None:
    terrain = resampled(holed(), GRID, fill="none")
    mesh = terrain.mesh()
    assert np.isfinite(mesh.vertices).all()
    assert 0 < len(mesh.faces) < len(resampled(holed(), GRID).mesh().faces)
    both = joined([mesh, mesh])
    assert both.faces.max() == 2 * len(mesh.vertices) - 1
    assert len(joined([]).faces) == 0


def test_a_raster_that_is_none_is_refused() -> None:
    good = raster()
    line = np.zeros((1, 5))
    with pytest.raises(UsageError, match="two pixels or more"):
        ElevationRaster(line, line, line)
    with pytest.raises(UsageError, match="two pixels or more"):
        ElevationRaster(good.heights_m, good.latitudes_rad, line)
    for bad in (math.nan, 2.0, math.inf):
        places = good.latitudes_rad.copy()
        places[3, 3] = bad
        with pytest.raises(UsageError, match="places that are none"):
            ElevationRaster(good.heights_m, places, good.longitudes_rad)
    large = np.zeros((2001, 2000))
    with pytest.raises(UsageError, match="4000000 are the most"):
        ElevationRaster(large, large, large)
    with pytest.raises(UsageError, match="has no heights"):
        resampled(ElevationRaster(good.heights_m * math.nan, good.latitudes_rad, good.longitudes_rad), GRID)
    with pytest.raises(UsageError, match="lie in one line"):
        resampled(ElevationRaster(good.heights_m, good.latitudes_rad, good.latitudes_rad * 0), GRID)
    with pytest.raises(UsageError, match="give it a plane"):
        resampled(good, Grid(0.0, 0.0, 1.0, 4, 4))
    with pytest.raises(UsageError, match="for a grid of"):
        Terrain(GRID, np.zeros((2, 2)))
