"""PLY scans and the PointCloud2 bodies made of them."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sern_client.endpoints.clouds import CLOUD_TYPE, CloudSource, cloud_body, read_ply
from sern_core.summaries.voxel import thin_cloud
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_types

HEAD = "ply\nformat {kind} 1.0\ncomment made for a test\nelement vertex {count}\n"
XYZI = "property float x\nproperty double y\nproperty float z\nproperty uchar intensity\n"
FACES = "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
POINTS = np.array([[1.0, 2.0, 3.0, 7.0], [-1.5, 0.25, 8.0, 255.0]], dtype=np.float32)


def test_ascii(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    path.write_text(HEAD.format(kind="ascii", count=2) + XYZI + FACES + "1 2 3 7\n-1.5 0.25 8 255\n3 0 1 2\n")
    assert np.array_equal(read_ply(path), POINTS)


def test_binary(tmp_path: Path) -> None:
    rows = np.array([tuple(row) for row in POINTS], dtype=[("x", "<f4"), ("y", "<f8"), ("z", "<f4"), ("i", "u1")])
    path = tmp_path / "b.ply"
    path.write_bytes((HEAD.format(kind="binary_little_endian", count=2) + XYZI + FACES).encode() + rows.tobytes())
    assert np.array_equal(read_ply(path), POINTS)
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(ConfigError, match="ends before its 2 vertices"):
        read_ply(path)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("", "not a PLY"),
        ("solid stl\nend_header\n", "not a PLY"),
        ("ply\nformat binary_big_endian 1.0\nelement vertex 1\nend_header\n", "not supported"),
        ("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n", "no vertices"),
        ("ply\nformat ascii 1.0\nelement vertex 1\nproperty list uchar int x\nend_header\n1\n", "not supported"),
        (HEAD.format(kind="ascii", count=2) + XYZI + "end_header\n1 2 3 4\n", "damaged"),
        (HEAD.format(kind="ascii", count=1) + XYZI + "end_header\n1 2 three 4\n", "damaged"),
    ],
)
def test_files_that_are_none(content: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "x.ply"
    path.write_text(content)
    with pytest.raises(ConfigError, match=said) as caught:
        read_ply(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("encoding", [Encoding.ROS1, Encoding.CDR])
@pytest.mark.parametrize("columns", [3, 4])
def test_cloud_bodies(encoding: Encoding, columns: int) -> None:
    points = POINTS[:, :columns].copy()
    points[1, 0] = np.nan
    message = ros_types.deserialise(cloud_body(points, 3 * 10**9 + 5, "lidar", encoding), CLOUD_TYPE, encoding)
    assert (message.header.stamp.sec, message.header.stamp.nanosec, message.header.frame_id) == (3, 5, "lidar")
    assert (message.width, message.height, message.point_step, message.row_step) == (2, 1, 4 * columns, 8 * columns)
    assert [f.name for f in message.fields] == ["x", "y", "z", "intensity"][:columns]
    assert [f.offset for f in message.fields] == [0, 4, 8, 12][:columns]
    assert not message.is_dense
    assert np.array_equal(message.data.view("<f4").reshape(2, columns), points, equal_nan=True)


def test_real_scans(data: Callable[[str], Path]) -> None:
    source = CloudSource((data("lidar_scan_a.ply"), data("lidar_scan_b.ply")), Encoding.CDR)
    messages = [ros_types.deserialise(source.next_body(i), CLOUD_TYPE, Encoding.CDR) for i in range(3)]
    assert [message.width for message in messages] == [69792, 69088, 69792]
    points = messages[0].data.view("<f4").reshape(-1, messages[0].point_step // 4)
    assert np.isfinite(points).all() and 1.0 < float(np.abs(points[:, :2]).max()) < 500.0


@pytest.mark.parametrize("encoding", [Encoding.ROS1, Encoding.CDR])
def test_labels_go_as_whole_numbers_and_outlive_a_summary(encoding: Encoding) -> None:
    points = np.array([[0.0, 0.0, 0.0, 9.0, 1.0], [5.0, 0.0, 0.0, 8.0, 5.0], [np.nan] * 3 + [0.0, 0.0]], np.float32)
    body = cloud_body(points, 1, "velodyne", encoding)
    row = np.dtype([("xyzi", "<f4", 4), ("label", "<u2")])
    read = ros_types.deserialise(body, CLOUD_TYPE, encoding)
    rows = np.frombuffer(read.data.tobytes(), dtype=row)
    assert np.array_equal(rows["xyzi"], points[:, :4], equal_nan=True) and rows["label"].tolist() == [1, 5, 0]
    assert read.point_step == 18 and not read.is_dense
    thin = ros_types.deserialise(thin_cloud(body, encoding, 0.5), CLOUD_TYPE, encoding)
    assert sorted(np.frombuffer(thin.data.tobytes(), dtype=row)["label"].tolist()) == [1, 5]
