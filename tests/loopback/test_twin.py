"""A robot, a relay, its twin and a site, as daemons: what the site gets is where the robot is."""

import math
import socket
import subprocess
import sys
from pathlib import Path

import aiohttp
import pytest

from sern_client.endpoints.synthetic import SyntheticEndpoint
from sern_client.endpoints.twin.endpoint import TwinEndpoint
from sern_core.vocabulary.types import TopicName
from sern_runtime import clock
from sern_tools.ports import free_ports
from tests.daemons import Lab, endpoint_of
from tests.support import until

TWIN = {"kind": "twin", "robots": [{"name": "robot1", "pose": "/robot1/odometry/filtered"}]}
ODOM = TopicName("/twin/robot1/odom")


@pytest.mark.parametrize("encoding", ["ros1", "cdr"])
async def test_a_site_gets_the_twin_of_a_robot(tmp_path: Path, encoding: str) -> None:
    robot_side = {
        "kind": "synthetic",
        "role": "robot",
        "topics": ["/odometry/filtered"],
        "patrol": True,
        "encoding": encoding,
    }
    rule = {"match": "/odometry/filtered", "class": "control"}
    async with Lab(tmp_path, "robot1", "twin", "site") as lab:
        await lab.relay()
        site = await lab.connected(lab.recorder_file("site", "/twin/.*", objects=[{"kind": "robot"}]))
        twin = await lab.connected(
            lab.client_file("twin", TWIN, client={"namespace": "/"}, discovery={"mode": "manual"})
        )
        robot = await lab.connected(lab.client_file("robot1", robot_side, topics=[rule]))
        arrived = site.core.received.topics
        await until(lambda: ODOM in arrived and arrived[ODOM].delivered >= 20)
        endpoint: TwinEndpoint = endpoint_of(twin, TwinEndpoint)
        source: SyntheticEndpoint = endpoint_of(robot, SyntheticEndpoint)
        shown = endpoint.robots["robot1"].twin(now=clock.now())
        assert shown is not None
        pose = source.state().pose
        assert math.dist((shown.shown.x_m, shown.shown.y_m), (pose.x_m, pose.y_m)) < 0.5
        assert endpoint.robots["robot1"].counts["taken"] > 10
        objects = site.core.mirror.objects
        await until(lambda: "/twin/robot1" in objects)
        assert "s old, error at most" in objects["/twin/robot1"].attributes["says"]
        assert {f"/twin/robot1/{part}" for part in ("odom", "estimate", "age", "error")} <= set(arrived)


async def test_a_robot_that_reckons_says_less_and_its_twin_is_as_right(tmp_path: Path) -> None:
    side = {"kind": "synthetic", "role": "robot", "topics": ["/odometry/filtered"], "patrol": True, "encoding": "cdr"}
    rule = {"match": "/odometry/filtered", "class": "control", "reliability": "best_effort", "dead_reckoning": True}
    async with Lab(tmp_path, "robot1", "twin") as lab:
        await lab.relay()
        twin = await lab.connected(
            lab.client_file("twin", TWIN, client={"namespace": "/"}, discovery={"mode": "manual"})
        )
        robot = await lab.connected(lab.client_file("robot1", side, topics=[rule]))
        endpoint: TwinEndpoint = endpoint_of(twin, TwinEndpoint)
        source: SyntheticEndpoint = endpoint_of(robot, SyntheticEndpoint)
        known = endpoint.robots["robot1"]
        await until(lambda: known.counts["taken"] >= 15)
        shown = known.twin(now=clock.now())
        assert shown is not None
        pose = source.state().pose
        assert math.dist((shown.shown.x_m, shown.shown.y_m), (pose.x_m, pose.y_m)) < 0.5
        assert robot.bridge.outbound.reckoned > known.counts["taken"]


async def test_the_state_of_twins_over_http(tmp_path: Path) -> None:
    async with Lab(tmp_path, "robot1", "twin") as lab:
        await lab.relay()
        twin = lab.process(lab.client_file("twin", TWIN, client={"namespace": "/"}))
        await twin.ready()
        told = twin.json("/api/twins")
        assert told["robot1"]["says"] == "not heard yet: /robot1/odometry/filtered" and told["robot1"]["pose"] is None


