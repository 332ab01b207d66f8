"""The twin of one robot, as messages make it: poses, plans and times in, the twin out.

A robot's clock is never compared with ours. A message says when the robot's client took it, by the robot's clock, and
the link says how long ago that was; a stamp is as much older as it is before that. So the robot may think it is 1970.
"""

import logging
import math
from collections import Counter
from dataclasses import dataclass
from statistics import fmean
from typing import Final

from sern_client.endpoints.twin.bodies import Planned, Pose, Said
from sern_client.endpoints.twin.options import RobotOptions
from sern_core.vocabulary.errors import BodyError
from sern_twin.acceleration import Accelerations
from sern_twin.fixes import Fixes
from sern_twin.following import MOVES_MPS, Following
from sern_twin.geodesy import TangentPlane
from sern_twin.motion import Motion
from sern_twin.predictors import ConstantAcceleration, PlanTracking, Predictor
from sern_twin.synchroniser import JUMP_M, TAKEN, Gap, Outcome, Synchroniser, SynchroniserOptions, Twin
from sern_twin.trajectory import Trajectory, Waypoint
from sern_twin.way import PathTracking, Way

SITE_FRAME: Final = "map"
"""The frame of what satellites place."""
NO_FIX: Final = "no_fix"
JUMP_ERRORS: Final = 3.0
"""What is further off than so many times its error is a jump."""
LEARNS_S: Final = 2.0
"""How often what was learned of a plan goes into the prediction."""
SPEED_SAMPLES: Final = 50

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Frame:
    frame_id: str
    child_frame_id: str
    z_m: float


