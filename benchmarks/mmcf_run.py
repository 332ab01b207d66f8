"""One policy on one trace: what it is told, what it chooses, and what that comes to."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from random import Random
from statistics import fmean, pvariance
from typing import Final

from benchmarks.mmcf_queue import Queues, arrivals, slowed
from benchmarks.mmcf_traces import NEEDED, Trace
from sern_core.adaptation.cost import Ranges, Weights, cost, measure
from sern_core.adaptation.model import ClassDemand, Configuration, LinkState, Measurement, Situation, Terms
from sern_core.adaptation.policy import Decision, Policy
from sern_core.bodies.codecs import CodecProfile
from sern_core.vocabulary.types import CLASSES

INTERVAL_S: Final = 1.0
LAG_S: Final = 0.3
"""How old the capacity is that the estimator reports, give or take NOISE."""
NOISE: Final = 0.05
SAMPLES: Final = 10
MEMORY: Final = 3
"""Intervals of arrivals that demand is told from."""


@dataclass
class Interval:
    """One interval as it was."""

    at_s: float
    configuration: Configuration
    switched: bool
    cost: float
    terms: Terms
    measurement: Measurement
    decision: Decision | None = None


@dataclass
class Run:
    trace: str
    policy: str
    intervals: list[Interval] = field(default_factory=list)

    @property
    def cost(self) -> float:
        return fmean(interval.cost for interval in self.intervals)

    @property
    def terms(self) -> Terms:
        return Terms(*(fmean(values) for values in zip(*(i.terms for i in self.intervals), strict=True)))

    @property
    def switches_per_minute(self) -> float:
        duration_s = len(self.intervals) * INTERVAL_S
        return 60.0 * sum(interval.switched for interval in self.intervals) / duration_s


class Observer:
    """Turns what the queues have seen into what a controller measures, with its errors."""

    def __init__(self, trace: Trace, *, seed: int) -> None:
        self.trace = trace
        self._random = Random(f"observer {seed}")
        self._seen: list[list[tuple[float, int, float]]] = []

    def situation(self, queues: Queues) -> Situation:
        self._seen = [*self._seen, queues.seen][-MEMORY:]
        now, path = queues.now, self.trace.path
        loss = queues.packets_lost / queues.packets if queues.packets else 0.0
        gauss = self._random.gauss
        samples = tuple(
            path.rate_bps(max(0.0, now - LAG_S - INTERVAL_S * (1.0 - k / SAMPLES))) * max(0.5, gauss(1.0, NOISE))
            for k in range(1, SAMPLES + 1)
        )
        link = LinkState(samples[-1], path.rtt_s(now), loss, samples)
        return Situation(tuple(self._demands(path.slowdown(now))), link)

    def _demands(self, slowdown: float) -> Iterator[ClassDemand]:
        topics = self.trace.topics
        latest = self._seen[-1]
        for priority in CLASSES:
            mine = [(at, i, size) for part in self._seen for at, i, size in part if topics[i].priority is priority]
            newest = [entry for entry in latest if topics[entry[1]].priority is priority]
            present = {index for _, index, _ in newest}
            if not newest:
                continue
            # A stream that has just begun or ended counts as it is now.
            mine = [entry for entry in mine if entry[1] in present]
            rate_hz = sum(
                sum(entry[1] == index for entry in mine)
                / max(1, sum(any(entry[1] == index for entry in part) for part in self._seen))
                for index in present
            )
            sizes = [size for _, _, size in mine]
            mean_bytes = fmean(sizes)
            arrival_cv2 = fmean(_ticking([at for at, i, _ in mine if i == index]) for index in present)
            first = topics[newest[0][1]]
            modes = sorted({mode for index in present for mode in topics[index].codecs})
            yield ClassDemand(
                priority,
                rate_hz / INTERVAL_S,
                mean_bytes,
                first.deadline_s,
                cv2=pvariance(sizes) / mean_bytes**2,
                arrival_cv2=arrival_cv2,
                topics=len(present),
                needed=NEEDED[priority],
                protected=priority == 0,
                codecs={mode: self._profile(mode, mine, slowdown) for mode in modes},
            )

    def _profile(self, mode: str, seen: Sequence[tuple[float, int, float]], slowdown: float) -> CodecProfile:
        """The mean over the topics of the class, weighed by bytes, as test compressions give it."""
        topics = self.trace.topics
        body = encoded = seconds = 0.0
        for _, index, size in seen:
            profile = topics[index].codecs.get(mode)
            body += size
            encoded += size * (profile.ratio if profile else 1.0)
            seconds += size / slowed(profile, slowdown).speed_bytes_per_s if profile else 0.0
        return CodecProfile(encoded / body * self._random.gauss(1.0, 0.03), body / seconds if seconds else 0.0)


def _ticking(times: list[float]) -> float:
    """Squared coefficient of variation of the times between arrivals of one topic."""
    gaps = [b - a for a, b in pairwise(times)]
    return pvariance(gaps) / fmean(gaps) ** 2 if len(gaps) > 1 else 0.1


NEEDS: Final = [ClassDemand(priority, 1.0, 1.0, 1.0, needed=NEEDED[priority]) for priority in CLASSES]
"""What `measure` has to know about the classes."""


def outcome(
    queues: Queues, ranges: Ranges, weights: Weights, previous: Measurement | None
) -> tuple[float, Terms, Measurement]:
    """What the interval since `take` came to."""
    measurement = measure(
        NEEDS,
        queues.outcomes(),
        interval_s=INTERVAL_S,
        cpu_s=queues.cpu_s,
        saturated=queues.idle_s < 0.05 * INTERVAL_S,
        ranges=ranges,
        previous=previous,
    )
    # Whatever a policy believed: all are priced by what the link could carry.
    capacity_bps = queues.path.mean_rate_bps(queues.now - INTERVAL_S, queues.now)
    terms = ranges.terms(
        latency_s=measurement.latency_s,
        unreliability=measurement.unreliability,
        compute=measurement.compute,
        bandwidth_bps=measurement.bandwidth_bps,
        capacity_bps=capacity_bps,
    )
    return cost(weights, terms), terms, measurement


def start(trace: Trace, seed: int) -> Queues:
    return Queues(trace.topics, trace.path, arrivals(trace.topics, trace.duration_s + 2.0, seed), seed=seed)


Chooser = Callable[[Queues, Measurement | None], tuple[Configuration, Decision | None]]


def run(trace: Trace, name: str, choose: Chooser, *, seed: int, ranges: Ranges, weights: Weights) -> Run:
    """The whole trace; the first interval is a warm-up that no policy is charged for."""
    queues = start(trace, seed)
    queues.run(INTERVAL_S)
    result = Run(trace.name, name)
    measurement: Measurement | None = None
    while queues.now < trace.duration_s - 1e-6:
        before = queues.configuration
        configuration, decision = choose(queues, measurement)
        queues.take()
        queues.apply(configuration)
        at_s = round(queues.now)
        queues.run(at_s + INTERVAL_S)
        value, terms, measurement = outcome(queues, ranges, weights, measurement)
        switched = configuration != before and bool(result.intervals)
        result.intervals.append(Interval(at_s, configuration, switched, value, terms, measurement, decision))
    return result


def fixed(configuration: Configuration) -> Chooser:
    return lambda _queues, _measurement: (configuration, None)


def controlled(policy: Policy, trace: Trace, *, seed: int) -> Chooser:
    observer = Observer(trace, seed=seed)

    def choose(queues: Queues, measurement: Measurement | None) -> tuple[Configuration, Decision | None]:
        decision = policy.decide(observer.situation(queues), measurement, now=queues.now)
        return decision.chosen, decision

    return choose


def oracle(
    candidates: Sequence[Configuration],
    *,
    ranges: Ranges,
    weights: Weights,
    keeps: Callable[[Measurement], bool] = lambda _measurement: True,
) -> Chooser:
    """Tries every configuration on a copy of the queues, with the link and the losses that will come. Those whose
    interval `keeps` come first."""

    def choose(queues: Queues, measurement: Measurement | None) -> tuple[Configuration, Decision | None]:
        until_s = round(queues.now) + INTERVAL_S
        best, lowest = candidates[0], (True, float("inf"))
        for configuration in candidates:
            copy = queues.clone()
            copy.apply(configuration)
            copy.run(until_s)
            cost_then, _, came = outcome(copy, ranges, weights, measurement)
            value = (not keeps(came), cost_then)
            if value < lowest:
                best, lowest = configuration, value
        return best, None

    return choose
