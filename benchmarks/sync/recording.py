"""What a site heard of a robot over a link, and where the robot was: the real core in virtual time."""

import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from random import Random
from typing import Final, NamedTuple

from benchmarks.sync.robot import Robot, Said
from sern_core.vocabulary.types import PriorityClass
from sern_sim.models import LinkModel
from sern_sim.robot import STEP_S
from sern_twin.motion import Motion, Twist
from sern_twin.trajectory import Trajectory
from tests.world import World, spec

POSE: Final = "/robot/odom"
BODY_BYTES: Final = 724
"""A nav_msgs/Odometry with its covariances, as CDR."""
_NUMBERS: Final = struct.Struct("<10d")
SETTLES_S: Final = 1.0
"""The robot begins to drive when the link is there."""


class Heard(NamedTuple):
    at_s: float
    stamp_s: float
    found: Motion
    told: Twist


@dataclass
class Recording:
    """All times are of the plan. `truth`: one a step."""

    way: Trajectory
    truth: list[Motion] = field(default_factory=list)
    heard: list[Heard] = field(default_factory=list)
    sent_bytes: int = 0
    sent: int = 0


def record(
    seed: int,
    way: Trajectory,
    length_s: float,
    there: LinkModel,
    *,
    stops_s: float | None = None,
    due: Callable[[Said], bool] = lambda _said: True,
) -> Recording:
    """A robot drives this way for so long, and says each step where it is, if that is due. `there`: its link to the
    relay; back it is the same."""
    world = World(seed, lossless=False)
    robot = world.client("robot", there)
    site = world.client("site", patterns=["/robot/.*"])
    pose = robot.publish(POSE, spec(PriorityClass.CONTROL))
    made = Recording(way)
    driver = Robot(Random(seed), way) if stops_s is None else Robot(Random(seed), way, stops_s=stops_s)
    start_s = world.network.now + SETTLES_S

    def step(_now: float) -> None:
        said = driver.step()
        made.truth.append(said.truth)
        if not due(said):
            return
        found, told = said.found, said.told
        twist = found.twist
        numbers = _NUMBERS.pack(
            said.time_s, found.x_m, found.y_m, found.yaw_rad, twist.forward_mps, twist.left_mps, twist.yaw_radps,
            found.forward_mps2, told.forward_mps, told.yaw_radps,
        )  # fmt: skip
        robot.send(pose, numbers + bytes(BODY_BYTES - len(numbers)))
        made.sent += 1
        made.sent_bytes += BODY_BYTES

    world.network.every(STEP_S, step, node=robot, first_s=SETTLES_S)
    world.run(SETTLES_S + length_s)
    for got in site.on(POSE):
        stamp_s, x_m, y_m, yaw, forward, left, rate, accel, told, turn = _NUMBERS.unpack_from(got.body)
        motion = Motion(x_m, y_m, yaw, Twist(forward, left, rate), accel)
        made.heard.append(Heard(got.at_s - start_s, stamp_s, motion, Twist(told, 0.0, turn)))
    return made
