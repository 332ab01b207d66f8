"""The file of a node that navigates (`sern-navigation`): its ROS graph, topics and robot, and Nav2's parameters."""

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Discriminator, Field, Tag, model_validator

from sern_core.vocabulary.errors import UsageError
from sern_navigation.collision_monitor import MonitorOptions
from sern_navigation.costmap.inflation import InflationOptions
from sern_navigation.costmap.layered import CostmapOptions
from sern_navigation.costmap.obstacles import ObstacleOptions
from sern_navigation.costmap.static import StaticOptions
from sern_navigation.costmap.twin import TwinOptions
from sern_navigation.global_plan import PlannerOptions
from sern_navigation.mapping import MapperOptions
from sern_navigation.mppi import MppiOptions
from sern_navigation.navigator import NavigatorOptions
from sern_navigation.recovery import RecoveryOptions
from sern_navigation.scan import ScanOptions
from sern_runtime.config.base import (
    FileModel,
    FileProblem,
    PathText,
    Seconds,
    Section,
    TopicText,
    fault,
    missing_directories,
    resolve,
    unexpected,
)
from sern_runtime.config.endpoints import (
    DdsEndpoint,
    RclpyEndpoint,
    Ros1Endpoint,
    ZenohEndpoint,
    installing,
    missing_package,
)
from sern_runtime.config.load import Loaded, load
from sern_runtime.config.mirrored import SectionOf, leave_out
from sern_runtime.config.shared import HttpSection, LogSection
from sern_runtime.config.yaml import Data
from sern_twin.world.grid import Grid

leave_out(
    {
        ScanOptions: frozenset({"frame_id", "origin_m"}),
        NavigatorOptions: frozenset({"scan", "costmap", "planner", "controller", "monitor", "recovery"}),
    }
)

NodeEndpoint = Annotated[Ros1Endpoint | DdsEndpoint | ZenohEndpoint | RclpyEndpoint, Field(discriminator="kind")]
_EXPECTED = unexpected("an endpoint of kind ros1, dds, zenoh or rclpy, or a list of them")


def _count(value: Any) -> str | None:
    return "one" if isinstance(value, (dict, Section)) else "list" if isinstance(value, (list, tuple)) else None


class GridSection(Section):
    """The site as the robot has it: all plans, maps and costs are on this grid. A map or a twin on another one is not
    used, and that is said."""

    west_m: Annotated[float, Field(ge=-1e6, le=1e6)]
    """West edge of the grid, in its frame."""
    south_m: Annotated[float, Field(ge=-1e6, le=1e6)]
    """South edge of the grid, in its frame."""
    width_m: Annotated[float, Field(gt=0, le=10_000)]
    """How far it goes to the east."""
    length_m: Annotated[float, Field(gt=0, le=10_000)]
    """How far it goes to the north."""
    cell_m: Annotated[float, Field(gt=0, le=100)] = 0.1
    """The side of a cell (Nav2's `resolution`)."""
    block_cells: Annotated[int, Field(ge=4, le=48)] = 16
    """Cells along the side of a block: what is published where the robot's own map changes."""
    frame_id: str = "map"
    """The frame of the grid, of goals, and of the odometry unless `localisation` is `scans` (Nav2's `global_frame`)."""

    @property
    def grid(self) -> Grid:
        """UsageError: there are too many cells or blocks."""
        columns, rows = (math.ceil(size / self.cell_m - 1e-9) for size in (self.width_m, self.length_m))
        return Grid(
            self.west_m, self.south_m, self.cell_m, columns, rows, self.block_cells, frame_id=self.frame_id
        )  # fmt: skip

    @model_validator(mode="after")
    def _fits(self) -> "GridSection":
        try:
            _ = self.grid
        except UsageError as error:
            raise fault(str(error), "cell_m") from error
        return self


