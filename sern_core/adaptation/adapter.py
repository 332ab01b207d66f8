"""The adaptation of one hop: measures its link, asks a policy, applies what it says. Pure.

The owner calls `sample` about ten times an interval and `step` once an interval. What is applied changes nothing that
waits or is under way: rates and queue limits act on the next message of a best-effort topic, a codec mode on the next
body to be encoded, redundancy on the next datagram, a summary's level on the next message of its topic. Topics that
appear are taken in by the next `step`.
"""

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from math import isfinite
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
from sern_core.stream.out_channel import OutChannel
from sern_core.stream.out_message import OutMessage
from sern_core.vocabulary.codec_names import Compression
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
        self._wire_bytes = link.lanes.wire_bytes
        self._encode_s = self._coder_s()
        self._topics: dict[TopicName, _TopicStats] = {}
        self._arrived: dict[PriorityClass, _ClassCount] = {priority: _ClassCount() for priority in CLASSES}
        self._samples: deque[float] = deque(maxlen=SAMPLES)
        self._measured: Measurement | None = None
        link.plane.on_arrived = self.note_arrival

    def close(self) -> None:
        """Give every topic back what its rule says."""
        self.link.plane.on_arrived = None
        for channel in self.link.sender.channels.values():
            channel.adapt(share=1.0, depth_max=channel.spec.depth)
        apply_levels(self._summaries(), Configuration())
        for lane in self.link.lanes.by_id.values():
            lane.copies_wanted = None

    # --- measuring ------------------------------------------------------------------------------------------------

    def note_arrival(self, channel: OutChannel, out: OutMessage, now: float) -> None:
        message = out.message
        if message.replay or message.tombstone:
            return
        count = self._arrived[channel.spec.priority]
        rtt_s = self._rtt_s()
        latency_s = max(0.0, now - message.born_s - rtt_s / 2.0)  # the acknowledgement took half a round trip
        count.delivered += 1
        count.latency_s += latency_s
        count.on_time += latency_s <= self._deadline_s(channel)

    def _deadline_s(self, channel: OutChannel) -> float:
        deadline_s = self.params.deadlines_s[channel.spec.priority]
        lifespan_s = channel.spec.lifespan_s
        return deadline_s if lifespan_s is None else max(MIN_DEADLINE_S, min(deadline_s, lifespan_s))

    def _rtt_s(self) -> float:
        rtt_s = self.link.lane.estimator.rtprop_s
        return rtt_s if rtt_s is not None and isfinite(rtt_s) else self.link.lane.flight.rtt.srtt_s or 0.0

    def _coder_s(self) -> float:
        """Processor time of encoding and of making summaries, of all time."""
        made_s = sum(item.cpu_s for item in self._summaries() if item.adapt)
        if self._coder is None:
            return made_s
        return made_s + sum(counters.elapsed_s for counters in self._coder.encoded.values())

    def sample(self) -> None:
        """Read the capacity; about ten times an interval."""
        self._probe.finish()
        capacity_bps = self._capacity_bps()
        if capacity_bps is not None:
            self._samples.append(capacity_bps)

    def _capacity_bps(self) -> float | None:
        """What the path can carry, as far as anybody knows: the estimate, or what is tried; and while there was never
        enough to send to tell it, what the ranges call a full link, or UNFILLED times what was carried if that is
        more."""
        return self._trial.read(self._estimate_bps())

    def _estimate_bps(self) -> float | None:
        link = self.link
        if link.lane.stalled or not link.established:
            return None
        estimator = link.lane.estimator
        if estimator.rate_bps is not None:
            return estimator.rate_bps
        return max(self.params.ranges.bandwidth_max_bps, UNFILLED * (estimator.bound_bps or 0.0))

    def _channels(self) -> list[OutChannel]:
        """Those that somebody wants."""
        return [channel for channel in self.link.sender.channels.values() if channel.wanted and channel.ready]

    def _count(self, channels: Iterable[OutChannel]) -> dict[PriorityClass, _ClassCount]:
        """What the interval brought, by class; the arrivals since the last call are in it."""
        counts, self._arrived = self._arrived, {priority: _ClassCount() for priority in CLASSES}
        by_topic: dict[TopicName, list[OutChannel]] = {}
        for channel in channels:
            by_topic.setdefault(channel.counters.topic, []).append(channel)
        for gone in self._topics.keys() - by_topic.keys():
            self._topics[gone].history.clear()
            if gone not in self.link.sender.ledger.topics:
                del self._topics[gone]
        for topic, mine in by_topic.items():
            counters, count = mine[0].counters, counts[mine[0].spec.priority]
            stats = self._topics.setdefault(topic, _TopicStats())
            thinned = sum(channel.thinned for channel in mine)
            # What its own max_rate_hz leaves out was never meant to be sent, nor what nobody wanted.
            dropped = counters.by_reason
            offered = counters.offered - dropped[DropReason.RATE_CAP] + thinned - dropped[DropReason.UNWANTED]
            raw_bytes = sum(channel.codec.raw_bytes for channel in mine if channel.codec is not None)
            encoded_bytes = sum(channel.codec.encoded_bytes for channel in mine if channel.codec is not None)
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

    def _offers(self, channels: Iterable[OutChannel]) -> list[Offer]:
        return [
            Offer(channel, messages / len(history), nbytes / messages)
            for channel in channels
            if (history := self._topics[channel.counters.topic].history)
            and (messages := sum(part[0] for part in history)) > 0
            and (nbytes := sum(part[1] for part in history)) >= 0
        ]

    def _demands(self, offers: Iterable[Offer], elapsed_s: float) -> tuple[ClassDemand, ...]:
        groups: dict[PriorityClass, list[Offer]] = {}
        for offer in offers:
            groups.setdefault(offer.channel.spec.priority, []).append(offer)
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
                    mean(lambda offer: self._deadline_s(offer.channel)),
                    cv2=spread / mean_bytes**2 if mean_bytes > 0.0 else 0.0,
                    arrival_cv2=ARRIVAL_CV2,
                    topics=len(weighed),
                    depth=max(1, round(mean(lambda offer: _depth(offer.channel)))),
                    needed=self.params.needed[priority],
                    thinnable=min(1.0, mean(lambda offer: float(offer.channel.thinnable))),
                    protected=priority is PriorityClass.CONTROL and not self.link.lane.lossless,
                    codecs={mode: _class_profile(mode, weighed) for mode in self.params.modes if mode != NO_CODEC},
                    prepare_s=mean(lambda offer: offer.prepare_s),
                )
            )
        return tuple(found)

    # --- deciding -------------------------------------------------------------------------------------------------

    def step(self, *, now: float) -> Step:
        """The interval is over: measure it, decide for the next one, apply that."""
        link, params = self.link, self.params
        elapsed_s = max(now - self._since_s, 1e-3)
        channels = self._channels()
        counts = self._count(channels)
        self._probe.abort()
        offers = self._offers(channels)
        demands = self._demands(offers, elapsed_s)
        items = chosen(self._summaries())
        levels = {level: self._demands(offered, elapsed_s) for level, offered in offers_by_level(offers, items)}
        in_force = self.policy.active
        measurement, terms, value = None, None, None
        carried_bps = fmean(self._samples) if self._samples else self._capacity_bps()
        if link.established and any(count.offered for count in counts.values()):
            measurement = self._measure(counts, demands, elapsed_s)
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
                self._estimate_bps(),
                link.lane.estimator.eased_s,
                measurement.classes,
                thinned=min(rates) < 1.0,
                summarised=summarised,
                now=now,
            )
        situation = Situation(
            levels.get(level_of(items), demands),
            LinkState(
                self._capacity_bps(), self._rtt_s(), link.lane.loss, tuple(self._samples), stream=link.lane.lossless
            ),
            levels if items else {},
        )
        self._measured = measurement
        self._since_s, self._wire_bytes, self._encode_s = now, link.lanes.wire_bytes, self._coder_s()
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
        self, counts: dict[PriorityClass, _ClassCount], demands: tuple[ClassDemand, ...], elapsed_s: float
    ) -> Measurement:
        wire_bytes = self.link.lanes.wire_bytes - self._wire_bytes
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
        """Bring every channel and lane in line. Idempotent; what waits or is under way is left as it is."""
        link = self.link
        for channel in link.sender.channels.values():
            priority = channel.spec.priority
            channel.adapt(share=configuration.rates[priority], depth_max=configuration.queues[priority])
            if self._coder is not None and channel.codec is not None:
                mode = channel_mode(channel, configuration.codec)
                if channel.codec.setting is not mode:
                    link.sender.set_compression(channel, mode, now=now)
        for lane in link.lanes.by_id.values():
            lane.copies_wanted = bool(configuration.redundancy)


