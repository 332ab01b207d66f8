"""The daemons over HTTP: metrics with proper names and every counter at 0, health, readiness, and JSON without NaN."""

import asyncio
import json
from pathlib import Path
from typing import Any

import aiohttp
import pytest
from prometheus_client import CollectorRegistry
from prometheus_client.parser import text_string_to_metric_families
from typer.testing import CliRunner

from sern_client.daemon import ClientDaemon
from sern_core.vocabulary.ledger import LOSSES
from sern_core.vocabulary.types import CLASS_LABELS, ClientName, TopicName
from sern_relay.daemon import RelayDaemon
from sern_runtime.link_metrics import RECEIVED_LOSSES
from sern_runtime.metrics import check_names
from sern_tools.commands import app
from sern_tools.ports import free_ports
from tests.daemons import Lab, delivered, write_bag
from tests.loopback.test_udp_client import SIX
from tests.support import until


async def get(daemon: RelayDaemon | ClientDaemon, path: str) -> tuple[int, str]:
    url = f"http://{daemon.loaded.model.http.listen}{path}"
    async with aiohttp.ClientSession() as session, session.get(url) as answer:
        return answer.status, await answer.text()


async def read(daemon: RelayDaemon | ClientDaemon, path: str) -> Any:
    status, text = await get(daemon, path)
    assert status == 200, text
    return json.loads(text, parse_constant=lambda word: pytest.fail(f"{path} holds {word}"))


async def samples(daemon: RelayDaemon | ClientDaemon) -> dict[str, dict[tuple[tuple[str, str], ...], float]]:
    status, text = await get(daemon, "/metrics")
    assert status == 200
    found: dict[str, dict[tuple[tuple[str, str], ...], float]] = {}
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            found.setdefault(sample.name, {})[tuple(sorted(sample.labels.items()))] = sample.value
    return found


class Read:
    """A registry that gives what was scraped: `check_names` reads the names as Prometheus sees them."""

    def __init__(self, text: str) -> None:
        self._text = text

    def collect(self) -> Any:
        return text_string_to_metric_families(self._text)


async def test_before_anything_is_connected_everything_answers(tmp_path: Path) -> None:
    async with Lab(tmp_path, "robot1") as lab:
        robot = await lab.client(lab.client_file("robot1", {"kind": "synthetic", "role": "robot", "topics": 3}))
        assert await get(robot, "/healthz") == (200, "running\n")
        status, reason = await get(robot, "/readyz")
        assert status == 503
        assert reason.strip()
        link = (await read(robot, "/api/link"))[0]
        assert link["up"] is False
        await read(robot, "/api/topics")
        await read(robot, "/api/trace")
        relay = await lab.relay()
        assert await get(relay, "/healthz") == (200, "running\n")
        assert await get(relay, "/readyz") == (200, "listening\n")
        for path in ("/api/link", "/api/objects", "/api/topics"):
            await read(relay, path)
        await until(lambda: robot.readiness().ok)
        assert await get(robot, "/readyz") == (200, "connected to relay\n")
        await lab.end(robot)
        await lab.end(relay)


