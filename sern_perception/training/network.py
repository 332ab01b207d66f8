"""A network in the manner of SqueezeSegV2 (Wu et al., ICRA 2019): fire modules, context aggregation, and skips.

Context aggregation (CAM) makes a layer look past the points that a scanner missed. The image is halved along the ring
alone, as it has few rings. A pixel without a return is marked by a mask of its own. Widths are half of the paper's:
one core of a robot has 50 ms.
"""

from typing import Any, Final

import torch
from torch import Tensor, nn
from torch.nn import functional

from sern_perception.classes import CLASSES
from sern_perception.projection import CHANNELS

SCALES: Final = (10.0, 10.0, 2.0, 100.0, 15.0)
"""What x, y, z, intensity and range are divided by, so that all are about 1."""
WIDTHS: Final = (32, 48, 64, 96)
INTENSITY_BINS: Final = 20
"""Equal parts of 0 to 100 %."""
NEIGHBOURS: Final = 4


class Cam(nn.Module):  # type: ignore[misc]
    """Context aggregation: each pixel is weighed by what the 7 x 7 around it have at the most."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.weigh = nn.Sequential(
            nn.MaxPool2d(7, 1, 3),
            nn.Conv2d(width, width // 16 or 1, 1),
            nn.ReLU(inplace=True),
            nn.Conv2d(width // 16 or 1, width, 1),
            nn.Sigmoid(),
        )

    def forward(self, x: Tensor) -> Tensor:
        return x * self.weigh(x)


class Fire(nn.Module):  # type: ignore[misc]
    """Squeeze to a quarter, expand by 1 x 1 and 3 x 3."""

    def __init__(self, before: int, after: int) -> None:
        super().__init__()
        self.squeeze = _conv(before, after // 4, 1)
        self.near = _conv(after // 4, after // 2, 1)
        self.around = _conv(after // 4, after // 2, 3)

    def forward(self, x: Tensor) -> Tensor:
        x = self.squeeze(x)
        return torch.cat([self.near(x), self.around(x)], 1)


class SegmentationNet(nn.Module):  # type: ignore[misc]
    """(n, 5, rows, columns) of a `RangeImage`'s channels to (n, classes, rows, columns) of scores."""

    def __init__(self) -> None:
        super().__init__()
        first, second, third, fourth = WIDTHS
        self.register_buffer("scales", torch.tensor(SCALES).view(1, CHANNELS, 1, 1))
        self.by_1 = _conv(CHANNELS + 1, first, 1)
        self.by_2 = nn.Sequential(_conv(CHANNELS + 1, first, 3, stride=(1, 2)), Cam(first))
        self.by_4 = nn.Sequential(Fire(first, second), Cam(second), Fire(second, second), Cam(second))
        self.by_8 = nn.Sequential(Fire(second, third), Fire(third, third))
        self.by_16 = nn.Sequential(Fire(third, fourth), Fire(fourth, fourth), Fire(fourth, fourth))
        self.down = nn.MaxPool2d((1, 3), (1, 2), (0, 1))
        self.up_8 = Fire(fourth + third, third)
        self.up_4 = Fire(third + second, second)
        self.up_2 = Fire(second + first, first)
        self.up_1 = Fire(first + first, first)
        self.scores = nn.Sequential(nn.Dropout2d(0.1), nn.Conv2d(first, len(CLASSES), 1))

    def features(self, x: Tensor) -> Tensor:
        """What the scores are made of, (n, width, rows, columns)."""
        there = (x[:, 4:5] > 0).to(x.dtype)
        x = torch.cat([x / self.scales, there], 1)
        half = self.by_2(x)
        quarter = self.by_4(self.down(half))
        eighth = self.by_8(self.down(quarter))
        deep = self.by_16(self.down(eighth))
        up = self.up_8(_beside(deep, eighth))
        up = self.up_4(_beside(up, quarter))
        up = self.up_2(_beside(up, half))
        return self.up_1(_beside(up, self.by_1(x)))

    def forward(self, x: Tensor) -> Tensor:
        return self.scores(self.features(x))


class IntensityNet(nn.Module):  # type: ignore[misc]
    """Intensity of places: learned of clouds without labels, and rendered into those that have labels and no intensity
    of a real scanner (SqueezeSegV2, "learned intensity rendering").

    It says how likely each bin is, and where in it the intensity is. It looks at ranges and at what neighbours differ
    by, not at where in the scanner's frame a place is: that is another one on another scanner.
    """

    def __init__(self, width: int = 32) -> None:
        super().__init__()
        self.net = nn.Sequential(
            _conv(NEIGHBOURS * 2 + 2, width, 3),
            _conv(width, width, 3),
            _conv(width, width, 3),
            nn.Conv2d(width, 2 * INTENSITY_BINS, 1),
        )

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Take channels (n, 5, rows, columns) without a look at intensity: scores of bins, and where in each bin the
        intensity is, from -0.5 to 0.5; (n, bins, rows, columns) both."""
        there = (x[:, 4:5] > 0).to(x.dtype)
        ranges_m, heights_m = x[:, 4:5], x[:, 2:3]
        padded = functional.pad(torch.cat([ranges_m, heights_m, there], 1), (1, 1, 1, 1))
        rows, columns = x.shape[-2:]
        parts = [ranges_m / SCALES[4], there]
        for down, right in ((0, 1), (2, 1), (1, 0), (1, 2)):
            beside = padded[:, :, down : down + rows, right : right + columns]
            both = beside[:, 2:3] * there
            by = (beside[:, :2] - torch.cat([ranges_m, heights_m], 1)) / ranges_m.clamp(min=0.5)
            parts.append((10 * by).clamp(-2.0, 2.0) * both)
        scores, within = self.net(torch.cat(parts, 1)).chunk(2, 1)
        return scores, torch.tanh(within) / 2


def _conv(before: int, after: int, size: int, *, stride: Any = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(before, after, size, stride, size // 2, bias=False), nn.BatchNorm2d(after), nn.ReLU(inplace=True)
    )


def _beside(small: Tensor, large: Tensor) -> Tensor:
    return torch.cat([functional.interpolate(small, size=large.shape[-2:], mode="nearest"), large], 1)


def focal_loss(scores: Tensor, labels: Tensor, weights: Tensor, gamma: float = 2.0) -> Tensor:
    """-(1 - p)^γ log p of each pixel's class, by its weight (Lin et al., ICCV 2017); class 0 does not count."""
    logs = functional.log_softmax(scores, 1).gather(1, labels[:, None]).squeeze(1)
    counted = weights[labels] * (labels > 0)
    losses = -((1 - logs.exp()) ** gamma) * logs * counted
    return losses.sum() / counted.sum().clamp(min=1.0)
