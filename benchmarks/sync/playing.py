"""The twin of what was heard, with one predictor or another, against where the robot was."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from benchmarks.sync.recording import Heard, Recording
from sern_sim.robot import STEP_S
from sern_twin.following import Following
from sern_twin.motion import STILL, Motion
from sern_twin.predictors import (
    Command,
    ConstantAcceleration,
    ConstantTwist,
    LastCommand,
    PlanTracking,
    Predictor,
)
from sern_twin.slip import Slip
from sern_twin.synchroniser import Gap, Synchroniser, SynchroniserOptions, Twin
from sern_twin.way import PathTracking
from sern_twin.way import Way as Path

LEARNS_S: Final = 2.0
"""How often what was learned goes into the predictor."""


class Hold(Predictor):
    """It stands where it was heard last: what is shown follows by correction alone."""

    def advance(self, motion: Motion, start_s: float, step_s: float, *, heard_s: float) -> Motion:
        return Motion(motion.x_m, motion.y_m, motion.yaw_rad, STILL)


class Way(NamedTuple):
    """A way to go on: `predictor` is asked from time to time, for what to go on with if nothing is heard any more."""

    hear: Callable[[Heard], None]
    predictor: Callable[[], Predictor]
    changed: Callable[[], object] = lambda: None
    """Another value than before: what it goes on with is another from now."""


def _nothing(_heard: Heard) -> None:
    """Learns nothing."""


def ways(recording: Recording) -> dict[str, Way]:
    """Each predictor that there is, with what it may know of this run."""
    following = Following(recording.way)
    slip = Slip()
    last: list[Heard] = []
    step_s = (recording.way.end_s - recording.way.start_s) / 200
    points = [recording.way.at(recording.way.start_s + number * step_s) for number in range(201)]
    path = Path([(point.x_m, point.y_m) for point in points])

    def learn(heard: Heard) -> None:
        if last:
            length_s = heard.stamp_s - last[-1].stamp_s
            if 0 < length_s < 0.2:
                slip.learn(heard.told, heard.found.twist, length_s)
        remember(heard)

    def remember(heard: Heard) -> None:
        last.append(heard)
        del last[:-50]

    def along() -> Predictor:
        if not last or not path.followed_by(last[-1].found):
            return ConstantAcceleration()
        return PathTracking(path, sum(heard.found.speed_mps for heard in last) / len(last))

    def told() -> Predictor:
        return LastCommand(Command(last[-1].stamp_s, last[-1].told), slip) if last else ConstantTwist()

    return {
        "shared trajectory": Way(
            lambda heard: following.heard(heard.stamp_s, heard.found),
            lambda: PlanTracking(recording.way, delay_s=following.delay_s) if following.follows else ConstantTwist(),
            lambda: following.follows,
        ),
        "shared path": Way(remember, along),
        "last command": Way(learn, told),
        "constant twist": Way(_nothing, ConstantTwist),
        "constant acceleration": Way(_nothing, ConstantAcceleration),
        "no prediction": Way(_nothing, Hold),
    }


@dataclass
class Played:
    """One entry a step of the truth."""

    twins: list[Twin | None] = field(default_factory=list)
    gaps: list[tuple[float, Gap]] = field(default_factory=list)
    snaps: int = 0
    corrections_mps: list[float] = field(default_factory=list)


def play(recording: Recording, way: Way, options: SynchroniserOptions | None = None) -> Played:
    twin = Synchroniser(way.predictor(), options)
    made = Played()
    heard = iter(recording.heard)
    coming = next(heard, None)
    learned_s, kind = 0.0, way.changed()
    for step in range(len(recording.truth)):
        now = step * STEP_S
        while coming is not None and coming.at_s <= now:
            _, gap = twin.measured(coming.stamp_s, coming.found, now=coming.at_s)
            way.hear(coming)
            if gap is not None:
                made.gaps.append((coming.at_s, gap))
            if coming.at_s >= learned_s or way.changed() != kind:
                kind = way.changed()
                twin.predict_with(way.predictor(), now=coming.at_s)
                learned_s = coming.at_s + LEARNS_S
            coming = next(heard, None)
        made.twins.append(twin.twin(now=now))
        made.corrections_mps.append(twin.correction_mps)
    made.snaps = twin.snaps
    return made


def errors(recording: Recording, played: Played, start_s: float, end_s: float) -> tuple[list[float], list[float]]:
    """Metres and degrees between what was shown in this time and where the robot was, one a step."""
    first, last = round(start_s / STEP_S), round(end_s / STEP_S)
    off_m, off_deg = [], []
    for truth, twin in zip(recording.truth[first:last], played.twins[first:last], strict=True):
        if twin is not None:
            off_m.append(truth.distance_m(twin.shown))
            off_deg.append(abs(math.degrees(truth.turn_rad(twin.shown))))
    return off_m, off_deg
