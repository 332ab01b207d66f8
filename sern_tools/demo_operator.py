"""The operator of `sern demo-navigation`, a node of the site's ROS 2 graph: adds to the twin, and gives the goal."""

import asyncio
import secrets
import time
from dataclasses import replace
from typing import Any, Final

import numpy as np

from sern_client.action_conversion import bodies
from sern_client.action_conversion.statuses import Ros2Status
from sern_client.endpoints.base import Publisher, ServiceInfo
from sern_client.endpoints.dds.domain import DomainOptions
from sern_client.endpoints.dds.endpoint import DdsEndpoint, DdsOptions
from sern_client.navigation.action import ACTION, Types
from sern_core.vocabulary.errors import ServiceError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import ros_geometry, ros_types
from sern_sim.robot import Pose2
from sern_tools.demo_navigation_report import Ended

FRAME: Final = "odom"
MARKER: Final = "visualization_msgs/msg/Marker"
ACCEPT_S: Final = 10.0
_CUBE, _ADD = 1, 0


class Operator:
    """`start`, any calls, `stop`."""

    def __init__(self, domain: int, action: str) -> None:
        self._action = action
        self._types: Types | None = None
        self._endpoint = DdsEndpoint(
            DdsOptions(
                DomainOptions(domain, localhost_only=True), node_name="operator", accept_bridged=True, as_node=True
            )
        )
        self._endpoint.watch_services(self)
        self._markers: Publisher | None = None
        self._known: set[TopicName] = set()
        self._served = asyncio.Event()
        self._added = 0

    async def start(self) -> None:
        self._types = Types.known()
        await self._endpoint.start(self)
        info = ros_types.topic_info("/scene/add", MARKER, Encoding.CDR, latched=True, reliable=True)
        self._markers = self._endpoint.advertise(replace(info, depth=100))

    async def stop(self) -> None:
        await self._endpoint.stop()

    def topic_added(self, info: TopicInfo) -> None:
        """The operator looks at the twin's page."""

    def topic_removed(self, name: TopicName) -> None:
        """The operator looks at the twin's page."""

    def service_added(self, info: ServiceInfo) -> None:
        self._known.add(info.name)
        if all(self._part(part) in self._known for part in ("send_goal", "get_result", "cancel_goal")):
            self._served.set()

    def service_removed(self, name: TopicName) -> None:
        self._known.discard(name)

    def wants_service(self, name: TopicName) -> bool:
        return name.startswith(self._action)

    async def served(self) -> None:
        """Return when the action is there."""
        await self._served.wait()

    def add(self, name: str, place: Pose2, size_m: tuple[float, float, float]) -> None:
        """Add a box to the twin, as rviz or a script would."""
        assert self._markers is not None
        new, cdr, now_ns = ros_types.new, Encoding.CDR, time.time_ns()
        pose = ros_geometry.pose(cdr, place.x_m, place.y_m, yaw_rad=place.yaw_rad)
        self._added += 1
        marker = new(
            MARKER, cdr, header=ros_types.header(now_ns, FRAME, cdr), ns=name, id=self._added, type=_CUBE, action=_ADD,
            pose=pose, scale=new("geometry_msgs/msg/Vector3", cdr, x=size_m[0], y=size_m[1], z=size_m[2]),
        )  # fmt: skip
        self._markers.publish(ros_types.serialise(marker, MARKER, cdr), now_ns)

    async def navigate(self, x_m: float, y_m: float, *, timeout_s: float) -> Ended:
        """Give the goal, and wait for its result."""
        assert self._types is not None
        types, new, cdr = self._types, ros_types.new, Encoding.CDR
        goal, uuid = types.send_goal.request, secrets.token_bytes(bodies.UUID_BYTES)
        pose = new(
            "geometry_msgs/msg/PoseStamped", cdr, header=ros_types.header(time.time_ns(), FRAME, cdr),
            pose=new("geometry_msgs/msg/Pose", cdr, position=new("geometry_msgs/msg/Point", cdr, x=x_m, y=y_m)),
        )  # fmt: skip
        request = ros_types.new_in(
            goal.store, goal.name,
            goal_id=ros_types.new_in(
                goal.store, "unique_identifier_msgs/msg/UUID", uuid=np.frombuffer(uuid, np.uint8)
            ),
            goal=ros_types.new_in(goal.store, f"{ACTION}_Goal", pose=pose),
        )  # fmt: skip
        try:
            answer = await self._endpoint.call(
                self._part("send_goal"), bytes(goal.store.serialize_cdr(request, goal.name)), timeout_s=ACCEPT_S
            )
            if not bodies.is_accepted(answer):
                return Ended("rejected", "the goal was not accepted")
            body = await self._endpoint.call(self._part("get_result"), bodies.result_request(uuid), timeout_s=timeout_s)
        except ServiceError as error:
            return Ended("no result", str(error))
        response = types.get_result.response
        said: Any = response.store.deserialize_cdr(body, response.name)
        return Ended(Ros2Status(said.status).name.lower(), str(getattr(said.result, "error_msg", "")))

    def _part(self, part: str) -> TopicName:
        return TopicName(f"{self._action}/_action/{part}")
