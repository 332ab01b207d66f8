"""The place of `sern demo-navigation`: buildings, a ditch with a narrow bridge, a street on which a car is parked, and
logs that only the twin has.

The ground is that of an elevation model and the buildings are those of a map, where there are files of them; else both
are made up. Ditch, bridge, street and car are laid over that: the paper's test course ("Navigation Comparison").
"""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any, Final

import numpy as np

from sern_core.vocabulary.errors import ConfigError
from sern_sim.robot import Pose2
from sern_sim.terrain import Block, Label, Terrain
from sern_sim.world import Floats
from sern_twin.geodesy import TangentPlane
from sern_twin.world.grid import Grid

HALF_M: Final = 20.0
POINTS: Final = 201
DITCH_Y_M: Final = -4.0
DITCH_HALF_M: Final = 0.9
DITCH_DEPTH_M: Final = 0.8
STREET_X_M: Final = 5.0
STREET_HALF_M: Final = 1.6
BRIDGE_X_M: Final = -15.0
BRIDGE_HALF_M: Final = 1.1
RAILING_HALF_M: Final = DITCH_HALF_M + 0.7
RAILING_M: Final = 0.5
"""The bridge has railings that begin before it, as bridges have."""
START: Final = Pose2(8.0, -10.0, 0.0)
GOAL_M: Final = (-2.0, 9.0)
CAR_M: Final = (4.2, 1.7, 1.4)
"""Length, width and height of the car, which stands across the street."""
LOG_M: Final = (1.5, 0.25)
STEEPEST: Final = 0.06
"""Rise over run: ground of an elevation model that is steeper is made as steep as that, where no robot slides."""
WALL_M: Final = 3.0
LEAST_M2: Final = 4.0
"""What is left of a building at the edge is at least so large."""
CLEAR_M: Final = 2.0
"""No building stands nearer to ditch, street, start and goal."""
MAP_MIDDLE_M: Final = (42.0, -9.0)
"""The middle of the place on the map: east and north of the middle of what the map has."""
Corners = tuple[tuple[float, float], ...]
GRID: Final = Grid(-HALF_M, -HALF_M, 0.1, 400, 400, frame_id="odom")
_MADE_UP: Final[tuple[Corners, ...]] = (
    ((-17.0, 6.0), (-8.0, 6.0), (-8.0, 15.0), (-17.0, 15.0)),
    ((3.0, 6.0), (14.0, 6.0), (14.0, 14.0), (3.0, 14.0)),
    ((-3.0, -18.0), (10.0, -18.0), (10.0, -12.0), (-3.0, -12.0)),
)

_YARD: Final[tuple[Corners, ...]] = (
    ((-9.8, -5.6), (-4.0, -5.6), (-4.0, -5.3), (-9.8, -5.3)),
    ((-9.8, -9.5), (-4.0, -9.5), (-4.0, -9.2), (-9.8, -9.2)),
    ((-9.8, -9.5), (-9.5, -9.5), (-9.5, -5.3), (-9.8, -5.3)),
)
"""Walls of a yard that is open to the east: a dead end on the way along the ditch."""


@dataclass(frozen=True, slots=True)
class Campus:
    """`terrain`: what is there. `buildings`: their corners [m]. `plane`: where the map is on the Earth."""

    terrain: Terrain
    buildings: tuple[Corners, ...]
    plane: TangentPlane
    notes: tuple[str, ...]

    def base_map(self) -> str:
        """What a map of the place has, as GeoJSON: buildings, the ditch as water, street and bridge."""
        ditch = (DITCH_Y_M - DITCH_HALF_M, DITCH_Y_M + DITCH_HALF_M)
        features: list[Any] = [self._area({"building": "yes"}, corners) for corners in self.buildings]
        for west_m, east_m in (
            (-HALF_M, STREET_X_M - STREET_HALF_M),
            (STREET_X_M + STREET_HALF_M, BRIDGE_X_M - BRIDGE_HALF_M),
            (BRIDGE_X_M + BRIDGE_HALF_M, HALF_M),
        ):
            corners = ((west_m, ditch[0]), (east_m, ditch[0]), (east_m, ditch[1]), (west_m, ditch[1]))
            features.append(self._area({"natural": "water"}, corners))
        for tags, x_m in (({"highway": "residential", "width": "3"}, STREET_X_M), ({"highway": "footway"}, BRIDGE_X_M)):
            features.append(
                self._feature(tags, "LineString", self._degrees(((x_m, DITCH_Y_M - 4), (x_m, DITCH_Y_M + 4))))
            )
        return json.dumps({"type": "FeatureCollection", "features": features})

    def added(self) -> tuple[tuple[str, Pose2, tuple[float, float, float]], ...]:
        """What people have added to the twin, by name: place and size [m]. The car stands there; the logs, side by side
        before the bridge, do not."""
        before_m = DITCH_Y_M - DITCH_HALF_M - 0.2
        logs = [
            ("logs", Pose2(BRIDGE_X_M + side * LOG_M[0] / 2, before_m, 0.0), (LOG_M[0], LOG_M[1], LOG_M[1]))
            for side in (-1, 1)
        ]
        return (("car", Pose2(STREET_X_M, DITCH_Y_M, 0.0), CAR_M), *logs)

    def _area(self, tags: dict[str, str], corners: Corners) -> Any:
        return self._feature(tags, "Polygon", [self._degrees((*corners, corners[0]))])

    def _feature(self, tags: dict[str, str], kind: str, coordinates: Any) -> Any:
        return {"type": "Feature", "properties": tags, "geometry": {"type": kind, "coordinates": coordinates}}

    def _degrees(self, corners: Corners) -> list[list[float]]:
        places = np.array([(x_m, y_m, 0.0) for x_m, y_m in corners])
        return [[float(each) for each in place] for place in np.degrees(self.plane.to_geodetic(places)[:, [1, 0]])]


