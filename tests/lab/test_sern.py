"""Relay, site and robot as their user runs them, with real packets lost, late and queued between them."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest

from sern_runtime.profiles import load_profile
from sern_sim.models import Window
from sern_sim.profiles import LinkProfile
from sern_tools.demo_scenario import COMMAND_TOPIC, POSE_TOPIC, STATE_OVERTAKEN_LIMIT
from sern_tools.lab.lab import Lab
from sern_tools.summary import judge
from tests.lab.stage import BUSY_S, COUNTER, UDP, ZMQ, Run, Stage, staged

pytestmark = pytest.mark.root
RUN_S = 6.0
MEGABIT = 1e6
POSE_SILENCE_S = 2.0


async def run(lab: Lab, directory: Path, profile: LinkProfile, *, overload: float, run_s: float = RUN_S) -> Run:
    """Connect over the profile's link, by TCP alone, then play its script."""
    async with staged(lab, directory, profile, overload=overload, run_s=run_s, lane=ZMQ, udp=False) as stage:
        return await stage.play()


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


async def test_data_takes_the_stream_and_leaves_it_when_the_path_gets_thin(lab: Lab, tmp_path: Path) -> None:
    """12 Mbit/s over 8 ms, more than datagrams are to carry here, then 1 Mbit/s."""
    profile = load_profile("field-wifi")
    path = replace(profile.up, rate_bps=12 * MEGABIT, delay_s=0.004, loss=0.0)
    profile = replace(profile, up=path, down=path)

    async def during(stage: Stage) -> None:
        await stage.uses(ZMQ)
        await stage.hears()
        lab.change(rate_bps=1 * MEGABIT)
        await stage.uses(UDP)
        await stage.hears()

    link = {"stream_from_bps": 4 * MEGABIT}
    async with staged(lab, tmp_path, profile, overload=1.2, link=link) as stage:
        played = await stage.play(during)
    check(played)
    assert longest_silence_s(played) < POSE_SILENCE_S


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