async def test_metrics_and_json_of_a_running_system(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "run.bag", {"/chat": 50})
    async with Lab(tmp_path, "robot1", "site") as lab:
        relay = await lab.relay()
        site = await lab.connected(lab.recorder_file("site", "/.*", message_log="site.csv"))
        endpoints = [
            {"kind": "bag", "path": str(bag), "rate": 0, "wait_for": ["/chat"]},
            {"kind": "synthetic", "role": "robot", "topics": 5},
        ]
        chat = {"match": "/chat", "class": "state", "reliability": "reliable"}
        robot = await lab.connected(lab.client_file("robot1", endpoints, topics=[chat]))
        await until(lambda: len(site.core.received.topics) >= 5)
        link = relay.hub.links[ClientName("site")]
        await until(lambda: link.lane.flight.rtt.srtt_s is not None)
        chat_topic = TopicName("/robot1/chat")
        await until(lambda: delivered(site, chat_topic) == 50, "the bag has arrived")
        await until(lambda: link.counters[chat_topic].delivered == 50, "and the relay knows")

        for daemon in (relay, site, robot):
            status, text = await get(daemon, "/metrics")
            assert status == 200
            registry: Any = Read(text)
            assert check_names(registry) == []
            found = await samples(daemon)
            assert set(found["sern_metrics_failures_total"].values()) == {0.0}
            for path in ("/api/link", "/api/topics"):
                await read(daemon, path)

        peers: list[tuple[RelayDaemon | ClientDaemon, str]] = [(robot, "relay"), (relay, "site")]
        for daemon, peer in peers:
            found = await samples(daemon)
            assert found["sern_link_up"][("peer", peer),] == 1.0
            dropped = found["sern_messages_dropped_total"]
            offered = found["sern_messages_offered_total"]
            assert len(offered) >= 5
            for labels in offered:
                for reason in LOSSES:
                    assert tuple(sorted((*labels, ("reason", reason)))) in dropped
        arrived = await samples(site)
        received = arrived["sern_received_messages_total"]
        assert received[("class", "state"), ("topic", "/robot1/chat")] == 50.0
        for labels in received:
            for reason in RECEIVED_LOSSES:
                assert tuple(sorted((*labels, ("reason", reason)))) in arrived["sern_received_dropped_total"]
        for label in CLASS_LABELS:
            assert (("class", label),) in arrived["sern_message_age_seconds_count"]
        assert all(age_s >= 0.0 for age_s in arrived["sern_topic_age_seconds"].values())

        objects = await read(relay, "/api/objects")
        text = json.dumps(objects)
        assert "node:robot1" in text and "node:site" in text and "/robot1/chat" in text
        topics = await read(relay, "/api/topics")
        assert topics["links"]["site"]["/robot1/chat"]["delivered"] == 50
        assert topics["received"]["/robot1/chat"]["delivered"] == 50
        trace = await read(robot, "/api/trace")
        assert "/robot1/chat" in json.dumps(trace)
        for daemon in (robot, site, relay):
            await lab.end(daemon)


@SIX
async def test_over_ipv6_everything_answers(tmp_path: Path) -> None:
    addresses = [f"[::1]:{port}" for port in free_ports(2)]
    async with Lab(tmp_path, "robot1") as lab:
        relay = await lab.relay(lab.relay_file(http={"listen": addresses[0]}))
        endpoint = {"kind": "synthetic", "role": "robot", "topics": 1}
        robot = await lab.connected(lab.client_file("robot1", endpoint, http={"listen": addresses[1]}))
        await until(lambda: len(list(relay.hub.streams.announced())) == 1, "the relay knows the robot's topic")
        daemons: tuple[RelayDaemon | ClientDaemon, ...] = (relay, robot)
        for daemon, address in zip(daemons, addresses, strict=True):
            assert await get(daemon, "/healthz") == (200, "running\n")
            assert (await samples(daemon))["sern_bad_frames_total"][()] == 0.0
            command = ["topics", "--json", "--api", f"http://{address}"]
            listed = await asyncio.to_thread(CliRunner().invoke, app, command)
            assert listed.exit_code == 0, listed.output
            assert {row["owner"] for row in json.loads(listed.stdout)} == {"robot1"}
            port = address.rpartition(":")[2]
            elsewhere = await asyncio.to_thread(CliRunner().invoke, app, [*command[:-1], f"http://127.0.0.1:{port}"])
            assert elsewhere.exit_code == 1 and "no answer (connection refused)" in elsewhere.output
        for daemon in (robot, relay):
            await lab.end(daemon)


def test_the_checker_reads_scrapes() -> None:
    registry: Any = Read("# HELP sern_delay_ms Delay.\n# TYPE sern_delay_ms gauge\nsern_delay_ms 1\n")
    assert check_names(registry)
    assert check_names(CollectorRegistry()) == []
