"""Labelled scans of the stand-in: worlds with things scattered in them, and a scanner that is set down here and there.

The scanner is one of two. `SOURCE` is the stand-in's own. `SHIFTED` is what a robot may carry in its place: other
rings, mounted higher and askew, noisier, with points missing, and an intensity that depends on what is hit and how.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from random import Random
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sern_perception.projection import ImageShape, project
from sern_perception.training.shapes import Shape, drawn
from sern_sim.mujoco_jackal import MujocoJackal
from sern_sim.robot import LIDAR_HEIGHT_M, LIDAR_RANGE_M, Pose2
from sern_sim.terrain import Block, Label, Terrain

FREE_M: Final = 0.7
"""A scanner is set down no nearer to anything."""
REFLECTS: Final = {Label.GROUND: 0.25, Label.CAR: 0.8, Label.BRIDGE: 0.5, Label.LOG: 0.35, Label.OTHER: 0.6}
INTENSITY_NOISE_PERCENT: Final = 3.0
FIRST_THING: Final = 100
APART_M: Final = 2.5
"""Things of other shapes stand no nearer to each other."""
ABOVE_M: Final = 4.0
"""Ground is looked for from so high."""
Floats = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Sensor:
    """`low_rad`, `high_rad`: its lowest and highest ring. `lost`: the share of points that are missing near it, and at
    its range. `reflects`: whether its intensity depends on what is hit and at which angle, or on the range alone."""

    low_rad: float
    high_rad: float
    height_m: float
    pitch_rad: float
    noise_m: float
    lost: tuple[float, float]
    reflects: bool
    rows: int = 16
    columns: int = 900

    @property
    def shape(self) -> ImageShape:
        return ImageShape(self.rows, self.columns, self.low_rad, self.high_rad)


SOURCE: Final = Sensor(math.radians(-15), math.radians(15), LIDAR_HEIGHT_M, 0.0, 0.01, (0.0, 0.0), False)
SHIFTED: Final = Sensor(math.radians(-22), math.radians(6), 0.75, math.radians(2), 0.03, (0.05, 0.4), True)


class Scans(NamedTuple):
    """`channels`: (n, 5, rows, columns) of `RangeImage`s; `labels`: (n, rows, columns) of `PointClass`."""

    channels: Floats
    labels: NDArray[np.uint8]


def scattered(random: Random, *, things: int = 14) -> Terrain:
    """Hills with a ditch, a bridge, a car and logs, as the stand-in has them, and as many things more: cars, logs and
    crates of all sizes."""
    hills = Terrain.hills(random)
    blocks = list(hills.blocks)
    reach_m = hills.half_size_m - 2.0
    for _ in range(things):
        x_m, y_m = random.uniform(-reach_m, reach_m), random.uniform(-reach_m, reach_m)
        if math.hypot(x_m, y_m) < 1.5:
            continue
        z_m, yaw_rad = hills.height_m(x_m, y_m), random.uniform(-math.pi, math.pi)
        kind = random.random()
        if kind < 0.2:
            blocks += [
                Block(Label.CAR, x_m, y_m, z_m + 0.55, (2.1, 0.85, 0.40), yaw_rad),
                Block(Label.CAR, x_m, y_m, z_m + 1.2, (1.1, 0.75, 0.27), yaw_rad),
            ]
        elif kind < 0.6:
            radius_m = random.uniform(0.10, 0.22)
            half_m = (random.uniform(0.5, 1.5), 0.0, 0.0)
            blocks.append(Block(Label.LOG, x_m, y_m, z_m + 0.8 * radius_m, half_m, yaw_rad, radius_m))
        else:
            sides_m = (random.uniform(0.1, 0.8), random.uniform(0.1, 0.8), random.uniform(0.15, 0.9))
            blocks.append(Block(Label.OTHER, x_m, y_m, z_m + sides_m[2] * 0.9, sides_m, yaw_rad))
    return Terrain(hills.heights_m, tuple(blocks), hills.half_size_m)


def places(random: Random, world: Terrain, count: int) -> list[Pose2]:
    """Places of a world where nothing is near. ValueError: there is next to none."""
    cells = 200
    cell_m = 2 * world.half_size_m / cells
    taken = world.occupancy(cells) > 0
    margin = math.ceil(FREE_M / cell_m)
    found: list[Pose2] = []
    for _ in range(100 * count):
        row, column = random.randrange(margin, cells - margin), random.randrange(margin, cells - margin)
        near = taken[row - margin : row + margin + 1, column - margin : column + margin + 1]
        if near.any():
            continue
        x_m, y_m = ((index + 0.5) * cell_m - world.half_size_m for index in (column, row))
        found.append(Pose2(x_m, y_m, random.uniform(-math.pi, math.pi)))
        if len(found) == count:
            return found
    raise ValueError(f"a world in which {len(found)} of {count} places are free")


def cloud(jackal: MujocoJackal, sensor: Sensor, noise: np.random.Generator, things: Sequence[Shape] = ()) -> Floats:
    """(rows * columns, 5): x, y, z in the sensor's frame [m], intensity [%] and label; NaN where no return came. The
    first of `things` has the label `FIRST_THING`, and so on."""
    elevations = np.linspace(sensor.high_rad, sensor.low_rad, sensor.rows)[:, None]
    bearings = math.pi - np.arange(sensor.columns) / sensor.columns * math.tau
    rays = np.empty((sensor.rows, sensor.columns, 3))
    rays[..., 0] = np.cos(elevations) * np.cos(bearings)
    rays[..., 1] = np.cos(elevations) * np.sin(bearings)
    rays[..., 2] = np.sin(elevations)
    cos, sin = math.cos(sensor.pitch_rad), math.sin(sensor.pitch_rad)
    pitched = rays.reshape(-1, 3) @ np.array([(cos, 0.0, -sin), (0.0, 1.0, 0.0), (sin, 0.0, cos)])
    at_m = (0.0, 0.0, sensor.height_m)
    ranges_m, labels = jackal.cast(at_m, pitched)
    for number, thing in enumerate(things):
        met_m = thing.meets(np.array(at_m), pitched)
        labels = np.where(met_m < ranges_m, FIRST_THING + number, labels).astype(np.uint16)
        ranges_m = np.minimum(ranges_m, met_m)
    there = ranges_m <= LIDAR_RANGE_M
    near, far = sensor.lost
    there &= noise.random(len(ranges_m)) >= near + (far - near) * np.minimum(ranges_m / LIDAR_RANGE_M, 1.0) ** 2
    measured_m = np.where(there, ranges_m + noise.normal(0.0, sensor.noise_m, len(ranges_m)), np.nan)
    found = np.empty((len(ranges_m), 5), np.float32)
    found[:, :3] = rays.reshape(-1, 3) * measured_m[:, None]
    found[:, 3] = _intensity(sensor, found[:, :3], np.minimum(labels, Label.OTHER), noise)
    found[:, 4] = np.where(there, labels, Label.NOTHING)
    return found


def things_around(
    jackal: MujocoJackal, random: Random, count: int, *, near_m: float = 1.2, far_m: float = 6.0
) -> list[Shape]:
    """Shapes that no training scan has, around a robot, on the ground and in sight; fewer where it is crowded."""
    found: list[Shape] = []
    for _ in range(20 * count):
        bearing_rad, away_m = random.uniform(-math.pi, math.pi), random.uniform(near_m, far_m)
        x_m, y_m = away_m * math.cos(bearing_rad), away_m * math.sin(bearing_rad)
        if any(math.hypot(x_m - each.middle_m[0], y_m - each.middle_m[1]) < APART_M for each in found):
            continue
        around = [(x_m + right, y_m + up) for right in (-0.7, 0.0, 0.7) for up in (-0.7, 0.0, 0.7)]
        below = [jackal.cast((*place, ABOVE_M), np.array([(0.0, 0.0, -1.0)])) for place in around]
        if all(labels[0] == Label.GROUND for _, labels in below):
            ground_m = ABOVE_M - float(below[len(below) // 2][0][0])
            found.append(drawn(random, x_m, y_m, ground_m))
            if len(found) == count:
                break
    return found


def _intensity(
    sensor: Sensor, points_m: Floats, labels: NDArray[np.uint16], noise: np.random.Generator
) -> NDArray[np.float64]:
    ranges_m = np.linalg.norm(points_m, axis=1)
    if not sensor.reflects:
        plain: NDArray[np.float64] = np.nan_to_num(100.0 / (1.0 + ranges_m))
        return plain
    reflects = np.zeros(int(max(Label)) + 1)
    for label, share in REFLECTS.items():
        reflects[label] = share
    image = points_m.reshape(sensor.rows, sensor.columns, 3)
    across, up = np.roll(image, -1, axis=1) - image, np.roll(image, -1, axis=0) - image
    normals = np.cross(across, up).reshape(-1, 3)
    facing = np.abs((normals * points_m).sum(axis=1)) / (np.linalg.norm(normals, axis=1) * ranges_m + 1e-9)
    said = 100.0 * reflects[labels] * (0.2 + 0.8 * np.nan_to_num(facing, nan=0.5)) * np.exp(-ranges_m / 40.0)
    noisy = said + noise.normal(0.0, INTENSITY_NOISE_PERCENT, len(said))
    found: NDArray[np.float64] = np.nan_to_num(np.clip(noisy, 0.0, 100.0))
    return found


def make(seed: int, count: int, sensor: Sensor, *, each_world: int = 8) -> Scans:
    """Makes `count` scans, `each_world` of them in one world; the same seed gives the same."""
    random = Random(seed)
    noise = np.random.default_rng(seed)
    shape = (sensor.rows, sensor.columns)
    channels, labels = np.empty((count, 5, *shape), np.float32), np.empty((count, *shape), np.uint8)
    number = 0
    while number < count:
        world = scattered(random)
        jackal = MujocoJackal(random, world=world)
        for place in places(random, world, min(each_world, count - number)):
            jackal.stand(place)
            said = cloud(jackal, sensor, noise)
            image = project(said[:, :4], sensor.shape)
            channels[number] = image.channels
            labels[number] = np.where(image.seen, said[image.points, 4], 0)
            number += 1
    return Scans(channels, labels)
