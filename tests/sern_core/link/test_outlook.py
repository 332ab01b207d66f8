"""Large messages that the link cannot carry within their lifespan: not begun, and begun again once it can."""

from random import Random

import pytest

from sern_core.vocabulary.codec_names import Compression
from sern_core.vocabulary.types import DropReason, PriorityClass
from sern_sim.models import LinkModel, RateStep
from tests.world import World, spec

POSE, SCAN, CAMERA, CLOUD = "/robot/pose", "/robot/scan", "/robot/camera", "/robot/points"
POSES_BPS = 25e3
"""What the poses take of the link, roughly."""


class Robot:
    """A robot with 12.5 poses a second, and large clouds of a second's lifespan, on a link of 25 ms each way."""

    def __init__(
        self,
        rate_bps: float,
        cloud_bytes: int,
        *steps: RateStep,
        reliable: bool = False,
        lossless: bool = False,
        encode_bytes_per_s: float | None = None,
    ) -> None:
        encoded = encode_bytes_per_s is not None
        self.world = World(lossless=lossless, compress=encoded, encode_bytes_per_s=encode_bytes_per_s)
        link = LinkModel(rate_bps=rate_bps, delay_s=0.025, rate_steps=steps)
        self.robot = self.world.client("robot", link, LinkModel(delay_s=0.025))
        self.site = self.world.client("site", patterns=["/robot/.*"])
        self.robot.every(0.08, self.robot.publish(POSE, spec(PriorityClass.CONTROL)), bytes(100))
        cloud = spec(
            PriorityClass.BULK,
            lifespan_s=None if reliable else 1.0,
            reliable=reliable,
            compression=Compression.LZ4 if encoded else Compression.NONE,
        )
        self.cloud = self.robot.publish(CLOUD, cloud)
        body = Random(1).randbytes(cloud_bytes) + bytes(cloud_bytes) if encoded else bytes(cloud_bytes)
        self.robot.every(0.1, self.cloud, body)

    def camera(self, priority: PriorityClass, rate_bps: float) -> None:
        """Images of 10 kB, offered at that rate, beside the clouds."""
        self.robot.every(
            8 * 10_000 / rate_bps, self.robot.publish(CAMERA, spec(priority, lifespan_s=1.0)), bytes(10_000)
        )

    def scans(self, every_s: float) -> None:
        """Scans of two fragments."""
        self.robot.every(every_s, self.robot.publish(SCAN, spec(PriorityClass.STATE)), bytes(2_000))

    def carried_bps(self, seconds: float) -> float:
        """What goes over the link in the next seconds."""
        link = self.world.hops["robot"].forward
        before = link.stats.carried_bytes
        self.world.run(seconds)
        return 8 * (link.stats.carried_bytes - before) / seconds

    def arrived(self, topic: str, seconds: float) -> int:
        """How many messages of a topic arrive in the next seconds."""
        before = len(self.site.on(topic))
        self.world.run(seconds)
        return len(self.site.on(topic)) - before

    @property
    def too_slow(self) -> int:
        return self.cloud.counters.by_reason[DropReason.TOO_SLOW]

    @property
    def probe_waits(self) -> bool:
        return self.cloud.probe_from_seq is not None

    @property
    def passed_over(self) -> int:
        return self.cloud.counters.by_reason[DropReason.SUPERSEDED]


def test_what_cannot_arrive_is_hardly_ever_begun() -> None:
    """2.4 s of a link, with a lifespan of one: nothing of it would ever arrive. It is tried now and then."""
    robot = Robot(1e6, 300_000)
    robot.world.run(10.0)
    assert robot.carried_bps(20.0) < POSES_BPS + 0.15 * 1e6
    assert robot.arrived(CLOUD, 1.0) == 0
    assert robot.cloud.counters.by_reason[DropReason.TOO_SLOW] > 200


def test_what_cannot_arrive_once_it_is_encoded_is_hardly_ever_begun() -> None:
    """Half of it is zeros. The codec takes it to its thread before anything of it leaves."""
    robot = Robot(1e6, 300_000, encode_bytes_per_s=60e6)
    robot.world.run(10.0)
    assert robot.carried_bps(20.0) < POSES_BPS + 0.15 * 1e6
    assert robot.too_slow > 200
    assert robot.cloud.codec is not None and robot.cloud.codec.ratio < 0.6


