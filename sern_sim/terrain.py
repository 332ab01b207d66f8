"""Ground with hills, a ditch and what stands on it: what a robot drives on, and looks at, in place of the flat yard.

Frame: x east, y north, z up, metres; the origin in the middle. Pure: the same `Random` gives the same terrain.
"""

import math
from dataclasses import dataclass
from enum import IntEnum
from random import Random
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sern_sim.world import Floats

HALF_SIZE_M: Final = 20.0
CELLS: Final = 201
FREE_RADIUS_M: Final = 5.0
"""Nothing stands nearer to the origin."""
DITCH_X_M: Final = -9.0
DITCH_HALF_WIDTH_M: Final = 0.9
DITCH_DEPTH_M: Final = 0.8
BRIDGE_WIDTH_M: Final = 1.0
_HILLS: Final = 24
_MOST_CELLS: Final = 1001
_STEEPEST: Final = 2.0  # rise over run of heights that are handed in


class Label(IntEnum):
    """What a ray of the scanner met. 0 is of rays that met nothing."""

    NOTHING = 0
    GROUND = 1
    CAR = 2
    BRIDGE = 3
    LOG = 4
    OTHER = 5


@dataclass(frozen=True, slots=True)
class Block:
    """A box, or with `radius_m` a lying log: half the sizes along its own axes, turned about z by `yaw_rad`."""

    label: Label
    x_m: float
    y_m: float
    z_m: float
    half_m: tuple[float, float, float]
    yaw_rad: float = 0.0
    radius_m: float | None = None


