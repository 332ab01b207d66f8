"""Endpoint sections: where a client's messages come from and go to.

To add a kind: write a section with `kind: Literal["name"]` and its settings, and add it to `EndpointSection`. Messages,
schema and reference follow from there; `sern_client` makes the endpoint from the section.
"""

import importlib.util
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Discriminator, Field, Tag, model_validator

from sern_runtime import ros_installation
from sern_runtime.config.base import (
    Bytes,
    Count,
    EndpointBase,
    FileProblem,
    HertzOrOff,
    NamespaceText,
    PathText,
    Pattern,
    Seconds,
    SecondsOrZero,
    TopicText,
    fault,
    missing_directories,
    pattern_problems,
    resolve,
    unexpected,
    unit_makes,
    unit_problems,
)
from sern_runtime.config.foxglove import FoxgloveEndpoint
from sern_runtime.config.twin import TwinEndpoint
from sern_runtime.config.unity import UnityEndpoint
from sern_runtime.config.yaml import Loc

MAX_SYNTHETIC_TOPICS = 20


def installed(package: str) -> bool:
    """Whether Python could import it here; nothing is imported."""
    return package in sys.modules or importlib.util.find_spec(package) is not None


def installing(package: str) -> str:
    """The command that installs a package where SERN is: another pip would put it beside."""
    return f"{sys.executable} -m pip install {package}"


def missing_package(package: str, remedy: str, loc: Loc, key: str = "kind") -> Iterator[FileProblem]:
    """A warning of an endpoint that this machine cannot run: the file may be for another one."""
    if not installed(package):
        problem = f"needs the Python package {package}, which is not on this machine: {remedy}"
        yield FileProblem((*loc, key), problem, warning=True)


class BagEndpoint(EndpointBase):
    """Plays a recording (ROS 1 .bag, rosbag2 directory, .db3, .mcap) as if it were a robot."""

    kind: Literal["bag"]
    """Plays a recording."""
    path: PathText
    """The .bag, .db3 or .mcap file, or a rosbag2 directory."""
    rate: Annotated[float, Field(ge=0, le=1000)] = 1.0
    """Playback speed; 2 is twice as fast as recorded, 0 as fast as messages are accepted."""
    loop: bool = False
    """Start again at the end."""
    namespaces: tuple[NamespaceText, ...] = ()
    """Play the recording once for each of these namespaces, as so many robots; empty: once, with its own names."""
    topics: tuple[Pattern, ...] | None = None
    """Play only topics whose name in the recording matches one of these; null: all."""
    deny: tuple[Pattern, ...] = ()
    """Play no topic whose name in the recording matches one of these; wins over `topics`."""
    start_delay_s: SecondsOrZero = 0.0
    """Wait so long before the first message."""
    wait_for: tuple[TopicText, ...] = ()
    """Start only when each of these topics has a subscriber at the far side."""
    on_refused: Literal["wait", "drop"] = "wait"
    """When a reliable queue is full: `wait` holds playback, `drop` counts the message as lost, like a live sensor."""
    stamps: Literal["now", "bag"] = "now"
    """Time stamps of messages on the link: when they are played, or when they were recorded."""

    def file_problems(self, base_dir: Path, loc: Loc) -> Iterator[FileProblem]:
        path = resolve(base_dir, self.path)
        if not path.exists():
            yield FileProblem((*loc, "path"), f"{path}: no such file or directory")
        yield from pattern_problems(self.topics or (), (*loc, "topics"))
        yield from pattern_problems(self.deny, (*loc, "deny"))


def _topics_tag(value: Any) -> str | None:
    """Which member of the union a value of `topics` is meant to be; bool is an int to Python and not meant."""
    if isinstance(value, bool):
        return None
    return "number" if isinstance(value, int) else "list" if isinstance(value, (list, tuple)) else None


_TOPICS_EXPECTED = unexpected("a number of topics or a list of topic names")


