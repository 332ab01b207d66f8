"""The ready-made configurations: each is accepted, and treats the topics of its robot as its comments say."""

from pathlib import Path
from typing import Final, NamedTuple

import pytest

from sern_core.adaptation.cost import profile
from sern_core.adaptation.policy import Mmcf
from sern_core.relay.access import AccessTable
from sern_core.topics.patterns import compile_pattern
from sern_core.topics.rules import Direction
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import ClientName, Encoding, PriorityClass, TopicName
from sern_runtime.config.client import ClientFile, load_client
from sern_runtime.config.navigation import load_navigation
from sern_runtime.config.relay import load_relay
from sern_runtime.config.twin import TwinEndpoint

EXAMPLES: Final = Path(__file__).resolve().parents[2] / "deploy" / "examples"
OF_THE_LINK: Final = sorted(path for path in EXAMPLES.glob("*.yaml") if path.name != "navigation.yaml")
"""Those of relay and clients."""
CLIENTS: Final = [path.name for path in OF_THE_LINK if path.name != "relay.yaml"]
CONTROL, STATE, BULK = PriorityClass.CONTROL, PriorityClass.STATE, PriorityClass.BULK
CLOUD: Final = "sensor_msgs/msg/PointCloud2"
NOETIC: Final = ("jackal-noetic.yaml", "husky-noetic.yaml")


class Treated(NamedTuple):
    """What becomes of a topic: None where it stays at the robot."""

    priority: PriorityClass
    direction: Direction
    reliable: bool
    summaries: tuple[str, ...] = ()


def client(name: str) -> ClientFile:
    return load_client(EXAMPLES / name, files=False).model


def treated(
    model: ClientFile, topic: str, type_name: str, encoding: Encoding, *, latched: bool = False
) -> Treated | None:
    name = TopicName(topic)
    info = TopicInfo(name, type_name, encoding, latched=latched)
    rules = model.rules()
    if not model.discovery.filter().wants(name, type_name, listed=rules.find(type_name, name) is not None):
        return None
    resolved = rules.resolve(info, local_name=name)
    kinds = tuple(type(summary.params).__name__ for summary in resolved.summaries)
    return Treated(resolved.spec.priority, resolved.direction, resolved.spec.reliable, kinds)


@pytest.mark.parametrize("name", CLIENTS)
def test_is_accepted(name: str) -> None:
    model = client(name)
    assert model.all_relays[0].endpoint == "tcp://relay.example:5555"
    assert model.http.listen is not None and model.http.listen.startswith("127.0.0.1:")


@pytest.mark.parametrize("path", OF_THE_LINK, ids=lambda path: path.stem)
def test_it_adapts_and_never_thins_a_command(path: Path) -> None:
    """The ready-made files of relay, robots and sites are as docs/adaptation.md says."""
    relay = path.name == "relay.yaml"
    loaded = load_relay(path, files=False) if relay else load_client(path, files=False)
    section = loaded.model.adaptation
    assert section is not None
    assert (section.policy, section.cost_weights(), section.floor_shares()) == (
        "mmcf", profile("teleoperation"), (1.0, 1.0, 1.0),
    )  # fmt: skip
    assert section.rates.control == (1.0,) and section.limits.min_rates.control == 1.0
    assert min(section.rates.bulk) < 1.0, "there is something to choose"
    policy = section.make_policy(encodes=not relay)()
    assert isinstance(policy, Mmcf) and len(policy.predictor.grid) > 1


