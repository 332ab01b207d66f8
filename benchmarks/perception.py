"""How well the network that comes with SERN knows scans of worlds that it was not trained on, what it costs on one
core, and whether a thing in the way is found by it or by the detector beside it.

What fits it to another scanner is studied apart, as that takes an hour: `python -m sern_perception.training study`.
"""

import argparse
import itertools
import math
import sys
import time
from random import Random
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from benchmarks.common import Report, main, percentile
from sern_perception.classes import CLASSES, OBSTACLES, PointClass
from sern_perception.detector import standing
from sern_perception.projection import HDL64, VLP16, ImageShape, RangeImage, project
from sern_perception.segmenter import WEIGHTS, Segmenter

SEED: Final = 4_242
NEAR_M: Final = 6.0
FEWEST: Final = 6
"""A thing of fewer points is not seen."""
FOUND: Final = 3
"""A thing of which so many points are called an obstacle is found."""
BOTH: Final = "one or the other"
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
        obstacle = [np.isin(each, OBSTACLES) for each in said]
        stands = [standing(image, sensor.shape) for image in images]
        for system, masks in _systems(obstacle, stands):
            found = _recall(masks, scans.labels, scans.channels)
            report.row(f"things within 6 m, {name}", system,
                       **{f"{kind.name.lower()}_percent": share for kind, share in found.items()},
                       ground_percent=_ground(masks, scans.labels, scans.channels))  # fmt: skip
            if sensor is SOURCE and system == BOTH:
                report.reach("logs within 6 m found by one or the other, %", found[PointClass.LOG], 95, at_least=True)
    _held_out(segmenter, report, 16 if options.quick else 160)
    _costs(segmenter, report, 3 if options.quick else 25)
    report.reach("the model, MB", WEIGHTS.stat().st_size / 1e6, 5)
    report.note(
        f"{count} scans of worlds that nothing was trained on; a thing is found if {FOUND} of its points are called an "
        f"obstacle, and counts if it has {FEWEST}; ground: its share within 6 m that is called an obstacle"
    )


def _held_out(segmenter: Segmenter, report: Report, count: int) -> None:
    """Things of shapes that no training scan has, four in each scan."""
    from sern_perception.training.scans import FIRST_THING, SOURCE, cloud, places, scattered, things_around
    from sern_perception.training.shapes import KINDS as SHAPES
    from sern_sim.mujoco_jackal import MujocoJackal

    random, noise = Random(SEED), np.random.default_rng(SEED)
    found: dict[str, dict[str, list[bool]]] = {}
    for _ in range(count // 8):
        jackal = MujocoJackal(random, world=scattered(random))
        for place in places(random, jackal.world, 8):
            jackal.stand(place)
            things = things_around(jackal, random, 4)
            said = cloud(jackal, SOURCE, noise, things)
            image = project(said, SOURCE.shape)
            labels = np.where(image.seen, said[image.points, 4], 0)
            obstacle, stands = np.isin(segmenter.segment(image).classes, OBSTACLES), standing(image, SOURCE.shape)
            for number, thing in enumerate(things):
                points = labels == FIRST_THING + number
                if np.count_nonzero(points) < FEWEST:
                    continue
                for system, (mask,) in _systems([obstacle], [stands]):
                    seen = bool(np.count_nonzero(mask & points) >= FOUND)
                    found.setdefault(system, {}).setdefault(thing.kind, []).append(seen)
    for system, kinds in found.items():
        each = [seen for kind in kinds.values() for seen in kind]
        report.row("shapes that nothing was trained on, within 6 m", system, things_count=len(each),
                   all_percent=100 * float(np.mean(each)),
                   **{f"{kind}_percent": 100 * float(np.mean(kinds[kind])) for kind in SHAPES if kind in kinds},
                   )  # fmt: skip
        if system == BOTH:
            report.reach("other shapes found by one or the other, %", 100 * float(np.mean(each)), 95, at_least=True)


def _systems(
    obstacle: list[NDArray[np.bool_]], stands: list[NDArray[np.bool_]]
) -> tuple[tuple[str, list[NDArray[np.bool_]]], ...]:
    both = [net | own for net, own in zip(obstacle, stands, strict=True)]
    return ("network", obstacle), ("detector", stands), (BOTH, both)


def _costs(segmenter: Segmenter, report: Report, rounds: int) -> None:
    """Milliseconds of each part, on clouds of the stand-in as it publishes them, and on one of as many points as the
    other image has pixels."""
    from sern_perception.training.scans import places, scattered
    from sern_sim.mujoco_jackal import MujocoJackal

    random = Random(SEED)
    jackal = MujocoJackal(random, world=scattered(random))
    clouds = []
    for place in places(random, jackal.world, 8):
        jackal.stand(place)
        clouds.append(jackal.cloud(VLP16.rows * VLP16.columns))
    draw = np.random.default_rng(SEED)
    dense = _everywhere(HDL64, draw)
    for shape, name, each_of in ((VLP16, "16 x 900", clouds), (HDL64, "64 x 512", [dense] * len(clouds))):
        took_ms: dict[str, list[float]] = {}
        for _ in range(rounds):
            for cloud in each_of:
                at_s = [time.perf_counter()]
                image = project(cloud, shape)
                at_s.append(time.perf_counter())
                segmenter.segment(image)
                at_s.append(time.perf_counter())
                standing(image, shape)
                at_s.append(time.perf_counter())
                parts_ms = [1e3 * (end - begin) for begin, end in itertools.pairwise(at_s)]
                for part, cost_ms in zip(("projection", "network", "detector"), parts_ms, strict=True):
                    took_ms.setdefault(part, []).append(cost_ms)
                took_ms.setdefault("projection and network", []).append(parts_ms[0] + parts_ms[1])
        for part, costs_ms in took_ms.items():
            costs_ms.sort()
            p50_ms, p99_ms = percentile(costs_ms, 0.5), percentile(costs_ms, 0.99)
            report.row(f"a scan of {name} on one core", part, p50_ms=p50_ms, p99_ms=p99_ms)
            if shape is VLP16 and part == "projection and network":
                report.reach("projection and network, 16 x 900, p50, ms", p50_ms, 40)


def _everywhere(shape: ImageShape, draw: np.random.Generator) -> NDArray[np.float64]:
    """A point in each pixel, (rows * columns, 4), at any range."""
    elevations = np.linspace(shape.high_rad, shape.low_rad, shape.rows)[:, None]
    bearings = math.pi - np.arange(shape.columns) / shape.columns * math.tau
    x, y, z = np.broadcast_arrays(
        np.cos(elevations) * np.cos(bearings), np.cos(elevations) * np.sin(bearings), np.sin(elevations)
    )
    ranges_m = draw.uniform(1.0, 30.0, x.shape)
    found: NDArray[np.float64] = np.stack((x * ranges_m, y * ranges_m, z * ranges_m, 100 * draw.random(x.shape)), -1)
    return found.reshape(-1, 4)


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


def _ground(masks: list[NDArray[np.bool_]], labels: NDArray[np.uint8], channels: NDArray[np.float32]) -> float:
    """The share of near ground that is called an obstacle, in per cent."""
    near = (labels == PointClass.GROUND) & (channels[:, 4] < NEAR_M)
    return 100 * float(np.array(masks)[near].mean())


if __name__ == "__main__":
    sys.exit(main("perception", bench, description=__doc__))
