"""Two relays as their users run them: what is seen of the clients of the other one, in tools, over HTTP and on the
plain feed."""

import asyncio
import json
import sys
from pathlib import Path
from typing import Any

import pytest

from sern_tools.ports import free_ports
from tests.daemons import Lab, Process
from tests.loopback.test_feed_clients import Programs, programs, send
from tests.support import until
from tests.two_relays import RELAYS, TwoRelays

pytest.importorskip("zenoh", reason="zenoh is not installed: pip install 'sern[zenoh]'")

__all__ = ["programs"]  # a fixture
ROBOT = {
    "kind": "synthetic",
    "role": "robot",
    "topics": ["/odometry/filtered", "/tf"],
    "cloud_rate_hz": 0,
    "map_rate_hz": 0,
}
ODOMETRY = "/robot1/odometry/filtered"


def robot(lab: Lab, two: TwoRelays, relay: str) -> Process:
    return lab.process(lab.client_file("robot1", ROBOT, relay=two.at(relay)))


async def tool(*words: str) -> str:
    """What a tool prints; it must end well."""
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "sern_tools.cli", *words, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE
    )
    out, errors = await process.communicate()
    assert process.returncode == 0, errors.decode()
    return out.decode()


def api(process: Process) -> str:
    return f"http://127.0.0.1:{process.port}"


def values(relay: Process, query: str) -> list[Any]:
    return [item["value"] for item in relay.json(f"/api/objects?{query}")["objects"]]


async def test_topics_clients_and_values_of_another_relay_are_seen_at_this_one(tmp_path: Path) -> None:
    async with Lab(tmp_path, "robot1", "site") as lab:
        two = TwoRelays(lab)
        first, second = two.relay("relay1"), two.relay("relay2")
        await second.said("connected to the relay relay1")
        mine = lab.process(lab.recorder_file("site", ODOMETRY, relay=two.at("relay1")))
        robot(lab, two, "relay1")
        await second.until(lambda: ODOMETRY in second.json("/api/topics")["elsewhere"], "knows the topic")
        await first.until(lambda: values(first, f"topic={ODOMETRY}") not in ([], [None]), "has a value")

        rows = {row["topic"]: row for row in json.loads(await tool("topics", "--api", api(second), "--json"))}
        assert (rows[ODOMETRY]["owner"], rows[ODOMETRY]["relay"]) == ("robot1", "relay1")
        assert rows[ODOMETRY]["untaken"] and not rows[ODOMETRY]["in_messages"]
        text = await tool("topics", "--api", api(second))
        assert "relay1" in text and f"{ODOMETRY} *" in text
        rows = {row["topic"]: row for row in json.loads(await tool("topics", "--api", api(first), "--json"))}
        assert rows[ODOMETRY]["relay"] == "relay1" and not rows[ODOMETRY]["untaken"]

        echoed = await tool("echo", ODOMETRY, "--api", api(second), "--count", "2")
        assert echoed.count("# robot1 seq") == 2 and "frame_id" in echoed
        assert not second.json("/api/topics")["announced"], "nobody takes it here"

        clients = {
            row["name"]: row for row in json.loads(await tool("clients", "--api", api(second), "--json"))["clients"]
        }
        assert clients["robot1"]["state"] == clients["site"]["state"] == "at relay1"
        assert clients["robot1"]["relay"] == "relay1"
        assert "at relay1" in await tool("clients", "--api", api(second))
        here = {row["name"]: row for row in first.json("/api/clients")["clients"]}
        assert (here["robot1"]["state"], here["robot1"]["relay"]) == ("connected", "relay1")
        await mine.stop()


async def test_echo_as_a_client_prints_a_topic_of_another_relay(tmp_path: Path) -> None:
    async with Lab(tmp_path, "robot1", "guest") as lab:
        two = TwoRelays(lab)
        for name in RELAYS:
            await two.relay(name).ready()
        robot(lab, two, "relay1")
        text = await tool(
            "echo", ODOMETRY, "--relay", two.files.endpoints["relay2"], "--key", str(tmp_path / "guest.key"),
            "--server-key", str(tmp_path / "relay2.pub"), "--count", "3", "--timeout", "0",
        )  # fmt: skip
        assert text.count("# robot1 seq") == 3


async def test_transforms_of_another_relay_are_objects_here_and_have_values_when_asked_for(tmp_path: Path) -> None:
    async with Lab(tmp_path, "robot1", "site") as lab:
        two = TwoRelays(lab)
        first, second = two.relay("relay1"), two.relay("relay2")
        await second.said("connected to the relay relay1")
        lab.process(lab.recorder_file("site", "/robot1/tf", "/tf", relay=two.at("relay2")))
        robot(lab, two, "relay1")

        def found() -> dict[str, Any]:
            items = second.json("/api/objects?kind=transform")["objects"]
            return {item["id"]: item["value"] for item in items if item["id"].startswith("tf:")}

        await second.until(lambda: found() and all(found().values()), "has transforms with their values")
        assert all(object_id.endswith("@robot1") for object_id in found())
        await first.ready()


async def test_a_program_at_the_feed_of_one_relay_sees_a_robot_at_another_and_drives_it(
    tmp_path: Path, programs: Programs
) -> None:
    role = programs.role(
        subscribe=["/robot1/odometry/.*"],
        publish=["/robot1/.*"],
        types=[{"match": "/robot1/goal", "type": "std_msgs/String", "class": "state"}],
    )
    async with Lab(tmp_path, "robot1", "site") as lab:
        two = TwoRelays(lab)
        first, second = two.relay("relay1"), two.relay("relay2", feed={"roles": [role]})
        await second.said("connected to the relay relay1")
        site = lab.process(lab.recorder_file("site", "/robot1/goal", relay=two.at("relay1")))
        robot(lab, two, "relay1")
        odometry = programs.subscriber(b"/robot1/odometry")
        await until(lambda: odometry.poll(0), "odometry of the other relay")
        topic, _header, body = odometry.recv_multipart()
        assert topic == ODOMETRY.encode() + b"\0" and body

        publisher = await programs.publisher()

        def arrived() -> bool:
            send(publisher, "/robot1/goal", b"\5\0\0\0there")
            counted = site.json("/api/topics").get("/robot1/goal", {})
            return bool(counted.get("delivered"))

        await site.ready()
        await site.until(arrived, "has what the program says")
        assert first.json("/api/topics")["announced"]["/robot1/goal"]["relays"] == ["relay2"]


async def test_a_role_of_one_name_at_two_relays_is_said_in_one_line_by_both(tmp_path: Path) -> None:
    async with Lab(tmp_path) as lab:
        two = TwoRelays(lab)
        relays = {}
        for name in RELAYS:
            ports = free_ports(2)
            role = {
                "name": "unity",
                "publish": ["/goal"],
                "publish_endpoint": f"tcp://127.0.0.1:{ports[0]}",
                "ingest_endpoint": f"tcp://127.0.0.1:{ports[1]}",
            }
            relays[name] = two.relay(name, feed={"roles": [role]})
        for name, other in (RELAYS, RELAYS[::-1]):
            words = f"both {name} and {other} have a feed role that publishes as feed_unity"
            await relays[name].said(words)
            await relays[name].stop()
            assert sum(words in line for line in relays[name].lines) == 1
