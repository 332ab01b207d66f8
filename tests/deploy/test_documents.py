"""The guides for people: what they name exists, and what they tell to type is right."""

import re
import shlex
from pathlib import Path
from typing import Final

import pytest
import typer.main
from ruamel.yaml import YAML

from sern_relay.udp import udp_endpoints
from sern_runtime.config.base import split_tcp
from sern_runtime.profiles import load_profile
from sern_sim.netem import netem_commands
from sern_tools.commands import app
from tests.daemons import Lab

ROOT: Final = Path(__file__).resolve().parents[2]
GUIDES: Final = ("deploy/README.md", "docs/operations.md", "CONTRIBUTING.md")
_PATH: Final = re.compile(r"(?<![\w/.~])((?:deploy|docs|schemas|tests|sern_[a-z]+)/[\w/.@-]*\w)(?![\w*])")


def commands(guide: str) -> list[list[str]]:
    """The words of every command in the `sh` blocks of a guide."""
    blocks = re.findall(r"^```sh\n(.*?)^```", (ROOT / guide).read_text(), flags=re.MULTILINE | re.DOTALL)
    return [shlex.split(line) for block in blocks for line in block.splitlines()]


@pytest.mark.parametrize("guide", GUIDES)
def test_files_that_are_named_exist(guide: str) -> None:
    text = (ROOT / guide).read_text()
    assert [path for path in _PATH.findall(text) if not (ROOT / path).exists()] == []
    links = re.findall(r"\]\(([^)#]+)\)", text)
    assert [link for link in links if not ((ROOT / guide).parent / link).exists()] == []


@pytest.mark.parametrize("guide", GUIDES)
def test_links_within_a_guide_lead_somewhere(guide: str) -> None:
    text = (ROOT / guide).read_text()
    titles = {re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in re.findall(r"^#+ (.*)$", text, re.M)}
    assert set(re.findall(r"\]\(#([^)]*)\)", text)) <= titles


@pytest.mark.parametrize("guide", GUIDES)
def test_sern_commands_and_their_options_exist(guide: str) -> None:
    root = typer.main.get_command(app)
    for words in commands(guide):
        if "/opt/sern/bin/sern" not in words:
            continue
        rest = words[words.index("/opt/sern/bin/sern") + 1 :]
        command = root
        while rest and rest[0] in (known := getattr(command, "commands", {})):
            command, rest = known[rest[0]], rest[1:]
        assert not getattr(command, "commands", None), f"{guide}: no such command: {' '.join(words)}"
        options = {option for parameter in command.params for option in parameter.opts}
        assert {word for word in rest if word.startswith("-")} <= options, f"{guide}: {' '.join(words)}"


def test_what_is_installed_is_there() -> None:
    named = {word for guide in GUIDES for words in commands(guide) for word in words if word.startswith("deploy/")}
    assert [word for word in named if not (ROOT / word).exists()] == []
    assert named >= {f"deploy/systemd/sern-{name}.service" for name in ("relay", "client")}


def test_the_netem_line_is_the_profile() -> None:
    profile = load_profile("field-wifi")
    expected = netem_commands(profile, "eth0")
    assert [shlex.join(["sudo", *shlex.split(line)]) for line in expected] == [
        shlex.join(words) for words in commands("deploy/README.md") if words[:4] == ["sudo", "tc", "qdisc", "replace"]
    ]


async def test_a_key_file_may_hold_two_keys_as_the_rotation_says(tmp_path: Path) -> None:
    """Rotation of a client's key: the relay takes both; of the relay's key: the client tries both."""
    async with Lab(tmp_path, "site") as lab:
        await lab.relay()
        config = lab.recorder_file("site", "/.*")
        public = (tmp_path / "relay.pub").read_text().splitlines()
        lab.make_keys("stranger")
        other = (lab.clients_dir / "stranger.pub").read_text().splitlines()
        key = next(line for line in other if "public_key" in line)
        at = next(index for index, line in enumerate(public) if "public_key" in line)
        (tmp_path / "relay.pub").write_text("\n".join([*public[:at], key, *public[at:]]) + "\n")
        client = await lab.connected(config)
        assert client.core.link.established
        await lab.end(client)


def test_the_guide_opens_every_port_that_the_example_relay_listens_on() -> None:
    relay = YAML(typ="safe").load((ROOT / "deploy" / "examples" / "relay.yaml").read_text())["relay"]
    tcp = {str(parts[1]) for endpoint in relay["listen"] if (parts := split_tcp(endpoint)) is not None}
    udp = {endpoint.rpartition(":")[2] for endpoint in udp_endpoints(relay["listen"])}
    opened: dict[str, set[tuple[str, str]]] = {"ufw": set(), "firewall-cmd": set(), "nft": set()}
    for words in commands("deploy/README.md"):
        for tool, found in opened.items():
            if tool in words:
                found.update(re.findall(r"\b(\d+)/(tcp|udp)\b", " ".join(words)))
                found.update((port, kind) for kind, port in re.findall(r"\b(tcp|udp) dport (\d+)", " ".join(words)))
    wanted = {(port, "tcp") for port in tcp} | {(port, "udp") for port in udp}
    assert wanted == {("5555", "tcp"), ("5555", "udp")}
    assert opened == dict.fromkeys(opened, wanted)
