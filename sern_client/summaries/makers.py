"""What makes the summaries of a topic, and how their streams are treated."""

import logging
from collections.abc import Callable
from dataclasses import replace

from sern_client.summaries.topic_summary import Job, Work
from sern_core.summaries.mask import MaskMaker, MaskParams
from sern_core.summaries.patches import PatchMaker, PatchParams
from sern_core.summaries.scan import ScanMaker, ScanParams
from sern_core.summaries.spec import (
    BEST_EFFORT_KEYFRAME_S,
    SummaryKind,
    SummaryLevel,
    SummarySpec,
    VoxelParams,
)
from sern_core.summaries.voxel import thin_cloud
from sern_core.topics.rules import AUTO, ResolvedTopic, TopicRule
from sern_core.vocabulary.message import KAPPA, TopicInfo, TopicSpec
from sern_core.vocabulary.types import Durability, Encoding, PriorityClass, Reliability

_log = logging.getLogger(__name__)


def work_of(spec: SummarySpec, encoding: Encoding, maker: PatchMaker | None) -> Work:
    """What makes summaries of one topic's messages; `maker` is that of patches."""
    make: Callable[[bytes], bytes]
    match params := spec.params:
        case PatchParams():
            return patch_work(maker or PatchMaker(params, encoding))
        case VoxelParams():

            def make(body: bytes) -> bytes:
                return thin_cloud(body, encoding, params.voxel_m, point=params.point, fields=params.fields)

        case ScanParams():
            scanner = ScanMaker(params)

            def make(body: bytes) -> bytes:
                return scanner.scan(body, encoding)

        case MaskParams():
            masker = MaskMaker(params)

            def make(body: bytes) -> bytes:
                return masker.mask(body, encoding)

    return lambda job: ((0, make(job.body)),)


def patch_work(maker: PatchMaker) -> Work:
    """Stream 0 has the whole grids, stream 1 the updates."""

    def work(job: Job) -> tuple[tuple[int, bytes], ...]:
        change = maker.change(job.body, whole=job.level is SummaryLevel.RAW, now=job.born_s)
        updates = tuple((1, update) for update in change.updates)
        return updates if change.whole is None else ((0, change.whole), *updates)

    return work


def summary_spec(spec: TopicSpec, summary: SummarySpec) -> TopicSpec:
    """How the stream of a summary is treated: as its topic, but for its class, and for the rate, which was capped."""
    priority = summary.priority
    if priority is None:
        obstacle = summary.kind in (SummaryKind.SCAN, SummaryKind.OCCUPANCY_MASK)
        priority = min(PriorityClass.STATE, spec.priority) if obstacle else spec.priority
    weight = spec.weight if priority is spec.priority else KAPPA[priority]
    return replace(spec, priority=priority, weight=weight, max_rate_hz=None)


def patch_specs(spec: TopicSpec, params: PatchParams, rule: TopicRule) -> tuple[TopicSpec, TopicSpec, PatchParams]:
    """How whole grids and updates are treated: reliable unless the rule says otherwise, and latched, so that a late
    joiner gets the last whole grid and all updates since."""
    reliable = rule.reliability is not Reliability.BEST_EFFORT
    whole = replace(
        spec,
        reliability=Reliability.RELIABLE if reliable else Reliability.BEST_EFFORT,
        durability=rule.durability or Durability.TRANSIENT_LOCAL,
        depth=1,
        lifespan_s=None if rule.lifespan_s is AUTO else rule.lifespan_s,
        max_rate_hz=None,
    )
    if not reliable and params.keyframe_s is None:
        params = replace(params, keyframe_s=BEST_EFFORT_KEYFRAME_S)
    return whole, replace(whole, depth=params.keyframe_updates), params


def attributes_of(kind: SummaryKind, topic: str) -> dict[str, str]:
    """What tells a consumer that a stream is a summary, of which kind and of which (global) topic."""
    return {"summary": str(kind), "summary_of": topic}


def fits(info: TopicInfo, resolved: ResolvedTopic) -> tuple[SummarySpec, ...]:
    """The rule's summaries that can be made of this topic's type; the others are logged."""
    found = []
    for spec in resolved.summaries:
        if info.encoding is not Encoding.RAW and info.type_name == spec.kind.source_type:
            found.append(spec)
        else:
            _log.warning("%s is %s, of which no %s is made; it is sent as it is", info.name, info.type_name, spec.kind)
    return tuple(found)
