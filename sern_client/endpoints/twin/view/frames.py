"""What is to be seen of all robots at one moment: as last heard, as shown, where they go, and how sure that is."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sern_client.endpoints.twin.options import FrameOrigin
from sern_client.endpoints.twin.robot import RobotTwin
from sern_twin.motion import Motion
from sern_twin.synchroniser import Twin

OK: Final = 0
WARN: Final = 1
ERROR: Final = 2
STALE: Final = 3
"""Levels of diagnostic_msgs/DiagnosticStatus."""
_ROBOT_BYTES: Final = 640
_SNAPSHOT_BYTES: Final = 256
"""What their Python objects take, paths and texts aside; a test measures that it is not less than they do."""


@dataclass(frozen=True, slots=True)
class Place:
    """The place of a base in the frame of the site: east, north, height, and its heading from east to north."""

    x_m: float
    y_m: float
    z_m: float
    yaw_rad: float


class Box(NamedTuple):
    """Something that stands at the site. `x_m`, `y_m`: its middle. `age_s`: since it was changed; NaN: it is as the map
    of the site has it."""

    x_m: float
    y_m: float
    size_m: float
    height_m: float
    age_s: float


@dataclass(frozen=True, slots=True)
class RobotFrame:
    """`heard`: what the robot said last; `shown`: its twin now. Both None: it was not heard yet.

    `path_m`: (n, 2) float32, where it is going to be, east and north of `shown`. `error_m`: how far the robot may be
    from `shown`. `age_s`: of what was said last. `level`: as in diagnostic_msgs/DiagnosticStatus.
    """

    name: str
    frame_id: str
    heard: Place | None
    shown: Place | None
    path_m: NDArray[np.float32]
    error_m: float
    age_s: float
    level: int
    says: str

    @property
    def label(self) -> str:
        """What stands at the twin."""
        return f"{self.name}: {self.age_s:.2f} s old, error ≤ {self.error_m:.2f} m"


@dataclass(frozen=True, slots=True)
class Snapshot:
    """`link`: the state of the link in words, empty where nobody knows it."""

    time_s: float
    robots: tuple[RobotFrame, ...]
    link: str

    @property
    def size_bytes(self) -> int:
        """How much memory it takes, no less than it does."""
        texts = sum(4 * (len(robot.says) + len(robot.frame_id)) for robot in self.robots)
        paths = sum(robot.path_m.nbytes for robot in self.robots)
        return _SNAPSHOT_BYTES + 4 * len(self.link) + len(self.robots) * _ROBOT_BYTES + texts + paths


MOST_FRAME_CHARS: Final = 64
MOST_HEIGHT_M: Final = 1e5
"""Heights are passed on as they came, and may be anything."""
NO_PATH: Final[NDArray[np.float32]] = np.zeros((0, 2), np.float32)


def robot_frame(robot: RobotTwin, twin: Twin | None, path: Sequence[Motion], says: str, level: int) -> RobotFrame:
    """`path`: the shown twin from now on; `says`, `level`: its status in words."""
    name, frame = robot.options.name, robot.frame
    frame_id = frame.frame_id[:MOST_FRAME_CHARS]
    z_m = frame.z_m if abs(frame.z_m) <= MOST_HEIGHT_M else 0.0
    if twin is None:
        return RobotFrame(name, frame_id, None, None, NO_PATH, 0.0, 0.0, level, says)
    shown, heard, origin = twin.shown, robot.last_heard, robot.options.origin
    path_m = np.array([(step.x_m - shown.x_m, step.y_m - shown.y_m) for step in path], np.float64).reshape(-1, 2)
    return RobotFrame(
        name,
        frame_id,
        None if heard is None else _place(heard, z_m, origin),
        _place(shown, z_m, origin),
        (path_m @ _turn(origin.yaw_rad)).astype(np.float32),
        twin.error_m,
        twin.age_s,
        level,
        says,
    )


def _place(motion: Motion, z_m: float, origin: FrameOrigin) -> Place:
    x_m, y_m = (motion.x_m, motion.y_m) @ _turn(origin.yaw_rad)
    return Place(origin.x_m + float(x_m), origin.y_m + float(y_m), z_m, origin.yaw_rad + motion.yaw_rad)


def _turn(yaw_rad: float) -> NDArray[np.float64]:
    """Rows of places times it are in axes from which those of the places are turned so."""
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array([(cos, sin), (-sin, cos)])


def places(snapshot: Snapshot) -> Mapping[str, Place]:
    """Where the shown twins are, by robot."""
    return {robot.name: robot.shown for robot in snapshot.robots if robot.shown is not None}
