"""Thinned clouds: by value, by property, against rosbags' reading, and on clouds that nobody should send."""

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from sern_client.endpoints.clouds import read_ply
from sern_core.summaries.clouds import read_cloud, write_cloud
from sern_core.summaries.voxel import VoxelPoint, thin_cloud, thin_rows
from sern_core.vocabulary.errors import BodyError, UsageError
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_types
from tests.daemons import recording
from tests.sern_core.summaries import scenes

PADDED = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "ring", "number", "normal"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<u2", "<u4", ("<f4", (3,))],
        "offsets": [0, 4, 8, 16, 20, 24, 28],
        "itemsize": 48,
    }
)
coordinates = arrays.arrays(
    np.float32, st.tuples(st.integers(0, 60), st.just(3)), elements=st.floats(-50, 50, width=32)
)


# --- by value -------------------------------------------------------------------------------------------------------


def test_one_point_a_voxel_and_their_means() -> None:
    xyz = np.array([[0.1, 0.1, 0.1], [5, 5, 5], [0.3, 0.2, 0.1], [-0.1, 0.1, 0.1], [5.2, 5, 5]], np.float32)
    rows, centroids = thin_rows(xyz, 1.0)
    assert rows.tolist() == [0, 1, 3]
    assert centroids is not None
    assert np.allclose(centroids, [[0.2, 0.15, 0.1], [5.1, 5, 5], [-0.1, 0.1, 0.1]])


def test_a_voxel_does_not_depend_on_the_other_points() -> None:
    wall = np.array([[2.01, 0.04, 0.5], [2.06, 0.06, 0.5], [2.19, 0.0, 0.5]], np.float32)
    far = np.array([[-31.33, 8.17, 2.2]], np.float32)
    _, alone = thin_rows(wall, 0.1)
    _, together = thin_rows(np.concatenate((far, wall)), 0.1)
    assert alone is not None and together is not None
    assert np.array_equal(together[1:], alone)


@pytest.mark.parametrize("size_m", [0.0, -1.0, float("nan"), float("inf")])
def test_a_size_that_is_none_is_refused(size_m: float) -> None:
    with pytest.raises(UsageError, match="voxel_m"):
        thin_rows(np.zeros((1, 3), np.float32), size_m)


# --- by property ----------------------------------------------------------------------------------------------------


@given(coordinates, st.sampled_from([0.05, 0.3, 1.0, 7.0]))
def test_every_point_has_a_neighbour_within_its_voxel(xyz: np.ndarray, voxel_m: float) -> None:
    rows, centroids = thin_rows(xyz, voxel_m)
    assert centroids is not None and len(rows) == len(centroids)
    assert (np.diff(rows) > 0).all()
    for kept in (xyz[rows].astype(np.float64), centroids):
        for point in xyz.astype(np.float64):
            assert np.abs(kept - point).max(axis=1).min() <= voxel_m * (1 + 1e-9)
    cells = {tuple(cell) for cell in np.floor(xyz.astype(np.float64) / voxel_m).tolist()}
    assert len(rows) == len(cells)


@given(coordinates)
def test_wide_and_narrow_clouds_are_thinned_alike(xyz: np.ndarray) -> None:
    """A far point makes the packed keys too long, and the slower sort must say the same."""
    far = np.array([[9e8, -9e8, 9e8]])
    rows, centroids = thin_rows(xyz, 0.01)
    wide_rows, wide_centroids = thin_rows(np.concatenate((xyz.astype(np.float64), far)), 0.01)
    assert np.array_equal(wide_rows[:-1], rows)
    assert centroids is not None and wide_centroids is not None
    assert np.allclose(wide_centroids[:-1], centroids, rtol=0, atol=1e-9)


