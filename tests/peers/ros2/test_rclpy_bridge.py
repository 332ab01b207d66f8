"""Two sites with real rclpy nodes, each in a domain of its own, and clients with the `rclpy` endpoint between them."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any, Final

import pytest

from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_types
from tests.daemons import Lab, Process
from tests.peers.dds.peer import free_domain
from tests.peers.ros2.sourced import DISTROS, PLACE, RosNode, RosNodes, before, sourced, until_answered, until_fed
from tests.sern_client.messages import made_up
from tests.support import DEADLINE_S

STRING: Final = "std_msgs/msg/String"
ODOMETRY: Final = "nav_msgs/msg/Odometry"
SUCCEEDED, CANCELED, ABORTED = 4, 5, 6
TIMEOUT_S: Final = DEADLINE_S


def body(type_name: str, seed: int) -> str:
    """A message of random content, as CDR in hex."""
    message = made_up(ros_types.typestore(Encoding.CDR), type_name, Random(seed))
    return ros_types.serialise(message, type_name, Encoding.CDR).hex()


def text(said: str) -> str:
    return ros_types.serialise(ros_types.new(STRING, Encoding.CDR, data=said), STRING, Encoding.CDR).hex()


@dataclass
class Sites:
    """The robot's node and client, and the site's."""

    nodes: RosNodes
    domains: tuple[int, int]
    robot: RosNode
    site: RosNode
    robot_client: Process
    site_client: Process


@asynccontextmanager
async def sites(
    directory: Path,
    robot: dict[str, Any],
    site: dict[str, Any],
    *,
    kinds: tuple[Any, Any] | None = None,
    distro: str = "jazzy",
) -> AsyncIterator[Sites]:
    """`robot`, `site`: sections of the clients' files. `kinds`: endpoints by domain in place of `rclpy`."""
    sourced(distro)
    domains = free_domain(), free_domain()
    first, second = kinds or (lambda domain: {"kind": "rclpy", "domain": domain, "poll_hz": 20},) * 2
    async with RosNodes(directory, distro) as nodes, Lab(directory, "robot1", "site") as lab:
        await lab.process(lab.relay_file()).ready()
        here, there = await nodes.start(domains[0], "machine"), await nodes.start(domains[1], "desk")
        robot = {"topics": [{"match": ".*", "reliability": "reliable", "lifespan_s": None}]} | robot
        one = lab.process(lab.client_file("robot1", first(domains[0]), **robot), before=before(distro))
        site = {"client": {"namespace": "/"}, "subscribe": ["/robot1/.*"]} | site
        two = lab.process(lab.client_file("site", second(domains[1]), **site), before=before(distro))
        await one.said("connected to relay")
        await two.said("connected to relay")
        yield Sites(nodes, domains, here, there, one, two)


ROBOT: Final[dict[str, Any]] = {
    "subscribe": ["/robot1/goal", "/robot1/map"],
    "services": {
        "offer": [{"match": "/lamp", "timeout_s": TIMEOUT_S}],
        "use": [{"match": "/horn", "timeout_s": TIMEOUT_S}],
    },
    "actions": {"offer": [{"match": "/fibonacci", "timeout_s": TIMEOUT_S}]},
}
SITE: Final[dict[str, Any]] = {
    "topics": [
        {"match": "/robot1/goal", "direction": "send", "reliability": "reliable", "lifespan_s": None},
        {"match": ".*", "reliability": "reliable", "lifespan_s": None},
    ],
    "services": {
        "offer": [{"match": "/horn", "timeout_s": TIMEOUT_S}],
        "use": [{"match": "/robot1/lamp", "timeout_s": TIMEOUT_S}],
    },
    "actions": {"use": [{"match": "/robot1/fibonacci", "timeout_s": TIMEOUT_S}]},
}


@pytest.mark.parametrize("distro", DISTROS)
async def test_topics_services_and_actions_cross(distro: str, tmp_path: Path) -> None:
    """One pair of clients for all of it: to start them costs more than what they do."""
    async with sites(tmp_path, ROBOT, SITE, distro=distro) as both:
        await topics_by_value(both)
        await services_both_ways(both)
        await goals(both)
        for client in (both.robot_client, both.site_client):
            assert "Traceback" not in client.text, client.text
            await client.stop()