class SyntheticEndpoint(EndpointBase):
    """A simulated robot, or the operator who drives it. The same seed gives the same messages."""

    kind: Literal["synthetic"]
    """A simulated robot or operator."""
    role: Literal["robot", "operator"]
    """`robot`: publishes odometry, scan, cloud, map, tf and obeys commands; `operator`: sends commands."""
    seed: Annotated[int, Field(ge=0, lt=1 << 63)] = 0
    """Start value of the random generator."""
    encoding: Literal["ros1", "cdr"] = "ros1"
    """How bodies are serialised: `ros1` or `cdr` (ROS 2)."""
    topics: Annotated[
        Annotated[Annotated[int, Field(ge=0, le=MAX_SYNTHETIC_TOPICS)], Tag("number")]
        | Annotated[tuple[TopicText, ...], Tag("list")],
        Discriminator(
            _topics_tag,
            custom_error_type=_TOPICS_EXPECTED.type,
            custom_error_message=_TOPICS_EXPECTED.message_template,
            custom_error_context=_TOPICS_EXPECTED.context,
        ),
    ] = 20
    """How many of its topics the robot publishes, most urgent first, or their names."""
    plant: Literal["unicycle", "mujoco"] = "unicycle"
    """What drives the robot: `unicycle`, in a flat yard; `mujoco`, four wheels that skid on hills, with a car, a bridge
    and logs, and labels in its clouds (needs the extra `sim`; about 2 % of a core, and a tenth for clouds at 10 Hz)."""
    patrol: bool = False
    """The robot drives a round by itself while it has no commands; of plant `unicycle` alone."""
    follow: bool = False
    """The robot drives by a plan of its own, in closed loop, and publishes it as /plan (nav_msgs/Path with times, 90 s
    ahead). Commands come first; once they cease for `command_timeout_s` it makes a new plan from where it is. Its
    odometry says where its localisation thinks it is, /ground_truth (nav_msgs/Odometry) and /pose where it truly is."""
    localisation_noise_m: Annotated[float, Field(ge=0, le=1)] = 0.01
    """What the localisation of a robot with `follow` is off in each axis, one sigma; in yaw 0.3° for each cm."""
    cloud_bytes: Annotated[int, Field(ge=1000, le=50_000_000)] = 100_000
    """Size of one point cloud."""
    cloud_rate_hz: HertzOrOff = 10.0
    """Point clouds a second; 0: none."""
    cloud_files: tuple[PathText, ...] = ()
    """Real scans (.ply) to send in turn in place of made-up clouds."""
    map_bytes: Annotated[int, Field(ge=1000, le=50_000_000)] = 40_000
    """Size of one occupancy grid."""
    map_rate_hz: HertzOrOff = 0.2
    """Occupancy grids a second; 0: none."""
    image_bytes: Annotated[int, Field(ge=3, le=50_000_000)] = 9_216
    """Size of one camera image."""
    pose_rate_hz: HertzOrOff = 50.0
    """Odometry messages a second; 0: none."""
    load_factor: Annotated[float, Field(ge=0, le=100)] = 1.0
    """Multiplies the rates of bulk topics: offered load as a factor of the usual one."""
    commands: tuple[TopicText, ...] = ("/cmd_vel",)
    """The topics (local names) that the robot drives by."""
    command_timeout_s: Seconds | None = None
    """The robot stops without a command for so long; null: that is left to `on_link_loss`."""
    counter_topics: tuple[TopicText, ...] = ()
    """Extra reliable topics that carry a counter: they show gaps and duplicates."""
    command_topic: TopicText = "/cmd_vel"
    """The topic (local name) on which the operator sends commands."""
    command_stamped: bool = False
    """The operator sends TwistStamped in place of Twist."""
    command_rate_hz: HertzOrOff = 10.0
    """Commands a second of the operator; 0: none."""
    goal_topic: TopicText = "/goal"
    """The topic (local name) on which the operator sends goals."""
    goal_rate_hz: HertzOrOff = 0.2
    """Goals a second of the operator; 0: none."""

    @model_validator(mode="after")
    def _plant_drives(self) -> "SyntheticEndpoint":
        if self.plant == "mujoco" and self.patrol:
            raise fault("is of plant unicycle alone; let plant mujoco follow a plan (follow: true)", "patrol")
        return self

    def file_problems(self, base_dir: Path, loc: Loc) -> Iterator[FileProblem]:
        for index, text in enumerate(self.cloud_files):
            path = resolve(base_dir, text)
            if not path.is_file():
                yield FileProblem((*loc, "cloud_files", index), f"{path}: no such file")
        if self.plant == "mujoco":
            yield from missing_package("mujoco", installing("mujoco"), loc, "plant")


