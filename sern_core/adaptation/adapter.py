"""The adaptation of one hop: measures its link, asks a policy, applies what it says. Pure.

The owner calls `sample` about ten times an interval and `step` once an interval. What is applied changes nothing that
waits or is under way: rates and queue limits act on the next message of a best-effort topic, a codec mode on the next
body to be encoded, redundancy on the next datagram, a summary's level on the next message of its topic. Topics that
appear are taken in by the next `step`.
"""

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from statistics import fmean
from typing import Final, NamedTuple

from sern_core.adaptation.cost import Ranges, Weights, cost, measure
from sern_core.adaptation.levels import Offer, RawProbe, Summarised, apply_levels, chosen, level_of, offers_by_level
from sern_core.adaptation.model import (
    NO_CODEC,
    NO_LIMIT,
    ClassDemand,
    ClassOutcome,
    Configuration,
    LinkState,
    Measurement,
    Situation,
    Terms,
)
from sern_core.adaptation.policy import Decision, Policy
from sern_core.adaptation.predict import SERIALISE_S
from sern_core.adaptation.trial import CapacityTrial
from sern_core.bodies.codecs import LOSSLESS, LOSSY, RAW_PROFILE, CodecProfile, Coder
from sern_core.link.link import Link
from sern_core.link.view import LinkSettings, LinkView, TopicView
from sern_core.stream.coding import preferred
from sern_core.vocabulary.codec_names import Compression
from sern_core.vocabulary.message import Message, TopicSpec
from sern_core.vocabulary.types import CLASSES, DropReason, PriorityClass, TopicName

INTERVAL_S: Final = 1.0
"""T_cfg of the paper's section "Multi-Metric Cost Function"."""
SAMPLES: Final = 10
"""Readings of the capacity an interval."""
MEMORY: Final = 3
"""Intervals that demand is told from."""
FULL: Final = 0.85
"""A link of which such a share was used is called saturated."""
UNFILLED: Final = 2.0
"""A link that was never full carries more than it had to. Taken for what it had to, it would be full at once: what fits
with room to spare would be left out."""
MIN_DEADLINE_S: Final = 1e-3
"""A peer may announce a lifespan of 0: its messages are as good as late, which costs what it costs."""
LOSSY_MODE: Final = "lossy"
"""z: what each topic allows to be lost is (point clouds through Draco, images as JPEG), the others Zstandard."""
ARRIVAL_CV2: Final = 0.1
"""Topics of robots tick; what is left is jitter."""


@dataclass(frozen=True, slots=True)
class AdapterParams:
    """What the owner decides. By class: control, state, bulk."""

    ranges: Ranges = field(default_factory=Ranges)
    weights: Weights = field(default_factory=lambda: Weights(0.45, 0.30, 0.10, 0.15))
    """The weights of the policy, which price what was measured."""
    interval_s: float = INTERVAL_S
    deadlines_s: tuple[float, ...] = (0.3, 0.5, 1.0)
    """Messages that arrive later do not count as delivered; a shorter lifespan of the topic counts instead."""
    needed: tuple[float, ...] = (1.0, 1.0, 0.4)
    """Share of the offered messages that the other side needs."""
    modes: tuple[str, ...] = (*LOSSLESS, LOSSY_MODE)
    """Codec modes that may be set; only `none` where bodies are forwarded as they are."""


@dataclass(frozen=True, slots=True)
class Step:
    """One interval: what was measured while it ran, what that cost, and what was decided at its end."""

    now: float
    situation: Situation
    measurement: Measurement | None
    terms: Terms | None
    cost: float | None
    bandwidth_full_bps: float
    """What counted 1 in the term of bandwidth: what the link was known to carry in the interval."""
    in_force: Configuration
    """What was in force while it was measured."""
    decision: Decision


class _Totals(NamedTuple):
    """What one topic had so far: messages, bytes, messages thinned, bytes before and after encoding."""

    offered: int
    nbytes: int
    thinned: int
    raw_bytes: int
    encoded_bytes: int


class _TopicStats:
    """Totals of one topic at the last step, and what came since, interval by interval."""

    __slots__ = ("history", "totals")

    def __init__(self) -> None:
        self.totals = _Totals(0, 0, 0, 0, 0)
        self.history: deque[tuple[int, int]] = deque(maxlen=MEMORY)  # (messages, bytes) an interval

    def update(self, *totals: int) -> _Totals:
        """The difference to the totals before; a channel that was opened anew begins at zero again."""
        new = _Totals._make(max(0, now - before) for now, before in zip(totals, self.totals, strict=True))
        self.totals = _Totals._make(totals)
        return new


