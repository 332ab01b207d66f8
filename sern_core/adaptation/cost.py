"""The cost J = w_l·L + w_r·(1−R) + w_c·C + w_b·B: weights, fixed ranges, and what an interval came to.

R is on time over what was needed, not over what was sent: else the argmin would send next to nothing. The ranges of
latency and computing are configured, not windowed minima and maxima: else the same interval would cost something else a
minute later.

Bandwidth is a share of what the link can carry. The paper's eq. (comp_band_norm) divides by a fixed b_max. One b_max
for every link starves a wide one: at 8 Mbit/s for 1, clouds of 8 Mbit/s cost as much on an empty link of 40 Mbit/s as
on one that they fill, so that six of ten were left out where nobody else wanted the room. And it makes a thin link look
free: 0.3 Mbit/s filled to the brim would cost 0.04. So b_max is the capacity as it is, and `bandwidth_max_bps` only
where that is not known. Costs of intervals on different capacities are thus in different units; who compares policies
prices all of them by the same capacity, that of the link, not by what each believes.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from sern_core.adaptation.model import CLASS_WEIGHTS, ClassDemand, ClassOutcome, Measurement, Terms
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.types import PriorityClass

SUM_TOLERANCE: Final = 1e-6
MIN_CAPACITY_BPS: Final = 1e3
"""A link that carries less is as good as full, whatever is sent."""


@dataclass(frozen=True, slots=True)
class Weights:
    """α, β, γ, δ of the paper's eq. (mmcf): latency, unreliability, compute, bandwidth.

    Raises ConfigError unless all are 0 or above and their sum is 1.
    """

    latency: float
    reliability: float
    compute: float
    bandwidth: float

    def __post_init__(self) -> None:
        for name, value in zip(("latency", "reliability", "compute", "bandwidth"), self, strict=True):
            if not 0.0 <= value <= 1.0:
                raise ConfigError(f"w_{name} is {value:g}: a weight is a number from 0 to 1", key=f"w_{name}")
        total = sum(self)
        if abs(total - 1.0) > SUM_TOLERANCE:
            raise ConfigError(f"the weights add up to {total:g}: change them so that the sum is 1", key="weights")

    def __iter__(self) -> Iterator[float]:
        return iter((self.latency, self.reliability, self.compute, self.bandwidth))


PROFILES: Final = {
    "teleoperation": Weights(0.45, 0.30, 0.10, 0.15),
    "mapping": Weights(0.10, 0.30, 0.15, 0.45),
    "balanced": Weights(0.25, 0.25, 0.25, 0.25),
}
"""Mission profiles (the paper's section "MMCF Evaluation" names the first two)."""
FLOORS: Final = {
    "teleoperation": (1.0, 1.0, 1.0),
    "mapping": (1.0, 0.5, 0.5),
    "balanced": (1.0, 1.0, 0.6),
}
"""The share of the offered messages that must arrive in time where the link can carry it, by profile and class. Who
drives wants all that there is room for; who maps shares the link with others, and half the scans make the map."""


def profile(name: str) -> Weights:
    """The weights of a named profile. Raises ConfigError."""
    try:
        return PROFILES[name]
    except KeyError:
        raise ConfigError(f"unknown profile {name!r}: use one of {', '.join(PROFILES)}", key="profile") from None


def profile_floors(name: str) -> tuple[float, float, float]:
    """The floors of a named profile, by class. Raises ConfigError."""
    profile(name)
    return FLOORS[name]


@dataclass(frozen=True, slots=True)
class Ranges:
    """What 1 means in each term. A latency of `latency_min_s` counts 0."""

    latency_min_s: float = 0.0
    latency_max_s: float = 0.5
    compute_max: float = 0.25
    """CPU seconds a second: a quarter of a core for serialising and compressing."""
    bandwidth_max_bps: float = 8e6
    """While the capacity of the link is not known; always, unless `share_of_capacity`."""
    share_of_capacity: bool = True
    """Bandwidth counts as a share of the link's capacity; False: of `bandwidth_max_bps`, as printed in the paper."""

    def __post_init__(self) -> None:
        for name, ok, what in (
            (
                "latency_max_s",
                0.0 <= self.latency_min_s < self.latency_max_s,
                "above latency_min_s, which is 0 or more",
            ),
            ("compute_max", self.compute_max > 0.0, "above 0"),
            ("bandwidth_max_bps", self.bandwidth_max_bps > 0.0, "above 0"),
        ):
            if not ok:
                raise ConfigError(f"{name} is {getattr(self, name):g}: it must be {what}", key=name)

    def bandwidth_full_bps(self, capacity_bps: float | None) -> float:
        """What counts 1 in the term of bandwidth, on a link of this capacity (None: not known)."""
        if capacity_bps is None or not self.share_of_capacity:
            return self.bandwidth_max_bps
        return max(capacity_bps, MIN_CAPACITY_BPS)

    def terms(
        self,
        *,
        latency_s: float,
        unreliability: float,
        compute: float,
        bandwidth_bps: float,
        capacity_bps: float | None,
    ) -> Terms:
        """The four terms of an interval in which the link could carry `capacity_bps`; None: nobody knows."""
        span_s = self.latency_max_s - self.latency_min_s
        return Terms(
            _unit((latency_s - self.latency_min_s) / span_s),
            _unit(unreliability),
            _unit(compute / self.compute_max),
            _unit(bandwidth_bps / self.bandwidth_full_bps(capacity_bps)),
        )


def _unit(value: float) -> float:
    return min(1.0, max(0.0, value))


def cost(weights: Weights, terms: Terms) -> float:
    """J, 0 to 1."""
    return sum(weight * term for weight, term in zip(weights, terms, strict=True))


def class_weights(priorities: Iterable[PriorityClass]) -> dict[PriorityClass, float]:
    """ω over the classes that are there, with sum 1."""
    mine = {priority: CLASS_WEIGHTS[priority] for priority in priorities}
    total = sum(mine.values())
    return {priority: weight / total for priority, weight in mine.items()}


def measure(
    demands: Sequence[ClassDemand],
    outcomes: Sequence[ClassOutcome],
    *,
    interval_s: float,
    cpu_s: float,
    saturated: bool,
    ranges: Ranges,
    previous: Measurement | None = None,
) -> Measurement:
    """What an interval came to, from its counts.

    A class of which nothing arrived has the largest latency there is; one of which nothing was to be sent keeps what
    it had in the interval before (`previous`).
    """
    by_class = {outcome.priority: outcome for outcome in outcomes if outcome.offered}
    here = [demand for demand in demands if demand.priority in by_class]
    weights = class_weights(demand.priority for demand in here)
    unreliability = sum(
        weights[demand.priority]
        * max(0.0, 1.0 - by_class[demand.priority].on_time / (by_class[demand.priority].offered * demand.needed))
        for demand in here
    )
    latencies = dict(previous.latencies) if previous is not None else {}
    for demand in here:
        outcome = by_class[demand.priority]
        if outcome.delivered:
            latencies[demand.priority] = outcome.latency_sum_s / outcome.delivered
        elif outcome.admitted:
            latencies[demand.priority] = ranges.latency_max_s
    known = class_weights(demand.priority for demand in here if demand.priority in latencies)
    latency_s = sum(weight * min(latencies[priority], ranges.latency_max_s) for priority, weight in known.items())
    return Measurement(
        latency_s=latency_s,
        unreliability=unreliability,
        compute=cpu_s / interval_s,
        bandwidth_bps=sum(8.0 * outcome.wire_bytes for outcome in outcomes) / interval_s,
        saturated=saturated,
        ratios={o.priority: o.encoded_bytes / o.body_bytes for o in outcomes if o.body_bytes > 0.0},
        classes=tuple(outcomes),
        latencies=latencies,
    )
