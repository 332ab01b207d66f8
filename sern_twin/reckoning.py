"""When a robot is to send its pose: when the twin would otherwise be wrong (dead reckoning as IEEE 1278.1 has it), and
not on a timer."""

import math
from dataclasses import dataclass

from sern_core.vocabulary.errors import UsageError
from sern_twin.motion import Motion
from sern_twin.predictors import SOON_S, Predictor


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
        if not self._wrong(motion, now):
            return False
        self._sent_s = self._time_s = now
        self._twin = motion
        return True

    def _wrong(self, motion: Motion, now: float) -> bool:
        """Whether the twin would be wrong, or has not heard for too long. A clock that goes back is that, too."""
        options = self._options
        if self._twin is None or not 0.0 <= now - self._sent_s < options.silence_s - SOON_S:
            return True
        self._twin = self._predictor.reach(self._twin, self._time_s, now, options.step_s, heard_s=self._sent_s)
        self._time_s = max(self._time_s, now)
        return self._twin.distance_m(motion) > options.error_m or abs(self._twin.turn_rad(motion)) > options.error_rad
