"""Relay, site and robot as their user runs them, over a lab's link: robot on side a, relay and site on side b."""

import json
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from ruamel.yaml import YAML

from sern_sim.profiles import LinkProfile
from sern_tools.counters import read_counters
from sern_tools.demo_scenario import (
    COMMAND_TOPIC,
    COUNTER_TOPIC,
    POSE_TOPIC,
    RELAY,
    ROBOT,
    SITE,
    Ports,
    Scenario,
    write_files,
)
from sern_tools.lab.lab import Lab, Node
from sern_tools.message_log import read_logs
from sern_tools.summary import Result, RunFacts, analyse
from tests.daemons import Process

UDP, ZMQ = "udp", "zmq"
RUN_S = 4.0
PORTS = Ports(relay=5555, relay_http=8081, robot_http=8082, site_http=8083)
COUNTER = f"/{ROBOT}{COUNTER_TOPIC}"
MAP = f"/{ROBOT}/map"
BUSY_S = 1.0
"""What may pass between the last check of a command's age and the line in the log: the machine may be busy."""


class Placed(Process):
    """A daemon in a namespace of the lab, asked over HTTP from inside it."""

    def __init__(self, node: Node, name: str, program: str, config: Path) -> None:
        self.node = node
        super().__init__(name, program, config, before=node.prefix)

    def get(self, path: str) -> tuple[int, str]:
        return self.node.inside(lambda: super(Placed, self).get(path))


@dataclass(frozen=True)
class Run:
    """What came of a run. `carried_bps` left the link from robot to relay, headers included."""

    result: Result
    carried_bps: float


def files_for(
    scenario: Scenario, directory: Path, relay: Node, *, udp: bool, link: Mapping[str, object]
) -> dict[str, Path]:
    """The demo's files, with the relay where the lab has it, over TCP, with `udp` from the robot over both lanes, and
    nothing thinned; `link` on top of the section of every daemon."""
    files = write_files(directory / "config", scenario, PORTS)
    endpoint = f"tcp://{relay.address}:{PORTS.relay}"
    for name, path in files.items():
        content: dict[str, Any] = YAML(typ="safe", pure=True).load(path)
        if name == RELAY:
            content["relay"]["listen"] = [endpoint]
        else:
            content["relay"] |= {"endpoint": endpoint, "udp": udp and name == ROBOT}
        content["link"] = {**content.get("link", {}), **link}
        content.pop("adaptation", None)
        path.write_text(json.dumps(content))
    return files


def received(daemon: Process) -> set[str]:
    """The topics of which something has arrived."""
    topics = daemon.json("/api/topics")
    return {name for name, counters in topics.items() if counters["direction"] == "receive" and counters["delivered"]}


def waiting(relay: Process) -> bool:
    """Whether the relay still has something for the site."""
    links = [link for link in relay.json("/api/link") if link["peer"] == SITE]
    return any(link["inflight_bytes"] or any(queue["bytes"] for queue in link["queue"].values()) for link in links)


def _only(links: object) -> dict[str, object]:
    """A client has one link."""
    if isinstance(links, list):
        (links,) = links
    assert isinstance(links, dict)
    return links


class Stage:
    """The three daemons, connected over the lab's link, and what is known of the run."""

    def __init__(
        self, lab: Lab, directory: Path, profile: LinkProfile, overload: float, run_s: float, *, udp: bool,
        link: Mapping[str, object],
    ) -> None:  # fmt: skip
        self.lab = lab
        self.profile = profile
        self.run_s = run_s
        self.scenario = Scenario(profile, run_s, overload)
        self.files = files_for(self.scenario, directory, lab.b, udp=udp, link=link)
        self.daemons: dict[str, Placed] = {}

    @property
    def relay(self) -> Placed:
        return self.daemons[RELAY]

    @property
    def site(self) -> Placed:
        return self.daemons[SITE]

    @property
    def robot(self) -> Placed:
        return self.daemons[ROBOT]

    async def start(self) -> None:
        self.lab.apply(self.profile)
        # The robot last: what it offers before anybody subscribes is unwanted, not lost.
        for name, node in ((RELAY, self.lab.b), (SITE, self.lab.b), (ROBOT, self.lab.a)):
            program = "relay" if name == RELAY else "client"
            daemon = self.daemons[name] = Placed(node, name, program, self.files[name])
            await daemon.ready()
        await self.site.until(lambda: {POSE_TOPIC, COUNTER} <= received(self.site), "hears from the robot")
        await self.robot.until(lambda: COMMAND_TOPIC in received(self.robot), "hears commands")

    def lane(self) -> str:
        """The lane that carries the robot's data."""
        return str(_only(self.robot.json("/api/link"))["lane"])

    async def uses(self, lane: str) -> None:
        await self.robot.until(lambda: self.lane() == lane, f"uses lane {lane}")

    def delivered(self, topic: str) -> int:
        return int(self.site.json("/api/topics").get(topic, {}).get("delivered", 0))

    async def hears(self, topic: str = POSE_TOPIC) -> None:
        """The site gets something new on a topic."""
        before = self.delivered(topic)
        await self.site.until(lambda: self.delivered(topic) > before, f"hears {topic}")

    async def play(self, during: Callable[["Stage"], Awaitable[None]] | None = None) -> Run:
        """Play the profile's script, or what `during` does instead, then stop everything and read what was logged."""
        origin_ns, before = time.time_ns(), self.lab.traffic()[0]
        if during is None:
            await self.lab.play(self.profile, until_s=self.run_s)
        else:
            await during(self)
        after, took_s = self.lab.traffic()[0], (time.time_ns() - origin_ns) / 1e9
        # Upstream first: what the robot still has goes to the relay, and from there to the site.
        await self.robot.stop()
        await self.site.until(lambda: not waiting(self.relay), "has been given everything")
        await self.site.stop()
        await self.relay.stop()
        facts = RunFacts(
            origin_ns=origin_ns,
            duration_s=took_s,
            floor_s={ROBOT: self.profile.up.delay_s, SITE: self.profile.down.delay_s},
            blackouts=tuple((window.start_s, window.end_s) for window in self.profile.up.blackouts),
            reliable_topics=frozenset({COUNTER, MAP}),
            command_lifespans_s={COMMAND_TOPIC: self.scenario.command_lifespan_s},
            pose_topic=POSE_TOPIC,
            relay=RELAY,
            subscribers={ROBOT: SITE, SITE: ROBOT},
        )
        logs = read_logs([(name, self.files[name].with_suffix(".csv")) for name in (ROBOT, RELAY, SITE)])
        counters = read_counters([file.with_suffix(".summary.json") for file in self.files.values()])
        return Run(analyse("SERN", logs, facts, counters), 8 * (after.bytes - before.bytes) / took_s)


@asynccontextmanager
async def staged(
    lab: Lab,
    directory: Path,
    profile: LinkProfile,
    *,
    overload: float,
    run_s: float = RUN_S,
    lane: str = UDP,
    udp: bool = True,
    link: Mapping[str, object] = MappingProxyType({}),
) -> AsyncIterator[Stage]:
    """A stage whose robot has come to use `lane`; what is left of it in the end is killed.

    `udp`: whether the robot asks for datagrams.
    """
    stage = Stage(lab, directory, profile, overload, run_s, udp=udp, link=link)
    try:
        await stage.start()
        await stage.uses(lane)
        yield stage
    finally:
        for daemon in stage.daemons.values():
            daemon.kill()
