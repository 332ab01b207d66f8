"""Rotations by quaternions x, y, z, w, written out: what the product says is checked against it."""

import numpy as np

from sern_twin.geodesy import Floats


def random_attitudes(random: np.random.Generator, number: int) -> Floats:
    """Unit quaternions, (number, 4)."""
    found = random.normal(size=(number, 4))
    unit: Floats = found / np.linalg.norm(found, axis=-1, keepdims=True)
    return unit


def turned(attitudes: Floats, points: Floats) -> Floats:
    """Points (n, 3) turned by attitudes (n, 4): p + 2 w (v × p) + 2 v × (v × p)."""
    axis, real = attitudes[:, :3], attitudes[:, 3:]
    once = np.cross(axis, points)
    moved: Floats = points + 2 * real * once + 2 * np.cross(axis, once)
    return moved