def campus(seed: int, dem: Path | None = None, streets: Path | None = None) -> Campus:
    """The place. ConfigError: a file cannot be read, or has nothing there."""
    random = Random(seed)
    notes: list[str] = []
    heights = _made_up_heights(random) if dem is None else _of_model(dem, notes)
    buildings, plane = _MADE_UP, TangentPlane.from_degrees(48.1354, 10.0698, 0.0)
    if streets is not None:
        buildings, plane = _of_map(streets)
        notes.append(f"{len(buildings)} buildings of {streets.name}")
    buildings += _YARD
    heights = _with_ditch(heights)
    ground = Terrain(heights, half_size_m=HALF_M)
    blocks = [block for corners in buildings for block in _walls(ground, corners)]
    blocks += [
        Block(Label.OTHER, x_m, y_m, 0.0, half_m)
        for x_m, y_m, half_m in (
            (HALF_M - 0.2, 0.0, (0.1, HALF_M, 6.0)), (0.2 - HALF_M, 0.0, (0.1, HALF_M, 6.0)),
            (0.0, HALF_M - 0.2, (HALF_M, 0.1, 6.0)), (0.0, 0.2 - HALF_M, (HALF_M, 0.1, 6.0)),
        )
    ]  # fmt: skip
    blocks.append(
        Block(
            Label.BRIDGE, BRIDGE_X_M, DITCH_Y_M, ground.height_m(BRIDGE_X_M, DITCH_Y_M - 2.0) - 0.02,
            (BRIDGE_HALF_M, DITCH_HALF_M + 0.6, 0.03),
        )
    )  # fmt: skip
    blocks += [
        Block(
            Label.OTHER, BRIDGE_X_M + side * BRIDGE_HALF_M, DITCH_Y_M, ground.height_m(BRIDGE_X_M, DITCH_Y_M - 2.0),
            (0.04, RAILING_HALF_M, RAILING_M),
        )
        for side in (-1, 1)
    ]  # fmt: skip
    length_m, width_m, height_m = CAR_M
    blocks.append(
        Block(
            Label.CAR, STREET_X_M, DITCH_Y_M, ground.height_m(STREET_X_M, DITCH_Y_M) + height_m / 2,
            (length_m / 2, width_m / 2, height_m / 2),
        )
    )  # fmt: skip
    return Campus(Terrain(heights, tuple(blocks), HALF_M), buildings, plane, tuple(notes))


def _axes() -> tuple[Floats, Floats]:
    axis = np.linspace(-HALF_M, HALF_M, POINTS)
    x, y = np.meshgrid(axis, axis)
    return x, y


def _made_up_heights(random: Random) -> Floats:
    """Hills of a few per cent."""
    x, y = _axes()
    heights = np.zeros_like(x)
    for _ in range(20):
        at_x, at_y, wide_m = random.uniform(-HALF_M, HALF_M), random.uniform(-HALF_M, HALF_M), random.uniform(4.0, 8.0)
        heights += random.uniform(-0.05, 0.05) * wide_m * np.exp(-((x - at_x) ** 2 + (y - at_y) ** 2) / (2 * wide_m**2))
    return heights


def _of_model(path: Path, notes: list[str]) -> Floats:
    """The relief in the middle of an elevation model, in its true size unless that is too steep."""
    from sern_runtime.geodata import read_elevation
    from sern_twin.world.terrain import resampled

    raster = read_elevation(path)
    latitude, longitude = float(np.median(raster.latitudes_rad)), float(np.median(raster.longitudes_rad))
    plane = TangentPlane.from_degrees(math.degrees(latitude), math.degrees(longitude), 0.0)
    step_m = 2 * HALF_M / (POINTS - 1)
    grid = Grid(-HALF_M - step_m / 2, -HALF_M - step_m / 2, step_m, POINTS, POINTS, plane=plane)
    x, y = _axes()
    found: Floats = resampled(raster, grid).height_m(x, y)
    found -= found.mean()
    steepest = float(np.hypot(*np.gradient(found, step_m)).max())
    if steepest > STEEPEST:
        found *= STEEPEST / steepest
        notes.append(f"ground of {path.name}, {100 * steepest:.0f} % steep, made {100 * STEEPEST:.0f} %")
    else:
        notes.append(f"ground of {path.name}, up to {100 * steepest:.0f} % steep")
    return found