class NavigationTopics(Section):
    """The topics of the robot, as the ROS graph has them."""

    cloud: TopicText = "/points"
    """What its lidar sees: sensor_msgs/PointCloud2."""
    odometry: TopicText = "/odometry/filtered"
    """The robot's place: nav_msgs/Odometry, in the frame of the grid, or in any with `localisation: scans`."""
    map: TopicText | None = None
    """The map of the site (nav_msgs/OccupancyGrid), whose obstacles are never driven into; null: there is none."""
    twin: TopicText | None = None
    """What the twin has, which its client brings: nav_msgs/OccupancyGrid and, under NAME_updates, what changes in it.
    It makes ways dearer and closes none. null: there is no twin."""
    goal: TopicText | None = "/goal_pose"
    """Goals as rviz gives them: geometry_msgs/PoseStamped. null: by the action alone."""
    link: TopicText | None = None
    """The state of the link as its client says it (/sern/link, diagnostic_msgs/DiagnosticStatus), for `on_link_loss`;
    null: it does not matter."""
    command: TopicText = "/cmd_vel"
    """What the base drives by: geometry_msgs/Twist, or TwistStamped with `stamped`."""
    plan: TopicText = "/plan"
    """The way to the goal: nav_msgs/Path."""
    trajectory: TopicText = "/optimal_trajectory"
    """What the controller is about to drive: nav_msgs/Path."""
    costmap: TopicText = "/local_costmap/costmap"
    """Costs around the robot, twice a second: nav_msgs/OccupancyGrid."""
    scan: TopicText = "/obstacle_scan"
    """What of each cloud stands in the way, edges of the ground among it: sensor_msgs/LaserScan. It is infinite where
    the ground was seen to be free, and NaN where nothing was seen; a scene takes it as a scanner of its robot."""
    own_map: TopicText = "/map"
    """The robot's own map, with `localisation: scans`: nav_msgs/OccupancyGrid, and under NAME_updates what changes."""
    status: TopicText = "/navigation/status"
    """What it is doing, in words and values: diagnostic_msgs/DiagnosticArray."""
    action: TopicText = "/navigate_to_pose"
    """Name of the action: nav2_msgs/NavigateToPose, in ROS 1 move_base_msgs/MoveBase."""


class LidarSection(Section):
    """The lidar's place on the robot, from the ground below its middle."""

    x_m: Annotated[float, Field(ge=-10, le=10)] = 0.0
    """Distance ahead of it."""
    y_m: Annotated[float, Field(ge=-10, le=10)] = 0.0
    """Distance to the left of it."""
    z_m: Annotated[float, Field(gt=0, le=10)] = 0.4
    """Height above the ground."""
    roll_rad: Annotated[float, Field(ge=-math.pi, le=math.pi)] = 0.0
    """Turn about its own axis ahead (REP 103)."""
    pitch_rad: Annotated[float, Field(ge=-math.pi, le=math.pi)] = 0.0
    """Nose down is positive."""
    yaw_rad: Annotated[float, Field(ge=-math.pi, le=math.pi)] = 0.0
    """Turn to the left."""
    frame_id: str | None = None
    """Clouds of another frame are not used; null: of any."""


class PerceptionSection(Section):
    """What is in each cloud, for people and other nodes; the robot does not drive by it. Needs the extra `seg`."""

    labels: TopicText = "/perception/points"
    """The points with their classes: sensor_msgs/PointCloud2 with a field `label`, 0 where nothing is known."""
    obstacles: TopicText = "/perception/obstacles"
    """What stands in the way, whatever it is, as boxes with the class of most of its points:
    visualization_msgs/MarkerArray."""
    rate_hz: Annotated[float, Field(gt=0, le=20)] = 5.0
    """Clouds a second that are looked at, at most."""
    rings: Annotated[int, Field(ge=8, le=128)] = 16
    """Rings of the scanner."""
    columns: Annotated[int, Field(ge=64, le=4096)] = 900
    """Points of a ring in one turn."""
    low_deg: Annotated[float, Field(ge=-80, le=80)] = -15.0
    """Elevation of its lowest ring."""
    high_deg: Annotated[float, Field(ge=-80, le=80)] = 15.0
    """Elevation of its highest ring. More than `low_deg`."""
    model: PathText | None = None
    """A network of your own (ONNX, as `python -m sern_perception.training train` makes it); null: the one that comes
    with SERN."""

    @model_validator(mode="after")
    def _rises(self) -> "PerceptionSection":
        if self.high_deg <= self.low_deg:
            raise fault(f"{self.high_deg} is to be more than low_deg, {self.low_deg}", "high_deg")
        return self


