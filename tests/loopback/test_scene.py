"""A scene that a robot and a site share, as daemons: what one sees or adds is on the map of the other."""

from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from sern_client.daemon import ClientDaemon
from sern_client.scene.node import SceneNode
from sern_core.vocabulary.types import Encoding, TopicName
from sern_twin.world.discrepancy import DiscrepancyKind
from sern_twin.world.patches import FREE, OCCUPIED
from tests.daemons import Json, Lab
from tests.sern_client.scene.test_scene_node import marker
from tests.support import until

SCENE: Json = {
    "name": "yard", "west_m": -12, "south_m": -12, "width_m": 24, "length_m": 24, "cell_m": 0.1, "frame_id": "odom"
}  # fmt: skip
ROBOT: Json = {
    "kind": "synthetic", "role": "robot", "topics": ["/odometry/filtered", "/scan"], "follow": True, "encoding": "cdr"
}  # fmt: skip


def node_of(daemon: ClientDaemon) -> SceneNode:
    assert daemon.scene is not None
    return daemon.scene


async def test_a_robot_and_a_site_share_a_scene(tmp_path: Path) -> None:
    async with Lab(tmp_path, "robot1", "site") as lab:
        await lab.relay()
        seeing = {"scanners": [{"scan": "/scan", "pose": "/odometry/filtered"}]}
        robot = await lab.connected(
            lab.client_file("robot1", ROBOT, scene={**SCENE, **seeing}, discovery={"mode": "manual"})
        )
        site = await lab.connected(lab.recorder_file("site", "/nothing", scene=SCENE))
        here, there = node_of(robot), node_of(site)
        await until(lambda: int((there.scene.merged("live") == OCCUPIED).sum()) > 200, "the site has what is seen")
        there.obstacles.heard(marker(x_m=0.0, y_m=3.9, namespace="lasting"), Encoding.CDR)  # else it may be cleared
        row, column = (int(value) for value in here.grid.index([0.0, 3.9]))
        await until(lambda: here.cells()[row, column] == OCCUPIED, "the robot has what was added")
        there.obstacles.heard(marker(action=3), Encoding.CDR)
        await until(lambda: here.cells()[row, column] != OCCUPIED, "and that it is gone")
        await until(lambda: here.scene.digest("live") == there.scene.digest("live"), "both have the same")
        assert here.unused.keys() <= {"superseded", "no_pose"}
        await until(lambda: not robot.check.found, "nothing differs at the endpoint")


async def test_the_twin_publishes_the_scene_and_what_is_wrong_in_it_for_a_site_without_one(tmp_path: Path) -> None:
    """An operator adds what the robot sees through; somebody else has it from sern-twin, as messages."""
    twins: Json = {"kind": "twin", "robots": [{"name": "robot1", "pose": "/robot1/odometry/filtered"}]}
    async with Lab(tmp_path, "robot1", "site", "twin", "other") as lab:
        await lab.relay()
        seeing = {"scanners": [{"scan": "/scan", "pose": "/odometry/filtered"}]}
        robot = await lab.connected(
            lab.client_file("robot1", ROBOT, scene={**SCENE, **seeing}, discovery={"mode": "manual"})
        )
        site = await lab.connected(lab.recorder_file("site", "/nothing", scene=SCENE))
        twin = await lab.connected(lab.client_file("twin", twins, client={"namespace": "/"}, scene=SCENE))
        other = await lab.connected(lab.recorder_file("other", "/twin/scene/.*"))
        assert node_of(twin).options.publish == "/twin/scene/map"
        here = node_of(robot)
        await until(lambda: int((here.scene.merged("live") == 0).sum()) > 2000, "the robot has seen the yard")
        clear = np.argwhere(ndimage.minimum_filter(here.scene.merged("live") == 0, 9))
        x_m, y_m = (float(value) for value in here.grid.centres(*clear[len(clear) // 2]))
        node_of(site).obstacles.heard(marker(x_m=x_m, y_m=y_m, size_m=0.5), Encoding.CDR)
        await until(lambda: any(node_of(twin).discrepancies()), "the twin is told of a phantom")
        assert {each.kind for each in node_of(twin).discrepancies()} == {DiscrepancyKind.PHANTOM}
        cell = tuple(int(value) for value in here.grid.index([x_m, y_m]))
        nodes = [node_of(daemon) for daemon in (robot, site, twin)]
        await until(lambda: all(node.cells()[cell] == FREE for node in nodes), "a patch has corrected it everywhere")
        assert [node.scene.merged("twin_only")[cell] for node in nodes] == [OCCUPIED] * 3, "what was added stays"
        wanted = [TopicName(f"/twin/scene/{part}") for part in ("map", "discrepancies")]
        arrived = other.core.received.topics
        await until(
            lambda: all(name in arrived and arrived[name].delivered for name in wanted), "a plain site has both"
        )
        node_of(site).obstacles.heard(marker(action=3), Encoding.CDR)
        await until(lambda: not node_of(twin).discrepancies(), "and that it is over")
        await until(lambda: not twin.check.found, "nothing differs at the endpoint of the twins")


@pytest.mark.parametrize(
    ("scene", "problem"),
    [
        (
            {**SCENE, "cell_m": 0.01},
            "scene.cell_m: a grid of 2400 x 2400 cells has 22500 blocks, and 1300 are",
        ),
        ({**SCENE, "base": "streets.osm"}, "scene.origin: is needed for base"),
        ({**SCENE, "origin": {"latitude_deg": 1, "longitude_deg": 2}, "base": "none.osm"}, "none.osm: no such file"),
        ({**SCENE, "name": "A yard"}, "scene.name: "),
        ({**SCENE, "rates": {"near_m": 20}}, "scene.rates.far_m: 12.0 is to be more than near_m, 20.0"),
        ({**SCENE, "scanners": [{"scan": "/scan"}]}, "scene.scanners.0.pose: "),
    ],
)
async def test_a_wrong_scene_is_one_line(tmp_path: Path, scene: Json, problem: str) -> None:
    async with Lab(tmp_path, "robot1") as lab:
        process = lab.process(lab.client_file("robot1", ROBOT, scene=scene))
        assert await process.ended() == 2
        await process.said(problem)
