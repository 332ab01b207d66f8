"""How soon the map is right where the twin is wrong, as a scene corrects it, and what is told or cleared wrongly."""

from random import Random
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from benchmarks.common import Report, percentile
from benchmarks.link.figures import NEVER_S
from benchmarks.navigation.campus import GRID, YARD, campus, cells_of
from sern_sim.robot import LIDAR_RANGE_M, STEP_S, Pose2, RobotState, SimulatedJackal
from sern_twin.world.correction import corrected, map_cells
from sern_twin.world.discrepancy import LEAST_CELLS, RADIUS_CELLS, RANGE_M, Discrepancies, Discrepancy, DiscrepancyKind
from sern_twin.world.occupancy import Occupancy, Pose
from sern_twin.world.patches import FREE, OCCUPIED, UNKNOWN, Cells

PERIOD_S: Final = 0.1
WATCHED_S: Final = 20.0
STARTS: Final = 6
ACCURACY: Final = 0.8
CASE: Final = "where the twin is wrong"
CLEAR_M: Final = 2.0
BEAMS: Final = 720
NOISE_M: Final = 0.02
NOISE_RAD: Final = 0.009
POSE_ERROR_M: Final = 0.05
SLACK_M: Final = 0.3
"""What is told so near to a thing that is wrong is told rightly."""
_AROUND: Final = np.ones((3, 3), np.bool_)
Mask = NDArray[np.bool_]


class Watched(NamedTuple):
    """What came of one place: seconds from first sight to the map of each thing, by kind; inf: not by the end."""

    late_s: dict[DiscrepancyKind, list[float]]
    false_flags: int
    cleared_cells: int
    """Cells of real things that were cleared at the end."""


def corrections(seeds: int, report: Report) -> None:
    """A robot drives rounds at places of a campus whose twin, of which nothing is on the base map, is right in 8 of 10
    of its things, with a localisation that is off by 2 cm and half a degree."""
    late_s: dict[DiscrepancyKind, list[float]] = {kind: [] for kind in DiscrepancyKind}
    flags, cleared, hours = 0, 0, 0.0
    for seed, start in ((seed, start) for seed in range(seeds) for start in range(STARTS)):
        made = watched(seed, start, ACCURACY)
        for kind, times_s in made.late_s.items():
            late_s[kind] += times_s
        flags, cleared, hours = flags + made.false_flags, cleared + made.cleared_cells, hours + WATCHED_S / 3600
    for kind, what in (
        (DiscrepancyKind.PHANTOM, "a phantom is cleared on the map"),
        (DiscrepancyKind.UNKNOWN_OBSTACLE, "an unknown obstacle is on the map"),
    ):
        ordered = sorted(min(time_s, NEVER_S) for time_s in late_s[kind])
        if ordered:
            report.row(CASE, what, counted_things=len(ordered), median_s=percentile(ordered, 0.5),
                       p95_s=percentile(ordered, 0.95), most_s=ordered[-1])  # fmt: skip
            report.reach(f"{what} after it was first seen, p95, s", percentile(ordered, 0.95), 1.0)
    report.row(CASE, "told, and not so", flags_hour=flags / hours, driven_hours=hours, counted_cleared=cleared)
    report.reach("discrepancies that are none, an hour", flags / hours, 1.0)


