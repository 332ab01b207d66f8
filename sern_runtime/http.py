"""The daemon's small HTTP server: /metrics, /healthz, /readyz, JSON for the tools, and the page. Read-only.

Who may ask is `http_access`'s to say; a refusal is one line of text.
"""

import asyncio
import errno
import json
import logging
from collections.abc import Awaitable, Callable, Mapping
from typing import Final

from prometheus_client import CollectorRegistry
from prometheus_client.exposition import choose_encoder

from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_runtime.http_access import HttpAccess
from sern_runtime.http_connections import HttpConnections
from sern_runtime.http_routes import HealthCheck, JsonParts, JsonQuery, JsonSource, UnknownError
from sern_runtime.metrics import Metrics, exposition
from sern_runtime.optional import OptionalParts
from sern_runtime.web import HttpProcessingError, web

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]

_SHUTDOWN_S: Final = 1.0
IDLE_S: Final = 75.0
"""A connection without a whole request for so long is closed, half a request or none; longer than between scrapes."""
MAX_ANSWER_BYTES: Final = 64 * 2**20
SLICE_PIECES: Final = 100
SLICE_BYTES: Final = 2**18
"""Pieces and bytes of a large answer that are made in one turn of the loop: about 5 ms."""
BACKLOG: Final = 128
HEALTH: Final = ("/healthz", "/readyz")
PART: Final = "http"
_log = logging.getLogger(__name__)


class _RequestLog(logging.Logger):
    """What aiohttp logs of requests. One that is none (a scanner, TLS at this port) is a line without a traceback, and
    counted; the limit on repeated warnings holds back the rest."""

    def __init__(self) -> None:
        super().__init__(_log.name)
        self.parent = _log
        self.refused = 0
        self.addFilter(self._one_line)

    def _one_line(self, record: logging.LogRecord) -> bool:
        error = record.exc_info[1] if record.exc_info else None
        if isinstance(error, HttpProcessingError):
            self.refused += 1
            why = " ".join(error.message.split())[:100]
            peer = record.args[0] if isinstance(record.args, tuple) and record.args else "somebody"
            record.msg, record.args = "%s sent what is no HTTP request: %s", (peer, why)
            record.levelno, record.levelname = logging.WARNING, "WARNING"
            record.exc_info = record.exc_text = None
        return True

    def isEnabledFor(self, level: int) -> bool:  # noqa: N802
        """aiohttp says some of it at DEBUG: all of it is counted, and written alike."""
        return level >= logging.DEBUG


def parse_listen(listen: str) -> tuple[str, int]:
    """`127.0.0.1:9464` or `[::1]:9464` as host and port. Port 0: any free one. Raises ConfigError."""
    host, separator, port_text = listen.rpartition(":")
    host = host[1:-1] if host.startswith("[") and host.endswith("]") else host
    if not separator or not host or not port_text.isdecimal() or int(port_text) > 65535:
        raise ConfigError(f"{listen!r} is not HOST:PORT; write for example 127.0.0.1:9464")
    return host, int(port_text)


