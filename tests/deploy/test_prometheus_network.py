"""Alerts in a real Prometheus about a bad network, what comes over it, and parts that fail: they fire, and clear.

A robot is reached over 0.6 s each way without datagrams, and then over a good network. The robot's daemon runs in this
process, where somebody stops the robot by hand, what it sends can be spoilt, and one of its metrics be broken.
"""

import json
import math
import resource
from pathlib import Path
from typing import Final

import pytest

from sern_client.daemon import ClientDaemon
from sern_client.endpoints.synthetic import SyntheticEndpoint
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import ros_types
from sern_runtime.datagram_watch import datagrams_pass
from sern_runtime.udp_client import UdpClient
from sern_runtime.zmq_socket import SendResult
from sern_sim.models import LinkModel
from sern_tools.proxy import Route, ShapingProxy
from tests.daemons import HOST, Json, Lab, Process, endpoint_of
from tests.deploy.prometheus import Jobs, Prometheus, missing, prometheus, scaled
from tests.deploy.test_metrics import RULES
from tests.support import until

pytestmark = pytest.mark.skipif(missing() is not None, reason=missing() or "")

FAR_HOST: Final = "127.0.0.2"
"""Where the robot finds the relay: networks that come and go are in between."""
BAD: Final = LinkModel(delay_s=0.6)
GOOD: Final = LinkModel(delay_s=0.005)
ROBOT: Final[Json] = {
    "kind": "synthetic", "role": "robot", "topics": ["/odometry/filtered"], "follow": True, "encoding": "cdr",
}  # fmt: skip
ROBOT_RULES: Final[list[Json]] = [
    {"match": "/odometry/filtered", "class": "control", "reliability": "best_effort", "depth": 1, "lifespan_s": 5.0},
]
TWINS: Final[Json] = {
    "kind": "twin",
    "robots": [{"name": "robot1", "pose": "/robot1/odometry/filtered", "plan": "/robot1/plan", "error_m": 0.04}],
}
TWIST: Final = "geometry_msgs/msg/Twist"
RIGHT_M: Final = 0.1
FAR_M: Final = 1.0
FAR: Final = 1.5
"""A twin is far off when it is so many metres off, and so many times what it says that it may be."""
ALERTS: Final = (
    "SernNoDatagrams", "SernClockUncertain", "SernControlLate", "SernOptionalPart", "SernMetricBroken", "SernBadFrames",
    "SernTwinOutside",
)  # fmt: skip
ROOM_BYTES: Final = 20_000
"""What the relay may write into one file: more than its own log has, and soon less than its message log."""


async def test_alerts_about_a_bad_network_and_parts_that_fail(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async with Lab(tmp_path, "robot1", "twin") as lab:
        relay = lab.process(lab.relay_file(message_log="messages.csv"))
        twin = lab.process(lab.client_file("twin", TWINS, client={"namespace": "/"}, discovery={"mode": "manual"}))
        there = {"endpoint": f"tcp://{FAR_HOST}:{lab.port}"}
        file = lab.client_file("robot1", ROBOT, topics=ROBOT_RULES, relay=there)
        at_robot: str = json.loads(file.read_text())["http"]["listen"]
        route = Route((FAR_HOST, lab.port), (HOST, lab.port))
        jobs: Jobs = {"sern-relay": [relay], "sern-client": [twin, at_robot]}
        with prometheus(tmp_path, scaled(RULES), jobs) as server:
            async with ShapingProxy(BAD, BAD, [route]):
                robot = await lab.client(file)
                await server.until_up()
                leave_no_room(relay)
                with monkeypatch.context() as patch:
                    patch.setattr(robot.bridge.inbound, "deadlines_missed", None)
                    await over_a_bad_network(server, relay, at_robot)
                    await server.until_fired("SernOptionalPart", instance=server.target(relay), part="message_log")
                    await server.until_fired("SernMetricBroken", instance=at_robot, metric="sern_deadline_missed_total")
            async with ShapingProxy(GOOD, GOOD, [route], datagrams=True):
                await twin.until(lambda: is_right(twin, robot), "shows the robot where it is, and goes by its plan")
            stop_by_hand(robot)  # while there is no network
            await twin.until(lambda: is_astray(twin, robot), "is far from where the robot stands")
            async with ShapingProxy(GOOD, GOOD, [route], datagrams=True):
                await server.until_fired("SernTwinOutside", instance=server.target(twin), robot="robot1")
                await until(lambda: datagrams_pass(robot.core.link), "datagrams pass")
                spoil_one(monkeypatch)
                await server.until_fired("SernBadFrames", instance=server.target(relay))
                await server.until_clear(*ALERTS)
                await lab.end(robot)


async def over_a_bad_network(server: Prometheus, relay: Process, at_robot: str) -> None:
    """Both ends miss the datagrams and know each other's clock badly; the relay gets control messages late."""
    for ends in ({"instance": server.target(relay), "peer": "robot1"}, {"instance": at_robot, "peer": "relay"}):
        await server.until_fired("SernNoDatagrams", **ends)
        await server.until_fired("SernClockUncertain", **ends)
    await server.until_fired("SernControlLate", instance=server.target(relay))


def leave_no_room(relay: Process) -> None:
    """Nothing that the relay writes becomes larger than this, as on a disk that is full: its message log ends."""
    _soft, hard = resource.prlimit(relay.process.pid, resource.RLIMIT_FSIZE)
    resource.prlimit(relay.process.pid, resource.RLIMIT_FSIZE, (ROOM_BYTES, hard))


def spoil_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Send what is no frame in place of the next datagram, sealed with the right key."""
    send = UdpClient.send
    spoilt: list[bytes] = []

    def spoil(self: UdpClient, data: bytes, tos: int | None = None) -> SendResult:
        if not spoilt:
            spoilt.append(data)
            data = b"no frame"
        return send(self, data, tos)

    monkeypatch.setattr(UdpClient, "send", spoil)


def stop_by_hand(robot: ClientDaemon) -> None:
    """A node beside the robot's client tells the robot to stand."""
    endpoint: SyntheticEndpoint = endpoint_of(robot, SyntheticEndpoint)
    publisher = endpoint.advertise(ros_types.topic_info(TopicName("/cmd_vel"), TWIST, Encoding.CDR))
    publisher.publish(ros_types.serialise(ros_types.new(TWIST, Encoding.CDR), TWIST, Encoding.CDR), 0)
    publisher.close()


def told(twin: Process, robot: ClientDaemon) -> tuple[Json, float]:
    """What the twin says, and how far it shows the robot from where it is."""
    says: Json = twin.json("/api/twins")["robot1"]
    pose = endpoint_of(robot, SyntheticEndpoint).state().pose
    return says, math.inf if says["pose"] is None else math.dist(says["pose"][:2], (pose.x_m, pose.y_m))


def is_right(twin: Process, robot: ClientDaemon) -> bool:
    says, off_m = told(twin, robot)
    return bool(says["goes_by"] == "trajectory" and off_m < RIGHT_M)


def is_astray(twin: Process, robot: ClientDaemon) -> bool:
    """Whether it shows the robot further from where it stands than it says that it may be off, by far."""
    says, off_m = told(twin, robot)
    return bool(off_m > max(FAR_M, FAR * says["error_m"]))
