"""Everything that moves through a relay is an object: the kinds, over HTTP with its parameters and over the link."""

import base64
import json
import threading
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import aiohttp
import pytest

from sern_core.bodies.codecs import decode
from sern_core.vocabulary.types import ObjectKind, TopicName
from sern_relay.daemon import RelayDaemon
from sern_runtime import clock
from tests.daemons import Lab
from tests.support import until


async def ask(relay: RelayDaemon, **parameters: object) -> tuple[int, Any]:
    url = f"http://{relay.loaded.model.http.listen}/api/objects?{urlencode(parameters)}"
    async with aiohttp.ClientSession() as session, session.get(url) as answer:
        return answer.status, json.loads(await answer.text(), parse_constant=pytest.fail)


def kinds(relay: RelayDaemon, kind: ObjectKind) -> list[str]:
    return [item.id for item in relay.hub.objects.select(kind=kind)]


def has_value(relay: RelayDaemon, object_id: str) -> bool:
    found = relay.hub.objects.get(object_id)
    return found is not None and found.value_bytes > 0


async def test_kinds_of_object(tmp_path: Path) -> None:
    async with Lab(tmp_path, "jackal1", "operator1") as lab:
        relay = await lab.relay()
        topics = ["/odometry/filtered", "/tf", "/tf_static", "/map_updates"]
        robot_endpoint = {"kind": "synthetic", "role": "robot", "topics": topics, "cloud_rate_hz": 0}
        command = {"match": "/cmd_vel", "class": "control", "direction": "receive"}
        robot = await lab.connected(lab.client_file("jackal1", robot_endpoint, topics=[command]))
        operator = {"kind": "synthetic", "role": "operator", "command_topic": "/jackal1/cmd_vel"}
        site = await lab.connected(
            lab.client_file(
                "operator1",
                operator,
                client={"namespace": "/"},
                subscribe=["/jackal1/.*"],
                topics=[{"match": "/jackal1/cmd_vel", "class": "control"}],
                objects=[{}],
            )
        )
        expected = {
            ObjectKind.TOPIC: "/jackal1/odometry/filtered@jackal1",
            ObjectKind.TRANSFORM: "tf:odom>base_link@jackal1",
            ObjectKind.NODE: "node:jackal1",
            ObjectKind.PATCH: "/jackal1/map_updates@jackal1",
            ObjectKind.COMMAND: "/jackal1/cmd_vel@operator1",
            ObjectKind.OBSTACLE: "jackal1/box",
        }
        robot.core.objects.put("jackal1/box", ObjectKind.OBSTACLE, "shape", wall_ns=1, now=clock.now(), value=b"box")
        for kind, object_id in expected.items():
            await until(lambda k=kind, i=object_id: i in kinds(relay, k), f"{object_id} among {kind}")  # type: ignore[misc]
        for object_id in (expected[ObjectKind.TOPIC], expected[ObjectKind.COMMAND], expected[ObjectKind.TRANSFORM]):
            await until(lambda i=object_id: has_value(relay, i), f"{object_id} has a value")  # type: ignore[misc]

        status, everything = await ask(relay, definitions="no")
        assert status == 200
        assert {item["kind"] for item in everything["objects"]} == set(expected)
        assert "definitions" not in everything

        mirror = site.core.mirror.objects
        others = {object_id for object_id in expected.values() if not object_id.endswith("@operator1")}
        await until(lambda: others <= mirror.keys(), "the site has those of others as well")
        assert expected[ObjectKind.COMMAND] not in mirror
        url = f"http://{site.loaded.model.http.listen}/api/site_objects"
        async with aiohttp.ClientSession() as session, session.get(f"{url}?id=jackal1/box") as answer:
            told = json.loads(await answer.text())
        assert [(item["owner"], item["value"]["base64"]) for item in told["objects"]] == [("jackal1", "Ym94")]
        robot.core.objects.delete("jackal1/box", now=clock.now())
        await until(lambda: "jackal1/box" not in mirror, "the site hears that it is gone")

        status, transforms = await ask(relay, kind="transform", owner="jackal1")
        assert status == 200
        assert {item["kind"] for item in transforms["objects"]} == {"transform"}
        pair = next(item for item in transforms["objects"] if item["id"] == expected[ObjectKind.TRANSFORM])
        assert (pair["attributes"]["parent"], pair["attributes"]["child"]) == ("odom", "base_link")
        assert len(json.loads(base64.b64decode(pair["value"]["base64"]))["rotation"]) == 4
        static = [item for item in transforms["objects"] if item["attributes"].get("static") == "true"]
        assert static

        assert (await ask(relay, owner="operator1", kind="transform"))[1]["objects"] == []
        (odom,) = (await ask(relay, topic="/jackal1/odometry/filtered"))[1]["objects"]
        assert odom["id"] == expected[ObjectKind.TOPIC]

        # What changes is listed once, and what is gone by its id.
        first = (await ask(relay, since=0))[1]
        assert len(first["objects"]) == len(relay.hub.objects)
        await lab.drop(robot)
        away = relay.hub.links[robot.core.name]
        await until(lambda: not away.snapshot()["up"], "the relay has noticed")
        for later_s in (1_000, 10_000):  # the session is given up, then the client
            relay.hub.sweep(now=away.now + later_s)
        status, changes = await ask(relay, since=first["version"], epoch=first["epoch"], kind="node")
        assert status == 200
        assert changes["resync"] is False
        assert {expected[ObjectKind.TRANSFORM], "node:jackal1"} <= set(changes["deleted"])
        assert kinds(relay, ObjectKind.TRANSFORM) == []
        assert (await ask(relay, since=1, epoch=first["epoch"] + 1))[1]["resync"] is True


