"""The robot of `sern demo-navigation`: a simulated Jackal on the campus, as nodes of a ROS 2 graph (DDS) see one.

    python -m sern_tools.demo_jackal --domain 31 --port 5601 [--dem FILE] [--streets FILE]

It publishes /points and /odometry/filtered, drives by /cmd_vel and stands half a second after the last one. Where it
truly is, how far it drove and what it touched is told over HTTP (/api/robot).
"""

import asyncio
import time
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Annotated, Final

import typer
from prometheus_client import CollectorRegistry

from sern_client.endpoints.base import Publisher, Subscription, TopicEvents
from sern_client.endpoints.clouds import CLOUD_TYPE, cloud_body
from sern_client.endpoints.dds.domain import DomainOptions
from sern_client.endpoints.dds.endpoint import DdsEndpoint, DdsOptions
from sern_client.endpoints.twin.bodies import ODOMETRY, read_message
from sern_core.vocabulary.errors import BodyError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import clock, ros_geometry, ros_types
from sern_runtime.config.shared import LogSection
from sern_runtime.entry import run_daemon, serve
from sern_runtime.http import HttpServer
from sern_runtime.http_routes import Health
from sern_runtime.loop import Shutdown
from sern_sim.mujoco_jackal import MujocoJackal
from sern_sim.plant import Plant
from sern_sim.robot import STEP_S
from sern_tools.demo_campus import START, campus

COMMAND: Final = TopicName("/cmd_vel")
TWIST: Final = "geometry_msgs/msg/Twist"
FRAME, BASE, LIDAR = "odom", "base_link", "velodyne"
POINTS: Final = 16 * 450
CLOUD_S: Final = 0.1
ODOMETRY_S: Final = 0.04
STANDS_S: Final = 0.5
"""It stands without a command for so long, as the base of a Jackal does."""
NOISE_M, NOISE_RAD = 0.01, 0.002
"""What its localisation is off in each axis, one sigma."""