async def test_topics_through_dds_and_services_through_rclpy_in_one_client(tmp_path: Path) -> None:
    pytest.importorskip("cyclonedds", reason="the dds endpoint needs cyclonedds: pip install cyclonedds==11.0.1")

    def both_kinds(domain: int) -> list[dict[str, Any]]:
        topics = {"kind": "dds", "domain": domain, "localhost_only": True, "type_paths": [str(PLACE / "share")]}
        return [topics, {"kind": "rclpy", "domain": domain, "services_only": True, "poll_hz": 20}]

    async with sites(tmp_path, ROBOT, SITE, kinds=(both_kinds, both_kinds)) as both:
        await topics_by_value(both)
        await services_both_ways(both)
        await goals(both)
        for client in (both.robot_client, both.site_client):
            assert "rmw_fastrtps" not in client.text, "the services are another endpoint's"
            await client.stop()


async def topics_by_value(both: Sites) -> None:
    await both.robot.do("sub", topic="/goal", type=ODOMETRY, depth=100)
    await both.site.do("sub", topic="/robot1/odom", type=ODOMETRY, depth=100)
    await both.robot.do("pub", topic="/odom", type=ODOMETRY, depth=100)
    await both.site.do("pub", topic="/robot1/goal", type=ODOMETRY, depth=100)
    for sender, topic, receiver, name in (
        (both.robot, "/odom", both.site, "/robot1/odom"),
        (both.site, "/robot1/goal", both.robot, "/goal"),
    ):
        await until_answered(lambda: sender.do("matched", topic=topic), 1)  # noqa: B023  (awaited here)
        sent = [(await sender.do("write", topic=topic, body=body(ODOMETRY, n)))["value"] for n in range(20)]
        await receiver.event("got", len(sent), topic=name)
        assert receiver.got(name) == sent


async def services_both_ways(both: Sites) -> None:
    """Served at the robot and called at the site, and the other way round."""
    for server, service, caller, name in (
        (both.robot, "/lamp", both.site, "/robot1/lamp"),
        (both.site, "/horn", both.robot, "/horn"),
    ):
        await server.do("serve", service=service)
        for number, data in enumerate([True, False, True], 1):
            await caller.do("call", service=name, data=data, key=f"{name} {number}")
            answered = await caller.event("answered", key=f"{name} {number}")
            assert (answered["success"], answered["text"]) == (data, f"call {number}")
        assert [each["data"] for each in server.of("asked", service=service)] == [True, False, True]


async def goals(both: Sites) -> None:
    """Accepted with feedback and result, refused, aborted, cancelled."""
    await both.robot.do("action_server", action="/fibonacci")
    await until_fed(both.site, "send_goal", action="/robot1/fibonacci", order=3)
    for key, order, status in (("done", 5, SUCCEEDED), ("aborted", -1, ABORTED)):
        await both.site.do("send_goal", action="/robot1/fibonacci", order=order, key=key)
        assert (await both.site.event("accepted", key=key))["accepted"]
        assert (await both.site.event("result", key=key))["status"] == status
    fed = sorted(each["sequence"] for each in both.site.of("feedback", key="done"))  # its node has several threads
    sequence = [0, 1, 1, 2, 3, 5, 8]
    # A result may overtake the last of it, which rclpy's client then drops.
    assert fed and fed == [sequence[:length] for length in range(3, 3 + len(fed))]
    assert both.site.of("result", key="done")[0]["sequence"] == sequence

    await both.site.do("send_goal", action="/robot1/fibonacci", order=-2, key="refused")
    assert not (await both.site.event("accepted", key="refused"))["accepted"]

    await both.site.do("send_goal", action="/robot1/fibonacci", order=100, key="long")
    assert (await both.site.event("accepted", key="long"))["accepted"]
    await both.site.event("feedback", 5, key="long")
    await both.site.do("cancel", key="long")
    assert (await both.site.event("cancelling", key="long"))["goals"] == 1
    assert (await both.site.event("result", key="long"))["status"] == CANCELED
    assert len(both.robot.of("cancelled")) == 1
