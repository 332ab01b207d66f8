"""The page of real daemons, with keys: what it is told, who may watch, and that who watches holds nothing up."""

import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, Final

import aiohttp
import pytest

from sern_client.daemon import ClientDaemon
from sern_relay.daemon import RelayDaemon
from sern_relay.told import RelayTold
from sern_tools.ports import free_ports
from tests.daemons import HOST, Lab
from tests.support import until

ROBOT: Final = {"kind": "synthetic", "role": "robot", "topics": ["/odometry/filtered", "/points"]}
RULES: Final = [{"match": ".*odometry.*", "class": "control"}]
ODOMETRY: Final = "/robot1/odometry/filtered"
TOKEN: Final = "0123456789abcdef"


def url(daemon: RelayDaemon | ClientDaemon, path: str) -> str:
    listen = daemon.loaded.model.http.listen
    assert listen is not None
    return f"http://{HOST}:{listen.rpartition(':')[2]}{path}"


class Page:
    """What a daemon tells to one who watches."""

    def __init__(self, content: aiohttp.StreamReader) -> None:
        self._content = content
        self.pictures: dict[str, list[list[Any]]] = {}

    async def state(self) -> Any:
        """The next one; None: it has ended."""
        while line := await self._content.readline():
            name = line.decode().removeprefix("event: ").strip()
            told = json.loads(
                (await self._content.readline()).decode().removeprefix("data: "), parse_constant=pytest.fail
            )
            assert await self._content.readline() == b"\n"
            if name == "state":
                return told
            for peer, points in told["links"]:
                self.pictures.setdefault(peer, []).extend(points)
        return None

    async def until(self, condition: Any, what: str) -> Any:
        """The first that meets a condition."""
        for _ in range(300):
            told = await self.state()
            assert told is not None, f"it ended before {what}"
            if condition(told):
                return told
        raise AssertionError(f"never {what}: {told}")


@asynccontextmanager
async def watching(daemon: RelayDaemon | ClientDaemon, **headers: str) -> AsyncIterator[Page]:
    async with (
        aiohttp.ClientSession() as session,
        session.get(url(daemon, "/api/live"), headers=headers, timeout=aiohttp.ClientTimeout(total=None)) as answer,
    ):
        assert answer.status == 200, await answer.text()
        yield Page(answer.content)


def topic(told: Any, name: str) -> Any:
    return next((row for row in told["topics"] if row["topic"] == name), None)


async def test_relay_robot_and_site_tell_what_is_and_what_is_wrong(tmp_path: Path) -> None:
    async with Lab(tmp_path, "robot1", "site") as lab:
        relay = await lab.relay(lab.relay_file(adaptation={"interval_s": 0.2}))
        robot = await lab.connected(lab.client_file("robot1", ROBOT, topics=RULES, adaptation={"interval_s": 0.2}))
        site = await lab.connected(lab.recorder_file("site", ODOMETRY))
        async with watching(relay) as hub, watching(robot) as source, watching(site) as sink:
            told = await hub.until(lambda told: (topic(told, ODOMETRY) or {"hz": 0})["hz"] > 5, "it flows")
            assert (told["role"], told["links_up"], told["links_total"]) == ("relay", 2, 2)
            assert {row["peer"]: row["state"] for row in told["links"]} == {"robot1": "connected", "site": "connected"}
            assert topic(told, "/robot1/points")["why"] == "nobody subscribes to it"
            assert told["objects"]["topic"] >= 2
            assert told["classes"]["control"]["hz"] > 5
            told = await hub.until(lambda told: told["choices"], "the adaptation has chosen")
            assert told["adaptation"]["policy"]
            told = await source.until(lambda told: (topic(told, ODOMETRY) or {"hz": 0})["hz"] > 5, "it leaves")
            assert (told["role"], told["name"], told["links"][0]["peer"]) == ("client", "robot1", "relay")
            told = await sink.until(lambda told: (topic(told, ODOMETRY) or {"hz": 0})["hz"] > 5, "it arrives")
            assert [row["peer"] for row in told["peers"]] == ["robot1"]

            await lab.end(robot)
            while await source.state() is not None:  # its daemon has ended
                continue
            told = await hub.until(lambda told: topic(told, ODOMETRY)["level"] != "ok", "the relay knows")
            told = await sink.until(lambda told: told["alerts"], "the site knows")
            assert told["alerts"][0]["text"].startswith("robot1 is gone")
            assert told["alerts"][0]["topics"] == [ODOMETRY]
            await sink.until(lambda _told: sink.pictures.get("relay"), "there is a point of its link")
            assert sink.pictures["relay"][-1][1] == 1
        await until(lambda: relay.live is not None and not relay.live.watchers, "nobody watches")
        await lab.end(site)
        await lab.end(relay)


async def test_off_loopback_it_asks_for_the_token_and_tools_send_it(tmp_path: Path) -> None:
    (tmp_path / "http.token").write_text(TOKEN + "\n")
    (tmp_path / "http.token").chmod(0o600)
    async with Lab(tmp_path) as lab:
        http = {"listen": f"0.0.0.0:{free_ports(1)[0]}", "token_file": "http.token"}
        relay = await lab.relay(lab.relay_file(http=http))
        async with aiohttp.ClientSession() as session:
            free, guarded = ("/", "/page.js", "/healthz", "/readyz"), ("/api/link", "/api/live", "/metrics")
            for path, expected in (*dict.fromkeys(free, 200).items(), *dict.fromkeys(guarded, 401).items()):
                async with session.get(url(relay, path)) as answer:
                    assert answer.status == expected, path
                    assert TOKEN not in await answer.text()
            async with session.get(url(relay, "/metrics"), headers={"Authorization": f"Bearer {TOKEN}"}) as answer:
                text = await answer.text()
        assert 'sern_http_unauthorized_total{reason="token"} 3.0' in text
        assert "sern_http_watchers 0.0" in text
        async with watching(relay, Authorization=f"Bearer {TOKEN}") as page:
            told = await page.state()
            assert (told["name"], told["alerts"], told["links"], told["topics"]) == ("relay", [], [], [])
        await lab.end(relay)


async def test_a_daemon_that_ends_lets_go_of_who_watches(tmp_path: Path) -> None:
    async with Lab(tmp_path) as lab:
        relay = await lab.relay()
        async with watching(relay) as page:
            assert await page.state() is not None
            await lab.end(relay)
            while await page.state() is not None:
                continue


async def test_a_page_that_fails_costs_the_daemon_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(_self: RelayTold) -> dict[str, object]:
        raise RuntimeError("of this test")

    async with Lab(tmp_path) as lab:
        relay = await lab.relay()
        monkeypatch.setattr(RelayTold, "head", broken)
        async with aiohttp.ClientSession() as session, session.get(url(relay, "/api/live")):
            await until(lambda: relay.parts.failures["watching"], "it is counted")
            async with session.get(url(relay, "/healthz")) as answer:
                assert answer.status == 200
        await lab.end(relay)
