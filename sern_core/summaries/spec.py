"""What a topic rule says about summaries, as plain data."""

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final

from sern_core.summaries.clouds import CLOUD_TYPE
from sern_core.summaries.grids import GRID_TYPE
from sern_core.summaries.mask import MaskParams
from sern_core.summaries.patches import PatchParams
from sern_core.summaries.scan import SCAN_TYPE, ScanParams
from sern_core.summaries.voxel import VoxelPoint
from sern_core.vocabulary.message import TopicInfo, TopicSpec
from sern_core.vocabulary.types import Encoding, PriorityClass, Reliability

BEST_EFFORT_KEYFRAME_S: Final = 10.0
"""How often a changed grid is repeated whole where patches can be lost without a word."""


class SummaryKind(StrEnum):
    VOXEL = "voxel"
    SCAN = "scan"
    OCCUPANCY_MASK = "occupancy_mask"
    PATCHES = "patches"

    @property
    def source_type(self) -> str:
        return GRID_TYPE if self is SummaryKind.PATCHES else CLOUD_TYPE

    @property
    def result_type(self) -> str:
        """What is published in place of the raw message; patches come together as whole grids again."""
        return {SummaryKind.VOXEL: CLOUD_TYPE, SummaryKind.SCAN: SCAN_TYPE}.get(self, GRID_TYPE)


class SummaryLevel(StrEnum):
    RAW = "raw"  # messages as they come
    SUMMARY = "summary"


class TooLarge(StrEnum):
    """What becomes of a cloud that cannot arrive within its lifespan at what the link carries."""

    SUMMARY = "summary"  # a thinner one goes in its place
    DROP = "drop"


@dataclass(frozen=True, slots=True)
class SummaryProfile:
    """What a summary costs and saves, measured; smoothed over about five messages. Zero until something came."""

    messages: int = 0
    """Messages summarised."""
    rate_hz: float = 0.0
    """Raw messages a second, over the last 20."""
    raw_bytes: float = 0.0
    """Size of a raw message."""
    bytes_ratio: float = 0.0
    """Size of what is sent for one, as a part of it."""
    seconds_per_message: float = 0.0
    """Processor time of making it."""


@dataclass(frozen=True, slots=True)
class VoxelParams:
    """`fields`: only these beside x, y and z; None: all. `in_place`: under the topic's own name."""

    voxel_m: float = 0.1
    point: VoxelPoint = VoxelPoint.CENTROID
    fields: tuple[str, ...] | None = None
    in_place: bool = False


@dataclass(frozen=True, slots=True)
class SummarySpec:
    """One summary of a topic. `name`: what is put behind the topic's name, or a whole name if it begins with `/`;
    None: its kind's. `priority` None: state for scans and masks, else as the topic. `beside`: the raw topic is sent as
    well, whatever the level. `adapt`: the adaptation may choose the level. `by_link`: the level is raw while the link
    carries the messages within their lifespan, else summary."""

    params: VoxelParams | ScanParams | MaskParams | PatchParams = field(default_factory=VoxelParams)
    level: SummaryLevel = SummaryLevel.SUMMARY
    name: str | None = None
    priority: PriorityClass | None = None
    beside: bool = False
    adapt: bool = False
    by_link: bool = False

    @property
    def kind(self) -> SummaryKind:
        match self.params:
            case VoxelParams():
                return SummaryKind.VOXEL
            case ScanParams():
                return SummaryKind.SCAN
            case MaskParams():
                return SummaryKind.OCCUPANCY_MASK
            case PatchParams():
                return SummaryKind.PATCHES

    @property
    def shares_topic(self) -> bool:
        """Whether raw messages and summaries are messages of one stream."""
        return isinstance(self.params, PatchParams) or (isinstance(self.params, VoxelParams) and self.params.in_place)

    def topic(self, topic: str) -> str:
        """What the summary of `topic` is called; of patches, the stream of the updates."""
        if isinstance(self.params, PatchParams):
            return topic + "_updates"
        if self.shares_topic:
            return topic
        name = self.name or {SummaryKind.OCCUPANCY_MASK: "mask"}.get(self.kind, str(self.kind))
        return name if name.startswith("/") else f"{topic}/{name}"


STAND_IN: Final = SummarySpec(VoxelParams(voxel_m=0.2, in_place=True), SummaryLevel.RAW, by_link=True)
"""What goes in the place of a cloud whose rule has no summary, while the link is too slow for the cloud."""


def stand_ins(info: TopicInfo, spec: TopicSpec) -> tuple[SummarySpec, ...]:
    """STAND_IN where it can be of use to a topic without a summary of its own."""
    clouds = info.type_name == CLOUD_TYPE and info.encoding is not Encoding.RAW
    best_effort = spec.reliability is Reliability.BEST_EFFORT and not spec.latched
    bulk = spec.priority is PriorityClass.BULK and spec.lifespan_s is not None
    return (STAND_IN,) if clouds and best_effort and bulk else ()