class RecordEndpoint(EndpointBase):
    """Records what arrives: ROS 1 messages into a .bag, ROS 2 (CDR) messages into an .mcap."""

    kind: Literal["record"]
    """Records what arrives."""
    path: PathText
    """A .bag or .mcap file (the other encoding goes beside it), a directory (files are named by date; with a slash at
    the end it is made), or a stem."""
    overwrite: bool = False
    """Replace files that exist."""
    max_buffer_bytes: Annotated[int, Field(ge=1 << 20, le=1 << 36)] = 64 * 2**20
    """What may wait for the disk; beyond, messages are dropped and counted."""
    flush_s: Annotated[float, Field(gt=0, le=60)] = 1.0
    """Longest time, in seconds, before a message is given to the operating system and so survives the end of this
    process, however it ends. A reliable message is confirmed to its sender then; without `sync` that is done after
    some milliseconds. At a megabyte it is done earlier."""
    sync: bool = False
    """Have each flush written to the disk itself (fsync), so that what is confirmed survives a power cut as well."""

    def file_problems(self, base_dir: Path, loc: Loc) -> Iterator[FileProblem]:
        path = resolve(base_dir, self.path)
        if path.is_file() and not self.overwrite:
            yield FileProblem((*loc, "path"), f"{path} exists; set overwrite: true or name another file")
        elif not path.is_dir() and not path.parent.is_dir() and not unit_makes(base_dir, path.parent):
            yield FileProblem((*loc, "path"), f"{path.parent}: no such directory; create it first")
        elif path.is_dir() and not os.access(path, os.W_OK):
            yield FileProblem((*loc, "path"), f"{path}: may not be written")
        else:
            yield from unit_problems(base_dir, path, (*loc, "path"))


def _check_uri(text: str) -> str:
    if not re.fullmatch(r"http://[A-Za-z0-9_.-]{1,253}:[0-9]{1,5}/?", text):
        raise fault("is not http://host:port, such as http://127.0.0.1:11311")
    return text


def _check_host(text: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9_.-]{1,253}", text):
        raise fault("is not a host name or an IPv4 address")
    return text


def _check_node(text: str) -> str:
    if not re.fullmatch(r"/?[A-Za-z][A-Za-z0-9_]*(/[A-Za-z0-9_]+)*", text):
        raise fault("is not the name of a ROS node, such as sern_robot1")
    return text


class Ros1Endpoint(EndpointBase):
    """A node of a ROS 1 master; no ROS installation is needed. With several of these, several masters."""

    kind: Literal["ros1"]
    """A node of a ROS 1 master."""
    master_uri: Annotated[str, AfterValidator(_check_uri)] | None = None
    """The master, http://host:port; null: the environment's ROS_MASTER_URI, else http://localhost:11311."""
    host: Annotated[str, AfterValidator(_check_host)] | None = None
    """The name or address at which other nodes reach this one; null: the environment's ROS_HOSTNAME, else ROS_IP, else
    what this machine has towards the master. A loopback address keeps our ports off the network."""
    node_name: Annotated[str, AfterValidator(_check_node)] | None = None
    """Our name at the master, which nobody else may have there; null: sern_ and the client's name."""
    namespace: NamespaceText | None = None
    """Put before the names of this master's topics and services, here and in rules; only what is below it is published
    there, without it. For several masters that use the same names. null: names are as at the master."""
    poll_hz: Annotated[float, Field(ge=0.5, le=20)] = 4.0
    """How often the master is asked what there is: new topics are found within one period."""
    queue_messages: Count = 1000
    """Messages that may wait for one slow local subscriber; beyond, the oldest are dropped and counted."""
    queue_bytes: Bytes = 64 * 2**20
    """Bytes that may wait for one slow local subscriber; at least one message always may."""
    max_message_bytes: Annotated[int, Field(ge=1000, le=1 << 30)] = 64 * 2**20
    """Longer messages of local nodes are dropped and counted, longer service calls fail."""
    tcp_nodelay: bool = True
    """Ask local publishers to send small messages at once."""
    accept_bridged: bool = False
    """Take what other SERN endpoints publish and serve at this master for its own nodes'. For a chain of two links with
    the master in the middle; with two of them side by side it makes a loop."""


