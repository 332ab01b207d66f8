"""Places: against pyproj and pymap3d, which know the Earth, and against what is known of the axes."""

import math

import numpy as np
import pytest

from sern_core.vocabulary.errors import UsageError
from sern_twin.geodesy import (
    UNITY_FROM_ENU,
    UNITY_FROM_FLU,
    AxisMap,
    Floats,
    Model,
    TangentPlane,
    geo_to_unity,
    haversine_m,
)
from tests.sern_twin.rotations import random_attitudes, turned

pymap3d = pytest.importorskip("pymap3d", reason="the Python package pymap3d (extra dev) is not installed")
pyproj = pytest.importorskip("pyproj", reason="the Python package pyproj (extra dev) is not installed")

SITE = TangentPlane.from_degrees(39.25, -76.71, 60.0)


def around(site: TangentPlane, radius_m: float, number: int = 400) -> tuple[Floats, Floats]:
    """Points up to so far away: geodetic, and what pymap3d says of them east, north and up of the site."""
    random = np.random.default_rng(1)
    local = random.uniform(-radius_m, radius_m, (number, 3)) / math.sqrt(2)
    local[:, 2] = random.uniform(-5, 5, number)
    latitude, longitude, height = pymap3d.enu2geodetic(
        *local.T, site.latitude_rad, site.longitude_rad, site.height_m, deg=False
    )
    return np.stack([latitude, longitude, height], -1), local


@pytest.mark.parametrize(
    ("start", "end"),
    [
        ((0, 0), (0, 90)),
        ((90, 0), (-90, 0)),
        ((51.5, -0.12), (48.85, 2.35)),
        ((10, 179.9), (10, -179.9)),
        ((5, 7), (5, 7)),
    ],
)
def test_haversine_is_near_the_geodesic(start: tuple[float, float], end: tuple[float, float]) -> None:
    _, _, geodesic_m = pyproj.Geod(ellps="WGS84").inv(start[1], start[0], end[1], end[0])
    found_m = haversine_m(np.radians(start), np.radians(end))
    assert found_m == pytest.approx(geodesic_m, rel=0.006, abs=1e-6)


def test_haversine_on_its_sphere() -> None:
    """It says what pyproj says where the ellipsoid is that sphere; opposite points are half a turn, and no NaN."""
    random = np.random.default_rng(2)
    start, end = np.radians(random.uniform((-90, -180), (90, 180), (2, 1000, 2)))
    _, _, sphere_m = pyproj.Geod(a=6_371_008.771, b=6_371_008.771).inv(
        start[:, 1], start[:, 0], end[:, 1], end[:, 0], radians=True
    )
    assert haversine_m(start, end) == pytest.approx(sphere_m, rel=1e-9, abs=1e-3)
    opposite = np.stack([-start[:, 0], start[:, 1] + math.pi], -1)
    assert haversine_m(start, opposite) == pytest.approx(math.pi * 6_371_008.771, rel=1e-6)


@pytest.mark.parametrize(("radius_m", "off_m"), [(50, 0.001), (400, 0.03), (3000, 1.2)])
@pytest.mark.parametrize("latitude_deg", [-39.25, 0.0, 39.25])
def test_the_plane_is_that_of_the_ellipsoid(latitude_deg: float, radius_m: float, off_m: float) -> None:
    site = TangentPlane.from_degrees(latitude_deg, -76.71, 60.0)
    geodetic, local = around(site, radius_m)
    off = np.abs(site.to_local(geodetic) - local)
    assert off[:, :2].max() < off_m
    assert off[:, 2].max() < radius_m**2 / 2 / 6.3e6 + 1e-6, "up is the height's: the ground falls away from the plane"
    assert site.to_local(geodetic)[:, 2] == pytest.approx(geodetic[:, 2] - 60.0)


def test_the_plane_of_the_paper_is_off_as_its_sphere_is() -> None:
    """Its eq. (enu) with the mean radius, against the ellipsoid's: +.16 % to the north, -.25 % to the east."""
    paper = TangentPlane.from_degrees(39.25, -76.71, 0.0, "paper")
    geodetic, local = around(TangentPlane.from_degrees(39.25, -76.71, 0.0), 50.0)
    ratio = paper.to_local(geodetic)[:, :2] / local[:, :2]
    assert np.median(ratio, axis=0) - 1 == pytest.approx([-0.00246, 0.00157], abs=2e-5)
    north_m = paper.to_local([paper.latitude_rad + 1e-6, paper.longitude_rad, 0.0])[1]
    assert north_m == pytest.approx(haversine_m([0.0, 0.0], [1e-6, 0.0]), rel=1e-9)


