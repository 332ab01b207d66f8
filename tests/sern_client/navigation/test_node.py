"""A node that navigates, at a graph in memory and a simulated robot: time is what the test says it is."""

import asyncio
import math
import os
import signal
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from dataclasses import replace
from functools import partial
from random import Random
from typing import Any, Final

import numpy as np
import pytest

from sern_client.action_conversion.bodies import result_request
from sern_client.navigation.action import NavigateToPose, Types
from sern_client.navigation.node import NavigationNode, Unused
from sern_client.navigation.options import Localisation, Mount, NodeOptions, OnLinkLoss, Stamps, TopicNames
from sern_client.navigation.planning import PlannerProcess
from sern_core.vocabulary.types import Encoding, TopicName
from sern_navigation.global_plan import plan_for
from sern_navigation.mppi import MppiOptions
from sern_navigation.navigator import Goal, Navigator, NavigatorOptions, State
from sern_navigation.scan import Cloud
from sern_sim.robot import LIDAR_HEIGHT_M, STEP_S, Pose2, SimulatedJackal
from sern_sim.world import World
from sern_twin.world.grid import Grid
from tests.sern_client.navigation import bodies
from tests.sern_client.navigation.graph import Graph
from tests.support import until

GRID: Final = Grid(-5.0, -5.0, 0.1, 100, 100)
PERIOD_S: Final = 0.1
BEGIN_NS: Final = 1_700_000_000 * 10**9
TOPICS: Final = TopicNames(map="/map", twin="/twin/scene/map", link="/sern/link", own_map="/own_map")
Walls = Sequence[tuple[float, float, float, float, float]]
"""Each from where to where, and how high [m]."""
FEW: Final = NavigatorOptions(controller=MppiOptions(batch_size=200))


class AtOnce:
    """Plans in the node's own process, in the cycle that wants them."""

    failures = 0

    def __init__(self, navigator: Navigator) -> None:
        self._navigator = navigator

    async def warm(self) -> None:
        """It runs."""

    def look(self) -> None:
        request = self._navigator.request()
        if request is not None:
            self._navigator.planned(request, plan_for(request))

    async def close(self) -> None:
        """There is nothing to end."""


