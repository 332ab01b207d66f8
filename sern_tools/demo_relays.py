"""`sern demo --relays N`: a fabric of relays as real processes on this machine, of which one is killed in the middle.

    robot1 --> relay1 ---- relay2 <-- robot2        every relay has a connection to each other one, over TLS
                    \\      /
                     relay3 <-- site                commands take the same way back

Keys, certificates, access rules and the lists of relays are as a user would have them. SIGKILL gives relay1 no time to
say or save anything, and it is not started again: its robot goes on at the next relay of its list.
"""

import asyncio
import re
import signal
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

import aiohttp
from rich.console import Console

from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.types import ClientName
from sern_runtime.config.endpoints import installing
from sern_tools import demo_relays_report as reporting
from sern_tools.demo_running import START_S, cancelled_by_signals, get_json, is_ready, working_directory
from sern_tools.demo_scenario import HOST
from sern_tools.harness.files import Content, client_content, relay_content, write
from sern_tools.harness.processes import DRAIN_S, Child, Children, program
from sern_tools.keygen import make_keys, write_pair
from sern_tools.keygen_fabric import make_fabric
from sern_tools.message_log import read_logs
from sern_tools.ports import free_ports

ROBOTS: Final = ("robot1", "robot2")
SITE: Final = "site"
CLIENTS: Final = (*ROBOTS, SITE)
FABRIC: Final = "fabric"
"""The folder of the certificates."""
DURATION_S: Final = 20.0
LEAST_S: Final = 8.0
"""A client leaves a relay that does not answer after 2 s, and that is to be seen in the second half."""
LOOK_S: Final = 0.1
"""How often each client is asked at which relay it is."""
COMMAND: Final = f"/{ROBOTS[0]}/cmd_vel"
COMMAND_LIFESPAN_S: Final = 0.3
POSE_RATE_HZ: Final = 20.0
CLOUD_BYTES: Final = 20_000
CLOUD_RATE_HZ: Final = 5.0


@dataclass(frozen=True)
class RelaysOptions:
    """What was asked for. `relays`: how many."""

    relays: int
    duration_s: float
    seed: int
    out: Path
    json_file: Path
    keep: bool
    command: str

    @property
    def names(self) -> tuple[str, ...]:
        """The relays; the first is the one that is killed."""
        return tuple(f"relay{number}" for number in range(1, self.relays + 1))

    def order(self, client: str) -> tuple[str, ...]:
        """A client's list: the relay that it is at comes first."""
        names = self.names
        first = {ROBOTS[0]: 0, ROBOTS[1]: 1, SITE: len(names) - 1}[client]
        return names[first:] + names[:first]


def contents(options: RelaysOptions, ports: Mapping[str, int], between: Mapping[str, int]) -> dict[str, Content]:
    """The files of all daemons. `ports`: by relay, for clients, and by `NAME/http`; `between`: by relay, for others."""
    names = options.names
    endpoints = {name: f"tcp://{HOST}:{ports[name]}" for name in names}

    def said(name: str) -> Content:
        return {"http": {"listen": f"{HOST}:{ports[f'{name}/http']}"}}

    access = [
        {"client": "robot[0-9]+", "publish": ["/{self}/.*"], "subscribe": ["/{self}/cmd_vel"]},
        {"client": SITE, "publish": [COMMAND], "subscribe": ["/robot[0-9]+/.*"]},
    ]
    made: dict[str, Content] = {}
    for number, name in enumerate(names):
        fabric = {
            "listen": [f"tls/{HOST}:{between[name]}"],
            "peers": [f"tls/{HOST}:{between[other]}" for other in names[:number]],
            "relays": [other for other in names if other != name],
            "certificates": FABRIC,
        }
        own = {"name": name, "secret_key_file": f"{name}.key"}
        made[name] = relay_content(endpoints[name], relay=own, access=access, fabric=fabric, **said(name))
    for name in CLIENTS:
        content = client_content(name, "", _endpoint(options, name), **_topics(name), **said(name))
        key = content.pop("relay")["secret_key_file"]
        content["relays"] = [
            {"endpoint": endpoints[relay], "server_key_file": f"{relay}.pub", "secret_key_file": key}
            for relay in options.order(name)
        ]
        made[name] = content | {"message_log": f"{name}.csv"}
    return made


def _endpoint(options: RelaysOptions, name: str) -> Content:
    seed = options.seed + CLIENTS.index(name)
    if name == SITE:
        operator = {"command_topic": COMMAND, "command_rate_hz": 10.0, "goal_rate_hz": 0.0}
        return {"kind": "synthetic", "role": "operator", "seed": seed, **operator}
    return {
        "kind": "synthetic",
        "role": "robot",
        "seed": seed,
        "patrol": True,
        "topics": ["/odometry/filtered", "/points"],
        "pose_rate_hz": POSE_RATE_HZ,
        "cloud_bytes": CLOUD_BYTES,
        "cloud_rate_hz": CLOUD_RATE_HZ,
        "counter_topics": ["/log"],
    }


