"""Relay, robot and site with keys and both lanes, over real bad links: what is promised holds, whatever the link does.

Judged from message logs and counters. Robot on side a, relay and site on side b.
"""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from sern_runtime.profiles import load_profile
from sern_sim.models import Flap, LinkModel, RateStep, Window
from sern_sim.profiles import LinkProfile
from sern_tools.demo_scenario import COMMAND_TOPIC, POSE_TOPIC, STATE_OVERTAKEN_LIMIT
from sern_tools.lab.host import LabError
from sern_tools.lab.host import run as run_command
from sern_tools.lab.lab import Lab, Node
from sern_tools.summary import judge
from tests.lab.stage import BUSY_S, COUNTER, RUN_S, UDP, ZMQ, Run, Stage, staged
from tests.support import until

pytestmark = pytest.mark.root
IDLE, TWICE = 0.2, 2.0
RUNS_S = {"satcom": 2.5}  # which takes seconds to connect
RECOVERY_S = 15.0
"""A fresh pose is there so soon after a blackout: no measure of speed, as the machine may be busy with anything."""
NEW_ADDRESS = "198.18.0.77"
CALM_WAY = LinkModel(rate_bps=4e6, delay_s=0.025)
CALM = LinkProfile("calm", "4 Mbit/s, 50 ms round trip", CALM_WAY, CALM_WAY)


def check(played: Run, profile: LinkProfile) -> None:
    """What every run promises: reliable messages complete, once and in order, nothing altered, no command after its
    lifespan, every message accounted for, a fresh pose soon after a blackout; where nothing is lost, class order to
    the last message.

    On a path with losses a message that is sent again comes after what was sent meanwhile: that is no choice of the
    sender, whose order tests/matrix holds to its floors fragment by fragment.
    """
    topics = played.result.topics
    assert all(topics[name].delivered for name in (POSE_TOPIC, COUNTER, COMMAND_TOPIC))
    lossy = profile.up.mean_loss or profile.up.blackouts
    verdicts = judge(
        played.result,
        None,
        overtaken_share_limits={} if lossy else {"state": STATE_OVERTAKEN_LIMIT},
        fresh_limit_s=RECOVERY_S,
        late_log_s=BUSY_S,
    )
    broken = [verdict for verdict in verdicts if not verdict.ok]
    assert not broken, broken


async def play(lab: Lab, directory: Path, profile: LinkProfile, *, overload: float, run_s: float = RUN_S) -> Run:
    async with staged(lab, directory, profile, overload=overload, run_s=run_s) as stage:
        return await stage.play()


def scripted(name: str, *, steps: tuple[RateStep, ...] = (), blackouts: tuple[Window, ...] = ()) -> LinkProfile:
    """A named profile with another script: the same link, sooner."""
    profile = load_profile(name)
    up, down = (
        replace(model, rate_steps=steps, blackouts=blackouts, flap=None) for model in (profile.up, profile.down)
    )
    return replace(profile, up=up, down=down)


def flapping(flap: Flap, until_s: float) -> tuple[Window, ...]:
    period_s = flap.up_s + flap.down_s
    return tuple(
        Window(n * period_s + flap.up_s, (n + 1) * period_s) for n in range(int((until_s - flap.up_s) / period_s))
    )


# --- what a lab's nodes are made to do ------------------------------------------------------------------------------


@contextmanager
def dropped(lab: Lab, protocol: str) -> Iterator[None]:
    """Packets of one protocol that cross the link are dropped where they arrive, without a word to their sender."""
    nodes = (lab.a, lab.b)
    for node in nodes:
        # The rule must come before the table of local addresses, which is the first of all.
        _ip(node, "rule", "add", "pref", "20", "lookup", "local")
        _ip(node, "rule", "add", "pref", "10", "iif", "eth0", "ipproto", protocol, "blackhole")
        _ip(node, "rule", "delete", "pref", "0")
    try:
        yield
    finally:
        for node in nodes:
            _ip(node, "rule", "add", "pref", "0", "lookup", "local")
            _ip(node, "rule", "delete", "pref", "10")
            _ip(node, "rule", "delete", "pref", "20")


@contextmanager
def moved(lab: Lab, address: str = NEW_ADDRESS) -> Iterator[None]:
    """The robot's address is another one: its connections are dead, and only it knows."""
    old = lab.a.address
    neighbours = json.loads(run_command(["ip", "-j", "-n", lab.b.namespace, "neigh", "show", old]))
    hardware, device = neighbours[0]["lladdr"], neighbours[0]["dev"]
    _ip(lab.b, "neigh", "replace", address, "lladdr", hardware, "dev", device, "nud", "permanent")
    _swap(lab.a, old, address)
    try:
        yield
    finally:
        _swap(lab.a, address, old)
        _ip(lab.b, "neigh", "delete", address, "dev", device)


