"""What a run amounts to, sensor by sensor: how often, how old, and the longest time without any."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.link.figures import NEVER_S
from benchmarks.sensors.bodies import HEIGHT, POINT, WIDTH, Sensor

SENSOR, NUMBER, STAMP, AT, SIZE = range(5)
WHOLE_BYTES = WIDTH * HEIGHT * POINT.itemsize
"""A smaller cloud is a summary."""


@dataclass(frozen=True)
class Outcome:
    """`offered` and `arrived` as `ends.COLUMNS` has it; counted is what was handed over, or arrived, from `begin_ns` to
    `end_ns`. A machine that is too busy offers less than it should."""

    system: str
    offered: NDArray[np.int64]
    arrived: NDArray[np.int64]
    begin_ns: int
    end_ns: int
    cpu_percent: dict[str, float]

    @property
    def seconds(self) -> float:
        return (self.end_ns - self.begin_ns) / 1e9

    def offered_hz(self, sensor: Sensor) -> float:
        stamps = self.offered[self.offered[:, SENSOR] == sensor][:, STAMP]
        return float(((stamps >= self.begin_ns) & (stamps < self.end_ns)).sum()) / self.seconds

    def of(self, sensor: Sensor) -> NDArray[np.int64]:
        rows = self.arrived[self.arrived[:, SENSOR] == sensor]
        found: NDArray[np.int64] = rows[(rows[:, AT] >= self.begin_ns) & (rows[:, AT] < self.end_ns)]
        return found


def metrics(outcome: Outcome, sensor: Sensor) -> dict[str, float]:
    """The row of a sensor. Only what is there: no ages of messages that never came."""
    rows = outcome.of(sensor)
    found = {"offered_hz": outcome.offered_hz(sensor), "delivered_hz": len(rows) / outcome.seconds}
    if sensor is Sensor.CLOUD:
        found["whole_hz"] = float((rows[:, SIZE] >= WHOLE_BYTES).sum()) / outcome.seconds
    ages_s = (rows[:, AT] - rows[:, STAMP]) / 1e9
    if len(ages_s):
        found |= {"age_p50_s": float(np.quantile(ages_s, 0.5)), "age_p99_s": float(np.quantile(ages_s, 0.99))}
    times = np.concatenate(([outcome.begin_ns], np.sort(rows[:, AT]), [outcome.end_ns]))
    found["longest_gap_s"] = float(np.diff(times).max()) / 1e9
    return found


def reaches(outcome: Outcome) -> list[tuple[str, float, float, bool]]:
    """What was set out: name, value, limit, and whether it is one from below."""
    scan, camera, cloud = (metrics(outcome, sensor) for sensor in Sensor)
    summaries_hz = cloud["delivered_hz"] - cloud["whole_hz"]
    return [
        ("scans a second", scan["delivered_hz"], 7.9, True),
        ("images a second", camera["delivered_hz"], 8.0, True),
        ("image's age, p99 [s]", camera.get("age_p99_s", NEVER_S), 0.5, False),
        ("clouds a second, or their summaries by 10", max(cloud["whole_hz"], summaries_hz / 10), 1.0, True),
    ]
