"""What each adaptation is worth: mIoU on the shifted scanner, over seeds; as it is, also where it is nothing.

The scanner of the labels is `SOURCE`, the other one `SHIFTED`. Of the other one the adaptations get scans without
labels, of worlds that are neither those of the training nor those of the test. The choices that are in them were made
on other seeds than those that are reported.
"""

from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sern_perception.training.adaptation import (
    calibrate,
    learn_intensity,
    rendered,
    without_intensity,
)
from sern_perception.training.learning import Budget, Told, class_ious, train
from sern_perception.training.network import SegmentationNet
from sern_perception.training.noise import noise_of, noised
from sern_perception.training.scans import SHIFTED, SOURCE, Scans, make
from sern_perception.training.table import NONE, OWN, TARGET, Tried

TRAINING_SCANS: Final = 480
OTHER_SCANS: Final = 160
TEST_SCANS: Final = 100
CALIBRATION_SCANS: Final = 32
BUDGET: Final = Budget(steps=500, batch=4, columns=225)
"""Each training has a sixteenth of what the network that comes with SERN gets, so that there can be many."""
ALIGNED: Final = "alignment"
ALL: Final = "all: noise, rendered intensity, alignment, calibration"
NAMES: Final = (
    OWN,
    NONE,
    "calibration",
    "intensity omitted",
    "intensity rendered",
    "noise of the other scanner",
    ALIGNED,
    "alignment and calibration",
    "all but alignment",
    ALL,
    TARGET,
)


def tried(seed: int, budget: Budget, told: Told) -> Iterator[Tried]:
    """All variants for one seed: of data, of the network's first weights, and of what is drawn."""
    source = make(10_000 + seed, TRAINING_SCANS, SOURCE)
    target = make(20_000 + seed, OTHER_SCANS, SHIFTED)
    test = make(30_000 + seed, TEST_SCANS, SHIFTED)
    own = make(40_000 + seed, TEST_SCANS, SOURCE)
    draw = np.random.default_rng(seed)
    other = target.channels  # without labels, but for the last row
    some = other[:CALIBRATION_SCANS]
    told(f"seed {seed}: {TRAINING_SCANS} scans with labels, {OTHER_SCANS} without, of the other scanner")

    names = iter(NAMES)

    def found(net: SegmentationNet, scans: Scans = test) -> Tried:
        return Tried(seed, next(names), class_ious(net, scans))

    plain = train(source, seed, budget)
    yield found(plain, own)
    yield found(plain)
    yield found(calibrate(plain, some))

    dark = _with(source, without_intensity(source.channels))
    yield found(train(dark, seed, budget), _with(test, without_intensity(test.channels)))
    intensity = learn_intensity(other, seed, budget)
    lit = _with(source, rendered(source.channels, intensity, draw))
    yield found(train(lit, seed, budget))
    noisy = noised(source, noise_of(other), draw)
    yield found(train(noisy, seed, budget))
    aligned = train(source, seed, budget, other=other)
    yield found(aligned)
    yield found(calibrate(aligned, some))

    like = _with(noisy, rendered(noisy.channels, intensity, draw))
    yield found(calibrate(train(like, seed, budget), some))
    yield found(calibrate(train(like, seed, budget, other=other), some))
    yield found(train(target, seed, budget))


def _with(scans: Scans, channels: NDArray[np.float32]) -> Scans:
    return Scans(channels, scans.labels)
