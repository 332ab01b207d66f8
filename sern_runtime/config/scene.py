"""The section `scene`: the map that sites share, and what goes into it here."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Final

from pydantic import Field, model_validator

from sern_runtime.config.base import ClientText, FileProblem, PathText, Section, TopicText, fault, resolve
from sern_runtime.config.yaml import Loc

MOST_BLOCKS: Final = 1_300
"""Three layers of them are as many objects as a client may have."""


class ScannerSection(Section):
    """A planar scanner of this site, and the robot that carries it."""

    scan: TopicText
    """Its topic (local name): sensor_msgs/LaserScan."""
    pose: TopicText
    """Where its robot is, in the frame of the grid (local name): nav_msgs/Odometry."""
    x_m: Annotated[float, Field(ge=-100, le=100)] = 0.0
    """Where it is on its robot: ahead of where the pose is."""
    y_m: Annotated[float, Field(ge=-100, le=100)] = 0.0
    """To the left of it."""
    yaw_rad: Annotated[float, Field(ge=-math.tau, le=math.tau)] = 0.0
    """Which way it looks."""
    pose_error_m: Annotated[float, Field(ge=0, le=10)] = 0.05
    """How far off the poses may be: what is seen within twice that of where the twin has it is no discrepancy."""


class OriginSection(Section):
    """A place on the Earth, as sensor_msgs/NavSatFix has it."""

    latitude_deg: Annotated[float, Field(gt=-90, lt=90)]
    """To the north."""
    longitude_deg: Annotated[float, Field(ge=-180, le=180)]
    """To the east."""
    height_m: Annotated[float, Field(ge=-1000, le=10_000)] = 0.0
    """Above the ellipsoid, or whatever the elevation model has its heights above."""


class UpdateRateSection(Section):
    """How often what scanners see is told, by how far it is from them. Where somebody added something counts as near
    them."""

    important_m: Annotated[float, Field(ge=0, le=10_000)] = 8.0
    """Blocks so near a scanner are told as often as they change, ten times a second at most."""
    near_m: Annotated[float, Field(gt=0, le=10_000)] = 8.0
    """Blocks so near those are told every `medium_s`."""
    far_m: Annotated[float, Field(gt=0, le=10_000)] = 12.0
    """They are so until they are so far away. More than `near_m`."""
    medium_s: Annotated[float, Field(ge=0, le=60)] = 0.5
    """How often blocks near those are told, at most."""
    low_s: Annotated[float, Field(ge=0, le=600)] = 2.0
    """How often all others are told, at most."""

    @model_validator(mode="after")
    def _rises(self) -> "UpdateRateSection":
        if self.near_m >= self.far_m:
            raise fault(f"{self.far_m} is to be more than near_m, {self.near_m}", "far_m")
        return self


class SceneSection(Section):
    """The scene that sites share: what their scanners see and what people add, as one map at each site. All sites of a
    scene need the same name and grid."""

    name: ClientText
    """Its name; its patches are the objects /scene/NAME/..., which access rules name so."""
    west_m: Annotated[float, Field(ge=-1e6, le=1e6)]
    """Where the grid begins, in its frame."""
    south_m: Annotated[float, Field(ge=-1e6, le=1e6)]
    """Where the grid begins, in its frame."""
    width_m: Annotated[float, Field(gt=0, le=10_000)]
    """How far it goes to the east."""
    length_m: Annotated[float, Field(gt=0, le=10_000)]
    """How far it goes to the north."""
    cell_m: Annotated[float, Field(gt=0, le=100)] = 0.1
    """The side of a cell."""
    block_cells: Annotated[int, Field(ge=4, le=48)] = 16
    """Cells along the side of a block: what is sent where one of them changes."""
    frame_id: str = "map"
    """The frame of the grid; poses and obstacles are in it as well."""
    origin: OriginSection | None = None
    """Where the origin of the frame is on the Earth; needed for `base` and `terrain`."""
    scanners: Annotated[tuple[ScannerSection, ...], Field(max_length=16)] = ()
    """What sees the scene here."""
    obstacles: TopicText | None = None
    """Topic of this site (local name) by which people add obstacles to the scene: visualization_msgs/Marker, cubes,
    spheres and cylinders, as rviz and scripts publish them; a marker that is deleted is taken back."""
    lasting: Annotated[tuple[Annotated[str, Field(max_length=100)], ...], Field(max_length=16)] = ("lasting",)
    """Namespaces of markers that are of holes, or of whatever else no scanner sees: they stay on the map of all sites
    until they are deleted, and are no phantoms."""
    corrects: bool = True
    """Whether what scanners here see corrects the map of all sites: a phantom is free there for as long as it is one,
    although somebody added it or `base` has it."""
    base: PathText | None = None
    """A map of the site that is the ground of the scene: .osm, .osm.pbf or .geojson. Buildings, barriers and water are
    occupied, roads and paths free. One site is enough."""
    terrain: PathText | None = None
    """An elevation model of the site, such as a GeoTIFF: the ground on which the page of sern-twin shows it, with the
    buildings of `base`."""
    rates: UpdateRateSection = UpdateRateSection()
    """How often what scanners see here is told."""
    publish: TopicText = "/scene/map"
    """Where the map is published here: nav_msgs/OccupancyGrid, and what changes beside it under NAME_updates. sern-twin
    publishes it for all sites as PREFIX/scene/map."""
    discrepancies: TopicText = "/scene/discrepancies"
    """Where it is published what scanners of any site see and the twin does not have, and the other way round:
    visualization_msgs/MarkerArray. sern-twin publishes it as PREFIX/scene/discrepancies."""

    @property
    def columns(self) -> int:
        return math.ceil(self.width_m / self.cell_m - 1e-9)

    @property
    def rows(self) -> int:
        return math.ceil(self.length_m / self.cell_m - 1e-9)

    @model_validator(mode="after")
    def _fits(self) -> "SceneSection":
        blocks = math.ceil(self.columns / self.block_cells) * math.ceil(self.rows / self.block_cells)
        if blocks > MOST_BLOCKS:
            raise fault(
                f"a grid of {self.columns} x {self.rows} cells has {blocks} blocks, and {MOST_BLOCKS} are the most; "
                "take larger cells, or more block_cells",
                "cell_m",
            )
        for key in ("base", "terrain"):
            if getattr(self, key) is not None and self.origin is None:
                raise fault(f"is needed for {key}: where the frame's origin is on the Earth", "origin")
        return self

    def file_problems(self, base_dir: Path, loc: Loc) -> Iterator[FileProblem]:
        for key in ("base", "terrain"):
            text = getattr(self, key)
            if text is not None and not (path := resolve(base_dir, text)).is_file():
                yield FileProblem((*loc, key), f"{path}: no such file")
