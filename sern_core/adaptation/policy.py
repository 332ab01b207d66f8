"""Who chooses the configuration: MMCF, and the policies it is measured against.

MMCF takes argmin of the predicted cost over the feasible candidates (the paper's eq. (mmcf_argmin)) every interval,
with hysteresis: it leaves the active configuration only for one that is clearly cheaper and after it has stood for a
few intervals, or at once when it has become infeasible.

The cost does not know what a summary leaves out (the paper defines no such term), so raw messages come first: a class
is summarised only where the cheapest configuration that sends it raw does not bring what is needed of it, and where the
summary costs less than GAIN_TO_SWITCH of that. Back it goes when raw fits with room to spare, whatever that costs.

Nor does the cost know what the mission cannot do without: of two classes it thins the one that pays better. So each
class has a floor, the share of its offered messages that must arrive in time. What stays below the floor of a class is
infeasible as long as something feasible keeps it; the floors of more urgent classes come first. It never asks for more
than the link can carry: where nothing keeps a floor, that floor does not count, and the cost decides.
"""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from sern_core.adaptation.cost import Ranges, Weights
from sern_core.adaptation.model import (
    NO_CODEC,
    Candidate,
    Configuration,
    LinkState,
    Measurement,
    Prediction,
    Situation,
)
from sern_core.adaptation.playback import CapacityPath
from sern_core.adaptation.predict import BELOW_FLOOR, PLANNED_SHARE, RAW_FIRST, Bounds, Grid, Predictions, Predictor
from sern_core.adaptation.queueing import Floats
from sern_core.adaptation.residuals import Residuals
from sern_core.vocabulary.errors import UsageError
from sern_core.vocabulary.types import CLASSES, PriorityClass

GAIN_TO_SWITCH: Final = 0.9
"""A new configuration must cost less than this share of the active one."""
SAME_COST: Final = 0.01
"""Costs that differ by less are the same: predictions err by more."""
SAVED_TO_SWITCH: Final = 0.4
"""On a link that swings: what a candidate must have been predicted to save since the last change, in costs of an
interval. The prediction is of whole swings, so a small gain is believed when it lasts, and a large one is not when it
does not: 8 % for five intervals, say."""
INTERVALS_TO_STAND: Final = 3
STEADY: Final = 0.25
"""A capacity that changed by more within the interval makes its measurement a mixture nobody can learn from."""
SWING: Final = 0.35
"""A fall by this share is a drop, not noise."""

RAW_SERVED: Final = 0.9
"""A share of what is needed of a class: raw messages fit when so many arrive in time."""
RAW_BACK_SERVED: Final = 0.95
RAW_BACK_LOAD: Final = 0.8
"""Before a class that is summarised goes back to raw: of what is needed, and the load of the planned capacity."""

FLOOR_KEPT: Final = 0.9
"""The share of a floor that is enough: predictions err, and on a lossy link nothing arrives whole."""
FLOOR_BACK: Final = 0.95
FLOOR_BACK_LOAD: Final = 0.8
"""Before a floor that was given up counts again: of the floor, and the load of the planned capacity. In between nothing
changes for it, so that a link about there is not followed to and fro."""

TURNS_OF_SWING: Final = 3
"""Down, up and down again within the memory, or up, down and up: a link that swings."""


@dataclass(frozen=True, slots=True)
class Decision:
    """What was chosen for the next interval, what else there was, and why in words.

    `index` is the place of the chosen one in `predictions`; None where nothing was predicted (capacity not known).
    """

    chosen: Configuration
    reason: str
    switched: bool
    index: int | None = None
    predictions: Predictions | None = field(default=None, repr=False)
    active_cost: float | None = None
    """Predicted cost of what was active before."""
    planned_bps: float | None = None
    """The capacity that was planned on."""

    @property
    def prediction(self) -> Prediction | None:
        if self.predictions is None or self.index is None:
            return None
        return self.predictions.prediction(self.index)

    def candidates(self, count: int | None = None) -> tuple[Candidate, ...]:
        """The candidates, feasible ones first, cheapest first; all, or the first `count`."""
        if self.predictions is None:
            return ()
        return tuple(self.predictions.candidate(index) for index in self.predictions.ranked()[:count])


class Policy(ABC):
    """Chooses a configuration every interval."""

    name: str

    @property
    @abstractmethod
    def active(self) -> Configuration:
        """What is in force."""

    @abstractmethod
    def decide(self, situation: Situation, measurement: Measurement | None, *, now: float) -> Decision:
        """Choose for the next interval. `measurement` is of the one that has just ended, None for the first."""

    @property
    def corrections(self) -> dict[str, float]:
        """What predictions are multiplied by, for people to see."""
        return {}