class NavigationFile(FileModel):
    """A node that drives a robot to its goals by its own sensors, and asks the twin which way. The keys of Nav2's
    parts are called as there, and mean the same."""

    endpoint: Annotated[
        Annotated[NodeEndpoint, Tag("one")]
        | Annotated[tuple[NodeEndpoint, ...], Field(min_length=1, max_length=2), Tag("list")],
        Discriminator(
            _count,
            custom_error_type=_EXPECTED.type,
            custom_error_message=_EXPECTED.message_template,
            custom_error_context=_EXPECTED.context,
        ),
    ]
    """The ROS graph of the robot; for topics by `dds` and the action by `rclpy`, both."""
    grid: GridSection
    """The site."""
    topics: NavigationTopics = NavigationTopics()
    """What is heard and said."""
    lidar: LidarSection = LidarSection()
    """Its scanner."""
    base_frame: str = "base_link"
    """The frame of the robot, of which stamped commands are."""
    stamped: bool = False
    """Commands are TwistStamped, as Jazzy's and later bases want them."""
    yaw_scale: Annotated[float, Field(gt=0.05, le=5)] = 1.0
    """How much the base turns of what it is told; wheels that skid turn less."""
    stamps: Literal["header", "arrival"] = "header"
    """The time of a cloud or a pose: as its header says by this machine's clock, or when it came, where headers have a
    time of their own (a simulator's)."""
    localisation: Literal["odometry", "scans"] = "odometry"
    """`odometry`: it says where the robot is on the grid. `scans`: it drifts, and is corrected by matching each scan
    with the map that the robot makes of all; /tf then has where its frame lies."""
    start: Annotated[tuple[float, float, float], Field(min_length=3, max_length=3)] = (0.0, 0.0, 0.0)
    """The place on the grid where the odometry begins, with `localisation: scans`: [x_m, y_m, yaw_rad]."""
    on_link_loss: Literal["continue", "wait", "abort"] = "continue"
    """While `topics.link` says that the operator cannot be reached: `continue` to the goal, stand and `wait` until the
    link is back, or `abort` the goal."""
    link_timeout_s: Seconds = 5.0
    """The link counts as lost without a word on `topics.link` for so long: the robot's client is not there."""
    seed: Annotated[int, Field(ge=0, lt=1 << 63)] = 1
    """Start value of the controller's random trajectories."""
    navigator: SectionOf[NavigatorOptions] = Field(default_factory=SectionOf[NavigatorOptions])
    """What counts as reached, and as no progress (Nav2's goal and progress checkers)."""
    planner: SectionOf[PlannerOptions] = Field(default_factory=SectionOf[PlannerOptions])
    """The way to the goal (Nav2's planner server with a 2-D planner)."""
    controller: SectionOf[MppiOptions] = Field(default_factory=SectionOf[MppiOptions])
    """What is driven next (Nav2's controller server with MPPI)."""
    static_layer: SectionOf[StaticOptions] = Field(default_factory=SectionOf[StaticOptions])
    """Costs of the map."""
    obstacle_layer: SectionOf[ObstacleOptions] = Field(default_factory=SectionOf[ObstacleOptions])
    """Costs of what is seen."""
    inflation_layer: SectionOf[InflationOptions] = Field(default_factory=SectionOf[InflationOptions])
    """Costs near obstacles."""
    twin_layer: SectionOf[TwinOptions] = Field(default_factory=SectionOf[TwinOptions])
    """Costs of what the twin has."""
    collision_monitor: SectionOf[MonitorOptions] = Field(default_factory=SectionOf[MonitorOptions])
    """The last word on every command, by real scans alone."""
    behaviors: SectionOf[RecoveryOptions] = Field(default_factory=SectionOf[RecoveryOptions])
    """What is tried when the robot is stuck."""
    scan: SectionOf[ScanOptions] = Field(default_factory=SectionOf[ScanOptions])
    """What counts as an obstacle in a cloud."""
    mapping: SectionOf[MapperOptions] = Field(default_factory=SectionOf[MapperOptions])
    """How scans are matched and laid down, with `localisation: scans`."""
    perception: PerceptionSection | None = None
    """Classes of points, and boxes; null: there are none."""
    type_paths: tuple[PathText, ...] = ()
    """Directories with .action files, where nav2_msgs is of another distribution than what is installed here or what
    SERN ships (Jazzy's)."""
    http: HttpSection = HttpSection()
    """The HTTP server with /metrics and /api/navigation."""
    log: LogSection = LogSection()
    """The log."""

    @classmethod
    def foreign(cls, data: Mapping[str, Data]) -> str | None:
        needed = "a navigation file is needed here (endpoint, grid)"
        if "sern_key" in data:
            return f"is a key file; {needed}"
        if "relay" in data:
            program = "sern-client" if "endpoint" in data else "sern-relay"
            return f"is a file that {program} reads; {needed}"
        return None

    @property
    def endpoints(self) -> tuple[Ros1Endpoint | DdsEndpoint | ZenohEndpoint | RclpyEndpoint, ...]:
        return self.endpoint if isinstance(self.endpoint, tuple) else (self.endpoint,)

    @model_validator(mode="after")
    def _fits(self) -> "NavigationFile":
        kinds = {endpoint.kind == "ros1" for endpoint in self.endpoints}
        if len(kinds) > 1:
            raise fault("is of ROS 1 and of ROS 2: a node is of one of them", "endpoint")
        if self.on_link_loss != "continue" and self.topics.link is None:
            raise fault("needs topics.link, such as /sern/link: without it nobody says that the link is lost",
                        "on_link_loss")  # fmt: skip
        try:
            self.options()
        except UsageError as error:
            raise fault(str(error)) from error
        return self

    def options(self) -> NavigatorOptions:
        """The navigator's options. UsageError: they do not fit together."""
        lidar = self.lidar
        costmap = CostmapOptions(
            self.static_layer.made(), self.obstacle_layer.made(), self.inflation_layer.made(), self.twin_layer.made()
        )
        return self.navigator.made(
            scan=self.scan.made(origin_m=(lidar.x_m, lidar.y_m, lidar.z_m), frame_id=self.base_frame),
            costmap=costmap,
            planner=self.planner.made(),
            controller=self.controller.made(),
            monitor=self.collision_monitor.made(),
            recovery=self.behaviors.made(),
        )

    def file_problems(self, base_dir: Path) -> Iterator[FileProblem]:
        several = isinstance(self.endpoint, tuple)
        for index, endpoint in enumerate(self.endpoints):
            yield from endpoint.file_problems(base_dir, ("endpoint", index) if several else ("endpoint",))
        yield from self.http.problems(base_dir)
        yield from missing_directories(base_dir, self.type_paths, ("type_paths",))
        perception = self.perception
        if perception is not None and perception.model is not None:
            path = resolve(base_dir, perception.model)
            if not path.is_file():
                yield FileProblem(("perception", "model"), f"{path}: no such file")
        if perception is not None:
            yield from missing_package("onnxruntime", installing("'sern[seg]'"), (), "perception")


def load_navigation(path: Path, *, files: bool = True) -> Loaded[NavigationFile]:
    """The navigation file at `path`; raises ConfigError. `files`: also check the files that it names."""
    return load(path, NavigationFile, files=files)