@pytest.mark.parametrize("name", NOETIC)
def test_topics_of_a_noetic_robot(name: str) -> None:
    model = client(name)
    robot = name.partition("-")[0]

    def of(topic: str, type_name: str, *, latched: bool = False) -> Treated | None:
        return treated(model, topic, type_name, Encoding.ROS1, latched=latched)

    send = Direction.SEND
    assert of("/cmd_vel", "geometry_msgs/Twist") == Treated(CONTROL, Direction.RECEIVE, False)
    assert of("/odometry/filtered", "nav_msgs/Odometry") == Treated(CONTROL, send, False)
    assert of(f"/{robot}_velocity_controller/odom", "nav_msgs/Odometry") == Treated(STATE, send, False)
    assert of("/imu/data", "sensor_msgs/Imu") == Treated(STATE, send, False)
    assert of("/tf", "tf2_msgs/TFMessage") == Treated(STATE, send, False)
    assert of("/tf_static", "tf2_msgs/TFMessage", latched=True) == Treated(STATE, send, True)
    assert of("/map", "nav_msgs/OccupancyGrid", latched=True) == Treated(STATE, send, True, ("PatchParams",))
    assert of("/mid/points", "sensor_msgs/PointCloud2") == Treated(BULK, send, False, ("ScanParams", "VoxelParams"))
    assert of("/front/scan", "sensor_msgs/LaserScan") == Treated(STATE, send, False)
    assert of("/move_base/goal", "move_base_msgs/MoveBaseActionGoal") == Treated(CONTROL, Direction.RECEIVE, True)
    assert of("/move_base/result", "move_base_msgs/MoveBaseActionResult") == Treated(STATE, send, True)
    assert of("/rosout", "rosgraph_msgs/Log") is None
    assert of("/joy_teleop/cmd_vel", "geometry_msgs/Twist") is None


@pytest.mark.parametrize("name", ["jackal-jazzy.yaml", "husky-jazzy.yaml"])
def test_topics_of_a_jazzy_robot(name: str) -> None:
    model = client(name)

    def of(topic: str, type_name: str, *, latched: bool = False) -> Treated | None:
        return treated(model, f"/{model.name}{topic}", type_name, Encoding.CDR, latched=latched)

    send = Direction.SEND
    assert of("/cmd_vel", "geometry_msgs/msg/TwistStamped") == Treated(CONTROL, Direction.RECEIVE, False)
    assert of("/platform/emergency_stop", "std_msgs/msg/Bool") == Treated(CONTROL, send, True)
    assert of("/platform/odom/filtered", "nav_msgs/msg/Odometry") == Treated(CONTROL, send, False)
    assert of("/platform/odom", "nav_msgs/msg/Odometry") == Treated(STATE, send, False)
    assert of("/tf", "tf2_msgs/msg/TFMessage") == Treated(STATE, send, False)
    assert of("/tf_static", "tf2_msgs/msg/TFMessage", latched=True) == Treated(STATE, send, True)
    assert of("/map", "nav_msgs/msg/OccupancyGrid", latched=True) == Treated(STATE, send, True, ("PatchParams",))
    points = of("/sensors/lidar3d_0/points", "sensor_msgs/msg/PointCloud2")
    assert points == Treated(BULK, send, False, ("ScanParams", "VoxelParams"))
    feedback = of("/navigate_to_pose/_action/feedback", "nav2_msgs/action/NavigateToPose_FeedbackMessage")
    assert feedback == Treated(STATE, send, False)
    assert of("/rosout", "rcl_interfaces/msg/Log") is None
    rules = model.rules()
    frames = TopicInfo(TopicName(f"/{model.name}/tf"), "tf2_msgs/msg/TFMessage", Encoding.CDR)
    assert rules.resolve(frames, local_name=frames.name).merge_tf