@pytest.mark.parametrize("model", ["wgs84", "paper"])
@pytest.mark.parametrize("longitude_deg", [-179.9999, 0.0, 12.5, 180.0])
def test_there_and_back(model: Model, longitude_deg: float) -> None:
    """Also over the date line, where the longitude changes its sign."""
    site = TangentPlane.from_degrees(12.0, longitude_deg, 5.0, model)
    local = np.random.default_rng(3).uniform(-2000, 2000, (50, 4, 3))
    geodetic = site.to_geodetic(local)
    assert np.abs(geodetic[..., 1]).max() <= math.pi
    assert site.to_local(geodetic) == pytest.approx(local, abs=1e-6)


def test_what_is_not_finite_stays_in_its_row() -> None:
    points = np.tile([SITE.latitude_rad, SITE.longitude_rad, 61.0], (3, 1))
    points[1] = (math.nan, math.inf, -math.inf)
    with np.errstate(invalid="ignore"):
        local = geo_to_unity(points, SITE)
    assert local[[0, 2]] == pytest.approx(np.tile([0.0, 1.0, 0.0], (2, 1)))
    assert not np.isfinite(local[1]).any()


def test_a_batch_is_its_points() -> None:
    geodetic, _ = around(SITE, 100.0, 24)
    single = np.stack([geo_to_unity(point, SITE) for point in geodetic])
    assert geo_to_unity(geodetic, SITE) == pytest.approx(single)
    assert geo_to_unity(geodetic.reshape(2, 3, 4, 3), SITE).reshape(-1, 3) == pytest.approx(single)
    assert geo_to_unity(np.empty((0, 3)), SITE).shape == (0, 3)


@pytest.mark.parametrize("latitude_deg", [90.0, -90.0, 91.0, math.nan])
def test_no_plane_at_a_pole_or_nowhere(latitude_deg: float) -> None:
    with pytest.raises(UsageError, match="latitude"):
        TangentPlane.from_degrees(latitude_deg, 0.0)


@pytest.mark.parametrize(("longitude_rad", "height_m"), [(math.nan, 0.0), (7.0, 0.0), (0.0, math.inf)])
def test_no_plane_without_longitude_and_height(longitude_rad: float, height_m: float) -> None:
    with pytest.raises(UsageError, match="longitude"):
        TangentPlane(0.5, longitude_rad, height_m)


def test_axes_of_unity() -> None:
    assert UNITY_FROM_ENU.points([1.0, 2.0, 3.0]) == pytest.approx([1.0, 3.0, 2.0])
    assert UNITY_FROM_FLU.points([1.0, 2.0, 3.0]) == pytest.approx([-2.0, 3.0, 1.0])
    # As ROS-TCP-Connector: q -> (-y, z, x, -w), which is the same attitude as (y, -z, -x, w).
    assert UNITY_FROM_FLU.quaternions([0.1, 0.2, 0.3, 0.9]) == pytest.approx([0.2, -0.3, -0.1, 0.9])
    for axes in (UNITY_FROM_ENU, UNITY_FROM_FLU):
        assert np.linalg.det(axes.matrix()) == pytest.approx(-1.0), "Unity is left-handed"


@pytest.mark.parametrize(
    "axes",
    [UNITY_FROM_ENU, UNITY_FROM_FLU, AxisMap(((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)), 100.0)],
    ids=["enu", "flu", "a turn, in centimetres"],
)
def test_turning_and_mapping_commute(axes: AxisMap) -> None:
    """Where the mapped attitude turns a mapped point to is where the turned point is mapped to; points come back."""
    random = np.random.default_rng(4)
    attitudes, points = random_attitudes(random, 100), random.normal(size=(100, 3))
    mapped = turned(axes.quaternions(attitudes), axes.points(points))
    assert mapped == pytest.approx(axes.points(turned(attitudes, points)))
    assert axes.back(axes.points(points)) == pytest.approx(points)


def test_rates_of_turn_go_with_the_attitudes() -> None:
    """A body that turns left (about up) turns left in Unity, too, where that is a negative rate about its up."""
    assert UNITY_FROM_FLU.axes([0.0, 0.0, 0.5]) == pytest.approx([0.0, -0.5, 0.0])


@pytest.mark.parametrize("rows", [((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.1)), ((1.0, 0.0, 0.0),) * 3])
def test_an_axis_map_is_orthogonal(rows: tuple[tuple[float, float, float], ...]) -> None:
    with pytest.raises(UsageError, match="orthogonal"):
        AxisMap(rows)  # type: ignore[arg-type]


@pytest.mark.parametrize("units_per_m", [0.0, -1.0, math.nan, math.inf])
def test_an_axis_map_has_a_scale(units_per_m: float) -> None:
    with pytest.raises(UsageError, match="units a metre"):
        AxisMap(UNITY_FROM_ENU.rows, units_per_m)