# --- bodies, against rosbags ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("encoding", scenes.ENCODINGS)
@pytest.mark.parametrize("frame_id", ["", "v", "velodyne", "jackal1/os_sensor"])
def test_a_body_is_read_and_written_as_rosbags_does(encoding: Encoding, frame_id: str) -> None:
    points = scenes.structured(np.arange(12, dtype=np.float32).reshape(4, 3))
    body = scenes.cloud_body(points, encoding, frame_id=frame_id, height=2)
    cloud = read_cloud(body, encoding)
    assert (cloud.height, cloud.width, cloud.point_step) == (2, 2, 16)
    assert cloud.header.stamp_ns == scenes.STAMP_NS and cloud.header.frame_id == frame_id
    assert np.array_equal(cloud.column("number"), np.arange(4))
    assert write_cloud(cloud, encoding) == body


@pytest.mark.parametrize("encoding", scenes.ENCODINGS)
@pytest.mark.parametrize("point", list(VoxelPoint))
def test_a_thinned_body_keeps_header_and_fields(encoding: Encoding, point: VoxelPoint) -> None:
    xyz = np.array([[0.0, 0.0, 0.0], [4, 0, 0], [0.5, 0.5, 0.5], [4, 0, 0.5]], np.float32)
    points = scenes.structured(xyz, PADDED)
    points["ring"], points["intensity"] = [9, 8, 7, 6], [0.1, 0.2, 0.3, 0.4]
    points["normal"] = xyz
    body = scenes.cloud_body(points, encoding, height=2, row_padding=5)
    cloud = scenes.read(thin_cloud(body, encoding, 1.0, point=point), scenes.CLOUD, encoding)
    assert cloud.header == scenes.cloud_message(points, encoding).header
    assert (cloud.height, cloud.width, cloud.is_dense) == (1, 2, True)
    assert cloud.point_step == 4 * 4 + 2 + 4 + 12 and cloud.row_step == cloud.point_step * 2
    thin = scenes.records(cloud)
    assert thin.dtype.names == PADDED.names
    expected = points[:2].copy()
    if point is VoxelPoint.CENTROID:
        expected["x"], expected["y"], expected["z"] = [0.25, 4], [0.25, 0], [0.25, 0.25]
    for name in PADDED.names or ():
        assert np.array_equal(thin[name], expected[name]), name


@pytest.mark.parametrize("encoding", scenes.ENCODINGS)
def test_only_the_fields_that_are_asked_for_travel(encoding: Encoding) -> None:
    points = scenes.structured(np.eye(3, dtype=np.float32), PADDED)
    body = thin_cloud(scenes.cloud_body(points, encoding), encoding, 0.5, fields=("intensity",))
    cloud = scenes.read(body, scenes.CLOUD, encoding)
    assert [field.name for field in cloud.fields] == ["x", "y", "z", "intensity"] and cloud.point_step == 16


def test_fields_that_overlap_stay_where_they_are() -> None:
    """The fields that PCL writes: rgb as a float and as a number, at one place."""
    message = scenes.cloud_message(scenes.structured(np.eye(3, dtype=np.float32)), Encoding.ROS1)
    message.fields += [scenes.cloud_message(scenes.structured(np.zeros((0, 3))), Encoding.ROS1).fields[3]] * 2
    thin = scenes.read(
        thin_cloud(scenes.write(message, scenes.CLOUD, Encoding.ROS1), Encoding.ROS1, 0.5), scenes.CLOUD, Encoding.ROS1
    )
    assert thin.fields == message.fields and thin.point_step == 16
    assert np.array_equal(thin.data, message.data)


@pytest.mark.parametrize("encoding", scenes.ENCODINGS)
def test_big_endian_clouds_stay_big_endian(encoding: Encoding) -> None:
    points = scenes.structured(
        np.array([[1, 2, 3], [1.5, 2, 3]], np.float32),
        [("x", ">f4"), ("y", ">f4"), ("z", ">f4"), ("number", ">u4")],
    )
    body = scenes.cloud_body(points, encoding, bigendian=True)
    cloud = scenes.read(thin_cloud(body, encoding, 1.0), scenes.CLOUD, encoding)
    assert cloud.is_bigendian
    assert scenes.xyz_of(scenes.records(cloud)).tolist() == [[1.25, 2, 3]]


