"""A goal from another site drives the robot, through relay and keys, and the relay is killed on the way.

The robot, its navigation and its operator are nodes of two ROS 2 graphs; the clients are real processes.
"""

import asyncio
import math
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from random import Random

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="needs Cyclone DDS: pip install 'sern[dds]'")
from sern_client.navigation.daemon import NavigationDaemon
from sern_client.navigation.node import NavigationNode
from sern_runtime.config.navigation import load_navigation
from sern_sim.robot import Pose2, SimulatedJackal
from sern_sim.world import World
from sern_tools.demo_jackal import Robot
from sern_tools.demo_navigation_report import Ended
from sern_tools.demo_operator import Operator
from sern_tools.harness.files import write
from tests.daemons import Lab, Process
from tests.peers.dds.peer import free_domain
from tests.support import until

YARD = [(-5, -5, 5, -5, 2), (5, -5, 5, 5, 2), (5, 5, -5, 5, 2), (-5, 5, -5, -5, 2)]
GOAL_M = (1.5, 1.0)


class Scene:
    """A robot and its navigation in one graph, an operator in another, a relay between them."""

    def __init__(self, lab: Lab) -> None:
        self.lab = lab
        self.domains = (free_domain(), free_domain())
        jackal = SimulatedJackal(Random(1), world=World(np.array(YARD), np.zeros((0, 4)), 6.0))
        jackal.state = replace(jackal.state, pose=Pose2(-2.0, 0.0, 0.0), odometry=Pose2(-2.0, 0.0, 0.0))
        self.jackal = jackal
        self.robot = Robot(jackal, 1, self.domains[0])
        self.operator = Operator(self.domains[1], "/robot1/navigate_to_pose")
        self.relay_file = lab.relay_file()
        self.relay = lab.process(self.relay_file)
        self.clients: list[Process] = []
        self.navigation: NavigationDaemon | None = None

    def graph(self, number: int) -> dict[str, object]:
        return {"kind": "dds", "domain": self.domains[number], "localhost_only": True}

    async def start(self, policy: str) -> None:
        await self.relay.ready()
        action = {"match": "/navigate_to_pose", "timeout_s": 300}
        robot = self.lab.client_file("robot1", self.graph(0), topics=[], actions={"offer": [action]})
        use = {"match": "/robot1/navigate_to_pose", "timeout_s": 300}
        site = self.lab.client_file(
            "site", self.graph(1), client={"namespace": "/"}, discovery={"mode": "manual"}, actions={"use": [use]}
        )
        self.clients = [self.lab.process(robot), self.lab.process(site)]
        for client in self.clients:
            await client.ready()
        content = {
            "endpoint": self.graph(0),
            "grid": {"west_m": -5, "south_m": -5, "width_m": 10, "length_m": 10, "frame_id": "odom"},
            "yaw_scale": self.jackal.yaw_scale_known,
            "topics": {"link": "/sern/link"},
            "controller": {"batch_size": 300},
            "on_link_loss": policy,
        }
        self.navigation = NavigationDaemon(load_navigation(write(self.lab.directory, "navigation", content)))
        await self.navigation.start()
        await self.operator.start()
        await self.operator.served()
        await until(lambda: self.node.readiness().ok)

    @property
    def node(self) -> NavigationNode:
        assert self.navigation is not None
        return self.navigation.node

    @property
    def away_m(self) -> float:
        pose = self.jackal.state.pose
        return math.dist((pose.x_m, pose.y_m), GOAL_M)

    def navigate(self) -> "asyncio.Task[Ended]":
        return asyncio.create_task(self.operator.navigate(*GOAL_M, timeout_s=300))

    async def stop(self) -> None:
        await self.operator.stop()
        if self.navigation is not None:
            await self.navigation.stop()


@asynccontextmanager
async def scene(tmp_path: Path, policy: str = "continue") -> AsyncIterator[Scene]:
    async with Lab(tmp_path, "robot1", "site") as lab:
        made = Scene(lab)
        driving = asyncio.create_task(made.robot.run())
        try:
            await made.start(policy)
            yield made
        finally:
            await made.stop()
            driving.cancel()
            await asyncio.gather(driving, return_exceptions=True)


async def test_the_robot_finishes_although_the_link_dies_on_the_way(tmp_path: Path) -> None:
    async with scene(tmp_path) as site:
        result = site.navigate()
        await until(lambda: site.away_m < 3.2)
        site.relay.kill()
        await until(lambda: site.away_m < 0.5)
        assert not result.done(), "nobody can have told"
        site.relay = site.lab.process(site.relay_file)
        assert await result == Ended("succeeded", "")


async def test_the_robot_waits_for_the_link_where_it_is_told_to(tmp_path: Path) -> None:
    async with scene(tmp_path, "wait") as site:
        result = site.navigate()
        await until(lambda: site.away_m < 3.2)
        site.relay.kill()
        await until(lambda: "stands until it is back" in site.node.words()[1])
        await until(lambda: abs(site.jackal.state.speed_mps) < 0.01)
        assert site.away_m > 0.5
        site.relay = site.lab.process(site.relay_file)
        assert (await result).how == "succeeded"
