"""Traffic and links of the adaptation benchmark: what a robot offers, and what happens to its link."""

from collections.abc import Callable
from dataclasses import dataclass
from random import Random
from typing import Final

from benchmarks.mmcf_queue import Path, Topic
from sern_core.adaptation.predict import Grid
from sern_core.bodies.codecs import CodecProfile
from sern_core.vocabulary.types import PriorityClass

CODECS: Final = ("lz4", "zstd", "draco")
NEEDED: Final = {PriorityClass.CONTROL: 1.0, PriorityClass.STATE: 1.0, PriorityClass.BULK: 0.4}

_STATE = {
    "lz4": CodecProfile(0.45, 300e6),
    "zstd": CodecProfile(0.30, 60e6),
    "draco": CodecProfile(0.30, 60e6),
}
_CLOUD = {
    "lz4": CodecProfile(0.85, 300e6),
    "zstd": CodecProfile(0.70, 50e6),
    "draco": CodecProfile(0.22, 12e6),
}
_IMAGE = {
    "lz4": CodecProfile(1.0, 400e6),
    "zstd": CodecProfile(0.98, 80e6),
    "draco": CodecProfile(0.98, 80e6),
}


def robot(prefix: str = "", *, from_s: float = 0.0, until_s: float = float("inf")) -> list[Topic]:
    """Pose and joints, scan and costmap, cloud and camera: 3.9 Mbit/s uncompressed."""
    control, state, bulk = PriorityClass.CONTROL, PriorityClass.STATE, PriorityClass.BULK
    return [
        Topic(f"{prefix}/pose", control, 0.02, 120.0, 0.4, 0.0, {}, from_s, until_s),
        Topic(f"{prefix}/joints", control, 0.05, 200.0, 0.4, 0.0, {}, from_s, until_s),
        Topic(f"{prefix}/scan", state, 0.1, 2200.0, 0.5, 0.1, _STATE, from_s, until_s),
        Topic(f"{prefix}/costmap", state, 0.5, 12000.0, 0.5, 0.3, _STATE, from_s, until_s),
        Topic(f"{prefix}/points", bulk, 0.2, 60000.0, 1.0, 0.15, _CLOUD, from_s, until_s),
        Topic(f"{prefix}/image", bulk, 0.2, 25000.0, 1.0, 0.15, _IMAGE, from_s, until_s),
    ]


GRID: Final = Grid.of(
    rates=[(1.0,), (1.0, 0.5), (1.0, 0.6, 0.4, 0.25, 0.1)],
    queues=[(1,), (1,), (1, 3)],
    codecs=("none", *CODECS),
    redundancy=(0, 1),
)
"""160 configurations."""


@dataclass(frozen=True)
class Trace:
    name: str
    topics: list[Topic]
    path: Path
    duration_s: float = 60.0
    steps: tuple[tuple[float, bool], ...] = ()  # (when, whether the rate rises) of the steps whose settling is measured


def _wave(high_bps: float, low_bps: float, period_s: float, duration_s: float) -> tuple[tuple[float, float], ...]:
    half_s = period_s / 2.0
    return tuple((i * half_s, low_bps if i % 2 else high_bps) for i in range(int(duration_s / half_s) + 1))


def _fades(seed: int, duration_s: float) -> tuple[tuple[float, float], ...]:
    """A slow random walk between 1 and 6 Mbit/s with fades to 50–300 kbit/s of 2–6 s."""
    random = Random(f"fades {seed}")
    steps, t, level = [], 0.0, 3.0
    while t < duration_s:
        if random.random() < 0.12:
            steps.append((t, random.uniform(0.05e6, 0.3e6)))
            t += random.uniform(2.0, 6.0)
        else:
            level = min(6.0, max(1.0, level * random.uniform(0.75, 1.33)))
            steps.append((t, level * 1e6))
            t += random.uniform(1.0, 3.0)
    return tuple(steps)


def _triangle(t: float, duration_s: float) -> float:
    """0 at both ends, 1 in the middle."""
    return 1.0 - abs(2.0 * t / duration_s - 1.0)


def traces(seed: int) -> list[Trace]:
    """Every trace the figures are of."""
    steady = ((0.0, 4e6),)
    loss: Callable[[float], float] = lambda t: 0.10 * _triangle(t, 60.0)  # noqa: E731
    rtt: Callable[[float], float] = lambda t: 0.01 * 60.0 ** _triangle(t, 60.0)  # noqa: E731
    slow: Callable[[float], float] = lambda t: 10.0 if 20.0 <= t < 40.0 else 1.0  # noqa: E731
    return [
        Trace("step", robot(), Path(((0.0, 4e6), (20.0, 0.6e6), (40.0, 4e6))), 60.0, ((20.0, False), (40.0, True))),
        Trace("wave", robot(), Path(_wave(4e6, 0.6e6, 3.0, 60.0))),
        Trace("fades", robot(), Path(_fades(seed, 60.0))),
        Trace("loss", robot(), Path(steady, loss=loss)),
        Trace("rtt", robot(), Path(steady, rtt_s=rtt)),
        Trace("throttle", robot(), Path(steady, slowdown=slow)),
        Trace("newcomer", robot() + robot("/second", from_s=20.0, until_s=40.0), Path(((0.0, 2e6),))),
    ]
