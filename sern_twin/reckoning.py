"""When a robot is to send its pose: when the twin would otherwise be wrong (dead reckoning as IEEE 1278.1 has it), and
not on a timer."""

import math
from dataclasses import dataclass

from sern_core.vocabulary.errors import UsageError
from sern_twin.motion import Motion
from sern_twin.predictors import Predictor


@dataclass(frozen=True, slots=True)
class ReckoningOptions:
    """UsageError: a number that is not above 0."""

    error_m: float = 0.02
    error_rad: float = math.radians(1.0)
    silence_s: float = 0.2
    """It is sent at least so often: what was lost is not missed for longer, and the twin sees that it is there."""
    step_s: float = 0.02

    def __post_init__(self) -> None:
        for name in self.__slots__:
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise UsageError(f"dead reckoning: {name} is {value}: give a number above 0")


class Reckoner:
    """Runs the twin's predictor at the robot, from what was sent last. The predictor is the same at both ends."""

    def __init__(self, predictor: Predictor, options: ReckoningOptions | None = None) -> None:
        self._options = options or ReckoningOptions()
        self._predictor = predictor
        self._sent_s = -math.inf
        self._time_s = -math.inf
        self._twin: Motion | None = None

    def due(self, motion: Motion, *, now: float) -> bool:
        """Whether to send this motion of now. If so, it counts as sent. One that is not finite never is."""
        if not motion.finite:
            return False
        twin = self._predict(now)
        options = self._options
        if (
            twin is None
            or now < self._sent_s
            or now - self._sent_s >= options.silence_s - 1e-9
            or twin.distance_m(motion) > options.error_m
            or abs(twin.turn_rad(motion)) > options.error_rad
        ):
            self._sent_s = self._time_s = now
            self._twin = motion
            return True
        return False

    def _predict(self, now: float) -> Motion | None:
        while self._twin is not None and now - self._time_s > 1e-9:
            part_s = min(self._options.step_s, now - self._time_s)
            self._twin = self._predictor.advance(self._twin, self._time_s, part_s, heard_s=self._sent_s)
            self._time_s += part_s
        return self._twin
