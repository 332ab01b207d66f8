"""Training of the network, and what makes it fit another scanner than that of its labels.

- Intensity: omitted, or rendered by a network that learned it of the other scanner's clouds, which need no labels.
- Geodesic correlation alignment: features of both scanners are to have covariances that are near in the log-Euclidean
  metric (Morerio et al., ICLR 2018; SqueezeSegV2).
- Progressive calibration: the statistics of each batch normalisation are taken anew of the other scanner's clouds, one
  layer after the other from the input on, since each changes what the next one sees (SqueezeSegV2).
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from sern_perception.classes import CLASSES, PointClass
from sern_perception.training.network import SegmentationNet, focal_loss
from sern_perception.training.scans import Scans

INTENSITY: Final = 3
"""The channel."""
SAMPLES: Final = 2048
"""Pixels of a batch whose features are aligned: more covariances than these tell nothing new."""
RARE: Final = (PointClass.CAR, PointClass.BRIDGE, PointClass.LOG)
RIDGE: Final = 1e-3
ALIGNS: Final = 3.0
"""The weight of the alignment beside the focal loss, of about 0.1."""
_FAST: Final = torch.channels_last
"""Images are kept so in memory: twice as fast on a CPU."""
Told = Callable[[str], None]
T = TypeVar("T", bound=np.generic)


@dataclass(frozen=True, slots=True)
class Budget:
    """`columns`: scans are cut to so many, at random; all of the ring takes longer and teaches little more. `rare`: so
    many parts of a batch are around a pixel of a class that is rare."""

    steps: int = 1500
    batch: int = 8
    columns: int = 450
    rare: int = 0
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
    net: SegmentationNet = SegmentationNet().to(memory_format=_FAST)
    weights = _weights(scans.labels)
    optimiser = torch.optim.AdamW(net.parameters(), lr=budget.rate, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, budget.rate, total_steps=budget.steps)
    net.train()
    batches = _Batches(scans, draw, budget)
    for step in range(budget.steps):
        channels, labels = batches.next()
        features = net.features(channels)
        loss = focal_loss(net.scores(features), labels, weights)
        if other is not None:
            there = some_channels(other, draw, budget)
            with statistics_kept(net):
                features_there = net.features(there)
            usual = slice(budget.rare, None)  # not those that were sought out
            aligned = geodesic_distance(
                _sampled(features[usual], channels[usual], draw), _sampled(features_there, there, draw)
            )
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


@contextmanager
def statistics_kept(net: nn.Module) -> Iterator[None]:
    """Batches are normalised by themselves and leave no trace in the statistics that the network keeps: those are of
    one scanner, and a mixture of two fits neither."""
    layers = [each for each in net.modules() if isinstance(each, nn.BatchNorm2d)]
    before = [each.momentum for each in layers]
    for each in layers:
        each.momentum = 0.0
    try:
        yield
    finally:
        for each, momentum in zip(layers, before, strict=True):
            each.momentum = momentum


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


class _Batches:
    """Parts of labelled scans. The first `rare` ones of a batch are around a pixel of a class that is rare, each of
    those classes as often as the others; the rest is from anywhere."""

    def __init__(self, scans: Scans, draw: np.random.Generator, budget: Budget) -> None:
        self._scans, self._draw, self._budget = scans, draw, budget
        found = [np.argwhere((scans.labels == kind).any(axis=1)) for kind in RARE]
        self._rare = [each for each in found if len(each)]

    def next(self) -> tuple[Tensor, Tensor]:
        draw, budget = self._draw, self._budget
        width = self._scans.labels.shape[-1]
        picked, starts = _anywhere(len(self._scans.labels), width, draw, budget.batch)
        for number in range(budget.rare if self._rare else 0):
            places = self._rare[int(draw.integers(0, len(self._rare)))]
            picked[number], middle = places[int(draw.integers(0, len(places)))]
            starts[number] = middle - int(draw.integers(0, min(budget.columns, width)))
        channels = _cut(self._scans.channels, picked, starts, budget)
        labels = _cut(self._scans.labels, picked, starts, budget).astype(np.int64)
        if draw.random() < 0.5:  # left and right are alike
            channels, labels = channels[..., ::-1].copy(), labels[..., ::-1].copy()
            channels[:, 1] *= -1
        return torch.from_numpy(channels).to(memory_format=_FAST), torch.from_numpy(labels)


def some_channels(channels: NDArray[np.float32], draw: np.random.Generator, budget: Budget) -> Tensor:
    """Parts of scans, from anywhere."""
    picked, starts = _anywhere(len(channels), channels.shape[-1], draw, budget.batch)
    return torch.from_numpy(_cut(channels, picked, starts, budget)).to(memory_format=_FAST)


def _anywhere(
    count: int, width: int, draw: np.random.Generator, batch: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Numbers of scans, and the column at which each part begins."""
    return draw.integers(0, count, batch), draw.integers(0, width, batch)


def _cut(images: NDArray[T], picked: NDArray[np.int64], starts: NDArray[np.int64], budget: Budget) -> NDArray[T]:
    """Columns that follow each other on the ring, of some images (n, ..., columns)."""
    width = images.shape[-1]
    columns = np.arange(min(budget.columns, width))
    return np.stack(
        [
            np.take(images[which], (start + columns) % width, axis=-1)
            for which, start in zip(picked, starts, strict=True)
        ]
    )
