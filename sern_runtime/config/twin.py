"""The section of an endpoint of kind `twin`: whose twins to keep, and by what."""

import importlib.util
import math
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Final, Literal

from pydantic import Field, model_validator

from sern_core.topics.patterns import compile_pattern
from sern_core.topics.rules import Direction, TopicRule
from sern_core.vocabulary.types import PriorityClass
from sern_runtime.config.base import (
    ClientText,
    EndpointBase,
    FileProblem,
    Hertz,
    HttpListen,
    Section,
    TopicText,
    fault,
    is_local,
)
from sern_runtime.config.scene import OriginSection
from sern_runtime.config.yaml import Loc

SLOW_PARTS: Final = ("path", "status")
SCENE_PARTS: Final = (("map", PriorityClass.BULK), ("map_updates|discrepancies", PriorityClass.STATE))
"""What is published of the scene, where the file has one."""
FAST_PARTS: Final = ("odom", "estimate", "age", "error", "unity")


ODOMETRY_ERRORS: Final = (0.02, 0.05)
SATELLITE_ERRORS: Final = (3.0, 0.5)
"""How far off poses are, metres and metres a second, where the file does not say."""


class FrameOrigin(Section):
    """A place and a direction in the frame of the site."""

    x_m: Annotated[float, Field(ge=-1e6, le=1e6)] = 0.0
    """To the east."""
    y_m: Annotated[float, Field(ge=-1e6, le=1e6)] = 0.0
    """To the north."""
    yaw_rad: Annotated[float, Field(ge=-math.tau, le=math.tau)] = 0.0
    """From east to north."""


class TwinRobot(Section):
    """One robot."""

    name: ClientText
    """What its twin is called: its topics are PREFIX/NAME/odom and so on."""
    pose: TopicText
    """Where it says where it is (local name): nav_msgs/Odometry, best from its localisation; with `datum`
    sensor_msgs/NavSatFix."""
    datum: OriginSection | None = None
    """Of a robot that only satellites place: where the origin of the site is on the Earth. Its twin is in metres east
    and north of there, in frame `map`; its heading and speed are those of the way that its fixes make."""
    error_m: Annotated[float, Field(gt=0, le=1000)] | None = None
    """How far off a pose may be: the bound begins there. null: 0.02 m, and 3 m of a robot with `datum`."""
    error_mps: Annotated[float, Field(gt=0, le=100)] | None = None
    """The same of its speed. null: 0.05 m/s, and 0.5 m/s of a robot with `datum`."""
    plan: TopicText | None = None
    """The plan that it follows (local name): nav_msgs/Path, or trajectory_msgs/MultiDOFJointTrajectory. Where the poses
    of a path have stamps that rise, they are when the robot is to be there. A twin follows a plan with times through a
    blackout to the centimetre; null: there is none."""
    max_speed_mps: Annotated[float, Field(gt=0, le=100)] = 2.0
    """Its top speed. What it says of itself beyond one and a half times this is not believed."""
    max_yaw_rate_radps: Annotated[float, Field(gt=0, le=100)] = 6.0
    """The same for turning."""
    gap_s: Annotated[float, Field(gt=0, le=3600)] = 0.5
    """Silence from here on is a gap, which is reported when it ends."""
    origin: FrameOrigin = FrameOrigin()
    """Where the origin of its frame is in that of the site, such as where it was switched on: its odometry begins
    there. The view shows all robots, and the scene, in that of the site; what is published stays in the robot's."""

    @property
    def errors(self) -> tuple[float, float]:
        """How far off its poses may be: metres, metres a second."""
        error_m, error_mps = ODOMETRY_ERRORS if self.datum is None else SATELLITE_ERRORS
        return self.error_m or error_m, self.error_mps or error_mps


