"""`sern demo --view foxglove`: relay, robot, twin and a site with an endpoint at which you look, until Ctrl-C.

    robot --> shaping proxy --> relay <-- twin
                                  ^------ site <-- your viewer

The robot's way is as bad as the profile says. What no panel shows does not come to the site.
"""

import asyncio
import socket
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import aiohttp
from rich.console import Console

from sern_core.vocabulary.errors import ConfigError
from sern_tools.demo_link import LinkProcess
from sern_tools.demo_live import rate
from sern_tools.demo_running import START_S, cancelled_by_signals, get_json, is_ready, working_directory
from sern_tools.demo_scenario import CLOUD_LIFESPAN_S, FAR_HOST, HOST, RELAY, ROBOT, SITE, Scenario
from sern_tools.harness.files import Content, client_content, relay_content, write
from sern_tools.harness.processes import Children, program
from sern_tools.keygen import make_keys
from sern_tools.ports import free_ports

TWIN: Final = "twin"
SAID_S: Final = 5.0
"""How often it is said what comes to the site."""
VIEWS: Final = ("foxglove",)
_PORT: Final = 8765
"""The port that viewers look at by themselves; where somebody has it, another is taken."""


@dataclass(frozen=True)
class ViewOptions:
    """What was asked for. `view`: one of VIEWS."""

    view: str
    scenario: Scenario
    profiles: Path | None
    out: Path
    keep: bool


def contents(options: ViewOptions, relay_port: int, view_port: int, web: Mapping[str, int]) -> dict[str, Content]:
    """The files of the four daemons."""

    def said(name: str) -> Content:
        return {"http": {"listen": f"{HOST}:{web[name]}"}}

    scenario = options.scenario
    robot = {
        "kind": "synthetic",
        "role": "robot",
        "seed": scenario.seed,
        "patrol": True,
        "encoding": "cdr",
        "topics": ["/odometry/filtered", "/imu/data", "/scan", "/map", "/points"],
        "pose_rate_hz": scenario.pose_rate_hz,
        "cloud_bytes": scenario.cloud_bytes,
    }
    stop = {"publish": "zero", "after_s": 0.5}
    rules: list[Content] = [
        {"match": "/odometry/filtered", "class": "control", "reliability": "best_effort"},
        {"match": "/cmd_vel", "class": "control", "direction": "receive", "on_link_loss": stop},
        {"match": "/map", "class": "state", "reliability": "reliable", "durability": "transient_local", "depth": 1},
        {"match": "/points", "class": "bulk", "lifespan_s": CLOUD_LIFESPAN_S},
    ]
    twin = {"kind": "twin", "robots": [{"name": ROBOT, "pose": f"/{ROBOT}/odometry/filtered"}]}
    site = {"kind": options.view, "listen": f"{HOST}:{view_port}", "publish": [f"/{ROBOT}/cmd_vel"]}
    here = f"tcp://{HOST}:{relay_port}"
    return {
        RELAY: relay_content(
            here,
            access=[
                {"client": ROBOT, "publish": ["/{self}/.*"], "subscribe": ["/{self}/cmd_vel"]},
                {"client": TWIN, "publish": ["/twin/.*"], "subscribe": [f"/{ROBOT}/.*"]},
                {"client": SITE, "publish": [f"/{ROBOT}/cmd_vel"], "subscribe": ["/.*"]},
            ],
            **said(RELAY),
        ),
        ROBOT: client_content(
            ROBOT, f"tcp://{FAR_HOST}:{relay_port}", robot, topics=rules, discovery={"mode": "dynamic"}, **said(ROBOT)
        ),
        TWIN: client_content(TWIN, here, twin, client={"namespace": "/"}, **said(TWIN)),
        SITE: client_content(SITE, here, site, client={"namespace": "/"}, on_demand=["/.*"], **said(SITE)),
    }


async def look(options: ViewOptions, console: Console) -> None:
    """Run it until Ctrl-C, which is asyncio.CancelledError. SernError: it could not run."""
    if options.view not in VIEWS:
        raise ConfigError(f"--view {options.view}: there is a view for {', '.join(VIEWS)}")
    cancelled_by_signals()
    with working_directory(options.out, "view", keep=options.keep) as directory:
        await _run(options, directory, console)


async def _run(options: ViewOptions, directory: Path, console: Console) -> None:
    relay_port, *ports = free_ports(5)
    names = (RELAY, TWIN, ROBOT, SITE)
    web = dict(zip(names, ports, strict=True))
    view_port = _PORT if _is_free(_PORT) else free_ports(1)[0]
    make_keys(directory, *names)
    made = contents(options, relay_port, view_port, web)
    files = {name: write(directory, name, content) for name, content in made.items()}
    commands = {RELAY: program("sern-relay"), TWIN: program("sern-twin")}
    where = f"the logs are in {directory}" if options.keep else "--keep keeps the logs"
    profile = options.scenario.profile
    timeout = aiohttp.ClientTimeout(total=2.0)
    async with aiohttp.ClientSession(timeout=timeout) as session, Children(directory) as children:
        link = await LinkProcess.start(
            children, "proxy", [relay_port], profile=profile.name, profiles=options.profiles,
            seed=options.scenario.seed, datagrams=True,
        )  # fmt: skip
        try:
            for name in names:
                command = commands.get(name, program("sern-client"))
                await children.start(name, [*command, "--config", str(files[name])])
                ready = partial(is_ready, session, f"http://{HOST}:{web[name]}")
                await children.until(ready, START_S, f"{name} is not ready ({where})", every_s=0.05)
            for line in _how(view_port, profile.description):
                console.print(line, highlight=False, soft_wrap=True)
            await link.ask(do="start", at_s=time.monotonic())
            while True:
                children.check()
                topics = await get_json(session, f"http://{HOST}:{web[SITE]}/api/topics")
                await asyncio.sleep(SAID_S)
                later = await get_json(session, f"http://{HOST}:{web[SITE]}/api/topics")
                console.print(_words(topics, later), highlight=False, soft_wrap=True)
        finally:
            link.close()


def _is_free(port: int) -> bool:
    with socket.socket() as probe:
        try:
            probe.bind((HOST, port))
        except OSError:
            return False
    return True


def _how(port: int, link: str) -> list[str]:
    address = f"ws://{HOST}:{port}"
    return [
        f"the robot's link: {link}",
        f"in Foxglove or Lichtblick: Open connection, Foxglove WebSocket, {address}",
        f"or open https://app.foxglove.dev/~/view?ds=foxglove-websocket&ds.url={address}",
        f"look at /{ROBOT}/odometry/filtered, /{ROBOT}/points, /twin/{ROBOT}/odom",
        f"drive with a teleop panel on /{ROBOT}/cmd_vel",
        "Ctrl-C ends it",
    ]


def _words(before: Any, after: Any) -> str:
    """What came to the site meanwhile."""
    if before is None or after is None:
        return "the site does not answer"
    came = {
        name: counters["bytes_delivered"] - before.get(name, {}).get("bytes_delivered", 0)
        for name, counters in after.items()
        if counters["direction"] == "receive" and not name.startswith("/_")
    }
    seen = [f"{name} {rate(8 * nbytes / SAID_S)}" for name, nbytes in sorted(came.items()) if nbytes]
    return f"comes to the site: {', '.join(seen) or 'nothing, for nobody looks'}"