class Scene:
    """A robot in a yard with a wall, and its node."""

    def __init__(self, options: NodeOptions, walls: Walls) -> None:
        yard = [(-5, -5, 5, -5, 2), (5, -5, 5, 5, 2), (5, 5, -5, 5, 2), (-5, 5, -5, -5, 2)]
        self.robot = SimulatedJackal(Random(1), world=World(np.array([*yard, *walls]), np.zeros((0, 4)), 6.0))
        self.robot.state = replace(self.robot.state, pose=Pose2(-2.0, 0.0, 0.0), odometry=Pose2(-2.0, 0.0, 0.0))
        self.now_s = 50.0
        self.graph = Graph()
        self.node = NavigationNode(
            replace(options, yaw_scale=self.robot.yaw_scale_known), GRID, self.graph.endpoint, Encoding.CDR,
            planner=AtOnce, now=lambda: self.now_s, wall_ns=lambda: self.wall_ns,
        )  # fmt: skip
        self.node.action = NavigateToPose(
            TopicName("/navigate_to_pose"), Types.known(), go=self.node.go, cancel=self.node.cancel,
            now=lambda: self.now_s, wall_ns=lambda: self.wall_ns,
        )  # fmt: skip
        self.node.action.serve(self.graph.endpoint, self.graph.endpoint)
        for name, type_name in (
            ("/points", "sensor_msgs/msg/PointCloud2"), ("/odometry/filtered", "nav_msgs/msg/Odometry"),
            ("/map", "nav_msgs/msg/OccupancyGrid"), ("/twin/scene/map", "nav_msgs/msg/OccupancyGrid"),
            ("/twin/scene/map_updates", "map_msgs/msg/OccupancyGridUpdate"),
            ("/goal_pose", "geometry_msgs/msg/PoseStamped"), ("/sern/link", "diagnostic_msgs/msg/DiagnosticStatus"),
        ):  # fmt: skip
            self.graph.announce(self.node, name, type_name)

    @property
    def wall_ns(self) -> int:
        return BEGIN_NS + round(self.now_s * 1e9)

    @property
    def commands(self) -> list[Any]:
        return self.graph.said.get("/cmd_vel", [])

    def odometry(self, frame_id: str = "map") -> None:
        pose = self.robot.state.pose
        body = bodies.odometry(self.wall_ns, pose.x_m, pose.y_m, pose.yaw_rad, frame_id=frame_id)
        self.graph.give("/odometry/filtered", body)

    def cloud(self) -> None:
        self.graph.give("/points", bodies.cloud(self.wall_ns, self.robot.cloud(5_760)))

    def turn(self, *, cloud: bool = True, odometry: bool = True) -> None:
        """One period: the robot drives by the last command, and the node has a cycle."""
        for _ in range(round(PERIOD_S / STEP_S)):
            self.robot.step()
        self.now_s += PERIOD_S
        if odometry:
            self.odometry()
        if cloud:
            self.cloud()
        before = len(self.commands)
        self.node.cycle()
        told = self.commands[before:]
        speed = (told[-1].linear.x, told[-1].angular.z) if told else (0.0, 0.0)
        self.robot.drive(*speed)

    async def give(self, x_m: float, y_m: float) -> "asyncio.Task[tuple[int, int, str]]":
        """Give a goal by the action; the result is awaited."""
        assert self.node.action is not None
        types, uuid = Types.known(), bytes(range(16))
        kind = types.send_goal.request
        goal = bodies.goal_request(types, uuid, x_m, y_m)
        await self.node.action.send_goal(bytes(kind.store.serialize_cdr(goal, kind.name)))
        waiting = asyncio.create_task(self._result(types, uuid))
        await asyncio.sleep(0)
        return waiting

    async def _result(self, types: Types, uuid: bytes) -> tuple[int, int, str]:
        assert self.node.action is not None
        kind = types.get_result.response
        said: Any = kind.store.deserialize_cdr(await self.node.action.get_result(result_request(uuid)), kind.name)
        return said.status, said.result.error_code, said.result.error_msg


async def settled() -> None:
    """What waits for a result has it."""
    for _ in range(5):
        await asyncio.sleep(0)


def _has_scans(site: Scene, number: int) -> bool:
    return site.node.own_map_scans >= number


@asynccontextmanager
async def scene(*, walls: Walls = (), **options: Any) -> AsyncIterator[Scene]:
    given: dict[str, Any] = {"lidar": Mount(z_m=LIDAR_HEIGHT_M), **options}
    made = Scene(NodeOptions(topics=TOPICS, navigator=FEW, **given), walls)
    try:
        yield made
    finally:
        await made.node.close()


async def test_a_goal_of_the_action_is_driven_to() -> None:
    async with scene() as site:
        site.turn()
        assert not site.commands, "without a goal it tells the base nothing"
        result = await site.give(1.0, 0.5)
        for _ in range(200):
            site.turn()
            await asyncio.sleep(0)
            if result.done():
                break
        pose = site.robot.state.pose
        assert await result == (4, 0, "") and math.dist((pose.x_m, pose.y_m), (1.0, 0.5)) < 0.35
        assert site.node.ended == {State.SUCCEEDED: 1}
        for _ in range(20):
            site.turn()
        assert (site.commands[-1].linear.x, site.commands[-1].angular.z) == (0.0, 0.0)
        told = len(site.commands)
        site.turn()
        assert len(site.commands) == told, "others may drive it now"
        path = site.graph.last("/plan")
        assert path.header.frame_id == "map" and path.poses[-1].pose.position.x == pytest.approx(1.0, abs=0.1)
        assert site.graph.last("/navigation/status").status[0].message == "succeeded"
        assert site.graph.last("/local_costmap/costmap").info.resolution == pytest.approx(0.1)
        scan = site.graph.last("/obstacle_scan")
        assert len(scan.ranges) == 360 and np.nanmin(scan.ranges) > 0.5 and scan.header.frame_id == "base_link"
        assert site.graph.said["/navigate_to_pose/_action/feedback"]


