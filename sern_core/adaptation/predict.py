"""What each candidate configuration would do: queueing formulas, over all candidates at once.

Only the active configuration can be measured, so the others are predicted. Per class i, in order of priority, with
measured arrivals λ_i, body size s_i, codec profile (k, v), n_i = 1 + h copies for protected classes, and C the planned
capacity:

    S_i = (s_i·k + 60·f_i)·n_i     bytes on the wire, f_i fragments       X_i = 8·S_i/C     ρ_i = r_i·λ_i·X_i
    u_i = ρ_i/(1 − σ_{i−1})        load of what is left                   σ_i = σ_{i−1} + ρ_i·(1 − d_i)
    d_i = (1 − u)·u^K/(1 − u^{K+1})  dropped for want of room
    W_i = W0_i/((1 − σ_{i−1})(1 − σ_i))  Cobham's wait (1954), at most what the queue limit allows
    late_i = min(1, σ_i)·exp(−slack_i/W_i),  slack_i = D_i − RTT/2 − X_i/(1 − σ_{i−1}) − s_i/v
    ℓ_i = W_i + X_i/(1 − σ_{i−1}) + RTT/2 + s_i/v
    on_i = r_i·(1 − d_i)·(1 − late_i)·(1 − p^{n_i·m_i})^{f_i},  m_i sendings that fit into the slack

    1 − R = Σ ω_i·max(0, 1 − on_i/needed_i)   ℓ = Σ ω_i·ℓ_i
    τ = Σ r_i·λ_i·(c_ser + (1 − d_i)·s_i/v)   b = Σ 8·r_i·λ_i·S_i·(1 − d_i)

Where this is more than the textbook: a less urgent class delays a more urgent one by a fragment at most, not by a
message (W0_i holds whole messages of classes up to i and fragments of the others); queues keep the newest, so that
a message waits no longer than its queue takes to be overrun; streams that tick are not Poisson, so K and W0 are scaled
by (c_a² + c_s²)/2 (Allen and Cunneen's correction; 1 for M/M). A level of the summaries has demands of its own; making
a summary takes time before the rest, and processor time for every offered message.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from statistics import fmean
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sern_core.adaptation.cost import Ranges, Weights, class_weights
from sern_core.adaptation.model import (
    Candidate,
    ClassDemand,
    ClassPrediction,
    Configuration,
    Levels,
    LinkState,
    Prediction,
    Situation,
    Terms,
)
from sern_core.adaptation.playback import CapacityPath, played
from sern_core.adaptation.queueing import Floats, Service, steady
from sern_core.path.lanes import DATAGRAM_BYTES, OVERHEAD_BYTES
from sern_core.vocabulary.errors import UsageError
from sern_core.vocabulary.types import CLASSES, PriorityClass

Bools = NDArray[np.bool_]

PLANNED_SHARE: Final = 0.9
"""The share of the estimated capacity to plan with: the predictions are worst near full load."""
CONTROL_SHARE_MAX: Final = 0.5
"""The share of the link for class control; its token bucket holds it there in any case."""
SERIALISE_S: Final = 100e-6
"""CPU time of a message outside its codec, until measured."""
FRAGMENT_BODY_BYTES: Final = DATAGRAM_BYTES - 31
OBSTACLES: Final = (
    "",
    "rate below the class's minimum",
    "control above half the link",
    "CPU",
    "more than the link",
    "nothing to summarise",
    "raw comes first",
    "below the floor of a class",
)
CLASS_ARRAYS: Final = ("load", "drop", "late", "latency_s", "on_time", "needed", "bandwidth_bps")
NOTHING_TO_SUMMARISE: Final = 5
RAW_FIRST: Final = 6
BELOW_FLOOR: Final = 7


@dataclass(frozen=True, slots=True)
class Bounds:
    """What makes a configuration feasible, the paper's C_feas.

    `min_rates` by class; `compute_max` CPU seconds a second; `load_max` offered load over planned capacity, inf for
    none: what does not fit is dropped by class, freshest kept, and the cost says so. Over a stream it is 1 at most:
    there the kernel's queue knows no classes.
    """

    min_rates: tuple[float, ...] = (0.0, 0.0, 0.0)
    compute_max: float = 1.0
    load_max: float = float("inf")


@dataclass(slots=True)
class ClassArrays:
    """Per candidate, for one class; NaN where its level has no such class."""

    priority: PriorityClass
    load: Floats
    drop: Floats
    late: Floats
    latency_s: Floats
    on_time: Floats
    needed: Floats
    bandwidth_bps: Floats


@dataclass(slots=True)
class Predictions:
    """Arrays over the candidates, in the order of the grid. `obstacle` indexes OBSTACLES, 0: feasible."""

    configurations: tuple[Configuration, ...]
    latency_s: Floats
    unreliability: Floats
    compute: Floats
    bandwidth_bps: Floats
    cost: Floats
    terms: tuple[Floats, Floats, Floats, Floats]
    obstacle: NDArray[np.int64]
    load: Floats  # offered, over planned capacity
    excess: Floats  # by how much bounds are broken, in shares of the link and of the CPU
    bandwidth_full_bps: float  # what counts 1 in the term of bandwidth
    classes: tuple[ClassArrays, ...] = ()

    @property
    def allowed(self) -> Bools:
        """The feasible candidates; where there are none, those that break the bounds by least: the safe ones."""
        feasible = self.obstacle == 0
        return feasible if feasible.any() else np.asarray(self.excess <= self.excess.min() + 1e-9)

    def best(self) -> int:
        """The cheapest of those that are allowed (eq. (mmcf_argmin)); the first of equals."""
        return int(np.argmin(np.where(self.allowed, self.cost, np.inf)))

    def prediction(self, index: int) -> Prediction:
        return Prediction(
            float(self.latency_s[index]),
            float(self.unreliability[index]),
            float(self.compute[index]),
            float(self.bandwidth_bps[index]),
            float(self.cost[index]),
            Terms(*(float(term[index]) for term in self.terms)),
            tuple(
                ClassPrediction(
                    c.priority,
                    float(c.load[index]),
                    float(c.drop[index]),
                    float(c.late[index]),
                    float(c.latency_s[index]),
                    float(c.on_time[index]),
                    float(c.bandwidth_bps[index]),
                )
                for c in self.classes
                if not np.isnan(c.load[index])
            ),
        )

    def candidate(self, index: int) -> Candidate:
        return Candidate(self.configurations[index], self.prediction(index), OBSTACLES[int(self.obstacle[index])])

    def ranked(self) -> list[int]:
        """Indices, feasible ones first, each part by cost."""
        order = np.lexsort((self.cost, self.obstacle != 0))
        return [int(index) for index in order]


@dataclass(frozen=True, slots=True)
class Factors:
    """What experience multiplies predictions by. `compute` is an array over the grid's codec modes."""

    latency: float
    unreliability: float
    compute: Floats
    bandwidth: float