@pytest.mark.parametrize(
    ("parameters", "said"),
    [
        (
            {"kind": "thing"},
            "kind is 'thing'; accepted: topic, transform, node, robot, obstacle, terrain, patch, discrepancy, command",
        ),
        ({"kin": "node"}, "unknown parameter 'kin'; accepted: kind, owner, topic, definitions, values, since, epoch"),
        ({"since": "x"}, "since is 'x'; a version or epoch of an earlier answer is needed"),
        ({"since": "-1"}, "since is '-1'; a version or epoch of an earlier answer is needed"),
        ({"epoch": "1"}, "epoch has no use without since"),
        ({"definitions": "maybe"}, "definitions is 'maybe'; accepted: yes, no"),
        ({"values": "maybe"}, "values is 'maybe'; accepted: yes, no"),
    ],
)
async def test_a_wrong_question_is_answered_in_one_line(tmp_path: Path, parameters: dict[str, str], said: str) -> None:
    async with Lab(tmp_path) as lab:
        relay = await lab.relay()
        assert await ask(relay, **parameters) == (400, {"error": said})


@pytest.mark.interpreted
async def test_an_encoded_cloud_is_decoded_beside_the_loop_when_somebody_asks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    threads: set[int] = set()

    def noted(codec: int, body: bytes, *, max_bytes: int) -> bytes:
        threads.add(threading.get_ident())
        return decode(codec, body, max_bytes=max_bytes)

    monkeypatch.setattr("sern_core.objects.registry.decode", noted)
    endpoint = {"kind": "synthetic", "role": "robot", "topics": ["/points"], "cloud_bytes": 200_000}
    rule = {"match": "/points", "compression": "zstd", "reliability": "reliable", "class": "state"}
    async with Lab(tmp_path, "jackal1", "operator1") as lab:
        relay = await lab.relay()
        site = await lab.connected(lab.recorder_file("operator1", "/jackal1/points"))
        await lab.connected(lab.client_file("jackal1", endpoint, topics=[rule]))
        topic = TopicName("/jackal1/points")
        await until(lambda: topic in site.core.received.topics and site.core.received.topics[topic].delivered >= 2)
        status, found = await ask(relay, owner="jackal1", kind="topic")
        assert status == 200
        (item,) = found["objects"]
        assert item["value"]["bytes"] > 150_000
        assert threads and threading.get_ident() not in threads