class FixedPolicy(Policy):
    """A hand-written configuration, kept whatever happens. It is predicted all the same, for people to compare."""

    def __init__(
        self, configuration: Configuration, predictor: Predictor | None = None, *, name: str = "fixed"
    ) -> None:
        self.name = name
        self._configuration = configuration
        self._predictor = predictor
        if predictor is not None and configuration not in predictor.grid.index:
            raise UsageError("FixedPolicy: the predictor's grid must hold the configuration")

    @property
    def active(self) -> Configuration:
        return self._configuration

    def decide(self, situation: Situation, measurement: Measurement | None, *, now: float) -> Decision:
        reason = f"policy {self.name}"
        if self._predictor is None or situation.link.capacity_bps is None or not situation.present:
            return Decision(self._configuration, reason, switched=False)
        predictions = self._predictor.predict(situation)
        index = self._predictor.grid.index[self._configuration]
        return Decision(
            self._configuration,
            reason,
            switched=False,
            index=index,
            predictions=predictions,
            active_cost=float(predictions.cost[index]),
            planned_bps=situation.link.capacity_bps,
        )


def fixed_throughput(codecs: Sequence[str]) -> Configuration:
    """The paper's baseline Fixed Throughput: everything is sent, compressed as far as it goes, nothing twice.

    `codecs` from the fastest to the strongest.
    """
    return Configuration(queues=(1, 2, 2), codec=codecs[-1] if codecs else NO_CODEC, redundancy=0)


def fixed_reliability(codecs: Sequence[str]) -> Configuration:
    """The paper's baseline Fixed Reliability: everything is sent, hardly compressed, class control twice."""
    del codecs
    return Configuration(queues=(1, 4, 4), codec=NO_CODEC, redundancy=1)


@dataclass(slots=True)
class _Levels:
    at_s: float
    readings_bps: tuple[float, ...]


class CapacityPlan:
    """Which capacities to plan for, with their shares.

    The estimate alone, as long as the link holds still. A link that keeps dropping is planned for as a whole, with
    the levels it had of late in their shares: following it would be late every time.
    """

    def __init__(self, memory_s: float) -> None:
        self._memory_s = memory_s
        self._levels: deque[_Levels] = deque()

    def add(self, link: LinkState, *, now: float) -> None:
        """Duty: the capacity is known."""
        assert link.capacity_bps is not None
        self._levels.append(_Levels(now, link.samples_bps or (link.capacity_bps,)))
        while self._levels[0].at_s < now - self._memory_s:
            self._levels.popleft()

    def _latest(self) -> tuple[float, ...]:
        latest = self._levels[-1].readings_bps
        if len(latest) == 1 and len(self._levels) > 1:
            return (self._levels[-2].readings_bps[-1], latest[0])
        return latest

    @property
    def steady(self) -> bool:
        """Whether the estimates of the last interval agree."""
        latest = self._latest()
        return max(latest) - min(latest) <= 2.0 * STEADY * max(latest)

    @property
    def fell(self) -> bool:
        """Whether the last estimate is clearly below others of the last interval."""
        latest = self._latest()
        return latest[-1] < (1.0 - 2.0 * STEADY) * max(latest)

    def path(self) -> CapacityPath | None:
        """The capacities of late where the link swings, whole swings of them; None where it holds still, or has just
        changed."""
        readings = [capacity_bps for levels in self._levels for capacity_bps in levels.readings_bps]
        turns = _turns(readings)
        if len(turns) < TURNS_OF_SWING:
            return None
        # From fall to fall or from rise to rise: so good moments and bad ones have their shares.
        last = turns[-1] if len(turns) % 2 else turns[-2]
        first_s = self._levels[0].at_s
        interval_s = (self._levels[-1].at_s - first_s) / max(len(self._levels) - 1, 1)
        duration_s = interval_s * len(self._levels) * (last - turns[0]) / len(readings)
        planned_bps = [PLANNED_SHARE * capacity_bps for capacity_bps in readings[turns[0] : last]]
        return CapacityPath.of(duration_s, planned_bps, max(1, round(duration_s / interval_s)))


def _turns(readings_bps: Sequence[float]) -> list[int]:
    """Where the capacity went from one level to another, down and up in turn: by much, and not noise about a
    threshold."""
    turns: list[int] = []
    down, low, high = None, readings_bps[0], readings_bps[0]
    for place, capacity_bps in enumerate(readings_bps):
        low, high = min(low, capacity_bps), max(high, capacity_bps)
        if down is not True and capacity_bps < (1.0 - SWING) * high:
            down = True
        elif down is not False and (1.0 - SWING) * capacity_bps > low:
            down = False
        else:
            continue
        turns.append(place)
        low = high = capacity_bps
    return turns


