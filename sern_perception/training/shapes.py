"""Things of shapes that no training scan has, put into scans: posts, barrels, balls, planks, and boxes of other sizes.

Rays meet them by formula, so that the stand-in's worlds need not know them.
"""

import math
from dataclasses import dataclass
from random import Random
from typing import Final

import numpy as np
from numpy.typing import NDArray

KINDS: Final = ("post", "barrel", "ball", "plank", "slab", "tower")
Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Shape:
    """`middle_m`: x, y, z in the robot's axes. `half_m`: half the sizes along its own axes, turned about z by
    `yaw_rad`; of what is round, the first is the radius."""

    kind: str
    middle_m: tuple[float, float, float]
    half_m: tuple[float, float, float]
    yaw_rad: float = 0.0

    def meets(self, at_m: Floats, rays: Floats) -> Floats:
        """Ranges [m] at which unit rays (n, 3) from a place meet it, (n,); infinite where they do not."""
        start = self._own(at_m - np.array(self.middle_m))
        along = self._own(rays)
        if self.kind == "ball":
            return _first(*_round(start, along, self.half_m[0], axes=3))
        if self.kind in ("post", "barrel"):
            sides = _round(start, along, self.half_m[0], axes=2)
            ends = _between(start[2:], along[:, 2:], np.array(self.half_m[2:]))
            return _first(np.maximum(sides[0], ends[0]), np.minimum(sides[1], ends[1]))
        return _first(*_between(start, along, np.array(self.half_m)))

    def _own(self, vectors: Floats) -> Floats:
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        turned: Floats = vectors @ np.array([(cos, -sin, 0.0), (sin, cos, 0.0), (0.0, 0.0, 1.0)])
        return turned


def drawn(random: Random, x_m: float, y_m: float, ground_m: float) -> Shape:
    """One that stands or lies on the ground there. Logs in training are round and lie; crates there are 0.2 to 1.6 m
    wide and 0.29 to 1.7 m high."""
    kind = random.choice(KINDS)
    if kind == "post":
        radius_m = random.uniform(0.04, 0.08)
        half_m = (radius_m, radius_m, random.uniform(0.4, 0.8))
    elif kind == "barrel":
        radius_m = random.uniform(0.25, 0.35)
        half_m = (radius_m, radius_m, random.uniform(0.3, 0.5))
    elif kind == "ball":
        radius_m = random.uniform(0.12, 0.3)
        half_m = (radius_m, radius_m, radius_m)
    elif kind == "plank":
        half_m = (random.uniform(0.8, 1.5), random.uniform(0.03, 0.06), random.uniform(0.07, 0.11))
    elif kind == "slab":
        half_m = (random.uniform(0.9, 1.4), random.uniform(0.3, 0.8), random.uniform(0.07, 0.11))
    else:
        half_m = (random.uniform(0.05, 0.09), random.uniform(0.05, 0.09), random.uniform(1.0, 1.4))
    return Shape(kind, (x_m, y_m, ground_m + half_m[2]), half_m, random.uniform(-math.pi, math.pi))


def _between(start: Floats, along: Floats, half_m: Floats) -> tuple[Floats, Floats]:
    """Ranges at which rays enter and leave what is between two planes for each axis."""
    with np.errstate(divide="ignore", invalid="ignore"):
        one, other = (-half_m - start) / along, (half_m - start) / along
    return np.fmin(one, other).max(axis=1), np.fmax(one, other).min(axis=1)


def _round(start: Floats, along: Floats, radius_m: float, *, axes: int) -> tuple[Floats, Floats]:
    """Ranges at which rays enter and leave a ball (3 axes), or an upright cylinder without ends (2)."""
    start, along = start[:axes], along[:, :axes]
    square = (along**2).sum(axis=1)
    towards = along @ start
    root = towards**2 - square * (float(start @ start) - radius_m**2)
    with np.errstate(divide="ignore", invalid="ignore"):
        apart = np.sqrt(root)
        enters, leaves = (-towards - apart) / square, (-towards + apart) / square
    upright = square < 1e-12  # such a ray is inside all along, or never
    inside = upright & bool(start @ start <= radius_m**2)
    met = (root > 0) & ~upright
    return (
        np.where(inside, -np.inf, np.where(met, enters, np.inf)),
        np.where(inside, np.inf, np.where(met, leaves, -np.inf)),
    )


def _first(enters: Floats, leaves: Floats) -> Floats:
    found: Floats = np.where((enters <= leaves) & (enters > 0), enters, np.inf)
    return found
