"""The profile file: what ships, and what a mistake in one looks like."""

import re
import shutil
import subprocess
from dataclasses import fields
from pathlib import Path

import pytest

from sern_core.vocabulary.errors import ConfigError
from sern_runtime import profiles as module
from sern_runtime.profiles import LinkSection, find_profiles_file, load_profile, load_profiles
from sern_sim.models import BurstLoss, Flap, Jitter, LinkModel, RateStep, Window
from sern_sim.netem import netem_timeline
from sern_sim.network import Network
from sern_sim.profiles import LinkProfile
from tests.sern_sim.toys import ArqReceiver, ArqSender

NAMES = [
    "lan", "wifi", "field-wifi", "lte", "satcom", "mesh-radio", "step", "blackout-10", "blackout-30", "flap",
    "burst-loss", "demo", "demo-navigation", "demo-twin",
]  # fmt: skip


@pytest.fixture(scope="module", name="shipped")
def shipped_profiles() -> dict[str, LinkProfile]:
    return load_profiles()


# ---------------------------------------------------------------------- what ships


def test_every_named_profile_ships_with_a_description(shipped: dict[str, LinkProfile]) -> None:
    assert list(shipped) == NAMES
    for name, profile in shipped.items():
        assert profile.name == name
        assert 20 < len(profile.description) <= 110
        assert profile.up.overhead_bytes == 28


@pytest.mark.parametrize(
    ("name", "rate_bps", "rtt_s", "loss"),
    [
        ("lan", 1e9, 0.0005, 0.0),
        ("wifi", 50e6, 0.0075, 0.0),
        ("field-wifi", 4e6, 0.050, 0.02),
        ("lte", 8e6, 0.060, 0.005),
        ("satcom", 1e6, 0.500, 0.025),
        ("mesh-radio", 0.5e6, 0.200, 0.05),
        ("step", 8e6, 0.050, 0.0),
        ("burst-loss", 4e6, 0.050, 0.03),
        ("demo", 4e6, 0.050, 0.0),
    ],
)
def test_the_figures_are_those_of_the_description(
    shipped: dict[str, LinkProfile], name: str, rate_bps: float, rtt_s: float, loss: float
) -> None:
    profile = shipped[name]
    assert profile.symmetric
    assert profile.rate_bps_at(0) == rate_bps
    assert profile.rtt_s == pytest.approx(rtt_s)
    assert profile.up.mean_loss == pytest.approx(loss, abs=0.0005)
    if loss:
        assert re.search(rf"\b{100 * loss:g} %", profile.description)


def test_the_scripts(shipped: dict[str, LinkProfile]) -> None:
    assert [shipped["step"].rate_bps_at(t) for t in (0, 19, 20, 39, 40)] == [8e6, 8e6, 1e6, 1e6, 4e6]
    assert shipped["blackout-10"].up.blackouts == (Window(20, 30),)
    assert shipped["blackout-30"].up.blackouts == (Window(20, 50),)
    assert shipped["flap"].up.flap == Flap(1, 1)
    wifi = shipped["wifi"].up
    assert wifi.jitter is Jitter.UNIFORM
    assert 2 * (wifi.delay_s - wifi.jitter_s) == pytest.approx(0.005)
    assert 2 * (wifi.delay_s + wifi.jitter_s) == pytest.approx(0.010)


def test_the_demo_recovers_well_before_its_end(shipped: dict[str, LinkProfile]) -> None:
    demo = shipped["demo"]
    assert demo.duration_s == 60
    assert {demo.rate_bps_at(t) for t in range(60)} == {4e6, 1e6}
    assert sum(demo.blackout_at(t) for t in range(60)) == 10
    last_s, t_s = 0.0, demo.next_change_s(0.0)
    while t_s is not None:
        last_s, t_s = t_s, demo.next_change_s(t_s)
    assert last_s <= demo.duration_s - 15
    assert (demo.rate_bps_at(last_s), demo.blackout_at(last_s)) == (4e6, False)


@pytest.mark.parametrize("name", NAMES)
def test_an_arq_works_over_every_profile(shipped: dict[str, LinkProfile], name: str) -> None:
    profile = shipped[name]
    for each in (profile, profile.as_stream()):
        sender, receiver = ArqSender(1000, timeout_s=1.5), ArqReceiver()
        network = Network(5)
        network.join(sender, None, receiver, None, each.up, each.down)
        network.run_until_true(lambda sender=sender: sender.done, within_s=600.0)  # type: ignore[misc]
        assert receiver.numbers == set(range(1000))


@pytest.mark.skipif(shutil.which("tc") is None, reason="needs the tc command (package iproute2)")
@pytest.mark.parametrize("name", NAMES)
def test_tc_understands_every_command(shipped: dict[str, LinkProfile], name: str) -> None:
    """tc parses its options before it looks for the device, and this one does not exist."""
    profile = shipped[name]
    for _, command in netem_timeline(profile.up, "sern-no-such", until_s=30.0):
        done = subprocess.run(command.split(), capture_output=True, text=True, check=False)
        if "distribution" in done.stderr:
            pytest.skip("tc's delay distributions are not installed")
        assert 'Cannot find device "sern-no-such"' in done.stderr


# ---------------------------------------------------------------------- own files


