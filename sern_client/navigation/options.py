"""What a node that navigates is told by its file; `sern_runtime/config/navigation.py` says what each means."""

from dataclasses import dataclass, field
from enum import StrEnum

from sern_navigation.mapping import MapperOptions
from sern_navigation.navigator import NavigatorOptions


class OnLinkLoss(StrEnum):
    """What becomes of a goal while the operator cannot be reached."""

    CONTINUE = "continue"
    WAIT = "wait"
    ABORT = "abort"


class Stamps(StrEnum):
    """The time that a message is of."""

    HEADER = "header"
    ARRIVAL = "arrival"


class Localisation(StrEnum):
    ODOMETRY = "odometry"
    SCANS = "scans"


@dataclass(frozen=True, slots=True)
class TopicNames:
    """Local names; None: there is no such topic."""

    cloud: str = "/points"
    odometry: str = "/odometry/filtered"
    map: str | None = None
    twin: str | None = None
    goal: str | None = "/goal_pose"
    link: str | None = None
    command: str = "/cmd_vel"
    plan: str = "/plan"
    trajectory: str = "/optimal_trajectory"
    costmap: str = "/local_costmap/costmap"
    scan: str = "/obstacle_scan"
    own_map: str = "/map"
    status: str = "/navigation/status"
    action: str = "/navigate_to_pose"


@dataclass(frozen=True, slots=True)
class Mount:
    """The scanner's place on the robot, from the ground below its middle; roll, pitch and yaw as in REP 103."""

    x_m: float = 0.0
    y_m: float = 0.0
    z_m: float = 0.4
    roll_rad: float = 0.0
    pitch_rad: float = 0.0
    yaw_rad: float = 0.0
    frame_id: str | None = None


@dataclass(frozen=True, slots=True)
class NodeOptions:
    topics: TopicNames = field(default_factory=TopicNames)
    navigator: NavigatorOptions = field(default_factory=NavigatorOptions)
    mapper: MapperOptions = field(default_factory=MapperOptions)
    lidar: Mount = field(default_factory=Mount)
    localisation: Localisation = Localisation.ODOMETRY
    start: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """The robot's place on its map when it is switched on, with localisation by scans."""
    stamps: Stamps = Stamps.HEADER
    stamped: bool = False
    """Commands are TwistStamped."""
    yaw_scale: float = 1.0
    """How much the base turns of what it is told."""
    base_frame: str = "base_link"
    on_link_loss: OnLinkLoss = OnLinkLoss.CONTINUE
    link_timeout_s: float = 2.0
    seed: int = 1