@pytest.mark.parametrize("name", [name for name in CLIENTS if name not in {"robot.yaml", "site.yaml"}])
def test_the_relay_lets_through_what_a_client_needs(name: str) -> None:
    """What the client sends under its own or a robot's name, and what it subscribes to."""
    rules = load_relay(EXAMPLES / "relay.yaml", files=False).model.access_rules()
    table = AccessTable(rules)
    model = client(name)
    own = ClientName(model.name)
    if name.startswith("site"):
        robot = "/jackal1"
        for topic in ("/cmd_vel", "/move_base/goal", "/dock/_call/site1"):
            assert table.may_publish(own, TopicName(robot + topic)), topic
        assert not table.may_publish(own, TopicName(robot + "/odometry/filtered"))
        assert not table.may_publish(own, TopicName(robot + "/dock/_call/jackal1"))
        assert table.may_subscribe(own, TopicName(robot + "/map"))
        return
    if name == "twin.yaml":
        for topic in ("/odometry/filtered", "/platform/odom/filtered", "/jackal_velocity_controller/odom", "/plan"):
            assert table.may_subscribe(own, TopicName(f"/jackal1{topic}")), topic
        assert not table.may_subscribe(own, TopicName("/jackal1/cmd_vel"))
        assert table.may_publish(own, TopicName("/twin/jackal1/odom"))
        assert not table.may_publish(own, TopicName("/jackal1/odom"))
        return
    robot = f"/{own}"
    for topic in ("/odom", "/map", "/points/scan"):
        assert table.may_publish(own, TopicName(robot + topic))
    assert not table.may_publish(own, TopicName("/other1/odom"))
    for topic in ("/cmd_vel", "/move_base/goal", "/dock/_call/site1"):
        assert table.may_subscribe(own, TopicName(robot + topic))
    assert not table.may_subscribe(own, TopicName("/other1/cmd_vel"))


def test_the_navigation_hears_what_the_robot_has_and_drives_by_its_topic() -> None:
    model = load_navigation(EXAMPLES / "navigation.yaml", files=False).model
    robot = client("jackal-jazzy.yaml")
    for topic, type_name in ((model.topics.cloud, CLOUD), (model.topics.odometry, "nav_msgs/msg/Odometry")):
        assert robot.rules().find(type_name, TopicName(f"/j100_0000{topic}")) is not None, topic
    assert model.options().scan.origin_m == (0.0, 0.0, 0.4) and model.topics.twin == "/twin/scene/map"


def test_twins_are_made_of_what_the_robot_sends() -> None:
    (section,) = client("twin.yaml").endpoints
    assert isinstance(section, TwinEndpoint)
    (robot,) = section.robots
    sender = client("jackal-noetic.yaml")
    for topic, type_name in ((robot.pose, "nav_msgs/Odometry"), (robot.plan, "nav_msgs/Path")):
        assert topic is not None
        found = treated(sender, topic.removeprefix("/jackal1"), type_name, Encoding.ROS1)
        assert found is not None and found.direction is Direction.SEND, topic
    rules = load_relay(EXAMPLES / "relay.yaml", files=False).model.access_rules()
    for topic in (robot.pose, robot.plan, "/j100_0000/platform/odom/filtered", "/j100_0000/plan"):
        assert AccessTable(rules).may_subscribe(ClientName("twin"), TopicName(topic or "")), topic


def test_the_feed_shows_twins_with_their_age_and_error() -> None:
    (role,) = load_relay(EXAMPLES / "relay.yaml", files=False).model.feed_roles()
    for part in ("odom", "age", "error"):
        assert any(pattern.fullmatch(f"/twin/jackal1/{part}") for pattern in role.subscribe), part


@pytest.mark.parametrize("name", [name for name in CLIENTS if not name.startswith(("site", "twin"))])
def test_the_feed_shows_where_each_robot_is_and_what_is_around_it(name: str) -> None:
    """Cover each robot that there is a file for, by topics that its file sends."""
    (role,) = load_relay(EXAMPLES / "relay.yaml", files=False).model.feed_roles()
    model = client(name)
    robot = model.name
    shown = [f"/{robot}/platform/odom/filtered", f"/{robot}/map", f"/{robot}/sensors/lidar2d_0/scan"]  # of jazzy
    if name == "robot.yaml":
        shown = ["/odometry/filtered", "/map", "/map_updates", "/scan"]
    elif name in NOETIC:
        shown = ["/odometry/filtered", "/map", "/front/scan"]
    for topic in shown:
        found = treated(model, topic, "nav_msgs/msg/Odometry", Encoding.CDR)
        assert found is not None and found.direction is Direction.SEND, topic
        assert any(pattern.fullmatch(model.namespace.rstrip("/") + topic) for pattern in role.subscribe), topic
    for topic in ("/cmd_vel", "/points", "/front/image_raw/compressed"):
        assert not any(pattern.fullmatch(f"/{robot}{topic}") for pattern in role.subscribe), topic


