"""Files of several relays are those of a fabric whose relays all reach each other."""

import json
from itertools import combinations
from pathlib import Path
from typing import Any

import pytest

from sern_runtime.config.client import load_client
from sern_runtime.config.relay import load_relay
from sern_tools.harness.fabric import FabricFiles, reached
from sern_tools.harness.files import client_content, write

NAMES = ("relay1", "relay2", "relay3", "relay4")


def fabric_of(files: FabricFiles, name: str) -> Any:
    file = files.relay(name, http={"listen": None})
    load_relay(file)
    return json.loads(file.read_text()).get("fabric")


@pytest.mark.parametrize("tls", [True, False])
def test_one_of_every_two_relays_connects_to_the_other(tmp_path: Path, tls: bool) -> None:
    files = FabricFiles(tmp_path, NAMES, tls=tls)
    sections = {name: fabric_of(files, name) for name in NAMES}
    for one, other in combinations(NAMES, 2):
        assert files.locators[one] in sections[one]["listen"]
        assert files.locators[one] in sections[other]["peers"]
        assert files.locators[other] not in sections[one].get("peers", [])
    assert all(locator.startswith("tls/" if tls else "tcp/") for locator in files.locators.values())


def test_at_external_routers_no_relay_listens(tmp_path: Path) -> None:
    files = FabricFiles(tmp_path, NAMES[:2], routers=["router1", "router2"])
    section = fabric_of(files, "relay2")
    assert section["external"] is True and "listen" not in section
    assert section["peers"] == [files.locators["router1"], files.locators["router2"]]
    assert (tmp_path / "fabric" / "router2-key.pem").exists()


def test_a_relay_alone_has_no_fabric(tmp_path: Path) -> None:
    files = FabricFiles(tmp_path, ["relay1"])
    assert fabric_of(files, "relay1") is None
    assert not (tmp_path / "fabric").exists()


def test_a_client_has_one_relay_or_a_list(tmp_path: Path) -> None:
    files = FabricFiles(tmp_path, NAMES[:2])
    files.admit(["robot"])
    content = client_content("robot", "", {"kind": "synthetic", "role": "robot"})
    content["relay"] |= files.at("relay2")
    one = load_client(write(tmp_path, "one", content)).model
    two = load_client(write(tmp_path, "two", files.several(content, NAMES[:2], failover_s=1.0))).model
    assert [each.endpoint for each in one.all_relays] == [files.endpoints["relay2"]]
    assert [each.endpoint for each in two.all_relays] == [files.endpoints[name] for name in NAMES[:2]]
    assert two.failover.failover_s == 1.0


def test_whom_a_relay_has_reached_is_in_its_log() -> None:
    lines = (
        "INFO connected to the relay relay2",
        "INFO connected to the relay relay3",
        "WARNING not connected to the relay relay2: it was restarted",
    )
    assert reached("\n".join(lines)) == {"relay3"}
    assert reached("\n".join((*lines, lines[0]))) == {"relay2", "relay3"}
