"""Chromium without a screen: a page is opened, waited for and photographed, over the DevTools protocol.

WebGL is drawn in software (SwiftShader), so that what is photographed needs no graphics card.
"""

import asyncio
import base64
import itertools
import json
import shutil
import subprocess
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, Final

import aiohttp

from sern_core.vocabulary.errors import SernError

NAMES: Final = ("chromium", "chromium-browser", "google-chrome")
FLAGS: Final = (
    "--headless", "--no-sandbox", "--disable-gpu", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--hide-scrollbars", "--no-first-run", "--disable-background-networking", "--disable-dev-shm-usage",
    "--remote-debugging-port=0",
)  # fmt: skip
STARTS_S: Final = 60.0
_POLL_S: Final = 0.05


def browser() -> str | None:
    """The command of a Chromium on this machine; None: there is none."""
    return next(filter(None, map(shutil.which, NAMES)), None)


class Tab:
    """A page of a browser that is open."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self._socket = socket
        self._numbers = itertools.count(1)

    async def ask(self, method: str, **parameters: object) -> dict[str, Any]:
        """A command of the DevTools protocol, and its result. SernError: it failed."""
        number = next(self._numbers)
        await self._socket.send_json({"id": number, "method": method, "params": parameters})
        while True:  # events come in between
            message = await self._socket.receive()
            if message.type is not aiohttp.WSMsgType.TEXT:
                raise SernError(f"the browser has gone: {message.type.name}")
            answer: dict[str, Any] = json.loads(message.data)
            if answer.get("id") == number:
                if "error" in answer:
                    raise SernError(f"{method}: {answer['error'].get('message')}")
                result: dict[str, Any] = answer["result"]
                return result

    async def picture(self) -> bytes:
        """The page as it is, a PNG."""
        return base64.b64decode((await self.ask("Page.captureScreenshot", format="png"))["data"])


@asynccontextmanager
async def opened(url: str, profile: Path, *, width: int, height: int) -> AsyncIterator[Tab]:
    """A browser with this page, in a window of so many pixels; it ends with the block. `profile`: an empty directory.

    SernError: there is no browser, or it does not start.
    """
    command = browser()
    if command is None:
        raise SernError(f"no {NAMES[0]} on this machine: install it")
    process = subprocess.Popen(  # noqa: ASYNC220  (it takes milliseconds)
        [command, *FLAGS, f"--user-data-dir={profile}", f"--window-size={width},{height}", "about:blank"],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        address = await _devtools(process, profile)
        async with aiohttp.ClientSession() as session:
            async with session.get(f"http://{address}/json/list") as answer:
                pages = await answer.json(content_type=None)
            at = next(page["webSocketDebuggerUrl"] for page in pages if page["type"] == "page")
            async with session.ws_connect(at, max_msg_size=0) as socket:
                tab = Tab(socket)
                await tab.ask(
                    "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False
                )
                await tab.ask("Page.navigate", url=url)
                yield tab
    finally:
        process.terminate()
        try:
            await asyncio.to_thread(process.wait, 10)
        except subprocess.TimeoutExpired:
            process.kill()
            await asyncio.to_thread(process.wait)


async def _devtools(process: "subprocess.Popen[bytes]", profile: Path) -> str:
    """Where the browser listens: it writes the port into its profile."""
    told = profile / "DevToolsActivePort"
    for _ in range(round(STARTS_S / _POLL_S)):
        if process.poll() is not None:
            raise SernError(f"the browser ended with {process.returncode}")
        lines = told.read_text().splitlines() if told.exists() else []
        if len(lines) >= 2:
            return f"127.0.0.1:{lines[0]}"
        await asyncio.sleep(_POLL_S)
    raise SernError(f"the browser did not start within {STARTS_S:.0f} s")
