"""The HTTP server as a scraper and a supervisor see it."""

import asyncio
import json
import socket as socketlib
from contextlib import suppress

import aiohttp
import pytest
from prometheus_client import CollectorRegistry
from prometheus_client.parser import text_string_to_metric_families

from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_runtime.http import IDLE_S, HttpServer, parse_listen
from sern_runtime.http_access import HttpAccess
from sern_runtime.http_routes import Health
from sern_runtime.metrics import Metrics
from tests.support import DEADLINE_S, until


class Daemon:
    """A server and what it is asked about."""

    def __init__(
        self, listen: str = "127.0.0.1:0", *, idle_s: float = IDLE_S, access: HttpAccess | None = None
    ) -> None:
        self.registry = CollectorRegistry()
        self.metrics = Metrics(self.registry, process=False)
        self.health = Health(ok=True, reason="ok")
        self.readiness = Health(ok=False, reason="link down: relay refused our key")
        self.server = HttpServer(
            listen,
            self.registry,
            health=lambda: self.health,
            ready=lambda: self.readiness,
            json_routes={
                "/api/link": lambda: {"up": True, "rtt_s": 0.025},
                "/api/broken": lambda: dict[str, int]()["no such key"],
            },
            access=access,
            idle_s=idle_s,
        )
        self.server.register(self.metrics)

    async def get(self, path: str, **headers: str) -> tuple[int, str, str]:
        async with (
            aiohttp.ClientSession() as session,
            session.get(f"http://127.0.0.1:{self.server.port}{path}", headers=headers) as answer,
        ):
            return answer.status, answer.content_type, await answer.text()


async def test_health_and_readiness_are_told_apart() -> None:
    daemon = Daemon()
    await daemon.server.start()
    assert await daemon.get("/healthz") == (200, "text/plain", "ok\n")
    assert await daemon.get("/readyz") == (503, "text/plain", "link down: relay refused our key\n")
    daemon.readiness = Health(ok=True, reason="link up")
    assert await daemon.get("/readyz") == (200, "text/plain", "link up\n")
    await daemon.server.stop()


async def test_metrics_are_read_when_scraped_in_either_format() -> None:
    daemon = Daemon()
    count = 0
    daemon.metrics.counter("sern_things_total", "Things.", (), lambda: [((), count)])
    await daemon.server.start()
    count = 3
    status, content_type, text = await daemon.get("/metrics")
    assert (status, content_type) == (200, "text/plain")
    families = {family.name: family for family in text_string_to_metric_families(text)}
    assert families["sern_things"].samples[0].value == 3
    _, content_type, text = await daemon.get("/metrics", Accept="application/openmetrics-text; version=1.0.0")
    assert content_type == "application/openmetrics-text"
    assert text.endswith("# EOF\n")
    await daemon.server.stop()


async def test_json_and_a_view_that_fails(caplog: pytest.LogCaptureFixture) -> None:
    daemon = Daemon()
    daemon.server.add_json("/api/more", lambda: [1, 2])
    await daemon.server.start()
    status, content_type, text = await daemon.get("/api/link")
    assert (status, content_type, json.loads(text)) == (200, "application/json", {"up": True, "rtt_s": 0.025})
    assert (await daemon.get("/api/more"))[2] == "[1, 2]"
    status, _, text = await daemon.get("/api/broken")
    assert (status, json.loads(text)) == (500, {"error": "internal error, see the log"})
    assert "no such key" in caplog.text
    assert (await daemon.get("/healthz"))[0] == 200
    assert (await daemon.get("/nothing"))[0] == 404
    with pytest.raises(UsageError, match="before the server is started"):
        daemon.server.add_json("/late", dict)
    await daemon.server.stop()
    await daemon.server.stop()


async def test_who_has_no_token_gets_a_line_and_is_counted() -> None:
    token = "0123456789abcdef"
    daemon = Daemon(access=HttpAccess(token))
    await daemon.server.start()
    for path in ("/api/link", "/metrics", "/nothing"):
        status, kind, text = await daemon.get(path, Authorization=f"Bearer {token}x")
        assert (status, kind) == (401, "text/plain")
        assert text == "this is not the token; send Authorization: Bearer TOKEN, as http.token_file has it\n"
        assert (await daemon.get(path))[2].startswith("a token is needed; ")
    assert (await daemon.get("/healthz"))[0] == 200
    assert (await daemon.get("/api/link", Authorization=f"Bearer {token}"))[0] == 200
    _status, _kind, text = await daemon.get("/metrics", Authorization=f"Bearer {token}")
    assert 'sern_http_unauthorized_total{reason="token"} 6.0' in text
    assert 'sern_http_unauthorized_total{reason="host"} 0.0' in text
    await daemon.server.stop()


async def test_a_page_elsewhere_whose_name_is_made_to_stand_for_this_machine_reads_nothing() -> None:
    daemon = Daemon()
    await daemon.server.start()
    for path in ("/api/link", "/metrics"):
        assert (await daemon.get(path, Host="attacker.example"))[0] == 421
        assert (await daemon.get(path, Host="localhost:5580"))[0] == 200
    await daemon.server.stop()


async def test_a_port_in_use_is_one_line() -> None:
    with socketlib.create_server(("127.0.0.1", 0)) as taken:
        daemon = Daemon(f"127.0.0.1:{taken.getsockname()[1]}")
        with pytest.raises(ConfigError) as caught:
            await daemon.server.start()
    assert str(caught.value) == (
        f"cannot listen on http://{daemon.server.listen}: "
        "the port is in use; stop the other process or choose another port"
    )


async def test_an_address_of_another_machine() -> None:
    with pytest.raises(ConfigError, match="no such address"):
        await Daemon("192.0.2.1:9464").server.start()


