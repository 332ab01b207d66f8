"""The section `adaptation`: what the multi-metric cost function may choose from and what it is to weigh."""

from collections.abc import Callable, Collection
from dataclasses import replace
from typing import Annotated, Literal

from pydantic import Field, model_validator

from sern_core.adaptation.adapter import AdapterParams
from sern_core.adaptation.cost import SUM_TOLERANCE, Ranges, Weights, profile, profile_floors
from sern_core.adaptation.model import NO_CODEC, Configuration
from sern_core.adaptation.policy import FixedPolicy, Mmcf, Policy, fixed_reliability, fixed_throughput
from sern_core.adaptation.predict import Bounds, Grid, Predictor
from sern_core.vocabulary.types import CLASSES, PriorityClass
from sern_runtime.config.base import Section, fault

_RANGES = Ranges()
_PARAMS = AdapterParams()
Share = Annotated[float, Field(gt=0, le=1)]
ShareOrZero = Annotated[float, Field(ge=0, le=1)]
QueueLimit = Annotated[int, Field(ge=1, le=10_000)]
CodecWord = Literal["none", "lz4", "zstd", "zstd_strong", "lossy"]
MAX_CANDIDATES = 2000


class WeightsSection(Section):
    """w_l, w_r, w_c, w_b of J = w_l·latency + w_r·(1 − reliability) + w_c·CPU + w_b·bandwidth; their sum is 1."""

    latency: ShareOrZero
    """How much late messages matter."""
    reliability: ShareOrZero
    """How much messages matter that do not arrive in time."""
    compute: ShareOrZero
    """How much processor time matters."""
    bandwidth: ShareOrZero
    """How much bytes on the link matter."""

    @model_validator(mode="after")
    def _whole(self) -> "WeightsSection":
        total = self.latency + self.reliability + self.compute + self.bandwidth
        if abs(total - 1.0) > SUM_TOLERANCE:
            raise fault(f"add up to {total:g}: change them so that their sum is 1")
        return self

    def weights(self) -> Weights:
        return Weights(self.latency, self.reliability, self.compute, self.bandwidth)


class RangesSection(Section):
    """What counts as 1 in each term of the cost. Bandwidth counts as a share of what the link can carry."""

    latency_max_s: Annotated[float, Field(gt=0, le=600)] = _RANGES.latency_max_s
    """A mean latency of this or more."""
    compute_max: Annotated[float, Field(gt=0, le=64)] = _RANGES.compute_max
    """Processor seconds a second spent on serialising and compressing."""
    bandwidth_max_bps: Annotated[float, Field(ge=1000, le=1e11)] = _RANGES.bandwidth_max_bps
    """Bits per second; what a link is taken to carry until it has once been full."""
    bandwidth: Literal["capacity", "fixed"] = "capacity"
    """What bandwidth is a share of: `capacity`, what the link can carry now; `fixed`, `bandwidth_max_bps` on every
    link, as printed in the paper (eq. (comp_band_norm)), which starves a wide link."""

    def ranges(self) -> Ranges:
        return Ranges(
            latency_max_s=self.latency_max_s,
            compute_max=self.compute_max,
            bandwidth_max_bps=self.bandwidth_max_bps,
            share_of_capacity=self.bandwidth == "capacity",
        )


class SharesSection(Section):
    """One share of the messages a class."""

    control: Share = 1.0
    """Class control."""
    state: Share = 1.0
    """Class state."""
    bulk: Share = 1.0
    """Class bulk."""

    def values(self) -> tuple[float, float, float]:
        return self.control, self.state, self.bulk


class NeededSection(SharesSection):
    """The share of the offered messages that the other side needs. Sending less counts as unreliability."""

    bulk: Share = _PARAMS.needed[2]
    """Class bulk: two clouds of five will do."""


class FloorsSection(Section):
    """What each class gets where the link can carry it: a configuration of which less would arrive in time is not
    chosen as long as another one brings it. 0: no floor."""

    control: ShareOrZero = 1.0
    """Class control."""
    state: ShareOrZero = 1.0
    """Class state."""
    bulk: ShareOrZero = 1.0
    """Class bulk."""

    def values(self) -> tuple[float, float, float]:
        return self.control, self.state, self.bulk