class ZenohEndpoint(EndpointBase):
    """ROS 2 over zenoh, among nodes that run with rmw_zenoh. Needs the extra `zenoh` (`'.[zenoh]'` where SERN is
    installed), no ROS installation."""

    kind: Literal["zenoh"]
    """ROS 2 over zenoh (rmw_zenoh)."""
    connect: Annotated[tuple[str, ...], Field(min_length=1)] | None = None
    """Zenoh locators of the router (rmw_zenohd) or of peers; it may start later than this. null: as `config_file` has
    it, without one `[tcp/localhost:7447]`."""
    listen: tuple[str, ...] | None = None
    """Zenoh locators to listen on; empty: a free port of loopback. null: as `config_file` has it (zenoh itself listens
    on every interface where that says nothing), without one a free port of loopback."""
    config_file: PathText | None = None
    """A session configuration of zenoh (JSON5) in place of rmw_zenoh's defaults; null: those."""
    domain: Annotated[int, Field(ge=0, le=232)] = 0
    """ROS_DOMAIN_ID of the nodes."""
    node_name: Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$", max_length=200)] = "sern"
    """What it is called in `ros2 node list`."""
    type_paths: tuple[PathText, ...] = ()
    """Directories with .msg, .srv and .action files (searched at any depth), for types that are neither in a ROS 2
    installation of this machine (AMENT_PREFIX_PATH, /opt/ros) nor of Jazzy's desktop, or in another version there."""

    accept_bridged: bool = False
    """Take what other SERN endpoints publish and serve in this domain for this site's own. For a chain of two links
    with the domain in the middle; with two of them side by side it makes a loop."""

    def file_problems(self, base_dir: Path, loc: Loc) -> Iterator[FileProblem]:
        yield from missing_package("zenoh", installing("eclipse-zenoh"), loc)
        if self.config_file is not None and not resolve(base_dir, self.config_file).is_file():
            yield FileProblem((*loc, "config_file"), f"{resolve(base_dir, self.config_file)}: no such file")
        yield from missing_directories(base_dir, self.type_paths, (*loc, "type_paths"))