def _topics(name: str) -> Content:
    control = {"class": "control", "reliability": "best_effort", "depth": 1}
    if name == SITE:
        rule = {"match": COMMAND, **control, "direction": "send", "lifespan_s": COMMAND_LIFESPAN_S}
        # It commands the robot by the robot's own topic.
        return {"topics": [rule], "subscribe": ["/robot[0-9]+/.*"], "client": {"namespace": "/"}}
    stop = {"publish": "zero", "after_s": COMMAND_LIFESPAN_S + 0.2}
    received = {"class": "control", "direction": "receive", "lifespan_s": COMMAND_LIFESPAN_S, "on_link_loss": stop}
    return {
        "topics": [
            {"match": "/cmd_vel", **received},
            {"match": "/odometry/filtered", **control, "direction": "send"},
            {"match": "/log", "class": "state", "direction": "send", "reliability": "reliable"},
            {"match": "/points", "class": "bulk", "direction": "send", "reliability": "best_effort", "lifespan_s": 1.0},
        ]
    }


def streams() -> tuple[reporting.Stream, ...]:
    """What is looked at, in the order of the table."""
    found = [reporting.Stream(COMMAND, f"commands to {ROBOTS[0]}", SITE, ROBOTS[0], lifespan_s=COMMAND_LIFESPAN_S)]
    for robot in ROBOTS:
        found += [
            reporting.Stream(f"/{robot}/odometry/filtered", f"poses of {robot}", robot, SITE),
            reporting.Stream(f"/{robot}/log", f"log of {robot}", robot, SITE, reliable=True),
            reporting.Stream(f"/{robot}/points", f"clouds of {robot}", robot, SITE),
        ]
    return tuple(found)


class RelaysDemo:
    """One run, in `directory`, which is not its own to remove."""

    def __init__(self, options: RelaysOptions, directory: Path, console: Console) -> None:
        self.options = options
        self.directory = directory
        self.console = console
        self._web: dict[str, str] = {}
        self._at: dict[str, str | None] = {}
        self._moves: list[reporting.Move] = []

    async def run(self) -> reporting.RelaysReport:
        """SernError when something could not run."""
        options = self.options
        started = datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z")
        self._say(f"1/3  {options.relays} relays, each with a TLS connection to every other, {len(CLIENTS)} clients")
        files = self._write()
        where = f"the logs are in {self.directory}" if options.keep else "--keep keeps the logs"
        timeout = aiohttp.ClientTimeout(total=2.0)
        async with aiohttp.ClientSession(timeout=timeout) as session, Children(self.directory) as children:
            daemons = await self._start(children, session, files, where)
            half_s = options.duration_s / 2
            killed = options.names[0]
            self._say(f"2/3  {half_s:g} s with all of them, then {killed} is killed (SIGKILL) and stays away")
            origin_ns = time.time_ns()
            before = dict(self._at)
            await self._look(children, session, half_s)
            daemons[killed].stopping = True
            kill_ns = time.time_ns()
            daemons[killed].signal(signal.SIGKILL)
            self._say(f"3/3  {killed} is killed; {half_s:g} s without it")
            await self._look(children, session, half_s, since_ns=kill_ns)
            end_ns = time.time_ns()
            after = dict(self._at)
            await children.end(*(daemons[name] for name in ROBOTS))
            await self._arrived(children, origin_ns)
            await children.end(daemons[SITE])
            await children.end(*(daemons[name] for name in options.names[1:]))
        run = reporting.Run(
            killed=killed,
            origin_ns=origin_ns,
            kill_ns=kill_ns,
            end_ns=end_ns,
            before=before,
            after=after,
            moves=tuple(self._moves),
        )
        logs = read_logs((name, self._log(name)) for name in CLIENTS)
        return reporting.judged(options.command, started, run, streams(), logs)

    def _say(self, text: str) -> None:
        self.console.print(text, highlight=False, soft_wrap=True)

    def _log(self, client: str) -> Path:
        return self.directory / f"{client}.csv"

    def _write(self) -> dict[str, Path]:
        names = self.options.names
        make_keys(self.directory, names[0], *CLIENTS)
        for name in names[1:]:
            write_pair(ClientName(name), self.directory, self.directory)
        make_fabric(names, out=self.directory / FABRIC)
        daemons = (*names, *CLIENTS)
        ports = iter(free_ports(2 * len(names) + len(daemons)))
        of_clients = {name: next(ports) for name in names}
        between = {name: next(ports) for name in names}
        of_http = {f"{name}/http": next(ports) for name in daemons}
        self._web = {name: f"http://{HOST}:{of_http[f'{name}/http']}" for name in daemons}
        made = contents(self.options, of_clients | of_http, between)
        return {name: write(self.directory, name, content) for name, content in made.items()}

    async def _start(
        self, children: Children, session: aiohttp.ClientSession, files: Mapping[str, Path], where: str
    ) -> dict[str, Child]:
        """Relays first, and each knows the others; then clients, until each has what it is to have."""
        daemons: dict[str, Child] = {}
        for kind, names in (("relay", self.options.names), ("client", (SITE, *reversed(ROBOTS)))):
            for name in names:
                daemons[name] = await children.start(name, [*program(f"sern-{kind}"), "--config", str(files[name])])
            for name in names:
                ready = partial(is_ready, session, self._web[name])
                await children.until(ready, START_S, f"{name} is not ready ({where})")
            if kind == "relay":
                meshed = partial(self._meshed, session)
                await children.until(meshed, START_S, f"the relays do not all see each other ({where})")
        flowing = partial(self._flowing, session)
        await children.until(flowing, START_S, f"not every stream arrives ({where})")
        await self._where(session, None)
        return daemons

    async def _meshed(self, session: aiohttp.ClientSession) -> bool:
        return all([await _peers(session, self._web[name]) == self.options.relays - 1 for name in self.options.names])

    async def _flowing(self, session: aiohttp.ClientSession) -> bool:
        topics = {name: await get_json(session, f"{self._web[name]}/api/topics") or {} for name in CLIENTS}
        return all(topics[each.taker].get(each.topic, {}).get("delivered") for each in streams())

    async def _look(
        self, children: Children, session: aiohttp.ClientSession, seconds: float, *, since_ns: int | None = None
    ) -> None:
        """Watch where the clients are for so long. `since_ns`: when the relay was killed."""
        until_s = time.monotonic() + seconds
        while time.monotonic() < until_s:
            children.check()
            await self._where(session, since_ns)
            await asyncio.sleep(LOOK_S)

    async def _where(self, session: aiohttp.ClientSession, since_ns: int | None) -> None:
        found = await asyncio.gather(*(_relay_of(session, self._web[name]) for name in CLIENTS))
        for name, relay in zip(CLIENTS, found, strict=True):
            if relay == self._at.get(name):
                continue
            self._at[name] = relay
            if since_ns is not None and relay is not None:
                after_s = (time.time_ns() - since_ns) / 1e9
                self._moves.append(reporting.Move(name, relay, after_s))
                self._say(f"     {after_s:.1f} s after it {name} is at {relay}")

    async def _arrived(self, children: Children, origin_ns: int) -> None:
        """Wait until the site has the reliable messages of robots that have ended, or no more of them come for long;
        what is missing then is judged like anything that is."""
        least, deadline_s = -1, time.monotonic() + DRAIN_S
        while time.monotonic() < deadline_s:
            children.check()
            logs = read_logs((name, self._log(name)) for name in CLIENTS)
            reliable = [logs[each.topic] for each in streams() if each.reliable and each.topic in logs]
            missing = sum(len(reporting.missing(log, origin_ns)) for log in reliable)
            if not missing:
                return
            if missing < least or least < 0:
                least, deadline_s = missing, time.monotonic() + DRAIN_S
            await asyncio.sleep(0.5)


