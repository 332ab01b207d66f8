"""Nodes of ROS 2 at a site, a server of ROS 1 at the robot, and relay and clients as their user runs them."""

import asyncio
import struct
from pathlib import Path
from typing import Any

import pytest

from sern_client import daemon as client_daemon
from sern_client.action_conversion import bodies
from sern_client.action_conversion.bodies import NO_STAMP, GoalInfo
from sern_client.action_conversion.statuses import Ros1Status, Ros2Status
from sern_client.actions import STATUS_TYPE
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import ros_types
from tests.daemons import Lab
from tests.sern_client.action_conversion.files import FIBONACCI, files, types_of
from tests.sern_client.action_conversion.nodes import ACTION, Nodes, Site
from tests.support import until

ENDPOINT = {"kind": "synthetic", "role": "operator"}
"""Any that the configuration accepts: the test puts its own in its place."""
UUID = bytes(range(16))
REFUSED = bodies.goal_response(accepted=False, stamp=NO_STAMP)


class Sites:
    def __init__(self, lab: Lab, monkeypatch: pytest.MonkeyPatch, place: Path) -> None:
        self.lab = lab
        self.robot = Nodes(Encoding.ROS1)
        self.site = Site(Encoding.CDR, place / "types")
        ends = {"robot1": self.robot, "site": self.site.endpoint}
        monkeypatch.setattr(client_daemon, "make_endpoint", lambda loaded: ends[loaded.model.name])
        self.types = types_of("count/Count", files(place / "robot", count__Count=FIBONACCI))

    async def start(self, **site: Any) -> None:
        manual = {"mode": "manual"}
        offer = {"offer": [{"match": "/count"}]}
        await self.lab.connected(self.lab.client_file("robot1", ENDPOINT, discovery=manual, actions=offer))
        use = {"use": [{"match": ACTION, "timeout_s": 60, **site}]}
        await self.lab.connected(
            self.lab.client_file("site", ENDPOINT, client={"namespace": "/"}, discovery=manual, actions=use)
        )
        self.robot.add(ros_types.topic_info("/count/status", STATUS_TYPE, Encoding.ROS1))
        for part, (kind, text) in (("feedback", self.types.feedback.topic), ("result", self.types.result.topic)):
            info = TopicInfo(TopicName(f"/count/{part}"), kind, Encoding.ROS1, text.type_hash, text.definition)
            self.robot.add(info)
        await until(lambda: len(self.site.nodes.served) == 3, "it is shown")

    def says(self, part: str, body: bytes) -> None:
        self.robot.sinks[TopicName(f"/count/{part}")].sink(bodies.ros1_header(1, NO_STAMP) + body, 10**18 + 1)


async def test_a_goal_goes_there_and_its_result_comes_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async with Lab(tmp_path, "robot1", "site") as lab:
        await lab.relay()
        sites = Sites(lab, monkeypatch, tmp_path)
        await sites.start()
        answer = asyncio.ensure_future(sites.site.call("send_goal")(bodies.HEAD + UUID + struct.pack("<i", 5)))
        goal, cancel = TopicName("/count/goal"), TopicName("/count/cancel")
        await until(lambda: goal in sites.robot.published and sites.robot.published[goal].bodies, "the goal is there")
        ident, own = bodies.split_goal(sites.robot.published[goal].bodies[0])
        assert own == struct.pack("<i", 5) and sites.robot.published[goal].info.type_name == "count/msg/CountActionGoal"
        sites.says("status", struct.pack("<I", 1) + bodies.ros1_status(ident, Ros1Status.ACTIVE, ""))
        assert bodies.is_accepted(await answer)
        stop = bodies.cancel_request(GoalInfo(UUID, NO_STAMP))
        assert bodies.cancel_code(await sites.site.call("cancel_goal")(stop)) == bodies.NONE
        await until(lambda: cancel in sites.robot.published and sites.robot.published[cancel].bodies, "so is its end")
        assert bodies.split_cancel(sites.robot.published[cancel].bodies[0]).text == ident.text
        sites.says("result", bodies.ros1_status(ident, Ros1Status.PREEMPTED, "") + struct.pack("<Ii", 1, 7))
        response = await sites.site.call("get_result")(bodies.result_request(UUID))
        assert response == bodies.HEAD + struct.pack("<b3xIi", Ros2Status.CANCELED, 1, 7)


async def test_a_goal_that_the_relay_does_not_let_pass_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    everything = [".*"]
    access = [
        {"client": "robot1", "publish": everything, "subscribe": everything},
        {"client": "site", "publish": ["/robot1/count/cancel"], "subscribe": everything},
    ]
    async with Lab(tmp_path, "robot1", "site") as lab:
        await lab.relay(lab.relay_file(access=access))
        sites = Sites(lab, monkeypatch, tmp_path)
        await sites.start()
        assert await sites.site.call("send_goal")(bodies.HEAD + UUID + struct.pack("<i", 5)) == REFUSED
        assert "the relay refuses /robot1/count/goal" in caplog.text


async def test_a_goal_without_a_link_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async with Lab(tmp_path, "robot1", "site") as lab:
        relay = await lab.relay()
        sites = Sites(lab, monkeypatch, tmp_path)
        await sites.start(timeout_s=0.5)
        await lab.drop(relay)
        assert await sites.site.call("send_goal")(bodies.HEAD + UUID + struct.pack("<i", 5)) == REFUSED
