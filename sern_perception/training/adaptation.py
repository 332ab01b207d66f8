"""What scans without labels tell of another scanner, and how scans with labels are made like its own.

- Intensity: omitted, or rendered by a network that learned it of the other scanner's clouds (SqueezeSegV2, "learned
  intensity rendering").
- Progressive calibration: the statistics of each batch normalisation are taken anew of the other scanner's clouds, one
  layer after the other from the input on, since each changes what the next one sees (SqueezeSegV2).
"""

import math
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage, special
from torch import nn
from torch.nn import functional

from sern_perception.training.learning import Budget, some_channels
from sern_perception.training.network import INTENSITY_BINS, IntensityNet, SegmentationNet
from sern_perception.training.noise import INTENSITY, RANGE

GRAIN_COLUMNS: Final = 6.0
"""Rendered intensities that are unsure are drawn alike over so much: a thing has one colour."""


def without_intensity(channels: NDArray[np.float32]) -> NDArray[np.float32]:
    found = channels.copy()
    found[:, INTENSITY] = 0.0
    return found


def learn_intensity(channels: NDArray[np.float32], seed: int, budget: Budget) -> IntensityNet:
    """A network that says what intensity these clouds have where. Its loss is SqueezeSegV2's: which bin, and how far
    off in it."""
    torch.manual_seed(seed)
    torch.set_num_threads(budget.threads)
    draw = np.random.default_rng(seed)
    net = IntensityNet()
    optimiser = torch.optim.Adam(net.parameters(), lr=budget.rate)
    for _ in range(max(1, budget.steps // 2)):
        batch = some_channels(channels, draw, budget)
        there = batch[:, RANGE] > 0
        bins = batch[:, INTENSITY] * (INTENSITY_BINS / 100.0)
        which = bins.long().clamp(0, INTENSITY_BINS - 1)
        scores, within = net(batch)
        off = within.gather(1, which[:, None])[:, 0] - (bins - which - 0.5)
        loss = functional.cross_entropy(scores.permute(0, 2, 3, 1)[there], which[there]) + (off[there] ** 2).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    net.eval()
    return net


def rendered(
    channels: NDArray[np.float32], intensity: IntensityNet, draw: np.random.Generator, *, batch: int = 16
) -> NDArray[np.float32]:
    """The same clouds with intensities drawn from what the network says: a mean would be smoother than any scanner."""
    found = channels.copy()
    with torch.no_grad():
        for start in range(0, len(channels), batch):
            part = channels[start : start + batch]
            scores, within = (each.numpy() for each in intensity(torch.from_numpy(part)))
            drawn = _drawn(special.softmax(scores, axis=1), within, draw)
            found[start : start + batch, INTENSITY] = drawn * (part[:, RANGE] > 0)
    return found


def _drawn(shares: NDArray[np.float32], within: NDArray[np.float32], draw: np.random.Generator) -> NDArray[np.float32]:
    """Intensities [%] of each pixel, (n, rows, columns), of the shares of bins, (n, bins, rows, columns)."""
    size = (len(shares), *shares.shape[2:])
    coarse = ndimage.gaussian_filter(draw.normal(size=size), (0.0, 2.0, GRAIN_COLUMNS), mode="wrap")
    mixed = (coarse / coarse.std() + draw.normal(size=size)) / math.sqrt(2.0)
    level = special.ndtr(mixed)
    sums = shares.cumsum(axis=1)
    which = np.minimum((sums < level[:, None]).sum(axis=1), INTENSITY_BINS - 1)[:, None]
    places = which + 0.5 + np.take_along_axis(within, which, axis=1)
    found: NDArray[np.float32] = (places[:, 0] * (100.0 / INTENSITY_BINS)).astype(np.float32)
    return found


class _ReachedError(Exception):
    """The layer whose statistics are taken has run: what comes after it need not."""


def calibrate(net: SegmentationNet, channels: NDArray[np.float32], *, batch: int = 8) -> SegmentationNet:
    """Take the statistics of each batch normalisation anew of these scans, from the input on. The same network."""
    net.eval()
    with torch.no_grad():
        for layer in [each for each in net.modules() if isinstance(each, nn.BatchNorm2d)]:
            layer.reset_running_stats()
            layer.momentum = None  # a plain mean over all batches
            layer.train()
            hook = layer.register_forward_hook(_reached)
            for start in range(0, len(channels), batch):
                try:
                    net(torch.from_numpy(channels[start : start + batch]))
                except _ReachedError:
                    continue
            hook.remove()
            layer.eval()
    return net


def _reached(_layer: nn.Module, _inputs: object, _output: object) -> None:
    raise _ReachedError