FRAMES: Final = ("tf", "tf_static", "map")
TAKEN_OF_NOETIC: Final = (
    *FRAMES, "odometry/filtered", "fix", "navsat/fix", "imu/data", "joint_states", "diagnostics_agg",
    "move_base/NavfnROS/plan", "move_base/local_costmap/costmap", "front/scan", "mid/points/scan", "mid/points/voxel",
)  # fmt: skip
TAKEN_OF_JAZZY: Final = (
    *FRAMES, "platform/odom/filtered", "platform/odom", "platform/joint_states", "platform/emergency_stop",
    "sensors/gps_0/fix", "sensors/imu_0/data", "plan", "local_costmap/costmap", "global_costmap/costmap",
    "sensors/lidar2d_0/scan", "sensors/lidar3d_0/points/scan", "sensors/lidar3d_0/points/voxel",
)  # fmt: skip
LEFT_THERE: Final = (
    "mid/points",
    "sensors/lidar3d_0/points",
    "front/image_raw/compressed",
    "sensors/camera_0/color/compressed",
)


@pytest.mark.parametrize("robot", [*NOETIC, "jackal-jazzy.yaml", "husky-jazzy.yaml"])
@pytest.mark.parametrize("site", ["site-noetic.yaml", "site-jazzy.yaml"])
def test_each_site_takes_what_its_operator_drives_by_of_each_robot(site: str, robot: str) -> None:
    """Where a robot is, how it leans, what it plans and what is near; what is heavy only in its summaries."""
    patterns = [compile_pattern(text) for text in client(site).subscribe]
    model = client(robot)
    noetic = robot in NOETIC
    drives_by = [*TAKEN_OF_NOETIC, f"{robot.partition('-')[0]}_velocity_controller/odom"] if noetic else TAKEN_OF_JAZZY

    def takes(topic: str) -> bool:
        return any(pattern.fullmatch(f"/{model.name}/{topic}") for pattern in patterns)

    assert [topic for topic in drives_by if not takes(topic)] == []
    assert [topic for topic in LEFT_THERE if takes(topic)] == []
    for topic in drives_by:  # and the robot's file sends it, or what it is a summary of
        whole = "/" + topic.removesuffix("/voxel").replace("points/scan", "points")
        local = whole if noetic else f"/{model.name}{whole}"
        found = treated(model, local, "nav_msgs/msg/Odometry", Encoding.ROS1 if noetic else Encoding.CDR)
        assert found is not None and found.direction is Direction.SEND, topic


def test_no_example_caps_a_command() -> None:
    """A limit on the rate makes a command wait for its turn, and does nothing to a reliable topic."""
    for path in OF_THE_LINK:
        if path.stem.startswith("relay"):
            continue
        model = load_client(path, files=False).model
        assert [s.match for s in model.topics if s.max_rate_hz is not None and s.rate_problem() is not None] == []


def test_a_capped_command_and_a_capped_reliable_topic_are_warned_of(tmp_path: Path) -> None:
    path = tmp_path / "site.yaml"
    path.write_text(
        "client: {name: site1}\n"
        "relay: {endpoint: 'tcp://127.0.0.1:5555', insecure: true}\n"
        "endpoint: {kind: synthetic, role: operator}\n"
        "topics:\n"
        "  - {match: /cmd_vel, class: control, max_rate_hz: 20}\n"
        "  - {match: /map, class: state, reliability: reliable, max_rate_hz: 1}\n"
        "  - {match: /imu, class: control, max_rate_hz: 20}\n"
    )
    warnings = load_client(path).warnings
    assert len(warnings) == 2
    assert "lets a command wait for up to 0.05 s" in warnings[0] and "site.yaml:5" in warnings[0]
    assert "has no effect on a reliable topic" in warnings[1]
