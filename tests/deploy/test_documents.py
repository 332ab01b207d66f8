"""The guides for people: what they name exists, and what they tell to type is right."""

import argparse
import ast
import re
import runpy
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import pytest
import typer.main
from ruamel.yaml import YAML

import sern_client.cli
import sern_relay.cli
from sern_relay.udp import udp_endpoints
from sern_runtime.config.base import split_tcp
from sern_runtime.profiles import load_profile
from sern_sim.netem import netem_commands
from sern_tools.commands import app
from tests.daemons import Lab


def typer_command(function: Callable[..., Any]) -> Any:
    """What `typer.run` makes of it."""
    alone = typer.Typer(add_completion=False)
    alone.command()(function)
    return typer.main.get_command(alone)


ROOT: Final = Path(__file__).resolve().parents[2]
GUIDES: Final = (
    "README.md",
    "ARCHITECTURE.md",
    "CONTRIBUTING.md",
    "deploy/README.md",
    *sorted(str(path.relative_to(ROOT)) for path in (ROOT / "docs").glob("*.md")),
)
OURS: Final[dict[str, Any]] = {
    "sern": typer.main.get_command(app),
    "sern-relay": typer_command(sern_relay.cli.command),
    "sern-client": typer_command(sern_client.cli.command),
}
INSTALLED: Final = "/opt/sern/bin/"
_PATH: Final = re.compile(r"(?<![\w/.~])((?:deploy|docs|schemas|tests|sern_[a-z]+)/[\w/.@-]*\w)(?![\w*-])")
QUOTING: Final = ("deploy/README.md", "docs/adaptation.md", "docs/adaptation-theory.md", "docs/operations.md")
"""Guides that quote what the programs say."""
PROGRAMS: Final = frozenset({"sern", "sudo", "systemctl", "journalctl", "getent", "ip", "nc", "ros2", "scp", "ss"})
_TYPED: Final = re.compile(r"^(?:sudo |make |sern |sern-\w+ |\S*/?python )", re.M)


def blocks(guide: str, language: str) -> list[str]:
    found = re.findall(r"^```(\w*)\n(.*?)^```$", (ROOT / guide).read_text(), flags=re.M | re.S)
    return [block for marked, block in found if marked == language]


def commands(guide: str) -> list[list[str]]:
    """The words of every command in the `sh` blocks of a guide; of a pipe, of all its parts."""
    lines = [line for block in blocks(guide, "sh") for line in block.splitlines()]
    return [words for line in lines if (words := shlex.split(line, comments=True))]


def program(words: list[str]) -> tuple[str, list[str]]:
    """What a command starts, and with which arguments, without what it is started by or in."""
    while True:
        match words:
            case ["sudo", "-u", _, *rest] | ["sudo", *rest] | ["ip", "netns", "exec", _, *rest]:
                words = rest
            case [first, *rest] if re.match(r"\w+=", first):
                words = rest
            case [first, *rest]:
                return first, rest
            case _:
                return "", []


def typed() -> list[tuple[str, list[str], str, list[str]]]:
    """(guide, words, program, its arguments) of everything that people are told to type."""
    return [(guide, words, *program(words)) for guide in GUIDES for words in commands(guide)]


@pytest.mark.parametrize("guide", GUIDES)
def test_files_that_are_named_exist(guide: str) -> None:
    text = (ROOT / guide).read_text()
    assert [path for path in _PATH.findall(text) if not (ROOT / path).exists()] == []
    links = re.findall(r"\]\(([^)#]+)[^)]*\)", text)
    assert [link for link in links if not ((ROOT / guide).parent / link).exists()] == []


def anchors(path: Path) -> set[str]:
    return {
        re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-")
        for title in re.findall(r"^#+ (.*)$", path.read_text(), re.M)
    }


@pytest.mark.parametrize("guide", GUIDES)
def test_links_to_a_title_lead_somewhere(guide: str) -> None:
    here = ROOT / guide
    for link, title in re.findall(r"\]\(([^)#]*)#([^)]*)\)", here.read_text()):
        assert title in anchors(here.parent / link if link else here), f"{guide}: {link}#{title}"


@pytest.mark.parametrize("guide", GUIDES)
def test_what_is_to_be_typed_is_marked_as_such(guide: str) -> None:
    """The tests below read nothing else."""
    assert [block for block in blocks(guide, "") if _TYPED.search(block)] == []


def test_sern_commands_and_their_options_exist() -> None:
    seen = set()
    for guide, words, name, rest in typed():
        command = OURS.get(Path(name).name)
        if command is None:
            continue
        while rest and rest[0] in (known := getattr(command, "commands", {})):
            command, rest = known[rest[0]], rest[1:]
        assert not getattr(command, "commands", None), f"{guide}: no such command: {' '.join(words)}"
        rest = rest[: rest.index("--")] if "--" in rest else rest
        rest = rest[: rest.index("|")] if "|" in rest else rest
        options = {option for parameter in command.params for option in [*parameter.opts, *parameter.secondary_opts]}
        assert {word for word in rest if word.startswith("-")} <= options, f"{guide}: {' '.join(words)}"
        seen.add(guide)
    assert seen >= {"README.md", "deploy/README.md", "docs/lab.md", "docs/operations.md"}


