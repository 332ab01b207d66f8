"""Poses that leave a site only when the twin of who receives them would be wrong without (sern_twin/reckoning.py)."""

import logging
from collections.abc import Callable

from sern_client.endpoints.base import Sink
from sern_client.endpoints.twin.bodies import read_pose
from sern_core.vocabulary.errors import BodyError
from sern_core.vocabulary.types import Encoding, TopicName
from sern_twin.acceleration import Accelerations
from sern_twin.predictors import ConstantAcceleration
from sern_twin.reckoning import Reckoner

_log = logging.getLogger(__name__)


class ReckonedPoses:
    """`sink` takes the nav_msgs/Odometry of one topic and passes on what is due. `kept`: called for every other one."""

    def __init__(self, name: TopicName, encoding: Encoding, sink: Sink, kept: Callable[[], None]) -> None:
        self._name = name
        self._encoding = encoding
        self._sink = sink
        self._kept = kept
        self._reckoner = Reckoner(ConstantAcceleration())
        self._accelerations = Accelerations()
        self._unreadable = False

    def sink(self, body: bytes, stamp_ns: int) -> bool:
        """What cannot be read, or is at no place, goes as it is: somebody else may know what to do with it."""
        try:
            pose = read_pose(body, self._encoding)
        except BodyError as error:
            if not self._unreadable:
                self._unreadable = True
                _log.warning("%s: no dead reckoning, such messages are sent as they are: %s", self._name, error)
            return self._sink(body, stamp_ns)
        stamp_s = pose.stamp_ns / 1e9
        motion = self._accelerations.of(stamp_s, pose.motion)
        if not motion.finite:
            return self._sink(body, stamp_ns)
        if not self._reckoner.due(motion, now=stamp_s):
            self._kept()
            return True
        self._accelerations.took(stamp_s, motion)
        return self._sink(body, stamp_ns)