# What the daemons say over HTTP ---------------------------------------------------------------------------------------


async def _relay_of(session: aiohttp.ClientSession, url: str) -> str | None:
    """The relay that a client has a link to; None: to none, or it does not say."""
    links: Sequence[Mapping[str, Any]] = await get_json(session, f"{url}/api/link") or ()
    for link in links:
        if link["up"]:
            return str(link["relay"]["name"])
    return None


async def _peers(session: aiohttp.ClientSession, url: str) -> int:
    """How many other relays a relay sees; -1: it does not answer."""
    try:
        async with session.get(f"{url}/metrics") as response:
            found = re.search(r"^sern_fabric_relays (\S+)$", await response.text(), re.M)
    except (aiohttp.ClientError, TimeoutError):
        return -1
    return -1 if found is None else int(float(found[1]))


# The command ----------------------------------------------------------------------------------------------------------


async def run(options: RelaysOptions, console: Console) -> bool:
    """Run it, print the tables and write the figures; whether every promise was kept. Ctrl-C is CancelledError."""
    if find_spec("zenoh") is None:
        raise ConfigError(f"--relays needs zenoh: {installing('eclipse-zenoh')}")
    if options.duration_s < LEAST_S:
        raise ConfigError(f"--relays needs {LEAST_S:g} s: a client leaves a relay that is silent for 2 s, not before")
    cancelled_by_signals()
    with working_directory(options.out, "relays", keep=options.keep) as directory:
        report = await RelaysDemo(options, directory, console).run()
        console.print()
        reporting.show(report, console)
        options.json_file.parent.mkdir(parents=True, exist_ok=True)
        options.json_file.write_text(reporting.as_json(report), encoding="utf-8")
        console.print(f"wrote {options.json_file}", highlight=False, soft_wrap=True)
        if options.keep:
            console.print(f"kept {directory}", highlight=False, soft_wrap=True)
    return report.ok