def test_a_big_endian_cdr_body_is_read() -> None:
    points = scenes.structured(np.array([[1, 2, 3]], np.float32))
    message = scenes.cloud_message(points, Encoding.CDR)
    store = ros_types.typestore(Encoding.CDR)
    body = bytes(store.serialize_cdr(message, scenes.CLOUD, little_endian=False))
    assert body[1] == 0
    thin = scenes.read(thin_cloud(body, Encoding.CDR, 1.0), scenes.CLOUD, Encoding.CDR)
    assert scenes.xyz_of(scenes.records(thin)).tolist() == [[1, 2, 3]]
    assert thin.header == message.header


@pytest.mark.parametrize("encoding", scenes.ENCODINGS)
def test_invalid_points_are_left_out(encoding: Encoding) -> None:
    xyz = np.array([[np.nan, 0, 0], [1, 1, 1], [0, np.inf, 0], [0, 0, -np.inf], [3e38, 0, 0], [2, 2, 2]], np.float32)
    thin = scenes.read(
        thin_cloud(scenes.cloud_body(scenes.structured(xyz), encoding), encoding, 0.1), scenes.CLOUD, encoding
    )
    assert scenes.records(thin)["number"].tolist() == [1, 5]


@pytest.mark.parametrize("encoding", scenes.ENCODINGS)
def test_float64_coordinates_far_from_the_origin_keep_their_precision(encoding: Encoding) -> None:
    xyz = np.array([[5_345_678.05, 432_100.05, 210.05], [5_345_678.07, 432_100.05, 210.05]])
    points = scenes.structured(xyz, [("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("number", "<u4")])
    thin = scenes.read(thin_cloud(scenes.cloud_body(points, encoding), encoding, 0.1), scenes.CLOUD, encoding)
    assert np.allclose(scenes.xyz_of(scenes.records(thin)), [[5_345_678.06, 432_100.05, 210.05]], rtol=0, atol=1e-6)


@pytest.mark.parametrize("encoding", scenes.ENCODINGS)
@pytest.mark.parametrize("shape", [(0, 0), (0, 5), (5, 0), (1, 0)])
def test_an_empty_cloud_stays_empty(encoding: Encoding, shape: tuple[int, int]) -> None:
    message = scenes.cloud_message(scenes.structured(np.empty((0, 3))), encoding)
    message.height, message.width = shape
    thin = scenes.read(thin_cloud(scenes.write(message, scenes.CLOUD, encoding), encoding, 1.0), scenes.CLOUD, encoding)
    assert (thin.height, thin.width, len(thin.data)) == (1, 0, 0)


# --- bodies that are wrong ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("encoding", scenes.ENCODINGS)
@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"width": 5}, "bytes of data for 1 x 5 points"),
        ({"width": 2**32 - 1, "height": 2**32 - 1}, "row_step"),
        ({"point_step": 0}, "point_step is 0"),
        ({"point_step": 8, "row_step": 16}, "beyond the point_step"),
        ({"height": 2, "row_step": 3}, "row_step 3 is less"),
        ({"fields": []}, "no field 'x'"),
    ],
)
def test_sizes_that_contradict_each_other_are_refused(
    encoding: Encoding, changes: dict[str, object], problem: str
) -> None:
    message = scenes.cloud_message(scenes.structured(np.zeros((2, 3), np.float32)), encoding)
    for name, value in changes.items():
        setattr(message, name, value)
    with pytest.raises(BodyError, match=problem):
        thin_cloud(scenes.write(message, scenes.CLOUD, encoding), encoding, 1.0)


