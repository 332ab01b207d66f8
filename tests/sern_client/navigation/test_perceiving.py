"""Classes and boxes of a cloud, as messages."""

from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest

from sern_client.endpoints.clouds import CLOUD_TYPE, cloud_body
from sern_core.summaries.clouds import read_cloud
from sern_core.vocabulary.errors import BodyError, ConfigError
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_types
from sern_sim.robot import SimulatedJackal
from sern_sim.world import World
from tests.sern_client.navigation import bodies

pytest.importorskip("onnxruntime", reason="needs onnxruntime: pip install 'sern[seg]'")
from sern_client.navigation.perceiving import MARKERS, Perception, PerceptionOptions

CDR = Encoding.CDR


def perception(options: PerceptionOptions | None = None) -> Perception:
    return Perception(options or PerceptionOptions(), CDR, lambda *_message: None)


def test_a_cloud_becomes_points_with_classes_and_boxes_of_what_stands_there() -> None:
    walls = np.array(
        [(2.0, -0.5, 2.0, 0.5, 0.6), (-4, -4, 4, -4, 2), (4, -4, 4, 4, 2), (4, 4, -4, 4, 2), (-4, 4, -4, -4, 2)]
    )
    robot = SimulatedJackal(Random(1), world=World(walls, np.zeros((0, 4)), 5.0))
    body = cloud_body(robot.cloud(14_400), 7, "velodyne", CDR, 1)
    (labels_name, labels_type, labels, stamp_ns), (boxes_name, boxes_type, boxes, _) = perception().look(body, CDR)
    assert (labels_name, labels_type, stamp_ns) == ("/perception/points", CLOUD_TYPE, 7)
    assert (boxes_name, boxes_type) == ("/perception/obstacles", MARKERS)
    cloud = read_cloud(labels, CDR)
    classes = cloud.column("label")
    assert cloud.header.frame_id == "velodyne" and len(classes) == 14_400
    assert 0.2 < np.mean(classes == 1) < 0.95, "ground is most of what is near"
    message: Any = ros_types.deserialise(boxes, MARKERS, CDR)
    assert message.markers[0].action == 3, "those of the cloud before go"
    places = [(each.pose.position.x, each.pose.position.y) for each in message.markers[1:]]
    assert any(abs(x - 2.0) < 0.2 and abs(y) < 0.3 for x, y in places), places
    assert all(each.text in ("car", "log", "other", "unknown") for each in message.markers[1:])


def test_a_cloud_without_intensity_will_do_and_one_without_points_has_no_boxes() -> None:
    robot = SimulatedJackal(Random(1))
    points = cloud_body(robot.cloud(5_760)[:, :3], 7, "velodyne", CDR, 1)
    assert len(perception().look(points, CDR)) == 2
    message: Any = ros_types.deserialise(perception().look(bodies.no_points(7), CDR)[1][2], MARKERS, CDR)
    assert len(message.markers) == 1


def test_what_is_no_cloud_is_a_line() -> None:
    with pytest.raises(BodyError):
        perception().look(b"\0\1\0\0x", CDR)


def test_a_model_that_is_none_is_a_line(tmp_path: Path) -> None:
    wrong = tmp_path / "wrong.onnx"
    wrong.write_bytes(b"no model")
    with pytest.raises(ConfigError, match=r"wrong\.onnx is no model"):
        perception(PerceptionOptions(model=wrong))
