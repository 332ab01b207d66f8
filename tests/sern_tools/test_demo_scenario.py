"""The demo's configuration files: valid, and a load that fits the link it is meant for."""

from pathlib import Path

import pytest

from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding, PriorityClass, TopicName
from sern_runtime.config.client import load_client
from sern_runtime.config.relay import load_relay
from sern_runtime.profiles import load_profile, load_profiles
from sern_sim.models import LinkModel
from sern_sim.profiles import LinkProfile
from sern_tools.demo_scenario import COMMAND_TOPIC, POSE_TOPIC, RELAY, ROBOT, SITE, Ports, Scenario, write_files

PORTS = Ports(relay=5001, relay_http=5003, robot_http=5004, site_http=5005)
DEMO = load_profile("demo")


def small_bytes_per_s(scenario: Scenario) -> float:
    return scenario.pose_rate_hz * 840 + scenario.map_bytes


@pytest.mark.parametrize("name", [name for name, p in load_profiles().items() if p.up.rate_bps is not None])
def test_the_load_is_twice_the_link_and_the_small_topics_fit_its_narrowest_moment(name: str) -> None:
    scenario = Scenario(load_profile(name), duration_s=60)
    offered_bps = 8 * (small_bytes_per_s(scenario) + 10 * scenario.cloud_bytes)
    assert offered_bps == pytest.approx(2 * scenario.usual_bps, rel=0.01)
    assert 8 * small_bytes_per_s(scenario) < 0.55 * scenario.lowest_bps


def test_a_link_without_a_rate_cannot_be_overloaded() -> None:
    endless = LinkProfile("endless", "no limit", up=LinkModel(), down=LinkModel())
    with pytest.raises(ConfigError, match="endless has no rate"):
        assert Scenario(endless, duration_s=60).cloud_bytes


def test_the_files_are_valid(tmp_path: Path) -> None:
    files = write_files(tmp_path / "run", Scenario(DEMO, duration_s=60), PORTS)
    assert load_relay(files[RELAY]).warnings == ()
    robot, site = load_client(files[ROBOT]), load_client(files[SITE])
    assert (robot.warnings, site.warnings) == ((), ())
    assert robot.model.all_relays[0].endpoint == "tcp://127.0.0.2:5001", "where the proxy is"
    assert site.model.all_relays[0].endpoint == "tcp://127.0.0.1:5001"
    assert robot.model.all_relays[0].udp and site.model.all_relays[0].udp and robot.model.adaptation is not None
    assert robot.model.subscribe_patterns() == ("/robot(?:/cmd_vel)",)
    assert site.model.subscribe_patterns() == ("/robot/.*",)


def info(name: str, type_name: str = "") -> TopicInfo:
    return TopicInfo(TopicName(name), type_name, Encoding.CDR, reliable=True)


def test_each_topic_has_its_class(tmp_path: Path) -> None:
    files = write_files(tmp_path / "run", Scenario(DEMO, duration_s=60), PORTS)
    rules = load_client(files[ROBOT]).model.rules()
    for name, priority, reliable in (
        ("/odometry/filtered", PriorityClass.CONTROL, False),
        ("/pose", PriorityClass.CONTROL, False),
        ("/map", PriorityClass.STATE, True),
        ("/counter", PriorityClass.STATE, True),
    ):
        spec = rules.resolve(info(name), local_name=TopicName(name)).spec
        assert (spec.priority, spec.reliable) == (priority, reliable)
    clouds = TopicInfo(TopicName("/points"), "sensor_msgs/msg/PointCloud2", Encoding.CDR, reliable=False)
    assert rules.resolve(clouds, local_name=clouds.name).spec.priority is PriorityClass.BULK
    outward = rules.outward(info("/odometry/filtered"), local_name=TopicName("/odometry/filtered"), namespace="/robot")
    assert outward == POSE_TOPIC
    site = load_client(files[SITE]).model
    command = site.rules().resolve(info(COMMAND_TOPIC, "geometry_msgs/msg/Twist"), local_name=TopicName(COMMAND_TOPIC))
    assert command.spec.lifespan_s == 0.3
    assert site.namespace == "/"


@pytest.mark.parametrize(
    ("topic", "type_name", "priority", "reliable"),
    [
        ("/odom", "nav_msgs/Odometry", PriorityClass.CONTROL, False),
        ("/imu/data", "sensor_msgs/msg/Imu", PriorityClass.CONTROL, False),
        ("/tf", "tf2_msgs/msg/TFMessage", PriorityClass.CONTROL, False),
        ("/tf", "tf/tfMessage", PriorityClass.CONTROL, False),
        ("/costmap", "nav_msgs/OccupancyGrid", PriorityClass.STATE, True),
        ("/fix", "sensor_msgs/msg/NavSatFix", PriorityClass.STATE, True),
        ("/diagnostics", "diagnostic_msgs/DiagnosticArray", PriorityClass.STATE, True),
        ("/image", "sensor_msgs/Image", PriorityClass.BULK, False),
    ],
)
def test_a_bags_topics_get_a_class_by_their_type(
    tmp_path: Path, topic: str, type_name: str, priority: PriorityClass, reliable: bool
) -> None:
    bag = tmp_path / "drive.bag"
    bag.touch()
    files = write_files(tmp_path / "run", Scenario(DEMO, duration_s=60, bag=bag), PORTS)
    loaded = load_client(files[ROBOT]).model
    assert [endpoint.kind for endpoint in loaded.endpoints] == ["bag", "synthetic"]
    spec = loaded.rules().resolve(info(topic, type_name), local_name=TopicName(topic)).spec
    assert (spec.priority, spec.reliable) == (priority, reliable)