def channel_mode(channel: OutChannel, mode: str) -> Compression:
    """What the mode z means for one topic: its rule's own setting, if any; of LOSSY_MODE what it allows."""
    if channel.spec.compression is not None:
        return channel.spec.compression
    if mode != LOSSY_MODE:
        return Compression(mode)
    allowed = channel.codec.modes if channel.codec is not None else ()
    return next((found for found in allowed if found in LOSSY), Compression.ZSTD)


def _depth(channel: OutChannel) -> int:
    """Messages that may wait; what may not be left out waits until it is sent."""
    return channel.spec.depth if channel.thinnable else NO_LIMIT


def _class_profile(mode: str, weighed: list[Offer]) -> CodecProfile:
    """What `mode` would make of a class: the mean of its topics, weighed by their bytes."""
    body = encoded = seconds = 0.0
    for channel, per_interval, size, _ in weighed:
        profile = RAW_PROFILE
        if channel.codec is not None:
            profile = channel.codec.profiles.get(channel_mode(channel, mode), RAW_PROFILE)
        nbytes = per_interval * size
        body += nbytes
        encoded += nbytes * min(profile.ratio, 1.0)
        seconds += nbytes / profile.speed_bytes_per_s if profile.speed_bytes_per_s > 0.0 else 0.0
    if body <= 0.0:
        return RAW_PROFILE
    return CodecProfile(encoded / body, body / seconds if seconds > 0.0 else 0.0)
