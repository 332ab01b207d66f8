"""What the demo runs: the load, the rules, and the configuration files of relay, robot and site.

The load is shaped to the link: poses, commands, a map and a counter that fit through its narrowest moment, and point
clouds that bring the whole to `overload` times its usual rate. Robot topics are `/robot/...` for everyone.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from ruamel.yaml import YAML

from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.params import SchedulerParams
from sern_sim.profiles import LinkProfile
from sern_tools.harness.files import Content, client_content, relay_content
from sern_tools.keygen import make_keys
from sern_tools.shaping import RateSchedule

HOST: Final = "127.0.0.1"
FAR_HOST: Final = "127.0.0.2"
"""Where the robot finds the relay: the address of the shaping proxy, another one of loopback's."""
RELAY, ROBOT, SITE = "relay", "robot", "site"
COMMAND_TOPIC: Final = "/robot/cmd_vel"
POSE_TOPIC: Final = "/robot/odometry/filtered"
COUNTER_TOPIC: Final = "/counter"
SHORT_COMMAND_LIFESPAN_S: Final = 0.3
STATE_OVERTAKEN_LIMIT: Final = SchedulerParams().floor
"""Class bulk keeps this share of the link while class state is backlogged, so it may overtake as often."""
CONTROL_OVERTAKEN_LIMIT: Final = 0.01
COMFORTABLE_BPS: Final = 1e6
"""The small topics run at full rate and size from this rate on; on slower links they shrink with it."""
FULL_POSE_RATE_HZ: Final = 50.0
FULL_MAP_BYTES: Final = 20_000
CLOUD_RATE_HZ: Final = 10.0
ODOMETRY_BYTES: Final = 730
POSE_BYTES: Final = 110
CLOUD_LIFESPAN_S: Final = 3.0
"""A cloud of the demo may take a while on a link that has just become four times slower, and is still of use."""
ADAPTATION: Final = {
    "deadlines_s": {"bulk": CLOUD_LIFESPAN_S},
    "limits": {"min_rates": {"control": 1.0, "state": 1.0, "bulk": 0.4}},
}
"""The robot's: the defaults, but clouds have their lifespan to arrive, and as many are let in as the link carries of
twice its load."""


@dataclass(frozen=True)
class Ports:
    """Ports on loopback; the relay's is the proxy's too, at another address."""

    relay: int
    relay_http: int
    robot_http: int
    site_http: int


@dataclass(frozen=True)
class Scenario:
    """One demo: the link, how long, how much, and whether a bag or the simulated robot plays."""

    profile: LinkProfile
    duration_s: float
    overload: float = 2.0
    seed: int = 1
    bag: Path | None = None

    @property
    def usual_bps(self) -> float:
        """The rate of the link when the script begins."""
        rate = self.profile.rate_bps_at(0.0)
        if rate is None:
            raise ConfigError(f"profile {self.profile.name} has no rate: the demo overloads a link that has one")
        return rate

    @property
    def lowest_bps(self) -> float:
        """The lowest rate above nothing during the run."""
        steps = RateSchedule.of(self.profile.up, until_s=self.duration_s).steps
        return min(rate for _, rate in steps if rate > 0)

    @property
    def comfort(self) -> float:
        return min(1.0, self.lowest_bps / COMFORTABLE_BPS)

    @property
    def command_lifespan_s(self) -> float:
        """Long enough for the path: half its round trip on the way, half for what the receiver cannot know of the
        other clock, and as much again for a queue. Below that no command would ever be young enough."""
        return max(SHORT_COMMAND_LIFESPAN_S, round(0.15 + 2 * self.profile.rtt_s, 2))

    @property
    def pose_rate_hz(self) -> float:
        return max(5.0, round(FULL_POSE_RATE_HZ * self.comfort))

    @property
    def map_bytes(self) -> int:
        return max(1000, int(FULL_MAP_BYTES * self.comfort))

    @property
    def cloud_bytes(self) -> int:
        """What brings the offered load to `overload` times the usual rate."""
        small = self.pose_rate_hz * (ODOMETRY_BYTES + POSE_BYTES) + self.map_bytes
        clouds = self.overload * self.usual_bps / 8 - small
        return max(1000, int(clouds / CLOUD_RATE_HZ))

    @property
    def robot_endpoints(self) -> list[dict[str, Any]]:
        robot: dict[str, Any] = {
            "kind": "synthetic",
            "role": "robot",
            "seed": self.seed,
            "patrol": True,
            "topics": ["/odometry/filtered", "/pose", "/map", "/points"],
            "pose_rate_hz": self.pose_rate_hz,
            "map_bytes": self.map_bytes,
            "map_rate_hz": 1.0,
            "cloud_bytes": self.cloud_bytes,
            "cloud_rate_hz": CLOUD_RATE_HZ,
            "counter_topics": [COUNTER_TOPIC],
        }
        if self.bag is None:
            return [robot]
        # Clouds, to overload the link, and the counter come from the simulated robot; the bag brings the rest.
        bag = {"kind": "bag", "path": str(self.bag.resolve()), "loop": True, "deny": ["/points|/counter"]}
        return [bag, {**robot, "topics": ["/points"]}]

    @property
    def robot_rules(self) -> list[dict[str, Any]]:
        """First match wins. By name for the simulated robot, and by type for whatever a bag holds."""
        control = {"class": "control", "direction": "send", "reliability": "best_effort", "depth": 1}
        state = {"class": "state", "direction": "send", "reliability": "reliable"}
        bulk = {"class": "bulk", "direction": "send", "reliability": "best_effort"}
        rules: list[dict[str, Any]] = [
            {
                "match": "/cmd_vel",
                "class": "control",
                "direction": "receive",
                "lifespan_s": self.command_lifespan_s,
                "on_link_loss": {"publish": "zero", "after_s": self.command_lifespan_s + 0.2},
            },
            {"match": "/points", **bulk, "lifespan_s": CLOUD_LIFESPAN_S},
            {"match": COUNTER_TOPIC, **state},
            {"match": "/map", **state, "durability": "transient_local", "depth": 1},
            {"match": "/odometry/filtered|/pose", **control},
        ]
        if self.bag is not None:
            rules += [
                {"match": ".*", "type": "nav_msgs/Odometry|geometry_msgs/(Pose|Twist).*|tf(2_msgs)?/.*", **control},
                {"match": ".*", "type": "sensor_msgs/Imu", **control},
                {"match": ".*", "type": "nav_msgs/OccupancyGrid|sensor_msgs/(NavSatFix|BatteryState)", **state},
                {"match": ".*", "type": "diagnostic_msgs/.*", **state},
                {"match": ".*", **bulk},
            ]
        return rules


