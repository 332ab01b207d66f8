"""The place of a robot: its odometry between moments, and where that frame lies on the map, as its scans say."""

import math
from collections import deque
from typing import Final

from sern_client.navigation.hearing import HeardOdometry
from sern_twin.motion import MOST_M
from sern_twin.world.occupancy import Pose

KEPT: Final = 200
"""Messages of odometry that are kept: 4 s at 50 Hz."""
AHEAD_S: Final = 0.3
"""The speed of the last one is believed for so long; then nobody knows where the robot is."""


class Localiser:
    """`start`: where the odometry's frame lies on the map at first."""

    def __init__(self, start: Pose = (0.0, 0.0, 0.0)) -> None:
        self._kept: deque[HeardOdometry] = deque(maxlen=KEPT)
        self.frame: Pose = start
        """The origin of the odometry's frame on the map."""

    @property
    def last(self) -> HeardOdometry | None:
        return self._kept[-1] if self._kept else None

    def heard(self, said: HeardOdometry) -> bool:
        """Take odometry, in order of its stamps. False: it is no place, and is left out."""
        x_m, y_m, yaw_rad = said.pose
        if not (abs(x_m) <= MOST_M and abs(y_m) <= MOST_M and math.isfinite(yaw_rad)):
            return False
        if self._kept and said.stamp_ns <= self._kept[-1].stamp_ns:
            if said.stamp_ns > self._kept[-1].stamp_ns - 10**9:
                return True  # a moment late: what is newer is there already
            self._kept.clear()  # its clock was set back
        self._kept.append(said)
        return True

    def odometry_at(self, stamp_ns: int) -> Pose | None:
        """The robot's place in the odometry's frame at a moment; None: nothing near it is known."""
        if not self._kept:
            return None
        last = self._kept[-1]
        since_s = (stamp_ns - last.stamp_ns) / 1e9
        if since_s >= 0:
            return _ahead(last, since_s) if since_s <= AHEAD_S else None
        after = last
        for before in reversed(self._kept):
            if before.stamp_ns <= stamp_ns:
                if (after.stamp_ns - before.stamp_ns) / 1e9 > 2 * AHEAD_S:
                    return None
                share = (stamp_ns - before.stamp_ns) / max(1, after.stamp_ns - before.stamp_ns)
                return _between(before.pose, after.pose, share)
            after = before
        return None

    def at(self, stamp_ns: int) -> Pose | None:
        """The robot's place on the map at a moment; None as above."""
        found = self.odometry_at(stamp_ns)
        return None if found is None else placed(self.frame, found)

    def fits(self, pose: Pose, stamp_ns: int) -> None:
        """The robot was there on the map: the odometry's frame lies so."""
        found = self.odometry_at(stamp_ns)
        if found is not None:
            self.frame = placed(pose, inverse(found))


def placed(frame: Pose, pose: Pose) -> Pose:
    """A pose that is said in a frame, where that frame is."""
    cos, sin = math.cos(frame[2]), math.sin(frame[2])
    return (
        frame[0] + cos * pose[0] - sin * pose[1],
        frame[1] + sin * pose[0] + cos * pose[1],
        math.remainder(frame[2] + pose[2], math.tau),
    )


def inverse(pose: Pose) -> Pose:
    """The origin as the pose has it."""
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    return -cos * pose[0] - sin * pose[1], sin * pose[0] - cos * pose[1], -pose[2]


def _between(one: Pose, other: Pose, share: float) -> Pose:
    return (
        one[0] + share * (other[0] - one[0]),
        one[1] + share * (other[1] - one[1]),
        one[2] + share * math.remainder(other[2] - one[2], math.tau),
    )


def _ahead(last: HeardOdometry, for_s: float) -> Pose:
    forward, turning = last.speed
    if not (math.isfinite(forward) and math.isfinite(turning)):
        return last.pose
    yaw_rad = last.pose[2] + turning * for_s / 2
    return (
        last.pose[0] + forward * for_s * math.cos(yaw_rad),
        last.pose[1] + forward * for_s * math.sin(yaw_rad),
        last.pose[2] + turning * for_s,
    )