def run(config: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "sern_client.twin_cli", "--config", str(config)],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("endpoint", "problem"),
    [
        (
            "{kind: synthetic, role: robot}",
            "endpoint: is of no twins: sern-twin needs kind: twin (for others there is sern-client)",
        ),
        ("{kind: twin, robots: []}", "endpoint.robots: "),
        (
            "[{kind: twin, robots: [{name: a, pose: /a/odom}]}, {kind: synthetic, role: robot}]",
            "twins are the only endpoint of their client: run them in another",
        ),
        (
            "{kind: twin, robots: [{name: a, pose: /a/odom}, {name: b, pose: /a/odom}]}",
            "endpoint.robots.1.pose: /a/odom is another robot's already: each has its own",
        ),
        (
            "{kind: twin, robots: [{name: a, pose: /twin/a/odom}]}",
            "endpoint.robots.0.pose: /twin/a/odom is a topic of the twins themselves (prefix)",
        ),
    ],
)
def test_a_wrong_file_is_one_line(tmp_path: Path, endpoint: str, problem: str) -> None:
    config = tmp_path / "twin.yaml"
    config.write_text(
        "client: {name: twin, namespace: /}\n"
        "relay: {endpoint: 'tcp://127.0.0.1:5555', insecure: true}\n"
        f"endpoint: {endpoint}\n"
    )
    ended = run(config)
    assert ended.returncode == 2 and ended.stdout == ""
    assert len(ended.stderr.splitlines()) == 1 and problem in ended.stderr, ended.stderr


async def test_the_twins_are_to_be_seen_with_their_scene_and_the_link(tmp_path: Path) -> None:
    pytest.importorskip("viser", reason="needs viser: pip install 'sern[viz]'")
    (port,) = free_ports(1)
    scene = {"name": "yard", "west_m": -12, "south_m": -12, "width_m": 24, "length_m": 24, "cell_m": 0.2}
    async with Lab(tmp_path, "twin") as lab:
        await lab.relay()
        seen = {**TWIN, "view": {"listen": f"127.0.0.1:{port}"}}
        twin = await lab.connected(
            lab.client_file("twin", seen, client={"namespace": "/"}, discovery={"mode": "manual"}, scene=scene)
        )
        endpoint: TwinEndpoint = endpoint_of(twin, TwinEndpoint)
        assert endpoint.view is not None and endpoint.view.scene is twin.scene
        assert twin.scene is not None and twin.scene.options.publish == "/twin/scene/map"
        assert endpoint.snapshot().link.startswith("connected to relay")
        async with aiohttp.ClientSession() as session, session.get(f"http://127.0.0.1:{port}/") as answer:
            assert answer.status == 200 and "<html" in (await answer.text()).lower()


@pytest.mark.parametrize(
    ("listen", "problem"),
    [
        ("0.0.0.0:8090", "view.listen: 0.0.0.0:8090 is open to the network, and the view asks nobody who they are"),
        ("[::]:8090", "view.listen: [::]:8090 is open to the network"),
        ("192.0.2.1:8090", "view.listen: 192.0.2.1:8090 is open to the network"),
        ("127.0.0.1", "view.listen: '127.0.0.1' is not address:port"),
        ("127.0.0.1:0", "view.listen: port 0 is not in 1..65535"),
    ],
)
async def test_a_view_for_the_whole_network_is_refused_in_one_line(tmp_path: Path, listen: str, problem: str) -> None:
    async with Lab(tmp_path, "twin") as lab:
        process = lab.process(lab.client_file("twin", {**TWIN, "view": {"listen": listen}}))
        assert await process.ended() == 2
        await process.said(problem)


async def test_a_view_whose_port_is_taken_is_one_line(tmp_path: Path) -> None:
    pytest.importorskip("viser", reason="needs viser: pip install 'sern[viz]'")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        listen = f"127.0.0.1:{taken.getsockname()[1]}"
        async with Lab(tmp_path, "twin") as lab:
            process = lab.process(lab.client_file("twin", {**TWIN, "view": {"listen": listen}}))
            assert await process.ended() == 2
            await process.said("endpoint.view.listen", f"{listen}: Address already in use: choose another address")
