"""Summary sections of a topic rule: compact equivalents of heavy messages."""

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Discriminator, Field, Tag, model_validator

from sern_core.stream.latched import MAX_REPLAY_MESSAGES
from sern_core.summaries.mask import MAX_CELLS, MaskParams
from sern_core.summaries.obstacles import Band
from sern_core.summaries.patches import PatchParams
from sern_core.summaries.scan import MAX_BEAMS, ScanParams
from sern_core.summaries.spec import SummaryLevel, SummarySpec, VoxelParams
from sern_core.summaries.voxel import VoxelPoint
from sern_core.vocabulary.errors import UsageError
from sern_core.vocabulary.names import topic_name
from sern_core.vocabulary.types import PriorityClass
from sern_runtime.config.base import Seconds, Section, fault
from sern_runtime.config.shared import ClassWord

_BAND = Band()
_VOXEL = VoxelParams()
_MASK = MaskParams()
_SCAN = ScanParams()
_PATCH = PatchParams()


def _check_name(text: str) -> str:
    try:
        topic_name(text if text.startswith("/") else f"/topic/{text}")
    except UsageError as error:
        raise fault(f"must be a name to put behind the topic's, such as thin, or a topic name: {error}") from error
    return text


def _check_kept(count: int) -> int:
    if count > MAX_REPLAY_MESSAGES:
        kept = "the messages of a topic that a relay keeps for late joiners"
        raise fault(f"must be <= {MAX_REPLAY_MESSAGES}, {kept}, not {count}")
    return count


SummaryName = Annotated[str, AfterValidator(_check_name)]
Metres = Annotated[float, Field(gt=0, le=1e4)]


class SummaryBase(Section):
    """What all summaries share."""

    def priority_class(self) -> PriorityClass | None:
        word: ClassWord | None = getattr(self, "priority", None)
        return None if word is None else PriorityClass[word.upper()]


class BesideBase(SummaryBase):
    """A summary that is a topic of its own."""

    level: Literal["summary", "raw", "auto"] = "summary"
    """What is sent at first: `summary`, or `raw`: the messages as they come. `auto`: as they come while the link
    carries them within their lifespan, else the summary; for topics that are best effort."""
    adapt: bool = False
    """Let the section `adaptation` choose the level: the messages as they come where the link carries what is needed
    of them, else the summary. Both topics must be subscribed to at the other side."""
    name: Annotated[SummaryName | None, Field(alias="as")] = None
    """What is put behind the topic's name, or another topic name (with a plain name in `match`); null: `voxel`,
    `scan` or `mask`, such as /points/scan."""
    priority: Annotated[ClassWord | None, Field(alias="class")] = None
    """Its urgency; null: `state` for scan and mask, else that of the topic."""
    beside: bool = False
    """Send the topic itself as well."""

    @model_validator(mode="after")
    def _either(self) -> "BesideBase":
        for key, chooses in (("adapt", self.adapt), ("level", self.level == "auto")):
            if chooses and self.beside:
                raise fault("chooses between the topic and its summary; leave `beside` out", key)
        if self.adapt and self.level == "auto":
            raise fault("auto leaves nothing for `adapt` to choose; give one of them", "level")
        return self

    def summary(self, params: VoxelParams | ScanParams | MaskParams) -> SummarySpec:
        """What is made, with what is said of it here."""
        auto = self.level == "auto"
        return SummarySpec(
            params,
            SummaryLevel.RAW if auto else SummaryLevel(self.level),
            self.name,
            self.priority_class(),
            self.beside,
            self.adapt,
            by_link=auto,
        )


class BandBase(BesideBase):
    """What counts as in the robot's way. Heights are above the ground, the cloud's frame is upright."""

    sensor_height_m: Annotated[float, Field(ge=0, le=100)] | None = None
    """Height of the cloud's frame above level ground (0 for base_link); null: fit the ground to each cloud."""
    min_height_m: Annotated[float, Field(ge=-10, le=100)] = _BAND.min_height_m
    """Lower things are ground."""
    max_height_m: Annotated[float, Field(ge=-10, le=100)] = _BAND.max_height_m
    """Higher things are driven under."""
    drop_off_m: Metres = _BAND.drop_off_m
    """Ground so far below the rest of it is an obstacle as well."""
    drop_off_range_m: Metres = _BAND.drop_off_range_m
    """Nearer than this; further off, a slope looks the same."""
    min_range_m: Annotated[float, Field(ge=0, le=1e4)] = _BAND.min_range_m
    """Nearer points are the robot itself."""
    max_range_m: Metres = _BAND.max_range_m
    """Points further off are left out."""

    @model_validator(mode="after")
    def _ordered(self) -> "BandBase":
        for low, high in (("min_height_m", "max_height_m"), ("min_range_m", "max_range_m")):
            if getattr(self, low) >= getattr(self, high):
                raise fault(f"must be below {high} ({getattr(self, high):g})", low)
        return self

    def band(self) -> Band:
        return Band(**{name: getattr(self, name) for name in Band.__dataclass_fields__})