class Mmcf(Policy):
    """argmin of the predicted cost, corrected by experience, with hysteresis."""

    name = "mmcf"

    def __init__(
        self,
        grid: Grid,
        *,
        weights: Weights,
        ranges: Ranges,
        bounds: Bounds | None = None,
        floors: Sequence[float] = (0.0,) * len(CLASSES),
        initial: Configuration | None = None,
        memory_s: float = 10.0,
    ) -> None:
        """`floors`: by class, the share of the offered messages that must arrive in time where it can; 0: none."""
        initial = initial or grid.configurations[0]
        if initial not in grid.index:
            grid = Grid([initial, *grid.configurations])
        self.predictor = Predictor(grid, weights=weights, ranges=ranges, bounds=bounds)
        self.residuals = Residuals()
        self.floors = tuple(floors)
        self._plan = CapacityPlan(memory_s)
        self._active = initial
        self._stood = INTERVALS_TO_STAND
        self._saved: Floats = np.zeros(len(grid))
        self._classes: frozenset[PriorityClass] = frozenset()

    @property
    def active(self) -> Configuration:
        return self._active

    @property
    def corrections(self) -> dict[str, float]:
        return self.residuals.snapshot()

    def decide(self, situation: Situation, measurement: Measurement | None, *, now: float) -> Decision:
        link = situation.link
        if link.capacity_bps is None or not situation.present:
            what = "the capacity is not known yet" if link.capacity_bps is None else "nothing is offered"
            return Decision(self._active, f"kept: {what}", switched=False)
        self._plan.add(link, now=now)
        self._stood += 1
        predictor, residuals = self.predictor, self.residuals
        active = predictor.grid.index[self._active]
        demands = situation.at(self._active.summaries)
        classes = frozenset(demand.priority for demand in demands)
        if classes != self._classes:
            self._classes = classes
            residuals.reset()
        elif measurement is not None:
            residuals.learn_ratios(self._active.codec, demands, measurement)
            if self._plan.steady:
                bare = predictor.predict(situation, residuals.ratios)
                residuals.learn(self._active.codec, bare.prediction(active), measurement)
        saturated = measurement is not None and measurement.saturated
        factors = residuals.factors(predictor.grid.codecs, saturated=saturated)
        path = self._plan.path()
        predictions = predictor.corrected(predictor.predict(situation, residuals.ratios, path), factors)
        lows = 0.0 if path is None else PLANNED_SHARE * link.capacity_bps / max(min(path.capacities_bps), 1.0)
        tells = path is None and not self._plan.fell  # what was so is so yet
        proven = self._proven(measurement) if measurement is not None and tells else frozenset()
        return self._choose(predictions, active, swings=path is not None, lows=lows, proven=proven)

    def _proven(self, measurement: Measurement) -> frozenset[PriorityClass]:
        """The classes whose floors what is in force has just kept. Summaries that arrive prove nothing of what they
        stand for."""
        if any(self._active.summaries or ()):
            return frozenset()
        return frozenset(
            found.priority
            for found in measurement.classes
            if found.offered and found.on_time >= FLOOR_KEPT * self.floors[found.priority] * found.offered
        )

    def _prefer_raw(self, predictions: Predictions, active: int) -> None:
        """Mark the summaries that raw messages come before. One class at a time, the others' levels being equal."""
        now_summarised = predictions.configurations[active].summaries or (False,) * len(CLASSES)
        for level, places in self.predictor.grid.places.items():
            for priority in CLASSES:
                if level is None or not level[priority]:
                    continue
                raw = self.predictor.grid.places[(*level[:priority], False, *level[priority + 1 :])]
                allowed = predictions.allowed
                if not allowed[raw].any():
                    continue
                best = int(raw[np.argmin(np.where(allowed[raw], predictions.cost[raw], np.inf))])
                if now_summarised[priority]:
                    first = self._stood >= INTERVALS_TO_STAND and self._served(predictions, best, priority, back=True)
                else:
                    # Where nothing keeps to the bounds the summary may be the only thing left to do.
                    costs = np.where(allowed[places], predictions.cost[places], np.inf)
                    first = self._served(predictions, best, priority, back=False)
                    first = first or float(costs.min()) >= GAIN_TO_SWITCH * float(predictions.cost[best])
                if first:
                    marked = places[predictions.obstacle[places] == 0]
                    predictions.obstacle[marked] = RAW_FIRST
                    predictions.excess[marked] = np.inf

    def _served(self, predictions: Predictions, index: int, priority: PriorityClass, *, back: bool) -> bool:
        """Whether a candidate brings what is needed of a class; `back`: and the link has room to spare."""
        mine = next((found for found in predictions.classes if found.priority is priority), None)
        if mine is None or predictions.obstacle[index] != 0:
            return False
        load = sum(float(found.load[index]) for found in predictions.classes if not np.isnan(found.load[index]))
        if back and load > RAW_BACK_LOAD:
            return False
        return bool(mine.on_time[index] >= (RAW_BACK_SERVED if back else RAW_SERVED) * mine.needed[index])

    def _keep_floors(
        self, predictions: Predictions, active: int, lows: float, proven: frozenset[PriorityClass]
    ) -> None:
        """Mark what stays below the floor of a class, where something else keeps it; the most urgent class first.

        `proven`: on a link that did not get worse what is in force has kept the floors of these classes. So it keeps
        them, whatever is foreseen, and so does what is foreseen to be no worse: the formulas know the sizes in a class
        by mean and spread alone, and see too many lost where clouds are among small messages.

        `lows`: the planned capacity over the least one of a link that swings, 0 of one that does not. There a floor
        counts only if there is room for it in the bad moments too: else it would be followed up and down.
        """
        roomy = predictions.load * lows <= FLOOR_BACK_LOAD
        for mine in predictions.classes:
            floor = self.floors[mine.priority]
            feasible = predictions.obstacle == 0
            here = ~np.isnan(mine.on_time)  # else the class has no traffic at that level
            keeps = feasible & (~here | (mine.on_time >= FLOOR_KEPT * floor))
            if mine.priority in proven and feasible[active] and here[active]:
                keeps |= feasible & here & (mine.on_time >= mine.on_time[active])
            if not floor or not (keeps & roomy).any():
                continue
            if not keeps[active] and feasible[active]:
                if self._stood < INTERVALS_TO_STAND:
                    continue
                back = (mine.on_time >= FLOOR_BACK * floor) & (predictions.load <= FLOOR_BACK_LOAD)
                if not (feasible & (~here | back)).any():
                    continue
            if keeps.any():
                below = feasible & ~keeps
                predictions.obstacle[below] = BELOW_FLOOR
                predictions.excess[below] = np.inf

    def _shortest(self, predictions: Predictions, best: int) -> int:
        """The one with the shortest queues among those that differ from the best one in them alone and cost the same,
        as far as anybody can tell: when the link gets worse before the next decision, less waits there."""
        grid = self.predictor.grid
        same = (grid.rates == grid.rates[best]).all(axis=1) & (grid.codec == grid.codec[best])
        same &= (grid.redundancy == grid.redundancy[best]) & predictions.allowed
        same &= predictions.cost <= (1.0 + SAME_COST) * predictions.cost[best]
        level = grid.configurations[best].summaries
        places = [int(i) for i in np.flatnonzero(same) if grid.configurations[i].summaries == level]
        return min(places, key=lambda i: (float(grid.queues[i].sum()), float(predictions.cost[i])))

    def _choose(
        self,
        predictions: Predictions,
        active: int,
        *,
        swings: bool,
        lows: float,
        proven: frozenset[PriorityClass] = frozenset(),
    ) -> Decision:
        self._prefer_raw(predictions, active)
        self._keep_floors(predictions, active, lows, proven)
        best = self._shortest(predictions, predictions.best())
        current_cost, best_cost = float(predictions.cost[active]), float(predictions.cost[best])
        if swings:
            self._saved = np.maximum(0.0, self._saved + 1.0 - predictions.cost / max(current_cost, 1e-9))
        else:
            self._saved[:] = 0.0
        note = "" if (predictions.obstacle == 0).any() else "; nothing is feasible, this is the least bad"
        if not predictions.allowed[active]:
            obstacle = predictions.candidate(active).obstacle
            return self._take(best, active, predictions, f"switched: the active one is infeasible ({obstacle}){note}")
        if best == active:
            return self._take(active, active, predictions, f"kept: nothing costs less{note}")
        saved = 100.0 * (1.0 - best_cost / current_cost) if current_cost > 0.0 else 0.0
        if swings:
            if self._saved[best] < SAVED_TO_SWITCH:
                reason = f"kept: the link swings, and the best saves {saved:.1f} % so far{note}"
                return self._take(active, active, predictions, reason)
        elif best_cost >= GAIN_TO_SWITCH * current_cost:
            return self._take(active, active, predictions, f"kept: the best saves {saved:.1f} %, less than 10 %{note}")
        if self._stood < INTERVALS_TO_STAND:
            return self._take(active, active, predictions, f"kept: chosen {self._stood} intervals ago{note}")
        reason = f"switched: costs {best_cost:.3f} instead of {current_cost:.3f}{note}"
        return self._take(best, active, predictions, reason)

    def _take(self, index: int, active: int, predictions: Predictions, reason: str) -> Decision:
        switched = index != active
        if switched:
            self._active = predictions.configurations[index]
            self._stood = 0
            self._saved = np.zeros(len(self._saved))
        return Decision(
            self._active,
            reason,
            switched=switched,
            index=index,
            predictions=predictions,
            active_cost=float(predictions.cost[active]),
        )