def _with_ditch(heights: Floats) -> Floats:
    """The ditch, level along its banks so that the bridge lies on both, and filled up where the street crosses it."""
    x, y = _axes()
    row = int(np.argmin(np.abs(y[:, 0] - DITCH_Y_M)))
    away = np.clip((np.abs(y - DITCH_Y_M) - 2.0) / 3.0, 0.0, 1.0)
    level = away * away * (3 - 2 * away)
    at_bridge = int(np.argmin(np.abs(x[0] - BRIDGE_X_M)))
    from_bridge = np.clip((np.abs(x[0] - BRIDGE_X_M) - 1.5) / 3.0, 0.0, 1.0)
    bank = heights[row] + (1 - from_bridge * from_bridge * (3 - 2 * from_bridge)) * (
        heights[row, at_bridge] - heights[row]
    )
    level_bank = bank[None, :] + level * (heights - bank[None, :])
    across = np.clip((DITCH_HALF_M - np.abs(y - DITCH_Y_M)) / 0.5, 0.0, 1.0)
    beside = np.clip((np.abs(x - STREET_X_M) - STREET_HALF_M) / 0.5, 0.0, 1.0)
    found: Floats = level_bank - DITCH_DEPTH_M * across * beside
    return found


def _of_map(path: Path) -> tuple[tuple[Corners, ...], TangentPlane]:
    """Buildings of a map that stand clear of everything else, as rectangles."""
    import shapely

    from sern_runtime.geodata import read_osm
    from sern_twin.world.primitives import primitives
    from sern_twin.world.tags import Kind

    read = read_osm(path)
    shapes = [each.geometry for each in read.features if each.geometry is not None]
    if not shapes:
        raise ConfigError("has nothing on it", file=str(path))
    west, south, east, north = shapely.total_bounds(np.array(shapes))
    middle = TangentPlane.from_degrees((south + north) / 2, (west + east) / 2, 0.0)
    latitude, longitude, _ = np.degrees(middle.to_geodetic(np.array([(*MAP_MIDDLE_M, 0.0)]))[0]).tolist()
    plane = TangentPlane.from_degrees(latitude, longitude, 0.0)
    taken = shapely.union_all(
        [
            shapely.box(-HALF_M, DITCH_Y_M - DITCH_HALF_M, HALF_M, DITCH_Y_M + DITCH_HALF_M).buffer(CLEAR_M),
            shapely.box(STREET_X_M - STREET_HALF_M, -10.0, STREET_X_M + STREET_HALF_M, 4.0).buffer(0.5),
            shapely.box(BRIDGE_X_M - CLEAR_M, -10.0, BRIDGE_X_M + CLEAR_M, 2.0),
            shapely.box(-10.0, -11.5, -4.0, -5.0),
            shapely.Point(START.x_m, START.y_m).buffer(CLEAR_M), shapely.Point(*GOAL_M).buffer(CLEAR_M),
        ]
    )  # fmt: skip
    inside = shapely.box(0.4 - HALF_M, 0.4 - HALF_M, HALF_M - 0.4, HALF_M - 0.4)
    found = []
    for thing in primitives(read.features, plane).found:
        if thing.kind is not Kind.BUILDING:
            continue
        area = shapely.oriented_envelope(thing.geometry)
        area = shapely.oriented_envelope(area.intersection(inside))
        if not area.is_empty and area.area >= LEAST_M2 and not area.intersects(taken):
            found.append(tuple((float(x_m), float(y_m)) for x_m, y_m in area.exterior.coords[:-1]))
    if not found:
        raise ConfigError("has no building near its middle", file=str(path))
    return tuple(found), plane


def _walls(ground: Terrain, corners: Corners) -> list[Block]:
    """A building as a box: `corners` are those of a rectangle, in order."""
    (ax, ay), (bx, by), (cx, cy), _ = corners
    along_m, wide_m = math.dist((ax, ay), (bx, by)), math.dist((bx, by), (cx, cy))
    x_m, y_m, yaw_rad = (ax + cx) / 2, (ay + cy) / 2, math.atan2(by - ay, bx - ax)
    return [Block(Label.OTHER, x_m, y_m, ground.height_m(x_m, y_m), (along_m / 2, wide_m / 2, WALL_M), yaw_rad)]