class HttpServer:
    """Serves while started. `start` and `stop` once each; `stop` also after a failed `start`.

    `health` says whether the process works (a supervisor restarts it otherwise), `ready` whether it does its job now.
    `json_routes` maps paths, such as /api/link, to what gives their content. `access`: who may ask; None: whoever is on
    this machine.
    """

    def __init__(
        self,
        listen: str,
        registry: CollectorRegistry,
        *,
        health: HealthCheck,
        ready: HealthCheck,
        json_routes: Mapping[str, JsonSource | JsonQuery] | None = None,
        access: HttpAccess | None = None,
        parts: OptionalParts | None = None,
        idle_s: float = IDLE_S,
    ) -> None:
        self._access = access or HttpAccess()
        self._access.let_in(*HEALTH)  # supervisors have no token
        self._idle_s = idle_s
        self._parts = parts or OptionalParts(PART)
        self.listen = listen
        self._host, self._port = parse_listen(listen)
        self._registry = registry
        self._runner: web.AppRunner | None = None
        self._connections: HttpConnections | None = None
        self._server: asyncio.Server | None = None
        self._requests = _RequestLog()
        self._scraping = asyncio.Lock()
        self._app = web.Application(middlewares=[self._survive, self._admit])
        self._app.router.add_get("/metrics", self._metrics)
        self._app.router.add_get(HEALTH[0], _health_route(health))
        self._app.router.add_get(HEALTH[1], _health_route(ready))
        for path, source in (json_routes or {}).items():
            self.add_json(path, source)

    def add_json(self, path: str, source: JsonSource | JsonQuery) -> None:
        """Add a JSON route. Before `start`."""
        self._router.add_get(path, _json_route(source))

    def add(self, path: str, handler: Handler) -> None:
        """Add a route for GET alone. Before `start`."""
        self._router.add_get(path, handler, allow_head=False)

    def let_in(self, *paths: str) -> None:
        """Let everybody ask for these paths, who know no token too."""
        self._access.let_in(*paths)

    @property
    def _router(self) -> web.UrlDispatcher:
        if self._runner is not None:
            raise UsageError("routes are added before the server is started")
        return self._app.router

    def register(self, metrics: Metrics) -> None:
        """What this server counts."""
        metrics.counter(
            "sern_http_refused_total",
            "Requests to the HTTP server that were none.",
            read=lambda: [((), float(self._requests.refused))],
        )
        metrics.counter(
            "sern_http_connections_refused_total",
            "Connections to the HTTP server that were closed because there were as many as may be.",
            read=lambda: [((), float(self._connections.refused if self._connections else 0))],
        )
        metrics.counter(
            "sern_http_unauthorized_total",
            "Requests to the HTTP server without the token, or by a name where there is no token.",
            ("reason",),
            lambda: [((reason,), float(count)) for reason, count in self._access.refused.items()],
        )

    @property
    def port(self) -> int:
        """The port in use, also when 0 was asked for."""
        if self._server is None:
            raise UsageError("the server is not started")
        return int(self._server.sockets[0].getsockname()[1])

    @property
    def refused(self) -> int:
        """Requests that were none, so far."""
        return self._requests.refused

    async def start(self) -> None:
        """Raises ConfigError of one line when it cannot listen."""
        runner = web.AppRunner(
            self._app,
            access_log=None,
            handle_signals=False,
            shutdown_timeout=_SHUTDOWN_S,
            keepalive_timeout=self._idle_s,  # from the connection's beginning on, too
            logger=self._requests,
        )
        self._runner = runner
        await runner.setup()
        assert runner.server is not None
        self._connections = HttpConnections(runner.server)
        loop = asyncio.get_running_loop()
        try:
            self._server = await loop.create_server(self._connections, self._host, self._port, backlog=BACKLOG)
        except OSError as error:
            await self.stop()
            raise ConfigError(f"cannot listen on http://{self.listen}: {bind_problem(error)}") from error

    async def stop(self) -> None:
        if self._server is not None:
            self._server.close()
            self._server = None
        if self._runner is not None:
            runner, self._runner = self._runner, None
            await runner.cleanup()

    @web.middleware
    async def _survive(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """An answer that fails is told to its reader and the log, and ends nothing."""
        try:
            return await handler(request)
        except web.HTTPException:
            raise
        except Exception as error:  # noqa: BLE001  (counted and said)
            self._parts.failed(PART, error)
            text = "internal error, see the log"
            if request.path.startswith("/api/"):
                return web.json_response({"error": text}, status=500)
            return web.Response(status=500, text=text + "\n")

    @web.middleware
    async def _admit(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Who may not ask gets a line in place of an answer."""
        headers = request.headers
        refusal = self._access.refusal(request.path, headers.get("Host"), headers.get("Authorization"))
        if refusal is None:
            return await handler(request)
        asks = {"WWW-Authenticate": 'Bearer realm="sern"'} if refusal.status == 401 else {}
        return web.Response(status=refusal.status, text=refusal.text + "\n", headers=asks)

    async def _metrics(self, request: web.Request) -> web.Response:
        encode, content_type = choose_encoder(request.headers.get("Accept", ""))
        parts: list[bytes] = []
        async with self._scraping:
            for part in exposition(self._registry, encode):
                parts.append(part)
                await asyncio.sleep(0)
        return web.Response(body=b"".join(parts), headers={"Content-Type": content_type})


def bind_problem(error: OSError) -> str:
    """Why nobody can listen there, and what to do."""
    # The loop wraps the cause in its own words; the number is what can be relied on.
    match error.errno:
        case errno.EADDRINUSE:
            return "the port is in use; stop the other process or choose another port"
        case errno.EADDRNOTAVAIL | errno.ENODEV:
            return "this machine has no such address; see `ip address`"
        case errno.EACCES:
            return "not permitted; choose a port above 1023"
        case _:
            return (error.strerror or str(error)).lower()


def _health_route(check: HealthCheck) -> Handler:
    async def handle(_request: web.Request) -> web.Response:
        answer = check()
        return web.Response(status=200 if answer.ok else 503, text=answer.reason + "\n")

    return handle


def _asked(source: JsonQuery, query: Mapping[str, str]) -> object:
    for name in query:
        if name not in source.accepts:
            raise UsageError(f"unknown parameter {name[:80]!r}; accepted: {', '.join(source.accepts)}")
    return source.read({name: query[name] for name in query})


async def joined(parts: JsonParts) -> bytes:
    """The whole of a large answer, with the loop's other work in between. UsageError when it is too large."""
    made: list[bytes] = []
    size = pieces = turn_bytes = 0
    for piece in parts.pieces:
        made.append(piece.encode())
        size += len(made[-1])
        turn_bytes += len(made[-1])
        pieces += 1
        if size > MAX_ANSWER_BYTES:
            raise UsageError(parts.too_large)
        if pieces >= SLICE_PIECES or turn_bytes >= SLICE_BYTES:
            pieces = turn_bytes = 0
            await asyncio.sleep(0)
    return b"".join(made)


def _json_route(source: JsonSource | JsonQuery) -> Handler:
    making = asyncio.Lock()  # one large answer at a time: what two hold is more than one may

    async def handle(request: web.Request) -> web.Response:
        try:
            if isinstance(source, JsonQuery) and source.prepare is not None:
                await source.prepare(request.query)
            answer = _asked(source, request.query) if isinstance(source, JsonQuery) else source()
            if isinstance(answer, JsonParts):
                async with making:
                    body = await joined(answer)
            else:
                body = json.dumps(answer).encode()
        except UnknownError as error:
            return web.json_response({"error": str(error)}, status=404)
        except UsageError as error:
            return web.json_response({"error": str(error)}, status=400)
        return web.Response(
            body=body, content_type="application/json", charset="utf-8", headers={"Cache-Control": "no-store"}
        )

    return handle