def _swap(node: Node, old: str, new: str) -> None:
    route = run_command(["ip", "-n", node.namespace, "route", "show", "dev", "eth0"]).splitlines()[0]
    length = route.split()[0].partition("/")[2]
    _ip(node, "address", "delete", f"{old}/{length}", "dev", "eth0")
    _ip(node, "address", "add", f"{new}/{length}", "dev", "eth0")
    # As it was: with the congestion control of the lab.
    _ip(node, "route", "replace", *route.replace(old, new).split(), "dev", "eth0")


def _ip(node: Node, *words: str) -> None:
    run_command(["ip", "-n", node.namespace, *words])


@pytest.fixture
def filtering(lab: Lab) -> Lab:
    """The lab, where its kernel can drop by protocol."""
    try:
        with dropped(lab, UDP):
            pass
    except LabError as error:
        pytest.skip(f"this kernel has no routing rules by protocol: {error}")
    return lab


# --- the runs -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "overload"),
    [
        pytest.param("wifi", IDLE, id="wifi-idle", marks=pytest.mark.lab_long),
        pytest.param("wifi", TWICE, id="wifi-2x"),
        pytest.param("field-wifi", TWICE, id="field-wifi-2x"),
        pytest.param("lte", TWICE, id="lte-2x"),
        pytest.param("satcom", TWICE, id="satcom-2x"),
        pytest.param("mesh-radio", TWICE, id="mesh-radio-2x"),
        pytest.param("burst-loss", TWICE, id="burst-loss-2x"),
    ],
)
async def test_promises_hold(lab: Lab, tmp_path: Path, name: str, overload: float) -> None:
    profile = load_profile(name)
    played = await play(lab, tmp_path, profile, overload=overload, run_s=RUNS_S.get(name, RUN_S))
    check(played, profile)
    assert profile.up.rate_bps is not None
    assert played.carried_bps <= profile.up.rate_bps * 1.05, "more than the link carries: something went past it"


async def test_rate_steps(lab: Lab, tmp_path: Path) -> None:
    """8, 1, 4 Mbit/s: the fall to an eighth is what fills queues."""
    profile = scripted("step", steps=(RateStep(1.5, 1e6), RateStep(3.5, 4e6)))
    played = await play(lab, tmp_path, profile, overload=TWICE, run_s=5.0)
    check(played, profile)


@pytest.mark.lab_long
async def test_flapping_path(lab: Lab, tmp_path: Path) -> None:
    flap = load_profile("flap").up.flap
    assert flap is not None
    profile = scripted("flap", blackouts=flapping(flap, 4.0))
    check(await play(lab, tmp_path, profile, overload=TWICE, run_s=5.0), profile)


async def test_blackout(lab: Lab, tmp_path: Path) -> None:
    """Shorter than its name says; `make lab` has it whole."""
    profile = scripted("blackout-10", blackouts=(Window(1.0, 3.5),))
    check(await play(lab, tmp_path, profile, overload=TWICE, run_s=5.0), profile)


async def test_udp_blocked_it_falls_back_and_returns_by_itself(filtering: Lab, tmp_path: Path) -> None:
    async def block(stage: Stage) -> None:
        with dropped(filtering, UDP):
            await stage.uses(ZMQ)
            await stage.hears()
            await stage.hears(COUNTER)
        await stage.uses(UDP)
        await stage.hears()

    async with staged(filtering, tmp_path, CALM, overload=TWICE) as stage:
        played = await stage.play(block)
    check(played, CALM)


@pytest.mark.lab_long
async def test_tcp_blocked_while_udp_flows_the_session_outlives_it(filtering: Lab, tmp_path: Path) -> None:
    """Until the stream's connection is given up, and on from there."""

    async def block(stage: Stage) -> None:
        with dropped(filtering, "tcp"):
            await until(lambda: not _stream_up(stage), "the stream is given up", deadline_s=30.0)
            await stage.hears()
            await stage.hears(COUNTER)
            assert stage.lane() == UDP
        await until(lambda: _stream_up(stage), "the stream is back", deadline_s=30.0)
        await stage.hears()

    async with staged(filtering, tmp_path, CALM, overload=TWICE) as stage:
        played = await stage.play(block)
        assert stage.robot.text.count("connected to relay") == 1, "another session"
    check(played, CALM)


def _stream_up(stage: Stage) -> bool:
    command = ["ss", "-Htn", "state", "established", "dport", "=", ":5555"]
    return bool(run_command([*stage.lab.a.prefix, *command]).strip())


async def test_another_address_loses_nothing_reliable(lab: Lab, tmp_path: Path) -> None:
    async def move(stage: Stage) -> None:
        with moved(lab):
            await stage.relay.said("robot is reached over UDP at", NEW_ADDRESS)
            await stage.hears()
            await stage.hears(COUNTER)
        await stage.hears()

    async with staged(lab, tmp_path, CALM, overload=TWICE) as stage:
        played = await stage.play(move)
    check(played, CALM)
