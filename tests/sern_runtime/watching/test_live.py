"""Watching a daemon, and the page's routes: bounded, and nobody who is slow or hostile costs the others anything."""

import asyncio
import json
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from typing import Any

import aiohttp
import pytest
from prometheus_client import CollectorRegistry, generate_latest

from sern_runtime.events import EventLog
from sern_runtime.http import HttpServer
from sern_runtime.http_access import HttpAccess
from sern_runtime.http_routes import Health
from sern_runtime.metrics import Metrics
from sern_runtime.optional import OptionalParts
from sern_runtime.watching.frames import MAX_ALERTS, MAX_LINES, MAX_TOPICS
from sern_runtime.watching.live import PART, FullError, Live
from sern_runtime.watching.page import SLOW_S, STATIC, add_page
from tests.sern_runtime.watching.fakes import FakeTold, client_row, look, received_row
from tests.support import until

TOKEN = "0123456789abcdef"
HOSTILE = "/robot/<img src=x onerror=alert(1)>"


class Page:
    """A server with the page of a daemon that is not real."""

    def __init__(self, told: FakeTold, *, token: str | None = None, slow_s: float = SLOW_S, **options: Any) -> None:
        self.told = told
        self.events = EventLog()
        self.parts = OptionalParts(PART)
        self.live = Live(told, self.events, **{"interval_s": 0.02} | options)
        self.registry = CollectorRegistry()
        metrics = Metrics(self.registry, process=False)
        health = Health(ok=True, reason="ok")
        self.server = HttpServer(
            "127.0.0.1:0", self.registry, health=lambda: health, ready=lambda: health, access=HttpAccess(token)
        )
        add_page(self.server, self.live, metrics, slow_s=slow_s)

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server.port}"

    def metric(self, line: str) -> bool:
        return line in generate_latest(self.registry).decode()


@asynccontextmanager
async def served(told: FakeTold, **options: Any) -> AsyncIterator[Page]:
    page = Page(told, **options)
    await page.server.start()
    task = asyncio.create_task(page.parts.keep(PART, page.live.run, reset=page.live.reset))
    try:
        yield page
    finally:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task
        page.live.close()
        await page.server.stop()


async def read(content: aiohttp.StreamReader) -> tuple[str, Any]:
    """The next event of a stream."""
    name = (await content.readline()).decode().removeprefix("event: ").strip()
    data = (await content.readline()).decode().removeprefix("data: ")
    assert await content.readline() == b"\n"
    return name, json.loads(data, parse_constant=pytest.fail)


async def state(content: aiohttp.StreamReader) -> Any:
    while True:
        name, data = await read(content)
        if name == "state":
            return data


def fleet(robots: int, topics: int) -> FakeTold:
    told = FakeTold([client_row(f"robot{number}") for number in range(robots)])
    told.topics_told = {f"/robot{n % robots}/topic{n}": (f"robot{n % robots}", received_row(n)) for n in range(topics)}
    told.looked = [look(f"robot{number}") for number in range(robots)]
    return told


async def test_the_page_and_its_files_are_everybodys_and_allow_nothing_from_elsewhere() -> None:
    async with served(FakeTold(), token=TOKEN) as page, aiohttp.ClientSession() as session:
        for path, (_name, kind) in STATIC.items():
            async with session.get(page.url + path) as answer:
                assert (answer.status, answer.content_type) == (200, kind)
                policy = answer.headers["Content-Security-Policy"]
                assert policy.startswith("default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'")
                assert "unsafe" not in policy and "frame-ancestors 'none'" in policy and "http" not in policy
                assert answer.headers["X-Content-Type-Options"] == "nosniff"
                text = await answer.text()
                assert "http://" not in text.replace("http://www.w3.org/2000/svg", "") and "https://" not in text
                assert "innerHTML" not in text and "eval(" not in text and " style=" not in text


async def test_what_is_live_needs_the_token_in_a_header() -> None:
    async with served(fleet(1, 1), token=TOKEN) as page, aiohttp.ClientSession() as session:
        for headers in ({}, {"Authorization": "Bearer fedcba9876543210"}):
            async with session.get(f"{page.url}/api/live", headers=headers) as answer:
                assert (answer.status, answer.content_type) == (401, "text/plain")
                assert (await answer.text()).count("\n") == 1
        async with session.get(f"{page.url}/api/live?token={TOKEN}") as answer:
            assert answer.status == 401, "a token is never in an address"
        assert page.live.watchers == 0
        async with session.get(f"{page.url}/api/live", headers={"Authorization": f"Bearer {TOKEN}"}) as answer:
            assert answer.headers["Content-Encoding"] == "gzip"
            assert (await state(answer.content))["name"] == "hub"


