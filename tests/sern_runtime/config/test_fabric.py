"""The section `fabric`: what is right, and what is said about certificates that are not."""

import datetime
from pathlib import Path

import pytest

from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.types import ClientName
from sern_runtime.config.fabric import CertificateFiles, certificate_problems
from sern_runtime.config.relay import load_relay
from sern_runtime.fabric.zenoh_port import options_of
from sern_runtime.fabric.zenoh_settings import settings
from sern_tools.keygen_fabric import make_fabric

HUB = "hub1"
NOW_S = datetime.datetime.now(datetime.UTC).timestamp()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("fabric")
    make_fabric([HUB, "hub2"], out=made)
    return made


def files(folder: Path, *, ca: str = "ca", certificate: str = HUB, key: str = HUB) -> CertificateFiles:
    return CertificateFiles(folder / f"{ca}.pem", folder / f"{certificate}.pem", folder / f"{key}-key.pem")


def said(found: CertificateFiles, relay: str = HUB, *, at_s: float = NOW_S) -> list[str]:
    return [problem.problem for problem in certificate_problems(found, (), relay, at_s=at_s)]


def test_what_keygen_makes_is_right(folder: Path) -> None:
    assert said(files(folder)) == []
    assert said(files(folder, certificate="hub2", key="hub2"), "hub2") == []


def test_each_mistake_is_said(folder: Path, tmp_path: Path) -> None:
    assert said(files(folder, key="hub2")) == [f"{folder}/hub2-key.pem is not the key of {folder}/hub1.pem"]
    wrong = said(files(folder, certificate="hub2", key="hub2"))
    assert wrong == [f"{folder}/hub2.pem is of hub2, and this is hub1; use that of hub1"]
    make_fabric([HUB], out=tmp_path)
    mixed = CertificateFiles(tmp_path / "ca.pem", folder / "hub1.pem", folder / "hub1-key.pem")
    assert said(mixed) == [f"{folder}/hub1.pem was not signed by {tmp_path}/ca.pem; use those of one authority"]
    gone = said(files(tmp_path / "none"))
    assert len(gone) == 3 and gone[0].startswith(f"{tmp_path}/none/ca.pem: can not be read (No such file")
    (tmp_path / "hub1.pem").write_text("not a certificate")
    assert said(files(tmp_path)) == [f"{tmp_path}/hub1.pem: is no certificate in PEM"]
    assert said(files(folder, key="../nothing/x"))[0].startswith(f"{folder}/../nothing/x-key.pem: can not be read")


def test_time_is_looked_at(folder: Path) -> None:
    year_s = 365 * 86_400.0
    assert all("is not valid before" in text for text in said(files(folder), at_s=NOW_S - year_s))
    assert all("; make new ones before" in text for text in said(files(folder), at_s=NOW_S + 10 * year_s - 86_400))
    assert all("has expired on" in text for text in said(files(folder), at_s=NOW_S + 11 * year_s))


def test_a_key_that_others_may_read(folder: Path, tmp_path: Path) -> None:
    for path in folder.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    (tmp_path / "hub1-key.pem").chmod(0o640)
    assert said(files(tmp_path)) == [
        f"{tmp_path}/hub1-key.pem is open to others than its owner (mode 0640); run: chmod 600 {tmp_path}/hub1-key.pem"
    ]


def write(folder: Path, fabric: str) -> Path:
    path = folder / "relay.yaml"
    path.write_text(f"relay: {{name: {HUB}, listen: ['ipc://x'], insecure: true}}\nfabric: {fabric}\n")
    return path


@pytest.mark.parametrize(
    "certificates", [".", "{ca: ca.pem, certificate: hub1.pem, key: hub1-key.pem}"], ids=["folder", "one by one"]
)
def test_what_zenoh_is_told(folder: Path, certificates: str) -> None:
    path = write(
        folder, f"{{listen: ['tls/*:7447'], peers: ['tls/h:1'], relays: [hub2], certificates: {certificates}}}"
    )
    loaded = load_relay(path)
    assert loaded.model.fabric is not None
    options = options_of(loaded.model.fabric, folder, name=ClientName(HUB), boot=1)
    told = settings(options)
    assert (told["mode"], told["listen/endpoints"]) == ("peer", ["tls/[::]:7447"])
    assert told["connect/endpoints"] == ["tls/h:1"]
    for key in ("transport/shared_memory/enabled", "scouting/multicast/enabled", "scouting/gossip/enabled"):
        assert told[key] is False
    assert (told["transport/unicast/max_links"], told["transport/link/tx/lease"]) == (1, 2000)
    assert told["transport/link/protocols"] == ["tls"]
    assert told["transport/link/tls"]["root_ca_certificate"] == str(folder / "ca.pem")
    access = told["access_control"]
    assert (access["enabled"], access["default_permission"]) == (True, "deny")
    assert [subject.get("cert_common_names") for subject in access["subjects"]] == [None, ["hub2"]]


def test_a_client_of_external_routers(folder: Path) -> None:
    loaded = load_relay(write(folder, "{external: true, peers: ['tls/router:7447'], certificates: .}"))
    assert loaded.model.fabric is not None
    told = settings(options_of(loaded.model.fabric, folder, name=ClientName(HUB), boot=1))
    assert told["mode"] == "client" and not told["listen/endpoints"] and "access_control" not in told


def test_a_relay_does_not_name_itself(folder: Path) -> None:
    path = write(folder, "{peers: ['tls/h:1'], relays: [hub2, hub1], certificates: .}")
    with pytest.raises(ConfigError, match=r"relay.yaml:2: fabric.relays.1: hub1 is this relay itself; name the others"):
        load_relay(path)