def test_what_can_arrive_has_the_link_instead() -> None:
    """Images of half the link's rate beside: all arrive, as fresh as without clouds."""
    robot = Robot(1e6, 300_000)
    robot.camera(PriorityClass.BULK, 0.5e6)
    robot.world.run(10.0)
    assert robot.carried_bps(20.0) < POSES_BPS + 1.1 * 0.5e6 + 0.2 * 1e6, "a try is given up all the same"
    assert robot.arrived(CAMERA, 20.0) >= 20.0 * 0.5e6 / 80_000 - 2
    assert robot.too_slow > 200


def test_a_full_link_is_not_tried() -> None:
    """More images than it carries: how fast it is shows by itself."""
    robot = Robot(2e6, 600_000)
    robot.camera(PriorityClass.STATE, 4e6)
    robot.world.run(10.0)
    assert not robot.cloud.flying
    before = robot.passed_over
    assert robot.arrived(CAMERA, 10.0) * 80_000 / 10.0 > 0.8 * 2e6
    assert robot.passed_over == before, "none waits behind one that is tried"


def test_a_probe_is_begun_whatever_else_fills_the_link() -> None:
    robot = Robot(2e6, 600_000)
    robot.camera(PriorityClass.STATE, 4e6)
    robot.world.run(10.0)
    assert not robot.cloud.flying
    robot.cloud.probe_from_seq = robot.cloud.next_seq
    robot.world.run(1.0)
    assert not robot.probe_waits, "one was begun"
    robot.world.run(2.0)
    assert not robot.cloud.flying, "and no other one"


def test_what_more_urgent_classes_leave_is_what_counts() -> None:
    """0.6 s of the whole link, and a link of which half is taken."""
    robot = Robot(1e6, 75_000)
    robot.world.run(5.0)
    assert robot.arrived(CLOUD, 10.0) > 10
    robot.camera(PriorityClass.STATE, 0.6e6)
    robot.world.run(5.0)
    before = robot.too_slow
    assert robot.arrived(CLOUD, 10.0) == 0
    assert robot.too_slow > before + 50


@pytest.mark.parametrize("rate_bps", [1e6, 2.5e6])
def test_what_can_arrive_is_never_held_back(rate_bps: float) -> None:
    robot = Robot(rate_bps, int(0.7 * rate_bps / 8))
    robot.world.run(20.0)
    assert robot.too_slow == 0
    assert len(robot.site.on(CLOUD)) > 20


def test_a_link_that_got_faster_is_found_out() -> None:
    robot = Robot(0.25e6, 150_000, RateStep(20.0, 2.5e6))
    robot.world.run(20.0)
    assert robot.site.on(CLOUD) == []
    robot.world.run(6.0)
    assert robot.arrived(CLOUD, 4.0) >= 6


@pytest.mark.parametrize("every_s", [0.1, 0.3])
@pytest.mark.parametrize("lossless", [False, True])
def test_a_faster_link_is_found_beside_messages_of_a_few_fragments(every_s: float, *, lossless: bool) -> None:
    """They wait for the pacer for a moment, and so does what comes behind them: that is no full link."""
    robot = Robot(0.3e6, 100_000, RateStep(20.0, 40e6), lossless=lossless)
    robot.scans(every_s)
    robot.world.run(20.0)
    before = len(robot.site.on(CLOUD))
    robot.world.run(6.0)
    assert len(robot.site.on(CLOUD)) > before
    assert robot.arrived(CLOUD, 4.0) >= 30


def test_a_link_that_faded_and_came_back_is_used_at_once() -> None:
    robot = Robot(5e6, 200_000, RateStep(10.0, 0.5e6), RateStep(12.0, 5e6))
    robot.world.run(12.0)
    assert robot.arrived(CLOUD, 3.0) >= 5


def test_reliable_and_small_messages_go_as_long_as_they_take() -> None:
    robot = Robot(1e6, 300_000, reliable=True)
    robot.world.run(20.0)
    assert robot.too_slow == 0 and len(robot.site.on(CLOUD)) >= 5
    thin = Robot(50e3, 9_000)
    thin.world.run(20.0)
    assert thin.too_slow == 0