def test_what_root_starts_is_named_by_its_path() -> None:
    """Neither an installation nor a checkout is on root's path."""
    ours = [(guide, words, name) for guide, words, name, _ in typed() if Path(name).name in (*OURS, "python")]
    assert len(ours) > 20
    assert [words for _, words, name in ours if words[0] == "sudo" and "/" not in name] == []
    assert {
        words[-1] for guide, words, name in ours if guide.startswith("deploy") and not name.startswith(INSTALLED)
    } == set()


def test_verbs_exist() -> None:
    verbs = set(re.findall(r"^([\w-]+):(?!=)", (ROOT / "Makefile").read_text(), re.M))
    named = {word for _, _, name, rest in typed() if name == "make" for word in rest if "=" not in word}
    named |= {
        word
        for guide in GUIDES
        for part in re.findall(r"`make ([a-z -]+)`", (ROOT / guide).read_text())
        for word in part.split()
    }
    assert {"demo", "test", "performance", "lab"} <= named <= verbs


def test_who_installs_is_told_of_the_middleware() -> None:
    """The dot alone takes away what a host with ROS 2 has, or leaves it at another version."""
    installing = {guide for guide, words, _, _ in typed() if "install" in words and words[-1] == "."}
    assert installing == {"deploy/README.md", "docs/operations.md"}
    for guide in installing:
        assert {"'.[dds]'", "'.[zenoh]'"} <= set(re.findall(r"'\.\[\w+\]'", (ROOT / guide).read_text())), guide


class _StoppedError(Exception):
    """Before a benchmark begins."""


@pytest.mark.usefixtures("default_signals")
@pytest.mark.filterwarnings("ignore:.* found in sys.modules:RuntimeWarning")  # other tests import them, too
def test_benchmarks_and_their_options_exist(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("psutil")
    parsers: list[argparse.ArgumentParser] = []

    def stop(parser: argparse.ArgumentParser) -> None:
        parsers.append(parser)
        raise _StoppedError

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", stop)
    named: dict[str, set[str]] = {}
    for guide in GUIDES:
        text = (ROOT / guide).read_text()
        for line in re.findall(r"python -m (benchmarks\.[^`\n#]+)", text):
            module, *rest = line.replace("[", "").replace("]", "").split()
            if module != "benchmarks.NAME":
                named.setdefault(module, set()).update(word for word in rest if word.startswith("--"))
    assert len(named) > 6
    for module, options in named.items():
        with pytest.raises(_StoppedError):
            runpy.run_module(module, run_name="__main__")
        known = {option for action in parsers[-1]._actions for option in action.option_strings}
        assert options <= known, f"{module}: {options - known}"


def test_a_log_line_that_is_quoted_names_who_is_in_the_guide() -> None:
    text = (ROOT / "deploy" / "README.md").read_text()
    assert re.findall(r"`(\w+): no datagram came through \.\.\.", text) == ["jackal1"]


def said() -> str:
    """Every text of the programs, a line each: what they log, answer and show. Values that are put in are `{}`."""
    found = []
    for path in sorted(file for package in ROOT.glob("sern_*") for file in package.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.JoinedStr):
                found.append("".join(str(v.value) if isinstance(v, ast.Constant) else "{}" for v in node.values))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.append(node.value)
    found += [path.read_text() for path in sorted((ROOT / "deploy" / "grafana").glob("*.json"))]
    found += [title for guide in GUIDES for title in re.findall(r"^#+ (.*)$", (ROOT / guide).read_text(), re.M)]
    return "\n".join(" ".join(text.split()) for text in found)


def pattern(quoted: str) -> str:
    """What a quoted line looks like in the source: names in capitals and words with a digit in them stand for values,
    and three dots for anything."""
    words = re.sub(r"\b[A-Z]+\b|[\w.]*\d[\w.]*", "\0", quoted)
    return re.escape(words).replace(r"\.\.\.", ".*").replace("…", ".*").replace("\0", r"\S*").replace(r"\ ", " ")


def test_lines_that_are_quoted_are_said() -> None:
    """Read all quotations of three words and more that are no commands and no parts of files. A line that ends in
    another one's text, after a colon, is looked for in its parts."""
    source = said()
    quotations = set()
    for guide in QUOTING:
        text = re.sub(r"^```.*?^```$", "", (ROOT / guide).read_text(), flags=re.M | re.S)
        text = " ".join(text.split())
        for quoted in re.findall(r"`([^`]+)`", text) + re.findall(r'"([^"`]+)"', text):
            first, *others = quoted.split()
            if len(others) >= 2 and first not in PROGRAMS and not re.search(r"[/={}<>|*\[\]]|--", quoted):
                quotations.add((guide, quoted))
    assert len(quotations) > 40
    missing = [
        (guide, quoted)
        for guide, quoted in sorted(quotations)
        if not all(re.search(pattern(part), source) for part in re.split(": ", quoted))
    ]
    assert missing == []


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