async def test_goals_come_by_topic_too_and_take_the_place_of_others() -> None:
    async with scene() as site:
        result = await site.give(1.0, 0.5)
        site.turn()
        site.graph.give("/goal_pose", bodies.goal_body(-2.0, 0.1))
        site.turn()
        await settled()
        assert (await result)[::2] == (6, "another goal took its place")
        assert site.node.to_json()["goal"] == [-2.0, 0.1, None]


async def test_cancelling_stops_the_robot() -> None:
    async with scene() as site:
        result = await site.give(3.0, 0.0)
        for _ in range(10):
            site.turn()
        assert site.commands[-1].linear.x > 0.1
        site.node.cancel()
        site.turn()
        await settled()
        assert (await result)[0] == 5 and site.commands[-1].linear.x == 0.0


@pytest.mark.parametrize(
    ("x_m", "frame_id", "says"),
    [
        (math.nan, "map", "not finite"),
        (100.0, "map", "not on the map"),
        (1.0, "odom", "the goal is in frame 'odom', the map in 'map'"),
    ],
)
async def test_a_goal_that_cannot_be_is_a_code_and_a_line(x_m: float, frame_id: str, says: str) -> None:
    async with scene() as site:
        site.turn()
        site.graph.give("/goal_pose", bodies.goal_body(x_m, 0.0, frame_id=frame_id))
        for _ in range(3):
            site.turn()
        assert site.node.status.state is State.ABORTED and says in site.node.words()[1] and site.node.words()[0] == 2
        assert all(each.linear.x == 0.0 for each in site.commands)


async def test_without_clouds_the_robot_stands_and_then_gives_up() -> None:
    async with scene() as site:
        result = await site.give(3.0, 0.0)
        for _ in range(10):
            site.turn()
        assert site.commands[-1].linear.x > 0.1
        for _ in range(13):
            site.turn(cloud=False)
        assert site.commands[-1].linear.x == 0.0 and "no scan is fresh" in site.node.words()[1]
        assert not site.node.readiness().ok and "no fresh clouds on /points" in site.node.readiness().reason
        for _ in range(120):
            site.turn(cloud=False)
        await settled()
        assert (await result)[0] == 6


@pytest.mark.parametrize(
    ("body", "says"),
    [
        (lambda at: bodies.cloud(at, np.full((50, 4), np.nan)), "not_finite"),
        (bodies.no_points, "empty"),
        (lambda at: bodies.cloud(at - 5 * 10**9, np.ones((50, 4))), "no_pose"),
        (lambda at: b"\0\1\0\0rubbish", "unreadable"),
        (lambda at: bodies.cloud(at, np.ones((50, 4)), "camera"), "other_frame"),
    ],
)
async def test_bad_clouds_are_counted_and_the_robot_stands(body: Any, says: str) -> None:
    async with scene(lidar=Mount(z_m=LIDAR_HEIGHT_M, frame_id="velodyne")) as site:
        await site.give(3.0, 0.0)
        site.turn()
        for _ in range(15):
            site.graph.give("/points", body(site.wall_ns))
            site.turn(cloud=False)
        counted = site.node.counts()
        assert any(says in name for name in counted), counted
        assert site.commands[-1].linear.x == 0.0


async def test_odometry_of_another_frame_is_said() -> None:
    async with scene() as site:
        await site.give(3.0, 0.0)
        for _ in range(5):
            site.now_s += PERIOD_S
            site.odometry("odom")
            site.cloud()
            site.node.cycle()
        assert site.node.unused[Unused.OTHER_FRAME] == 5
        assert "in frame 'odom', the grid in 'map'" in str(site.node.to_json()["problem"])
        assert all(each.linear.x == 0.0 for each in site.commands)


