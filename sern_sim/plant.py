"""What drives a simulated robot, and makes messages of it, needs of one: the unicycle in its yard, or MuJoCo."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sern_sim.robot import Inertial, RobotState


class Area(Protocol):
    """Where a robot drives: a square around the origin."""

    @property
    def half_size_m(self) -> float: ...

    def occupancy(self, cells: int) -> NDArray[np.int8]:
        """(cells, cells), row 0 at the south, column 0 at the west: 100 occupied, 0 free."""
        ...


class Plant(Protocol):
    """A robot that is stepped by `sern_sim.robot.STEP_S`. The same seed and the same calls give the same numbers."""

    @property
    def world(self) -> Area: ...

    @property
    def state(self) -> RobotState: ...

    @property
    def command(self) -> tuple[float, float]:
        """Speed m/s and yaw rate rad/s in force: as asked, unlimited."""
        ...

    @property
    def commanded(self) -> bool:
        """Whether it was ever told to drive."""
        ...

    @property
    def yaw_scale_known(self) -> float:
        """What its maker thinks that its base makes of a turn; what it does make of one differs."""
        ...

    def drive(self, speed_mps: float, yaw_rate_radps: float) -> None:
        """A velocity command, in force until the next. Not a finite number: ValueError."""
        ...

    def step(self) -> RobotState: ...

    def imu(self) -> Inertial: ...

    def scan(self, beams: int = ..., span_rad: float = ...) -> NDArray[np.float32]:
        """(beams,) ranges in metres from -span/2 to +span/2, inf where nothing is in range."""
        ...

    def cloud(self, points: int) -> NDArray[np.float32]:
        """(points, 4) x, y, z, intensity in the sensor frame, or (points, 5) with a label; a missing return is NaN."""
        ...

    def image(self, width: int, height: int) -> NDArray[np.uint8]:
        """(height, width, 3) RGB."""
        ...
