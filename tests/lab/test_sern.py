"""Relay, site and robot as their user runs them, with real packets lost, late and queued between them."""

import json
import time
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from sern_runtime.profiles import load_profile
from sern_sim.models import Window
from sern_sim.profiles import LinkProfile
from sern_tools.counters import read_counters
from sern_tools.demo_scenario import (
    COMMAND_TOPIC,
    COUNTER_TOPIC,
    POSE_TOPIC,
    RELAY,
    ROBOT,
    SITE,
    STATE_OVERTAKEN_LIMIT,
    Ports,
    Scenario,
    write_files,
)
from sern_tools.lab.lab import Lab, Node
from sern_tools.message_log import read_logs
from sern_tools.summary import Result, RunFacts, analyse, judge
from tests.daemons import Process

pytestmark = pytest.mark.root
RUN_S = 6.0
PORTS = Ports(relay=5555, relay_http=8081, robot_http=8082, site_http=8083)
MEGABIT = 1e6
COUNTER = f"/{ROBOT}{COUNTER_TOPIC}"
MAP = f"/{ROBOT}/map"
POSE_SILENCE_S = 2.0
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


def files_for(scenario: Scenario, directory: Path, relay: Node) -> dict[str, Path]:
    """The demo's files, with the relay where the lab has it, over TCP, and nothing thinned."""
    files = write_files(directory / "config", scenario, PORTS)
    endpoint = f"tcp://{relay.address}:{PORTS.relay}"
    for name, path in files.items():
        content: dict[str, Any] = YAML(typ="safe", pure=True).load(path)
        content["relay"] |= {"listen": [endpoint]} if name == RELAY else {"endpoint": endpoint, "udp": False}
        content.pop("adaptation", None)
        path.write_text(json.dumps(content))
    return files


async def run(lab: Lab, directory: Path, profile: LinkProfile, *, overload: float, run_s: float = RUN_S) -> Run:
    """Robot on side a, relay and site together on side b: connect over the profile's link, then play its script."""
    scenario = Scenario(profile, run_s, overload)
    files = files_for(scenario, directory, lab.b)
    lab.apply(profile)
    daemons: list[Placed] = []
    try:
        for name, node in ((RELAY, lab.b), (SITE, lab.b), (ROBOT, lab.a)):
            program = "relay" if name == RELAY else "client"
            daemons.append(await Placed(node, name, program, files[name]).ready())
        relay, site, robot = daemons
        await site.until(lambda: {POSE_TOPIC, COUNTER} <= received(site), "hears from the robot")
        await robot.until(lambda: COMMAND_TOPIC in received(robot), "hears commands")
        origin_ns, before = time.time_ns(), lab.traffic()[0]
        await lab.play(profile, until_s=run_s)
        after, took_s = lab.traffic()[0], (time.time_ns() - origin_ns) / 1e9
        # Upstream first: what the robot still has goes to the relay, and from there to the site.
        await robot.stop()
        await site.until(lambda: not waiting(relay), "has been given everything")
        await site.stop()
        await relay.stop()
    finally:
        for daemon in daemons:
            daemon.kill()
    facts = RunFacts(
        origin_ns=origin_ns,
        duration_s=run_s,
        floor_s={ROBOT: profile.up.delay_s, SITE: profile.down.delay_s},
        blackouts=tuple((window.start_s, window.end_s) for window in profile.up.blackouts),
        reliable_topics=frozenset({COUNTER, MAP}),
        command_lifespans_s={COMMAND_TOPIC: scenario.command_lifespan_s},
        pose_topic=POSE_TOPIC,
        relay=RELAY,
        takers={ROBOT: SITE, SITE: ROBOT},
    )
    logs = read_logs([(name, files[name].with_suffix(".csv")) for name in (ROBOT, RELAY, SITE)])
    counters = read_counters([files[name].with_suffix(".summary.json") for name in files])
    return Run(analyse("SERN", logs, facts, counters), 8 * (after.bytes - before.bytes) / took_s)