@pytest.mark.parametrize(("datatype", "problem"), [(9, "does not define"), (5, "FLOAT32 or FLOAT64")])
def test_coordinates_of_another_kind_are_refused(datatype: int, problem: str) -> None:
    message = scenes.cloud_message(scenes.structured(np.zeros((2, 3), np.float32)), Encoding.CDR)
    message.fields[1].datatype = datatype
    with pytest.raises(BodyError, match=problem):
        thin_cloud(scenes.write(message, scenes.CLOUD, Encoding.CDR), Encoding.CDR, 1.0)


@pytest.mark.parametrize("encoding", scenes.ENCODINGS)
def test_every_shortened_body_is_refused(encoding: Encoding) -> None:
    body = scenes.cloud_body(scenes.structured(np.zeros((3, 3), np.float32)), encoding)
    for size in range(len(body)):
        with pytest.raises(BodyError):
            thin_cloud(body[:size], encoding, 1.0)
    with pytest.raises(BodyError, match="left over"):
        thin_cloud(body + bytes(8), encoding, 1.0)


@given(st.data(), st.sampled_from(scenes.ENCODINGS))
def test_a_changed_body_is_thinned_or_refused(data: st.DataObject, encoding: Encoding) -> None:
    body = bytearray(scenes.cloud_body(scenes.structured(np.ones((3, 3), np.float32)), encoding, height=3))
    for _ in range(data.draw(st.integers(1, 4))):
        body[data.draw(st.integers(0, len(body) - 1))] = data.draw(st.integers(0, 255))
    try:
        thin = thin_cloud(bytes(body), encoding, 0.1)
    except BodyError:
        return
    assert read_cloud(thin, encoding).width <= 3


def test_rows_of_one_point_may_be_padded() -> None:
    xyz = np.arange(9, dtype=np.float32).reshape(3, 3)
    cloud = read_cloud(scenes.cloud_body(scenes.structured(xyz), Encoding.CDR, height=3), Encoding.CDR)
    padded = np.zeros((3, cloud.point_step + 5), np.uint8)
    padded[:, : cloud.point_step] = cloud.points
    assert replace(cloud, points=padded[:, : cloud.point_step]).xyz().tolist() == xyz.tolist()


def test_a_cloud_that_was_never_filled_is_empty() -> None:
    for encoding in scenes.ENCODINGS:
        body = scenes.write(ros_types.new(scenes.CLOUD, encoding), scenes.CLOUD, encoding)
        assert read_cloud(thin_cloud(body, encoding, 1.0), encoding).width == 0


def test_a_raw_body_is_no_cloud() -> None:
    with pytest.raises(BodyError, match="raw"):
        thin_cloud(b"", Encoding.RAW, 1.0)
    with pytest.raises(BodyError, match="plain CDR"):
        thin_cloud(struct.pack("4B", 0, 3, 0, 0) + bytes(64), Encoding.CDR, 1.0)


# --- real scans -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["lidar_scan_a.ply", "lidar_scan_b.ply"])
def test_a_real_scan_keeps_its_shape(name: str) -> None:
    scan = read_ply(Path(recording(name)))
    points = scenes.structured(scan[:, :3])
    body = scenes.cloud_body(points, Encoding.CDR)
    thin = thin_cloud(body, Encoding.CDR, 0.2)
    assert len(thin) < 0.15 * len(body)
    kept = scenes.xyz_of(scenes.records(scenes.read(thin, scenes.CLOUD, Encoding.CDR)))
    cells = np.unique(np.floor(scan[:, :3].astype(np.float64) / 0.2), axis=0)
    assert len(kept) == len(cells)
    # A mean lies in the voxel of its points, and a float32 of it within rounding of that.
    assert np.abs(np.sort(np.floor(kept / 0.2).view("f8,f8,f8").ravel()).view("f8").reshape(-1, 3) - cells).max() <= 1
    lost = [np.abs(kept - point).max(axis=1).min() for point in scan[::500, :3].astype(np.float64)]
    assert max(lost) <= 0.2