class DeadlinesSection(Section):
    """Messages that take longer count as not delivered; where a topic's `lifespan_s` is shorter, that counts."""

    control: Annotated[float, Field(gt=0, le=600)] = _PARAMS.deadlines_s[0]
    """Class control."""
    state: Annotated[float, Field(gt=0, le=600)] = _PARAMS.deadlines_s[1]
    """Class state."""
    bulk: Annotated[float, Field(gt=0, le=600)] = _PARAMS.deadlines_s[2]
    """Class bulk."""

    def values(self) -> tuple[float, float, float]:
        return self.control, self.state, self.bulk


class RatesSection(Section):
    """Shares of the messages to choose from; they thin best-effort topics, and no others."""

    control: Annotated[tuple[Share, ...], Field(min_length=1)] = (1.0,)
    """Class control: as it comes."""
    state: Annotated[tuple[Share, ...], Field(min_length=1)] = (1.0, 0.5)
    """Class state."""
    bulk: Annotated[tuple[Share, ...], Field(min_length=1)] = (1.0, 0.6, 0.4, 0.25, 0.1)
    """Class bulk."""


class QueuesSection(Section):
    """Queue limits to choose from, in messages a topic; a topic's own `depth` is never exceeded."""

    control: Annotated[tuple[QueueLimit, ...], Field(min_length=1)] = (10,)
    """Class control."""
    state: Annotated[tuple[QueueLimit, ...], Field(min_length=1)] = (1, 10)
    """Class state."""
    bulk: Annotated[tuple[QueueLimit, ...], Field(min_length=1)] = (1, 10)
    """Class bulk."""


class LimitsSection(Section):
    """What a configuration must keep to. Where none does, those that miss by least are chosen from."""

    min_rates: SharesSection = SharesSection(control=1.0, state=0.5, bulk=0.1)
    """The least share of the messages of each class."""
    compute_max: Annotated[float, Field(gt=0, le=64)] = 1.0
    """Processor seconds a second for serialising and compressing."""


class FixedSection(Section):
    """The configuration of policy `fixed`."""

    rates: SharesSection = SharesSection()
    """Share of the messages of each class."""
    queue_limit: QueueLimit = 10
    """Messages that may wait a topic."""
    codec: CodecWord = "none"
    """How bodies are compressed: `none`, `lz4`, `zstd` or `zstd_strong`."""
    redundancy: bool = False
    """Class control sent twice over the datagram lane."""

    def configuration(self) -> Configuration:
        return Configuration(self.rates.values(), (self.queue_limit,) * 3, self.codec, int(self.redundancy))