class VoxelSummary(BesideBase):
    """Point cloud to a thinner point cloud: one point for each occupied cube."""

    kind: Literal["voxel"]
    """A thinner point cloud."""
    voxel_m: Annotated[float, Field(ge=0.001, le=1000)] = _VOXEL.voxel_m
    """Edge of the cubes."""
    point: VoxelPoint = _VOXEL.point
    """`centroid`: the mean of the cube's points; `first`: one of them as it is."""
    fields: tuple[str, ...] | None = None
    """Fields to keep beside x, y and z, such as [intensity]; null: all."""
    in_place: bool = False
    """Under the topic's own name instead of a name of its own."""

    @model_validator(mode="after")
    def _one_name(self) -> "VoxelSummary":
        if self.in_place and (self.name is not None or self.beside or self.priority is not None):
            raise fault("leaves no room for `as`, `class` or `beside`: there is only the topic itself", "in_place")
        return self

    def spec(self) -> SummarySpec:
        return self.summary(VoxelParams(self.voxel_m, self.point, self.fields, self.in_place))


class ScanSummary(BandBase):
    """Point cloud to a 2-D scan: the nearest obstacle at each bearing."""

    kind: Literal["scan"]
    """A 2-D scan (sensor_msgs/LaserScan)."""
    beams: Annotated[int, Field(ge=4, le=MAX_BEAMS)] = _SCAN.beams
    """Bearings around the robot."""

    def spec(self) -> SummarySpec:
        return self.summary(ScanParams(self.band(), self.beams))


class MaskSummary(BandBase):
    """Point cloud to a grid around the robot: occupied, free or unknown."""

    kind: Literal["occupancy_mask"]
    """A grid around the robot (nav_msgs/OccupancyGrid)."""
    size_m: Metres = _MASK.size_m
    """Side of the square."""
    resolution_m: Metres = _MASK.resolution_m
    """Side of a cell."""

    @model_validator(mode="after")
    def _bounded(self) -> "MaskSummary":
        if self.size_m / self.resolution_m > MAX_CELLS**0.5:
            raise fault(f"makes a mask of more than {MAX_CELLS} cells", "resolution_m")
        return self

    def spec(self) -> SummarySpec:
        return self.summary(MaskParams(self.band(), self.size_m, self.resolution_m))


class PatchesSummary(SummaryBase):
    """Occupancy grid to its changes: whole grids now and then, changed rectangles on <topic>_updates in between."""

    kind: Literal["patches"]
    """The changed cells of an occupancy grid."""
    level: SummaryLevel = SummaryLevel.SUMMARY
    """What is sent at first: `summary`, or `raw`: the messages as they come. May change while it runs."""
    keyframe_updates: Annotated[
        int, Field(ge=2, json_schema_extra={"maximum": MAX_REPLAY_MESSAGES}), AfterValidator(_check_kept)
    ] = _PATCH.keyframe_updates
    """A whole grid after so many updates at the latest; also what a late joiner gets at most, and so no more than a
    relay keeps."""
    keyframe_part: Annotated[float, Field(gt=0, le=1)] = _PATCH.keyframe_part
    """A whole grid when the changes are more than this part of it."""
    keyframe_s: Seconds | None = None
    """A whole grid when the last one is older and something changed since; null: 10 if best effort, else never."""

    def spec(self) -> SummarySpec:
        return SummarySpec(PatchParams(self.keyframe_updates, self.keyframe_part, self.keyframe_s), self.level)


SummarySection = Annotated[
    VoxelSummary | ScanSummary | MaskSummary | PatchesSummary, Field(discriminator="kind")
]  # fmt: skip


def one_or_list(value: Any) -> str:
    """The discriminator of a section that may stand alone or in a list."""
    return "<list>" if isinstance(value, (list, tuple)) else "<one>"


OneOrMoreSummaries = Annotated[
    Annotated[SummarySection, Tag("<one>")] | Annotated[tuple[SummarySection, ...], Tag("<list>")],
    Discriminator(one_or_list),
]


def specs(section: OneOrMoreSummaries) -> tuple[SummarySpec, ...]:
    """The summaries as the core reads them."""
    sections = section if isinstance(section, tuple) else (section,)
    return tuple(item.spec() for item in sections)
