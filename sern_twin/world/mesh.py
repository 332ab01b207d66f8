"""Triangles for a viewer, in metres east, north and up; counter-clockwise as seen from outside."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """`vertices` is (n, 3) [m], `faces` (m, 3) of their numbers."""

    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]


def no_mesh() -> Mesh:
    return Mesh(np.empty((0, 3), np.float32), np.empty((0, 3), np.int32))


def joined(meshes: Iterable[Mesh]) -> Mesh:
    """One mesh of many."""
    parts = [no_mesh(), *meshes]
    starts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    faces = [part.faces + np.int32(start) for part, start in zip(parts, starts, strict=True)]
    return Mesh(np.concatenate([part.vertices for part in parts]), np.concatenate(faces))
