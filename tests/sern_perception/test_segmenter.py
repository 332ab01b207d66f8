"""The classes of a cloud by the network that comes with SERN."""

from pathlib import Path
from random import Random

import numpy as np
import pytest

from sern_core.vocabulary.errors import ConfigError
from sern_perception.classes import CLASSES, PointClass
from sern_perception.projection import HDL64, VLP16, project
from sern_perception.segmenter import WEIGHTS, Segmenter

pytest.importorskip("onnxruntime", reason="needs onnxruntime: pip install 'sern[seg]'")


def test_the_network_knows_the_clouds_that_the_stand_in_publishes() -> None:
    """Worlds that it was not trained on, through the same door as a robot's clouds: intensity in its unit, and rays
    where it has them."""
    pytest.importorskip("mujoco", reason="needs mujoco: pip install 'sern[sim]'")
    from sern_perception.training.scans import places, scattered
    from sern_sim.mujoco_jackal import MujocoJackal

    segmenter, random = Segmenter(), Random(777)
    met, either = np.zeros(len(CLASSES)), np.zeros(len(CLASSES))
    for _ in range(2):
        jackal = MujocoJackal(random, world=scattered(random))
        for place in places(random, jackal.world, 3):
            jackal.stand(place)
            cloud = jackal.cloud(VLP16.rows * VLP16.columns)
            image = project(cloud)
            assert image.unused["hidden"] == 0, "each ray has a pixel of its own"
            labels = np.where(image.seen, cloud[image.points, 4], 0)
            said = segmenter.segment(image)
            assert not said.classes[labels == 0].any() and not said.sure[labels == 0].any()
            assert (said.sure[labels > 0] > 1 / len(CLASSES)).all()
            for number in range(1, len(CLASSES)):
                met[number] += np.count_nonzero((labels == number) & (said.classes == number))
                either[number] += np.count_nonzero((labels == number) | (said.classes == number))
    for known, least in (
        (PointClass.GROUND, 0.9),
        (PointClass.OTHER, 0.85),
        (PointClass.CAR, 0.6),
        (PointClass.LOG, 0.4),
    ):
        assert met[known] / either[known] > least, known.name


def test_images_of_any_scanner_are_taken_and_one_of_nothing_is_of_nothing() -> None:
    segmenter, random = Segmenter(), Random(2)
    cloud = np.array([[random.uniform(-9, 9), random.uniform(-9, 9), random.uniform(-1, 1), 0.2] for _ in range(500)])
    for shape in (VLP16, HDL64):
        image = project(cloud, shape)
        said = segmenter.segment(image)
        assert said.classes.shape == image.points.shape and said.classes.max() < len(CLASSES)
    assert not segmenter.segment(project(np.zeros((0, 4)))).classes.any()


def test_the_model_is_small() -> None:
    assert WEIGHTS.stat().st_size < 5_000_000


def test_what_is_no_model_of_clouds_is_one_line(tmp_path: Path) -> None:
    nowhere, nonsense, cut = tmp_path / "none.onnx", tmp_path / "nonsense.onnx", tmp_path / "cut.onnx"
    nonsense.write_bytes(b"no model at all")
    cut.write_bytes(WEIGHTS.read_bytes()[:5000])
    for path, said in (
        (nowhere, "no such file"),
        (nonsense, "nonsense.onnx is no model that onnxruntime can run"),
        (cut, "cut.onnx is no model that onnxruntime can run"),
    ):
        with pytest.raises(ConfigError, match=said) as raised:
            Segmenter(path)
        assert "\n" not in str(raised.value)


def test_a_model_of_other_classes_is_refused_by_name(tmp_path: Path) -> None:
    other = tmp_path / "other.onnx"
    model = WEIGHTS.read_bytes()
    assert model.count(b"nothing,ground") == 1
    other.write_bytes(model.replace(b"nothing,ground", b"nothing,flower"))
    with pytest.raises(ConfigError, match="has the classes nothing,flower,car,bridge,log,other: those here"):
        Segmenter(other)