def write_files(directory: Path, scenario: Scenario, ports: Ports) -> dict[str, Path]:
    """Keys and configuration files of one run, by the names relay, robot and site. The directory must be new."""
    make_keys(directory, RELAY, ROBOT, SITE)
    files = {RELAY: _relay(ports), ROBOT: _robot(scenario, ports), SITE: _site(scenario, ports)}
    written = {}
    for name, content in files.items():
        written[name] = directory / f"{name}.yaml"
        with written[name].open("w", encoding="utf-8") as stream:
            YAML(typ="safe", pure=True).dump(content, stream)
    return written


def _relay(ports: Ports) -> Content:
    return relay_content(
        f"tcp://{HOST}:{ports.relay}",
        access=[
            {"client": ROBOT, "publish": ["/{self}/.*"], "subscribe": [COMMAND_TOPIC]},
            {"client": SITE, "publish": [COMMAND_TOPIC], "subscribe": [f"/{ROBOT}/.*"]},
        ],
        **_said(RELAY, ports.relay_http),
    )


def _robot(scenario: Scenario, ports: Ports) -> Content:
    return client_content(
        ROBOT,
        f"tcp://{FAR_HOST}:{ports.relay}",
        scenario.robot_endpoints,
        topics=scenario.robot_rules,
        discovery={"mode": "dynamic"},
        adaptation=ADAPTATION,
        **_said(ROBOT, ports.robot_http),
    )


def _site(scenario: Scenario, ports: Ports) -> Content:
    operator = {
        "kind": "synthetic",
        "role": "operator",
        "seed": scenario.seed,
        "command_topic": COMMAND_TOPIC,
        "command_rate_hz": 10.0,
        "goal_rate_hz": 0.0,
    }
    commands = {"match": COMMAND_TOPIC, "class": "control", "direction": "send", "reliability": "best_effort"}
    return client_content(
        SITE,
        f"tcp://{HOST}:{ports.relay}",
        [operator],
        client={"namespace": "/"},  # it commands the robot by the robot's own topic
        topics=[{**commands, "depth": 1, "lifespan_s": scenario.command_lifespan_s}],
        subscribe=[f"/{ROBOT}/.*"],
        **_said(SITE, ports.site_http),
    )


def _said(name: str, http_port: int) -> Content:
    """Where a daemon says what it does."""
    return {
        "http": {"listen": f"{HOST}:{http_port}"},
        "message_log": f"{name}.csv",
        "summary": f"{name}.summary.json",
    }
