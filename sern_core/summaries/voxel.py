"""A thinner point cloud: one point for each occupied cube of a grid that is fixed to the cloud's frame.

The grid does not move with the cloud's bounds, so a standing robot sees the same voxels scan after scan.
"""

from enum import StrEnum
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sern_core.summaries.clouds import read_cloud, valid_rows, write_cloud
from sern_core.vocabulary.errors import UsageError
from sern_core.vocabulary.types import Encoding

_KEY_BITS: Final = 64


class VoxelPoint(StrEnum):
    CENTROID = "centroid"  # the mean of the voxel's points; the other fields are those of its first point
    FIRST = "first"  # the voxel's first point, unchanged


def _cells(xyz: NDArray[Any], voxel_m: float) -> NDArray[np.float64]:
    """(n, 3) index of the voxel of each point, as whole float64: exact up to 2^53."""
    return np.floor(np.asarray(xyz, np.float64) / voxel_m)


def _order(cells: NDArray[np.float64]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Points sorted by voxel and, within one, by index; and where in that order each voxel begins.

    Voxel and index are packed into one uint64 where they fit, because numpy sorts plain integers far faster than it
    sorts rows or keeps a sort stable.
    """
    count = len(cells)
    low = cells.min(axis=0)
    spans = (cells.max(axis=0) - low + 1).tolist()
    index_bits = max(count - 1, 1).bit_length()
    if spans[0] * spans[1] * spans[2] < 2.0 ** (_KEY_BITS - index_bits - 1):
        shifted = (cells - low).astype(np.uint64)
        ny, nz = np.uint64(spans[1]), np.uint64(spans[2])
        keys = (shifted[:, 0] * ny + shifted[:, 1]) * nz + shifted[:, 2]
        packed = (keys << np.uint64(index_bits)) | np.arange(count, dtype=np.uint64)
        packed.sort()
        order = (packed & np.uint64((1 << index_bits) - 1)).astype(np.intp)
        sorted_keys = packed >> np.uint64(index_bits)
        changed = sorted_keys[1:] != sorted_keys[:-1]
    else:
        order = np.lexsort((cells[:, 2], cells[:, 1], cells[:, 0]))
        ordered = cells[order]
        changed = (ordered[1:] != ordered[:-1]).any(axis=1)
    starts = np.concatenate((np.zeros(1, np.intp), np.flatnonzero(changed) + 1))
    return order, starts


def thin_rows(
    xyz: NDArray[np.float32] | NDArray[np.float64], voxel_m: float, *, centroid: bool = True
) -> tuple[NDArray[np.intp], NDArray[np.float64] | None]:
    """One point per occupied voxel of `voxel_m` metres: the index of the first point of each, and their centroids.

    `xyz` (n, 3) in metres; points that are not finite or beyond 1e9 m are left out. The indices (m,) ascend, so the
    order of the cloud is kept; centroids are (m, 3) in that order, None when not asked for. Deterministic.
    UsageError unless 0 < voxel_m is finite.
    """
    if not 0 < voxel_m < np.inf:
        raise UsageError(f"voxel_m must be a size in metres above 0, not {voxel_m}")
    valid = valid_rows(xyz)
    rows = np.flatnonzero(valid)
    if len(rows) < len(xyz):
        xyz = np.stack([xyz[rows, axis] for axis in range(3)]).T
    if not len(xyz):
        return rows, np.empty((0, 3)) if centroid else None
    order, starts = _order(_cells(xyz, voxel_m))
    first = order[starts]
    ascending = np.argsort(first)
    first = first[ascending]
    if not centroid:
        return rows[first], None
    counts = np.diff(starts, append=len(order))
    means = [np.add.reduceat(xyz[order, axis].astype(np.float64), starts) / counts for axis in range(3)]
    return rows[first], np.stack(means, axis=1)[ascending]


def thin_cloud(
    body: bytes,
    encoding: Encoding,
    voxel_m: float,
    *,
    point: VoxelPoint = VoxelPoint.CENTROID,
    fields: tuple[str, ...] | None = None,
) -> bytes:
    """A PointCloud2 body, thinned. Header and fields are kept (`fields`: only these beside x, y and z), padding inside
    points and invalid points are not; the result is unorganised (height 1) and dense. BodyError."""
    cloud = read_cloud(body, encoding)
    rows, centroids = thin_rows(cloud.xyz(), voxel_m, centroid=point is VoxelPoint.CENTROID)
    thin = cloud.take(rows, fields)
    if centroids is not None and len(rows):
        thin.put_xyz(centroids)
    return write_cloud(thin, encoding)