class Grid:
    """A finite set of configurations, as arrays."""

    def __init__(self, configurations: Sequence[Configuration]) -> None:
        if not configurations:
            raise UsageError("Grid: there must be at least one configuration")
        self.configurations = tuple(configurations)
        self.index = {configuration: i for i, configuration in enumerate(self.configurations)}
        self.rates: Floats = np.array([c.rates for c in configurations], dtype=np.float64)
        self.queues: Floats = np.array([c.queues for c in configurations], dtype=np.float64)
        self.codecs = tuple(dict.fromkeys(c.codec for c in configurations))
        self.codec: NDArray[np.int64] = np.array([self.codecs.index(c.codec) for c in configurations], dtype=np.int64)
        self.redundancy: Floats = np.array([c.redundancy for c in configurations], dtype=np.float64)
        places: dict[Levels | None, list[int]] = {}
        for i, configuration in enumerate(self.configurations):
            places.setdefault(configuration.summaries, []).append(i)
        self.places: dict[Levels | None, NDArray[np.int64]] = {
            level: np.array(found, dtype=np.int64) for level, found in places.items()
        }
        """Where in the grid each level of the summaries is."""
        self.parts: dict[Levels | None, Grid] = (
            dict.fromkeys(places, self)
            if len(places) == 1
            else {level: Grid([self.configurations[i] for i in found]) for level, found in places.items()}
        )

    def __len__(self) -> int:
        return len(self.configurations)

    @classmethod
    def of(
        cls,
        *,
        rates: Sequence[Sequence[float]],
        queues: Sequence[Sequence[int]],
        codecs: Sequence[str],
        redundancy: Sequence[int],
        summarised: Collection[PriorityClass] = (),
    ) -> "Grid":
        """Every combination; `rates` and `queues` have one list of choices a class. `summarised` are the classes that
        have topics whose rule lets them be sent as summaries; without any, levels are not chosen."""
        if len(rates) != len(CLASSES) or len(queues) != len(CLASSES):
            raise UsageError("Grid.of: one list of choices per class for rates and for queues")
        choices = [(False, True) if priority in summarised else (False,) for priority in CLASSES]
        levels: list[Levels | None] = list(product(*choices)) if summarised else [None]
        return cls(
            [
                Configuration((r0, r1, r2), (q0, q1, q2), codec, copies, level)
                for level in levels
                for r0 in rates[0]
                for r1 in rates[1]
                for r2 in rates[2]
                for q0 in queues[0]
                for q1 in queues[1]
                for q2 in queues[2]
                for codec in codecs
                for copies in redundancy
            ]
        )