class AdaptationSection(Section):
    """Chooses rates, queue limits, compression, redundancy and, for topics whose summary has `adapt`, raw or summary,
    again every interval by their predicted cost (the paper's multi-metric cost function, eq. (mmcf_argmin)). Without
    the section nothing is adapted."""

    policy: Literal["mmcf", "fixed_throughput", "fixed_reliability", "fixed"] = "mmcf"
    """`mmcf`: the cheapest configuration by prediction; `fixed_throughput`, `fixed_reliability`: the paper's baselines;
    `fixed`: the one under `fixed`."""
    profile: Literal["teleoperation", "mapping", "balanced"] = "teleoperation"
    """Named weights: (0.45, 0.30, 0.10, 0.15), (0.10, 0.30, 0.15, 0.45) or 0.25 each."""
    weights: WeightsSection | None = None
    """Weights of your own instead of a profile's."""
    interval_s: Annotated[float, Field(ge=0.2, le=60)] = _PARAMS.interval_s
    """T_cfg: how often a configuration is chosen."""
    ranges: RangesSection = RangesSection()
    """What counts as 1 in each term of the cost."""
    needed: NeededSection = NeededSection()
    """Share of the offered messages that must arrive in time. A relay that is not told otherwise needs all: what its
    clients did not need they have left out."""
    floors: FloorsSection | None = None
    """Share of the offered messages that each class gets where the link can carry it, instead of the profile's:
    teleoperation 1, 1, 1; mapping 1, 0.5, 0.5; balanced 1, 1, 0.6 (control, state, bulk). On a link that is too thin
    for all of them those of more urgent classes come first."""
    deadlines_s: DeadlinesSection = DeadlinesSection()
    """What in time means, by class."""
    rates: RatesSection = RatesSection()
    """Shares of the messages to choose from, r."""
    queues: QueuesSection = QueuesSection()
    """Queue limits to choose from, q."""
    codecs: Annotated[tuple[CodecWord, ...], Field(min_length=1)] = ("none", "lz4", "zstd", "zstd_strong", "lossy")
    """Compression modes to choose from, z, for topics whose rule leaves it open. `lossy`: as far as a topic allows
    (`lossy` in its rule), else `zstd`. A relay forwards bodies unchanged."""
    redundancy: Annotated[tuple[bool, ...], Field(min_length=1)] = (False, True)
    """Whether class control may be sent twice, h, where `link.redundancy` is `auto`."""
    limits: LimitsSection = LimitsSection()
    """What a configuration must keep to."""
    fixed: FixedSection = FixedSection()
    """The configuration of policy `fixed`."""

    @model_validator(mode="after")
    def _finite(self) -> "AdaptationSection":
        rates, queues = self.rates, self.queues
        count = len(self.codecs) * len(self.redundancy)
        for choices in (rates.control, rates.state, rates.bulk, queues.control, queues.state, queues.bulk):
            count *= len(choices)
        if count > MAX_CANDIDATES:
            raise fault(f"gives {count} configurations to choose from, more than {MAX_CANDIDATES}; name fewer")
        if self.policy == "fixed" and self.fixed.codec not in self.codecs:
            raise fault(f"{self.fixed.codec} is not among codecs: {', '.join(self.codecs)}", "fixed", "codec")
        return self

    def cost_weights(self) -> Weights:
        return profile(self.profile) if self.weights is None else self.weights.weights()

    def floor_shares(self) -> tuple[float, float, float]:
        """The floors of control, state and bulk."""
        return profile_floors(self.profile) if self.floors is None else self.floors.values()

    def params(self, *, encodes: bool) -> AdapterParams:
        """`encodes`: bodies are encoded here, not forwarded."""
        return AdapterParams(
            ranges=self.ranges.ranges(),
            weights=self.cost_weights(),
            interval_s=self.interval_s,
            deadlines_s=self.deadlines_s.values(),
            needed=self.needed.values() if encodes or "needed" in self.model_fields_set else (1.0, 1.0, 1.0),
            modes=self.codecs if encodes else (NO_CODEC,),
        )

    def make_policy(self, *, encodes: bool, summarised: Collection[PriorityClass] = ()) -> Callable[[], Policy]:
        """A maker of policies, one a link. `summarised`: classes of topics whose summaries may be chosen."""
        params = self.params(encodes=encodes)
        bounds = Bounds(self.limits.min_rates.values(), self.limits.compute_max)
        if self.policy == "mmcf":
            rates, queues = self.rates, self.queues
            grid = Grid.of(
                rates=(rates.control, rates.state, rates.bulk),
                queues=(queues.control, queues.state, queues.bulk),
                codecs=params.modes,
                redundancy=tuple(int(flag) for flag in self.redundancy),
                summarised=summarised,
            )
            initial = Configuration(
                queues=(max(queues.control), max(queues.state), max(queues.bulk)),
                codec=NO_CODEC,
                summaries=(False,) * len(CLASSES) if summarised else None,
            )
            floors = self.floor_shares()
            return lambda: Mmcf(
                grid, weights=params.weights, ranges=params.ranges, bounds=bounds, floors=floors, initial=initial
            )
        fixed = {
            "fixed_throughput": fixed_throughput(params.modes),
            "fixed_reliability": fixed_reliability(params.modes),
            "fixed": self.fixed.configuration(),
        }[self.policy]
        if not encodes:
            fixed = replace(fixed, codec=NO_CODEC)
        grid = Grid([fixed])
        name = self.policy
        return lambda: FixedPolicy(
            fixed, Predictor(grid, weights=params.weights, ranges=params.ranges, bounds=bounds), name=name
        )
