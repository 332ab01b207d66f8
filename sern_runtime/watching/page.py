"""The page that a daemon serves, so that a person sees in a browser how it is: files of this package, and what is live.

    /              the page; /page.css and /page.js belong to it. Nothing else is loaded, from nowhere else
    /api/live      server-sent events: `state`, once a second, and `links`, the points of the pictures

The files are everybody's; what is live needs the token, where there is one. The page sends it in a header, and keeps it
in the browser for as long as its tab is open.
"""

import asyncio
import logging
import socket
import zlib
from collections.abc import Iterator
from importlib.resources import files
from typing import Final

from sern_runtime.http import Handler, HttpServer
from sern_runtime.metrics import Metrics
from sern_runtime.watching.live import SLOW, FullError, Live
from sern_runtime.web import web

SLOW_S: Final = 15.0
"""A page that has taken nothing of what was sent to it for so long is cut."""
VANISHED_S: Final = 60.0
"""Whose machine says nothing for so long has gone without a word: its place is free again."""
CHUNK_BYTES: Final = 1 << 16
"""What is compressed in one turn of the loop, and what the kernel keeps for one page."""
LIVE: Final = "/api/live"
STATIC: Final = {
    "/": ("index.html", "text/html"),
    "/page.css": ("page.css", "text/css"),
    "/page.js": ("page.js", "text/javascript"),
}
HEADERS: Final = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src data:; base-uri 'none'; "
        "form-action 'none'; frame-ancestors 'none'; require-trusted-types-for 'script'; trusted-types 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-cache",
}
_log = logging.getLogger(__name__)


def add_page(server: HttpServer, live: Live, metrics: Metrics, *, slow_s: float = SLOW_S) -> None:
    """Add the page and its metrics to a server. Before its start."""
    for path, (name, kind) in STATIC.items():
        server.add(path, _file(name, kind))
    server.let_in(*STATIC)
    server.add(LIVE, _live(live, slow_s))
    live.register(metrics)


def _file(name: str, kind: str) -> Handler:
    body = files(__package__).joinpath("static", name).read_bytes()

    async def handle(_request: web.Request) -> web.Response:
        return web.Response(body=body, content_type=kind, charset="utf-8", headers=HEADERS)

    return handle


def _live(live: Live, slow_s: float) -> Handler:
    async def handle(request: web.Request) -> web.StreamResponse:
        try:
            with live.watcher() as watcher:
                stream = _Stream(request, slow_s)
                await stream.begin()
                while (events := await watcher.next()) is not None:
                    if not await stream.send(events):
                        live.turned_away[SLOW] += 1
                        _log.warning("%s watched this daemon, and was cut: it took too little", request.remote)
                        break
                else:
                    await stream.end()
                return stream.response
        except FullError as error:
            return web.Response(status=503, text=f"{error}\n")
        except ConnectionError:
            return web.Response()  # the page was closed: nobody gets this

    return handle


class _Stream:
    """Server-sent events to one page, compressed where it takes that: frames are like the ones before."""

    def __init__(self, request: web.Request, slow_s: float) -> None:
        self._request = request
        self._slow_s = slow_s
        takes = "gzip" in request.headers.get("Accept-Encoding", "")
        self._compressor = zlib.compressobj(1, zlib.DEFLATED, 16 + zlib.MAX_WBITS) if takes else None
        self.response = web.StreamResponse(headers={**HEADERS, "Cache-Control": "no-store", "X-Accel-Buffering": "no"})
        self.response.content_type = "text/event-stream"
        if takes:
            self.response.headers["Content-Encoding"] = "gzip"

    async def begin(self) -> None:
        transport = self._request.transport
        sock = None if transport is None else transport.get_extra_info("socket")
        if sock is not None:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, CHUNK_BYTES)
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(1e3 * VANISHED_S))
        await self.response.prepare(self._request)

    async def send(self, events: list[tuple[str, str]]) -> bool:
        """Send events; False: too little of it was taken for too long, and the connection is cut."""
        body = "".join(f"event: {name}\ndata: {text}\n\n" for name, text in events).encode()
        for chunk in self._packed(body):
            try:
                async with asyncio.timeout(self._slow_s):
                    await self.response.write(chunk)
            except TimeoutError:
                if self._request.transport is not None:
                    self._request.transport.abort()
                return False
            await asyncio.sleep(0)
        return True

    def _packed(self, body: bytes) -> Iterator[bytes]:
        for at in range(0, len(body), CHUNK_BYTES):
            chunk = body[at : at + CHUNK_BYTES]
            if self._compressor is None:
                yield chunk
            elif packed := self._compressor.compress(chunk):
                yield packed
        if self._compressor is not None:
            yield self._compressor.flush(zlib.Z_SYNC_FLUSH)

    async def end(self) -> None:
        if self._compressor is not None:
            await self.response.write(self._compressor.flush())
        await self.response.write_eof()