async def test_a_map_of_another_resolution_ends_the_goal_with_a_line() -> None:
    async with scene() as site:
        other = Grid(-5.0, -5.0, 0.2, 50, 50)
        site.graph.give("/map", bodies.grid_map(other, np.zeros(other.shape)))
        result = await site.give(3.0, 0.0)
        site.turn()
        await settled()
        status, code, why = await result
        assert (status, code) == (6, 9000) and "set one of 0.1 m cells" in why


async def test_what_the_twin_says_makes_a_way_dearer() -> None:
    """A wall that the twin has across the straight way, with a gap far to the left."""
    async with scene() as site:
        cells = np.zeros(GRID.shape, np.int8)
        cells[:65, 68:73] = 100  # x = 2, where no scan reaches yet, from the south up to y = 1.5
        site.graph.give("/twin/scene/map", bodies.grid_map(GRID, cells))
        await site.give(4.0, 0.0)
        for _ in range(2):
            site.turn()
        assert max(pose.pose.position.y for pose in site.graph.last("/plan").poses) > 1.5
        site.now_s += 3.0  # nothing is heard of the twin any more: what it said is worth nothing
        for _ in range(12):
            site.turn()
        assert max(pose.pose.position.y for pose in site.graph.last("/plan").poses) < 1.0


@pytest.mark.parametrize("policy", list(OnLinkLoss))
async def test_when_the_link_dies_on_the_way(policy: OnLinkLoss) -> None:
    async with scene(on_link_loss=policy, link_timeout_s=5.0) as site:
        site.graph.give("/sern/link", bodies.link(True))
        result = await site.give(2.0, 0.0)
        for _ in range(5):
            site.turn()
        site.graph.give("/sern/link", bodies.link(False))
        for _ in range(5):
            site.turn()
        await settled()
        drives = site.commands[-1].linear.x > 0.0
        assert drives is (policy is OnLinkLoss.CONTINUE)
        assert result.done() is (policy is OnLinkLoss.ABORT)
        if policy is OnLinkLoss.ABORT:
            assert "the link was lost" in (await result)[2]
            return
        if policy is OnLinkLoss.WAIT:
            assert "stands until it is back" in site.node.words()[1]
        site.graph.give("/sern/link", bodies.link(True))
        for _ in range(200):
            site.turn()
            site.graph.give("/sern/link", bodies.link(True))
            await asyncio.sleep(0)
            if result.done():
                break
        assert (await result)[0] == 4


async def test_who_waits_for_the_link_can_be_cancelled() -> None:
    async with scene(on_link_loss=OnLinkLoss.WAIT) as site:
        result = await site.give(2.0, 0.0)
        site.graph.give("/sern/link", bodies.link(False))
        site.turn()
        site.node.cancel()
        assert (await result)[0] == 5


async def test_a_client_that_is_gone_is_a_link_that_is_lost() -> None:
    async with scene(on_link_loss=OnLinkLoss.ABORT, link_timeout_s=1.0) as site:
        site.graph.give("/sern/link", bodies.link(True))
        result = await site.give(2.0, 0.0)
        for _ in range(12):
            site.turn()
        await settled()
        assert (await result)[0] == 6


async def test_the_robots_own_map_corrects_its_odometry() -> None:
    """The odometry is off by 10 cm from the second scan on."""
    walls = [(1.0, -2.0, 1.0, 2.0, 2.0), (-4.0, 2.5, 3.0, 2.5, 2.0)]
    async with scene(walls=walls, localisation=Localisation.SCANS, start=(0.0, 0.0, 0.0)) as site:
        site.turn()
        keeping = asyncio.create_task(site.node.keep_map())
        try:
            await until(lambda: bool(site.graph.said.get("/own_map")))
            pose = site.robot.state.pose
            for number in range(1, 6):
                site.now_s += PERIOD_S
                body = bodies.odometry(site.wall_ns, pose.x_m + 0.1, pose.y_m, pose.yaw_rad, frame_id="odom")
                site.graph.give("/odometry/filtered", body)
                site.cloud()
                site.node.cycle()
                await until(partial(_has_scans, site, number + 1))
            found = site.node.localiser.at(site.wall_ns)
            assert found is not None and abs(found[0] - pose.x_m) < 0.05
            site.now_s += 1.0
            site.turn(odometry=False)
            assert site.graph.last("/own_map").info.width == 100
        finally:
            keeping.cancel()
            await asyncio.gather(keeping, return_exceptions=True)


