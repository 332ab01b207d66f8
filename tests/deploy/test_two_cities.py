"""The guide for two cities: its files are accepted, its commands make them, its ports are those of the files, and what
it sets up works, on loopback."""

import json
import re
from pathlib import Path
from typing import Any, Final

import pytest
from ruamel.yaml import YAML
from typer.testing import CliRunner

from sern_core.vocabulary.types import ClientName
from sern_relay.fabric import rules_hash
from sern_runtime.config.load import check_bytes
from sern_runtime.config.relay import RelayFile
from sern_tools.commands import app
from sern_tools.keygen import write_pair
from sern_tools.ports import free_ports
from tests.daemons import HOST, Lab, Process
from tests.deploy.test_documents import ROOT, blocks, commands, program

GUIDE: Final = "docs/two-cities.md"
EXAMPLES: Final = ROOT / "deploy" / "examples" / "two-cities"
CITIES: Final = ("berlin", "hamburg")
CLIENTS: Final = {"jackal1": "berlin", "site1": "hamburg"}
ADMIN: Final = "authority"


def parsed(text: str) -> Any:
    return YAML(typ="safe").load(text)


def example(name: str) -> Any:
    return parsed((EXAMPLES / name).read_text())


def type_in(folder: Path, monkeypatch: pytest.MonkeyPatch, *words: str) -> str:
    """Give a command of ours as the guide has it, in a folder."""
    monkeypatch.chdir(folder)
    result = CliRunner().invoke(app, list(words))
    assert result.exit_code == 0, f"{' '.join(words)}: {result.output}"
    return result.output


def keygens() -> list[list[str]]:
    """The arguments of every `sern keygen fabric` of the guide, in order."""
    typed = [program(words) for words in commands(GUIDE)]
    return [rest for name, rest in typed if Path(name).name == "sern" and rest[:2] == ["keygen", "fabric"]]