def watched(seed: int, start: int, accuracy: float) -> Watched:
    """One of the places of a campus, for `WATCHED_S`."""
    found = campus(seed)
    random, noise = Random(seed * STARTS + start), Random(seed)
    robot = SimulatedJackal(random, world=found.world(), patrol=True)
    while robot.world.clearance_m(*(place_m := (random.uniform(-10, 10), random.uniform(-10, 10)))) < CLEAR_M:
        pass  # inside a building is clear too, and shows nothing of the campus
    robot.state = RobotState(pose=Pose2(*place_m, 0.0), odometry=Pose2(*place_m, 0.0))
    real, twin = cells_of((*YARD, *found.real)) == OCCUPIED, found.twin(accuracy)
    things = _Things(real, twin == OCCUPIED)
    world, occupancy = Discrepancies(GRID), Occupancy(GRID)
    base = np.full(GRID.shape, FREE, np.int8)
    added = np.where(twin == OCCUPIED, twin, np.int8(UNKNOWN))
    bearings = np.linspace(-np.pi, np.pi, BEAMS, endpoint=False)
    correction: Cells = np.full(GRID.shape, UNKNOWN, np.int8)
    while robot.state.time_s < WATCHED_S:
        time_s, pose = robot.state.time_s, robot.state.pose
        ranges_m = robot.world.cast(pose.x_m, pose.y_m, pose.yaw_rad + bearings).range_m
        said: Pose = (
            pose.x_m + noise.gauss(0, NOISE_M),
            pose.y_m + noise.gauss(0, NOISE_M),
            pose.yaw_rad + noise.gauss(0, NOISE_RAD),
        )
        sight = occupancy.fuse(said, bearings, np.where(ranges_m <= LIDAR_RANGE_M, ranges_m, np.inf), LIDAR_RANGE_M)
        world.saw(sight.free, sight.occupied, said[:2])
        things.told(world.compare(twin, now_s=time_s, pose_error_m=POSE_ERROR_M))
        correction = world.correction()
        near = np.hypot(*np.moveaxis(GRID.all_centres() - said[:2], -1, 0)) <= RANGE_M
        things.seen(sight.free & near, sight.occupied & near, time_s)
        things.mapped(map_cells(base, corrected(occupancy.classes(), correction), added), time_s)
        for _ in range(round(PERIOD_S / STEP_S)):
            robot.step()
    cleared = int(np.count_nonzero(real & (correction == FREE)))
    return Watched(things.late_s(), len(things.false), cleared)


class _Things:
    """What the twin has and is not there, and what is there and the twin does not have: when each was seen first, and
    when the map had it right. `LEAST_CELLS` of its cells make both."""

    def __init__(self, real: Mask, has: Mask) -> None:
        self._wrong = {DiscrepancyKind.PHANTOM: has & ~real, DiscrepancyKind.UNKNOWN_OBSTACLE: real & ~has}
        self._masks = {
            DiscrepancyKind.PHANTOM: _apart(has & ~real, real),
            # A surface lies between two cells, and rays end in both: the thing is also what touches it.
            DiscrepancyKind.UNKNOWN_OBSTACLE: [
                ndimage.binary_dilation(mask, _AROUND) & ~has for mask in _apart(real & ~has, has)
            ],
        }
        self._seen_s: dict[tuple[DiscrepancyKind, int], float] = {}
        self._right_s: dict[tuple[DiscrepancyKind, int], float] = {}
        self._known: set[int] = set()
        self.false: set[int] = set()

    def told(self, found: tuple[Discrepancy, ...]) -> None:
        for each in found:
            if each.number not in self._known:
                self._known.add(each.number)
                places = GRID.all_centres()[self._wrong[each.kind]]
                away_m = np.hypot(*(places - (each.east_m, each.north_m)).T)
                if not (away_m <= each.radius_m + SLACK_M).any():
                    self.false.add(each.number)

    def seen(self, free: Mask, occupied: Mask, time_s: float) -> None:
        self._first(DiscrepancyKind.PHANTOM, free, time_s, self._seen_s)
        self._first(DiscrepancyKind.UNKNOWN_OBSTACLE, occupied, time_s, self._seen_s)

    def mapped(self, cells: Cells, time_s: float) -> None:
        self._first(DiscrepancyKind.PHANTOM, cells == FREE, time_s, self._right_s)
        self._first(DiscrepancyKind.UNKNOWN_OBSTACLE, cells >= OCCUPIED, time_s, self._right_s)

    def late_s(self) -> dict[DiscrepancyKind, list[float]]:
        """The things that were seen."""
        found: dict[DiscrepancyKind, list[float]] = {kind: [] for kind in DiscrepancyKind}
        for key, seen_s in self._seen_s.items():
            found[key[0]].append(self._right_s.get(key, np.inf) - seen_s)
        return found

    def _first(
        self, kind: DiscrepancyKind, cells: Mask, time_s: float, into: dict[tuple[DiscrepancyKind, int], float]
    ) -> None:
        for number, mask in enumerate(self._masks[kind]):
            if (kind, number) not in into and np.count_nonzero(cells & mask) >= LEAST_CELLS:
                into[kind, number] = time_s


def _apart(mask: Mask, others: Mask) -> list[Mask]:
    """Each thing of a mask, as far as it is further than the match radius from what it could be taken for."""
    beyond = mask & (ndimage.distance_transform_edt(~others) > RADIUS_CELLS + 1)
    labels, count = ndimage.label(beyond, _AROUND)
    return [labels == number for number in range(1, count + 1)]