class Robot:
    """`run` until cancelled."""

    def __init__(self, jackal: Plant, seed: int, domain: int, *, touches: Callable[[], bool] = lambda: False) -> None:
        """`touches`: whether it touches anything now."""
        self.jackal = jackal
        self.touched = 0
        self._noise = Random(seed + 1)
        self._endpoint = DdsEndpoint(
            DdsOptions(DomainOptions(domain, localhost_only=True), node_name="jackal", as_node=True)
        )
        self._commanded_s = 0.0
        self._subscription: Subscription | None = None
        self._touching = touches
        self._touches = False
        self._seq = 0

    # Commands

    def topic_added(self, info: TopicInfo) -> None:
        if info.name == COMMAND and self._subscription is None:
            self._subscription = self._endpoint.subscribe(info.name, self._obey)

    def topic_removed(self, name: TopicName) -> None:
        if name == COMMAND and self._subscription is not None:
            self._subscription.close()
            self._subscription = None

    def _obey(self, body: bytes, _stamp_ns: int) -> bool:
        try:
            twist = read_message(body, TWIST, Encoding.CDR)
            self.jackal.drive(float(twist.linear.x), float(twist.angular.z))
        except (BodyError, ValueError):
            return False
        self._commanded_s = clock.now()
        return True

    # In time

    async def run(self) -> None:
        events: TopicEvents = self
        await self._endpoint.start(events)
        try:
            odometry = self._advertise("/odometry/filtered", ODOMETRY)
            points = self._advertise("/points", CLOUD_TYPE)
            begin_s = clock.now()
            cloud_s = odometry_s = 0.0
            while True:
                at_s = clock.now() - begin_s
                if clock.now() - self._commanded_s > STANDS_S:
                    self.jackal.drive(0.0, 0.0)
                while self.jackal.state.time_s + STEP_S <= at_s:
                    self.jackal.step()
                    touches = self._touching()
                    self.touched += touches and not self._touches
                    self._touches = touches
                stamp_ns = time.time_ns()
                if at_s >= odometry_s:
                    odometry_s = max(odometry_s + ODOMETRY_S, at_s - ODOMETRY_S)
                    odometry.publish(self._odometry(stamp_ns), stamp_ns)
                if at_s >= cloud_s:
                    cloud_s = max(cloud_s + CLOUD_S, at_s - CLOUD_S)
                    self._seq += 1
                    cloud = self.jackal.cloud(POINTS)
                    points.publish(cloud_body(cloud, stamp_ns, LIDAR, Encoding.CDR, self._seq), stamp_ns)
                await asyncio.sleep(max(0.0, min(cloud_s, odometry_s) - (clock.now() - begin_s)))
        finally:
            await self._endpoint.stop()

    def _advertise(self, name: str, type_name: str) -> Publisher:
        return self._endpoint.advertise(ros_types.topic_info(name, type_name, Encoding.CDR))

    def _odometry(self, stamp_ns: int) -> bytes:
        state, gauss = self.jackal.state, self._noise.gauss
        new = ros_types.new
        pose = ros_geometry.pose(
            Encoding.CDR, state.pose.x_m + gauss(0, NOISE_M), state.pose.y_m + gauss(0, NOISE_M), state.z_m,
            state.pose.yaw_rad + gauss(0, NOISE_RAD), state.roll_rad, state.pitch_rad,
        )  # fmt: skip
        twist = new(
            "geometry_msgs/msg/Twist",
            Encoding.CDR,
            linear=new("geometry_msgs/msg/Vector3", Encoding.CDR, x=state.speed_mps),
            angular=new("geometry_msgs/msg/Vector3", Encoding.CDR, z=state.yaw_rate_radps),
        )
        message = new(
            ODOMETRY,
            Encoding.CDR,
            header=ros_types.header(stamp_ns, FRAME, Encoding.CDR),
            child_frame_id=BASE,
            pose=new("geometry_msgs/msg/PoseWithCovariance", Encoding.CDR, pose=pose),
            twist=new("geometry_msgs/msg/TwistWithCovariance", Encoding.CDR, twist=twist),
        )
        return ros_types.serialise(message, ODOMETRY, Encoding.CDR)

    def to_json(self) -> dict[str, object]:
        state = self.jackal.state
        return {
            "pose": [state.pose.x_m, state.pose.y_m, state.pose.yaw_rad],
            "travelled_m": state.travelled_m,
            "touched": self.touched,
            "time_s": state.time_s,
        }


def command(
    domain: Annotated[int, typer.Option(min=0, max=232, help="ROS_DOMAIN_ID of its graph.")],
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of its HTTP server, on loopback.")],
    seed: Annotated[int, typer.Option(min=0)] = 1,
    dem: Annotated[Path | None, typer.Option(help="An elevation model.")] = None,
    streets: Annotated[Path | None, typer.Option(help="A map (.osm).")] = None,
) -> None:
    """A simulated Jackal as a node of a ROS 2 graph, until SIGTERM or Ctrl-C."""

    async def run(shutdown: Shutdown) -> int:
        ros_types.load()
        jackal = MujocoJackal(Random(seed), world=campus(seed, dem, streets).terrain, start=START)
        robot = Robot(jackal, seed, domain, touches=lambda: jackal.touches)

        def works() -> Health:
            return Health(ok=True, reason="driving")

        http = HttpServer(
            f"127.0.0.1:{port}", CollectorRegistry(), health=works, ready=works,
            json_routes={"/api/robot": robot.to_json},
        )  # fmt: skip
        task = asyncio.create_task(robot.run(), name="robot")
        await http.start()
        try:
            await serve(shutdown, [task])
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
            await http.stop()
        return 0

    raise typer.Exit(run_daemon("demo_jackal", LogSection, run))


if __name__ == "__main__":
    typer.run(command)