@pytest.fixture
def world(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder for the authority, and one for each host with what the guide puts into its /etc/sern."""
    (tmp_path / ADMIN).mkdir()
    type_in(tmp_path / ADMIN, monkeypatch, *keygens()[0])
    for name in (*CITIES, *CLIENTS):
        (tmp_path / name).mkdir()
        write_pair(ClientName(name), tmp_path / name, tmp_path / name)
    for city in CITIES:
        install(tmp_path, city)
        (tmp_path / city / "clients").mkdir()
        for client in CLIENTS:
            copy(tmp_path / client / f"{client}.pub", tmp_path / city / "clients")
            copy(tmp_path / city / f"{city}.pub", tmp_path / client)
        (tmp_path / city / "relay.yaml").write_text((EXAMPLES / city / "relay.yaml").read_text())
    for client in CLIENTS:
        (tmp_path / client / "client.yaml").write_text((EXAMPLES / f"{client}.yaml").read_text())
    return tmp_path


def copy(path: Path, folder: Path, *, name: str | None = None) -> None:
    to = folder / (name or path.name)
    to.write_bytes(path.read_bytes())
    to.chmod(path.stat().st_mode & 0o777)


def install(world: Path, city: str) -> None:
    fabric = world / city / "fabric"
    fabric.mkdir(exist_ok=True)
    for name in ("ca.pem", f"{city}.pem", f"{city}-key.pem"):
        copy(world / ADMIN / "fabric" / name, fabric)


def is_right(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    said = type_in(path.parent, monkeypatch, "check", path.name)
    warnings = [line for line in said.splitlines() if "warning" in line and "does not resolve" not in line]
    assert not warnings and f"{path.name}: right" in said, said


def test_the_files_are_right_where_the_guide_puts_them(world: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("zenoh", reason="zenoh is not installed: pip install 'sern[zenoh]'")
    for city in CITIES:
        is_right(world / city / "relay.yaml", monkeypatch)
    for client in CLIENTS:
        is_right(world / client / "client.yaml", monkeypatch)
    assert (world / ADMIN / "fabric" / "ca-key.pem").stat().st_mode & 0o777 == 0o600


def fabrics() -> list[Any]:
    """The sections `fabric` of the guide's blocks, in order."""
    return [found["fabric"] for block in blocks(GUIDE, "yaml") if "fabric" in (found := parsed(block))]


def test_what_the_guide_shows_is_in_the_files() -> None:
    shown = fabrics()
    assert shown[:2] == [example(f"{city}/relay.yaml")["fabric"] for city in CITIES]
    (lists,) = [found["relays"] for block in blocks(GUIDE, "yaml") if "relays" in (found := parsed(block))]
    assert lists == example("jackal1.yaml")["relays"]
    assert lists == list(
        reversed([{**each, "secret_key_file": "jackal1.key"} for each in example("site1.yaml")["relays"]])
    )


def test_both_relays_have_the_same_rules() -> None:
    models = [check_bytes((EXAMPLES / city / "relay.yaml").read_bytes(), EXAMPLES / "x", RelayFile) for city in CITIES]
    rules = [checked.loaded.model.access_rules() for checked in models if checked.loaded is not None]
    assert len(rules) == 2 and rules_hash(rules[0]) == rules_hash(rules[1])


def test_the_firewall_opens_what_the_files_need() -> None:
    opened = {
        (kind, int(port)): " saddr " in " ".join(words)
        for words in commands(GUIDE)
        if "nft" in words
        for kind, port in re.findall(r"\b(tcp|udp) dport (\d+)", " ".join(words))
    }
    (listen,) = example("berlin/relay.yaml")["fabric"]["listen"]
    (clients,) = example("berlin/relay.yaml")["relay"]["listen"]
    between, public = int(listen.rpartition(":")[2]), int(clients.rpartition(":")[2])
    assert opened == {("tcp", public): False, ("udp", public): False, ("tcp", between): True}


def test_a_key_as_a_credential_is_right(world: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("zenoh", reason="zenoh is not installed: pip install 'sern[zenoh]'")
    copy(world / ADMIN / "fabric" / "berlin-key.pem", world, name="fabric.key")
    (world / "berlin" / "fabric" / "berlin-key.pem").unlink()
    section = fabrics()[2]
    section["certificates"]["key"] = section["certificates"]["key"].replace(
        "/run/credentials/sern-relay.service", str(world)
    )
    rewrite(world / "berlin" / "relay.yaml", fabric=section)
    is_right(world / "berlin" / "relay.yaml", monkeypatch)
    (ini,) = blocks(GUIDE, "ini")
    named = Path(fabrics()[2]["certificates"]["key"]).name
    assert f"LoadCredential={named}:" in ini


def rewrite(path: Path, **sections: Any) -> None:
    """Replace sections of a file; JSON is YAML."""
    path.write_text(json.dumps({**parsed(path.read_text()), **sections}))


def test_a_third_relay_and_a_certificate_that_is_replaced(world: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("zenoh", reason="zenoh is not installed: pip install 'sern[zenoh]'")
    _, third, again, _ = keygens()
    type_in(world / ADMIN, monkeypatch, *third)
    (world / "munich").mkdir()
    write_pair(ClientName("munich"), world / "munich", world / "munich")
    (world / "munich" / "clients").mkdir()
    for client in CLIENTS:
        copy(world / client / f"{client}.pub", world / "munich" / "clients")
    install(world, "munich")
    text = (EXAMPLES / "berlin" / "relay.yaml").read_text()
    (world / "munich" / "relay.yaml").write_text(text)
    rewrite(
        world / "munich" / "relay.yaml",
        relay={**parsed(text)["relay"], "name": "munich", "secret_key_file": "munich.key"},
        fabric=fabrics()[3],
    )
    is_right(world / "munich" / "relay.yaml", monkeypatch)
    fabric = world / ADMIN / "fabric"
    (fabric / "old").mkdir()
    for name in ("berlin.pem", "berlin-key.pem"):
        (fabric / name).rename(fabric / "old" / name)
    type_in(world / ADMIN, monkeypatch, *again)
    install(world, "berlin")
    is_right(world / "berlin" / "relay.yaml", monkeypatch)
    assert (fabric / "berlin.pem").read_bytes() != (fabric / "old" / "berlin.pem").read_bytes()


def test_a_new_authority_beside_the_old_one(world: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Either pair is right while ca.pem has both."""
    pytest.importorskip("zenoh", reason="zenoh is not installed: pip install 'sern[zenoh]'")
    with_both_authorities(world, monkeypatch)
    is_right(world / "berlin" / "relay.yaml", monkeypatch)
    for name in ("berlin.pem", "berlin-key.pem"):
        copy(world / ADMIN / "new" / name, world / "berlin" / "fabric")
    is_right(world / "berlin" / "relay.yaml", monkeypatch)


def with_both_authorities(world: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    type_in(world / ADMIN, monkeypatch, *keygens()[3])
    old, new = (world / ADMIN / name / "ca.pem" for name in ("fabric", "new"))
    old.write_bytes(old.read_bytes() + new.read_bytes())
    for city in CITIES:
        install(world, city)


async def test_it_works(world: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Robot and site at their own relays; the tools; then Berlin is drained, and its robot goes on in Hamburg until it
    is back, with a pair of a new authority."""
    pytest.importorskip("zenoh", reason="zenoh is not installed: pip install 'sern[zenoh]'")
    fabric, *ports = free_ports(7)
    clients = dict(zip(CITIES, ports, strict=False))
    web = dict(zip((*CITIES, *CLIENTS), ports[2:], strict=True))
    for city in CITIES:
        path = world / city / "relay.yaml"
        content = parsed(path.read_text())
        between = {"berlin": {"listen": [f"tls/{HOST}:{fabric}"]}, "hamburg": {"peers": [f"tls/{HOST}:{fabric}"]}}[city]
        rewrite(
            path,
            relay={**content["relay"], "listen": [f"tcp://{HOST}:{clients[city]}"]},
            fabric={**content["fabric"], **between},
            http={"listen": f"{HOST}:{web[city]}"},
        )
    for client in CLIENTS:
        path = world / client / "client.yaml"
        content = parsed(path.read_text())
        for relay in content["relays"]:
            city = relay["server_key_file"].removesuffix(".pub")
            relay["endpoint"] = f"tcp://{HOST}:{clients[city]}"
        own = {"http": {"listen": f"{HOST}:{web[client]}"}, "local": {"listen": False}}
        rewrite(path, relays=content["relays"], failover={"return_s": 1.0}, **own)
    with_both_authorities(world, monkeypatch)
    async with Lab(world) as lab:
        relays = {city: lab.process(world / city / "relay.yaml") for city in CITIES}
        await relays["berlin"].said("relay hamburg is there")
        await relays["hamburg"].said("relay berlin is there")
        site = await lab.process(world / "site1" / "client.yaml").ready()
        robot = await lab.process(world / "jackal1" / "client.yaml").ready()
        await arrives(site)
        assert at(robot) == "berlin" and at(site) == "hamburg"
        api = f"http://{HOST}:{web['berlin']}"
        listed = type_in(world, monkeypatch, "clients", "--api", api)
        assert re.search(r"jackal1 .*connected", listed) and re.search(r"site1 .*at hamburg", listed), listed
        assert "jackal1" in type_in(world, monkeypatch, "top", "--once", "--interval", "0.2", "--api", api)
        await relays["berlin"].stop()
        await robot.until(lambda: at(robot) == "hamburg", "is in Hamburg")
        await arrives(site)
        for name in ("berlin.pem", "berlin-key.pem"):
            copy(world / ADMIN / "new" / name, world / "berlin" / "fabric")
        relays["berlin"] = await lab.process(world / "berlin" / "relay.yaml").ready()
        await robot.until(lambda: at(robot) == "berlin", "is back in Berlin")
        await arrives(site)
        for process in (robot, site, *relays.values()):
            await process.stop()


def at(client: Process) -> str | None:
    """The relay that it has a session with."""
    (link,) = client.json("/api/link")
    return link["relay"]["name"] if link["up"] else None


async def arrives(site: Process) -> None:
    """More poses come to the site."""

    def poses() -> int:
        return int(site.json("/api/topics").get("/jackal1/odometry/filtered", {}).get("delivered", 0))

    least = poses() + 5
    await site.until(lambda: poses() >= least, "has poses")