class TwinView(Section):
    """The twins in a browser, in three dimensions."""

    listen: HttpListen
    """`address:port` of this machine's loopback, such as 127.0.0.1:8090. Whoever reaches it sees everything; from
    elsewhere through an SSH tunnel."""

    @model_validator(mode="after")
    def _is_for_this_machine(self) -> "TwinView":
        if not is_local(f"tcp://{self.listen}"):
            raise fault(
                f"{self.listen} is open to the network, and the view asks nobody who they are; "
                "listen on 127.0.0.1 and come through an SSH tunnel (ssh -L)",
                "listen",
            )
        return self

    @property
    def place(self) -> tuple[str, int]:
        """Host, without the brackets of IPv6, and port."""
        host, _, port = self.listen.rpartition(":")
        return host.strip("[]"), int(port)


class TwinEndpoint(EndpointBase):
    """Keeps the twins of robots elsewhere: hears their poses and plans, and publishes where they are by now. Run it
    with sern-twin; it is the only endpoint of its client."""

    kind: Literal["twin"]
    """Keeps the twins of robots."""
    robots: Annotated[tuple[TwinRobot, ...], Field(min_length=1, max_length=200)]
    """Whose twins."""
    encoding: Literal["ros1", "cdr"] = "cdr"
    """How twins are serialised: `ros1` or `cdr` (ROS 2). What robots say is read either way."""
    rate_hz: Annotated[Hertz, Field(le=100)] = 20.0
    """How often the twins are published; path and status twice a second."""
    ahead_s: Annotated[float, Field(gt=0, le=60)] = 5.0
    """How far ahead the path goes that is published."""
    prefix: TopicText = "/twin"
    """Under which name the topics of the twins are."""
    unity: bool = False
    """Also PREFIX/NAME/unity, geometry_msgs/PoseStamped: the twin in Unity's axes, x east, y up, z north."""

    objects: bool = True
    """Also as objects PREFIX/NAME of kind robot, twice a second: the twin to be shown, how old and how far off it may
    be, for whoever subscribes to objects."""
    view: TwinView | None = None
    """Also in a browser, in three dimensions; null: not. Needs `pip install 'sern[viz]'`."""

    @model_validator(mode="after")
    def _apart(self) -> "TwinEndpoint":
        seen: Counter[str] = Counter()
        for index, robot in enumerate(self.robots):
            for key, value in (("name", robot.name), ("pose", robot.pose), ("plan", robot.plan)):
                if value is None:
                    continue
                seen[f"{'name' if key == 'name' else 'topic'} {value}"] += 1
                if max(seen.values()) > 1:
                    raise fault(f"{value} is another robot's already: each has its own", "robots", index, key)
                if key != "name" and value.startswith(f"{self.prefix}/"):
                    raise fault(f"{value} is a topic of the twins themselves (prefix)", "robots", index, key)
        return self

    def topic_rules(self) -> Iterator[TopicRule]:
        """What robots say is received, and the twins are sent. A name is its own pattern: it has only letters, digits,
        _ and /."""
        for robot in self.robots:
            for topic, priority in ((robot.pose, PriorityClass.CONTROL), (robot.plan, PriorityClass.STATE)):
                if topic is not None:
                    yield TopicRule(compile_pattern(topic), None, priority, Direction.RECEIVE)
        for parts, priority in ((FAST_PARTS, PriorityClass.CONTROL), (SLOW_PARTS, PriorityClass.STATE)):
            yield TopicRule(compile_pattern(f"{self.prefix}/[^/]*/({'|'.join(parts)})"), None, priority, Direction.SEND)
        for part, priority in SCENE_PARTS:
            yield TopicRule(compile_pattern(f"{self.prefix}/scene/({part})"), None, priority, Direction.SEND)

    def file_problems(self, base_dir: Path, loc: Loc) -> Iterator[FileProblem]:
        if self.view is not None and importlib.util.find_spec("viser") is None:
            problem = "needs the Python package viser, which is not on this machine: pip install 'sern[viz]'"
            yield FileProblem((*loc, "view"), problem, warning=True)