class DdsEndpoint(EndpointBase):
    """ROS 2 over DDS, among nodes of rmw_fastrtps, rmw_cyclonedds and others. Needs the extra `dds` (`'.[dds]'` where
    SERN is installed), no ROS installation. Services work with nodes of rmw_cyclonedds only."""

    kind: Literal["dds"]
    """ROS 2 over DDS."""
    domain: Annotated[int, Field(ge=0, le=232)] | None = None
    """ROS_DOMAIN_ID of the nodes; null: the environment's, else 0."""
    node_name: Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$", max_length=200)] = "sern"
    """What it is called in `ros2 node list`."""
    interface: Annotated[str, AfterValidator(_check_host)] | None = None
    """The network interface to use, by name or address; null: as Cyclone DDS chooses, or CYCLONEDDS_URI says."""
    peers: tuple[Annotated[str, AfterValidator(_check_host)], ...] = ()
    """Hosts to look for participants on, where multicast does not reach them."""
    multicast: bool | None = None
    """Find others by multicast; null: where the interface can. With false, name `peers`."""
    localhost_only: bool = False
    """Speak to nodes on this host only, over loopback, without multicast, in large datagrams."""
    fragment_bytes: Annotated[int, Field(ge=1000, le=65_000)] | None = None
    """The largest piece of a message in one datagram; null: 62000 with `localhost_only`, else as Cyclone DDS has it."""
    receive_buffer_bytes: Annotated[int, Field(ge=1 << 16, le=1 << 30)] | None = None
    """Receive buffer to ask the system for; null: 4 MiB with `localhost_only`, else as Cyclone DDS has it."""
    lease_s: Annotated[float, Field(ge=1, le=3600)] | None = None
    """After so long without a sign of us others take us for gone; null: as Cyclone DDS has it (10 s)."""
    type_paths: tuple[PathText, ...] = ()
    """Directories with .msg, .srv and .action files (searched at any depth), for types that are neither in a ROS 2
    installation of this machine (AMENT_PREFIX_PATH, /opt/ros) nor of Jazzy's desktop, or in another version there."""
    queue_depth: Count = 100
    """Messages of one topic that may wait for the link; beyond, the oldest are dropped and counted."""
    max_buffer_bytes: Bytes = 64 * 2**20
    """Bytes that may wait for the link, of all topics together."""
    offer_lifespan: bool = False
    """Offer what is published here with its lifespan: readers then drop what is older, by their own clocks, which must
    agree with this host's."""
    accept_bridged: bool = False
    """Take what other SERN endpoints publish in this domain for this site's own. For a chain of two links with the
    domain in the middle; with two of them side by side it makes a loop."""

    def file_problems(self, base_dir: Path, loc: Loc) -> Iterator[FileProblem]:
        yield from missing_package("cyclonedds", installing("cyclonedds==11.0.1"), loc)
        yield from missing_directories(base_dir, self.type_paths, (*loc, "type_paths"))


class RclpyEndpoint(EndpointBase):
    """ROS 2 through rclpy, where an installation is sourced, whatever its middleware is; services and actions too. Runs
    with the Python of that installation (docs/ros2.md). Kinds `dds` and `zenoh` need none."""

    kind: Literal["rclpy"]
    """ROS 2 through a sourced installation."""
    node_name: Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$", max_length=200)] = "sern"
    """What it is called in `ros2 node list`."""
    domain: Annotated[int, Field(ge=0, le=232)] | None = None
    """ROS_DOMAIN_ID of the nodes; null: the environment's."""
    poll_hz: Annotated[float, Field(ge=0.5, le=20)] = 4.0
    """How often the graph is asked what there is: new topics and services are found within one period."""
    services_only: bool = False
    """Only services and actions are taken and served here, and those of endpoints of kind `dds` for the same nodes are
    not: `[{kind: dds}, {kind: rclpy, services_only: true}]` has topics at the price of `dds`, and services of any
    middleware."""
    type_paths: tuple[PathText, ...] = ()
    """Directories with .msg, .srv and .action files in place of those of the installation (searched at any depth)."""
    max_buffer_bytes: Bytes = 64 * 2**20
    """Bytes that may wait for the link, of all topics together."""
    accept_bridged: bool = False
    """Take what other SERN endpoints publish and serve in this domain for this site's own. For a chain of two links
    with the domain in the middle; with two of them side by side it makes a loop."""

    def file_problems(self, base_dir: Path, loc: Loc) -> Iterator[FileProblem]:
        yield from missing_package("rclpy", ros_installation.remedy(), loc)
        yield from missing_directories(base_dir, self.type_paths, (*loc, "type_paths"))


EndpointSection = Annotated[
    BagEndpoint
    | SyntheticEndpoint
    | RecordEndpoint
    | Ros1Endpoint
    | DdsEndpoint
    | ZenohEndpoint
    | RclpyEndpoint
    | TwinEndpoint
    | FoxgloveEndpoint
    | UnityEndpoint,
    Field(discriminator="kind"),
]
