"""From GPS to metres at the site, and from there to an engine's axes: the paper's eqs. haversine, enu and unity, and
its Algorithm convert_gps_to_unity.

All takes batches: the last axis of an array has latitude, longitude (radians) and height (metres above the ellipsoid),
or east, north and up (metres). What is not finite stays so, in its own row alone; whoever has a fix that may be none
looks before.
"""

import math
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sern_core.vocabulary.errors import UsageError

Floats = NDArray[np.float64]
Model = Literal["wgs84", "paper"]

EARTH_RADIUS_M: Final = 6_371_008.771
"""The mean radius (2a + b) / 3 of the ellipsoid: `r` in the paper's equations."""
WGS84_A_M: Final = 6_378_137.0
WGS84_E2: Final = 0.006_694_379_990_141_317
"""Semi-major axis and first eccentricity squared of WGS-84 (NGA.STND.0036, table 3.1 and 3.5)."""
_ORTHOGONAL: Final = 1e-9


def haversine_m(start: ArrayLike, end: ArrayLike) -> Floats:
    """The great-circle distance [m] on a sphere (eq. haversine); of the points' heights nothing is used.

    It is within .6 % of the geodesic on the ellipsoid.
    """
    first, second = np.asarray(start, np.float64), np.asarray(end, np.float64)
    latitude, longitude = first[..., 0], first[..., 1]
    other_latitude, other_longitude = second[..., 0], second[..., 1]
    half = (
        np.sin((other_latitude - latitude) / 2) ** 2
        + np.cos(latitude) * np.cos(other_latitude) * np.sin((other_longitude - longitude) / 2) ** 2
    )
    # Rounding makes it a little more than 1 for points opposite each other.
    distance: Floats = 2 * EARTH_RADIUS_M * np.arcsin(np.sqrt(np.minimum(half, 1.0)))
    return distance


@dataclass(frozen=True, slots=True)
class TangentPlane:
    """The site's plane of east, north and up, through a point of reference.

    `paper` is eq. (enu) on a sphere: at 39° of latitude it is off by +.16 % to the north and -.25 % to the east, 8 cm
    at 32 m. `wgs84` has the radii of curvature of the ellipsoid at the point instead: it is off by 1 cm at 400 m, 7 cm
    at 1 km and .7 m at 3 km. Up is the difference of the heights in both, so that the ground of an elevation model
    stays as level as it is there. Neither is for points nearer to a pole than the site is large.

    UsageError: the point is no point of the Earth, or a pole.
    """

    latitude_rad: float
    longitude_rad: float
    height_m: float = 0.0
    model: Model = "wgs84"

    def __post_init__(self) -> None:
        if not abs(self.latitude_rad) < math.pi / 2:  # and no NaN
            raise UsageError(f"the latitude of the site's point is {self.latitude_rad}: radians between -π/2 and π/2")
        if not (abs(self.longitude_rad) <= 2 * math.pi and math.isfinite(self.height_m)):
            raise UsageError(
                f"the site's point has longitude {self.longitude_rad} and height {self.height_m}: radians and metres"
            )

    @classmethod
    def from_degrees(
        cls, latitude_deg: float, longitude_deg: float, height_m: float = 0.0, model: Model = "wgs84"
    ) -> "TangentPlane":
        """The same from degrees, as sensor_msgs/NavSatFix has them."""
        return cls(math.radians(latitude_deg), math.radians(longitude_deg), height_m, model)

    def east_radius_m(self) -> float:
        """Metres to the east for a radian of longitude."""
        radius_m = EARTH_RADIUS_M
        if self.model == "wgs84":
            radius_m = WGS84_A_M / math.sqrt(1 - WGS84_E2 * math.sin(self.latitude_rad) ** 2) + self.height_m
        return radius_m * math.cos(self.latitude_rad)

    def north_radius_m(self) -> float:
        """Metres to the north for a radian of latitude."""
        if self.model == "paper":
            return EARTH_RADIUS_M
        flattened = 1 - WGS84_E2 * math.sin(self.latitude_rad) ** 2
        return float(WGS84_A_M * (1 - WGS84_E2) / flattened**1.5 + self.height_m)

    def to_local(self, points: ArrayLike) -> Floats:
        """East, north, up [m] of latitudes, longitudes [rad] and heights [m], (..., 3). The shorter way round."""
        geodetic = np.asarray(points, np.float64)
        local = np.empty_like(geodetic)
        east = geodetic[..., 1] - self.longitude_rad
        east -= 2 * math.pi * np.rint(east / (2 * math.pi))
        local[..., 0] = east * self.east_radius_m()
        local[..., 1] = (geodetic[..., 0] - self.latitude_rad) * self.north_radius_m()
        local[..., 2] = geodetic[..., 2] - self.height_m
        return local

    def to_geodetic(self, points: ArrayLike) -> Floats:
        """Latitude, longitude (-π to π) [rad] and height [m] of points of the plane, (..., 3)."""
        local = np.asarray(points, np.float64)
        geodetic = np.empty_like(local)
        geodetic[..., 0] = self.latitude_rad + local[..., 1] / self.north_radius_m()
        longitude = self.longitude_rad + local[..., 0] / self.east_radius_m()
        geodetic[..., 1] = longitude - 2 * math.pi * np.rint(longitude / (2 * math.pi))
        geodetic[..., 2] = local[..., 2] + self.height_m
        return geodetic