@dataclass(slots=True)
class _ClassCount:
    offered: int = 0
    admitted: int = 0
    delivered: int = 0
    on_time: int = 0
    latency_s: float = 0.0
    raw_bytes: int = 0
    encoded_bytes: int = 0


class HopAdapter:
    """Measures, decides and applies for what goes out over one link.

    `coder` is the encoder of this process, None where bodies are not encoded here. `summaries` are what the topics'
    rules make of them, as it is now.
    """

    def __init__(
        self,
        link: Link,
        policy: Policy,
        params: AdapterParams,
        *,
        coder: Coder | None,
        now: float,
        summaries: Callable[[], Sequence[Summarised]] = list,
    ) -> None:
        self.link = link
        self.policy = policy
        self.params = params
        self.last: Step | None = None
        self.prediction_error: float | None = None
        """Cost of the last interval less what was predicted for it."""
        self.switches = 0
        self._coder = coder
        self._summaries = summaries
        self._probe = RawProbe(params.interval_s)
        self._trial = CapacityTrial(params.interval_s, assumed_min_bps=params.ranges.bandwidth_max_bps)
        self._since_s = now
        self._wire_bytes = _taken_bytes(link.observe(now=now))
        self._encode_s = self._coder_s()
        self._topics: dict[TopicName, _TopicStats] = {}
        self._arrived: dict[PriorityClass, _ClassCount] = {priority: _ClassCount() for priority in CLASSES}
        self._samples: deque[float] = deque(maxlen=SAMPLES)
        self._measured: Measurement | None = None
        link.watch_arrivals(self.note_arrival)

    def close(self, *, now: float) -> None:
        """Give every topic back what its rule says."""
        self.link.watch_arrivals(None)
        self.link.apply(LinkSettings(), now=now)
        apply_levels(self._summaries(), Configuration())

    # --- measuring ------------------------------------------------------------------------------------------------

    def note_arrival(self, spec: TopicSpec, message: Message, now: float) -> None:
        if message.replay or message.drop_marker or spec.background:
            return
        count = self._arrived[spec.priority]
        latency_s = max(0.0, now - message.born_s - self.link.rtt_s / 2.0)  # the acknowledgement took half a round trip
        count.delivered += 1
        count.latency_s += latency_s
        count.on_time += latency_s <= self._deadline_s(spec)

    def _deadline_s(self, spec: TopicSpec) -> float:
        deadline_s = self.params.deadlines_s[spec.priority]
        lifespan_s = spec.lifespan_s
        return deadline_s if lifespan_s is None else max(MIN_DEADLINE_S, min(deadline_s, lifespan_s))

    def _coder_s(self) -> float:
        """Processor time of encoding and of making summaries, of all time."""
        made_s = sum((item.cpu_s for item in self._summaries() if item.adapt), 0.0)
        if self._coder is None:
            return made_s
        return made_s + sum((counters.elapsed_s for counters in self._coder.encoded.values()), 0.0)

    def sample(self, *, now: float) -> None:
        """Read the capacity; about ten times an interval."""
        self._probe.finish()
        capacity_bps = self._capacity_bps(self.link.observe(now=now))
        if capacity_bps is not None:
            self._samples.append(capacity_bps)

    def _capacity_bps(self, link: LinkView) -> float | None:
        """What the path can carry, as far as anybody knows: the estimate, or what is tried; and while there was never
        enough to send to tell it, what the ranges call a full link, or UNFILLED times what was carried if that is
        more."""
        return self._trial.read(self._estimate_bps(link))

    def _estimate_bps(self, link: LinkView) -> float | None:
        if not link.up:
            return None
        if link.rate_bps is not None:
            return link.rate_bps
        return max(self.params.ranges.bandwidth_max_bps, UNFILLED * (link.bound_bps or 0.0))

    def _wanted(self) -> list[TopicView]:
        """Streams that somebody wants. What is in the background takes only what these leave: it is no reason to thin
        them."""
        return [v for v in self.link.topics() if v.wanted and v.ready and not v.spec.background]

    def _count(self, views: Iterable[TopicView]) -> dict[PriorityClass, _ClassCount]:
        """What the interval brought, by class; the arrivals since the last call are in it."""
        counts, self._arrived = self._arrived, {priority: _ClassCount() for priority in CLASSES}
        by_topic: dict[TopicName, list[TopicView]] = {}
        for view in views:
            by_topic.setdefault(view.topic, []).append(view)
        counted = self.link.counters
        for gone in self._topics.keys() - by_topic.keys():
            self._topics[gone].history.clear()
            if gone not in counted:
                del self._topics[gone]
        for topic, mine in by_topic.items():
            counters, count = counted[topic], counts[mine[0].spec.priority]
            stats = self._topics.setdefault(topic, _TopicStats())
            thinned = sum(view.thinned for view in mine)
            # What its own max_rate_hz leaves out was never meant to be sent, nor what nobody wanted.
            dropped = counters.by_reason
            offered = counters.offered - dropped[DropReason.RATE_CAP] + thinned - dropped[DropReason.UNWANTED]
            raw_bytes = sum(view.codec.raw_bytes for view in mine if view.codec is not None)
            encoded_bytes = sum(view.codec.encoded_bytes for view in mine if view.codec is not None)
            new = stats.update(offered, counters.offered_bytes, thinned, raw_bytes, encoded_bytes)
            if self.last is None:
                continue  # totals of who knows how long
            stats.history.append((new.offered, new.nbytes))
            count.offered += new.offered
            count.admitted += max(0, new.offered - new.thinned)
            if mine[0].spec.compression is None:
                count.raw_bytes += new.raw_bytes
                count.encoded_bytes += new.encoded_bytes
        return counts

    def _offers(self, views: Iterable[TopicView]) -> list[Offer]:
        return [
            Offer(view, messages / len(history), nbytes / messages)
            for view in views
            if (history := self._topics[view.topic].history)
            and (messages := sum(part[0] for part in history)) > 0
            and (nbytes := sum(part[1] for part in history)) >= 0
        ]

    def _demands(self, offers: Iterable[Offer], elapsed_s: float, *, lossless: bool) -> tuple[ClassDemand, ...]:
        groups: dict[PriorityClass, list[Offer]] = {}
        for offer in offers:
            groups.setdefault(offer.view.spec.priority, []).append(offer)
        found = []
        for priority in CLASSES:
            weighed = groups.get(priority, [])
            rate = sum(offer.per_interval for offer in weighed)
            if not rate:
                continue

            def mean(of: Callable[[Offer], float], weighed: list[Offer] = weighed, rate: float = rate) -> float:
                return sum(offer.per_interval * of(offer) for offer in weighed) / rate

            mean_bytes = mean(lambda offer: offer.mean_bytes)
            spread = sum(offer.per_interval * (offer.mean_bytes - mean_bytes) ** 2 for offer in weighed) / rate
            found.append(
                ClassDemand(
                    priority,
                    rate / elapsed_s,
                    mean_bytes,
                    mean(lambda offer: self._deadline_s(offer.view.spec)),
                    cv2=spread / mean_bytes**2 if mean_bytes > 0.0 else 0.0,
                    arrival_cv2=ARRIVAL_CV2,
                    topics=len(weighed),
                    depth=max(1, round(mean(lambda offer: _depth(offer.view)))),
                    needed=self.params.needed[priority],
                    thinnable=min(1.0, mean(lambda offer: float(offer.view.thinnable))),
                    protected=priority is PriorityClass.CONTROL and not lossless,
                    codecs={mode: _class_profile(mode, weighed) for mode in self.params.modes if mode != NO_CODEC},
                    prepare_s=mean(lambda offer: offer.prepare_s),
                )
            )
        return tuple(found)

    # --- deciding -------------------------------------------------------------------------------------------------

    def step(self, *, now: float) -> Step:
        """The interval is over: measure it, decide for the next one, apply that."""
        link, params = self.link.observe(now=now), self.params
        elapsed_s = max(now - self._since_s, 1e-3)
        views = self._wanted()
        counts = self._count(views)
        self._probe.abort()
        offers = self._offers(views)
        demands = self._demands(offers, elapsed_s, lossless=link.lossless)
        items = chosen(self._summaries())
        levels = {
            level: self._demands(offered, elapsed_s, lossless=link.lossless)
            for level, offered in offers_by_level(offers, items, views)
        }
        in_force = self.policy.active
        measurement, terms, value = None, None, None
        carried_bps = fmean(self._samples) if self._samples else self._capacity_bps(link)
        if link.established and any(count.offered for count in counts.values()):
            measurement = self._measure(counts, demands, _taken_bytes(link) - self._wire_bytes, elapsed_s)
            terms = params.ranges.terms(
                latency_s=measurement.latency_s,
                unreliability=measurement.unreliability,
                compute=measurement.compute,
                bandwidth_bps=measurement.bandwidth_bps,
                capacity_bps=carried_bps,
            )
            value = cost(params.weights, terms)
        if measurement is not None:
            rates, summarised = in_force.rates, any(in_force.summaries or ())
            self._trial.judge(
                self._estimate_bps(link),
                link.eased_s,
                measurement.classes,
                thinned=min(rates) < 1.0,
                summarised=summarised,
                now=now,
            )
        situation = Situation(
            levels.get(level_of(items), demands),
            LinkState(self._capacity_bps(link), self.link.rtt_s, link.loss, tuple(self._samples), stream=link.lossless),
            levels if items else {},
        )
        self._measured = measurement
        self._since_s, self._wire_bytes, self._encode_s = now, _taken_bytes(link), self._coder_s()
        self._samples.clear()
        foreseen = self.last.decision.prediction if self.last is not None else None
        self.prediction_error = None if value is None or foreseen is None else value - foreseen.cost
        decision = self.policy.decide(situation, measurement, now=now)
        self.switches += decision.switched
        self.apply(decision.chosen, now=now)
        if decision.predictions is not None:
            apply_levels(self._summaries(), decision.chosen)
            if decision.chosen.summaries is not None:
                self._probe.start(items, situation.link.capacity_bps, now=now)
        full_bps = params.ranges.bandwidth_full_bps(carried_bps)
        self.last = Step(now, situation, measurement, terms, value, full_bps, in_force, decision)
        return self.last

    def _measure(
        self,
        counts: dict[PriorityClass, _ClassCount],
        demands: tuple[ClassDemand, ...],
        wire_bytes: int,
        elapsed_s: float,
    ) -> Measurement:
        cpu_s = self._coder_s() - self._encode_s + SERIALISE_S * sum(count.admitted for count in counts.values())
        return measure(
            demands,
            [
                ClassOutcome(
                    priority,
                    count.offered,
                    count.admitted,
                    min(count.on_time, count.offered),
                    count.delivered,
                    count.latency_s,
                    # Classes share datagrams: all bytes are counted under the first.
                    float(wire_bytes) if priority is PriorityClass.CONTROL else 0.0,
                    float(count.raw_bytes),
                    float(count.encoded_bytes),
                )
                for priority, count in counts.items()
            ],
            interval_s=elapsed_s,
            cpu_s=cpu_s,
            saturated=8.0 * wire_bytes / elapsed_s > FULL * sum(self._samples) / max(1, len(self._samples)),
            ranges=self.params.ranges,
            previous=self._measured,
        )

    # --- applying -------------------------------------------------------------------------------------------------

    def apply(self, configuration: Configuration, *, now: float) -> None:
        """Bring the link in line. Idempotent; what waits or is under way is left as it is."""
        self.link.apply(settings(configuration, encodes=self._coder is not None), now=now)