def received(daemon: Process) -> set[str]:
    """The topics of which something has arrived."""
    topics = daemon.json("/api/topics")
    return {name for name, counters in topics.items() if counters["direction"] == "receive" and counters["delivered"]}


def waiting(relay: Process) -> bool:
    """Whether the relay still has something for the site."""
    links = [link for link in relay.json("/api/link") if link["peer"] == SITE]
    return any(link["inflight_bytes"] or any(queue["bytes"] for queue in link["queue"].values()) for link in links)


def longest_silence_s(run: Run) -> float:
    """The longest time between two poses during the run."""
    facts = run.result.facts
    times = [(each.wall_ns - facts.origin_ns) / 1e9 for each in run.result.logs[POSE_TOPIC].deliveries]
    inside = [0.0, *sorted(time_s for time_s in times if 0.0 < time_s < facts.duration_s), facts.duration_s]
    return max(later - earlier for earlier, later in pairwise(inside))


def check(run: Run, *, complete: bool = True) -> None:
    """What every run promises: reliable messages once and in order, nothing altered, no command after its lifespan,
    a fresh pose soon after a blackout. Unless `complete`, reliable messages may still have been waiting at the end."""
    topics = run.result.topics
    assert all(topics[name].delivered for name in (POSE_TOPIC, COUNTER, COMMAND_TOPIC))
    for name in run.result.facts.reliable_topics:
        assert (topics[name].duplicates, topics[name].out_of_order) == (0, 0), name
    apart = set() if complete else {"reliable_faults"}
    verdicts = judge(run.result, None, overtaken_share_limits={"state": STATE_OVERTAKEN_LIMIT}, late_log_s=BUSY_S)
    broken = [verdict for verdict in verdicts if not verdict.ok and verdict.name not in apart]
    assert not broken, broken


@pytest.mark.parametrize("overload", [0.2, 2.0], ids=["idle", "overload"])
async def test_field_wifi(lab: Lab, tmp_path: Path, overload: float) -> None:
    """4 Mbit/s, 50 ms round trip, 2 % loss; idle, and with twice of what it carries."""
    played = await run(lab, tmp_path, load_profile("field-wifi"), overload=overload)
    check(played)
    assert played.carried_bps <= 4 * MEGABIT * 1.05, "more than the link carries: something went past it"
    # A pose every 20 ms; a lost TCP segment may hold a few back, a backlog would silence them for seconds.
    assert longest_silence_s(played) < POSE_SILENCE_S
    poses = played.result.topics[POSE_TOPIC]
    assert poses.delivered_share > 0.5


@pytest.mark.lab_long
@pytest.mark.parametrize(
    ("name", "complete"),
    # Over one TCP connection with cubic, losses leave 1.22 · MSS / (RTT · √p) of the link (Mathis et al. 1997): about
    # 0.18 Mbit/s of satcom's 1, 0.3 of mesh-radio's 0.5. That is less than the load's poses and maps together.
    [("wifi", True), ("lte", True), ("burst-loss", True), ("satcom", False), ("mesh-radio", False)],
)
async def test_profiles_under_overload(lab: Lab, tmp_path: Path, name: str, complete: bool) -> None:
    played = await run(lab, tmp_path, load_profile(name), overload=2.0, run_s=20.0)
    check(played, complete=complete)
    assert longest_silence_s(played) < 2 * POSE_SILENCE_S


@pytest.mark.lab_long
async def test_blackout_and_back(lab: Lab, tmp_path: Path) -> None:
    """Ten seconds of nothing: a fresh pose soon after, and everything reliable."""
    profile = load_profile("blackout-10")
    up, down = (replace(model, blackouts=(Window(5.0, 15.0),)) for model in (profile.up, profile.down))
    check(await run(lab, tmp_path, replace(profile, up=up, down=down), overload=2.0, run_s=25.0))