@dataclass(frozen=True, slots=True)
class AxisMap:
    """How one frame's axes lie in another, `rows` of a matrix of O(3), and how many units of it are a metre.

    The paper has SO(3) in eq. (unity). Unity is left-handed, so from ENU the map is a reflection.

    UsageError: the rows are not orthogonal, or the scale is not more than 0.
    """

    rows: tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
    units_per_m: float = 1.0

    def __post_init__(self) -> None:
        matrix = self.matrix()
        if not (matrix.shape == (3, 3) and np.allclose(matrix @ matrix.T, np.eye(3), rtol=0, atol=_ORTHOGONAL)):
            raise UsageError(f"the axis map {self.rows} is not orthogonal: give three perpendicular rows of length 1")
        if not (math.isfinite(self.units_per_m) and self.units_per_m > 0):
            raise UsageError(f"the axis map has {self.units_per_m} units a metre: give a number above 0")

    def matrix(self) -> Floats:
        return np.array(self.rows, np.float64)

    def points(self, points: ArrayLike) -> Floats:
        """Positions in the other frame and its units, (..., 3): eq. (unity). Speeds go the same way."""
        mapped: Floats = np.asarray(points, np.float64) @ (self.units_per_m * self.matrix().T)
        return mapped

    def back(self, points: ArrayLike) -> Floats:
        """Positions [m] of what `points` gave."""
        mapped: Floats = np.asarray(points, np.float64) @ (self.matrix() / self.units_per_m)
        return mapped

    def quaternions(self, quaternions: ArrayLike) -> Floats:
        """Attitudes x, y, z, w in the other frame, (..., 4).

        A turn by Q is one by R Q Rᵀ there: the axis goes through R, and a reflection turns its sense. Rates of turn
        are such axes, too. With FLU and RUF it is (-y, z, x, -w) up to the sign of all, as ROS-TCP-Connector has it.
        """
        attitudes = np.asarray(quaternions, np.float64)
        mapped = np.empty_like(attitudes)
        mapped[..., :3] = self.axes(attitudes[..., :3])
        mapped[..., 3] = attitudes[..., 3]
        return mapped

    def axes(self, axes: ArrayLike) -> Floats:
        """Axial vectors, as rates of turn [rad/s], in the other frame, (..., 3)."""
        matrix = self.matrix()
        mapped: Floats = np.asarray(axes, np.float64) @ (float(np.rint(np.linalg.det(matrix))) * matrix.T)
        return mapped


UNITY_FROM_ENU: Final = AxisMap(((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)))
"""x east, y up, z north: the world frame of Unity's scenes."""
UNITY_FROM_FLU: Final = AxisMap(((0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)))
"""x right, y up, z forward: Unity's axes of a body, from forward, left, up (REP 103)."""


def geo_to_unity(points: ArrayLike, plane: TangentPlane, axes: AxisMap = UNITY_FROM_ENU) -> Floats:
    """Unity's coordinates of latitudes, longitudes [rad] and heights [m], (..., 3): Algorithm convert_gps_to_unity."""
    return axes.points(plane.to_local(points))
