"""Foxglove Studio at a site: what a person opens comes over the link, and what they press moves the robot."""

from pathlib import Path
from typing import Any, Final

import pytest

from sern_tools.ports import free_ports
from tests.daemons import Json, Lab, Process
from tests.peers.foxglove.viewer.studio import Layout, Viewer, missing, studio

pytest.importorskip("foxglove", reason="the foxglove endpoint needs foxglove-sdk: pip install foxglove-sdk")
pytestmark = pytest.mark.skipif(missing() is not None, reason=missing() or "")

ODOMETRY: Final = "/robot1/odometry/filtered"
SCAN: Final = "/robot1/scan"
COMMANDS: Final = "/robot1/cmd_vel"
UP: Final = "document.querySelector('svg [role=button]')"
PROBLEMS: Final = "document.querySelector('[data-sidebar-key=connection] .MuiBadge-badge:not(.MuiBadge-invisible)')"
MORE: Final = 10
"""Messages of one topic, after which a topic that comes more often would have come."""
ROBOT: Final[Json] = {"kind": "synthetic", "role": "robot", "encoding": "cdr"}
ROBOT_RULES: Final = [
    {
        "match": "/cmd_vel",
        "class": "control",
        "direction": "receive",
        "lifespan_s": 0.3,
        "on_link_loss": {"publish": "zero", "after_s": 0.5},
    }
]
SITE_RULES: Final = [{"match": COMMANDS, "class": "control", "direction": "send", "lifespan_s": 0.3}]


def layout(**panels: Json) -> Layout:
    """Panels by their type, above each other."""
    first, *others = panels
    arranged: Json | str = f"{first}!1"
    for each in others:
        arranged = {"direction": "column", "first": arranged, "second": f"{each}!1"}
    return {"layout": arranged, "configById": {f"{kind}!1": config for kind, config in panels.items()}}


LAYOUTS: Final = {
    "odometry": layout(RawMessages={"topicPath": ODOMETRY}),
    "scan": layout(RawMessages={"topicPath": SCAN}),
    "age": layout(RawMessages={"topicPath": f"{SCAN}/sern/age"}),
    "drive": layout(**{"3D": {}, "Teleop": {"topic": COMMANDS, "publishRate": 10}}),
}


def came(site: Process, topic: str) -> int:
    """Messages of a topic that came over the link."""
    return int(site.json("/api/topics").get(topic, {}).get("delivered", 0))


async def comes_no_more(site: Process, topic: str, other: str) -> None:
    """Return once nothing of a topic has come while something of another did."""
    seen, since = -1, 0

    def met() -> bool:
        nonlocal seen, since
        if (count := came(site, topic)) != seen:
            seen, since = count, came(site, other)
        return came(site, other) >= since + MORE

    await site.until(met, f"gets {other} and no {topic}")


def speed_mps(robot: Process) -> float:
    told: dict[str, Any] = robot.json("/api/robot")
    return float(told["speed_mps"])


async def test_a_person_looks_and_drives(tmp_path: Path) -> None:
    (port,) = free_ports(1)
    async with Lab(tmp_path, "robot1", "site") as lab:
        lab.process(lab.relay_file())
        robot = lab.process(lab.client_file("robot1", ROBOT, topics=ROBOT_RULES))
        endpoint: Json = {"kind": "foxglove", "listen": f"127.0.0.1:{port}", "publish": [COMMANDS]}
        sections: Json = {"client": {"namespace": "/"}, "on_demand": ["/.*"], "topics": SITE_RULES}
        site = await lab.process(lab.client_file("site", endpoint, **sections)).ready()
        await robot.ready()
        (profile := tmp_path / "profile").mkdir()
        async with studio(f"ws://127.0.0.1:{port}", LAYOUTS, profile, layout="odometry") as viewer:
            await look(viewer, site)
            await drive(viewer, robot)
            assert not await viewer.ask(PROBLEMS), await viewer.text()


async def look(viewer: Viewer, site: Process) -> None:
    """What a panel shows comes, and no longer than it is open."""
    await viewer.until_said("child_frame_id", "base_link", "sensor_msgs/msg/PointCloud2")
    assert came(site, ODOMETRY) > 0 and came(site, SCAN) == 0
    await viewer.open_layout("scan")
    await viewer.until_said("angle_increment")
    await comes_no_more(site, ODOMETRY, SCAN)
    before = came(site, SCAN)
    await viewer.open_layout("odometry")
    await viewer.until_said("child_frame_id")
    await comes_no_more(site, SCAN, ODOMETRY)
    assert came(site, SCAN) >= before > 0
    await viewer.open_layout("age")
    await viewer.until("/data\\s+\\d/.test(document.body.innerText)", "an age is shown")
    assert came(site, "/robot1/points") == 0, "nobody has looked at it"


async def drive(viewer: Viewer, robot: Process) -> None:
    """The robot moves while an arrow is held down, and no longer."""
    await viewer.open_layout("drive")
    assert speed_mps(robot) == 0.0
    async with viewer.held(UP):
        await robot.until(lambda: speed_mps(robot) > 0.1, "drives")
    await robot.until(lambda: speed_mps(robot) == 0.0, "stands")