def settings(configuration: Configuration, *, encodes: bool) -> LinkSettings:
    """What a configuration means for the link. `encodes`: bodies are encoded here."""
    return LinkSettings(
        shares=configuration.rates,
        depths=configuration.queues,
        codecs=codecs_of(configuration.codec) if encodes else None,
        copies=bool(configuration.redundancy),
    )


def codecs_of(mode: str) -> tuple[Compression, ...]:
    """What the mode z stands for, the better first; which of them a topic takes is up to what it allows."""
    return (*LOSSY, Compression.ZSTD) if mode == LOSSY_MODE else (Compression(mode),)


def _taken_bytes(link: LinkView) -> int:
    """What left so far, but for what took only the room that was over."""
    return link.wire_bytes - link.background_bytes


def _depth(view: TopicView) -> int:
    """Messages that may wait; what may not be left out waits until it is sent."""
    return view.spec.depth if view.thinnable else NO_LIMIT


def _class_profile(mode: str, weighed: list[Offer]) -> CodecProfile:
    """What `mode` would make of a class: the mean of its topics, weighed by their bytes."""
    codecs = codecs_of(mode)
    body = encoded = seconds = 0.0
    for view, per_interval, size, _ in weighed:
        profile = RAW_PROFILE
        if view.codec is not None:
            chosen_mode = view.spec.compression or preferred(codecs, view.codec.modes)
            profile = view.codec.profiles.get(chosen_mode, RAW_PROFILE)
        nbytes = per_interval * size
        body += nbytes
        encoded += nbytes * min(profile.ratio, 1.0)
        seconds += nbytes / profile.speed_bytes_per_s if profile.speed_bytes_per_s > 0.0 else 0.0
    if body <= 0.0:
        return RAW_PROFILE
    return CodecProfile(encoded / body, body / seconds if seconds > 0.0 else 0.0)
