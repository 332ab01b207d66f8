"""What the adaptation measures, chooses and reports: plain frozen data, units in the names.

A configuration is the paper's vector c = [r_1..r_q, q_1..q_q, z, h] (eq. (config_vector)): a rate cap and a queue limit
per priority class, a compression mode, redundancy; and by class whether topics that may be are sent as summaries.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from sern_core.bodies.codecs import RAW_PROFILE, CodecProfile
from sern_core.vocabulary.errors import UsageError
from sern_core.vocabulary.types import CLASS_LABELS, CLASSES, PriorityClass

NO_CODEC: Final = "none"
NO_LIMIT: Final = 1000
"""A queue of so many messages is as good as one without a limit."""
CLASS_WEIGHTS: Final = (0.6, 0.3, 0.1)
"""ω: what a class counts in latency and unreliability; spread over the classes that have traffic."""


@dataclass(frozen=True, slots=True)
class ClassDemand:
    """What one class offers and what it needs, as measured over the last interval.

    `rate_hz` messages offered a second before any thinning, `mean_bytes` of their bodies, `cv2` the squared coefficient
    of variation of the sizes, `arrival_cv2` that of the times between arrivals of one topic (1: Poisson, 0: it ticks).
    `topics` each have a queue of their own of at most `depth` messages. `needed` is the share of the offered messages
    that must arrive within `deadline_s` for the class to count as reliable: sending less than that counts as
    unreliability. `thinnable` is the share of the messages that a rate cap may drop (best-effort topics). `protected`
    classes are sent `1 + h` times. `repaired`: lost fragments are sent again while the message is wanted. `codecs` by
    mode; modes that are not named do nothing to this class. `prepare_s` is the processor time of making a message
    (a summary) before anything is thinned or encoded.
    """

    priority: PriorityClass
    rate_hz: float
    mean_bytes: float
    deadline_s: float
    cv2: float = 0.0
    arrival_cv2: float = 1.0
    topics: int = 1
    depth: int = NO_LIMIT
    needed: float = 1.0
    thinnable: float = 1.0
    protected: bool = False
    repaired: bool = True
    codecs: Mapping[str, CodecProfile] = field(default_factory=dict)
    prepare_s: float = 0.0

    def __post_init__(self) -> None:
        for name, ok in (
            ("rate_hz", 0.0 <= self.rate_hz < float("inf")),
            ("mean_bytes", 0.0 <= self.mean_bytes < float("inf")),
            ("deadline_s", self.deadline_s > 0.0),
            ("cv2", self.cv2 >= 0.0),
            ("arrival_cv2", self.arrival_cv2 >= 0.0),
            ("topics", self.topics >= 1),
            ("depth", self.depth >= 1),
            ("needed", 0.0 < self.needed <= 1.0),
            ("thinnable", 0.0 <= self.thinnable <= 1.0),
            ("prepare_s", self.prepare_s >= 0.0),
        ):
            if not ok:
                raise UsageError(f"ClassDemand: {name} = {getattr(self, name)!r} is out of range")

    def codec(self, mode: str) -> CodecProfile:
        return self.codecs.get(mode, RAW_PROFILE)

    def encode_s(self, mode: str) -> float:
        """Time to encode a message of mean size."""
        speed = self.codec(mode).speed_bytes_per_s
        return self.mean_bytes / speed if speed > 0.0 else 0.0


@dataclass(frozen=True, slots=True)
class LinkState:
    """The link as the estimators see it. `capacity_bps` None: not known yet. `loss` is the share of packets lost.

    `samples_bps` are estimates of the capacity taken evenly over the last interval, oldest first: on a link that swings
    faster than the interval, one reading says little.
    """

    capacity_bps: float | None
    rtt_s: float
    loss: float = 0.0
    samples_bps: tuple[float, ...] = ()
    stream: bool = False
    """TCP: what is offered beyond the capacity waits in the kernel, where it delays every class."""

    def __post_init__(self) -> None:
        if not (
            self.rtt_s >= 0.0 and 0.0 <= self.loss <= 1.0 and (self.capacity_bps is None or self.capacity_bps >= 0)
        ):
            raise UsageError(f"LinkState: {self!r} is out of range")


Levels = tuple[bool, ...]
"""Whether topics that may be are sent as their summaries, by class (control, state, bulk)."""


@dataclass(frozen=True, slots=True)
class Configuration:
    """The paper's c: `rates` and `queues` by class (control, state, bulk), codec mode z, redundancy h.

    A rate is the share of the offered best-effort messages that is sent, in (0, 1]. A queue limit is messages a topic.
    `summaries` None: not chosen, every topic is as its rule says.
    """

    rates: tuple[float, ...] = (1.0, 1.0, 1.0)
    queues: tuple[int, ...] = (1, 1, 1)
    codec: str = NO_CODEC
    redundancy: int = 0
    summaries: Levels | None = None

    def __post_init__(self) -> None:
        for name, ok in (
            ("rates", len(self.rates) == len(CLASSES) and all(0.0 < rate <= 1.0 for rate in self.rates)),
            ("queues", len(self.queues) == len(CLASSES) and all(limit >= 1 for limit in self.queues)),
            ("redundancy", self.redundancy in (0, 1)),
            ("summaries", self.summaries is None or len(self.summaries) == len(CLASSES)),
        ):
            if not ok:
                raise UsageError(f"Configuration: {name} = {getattr(self, name)!r} is out of range")

    def __str__(self) -> str:
        rates = "/".join(f"{rate:.3g}" for rate in self.rates)
        queues = "/".join(str(limit) for limit in self.queues)
        text = f"r {rates}  q {queues}  z {self.codec}  h {self.redundancy}"
        if self.summaries is None:
            return text
        summarised = [label for label, yes in zip(CLASS_LABELS, self.summaries, strict=True) if yes]
        return f"{text}  s {'/'.join(summarised) or 'raw'}"


class Terms(NamedTuple):
    """The four normalised terms of the cost, 0 (good) to 1 (bad): eqs. (lat_loss_norm) and (comp_band_norm)."""

    latency: float
    unreliability: float
    compute: float
    bandwidth: float


class ClassPrediction(NamedTuple):
    """What a configuration would do to one class."""

    priority: PriorityClass
    load: float  # ρ, share of the link that its offered messages would take
    drop: float  # share dropped for want of room in the queue
    late: float  # share of the rest behind its deadline
    latency_s: float
    on_time: float  # share of the offered messages delivered in time
    bandwidth_bps: float

    @property
    def label(self) -> str:
        return CLASS_LABELS[self.priority]


@dataclass(frozen=True, slots=True)
class Prediction:
    """What a configuration would do in the next interval. `compute` is CPU seconds a second."""

    latency_s: float
    unreliability: float
    compute: float
    bandwidth_bps: float
    cost: float
    terms: Terms
    classes: tuple[ClassPrediction, ...] = ()


@dataclass(frozen=True, slots=True)
class Candidate:
    """One configuration that was weighed. `obstacle` says why it is not feasible, empty when it is."""

    configuration: Configuration
    prediction: Prediction
    obstacle: str


@dataclass(frozen=True, slots=True)
class ClassOutcome:
    """What happened to one class in an interval: counts of messages and sums over the delivered ones.

    `admitted` were offered and not thinned by a rate cap; `wire_bytes` are all that left, with overhead, copies and
    repairs; `body_bytes` and `encoded_bytes` of what was encoded.
    """

    priority: PriorityClass
    offered: int
    admitted: int
    on_time: int
    delivered: int
    latency_sum_s: float
    wire_bytes: float = 0.0
    body_bytes: float = 0.0
    encoded_bytes: float = 0.0


@dataclass(frozen=True, slots=True)
class Measurement:
    """What the interval that has just ended came to, in the units of `Prediction`.

    `saturated`: the link had no time to spare. `ratios` are encoded bytes over body bytes by class, where seen.
    """

    latency_s: float
    unreliability: float
    compute: float
    bandwidth_bps: float
    saturated: bool
    ratios: Mapping[PriorityClass, float] = field(default_factory=dict)
    classes: tuple[ClassOutcome, ...] = ()
    latencies: Mapping[PriorityClass, float] = field(default_factory=dict)
    """Mean latency of each class's latest messages, seconds."""


@dataclass(frozen=True, slots=True)
class Situation:
    """Everything a policy may look at. `levels` is what would be offered with other topics summarised, for every level
    there is to choose; empty where there is nothing to summarise."""

    classes: tuple[ClassDemand, ...]
    link: LinkState
    levels: Mapping[Levels, tuple[ClassDemand, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for classes in (self.classes, *self.levels.values()):
            order = [demand.priority for demand in classes]
            if order != sorted(set(order)):
                raise UsageError(f"Situation: classes must be in order and named once, not {order!r}")

    def at(self, level: Levels | None) -> tuple[ClassDemand, ...]:
        """Classes that have traffic at a level, None: as it is now."""
        classes = self.classes if level is None else self.levels.get(level, self.classes)
        return tuple(demand for demand in classes if demand.rate_hz > 0.0)

    @property
    def present(self) -> tuple[ClassDemand, ...]:
        """Classes that have traffic."""
        return self.at(None)