async def test_there_are_no_more_connections_than_may_be() -> None:
    """One address has 32 at the most; others come in meanwhile, and so does it when it has closed one."""
    daemon = Daemon()
    await daemon.server.start()
    address = ("127.0.0.1", daemon.server.port)
    idle = [await asyncio.open_connection(*address, local_addr=("127.0.0.9", 0)) for _ in range(32)]
    reader, writer = await asyncio.open_connection(*address, local_addr=("127.0.0.9", 0))
    with suppress(ConnectionError):
        assert await reader.read() == b""
    writer.close()
    _status, _kind, text = await daemon.get("/metrics")
    assert "sern_http_connections_refused_total 1.0" in text
    idle.pop()[1].close()

    async def served() -> bool:
        reader, writer = await asyncio.open_connection(*address, local_addr=("127.0.0.9", 0))
        try:
            writer.write(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
            return (await reader.read()).startswith(b"HTTP/1.1 200")
        except ConnectionError:
            return False
        finally:
            writer.close()

    async with asyncio.timeout(DEADLINE_S):
        while not await served():
            pass
    for _reader, writer in idle:
        writer.close()
    await daemon.server.stop()


async def test_stopping_does_not_wait_for_a_client_that_keeps_its_connection() -> None:
    daemon = Daemon()
    await daemon.server.start()
    reader, writer = await asyncio.open_connection("127.0.0.1", daemon.server.port)
    writer.write(b"GET /healthz HTTP/1.1\r\nHost: x\r\n\r\n")
    assert b"200 OK" in await reader.readuntil(b"\r\n\r\n")
    await daemon.server.stop()
    writer.close()
    await writer.wait_closed()
    with pytest.raises(UsageError, match="not started"):
        _ = daemon.server.port


@pytest.mark.parametrize(
    ("listen", "expected"),
    [
        ("127.0.0.1:9464", ("127.0.0.1", 9464)),
        ("[::1]:80", ("::1", 80)),
        ("localhost:0", ("localhost", 0)),
        ("9464", None),
        (":9464", None),
        ("127.0.0.1:", None),
        ("127.0.0.1:70000", None),
        ("127.0.0.1:http", None),
    ],
)
def test_listen(listen: str, expected: tuple[str, int] | None) -> None:
    if expected is None:
        with pytest.raises(ConfigError, match="is not HOST:PORT"):
            parse_listen(listen)
    else:
        assert parse_listen(listen) == expected


GARBAGE = {
    "noise": b"\x00\xff\xfe garbage\r\n\r\n",
    "tls": b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(range(200)),
    "huge header": b"GET /healthz HTTP/1.1\r\nHost: x\r\nX: " + b"a" * 100_000 + b"\r\n\r\n",
    "huge path": b"GET /" + b"a" * 100_000,
    "no host": b"GET /healthz HTTP/1.1\r\nContent-Length: 99\r\n\r\nabc",
    "bad chunk": b"POST /healthz HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n",
    "bad url": b"GET http://[::1 HTTP/1.1\r\nHost: x\r\n\r\n",
    "bad query": b"GET /api/link?\xff%zz HTTP/1.1\r\nHost: x\r\n\r\n",
    "version": b"GET /healthz HTTP/9.9\r\n\r\n",
    "http2": b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n",
    "forged line": b"GET /\x1b[31m\nERROR sern forged HTTP/1.1\r\n\r\n",
}


@pytest.mark.parametrize("name", GARBAGE)
async def test_what_is_no_request_is_a_line_and_no_traceback(name: str, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("DEBUG")
    daemon = Daemon()
    await daemon.server.start()
    reader, writer = await asyncio.open_connection("127.0.0.1", daemon.server.port)
    with suppress(ConnectionError):
        writer.write(GARBAGE[name])
        await writer.drain()
        answer = await reader.read()
        assert answer.split()[1] in (b"400", b"405", b"505")
    writer.transport.abort()
    await until(lambda: daemon.server.refused or caplog.records)
    assert await daemon.get("/healthz") == (200, "text/plain", "ok\n")
    await daemon.server.stop()
    assert not any(record.exc_info for record in caplog.records)
    lines = [record.getMessage() for record in caplog.records if record.name.startswith(("sern", "aiohttp"))]
    assert len(lines) == daemon.server.refused == 1, lines
    assert "sent what is no HTTP request" in lines[0] and "\n" not in lines[0] and len(lines[0]) < 200


async def test_half_a_request_is_nothing_to_speak_of(caplog: pytest.LogCaptureFixture) -> None:
    daemon = Daemon()
    await daemon.server.start()
    for part in (b"", b"GET /heal", b"GET /healthz HTTP/1.1\r\nHost: x\r\n", b"\r\n" * 100):
        _reader, writer = await asyncio.open_connection("127.0.0.1", daemon.server.port)
        writer.write(part)
        await writer.drain()
        writer.transport.abort()
    assert await daemon.get("/healthz") == (200, "text/plain", "ok\n")
    await daemon.server.stop()
    assert [record.getMessage() for record in caplog.records] == []


@pytest.mark.parametrize("part", [b"", b"GET /heal", b"GET /healthz HTTP/1.1\r\nHost: x\r\n"])
async def test_a_connection_without_a_whole_request_is_closed(part: bytes) -> None:
    daemon = Daemon(idle_s=0.05)
    await daemon.server.start()
    reader, writer = await asyncio.open_connection("127.0.0.1", daemon.server.port)
    writer.write(part)
    async with asyncio.timeout(30.0):
        assert await reader.read() == b""
    writer.close()
    await daemon.server.stop()
