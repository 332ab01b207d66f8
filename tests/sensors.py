"""Sensors of today over Wi-Fi: a 2-D scan, a camera and a depth camera's clouds, on a link that carries a part of it.

The link is that of Arm's study "Tune Zenoh for ROS 2". Clouds are 7.4 MB at 12 Hz, 710 Mbit/s of 25: not one would
arrive within a second. Here it is played in virtual time with the real core; `benchmarks.link` has it with the
installed daemons over `tc netem`.
"""

from dataclasses import replace
from itertools import pairwise
from typing import Final, NamedTuple

from benchmarks.sensors import WIFI
from sern_core.site.fit import Fit
from sern_core.stream.out_channel import OutChannel
from sern_core.summaries.spec import SummaryLevel
from sern_core.vocabulary.types import PriorityClass
from sern_sim.models import RateStep
from tests.world import Got, SimClient, World, spec

SCAN, CAMERA, CLOUD = "/robot/scan", "/robot/camera", "/robot/points"
RATES_HZ: Final = {SCAN: 8.0, CAMERA: 11.9, CLOUD: 12.0}
SCAN_BYTES: Final = 8_700
"""1,080 beams with intensities."""
JPEG_BYTES: Final = 60_000
"""640 x 480 at quality 75, of a scene with much in it."""
CLOUD_BYTES: Final = 7_372_880
"""640 x 480 points of 24 bytes."""
THIN_BYTES: Final = 40_000
"""What is left of it at a point in 0.2 m, roughly."""
LIFESPAN_S: Final = 1.0
SETTLED_S: Final = 3.0
"""Nobody knows what a link carries before something has gone over it."""


class FittedTopic:
    """A topic whose messages are so large, and whose summary so; sent as a client sends `level: auto`, `in_place`."""

    def __init__(self, robot: SimClient, topic: str, whole_bytes: int, thin_bytes: int, rate_hz: float) -> None:
        self.channel: OutChannel = robot.publish(topic, spec(PriorityClass.BULK, lifespan_s=LIFESPAN_S))
        self.fit = Fit(self.channel)
        self.levels: list[tuple[float, SummaryLevel]] = []
        """When each level began."""
        self._robot = robot
        self._whole, self._thin = bytes(whole_bytes), bytes(thin_bytes)
        robot.world.network.every(1.0 / rate_hz, self._tick, node=robot)

    def _tick(self, _now: float) -> None:
        before = self.fit.level
        level = self.fit.choose(self._robot.now, self._robot.core.link.lane.estimator.rate_bps)
        if self.fit.level is not before:
            self.levels.append((self._robot.world.network.now, self.fit.level))
            self._robot.core.level_changed(self.channel, self.fit.level, now=self._robot.now)
        if level is SummaryLevel.RAW:
            self.fit.sent(self.channel.next_seq, len(self._whole))
        self._robot.send(self.channel, self._whole if level is SummaryLevel.RAW else self._thin)


class Sensors:
    """A robot with those sensors at the near end of the link, and a site beside the relay."""

    def __init__(self, *steps: RateStep, seed: int = 1) -> None:
        self.world = World(lossless=False, seed=seed)
        self.robot = self.world.client("robot", replace(WIFI, rate_steps=steps), WIFI)
        self.site = self.world.client("site", patterns=["/robot/.*"])
        self._every(SCAN, PriorityClass.STATE, SCAN_BYTES)
        self._every(CAMERA, PriorityClass.BULK, JPEG_BYTES)
        self.clouds = FittedTopic(self.robot, CLOUD, CLOUD_BYTES, THIN_BYTES, RATES_HZ[CLOUD])

    def _every(self, topic: str, priority: PriorityClass, nbytes: int) -> None:
        channel = self.robot.publish(topic, spec(priority, lifespan_s=LIFESPAN_S))
        self.robot.every(1.0 / RATES_HZ[topic], channel, bytes(nbytes))

    def arrived(self, seconds: float) -> "dict[str, Arrived]":
        """What arrives in the next seconds, by topic."""
        begun_s = self.world.network.now
        self.world.run(seconds)
        return {
            topic: Arrived(tuple(got for got in self.site.on(topic) if got.at_s >= begun_s), begun_s, seconds)
            for topic in RATES_HZ
        }


class Arrived(NamedTuple):
    """Messages of one topic over a while."""

    got: tuple[Got, ...]
    begun_s: float
    seconds: float

    @property
    def rate_hz(self) -> float:
        return len(self.got) / self.seconds

    @property
    def longest_gap_s(self) -> float:
        """Between two of them, or one and an end of the while."""
        times = [self.begun_s, *(got.at_s for got in self.got), self.begun_s + self.seconds]
        return max(later - earlier for earlier, later in pairwise(times))

    def age_s(self, share: float) -> float:
        """Quantile of the ages."""
        ages = sorted(got.age_s for got in self.got)
        return ages[min(int(share * len(ages)), len(ages) - 1)]
