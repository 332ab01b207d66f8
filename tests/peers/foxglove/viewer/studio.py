"""Foxglove Studio in Chromium: a real viewer, which a test drives as a person does.

`setup` fetches Studio 1.48.0, the last one that was published as a package while it was open source. Lichtblick comes
from it. It asks for the subprotocol foxglove.websocket.v1 alone, as all viewers did then.
"""

import asyncio
import json
import os
import threading
from collections.abc import AsyncIterator, Iterator, Mapping
from contextlib import asynccontextmanager, contextmanager
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlencode

from sern_core.vocabulary.errors import SernError
from sern_tools.harness.browser import NAMES, Tab, browser, opened
from tests.support import Patience

HERE: Final = Path(__file__).resolve().parent
PLACE: Final = Path(os.environ.get("SERN_VIEWER") or HERE.parents[3] / ".venv-viewer")
OWN: Final = ("index.html", "main.js")
KINDS: Final = {".html": "text/html", ".js": "text/javascript", ".wasm": "application/wasm"}
WIDTH: Final = 1400
HEIGHT: Final = 900
TEXT: Final = '(document.body?.innerText ?? "")'
_POLL_S: Final = 0.05

Layout = Mapping[str, Any]
"""What Studio's export of a layout has: `layout`, `configById` and others."""


def missing() -> str | None:
    """Why there can be no viewer here; None: there can."""
    if browser() is None:
        return f"needs {NAMES[0]}"
    if not (PLACE / ".ready").exists():
        return "needs Foxglove Studio: tests/peers/foxglove/viewer/setup"
    return None


class _Pages(BaseHTTPRequestHandler):
    """Studio's files, our page, and the layouts."""

    def __init__(self, layouts: bytes, *args: Any) -> None:
        self._layouts = layouts
        super().__init__(*args)

    def do_GET(self) -> None:
        name = self.path.partition("?")[0].lstrip("/") or OWN[0]
        try:
            body = self._body(name)
        except OSError:
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", KINDS.get(Path(name).suffix, "application/octet-stream"))
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def _body(self, name: str) -> bytes:
        if name == "layouts.json":
            return self._layouts
        return ((HERE if name in OWN else PLACE) / name).read_bytes()

    def log_message(self, *args: object) -> None:
        """Nothing."""


@contextmanager
def served(layouts: Mapping[str, Layout]) -> Iterator[str]:
    """The address of the viewer's page, while the block runs."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(_Pages, json.dumps(layouts).encode()))
    thread = threading.Thread(target=server.serve_forever, name="viewer", kwargs={"poll_interval": _POLL_S})
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


class Viewer:
    """Studio, as a person has it before them."""

    def __init__(self, tab: Tab) -> None:
        self._tab = tab

    async def ask(self, expression: str) -> Any:
        """The value of a JavaScript expression in the page. SernError: it throws."""
        answer = await self._tab.ask("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in answer:
            raise SernError(f"{expression}: {answer['exceptionDetails'].get('exception', {}).get('description')}")
        return answer["result"].get("value")

    async def text(self) -> str:
        """All that can be read in the page."""
        return str(await self.ask(TEXT))

    async def until(self, expression: str, what: str) -> Any:
        """The value of an expression once it is true; the test fails when it does not become so."""
        patience = Patience()
        while not (value := await self.ask(expression)):
            assert not patience.over(), f"{what}: {expression} is not true. The page says: {await self.text()}"
            await asyncio.sleep(_POLL_S)
        return value

    async def until_said(self, *words: str) -> None:
        """Return once all this can be read in the page."""
        for word in words:
            await self.until(f"{TEXT}.includes({json.dumps(word)})", f"{word!r} is to be read")

    async def click(self, element: str) -> None:
        """Click on an element (an expression) once it is there."""
        async with self.held(element):
            pass

    @asynccontextmanager
    async def held(self, element: str) -> AsyncIterator[None]:
        """The mouse button is down on the middle of an element, while the block runs."""
        box = f"(each => each && each.getBoundingClientRect())({element})"
        middle = f"(box => box && box.width && [box.x + box.width / 2, box.y + box.height / 2])({box})"
        x, y = await self.until(middle, "it is there")
        mouse = partial(self._tab.ask, "Input.dispatchMouseEvent", x=x, y=y, button="left", clickCount=1)
        await mouse(type="mousePressed")
        try:
            yield
        finally:
            await mouse(type="mouseReleased")

    async def open_layout(self, name: str) -> None:
        """Choose another layout, as a person does: at the left, in the list of layouts."""
        tab = "document.querySelector('[data-sidebar-key=layouts]')"
        if await self.ask(f"{tab}.getAttribute('aria-selected')") != "true":  # a second click would close it
            await self.click(tab)
        rows = "[...document.querySelectorAll('[data-testid=layout-list-item]')]"
        await self.click(f"{rows}.find(each => each.innerText.trim() === {json.dumps(name)})")
        await self.until(f"new URL(location).searchParams.get('layoutId') === {json.dumps(name)}", f"{name} is open")

    async def picture(self) -> bytes:
        """The page as it is, a PNG."""
        return await self._tab.picture()


@asynccontextmanager
async def studio(
    address: str, layouts: Mapping[str, Layout], profile: Path, *, layout: str, width: int = WIDTH, height: int = HEIGHT
) -> AsyncIterator[Viewer]:
    """Studio, which connects to a WebSocket address and opens one of these layouts. `profile`: an empty directory."""
    asked = urlencode({"ds": "foxglove-websocket", "ds.url": address, "layoutId": layout})
    with served(layouts) as page:
        async with opened(f"{page}?{asked}", profile, width=width, height=height) as tab:
            yield Viewer(tab)
