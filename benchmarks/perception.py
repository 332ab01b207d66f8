"""How well the network that comes with SERN knows scans of worlds that it was not trained on, what it costs on one
core, and whether a thing in the way is found by it or by the detector beside it.

The study of what fits it to another scanner takes hours: `python -m sern_perception.training study`.
"""

import argparse
import sys
import time
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from benchmarks.common import Report, main, percentile
from sern_perception.classes import CLASSES, OBSTACLES, PointClass
from sern_perception.detector import standing
from sern_perception.projection import HDL64, VLP16, RangeImage
from sern_perception.segmenter import WEIGHTS, Segmenter

SEED: Final = 4_242
NEAR_M: Final = 6.0
FEWEST: Final = 6
"""A thing of fewer points is not seen."""
FOUND: Final = 3
"""A thing of which so many points are called an obstacle is found."""
KINDS: Final = (PointClass.CAR, PointClass.LOG, PointClass.OTHER)


def bench(options: argparse.Namespace, report: Report) -> None:
    from sern_perception.training.scans import SHIFTED, SOURCE, make

    count = 12 if options.quick else 200
    segmenter = Segmenter()
    for sensor, name in ((SOURCE, "the scanner that it was trained on"), (SHIFTED, "another scanner, as it is")):
        scans = make(SEED, count, sensor)
        images = [_image(channels, labels) for channels, labels in zip(scans.channels, scans.labels, strict=True)]
        said = [segmenter.segment(image).classes for image in images]
        ious = _ious(said, scans.labels)
        report.row(name, "network", miou_percent=100 * float(np.mean(list(ious.values()))),
                   **{f"{CLASSES[number]}_percent": 100 * iou for number, iou in ious.items()})  # fmt: skip
        stands = [standing(image, sensor.shape) for image in images]
        obstacle = [np.isin(each, OBSTACLES) for each in said]
        both = [net | own for net, own in zip(obstacle, stands, strict=True)]
        for system, masks in (("network", obstacle), ("detector", stands), ("one or the other", both)):
            found = _recall(masks, scans.labels, scans.channels)
            report.row(f"things within 6 m, {name}", system,
                       **{f"{kind.name.lower()}_percent": share for kind, share in found.items()})  # fmt: skip
            if sensor is SOURCE and system == "one or the other":
                report.reach("logs within 6 m found by one or the other, %", found[PointClass.LOG], 95, at_least=True)
    _costs(segmenter, report, 20 if options.quick else 200)
    report.reach("the model, MB", WEIGHTS.stat().st_size / 1e6, 5)
    report.note(f"{count} scans of worlds that nothing was trained on")


def _costs(segmenter: Segmenter, report: Report, rounds: int) -> None:
    draw = np.random.default_rng(1)
    for shape, name in ((VLP16, "16 x 900"), (HDL64, "64 x 512")):
        channels = draw.random((5, shape.rows, shape.columns)).astype(np.float32)
        image = _image(channels, np.ones((shape.rows, shape.columns), np.uint8))
        took_ms = []
        for _ in range(rounds):
            begin_s = time.perf_counter()
            segmenter.segment(image)
            took_ms.append(1e3 * (time.perf_counter() - begin_s))
        took_ms.sort()
        p50_ms, p99_ms = percentile(took_ms, 0.5), percentile(took_ms, 0.99)
        report.row("one core", f"network, {name}", p50_ms=p50_ms, p99_ms=p99_ms)
        if shape is VLP16:
            report.reach("network, 16 x 900, p50, ms", p50_ms, 40)


def _image(channels: NDArray[np.float32], labels: NDArray[np.uint8]) -> RangeImage:
    points = np.where(labels > 0, np.arange(labels.size).reshape(labels.shape), -1).astype(np.int32)
    return RangeImage(channels, points, {})


def _ious(said: list[NDArray[np.uint8]], labels: NDArray[np.uint8]) -> dict[int, float]:
    found = np.array(said)
    return {
        number: float(np.count_nonzero((found == number) & (labels == number)))
        / float(np.count_nonzero(((found == number) | (labels == number)) & (labels > 0)))
        for number in range(1, len(CLASSES))
        if (labels == number).any()
    }


def _recall(
    masks: list[NDArray[np.bool_]], labels: NDArray[np.uint8], channels: NDArray[np.float32]
) -> dict[PointClass, float]:
    """The share of the things of each kind that is found, in per cent."""
    found = dict.fromkeys(KINDS, 0)
    all_of = dict.fromkeys(KINDS, 0)
    for mask, label, channel in zip(masks, labels, channels, strict=True):
        for kind in KINDS:
            near = (label == kind) & (channel[4] < NEAR_M)
            things, count = ndimage.label(ndimage.binary_dilation(near, np.ones((3, 5))))
            for number in range(1, count + 1):
                thing = near & (things == number)
                if np.count_nonzero(thing) >= FEWEST:
                    all_of[kind] += 1
                    found[kind] += int(np.count_nonzero(mask & thing)) >= FOUND
    return {kind: 100 * found[kind] / max(1, all_of[kind]) for kind in KINDS}


if __name__ == "__main__":
    sys.exit(main("perception", bench, description=__doc__))
