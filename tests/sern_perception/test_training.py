"""What training and adaptation are made of; none of it is trained for long here."""

import copy

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs torch: pip install 'sern[train]'")
pytest.importorskip("onnx", reason="needs onnx: pip install 'sern[train]'")

import torch

from sern_perception.classes import CLASSES, PointClass
from sern_perception.projection import CHANNELS
from sern_perception.training.adaptation import calibrate, learn_intensity, rendered, without_intensity
from sern_perception.training.learning import Budget, class_ious, geodesic_distance, statistics_kept, train
from sern_perception.training.network import SegmentationNet, focal_loss
from sern_perception.training.noise import INTENSITY, RANGE
from sern_perception.training.scans import Scans

ROWS, COLUMNS = 8, 64
BUDGET = Budget(steps=3, batch=2, columns=32, rare=1, threads=1)


def scans(count: int = 4, *, lift_m: float = 0.0) -> Scans:
    """A car in each, at half of the ring, brighter than the ground around it."""
    draw = np.random.default_rng(3)
    channels = draw.normal(0.0, 1.0, (count, CHANNELS, ROWS, COLUMNS)).astype(np.float32)
    channels[:, RANGE] = 5.0 + draw.random((count, ROWS, COLUMNS))
    channels[:, 2] += lift_m
    labels = np.full((count, ROWS, COLUMNS), PointClass.GROUND, np.uint8)
    labels[..., :32] = PointClass.CAR
    channels[..., :32][:, RANGE] -= 3.0
    channels[:, INTENSITY] = np.where(labels == PointClass.CAR, 80.0, 20.0) + draw.normal(0.0, 2.0, labels.shape)
    channels[:, :, 0, :3] = labels[:, 0, :3] = 0
    return Scans(channels, labels)


def weights(net: SegmentationNet) -> list[torch.Tensor]:
    return [each.detach().clone() for each in net.state_dict().values()]


def test_the_same_seed_trains_the_same_network() -> None:
    one, same, other = (weights(train(scans(), seed, BUDGET)) for seed in (1, 1, 2))
    assert all(torch.equal(mine, yours) for mine, yours in zip(one, same, strict=True))
    assert any(not torch.equal(mine, yours) for mine, yours in zip(one, other, strict=True))


def test_alignment_changes_weights_and_leaves_no_trace_of_the_other_scanner_in_the_statistics() -> None:
    far = scans(lift_m=50.0).channels
    plain, aligned = train(scans(), 1, BUDGET), train(scans(), 1, BUDGET, other=far)
    assert not torch.equal(plain.by_1[0].weight, aligned.by_1[0].weight)
    net = SegmentationNet().train()
    before = copy.deepcopy(net.state_dict())
    with statistics_kept(net):
        net(torch.from_numpy(far))
    for name, value in net.state_dict().items():
        assert name.endswith("num_batches_tracked") or torch.equal(value, before[name]), name
    net(torch.from_numpy(far))
    assert not torch.equal(net.by_1[1].running_mean, before["by_1.1.running_mean"])


def test_covariances_that_are_alike_are_no_distance_apart() -> None:
    torch.manual_seed(1)
    features = torch.randn(500, 8)
    assert geodesic_distance(features, features + 3.0).item() == pytest.approx(0.0, abs=1e-6)
    assert geodesic_distance(features, 2 * features).item() > 0.01


def test_calibration_gives_each_layer_the_statistics_of_what_it_sees() -> None:
    """What each normalisation makes of these scans has mean 0 and variance 1 after it, times its own weights."""
    net, there = train(scans(), 1, BUDGET), scans(lift_m=3.0).channels
    seen: dict[str, tuple[float, float]] = {}

    def note(name: str) -> object:
        def hook(layer: torch.nn.BatchNorm2d, _inputs: object, made: torch.Tensor) -> None:
            made = (made - layer.bias.view(1, -1, 1, 1)) / layer.weight.view(1, -1, 1, 1)
            alive = layer.running_var > 1e-3
            means, variances = made.mean((0, 2, 3))[alive], made.var((0, 2, 3))[alive]
            seen[name] = (float(means.abs().max()), float((variances - 1).abs().max()))

        return hook

    calibrate(net, there)
    assert not net.training and not any(each.training for each in net.modules())
    for name, layer in net.named_modules():
        if isinstance(layer, torch.nn.BatchNorm2d):
            layer.register_forward_hook(note(name))
    with torch.no_grad():
        net(torch.from_numpy(there))
    assert len(seen) == 35
    for name, (mean, variance) in seen.items():
        assert mean < 1e-2 and variance < 5e-2, name


def test_intensity_is_rendered_where_something_is_as_the_other_scanner_has_it() -> None:
    other = scans()
    net = learn_intensity(other.channels, 1, Budget(steps=160, batch=4, columns=32, threads=1))
    dark = without_intensity(other.channels)
    found = rendered(dark, net, np.random.default_rng(1))[:, INTENSITY]
    car, ground = (found[other.labels == kind] for kind in (PointClass.CAR, PointClass.GROUND))
    assert float(np.median(car)) == pytest.approx(80.0, abs=10.0)
    assert float(np.median(ground)) == pytest.approx(20.0, abs=10.0)
    assert not found[other.labels == 0].any() and not dark[:, INTENSITY].any()


def test_focal_loss_is_of_labelled_pixels_and_less_where_it_is_sure() -> None:
    labels = torch.tensor([[[1, 2, 0]]])
    ones = torch.ones(len(CLASSES))
    right = torch.zeros(1, len(CLASSES), 1, 3)
    right[0, 1, 0, 0] = right[0, 2, 0, 1] = 5.0
    nothing = right.clone()
    nothing[0, 3, 0, 2] = 9.0
    assert focal_loss(right, labels, ones) < 1e-3 < focal_loss(torch.zeros_like(right), labels, ones)
    assert focal_loss(nothing, labels, ones) == focal_loss(right, labels, ones)


def test_ious_are_of_all_pixels_with_a_return() -> None:
    class Says(torch.nn.Module):  # type: ignore[misc]
        def forward(self, x: torch.Tensor) -> torch.Tensor:
            scores = torch.zeros(len(x), len(CLASSES), *x.shape[-2:])
            scores[:, PointClass.GROUND] = 1.0
            return scores

    found = class_ious(Says(), scans())
    there = int(np.count_nonzero(scans().labels))
    ground = int(np.count_nonzero(scans().labels == PointClass.GROUND))
    assert found == {"ground": pytest.approx(ground / there), "car": 0.0}