class Terrain:
    """`heights_m` (n, n), row 0 at the south edge, column 0 at the west; `blocks` stand on it."""

    def __init__(self, heights_m: Floats, blocks: tuple[Block, ...] = (), half_size_m: float = HALF_SIZE_M) -> None:
        """ValueError: not square, fewer than 2 or more than 1001 a side, not finite, or steeper than 2 in 1."""
        heights_m = np.array(heights_m, dtype=np.float64)
        if heights_m.ndim != 2 or len(set(heights_m.shape)) != 1 or not 2 <= len(heights_m) <= _MOST_CELLS:
            raise ValueError(f"heights of a terrain are (n, n) with n from 2 to {_MOST_CELLS}, not {heights_m.shape}")
        if not np.all(np.isfinite(heights_m)):
            raise ValueError("heights of a terrain must be finite")
        if not (math.isfinite(half_size_m) and half_size_m > FREE_RADIUS_M):
            raise ValueError(f"a terrain reaches more than {FREE_RADIUS_M} m from its middle, not {half_size_m} m")
        step_m = 2 * half_size_m / (len(heights_m) - 1)
        steepest = max(float(np.abs(np.diff(heights_m, axis=axis)).max()) for axis in (0, 1)) / step_m
        if steepest > _STEEPEST:
            raise ValueError(f"a terrain must not be steeper than {_STEEPEST:g} in 1, and this one is {steepest:.3g}")
        self.heights_m = heights_m
        self.blocks = blocks
        self.half_size_m = half_size_m

    @classmethod
    def hills(cls, random: Random) -> "Terrain":
        """Smooth hills of up to about 10 degrees, a ditch with a bridge in the west, a car in the east, three logs in
        the north, and a low wall all round."""
        axis = np.linspace(-HALF_SIZE_M, HALF_SIZE_M, CELLS)
        x, y = np.meshgrid(axis, axis)
        heights = np.zeros((CELLS, CELLS))
        for _ in range(_HILLS):
            at_x, at_y = random.uniform(-HALF_SIZE_M, HALF_SIZE_M), random.uniform(-HALF_SIZE_M, HALF_SIZE_M)
            wide_m = random.uniform(2.5, 5.0)
            high_m = random.uniform(-0.12, 0.12) * wide_m
            heights += high_m * np.exp(-((x - at_x) ** 2 + (y - at_y) ** 2) / (2 * wide_m**2))
        # In the middle, where a robot drives its rounds, the hills are half as steep: it slides on steep ones.
        calm = np.clip((np.hypot(x, y) - 3.0) / 5.0, 0.0, 1.0)
        heights *= 0.5 + 0.5 * calm * calm * (3 - 2 * calm)
        # Beside the ditch the ground is level, so that the bridge lies on both its edges.
        level = np.clip((np.abs(x - DITCH_X_M) - 2.0) / 2.0, 0.0, 1.0)
        heights *= level * level * (3 - 2 * level)
        across = np.clip((DITCH_HALF_WIDTH_M - np.abs(x - DITCH_X_M)) / 0.5, 0.0, 1.0)
        heights -= DITCH_DEPTH_M * across
        ground = cls(heights)
        return cls(heights, (*_walls(), *ground.furniture(random)))

    @classmethod
    def of_heights(cls, heights_m: Floats, random: Random, half_size_m: float = HALF_SIZE_M) -> "Terrain":
        """Heights that are handed in, with wall, car and logs on them; no ditch, so no bridge. ValueError as above."""
        ground = cls(heights_m, half_size_m=half_size_m)
        blocks = [block for block in ground.furniture(random) if block.label is not Label.BRIDGE]
        return cls(heights_m, (*_walls(half_size_m), *blocks), half_size_m)

    def furniture(self, random: Random) -> tuple[Block, ...]:
        """A car, a bridge and three logs, at the height of the ground where they stand."""
        car_yaw, cos, sin = (yaw := random.uniform(-0.6, 0.6)), math.cos(yaw), math.sin(yaw)
        car_x, car_y = random.uniform(7.5, 8.5), random.uniform(-1.5, 1.5)
        car_z = self.height_m(car_x, car_y)
        blocks = [
            Block(Label.CAR, car_x, car_y, car_z + 0.55, (2.1, 0.85, 0.40), car_yaw),
            Block(Label.CAR, car_x - 0.2 * cos, car_y - 0.2 * sin, car_z + 1.2, (1.1, 0.75, 0.27), car_yaw),
            Block(Label.BRIDGE, DITCH_X_M, 0.0, 0.01, (DITCH_HALF_WIDTH_M + 0.6, BRIDGE_WIDTH_M / 2, 0.03)),
        ]
        for number in range(3):
            x_m, y_m = -3.0 + 3.0 * number + random.uniform(-0.5, 0.5), random.uniform(6.5, 8.5)
            radius_m = random.uniform(0.10, 0.16)
            z_m = self.height_m(x_m, y_m) + 0.8 * radius_m
            yaw = random.uniform(-0.4, 0.4)
            blocks.append(Block(Label.LOG, x_m, y_m, z_m, (random.uniform(0.7, 1.1), 0.0, 0.0), yaw, radius_m))
        return tuple(blocks)

    def height_m(self, x_m: float, y_m: float) -> float:
        """The ground's height at a place, bilinear; outside, that of the edge."""
        last = len(self.heights_m) - 1
        column = min(max((x_m + self.half_size_m) / (2 * self.half_size_m), 0.0), 1.0) * last
        row = min(max((y_m + self.half_size_m) / (2 * self.half_size_m), 0.0), 1.0) * last
        i, j = min(int(row), last - 1), min(int(column), last - 1)
        (a, b), (c, d) = self.heights_m[i : i + 2, j : j + 2]
        up, right = row - i, column - j
        return float((a * (1 - right) + b * right) * (1 - up) + (c * (1 - right) + d * right) * up)

    def occupancy(self, cells: int) -> NDArray[np.int8]:
        """(cells, cells) grid over the whole terrain, row 0 at the south: 100 occupied or too deep, 0 free."""
        axis = (np.arange(cells) + 0.5) / cells * 2 * self.half_size_m - self.half_size_m
        x, y = np.meshgrid(axis, axis)
        half_cell_m = self.half_size_m / cells
        last = len(self.heights_m) - 1
        near = np.clip(np.rint((axis + self.half_size_m) / (2 * self.half_size_m) * last), 0, last).astype(int)
        steep = np.hypot(*np.gradient(self.heights_m, 2 * self.half_size_m / last)) > 0.5
        grid = np.where(steep[np.ix_(near, near)], 100, 0).astype(np.int8)
        # The bridge comes last: it makes free what is too steep below it.
        for block in sorted(self.blocks, key=lambda block: block.label is Label.BRIDGE):
            cos, sin = math.cos(block.yaw_rad), math.sin(block.yaw_rad)
            along, left = cos * (x - block.x_m) + sin * (y - block.y_m), cos * (y - block.y_m) - sin * (x - block.x_m)
            wide_m = block.half_m[1] if block.radius_m is None else block.radius_m
            inside = (np.abs(along) <= block.half_m[0] + half_cell_m) & (np.abs(left) <= wide_m + half_cell_m)
            grid[inside] = 0 if block.label is Label.BRIDGE else 100
        return grid


def _walls(half_size_m: float = HALF_SIZE_M) -> tuple[Block, ...]:
    """All round, and deep enough for any ground: nothing falls off the edge."""
    at_m = half_size_m - 0.2
    return (
        Block(Label.OTHER, at_m, 0.0, 0.0, (0.1, half_size_m, 3.0)),
        Block(Label.OTHER, -at_m, 0.0, 0.0, (0.1, half_size_m, 3.0)),
        Block(Label.OTHER, 0.0, at_m, 0.0, (half_size_m, 0.1, 3.0)),
        Block(Label.OTHER, 0.0, -at_m, 0.0, (half_size_m, 0.1, 3.0)),
    )