class RobotTwin:
    """`gaps` counts those that have ended, `violated` and `stops` those of them beyond their bound, and after which the
    robot stood and was to move; `refused` counts plans by why they are not used."""

    def __init__(self, options: RobotOptions) -> None:
        self.options = options
        self.frame = Frame("", "", 0.0)
        datum = options.datum
        self._fixes: Fixes | None = None
        if datum is not None:
            self._fixes = Fixes(TangentPlane.from_degrees(datum.latitude_deg, datum.longitude_deg, datum.height_m))
        self._without_fix = 0
        self.refused: Counter[str] = Counter()
        self.gaps = 0
        self.violated = 0
        self.stops = 0
        self._synchroniser = Synchroniser(
            ConstantAcceleration(),
            SynchroniserOptions(
                max_speed_mps=options.max_speed_mps,
                max_yaw_rate_radps=options.max_yaw_rate_radps,
                gap_s=options.gap_s,
                error_m=options.error_m,
                error_mps=options.error_mps,
                jump_m=max(JUMP_M, JUMP_ERRORS * options.error_m),
            ),
        )
        self._following: Following | None = None
        self._way: Way | None = None
        """A plan without times."""
        self._predictor: Predictor = ConstantAcceleration()
        self._learned_s = -math.inf
        self._followed = False
        self._accelerations = Accelerations()
        self._heard: list[tuple[float, Motion]] = []

    @property
    def counts(self) -> dict[str, int]:
        counts = {outcome.value: count for outcome, count in self._synchroniser.counts.items()}
        return counts if self._fixes is None else {**counts, NO_FIX: self._without_fix}

    @property
    def snaps(self) -> int:
        return self._synchroniser.snaps

    @property
    def goes_by(self) -> str:
        """What it goes on by while nothing is heard."""
        if not self._followed:
            return "acceleration"
        return "trajectory" if self._way is None else "path"

    @property
    def last_heard(self) -> Motion | None:
        """What the robot said last that was taken."""
        return self._heard[-1][1] if self._heard else None

    def twin(self, *, now: float) -> Twin | None:
        return self._synchroniser.twin(now=now)

    def ahead(self, start: Motion, steps: int, step_s: float, *, now: float) -> list[Motion]:
        """Where the twin is going to be, from `start` now on."""
        found = [start]
        for number in range(steps):
            begin_s = now + number * step_s
            found.append(self._predictor.reach(found[-1], begin_s, begin_s + step_s, 0.1, heard_s=now))
        return found

    def pose(self, pose: Pose, *, taken_ns: int, age_s: float, now: float) -> Outcome:
        """`taken_ns`: when the robot's client took the message, by its own clock, which is `age_s` ago."""
        stamp_s = now - age_s - (taken_ns - pose.stamp_ns) / 1e9
        motion = self._accelerations.of(stamp_s, pose.motion)
        outcome = self._measured(stamp_s, motion, Frame(pose.frame_id, pose.child_frame_id, pose.z_m), now)
        if outcome in TAKEN:
            self._accelerations.took(stamp_s, motion)
        return outcome

    def fix(self, said: Said, *, taken_ns: int, age_s: float, now: float) -> Outcome | None:
        """The same for what satellites say. None: they say nothing; that is counted."""
        if self._fixes is None or not said.fix.valid:
            self._without_fix += 1
            return None
        stamp_s = now - age_s - (taken_ns - said.stamp_ns) / 1e9
        motion, z_m = self._fixes.motion(stamp_s, said.fix)
        outcome = self._measured(stamp_s, motion, Frame(SITE_FRAME, said.frame_id, z_m), now)
        if outcome in TAKEN:
            self._fixes.took(stamp_s, motion, anew=outcome is not Outcome.TAKEN)
        return outcome

    def _measured(self, stamp_s: float, motion: Motion, frame: Frame, now: float) -> Outcome:
        outcome, gap = self._synchroniser.measured(stamp_s, motion, now=now)
        if gap is not None:
            self._report(gap)
        if outcome in TAKEN:
            if self.frame.frame_id not in ("", frame.frame_id):
                _log.warning(
                    "%s: %s is in frame %r now, and was in %r: a plan of the old frame is dropped",
                    self.options.name, self.options.pose, frame.frame_id, self.frame.frame_id,
                )  # fmt: skip
                self._drop_plan()
            self.frame = frame
            self._heard.append((stamp_s, motion))
            del self._heard[:-SPEED_SAMPLES]
            if self._following is not None:
                self._following.heard(stamp_s, motion)
            self._learn(now)
        return outcome

    def plan(self, plan: Planned, *, taken_ns: int, age_s: float, now: float) -> None:
        """A plan takes the place of the one before. BodyError: it cannot be used; the one before is dropped, too."""
        self._drop_plan()
        try:
            if self.frame.frame_id and plan.frame_id != self.frame.frame_id:
                self.refused["frame"] += 1
                raise BodyError(f"its frame is {plan.frame_id!r}, and that of the poses {self.frame.frame_id!r}")
            if len(plan.places) < 2:
                self.refused["short"] += 1
                raise BodyError(f"it has {len(plan.places)} poses: a plan has two at least")
            if plan.times_ns is None:
                try:
                    self._way = Way(plan.places)
                except BodyError:
                    self.refused["bad"] += 1
                    raise
                return
            base_s = now - age_s
            points = [
                Waypoint(base_s + (time_ns - taken_ns) / 1e9, x_m, y_m)
                for time_ns, (x_m, y_m) in zip(plan.times_ns, plan.places, strict=True)
            ]
            if points[-1].time_s <= now:
                self.refused["past"] += 1
                raise BodyError(f"it ended {now - points[-1].time_s:.1f} s ago")
            try:
                self._following = Following(Trajectory(points))
            except BodyError:
                self.refused["bad"] += 1
                raise
            for stamp_s, motion in self._heard:  # of a plan that goes on where the one before ended all is known
                self._following.heard(stamp_s, motion)
        finally:
            self._learned_s = -math.inf
            self._learn(now)

    def _drop_plan(self) -> None:
        self._following, self._way = None, None

    def _learn(self, now: float) -> None:
        """Take the best way to go on, from time to time, and at once when it is another."""
        follows = self._follows()
        if follows == self._followed and now - self._learned_s < LEARNS_S:
            return
        self._learned_s, self._followed = now, follows
        if follows and self._way is not None:
            self._predictor = PathTracking(self._way, fmean(motion.speed_mps for _, motion in self._heard))
        elif follows and self._following is not None:
            self._predictor = PlanTracking(self._following.plan, delay_s=self._following.delay_s)
        else:
            self._predictor = ConstantAcceleration()
        self._synchroniser.predict_with(self._predictor, now=now)

    def _follows(self) -> bool:
        """Whether it does what its plan says."""
        if self._way is None:
            return self._following is not None and self._following.follows
        last = self.last_heard
        return last is not None and last.speed_mps >= MOVES_MPS and self._way.followed_by(last)

    def _report(self, gap: Gap) -> None:
        report = gap.report
        self.gaps += 1
        self.stops += gap.stopped
        self.violated += report.violated
        if report.violated or gap.stopped:
            _log.warning(
                "%s: after %.1f s of silence it is %.2f m from where its twin was, bounded by %.2f m%s",
                self.options.name, report.gap_s, report.error_m, report.reachable_m,
                ": it stands, and was to move" if gap.stopped else "",
            )  # fmt: skip
