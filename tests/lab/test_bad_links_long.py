"""The longer runs over real bad links: every named profile with its whole script, at three loads, over both lanes."""

from pathlib import Path

import pytest

from sern_runtime.profiles import load_profiles
from sern_tools.lab.lab import Lab
from tests.lab.test_bad_links import IDLE, TWICE, check, play

pytestmark = [pytest.mark.root, pytest.mark.lab_long]
THIRTEEN = 13.0
RUN_S = 15.0
IDLE_LAN = 2e-4
PROFILES = load_profiles()
LOADS = {"lan": (IDLE_LAN,), "wifi": (IDLE, TWICE)}
"""Profiles that are overloaded less than the others: twice a gigabit is more than two processors carry, and thirteen
times 50 Mbit/s more than they compose."""
RUNS = [(name, load) for name in PROFILES for load in LOADS.get(name, (IDLE, TWICE, THIRTEEN))]


@pytest.mark.parametrize(("name", "overload"), [pytest.param(*run, id=f"{run[0]}-{run[1]:g}x") for run in RUNS])
async def test_promises_hold(lab: Lab, tmp_path: Path, name: str, overload: float) -> None:
    profile = PROFILES[name]
    scripted = profile.next_change_s(0.0) is not None
    run_s = profile.duration_s if scripted and profile.up.flap is None else RUN_S
    check(await play(lab, tmp_path, profile, overload=overload, run_s=run_s), profile)
