"""Training of the network, and what makes it fit another scanner than that of its labels.

- Intensity: omitted, or rendered by a network that learned it of the other scanner's clouds, which need no labels.
- Geodesic correlation alignment: features of both scanners are to have covariances that are near in the log-Euclidean
  metric (Morerio et al., ICLR 2018; SqueezeSegV2).
- Progressive calibration: the statistics of each batch normalisation are taken anew of the other scanner's clouds, one
  layer after the other from the input on, since each changes what the next one sees (SqueezeSegV2).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from sern_perception.classes import CLASSES
from sern_perception.training.network import IntensityNet, SegmentationNet, focal_loss
from sern_perception.training.scans import Scans

INTENSITY: Final = 3
"""The channel."""
SAMPLES: Final = 2048
"""Pixels of a batch whose features are aligned: more covariances than these tell nothing new."""
RIDGE: Final = 1e-3
ALIGNS: Final = 10.0
"""The weight of the alignment beside the focal loss, of about 0.1."""
Told = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Budget:
    """`columns`: scans are cut to so many, at random; all of the ring takes longer and teaches little more."""

    steps: int = 1500
    batch: int = 8
    columns: int = 450
    rate: float = 3e-3
    threads: int = 2


def train(
    scans: Scans, seed: int, budget: Budget, *, other: NDArray[np.float32] | None = None, told: Told | None = None
) -> SegmentationNet:
    """A network that learned of labelled scans, aligned with the channels of `other` ones where there are any.

    Seeded: on one machine the same seed gives the same network.
    """
    torch.manual_seed(seed)
    torch.set_num_threads(budget.threads)
    draw = np.random.default_rng(seed)
    net = SegmentationNet()
    weights = _weights(scans.labels)
    optimiser = torch.optim.AdamW(net.parameters(), lr=budget.rate, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, budget.rate, total_steps=budget.steps)
    net.train()
    for step in range(budget.steps):
        channels, labels = _batch(scans, draw, budget)
        features = net.features(channels)
        loss = focal_loss(net.scores(features), labels, weights)
        if other is not None:
            there = _channels(other, draw, budget)
            aligned = geodesic_distance(_sampled(features, channels, draw), _sampled(net.features(there), there, draw))
            loss = loss + ALIGNS * aligned
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimiser.step()
        schedule.step()
        if told is not None and (step + 1) % 100 == 0:
            told(f"step {step + 1} of {budget.steps}: loss {float(loss.detach()):.4f}")
    net.eval()
    return net


def geodesic_distance(one: Tensor, other: Tensor) -> Tensor:
    """The log-Euclidean distance of the covariances of features (n, d) each, squared, over 4 d²."""
    logs = [_log_covariance(features) for features in (one, other)]
    width = one.shape[1]
    return ((logs[0] - logs[1]) ** 2).sum() / (4 * width**2)


def calibrate(net: SegmentationNet, channels: NDArray[np.float32], *, batch: int = 8) -> SegmentationNet:
    """Take the statistics of each batch normalisation anew of these scans, from the input on. The same network."""
    layers = [each for each in net.modules() if isinstance(each, nn.BatchNorm2d)]
    net.eval()
    with torch.no_grad():
        for layer in layers:
            layer.reset_running_stats()
            layer.momentum = None  # a plain mean over all batches
            layer.train()
            for start in range(0, len(channels), batch):
                net(torch.from_numpy(channels[start : start + batch]))
            layer.eval()
    return net


def without_intensity(channels: NDArray[np.float32]) -> NDArray[np.float32]:
    found = channels.copy()
    found[:, INTENSITY] = 0.0
    return found


def learn_intensity(channels: NDArray[np.float32], seed: int, budget: Budget) -> IntensityNet:
    """A network that says what intensity these clouds have where."""
    torch.manual_seed(seed)
    draw = np.random.default_rng(seed)
    net = IntensityNet()
    optimiser = torch.optim.Adam(net.parameters(), lr=budget.rate)
    for _ in range(max(1, budget.steps // 3)):
        batch = _channels(channels, draw, budget)
        there = batch[:, 4:5] > 0
        loss = functional.smooth_l1_loss(net(batch)[there], batch[:, INTENSITY : INTENSITY + 1][there], beta=0.1)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    net.eval()
    return net


def rendered(channels: NDArray[np.float32], intensity: IntensityNet, *, batch: int = 16) -> NDArray[np.float32]:
    """The same clouds with the intensity that the network says."""
    found = channels.copy()
    with torch.no_grad():
        for start in range(0, len(channels), batch):
            part = torch.from_numpy(channels[start : start + batch])
            found[start : start + batch, INTENSITY] = intensity(part)[:, 0].numpy()
    return found


def class_ious(net: SegmentationNet, scans: Scans, *, batch: int = 8) -> dict[str, float]:
    """Intersection over union of each class that is in the scans but NOTHING, over all of their pixels."""
    counts = np.zeros((len(CLASSES), len(CLASSES)), np.int64)
    with torch.no_grad():
        for start in range(0, len(scans.labels), batch):
            said = net(torch.from_numpy(scans.channels[start : start + batch]))
            said[:, 0] = -np.inf  # a pixel with a return is of some class
            found = said.argmax(1).numpy()
            labels = scans.labels[start : start + batch]
            there = labels > 0
            np.add.at(counts, (labels[there], found[there]), 1)
    met = np.diag(counts)
    either = counts.sum(axis=0) + counts.sum(axis=1) - met
    return {
        name: float(met[number] / either[number])
        for number, name in enumerate(CLASSES)
        if number and counts[number].sum()
    }


def _log_covariance(features: Tensor) -> Tensor:
    centred = features - features.mean(0)
    covariance = centred.T @ centred / (len(features) - 1) + RIDGE * torch.eye(features.shape[1])
    values, vectors = torch.linalg.eigh(covariance)
    return (vectors * values.clamp(min=RIDGE / 10).log()) @ vectors.T


def _sampled(features: Tensor, channels: Tensor, draw: np.random.Generator) -> Tensor:
    """Features of pixels that something is in, (SAMPLES, width)."""
    found = features.permute(0, 2, 3, 1)[channels[:, 4] > 0]
    picked = draw.integers(0, len(found), SAMPLES)
    return found[torch.from_numpy(picked)]


def _weights(labels: NDArray[np.uint8]) -> Tensor:
    """Class weights, the less the more pixels one has, by the root of the logarithm's argument (SqueezeSeg)."""
    counts = np.bincount(labels[labels > 0].ravel(), minlength=len(CLASSES))
    shares = counts / max(1, int(counts.sum()))
    return torch.from_numpy(1.0 / np.log(1.1 + shares)).float()


def _batch(scans: Scans, draw: np.random.Generator, budget: Budget) -> tuple[Tensor, Tensor]:
    picked, columns = _picked(len(scans.labels), scans.labels.shape[-1], draw, budget)
    channels, labels = scans.channels[picked][..., columns], scans.labels[picked][..., columns].astype(np.int64)
    if draw.random() < 0.5:  # left and right are alike
        channels, labels = channels[..., ::-1].copy(), labels[..., ::-1].copy()
        channels[:, 1] *= -1
    return torch.from_numpy(np.ascontiguousarray(channels)), torch.from_numpy(np.ascontiguousarray(labels))


def _channels(channels: NDArray[np.float32], draw: np.random.Generator, budget: Budget) -> Tensor:
    picked, columns = _picked(len(channels), channels.shape[-1], draw, budget)
    return torch.from_numpy(np.ascontiguousarray(channels[picked][..., columns]))


def _picked(count: int, width: int, draw: np.random.Generator, budget: Budget) -> tuple[Any, Any]:
    """Numbers of scans, and of columns that follow each other on the ring."""
    start = int(draw.integers(0, width))
    return draw.integers(0, count, budget.batch), (start + np.arange(min(budget.columns, width))) % width
