"""What a robot tries that is stuck, one thing after the other: the recoveries of Nav2's default behaviour tree."""

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np

from sern_core.vocabulary.errors import UsageError
from sern_navigation.costmap.costs import INSCRIBED_INFLATED_OBSTACLE, LETHAL_OBSTACLE, Costmap
from sern_navigation.costmap.escape import escaping
from sern_twin.world.occupancy import Pose

Speed = tuple[float, float]

_STILL: Final = (0.0, 0.0)


class Behaviour(StrEnum):
    """What is tried, in the order of Nav2's round robin."""

    CLEAR_COSTMAP = "clear_costmap"
    SPIN = "spin"
    WAIT = "wait"
    BACK_UP = "back_up"


ORDER: Final = tuple(Behaviour)


@dataclass(frozen=True, slots=True)
class RecoveryOptions:
    """UsageError: a number that is negative or not finite."""

    number_of_retries: int = 6
    """After so many the goal is given up."""
    spin_dist: float = 1.57
    """[rad]"""
    max_rotational_vel: float = 1.0
    min_rotational_vel: float = 0.4
    rotational_acc_lim: float = 3.2
    wait_duration: float = 5.0
    """[s]"""
    backup_dist: float = 0.30
    """[m]"""
    backup_speed: float = 0.15
    time_allowance: float = 10.0
    """[s]: for each spin and each back-up."""
    simulate_ahead_time: float = 2.0
    """[s]: how far ahead a back-up looks."""

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise UsageError(f"recovery with {name} {value}: give a number of 0 or more")
        if not 0 < self.min_rotational_vel <= self.max_rotational_vel:
            raise UsageError("recovery: 0 < min_rotational_vel <= max_rotational_vel")


class Progress(StrEnum):
    RUNNING = "running"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    """It took too long, or something is in the way."""


class Recovery:
    """`begin` the next behaviour, then `step` until it does not run any more."""

    def __init__(self, options: RecoveryOptions | None = None) -> None:
        self.options: Final = options or RecoveryOptions()
        self.begun = 0
        """How many behaviours there were for this goal."""
        self.behaviour: Behaviour = ORDER[0]
        self._since_s = 0.0
        self._from: Pose = (0.0, 0.0, 0.0)
        self._turned_rad = 0.0
        self._yaw_rad = 0.0

    def reset(self) -> None:
        """There is a new goal."""
        self.begun = 0

    @property
    def exhausted(self) -> bool:
        return self.begun >= self.options.number_of_retries

    def begin(self, now_s: float, pose: Pose) -> Behaviour:
        """The next behaviour. Whoever calls clears the costmap if that is it."""
        self.behaviour = ORDER[self.begun % len(ORDER)]
        self.begun += 1
        self._since_s, self._from, self._yaw_rad, self._turned_rad = now_s, pose, pose[2], 0.0
        return self.behaviour

    def step(self, now_s: float, pose: Pose, costmap: Costmap | None) -> tuple[Progress, Speed]:
        """Whether it goes on, and the command. None: the robot is not on the map, so it does not back up."""
        match self.behaviour:
            case Behaviour.CLEAR_COSTMAP:
                return Progress.SUCCEEDED, _STILL
            case Behaviour.WAIT:
                waits = now_s - self._since_s < self.options.wait_duration
                return Progress.RUNNING if waits else Progress.SUCCEEDED, _STILL
            case Behaviour.SPIN:
                return self._spin(now_s, pose)
            case Behaviour.BACK_UP:
                return self._back_up(now_s, pose, costmap)

    def _spin(self, now_s: float, pose: Pose) -> tuple[Progress, Speed]:
        """Turn in place: a round robot meets nothing."""
        options = self.options
        self._turned_rad += math.remainder(pose[2] - self._yaw_rad, 2 * math.pi)
        self._yaw_rad = pose[2]
        left_rad = options.spin_dist - self._turned_rad
        if left_rad <= 0:
            return Progress.SUCCEEDED, _STILL
        if now_s - self._since_s > options.time_allowance:
            return Progress.FAILED, _STILL
        rate = math.sqrt(2 * options.rotational_acc_lim * left_rad)
        return Progress.RUNNING, (0.0, min(max(rate, options.min_rotational_vel), options.max_rotational_vel))

    def _back_up(self, now_s: float, pose: Pose, costmap: Costmap | None) -> tuple[Progress, Speed]:
        options = self.options
        left_m = options.backup_dist - math.dist(pose[:2], self._from[:2])
        if left_m <= 0:
            return Progress.SUCCEEDED, _STILL
        if now_s - self._since_s > options.time_allowance or costmap is None:
            return Progress.FAILED, _STILL
        ahead_m = min(options.backup_speed * options.simulate_ahead_time, left_m)
        places = np.linspace(0.0, -ahead_m, 2 + math.ceil(ahead_m / costmap.grid.cell_m))[1:, None]
        costs = escaping(costmap, pose).at(places * [math.cos(pose[2]), math.sin(pose[2])] + pose[:2])
        if ((costs == LETHAL_OBSTACLE) | (costs == INSCRIBED_INFLATED_OBSTACLE)).any():
            return Progress.FAILED, _STILL
        return Progress.RUNNING, (-options.backup_speed, 0.0)