def _file(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "links.yaml"
    path.write_text(text)
    return path


def test_a_file_of_ones_own(tmp_path: Path) -> None:
    path = _file(
        tmp_path,
        """
profiles:
  plain: {description: Nothing special}
  mine:
    description: Different up and down
    link: {rate_bps: 2e6, delay_s: 0.1, loss: 0.01, jitter: uniform}
    up: {rate_bps: 500000, burst_loss: {enter: 0.01, leave: 0.5}}
    down: {loss: 0.0, rate_bps: null}
    schedule:
      - {at_s: 1, rate_bps: 1000000, direction: up}
      - {at_s: 2, blackout_s: 3}
      - {at_s: 6, blackout_s: 1, direction: down}
    duration_s: 12.5
""",
    )
    profiles = load_profiles(path)
    assert profiles["plain"].up == profiles["plain"].down == LinkModel()
    mine = load_profile("mine", str(path))
    assert mine.up == LinkModel(
        rate_bps=500_000,
        delay_s=0.1,
        loss=0.01,
        jitter=Jitter.UNIFORM,
        burst_loss=BurstLoss(0.01, 0.5, 1.0, 0.0),
        rate_steps=(RateStep(1, 1e6),),
        blackouts=(Window(2, 5),),
    )
    assert mine.down == LinkModel(
        rate_bps=None, delay_s=0.1, jitter=Jitter.UNIFORM, blackouts=(Window(2, 5), Window(6, 7))
    )
    assert mine.duration_s == 12.5


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("", "links.yaml:1: the file must be a mapping"),
        ("{}", "links.yaml:1: profiles: expected a mapping from names to profiles"),
        ("profiles: []", "links.yaml:1: profiles: expected a mapping"),
        ("profiles: {}\n\nlinks: 1", "links.yaml:3: links: unknown key; accepted: profiles"),
        ("profiles:\n  Bad Name: {}", "links.yaml:2: profiles.'Bad Name': a profile's name is lower-case"),
        ("profiles:\n  a:\n  b:", "links.yaml:2: profiles.a: expected a mapping"),
        ("profiles:\n  a: {link: {}}", "links.yaml:2: profiles.a.description: is missing"),
        (
            "profiles:\n  a:\n    description: x\n    link:\n      rate_bits: 5",
            "links.yaml:5: profiles.a.link.rate_bits: unknown key (did you mean rate_bps?); accepted: rate_bps, ",
        ),
        (
            "profiles:\n  a:\n    description: x\n    link:\n      delay_s: 1\n      loss: 2",
            "links.yaml:6: profiles.a.link.loss: loss is 2.0: give a probability from 0 to 1 (2 % is 0.02)",
        ),
        (
            "profiles:\n  a:\n    description: x\n    down: {\n      delay_s: -1}",
            "links.yaml:5: profiles.a.down.delay_s: delay_s is -1.0: give a time of 0 s or more",
        ),
        (
            "profiles:\n  a:\n    description: x\n    link: {loss: '2%'}",
            "links.yaml:4: profiles.a.link.loss: expected a number, not '2%'",
        ),
        (
            "profiles:\n  a:\n    description: x\n    link: {jitter: gauss}",
            "links.yaml:4: profiles.a.link.jitter: 'gauss' is not accepted; accepted: uniform, normal",
        ),
        (
            "profiles:\n  a:\n    description: x\n    schedule:\n      - {at_s: 1}",
            "links.yaml:5: profiles.a.schedule.0: give either rate_bps or blackout_s",
        ),
        (
            "profiles:\n  a:\n    description: x\n    schedule:\n      - {at_s: 1, blackout_s: 0}",
            "links.yaml:5: profiles.a.schedule.0.blackout_s: must be > 0, not 0",
        ),
        (
            "profiles:\n  a:\n    description: x\n    schedule: [{at_s: 5, rate_bps: 9}, {at_s: 1, rate_bps: 9}]",
            "links.yaml:4: profiles.a.schedule: rate_steps: the step at 1.0 s is out of order",
        ),
        (
            "profiles:\n  a:\n    description: x\n    flap: {up_s: 0, down_s: 1}",
            "links.yaml:4: profiles.a.flap: flap: give up_s and down_s above 0 s",
        ),
        (
            "profiles:\n  a:\n    description: x\n    duration_s: 0",
            "links.yaml:4: profiles.a.duration_s: duration_s is 0.0: give a time above 0 s",
        ),
    ],
)
def test_a_mistake_is_one_line_with_its_place(tmp_path: Path, text: str, error: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_profiles(_file(tmp_path, text))
    message = str(caught.value)
    assert message.startswith(f"{tmp_path}/{error}")
    assert "\n" not in message


def test_a_missing_profile_names_those_there_are() -> None:
    with pytest.raises(ConfigError) as caught:
        load_profile("feild-wifi")
    assert str(caught.value) == f"no link profile feild-wifi (did you mean field-wifi?); there are: {', '.join(NAMES)}"


def test_a_missing_file_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match=r"none\.yaml: no such file"):
        load_profiles(tmp_path / "none.yaml")
    monkeypatch.setattr(module, "PROFILES_FILE", "none.yaml")
    with pytest.raises(ConfigError, match=r"are not at .*sern_runtime/none\.yaml: name a file of your own"):
        find_profiles_file()


def test_the_file_has_a_key_for_every_figure_of_a_model() -> None:
    """What only a stream or a script has is not among the keys of a link."""
    elsewhere = {
        "rate_steps",
        "path_steps",
        "blackouts",
        "flap",
        "mode",
        "stall_s",
        "disconnect_after_s",
        "reconnect_s",
    }
    assert set(LinkSection.model_fields) == {field.name for field in fields(LinkModel)} - elsewhere
    for name, info in LinkSection.model_fields.items():
        assert info.default == getattr(LinkModel(), name)
