"""What crosses the link because somebody looks: relay, robot, twin and site as daemons with keys, on this machine.

Bytes are those of bodies that come to the site while nobody looks, while one panel is open, and while all are. How long
it takes until a topic comes is from the subscription of the viewer to the first message that it gets.
"""

import asyncio
import json
import tempfile
import time
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final

import aiohttp

from benchmarks.common import Report, percentile
from sern_runtime.profiles import load_profile
from sern_tools.demo_running import START_S, get_json, is_ready
from sern_tools.demo_scenario import HOST, RELAY, ROBOT, SITE, Scenario
from sern_tools.demo_view import TWIN, ViewOptions, contents
from sern_tools.harness.files import write
from sern_tools.harness.processes import Children, program
from sern_tools.keygen import make_keys
from sern_tools.ports import free_ports

CASE: Final = "what comes to the site"
PANEL: Final = f"/{ROBOT}/odometry/filtered"
FIRST_LIMIT_MS: Final = 100.0
PROTOCOL: Final = "foxglove.sdk.v1"


class Viewer:
    """One connection that subscribes, and counts what it gets."""

    def __init__(self, connection: Any) -> None:
        self.channels: dict[str, int] = {}
        self.first = asyncio.Event()
        self._connection = connection
        self._numbers = 0

    async def read(self) -> None:
        async for message in self._connection:
            if isinstance(message, bytes):
                self.first.set()
            elif (said := json.loads(message))["op"] == "advertise":
                self.channels |= {each["topic"]: each["id"] for each in said["channels"]}

    async def look(self, *topics: str) -> None:
        listed = []
        for topic in topics:
            self._numbers += 1
            listed.append({"id": self._numbers, "channelId": self.channels[topic]})
        self.first.clear()
        await self._connection.send(json.dumps({"op": "subscribe", "subscriptions": listed}))

    async def look_away(self) -> None:
        numbers = list(range(1, self._numbers + 1))
        await self._connection.send(json.dumps({"op": "unsubscribe", "subscriptionIds": numbers}))


async def measure(report: Report, *, seconds: float, times: int) -> None:
    """SernError: it could not run."""
    import websockets

    names = (RELAY, TWIN, ROBOT, SITE)
    relay_port, view_port, *ports = free_ports(2 + len(names))
    web = dict(zip(names, ports, strict=True))
    profile = load_profile("demo", None)
    options = ViewOptions("foxglove", Scenario(profile, profile.duration_s), None, Path(), keep=False)
    async with aiohttp.ClientSession(timeout=aiohttp.ClientTimeout(total=5.0)) as session:
        with tempfile.TemporaryDirectory() as name:
            directory = Path(name)
            make_keys(directory, *names)
            async with Children(directory) as children:
                for each, content in contents(options, relay_port, view_port, web).items():
                    content["relay"] = _directly(content["relay"], relay_port)
                    file = write(directory, each, content)
                    command = program({RELAY: "sern-relay", TWIN: "sern-twin"}.get(each, "sern-client"))
                    await children.start(each, [*command, "--config", str(file)])
                    ready = partial(is_ready, session, f"http://{HOST}:{web[each]}")
                    await children.until(ready, START_S, f"{each} is not ready")
                came = partial(_came, session, f"http://{HOST}:{web[SITE]}", seconds)
                async with websockets.connect(
                    f"ws://{HOST}:{view_port}", subprotocols=[websockets.Subprotocol(PROTOCOL)], max_size=None,
                    compression=None, proxy=None,
                ) as connection:  # fmt: skip
                    viewer = Viewer(connection)
                    reading = asyncio.create_task(viewer.read())
                    try:
                        await children.until(partial(_offered, viewer), START_S, "the robot's topics are not offered")
                        await _rows(report, viewer, came, times)
                    finally:
                        reading.cancel()
                        await asyncio.gather(reading, return_exceptions=True)


async def _rows(report: Report, viewer: Viewer, came: Any, times: int) -> None:
    nobody = await came()
    firsts_ms = []
    for _ in range(times):
        began_s = time.monotonic()
        await viewer.look(PANEL)
        await viewer.first.wait()
        firsts_ms.append(1e3 * (time.monotonic() - began_s))
        await viewer.look_away()
        await asyncio.sleep(0.2)
    await viewer.look(PANEL)
    await viewer.first.wait()
    panel = await came()
    await viewer.look_away()
    robots = [topic for topic in viewer.channels if topic.startswith(f"/{ROBOT}/") and not topic.endswith("/age")]
    await viewer.look(*robots)
    await viewer.first.wait()
    everything = await came()
    for system, found in (("nobody looks", nobody), ("one panel", panel), ("all topics", everything)):
        report.row(CASE, system, bodies_kBps=sum(found.values()) / 1e3, counted_topics=len(found))
    firsts_ms.sort()
    report.row("until a topic comes", "all of the chain", p50_ms=percentile(firsts_ms, 0.5), most_ms=firsts_ms[-1])
    report.reach("bytes a second of topics while nobody looks", float(sum(nobody.values())), 0.0)
    others = sum(rate for topic, rate in panel.items() if topic != PANEL)
    report.reach("bytes a second of other topics while one panel is open", float(others), 0.0)
    report.reach("from a subscription to its first message, the slowest, ms", max(firsts_ms), FIRST_LIMIT_MS)


def _directly(relay: Mapping[str, Any], port: int) -> dict[str, Any]:
    """The robot reaches the relay without the demo's link between them."""
    return {**relay, "endpoint": f"tcp://{HOST}:{port}"} if "endpoint" in relay else dict(relay)


async def _offered(viewer: Viewer) -> bool:
    return PANEL in viewer.channels and f"/{ROBOT}/points" in viewer.channels


async def _came(session: aiohttp.ClientSession, site: str, seconds: float) -> dict[str, float]:
    """Bytes a second of each topic that came meanwhile."""
    before = await get_json(session, f"{site}/api/topics") or {}
    began_s = time.monotonic()
    await asyncio.sleep(seconds)
    after = await get_json(session, f"{site}/api/topics") or {}
    took_s = time.monotonic() - began_s
    rates = {
        topic: (counters["bytes_delivered"] - before.get(topic, {}).get("bytes_delivered", 0)) / took_s
        for topic, counters in after.items()
        if counters["direction"] == "receive" and not topic.startswith("/_")
    }
    return {topic: rate for topic, rate in rates.items() if rate}