class Predictor:
    """The formulas above, for one grid, one set of ranges and weights."""

    def __init__(
        self,
        grid: Grid,
        *,
        weights: Weights,
        ranges: Ranges,
        bounds: Bounds | None = None,
        serialise_s: float = SERIALISE_S,
    ) -> None:
        self.grid = grid
        self.weights = weights
        self.ranges = ranges
        self.bounds = bounds or Bounds()
        self.serialise_s = serialise_s

    def predict(
        self,
        situation: Situation,
        ratios: Mapping[tuple[PriorityClass, str], float] | None = None,
        path: CapacityPath | None = None,
    ) -> Predictions:
        """The bare predictions; `ratios` corrects the compression ratios of (class, mode). Duty: the capacity is known.

        With a `path` what was offered is played over those capacities, one after the other; what is feasible is told
        from the capacity as it is now in any case.
        """
        grid = self.grid
        if situation.link.capacity_bps is None:
            raise UsageError("Predictor.predict: the capacity is not known")
        parts = {
            level: self._predict(part, situation.at(level), situation.link, ratios or {}, path)
            for level, part in grid.parts.items()
        }
        if len(parts) == 1:
            return next(iter(parts.values()))
        found = self._joined(parts)
        for level, places in grid.places.items():
            if level is not None and any(level) and level not in situation.levels:
                found.obstacle[places] = NOTHING_TO_SUMMARISE
                found.excess[places] = np.inf
        return found

    def _joined(self, parts: Mapping[Levels | None, Predictions]) -> Predictions:
        """The predictions of all levels in the order of the grid."""
        grid = self.grid

        def whole(read: Callable[[Predictions], NDArray[Any]]) -> NDArray[Any]:
            first = read(next(iter(parts.values())))
            joined = np.empty(len(grid), dtype=first.dtype)
            for level, part in parts.items():
                joined[grid.places[level]] = read(part)
            return joined

        def of_class(priority: PriorityClass, name: str) -> Floats:
            joined = np.full(len(grid), np.nan)
            for level, part in parts.items():
                for mine in part.classes:
                    if mine.priority is priority:
                        joined[grid.places[level]] = getattr(mine, name)
            return joined

        seen = {mine.priority for part in parts.values() for mine in part.classes}
        return Predictions(
            grid.configurations,
            latency_s=whole(lambda part: part.latency_s),
            unreliability=whole(lambda part: part.unreliability),
            compute=whole(lambda part: part.compute),
            bandwidth_bps=whole(lambda part: part.bandwidth_bps),
            cost=whole(lambda part: part.cost),
            terms=(
                whole(lambda part: part.terms[0]),
                whole(lambda part: part.terms[1]),
                whole(lambda part: part.terms[2]),
                whole(lambda part: part.terms[3]),
            ),
            obstacle=whole(lambda part: part.obstacle),
            load=whole(lambda part: part.load),
            excess=whole(lambda part: part.excess),
            bandwidth_full_bps=next(iter(parts.values())).bandwidth_full_bps,
            classes=tuple(ClassArrays(p, *(of_class(p, name) for name in CLASS_ARRAYS)) for p in CLASSES if p in seen),
        )

    def _predict(
        self,
        grid: Grid,
        demands: Sequence[ClassDemand],
        link: LinkState,
        ratios: Mapping[tuple[PriorityClass, str], float],
        path: CapacityPath | None,
    ) -> Predictions:
        """One level of the summaries."""
        assert link.capacity_bps is not None
        capacity_bps = max(PLANNED_SHARE * link.capacity_bps, 1.0)
        omega = class_weights(demand.priority for demand in demands)
        shape = len(grid)
        parts = [self._service(grid, demand, capacity_bps, link, ratios) for demand in demands]
        offered_load = sum((part.load for part in parts), np.zeros(shape))

        if path is None:
            outcomes = steady(parts, link, capacity_bps, self.ranges.latency_max_s)
        else:
            outcomes = played(parts, link, path, self.ranges.latency_max_s)
        latency_s, unreliability = np.zeros(shape), np.zeros(shape)
        compute, bandwidth_bps = np.zeros(shape), np.zeros(shape)
        control_load = np.zeros(shape)
        classes = []
        for part, found in zip(parts, outcomes, strict=True):
            demand = part.demand
            latency_s += omega[demand.priority] * found.latency_s
            unreliability += omega[demand.priority] * found.short
            compute += part.rate_hz * (self.serialise_s + (1.0 - found.drop) * part.encode_s)
            compute += demand.rate_hz * demand.prepare_s
            bandwidth_bps += found.bandwidth_bps
            if demand.priority is PriorityClass.CONTROL:
                control_load = part.load
            needed = np.full(shape, demand.needed)
            classes.append(
                ClassArrays(
                    demand.priority,
                    part.load,
                    found.drop,
                    found.late,
                    found.latency_s,
                    found.on_time,
                    needed,
                    found.bandwidth_bps,
                )
            )

        load_max = min(self.bounds.load_max, 1.0) if link.stream else self.bounds.load_max
        excess = np.maximum(control_load - CONTROL_SHARE_MAX, 0.0)
        excess += np.maximum(offered_load - load_max, 0.0)
        excess += np.maximum(np.array(self.bounds.min_rates) - grid.rates, 0.0).sum(axis=1)
        obstacle = np.zeros(shape, dtype=np.int64)
        obstacle[offered_load > load_max] = 4
        obstacle[control_load > CONTROL_SHARE_MAX] = 2
        obstacle[(grid.rates < np.array(self.bounds.min_rates)).any(axis=1)] = 1
        return self._costed(
            grid,
            latency_s,
            unreliability,
            compute,
            bandwidth_bps,
            obstacle,
            excess,
            # Over a path it is what that carried in the mean, so that all candidates are priced alike.
            bandwidth_full_bps=self.ranges.bandwidth_full_bps(
                link.capacity_bps if path is None else fmean(path.capacities_bps) / PLANNED_SHARE
            ),
            load=offered_load,
            classes=tuple(classes),
        )

    def corrected(self, raw: Predictions, factors: Factors) -> Predictions:
        """The same, multiplied by what experience says."""
        return self._costed(
            self.grid,
            np.minimum(raw.latency_s * factors.latency, self.ranges.latency_max_s),
            np.minimum(raw.unreliability * factors.unreliability, 1.0),
            raw.compute * factors.compute[self.grid.codec],
            raw.bandwidth_bps * factors.bandwidth,
            raw.obstacle,
            raw.excess,
            bandwidth_full_bps=raw.bandwidth_full_bps,
            load=raw.load,
            classes=raw.classes,
        )

    def _costed(
        self,
        grid: Grid,
        latency_s: Floats,
        unreliability: Floats,
        compute: Floats,
        bandwidth_bps: Floats,
        obstacle: NDArray[np.int64],
        excess: Floats,
        *,
        bandwidth_full_bps: float,
        load: Floats,
        classes: tuple[ClassArrays, ...],
    ) -> Predictions:
        terms = self._terms(latency_s, unreliability, compute, bandwidth_bps / bandwidth_full_bps)
        weights = self.weights
        cost = (
            weights.latency * terms[0]
            + weights.reliability * terms[1]
            + weights.compute * terms[2]
            + weights.bandwidth * terms[3]
        )
        busy = (obstacle == 0) & (compute > self.bounds.compute_max)
        obstacle = np.where(busy, np.int64(3), obstacle)
        return Predictions(
            grid.configurations,
            latency_s,
            unreliability,
            compute,
            bandwidth_bps,
            cost,
            terms,
            obstacle,
            load,
            excess + np.maximum(compute - self.bounds.compute_max, 0.0),
            bandwidth_full_bps,
            classes,
        )

    def _terms(
        self, latency_s: Floats, unreliability: Floats, compute: Floats, bandwidth: Floats
    ) -> tuple[Floats, Floats, Floats, Floats]:
        ranges = self.ranges
        span_s = ranges.latency_max_s - ranges.latency_min_s
        return (
            np.clip((latency_s - ranges.latency_min_s) / span_s, 0.0, 1.0),
            np.clip(unreliability, 0.0, 1.0),
            np.clip(compute / ranges.compute_max, 0.0, 1.0),
            np.clip(bandwidth, 0.0, 1.0),
        )

    def _service(
        self,
        grid: Grid,
        demand: ClassDemand,
        capacity_bps: float,
        link: LinkState,
        ratios: Mapping[tuple[PriorityClass, str], float],
    ) -> Service:
        profiles = [demand.codec(name) for name in grid.codecs]
        ratio = np.array(
            [
                profile.ratio * ratios.get((demand.priority, name), 1.0)
                for name, profile in zip(grid.codecs, profiles, strict=True)
            ]
        )
        encode_s = np.array([demand.encode_s(name) for name in grid.codecs])[grid.codec]
        encoded_bytes = demand.mean_bytes * ratio[grid.codec]
        fragments = np.maximum(1.0, np.ceil(encoded_bytes / FRAGMENT_BODY_BYTES))
        copies = 1.0 + grid.redundancy if demand.protected else np.ones(len(grid))
        wire_bytes = (encoded_bytes + OVERHEAD_BYTES * fragments) * copies
        if demand.repaired:
            wire_bytes = wire_bytes / max(1.0 - link.loss, 0.1)
        kept = 1.0 - demand.thinnable * (1.0 - grid.rates[:, demand.priority])
        rate_hz = kept * demand.rate_hz
        x_s = 8.0 * wire_bytes / capacity_bps
        limit = np.minimum(grid.queues[:, demand.priority], demand.depth)
        return Service(demand, kept, rate_hz, x_s, rate_hz * x_s, encode_s, fragments, copies, limit, 8.0 * wire_bytes)