async def test_stamps_of_a_simulators_clock_may_be_left_out() -> None:
    async with scene(stamps=Stamps.ARRIVAL) as site:
        site.graph.give("/odometry/filtered", bodies.odometry(5, -2.0, 0.0, 0.0))
        site.graph.give("/points", bodies.cloud(5, site.robot.cloud(5_760)))
        site.node.cycle()
        assert site.node.readiness().ok or site.node.readiness().reason == "starting"
        assert not site.node.counts() and site.node.to_json()["pose"] is not None


async def test_topics_of_another_type_are_left_alone(caplog: pytest.LogCaptureFixture) -> None:
    graph = Graph()
    node = NavigationNode(NodeOptions(), GRID, graph.endpoint, Encoding.CDR, planner=AtOnce)
    graph.announce(node, "/points", "sensor_msgs/msg/LaserScan")
    assert not graph.sinks and "name another topic" in caplog.text
    graph.announce(node, "/points", "sensor_msgs/msg/PointCloud2")
    assert list(graph.sinks) == ["/points"]
    node.topic_removed(TopicName("/points"))
    assert not graph.sinks
    await node.close()


async def test_at_the_end_the_robot_is_told_to_stand() -> None:
    async with scene() as site:
        result = await site.give(3.0, 0.0)
        for _ in range(10):
            site.turn()
        assert site.commands[-1].linear.x > 0.1
    assert site.commands[-1].linear.x == 0.0 and (await result)[0] == 6
    assert not site.graph.sinks and not site.graph.open, "everything is closed"


async def test_plans_come_from_a_process_of_their_own() -> None:
    navigator = Navigator(GRID, np.random.default_rng(1), FEW, plans_itself=False)
    planner = PlannerProcess(navigator)
    robot = SimulatedJackal(Random(1))
    try:
        await planner.warm()
        navigator.go(Goal(1.0, 0.0))
        points = robot.cloud(5_760)[:, :3].astype(np.float64)
        points[:, 2] += LIDAR_HEIGHT_M
        navigator.step(0.0, (0.0, 0.0, 0.0), Cloud(points, 0.0))
        planner.look()
        await until(lambda: bool(len(navigator.path_m)))
        assert navigator.path_m[-1] == pytest.approx((1.0, 0.0), abs=0.11)
    finally:
        await planner.close()


async def test_a_process_that_plans_and_is_killed_is_started_again(caplog: pytest.LogCaptureFixture) -> None:
    navigator = Navigator(GRID, np.random.default_rng(1), FEW, plans_itself=False)
    planner = PlannerProcess(navigator)
    points = SimulatedJackal(Random(1)).cloud(5_760)[:, :3].astype(np.float64)
    points[:, 2] += LIDAR_HEIGHT_M

    def wants() -> None:
        navigator.go(Goal(1.0, 0.0))
        navigator.step(0.0, (0.0, 0.0, 0.0), Cloud(points, 0.0))
        planner.look()

    try:
        await planner.warm()
        assert planner.pid is not None
        os.kill(planner.pid, signal.SIGKILL)
        wants()
        await until(lambda: planner.failures == 1)
        assert "does not answer" in caplog.text and not len(navigator.path_m)
        wants()
        await until(lambda: bool(len(navigator.path_m)))
    finally:
        await planner.close()
    assert planner.pid is None