async def test_frames_tell_of_everything_and_names_are_text() -> None:
    told = fleet(2, 3)
    told.clients_told.append(client_row("rover", "away", why="it is off"))
    told.clients_told.append(client_row("far", "at hub2", since_s=None, heard_s=None))
    told.topics_told[HOSTILE] = ("robot0", received_row(4, dropped={"lost": 3}))
    told.kinds = ["topic", "topic", "robot"]
    configuration = {"rates": {"bulk": 0.5}, "codec": "none", "redundancy": 0, "summaries": None}
    async with served(told) as page, aiohttp.ClientSession() as session:
        page.events.add("connected", "robot0", "robot0 came")
        async with session.get(f"{page.url}/api/live") as answer:
            assert answer.content_type == "text/event-stream"
            name, pictures = await read(answer.content)
            assert name == "links" and pictures["left_out"] == 0
            seen = await state(answer.content)
        assert {row["topic"] for row in seen["topics"]} == set(told.topics_told)
        assert (seen["links_up"], seen["links_known"], seen["links_total"]) == (2, 3, 4)
        assert [row["peer"] for row in seen["links"]] == ["rover", "robot0", "robot1", "far"]
        assert seen["alerts"][0]["text"] == "rover is gone for 12 s: it is off"
        assert seen["objects"] == {"topic": 2, "robot": 1}
        assert seen["events"][-1]["text"] == "robot0 came"
        assert seen["adaptation"] is None and seen["choices"] == []
        await until(lambda: not page.live.watchers, "it has left")
        told.adapted = [{"peer": "robot0", "configuration": configuration, "history": []}]
        async with session.get(f"{page.url}/api/live") as answer:
            while (seen := await state(answer.content))["adaptation"] is None:
                continue
        assert seen["adaptation"]["policy"] == "mmcf"
        assert seen["choices"] == [{"peer": "robot0", "text": "let in: bulk 50%; no compression", "reason": ""}]


async def test_a_frame_is_bounded_however_much_there_is() -> None:
    told = fleet(1000, 3000)
    for row in told.clients_told[:900]:
        row["state"] = "away"
    async with served(told) as page, aiohttp.ClientSession() as session, session.get(f"{page.url}/api/live") as answer:
        seen = await state(answer.content)
        assert (len(seen["topics"]), seen["topics_total"]) == (MAX_TOPICS, 3000)
        assert (len(seen["links"]), seen["links_total"]) == (MAX_LINES, 1000)
        assert (len(seen["alerts"]), seen["alerts_total"]) == (MAX_ALERTS, 900)
        assert len(page.live.frame) < 500_000


async def test_the_pictures_come_whole_and_then_only_what_is_new() -> None:
    told = fleet(1, 1)
    async with served(told) as page, aiohttp.ClientSession() as session:
        page.live.history.step_s = 0.05
        await until(lambda: page.live.history.number > 0 and dict(page.live.history.since(-1)), "there is a point")
        async with session.get(f"{page.url}/api/live") as answer:
            newest = -1
            for _ in range(3):
                while (event := await read(answer.content))[0] != "links":
                    continue
                for peer, points in event[1]["links"]:
                    assert peer == "robot0"
                    assert all(newest < point[0] <= event[1]["number"] for point in points)
                newest = event[1]["number"]
        assert newest > 0


async def test_nobody_looks_while_nobody_watches() -> None:
    told = fleet(1, 1)
    async with served(told) as page, aiohttp.ClientSession() as session:
        async with session.get(f"{page.url}/api/live") as answer:
            await state(answer.content)
            assert page.metric("sern_http_watchers 1.0")
        await until(lambda: not page.live.frame, "it has stopped")
        number = page.live.number
        told.fails = RuntimeError("nobody should ask")
        await until(lambda: page.live.history.number >= 0, "the links' history goes on")
        assert (page.live.number, page.parts.failures[PART]) == (number, 0)
        assert page.metric("sern_http_watchers 0.0")


async def test_there_are_only_so_many_watchers() -> None:
    async with served(fleet(1, 1), max_watchers=2) as page, aiohttp.ClientSession() as session:
        async with session.get(f"{page.url}/api/live") as one, session.get(f"{page.url}/api/live") as two:
            await state(one.content)
            await state(two.content)
            async with session.get(f"{page.url}/api/live") as answer:
                assert answer.status == 503
                assert await answer.text() == "2 pages watch this daemon already; close one of them\n"
            assert page.metric('sern_http_watchers_turned_away_total{reason="full"} 1.0')
        await until(lambda: page.live.watchers < 2, "one has left")
        async with session.get(f"{page.url}/api/live") as again:
            await state(again.content)


async def test_who_takes_nothing_is_cut_and_counted_and_keeps_nobody_waiting() -> None:
    told = fleet(300, 2000)
    async with served(told, slow_s=0.3) as page, aiohttp.ClientSession() as session:
        stuck = socket.socket()
        with stuck:
            stuck.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            stuck.connect(("127.0.0.1", page.server.port))
            stuck.sendall(b"GET /api/live HTTP/1.1\r\nHost: localhost\r\n\r\n")
            await until(lambda: page.live.watchers == 1, "it watches")
            async with session.get(f"{page.url}/api/live") as answer:
                while not page.live.turned_away["slow"]:
                    await state(answer.content)
                await state(answer.content)
            assert page.metric('sern_http_watchers_turned_away_total{reason="slow"} 1.0')
        await until(lambda: page.live.watchers == 0, "both are gone")


async def test_who_watches_is_let_go_when_the_daemon_ends() -> None:
    async with served(fleet(1, 1)) as page, aiohttp.ClientSession() as session:
        async with session.get(f"{page.url}/api/live") as answer:
            await state(answer.content)
            page.live.close()
            while await answer.content.readline():
                continue
        await until(lambda: page.live.watchers == 0, "it has gone")


async def test_a_failure_costs_a_frame_and_is_counted() -> None:
    told = fleet(1, 1)
    async with served(told) as page, aiohttp.ClientSession() as session, session.get(f"{page.url}/api/live") as answer:
        await state(answer.content)
        told.fails = RuntimeError("of this test")
        await until(lambda: page.parts.failures[PART], "it is counted")
        told.fails = None
        number = page.live.number
        while page.live.number == number:
            await read(answer.content)
        assert (await state(answer.content))["name"] == "hub"


async def test_a_watcher_who_comes_when_there_are_enough_is_told() -> None:
    live = Live(FakeTold(), EventLog(), max_watchers=0)
    with pytest.raises(FullError, match="0 pages watch"), live.watcher():
        pass
