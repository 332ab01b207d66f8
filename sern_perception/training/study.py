"""What each adaptation is worth: mIoU on the shifted scanner, over seeds, with intervals; as it is, also where it is
nothing."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from statistics import fmean, stdev
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from sern_perception.training.learning import (
    Budget,
    Told,
    calibrate,
    class_ious,
    learn_intensity,
    rendered,
    train,
    without_intensity,
)
from sern_perception.training.scans import SHIFTED, SOURCE, Scans, make

TRAINING_SCANS: Final = 480
OTHER_SCANS: Final = 160
TEST_SCANS: Final = 120
CALIBRATION_SCANS: Final = 80


@dataclass(frozen=True, slots=True)
class Tried:
    """One network on the test scans: `ious` by class."""

    seed: int
    name: str
    ious: dict[str, float]

    @property
    def miou(self) -> float:
        return fmean(self.ious.values())


def interval(values: list[float]) -> tuple[float, float]:
    """Mean and half of the width of its 95 % interval (Student's t); NaN for one value."""
    if len(values) < 2:
        return fmean(values), math.nan
    return fmean(values), float(student.ppf(0.975, len(values) - 1)) * stdev(values) / math.sqrt(len(values))


def tried(seed: int, budget: Budget, told: Told) -> Iterator[Tried]:
    """All variants for one seed: of data, of the network's first weights, and of what is drawn."""
    source = make(10_000 + seed, TRAINING_SCANS, SOURCE)
    other = make(20_000 + seed, OTHER_SCANS, SHIFTED)
    test = make(30_000 + seed, TEST_SCANS, SHIFTED)
    own = make(40_000 + seed, TEST_SCANS, SOURCE)
    some = other.channels[:CALIBRATION_SCANS]
    told(f"seed {seed}: {TRAINING_SCANS} scans with labels, {OTHER_SCANS} without, of the other scanner")

    plain = train(source, seed, budget)
    yield Tried(seed, "source alone, on the source", class_ious(plain, own))
    yield Tried(seed, "source alone", class_ious(plain, test))
    yield Tried(seed, "calibration", class_ious(calibrate(plain, some), test))

    dark = _with(source, without_intensity(source.channels))
    omitted = train(dark, seed, budget)
    yield Tried(seed, "intensity omitted", class_ious(omitted, _with(test, without_intensity(test.channels))))

    lit = _with(source, rendered(source.channels, learn_intensity(other.channels, seed, budget)))
    yield Tried(seed, "intensity rendered", class_ious(train(lit, seed, budget), test))
    yield Tried(seed, "alignment", class_ious(train(source, seed, budget, other=other.channels), test))
    everything = train(lit, seed, budget, other=other.channels)
    yield Tried(seed, "rendered and aligned", class_ious(everything, test))
    yield Tried(seed, "all", class_ious(calibrate(everything, some), test))
    yield Tried(seed, "labels of the target", class_ious(train(other, seed, budget), test))


def _with(scans: Scans, channels: NDArray[np.float32]) -> Scans:
    return Scans(channels, scans.labels)
