"""A relay whose file has `fabric`: it sees others, says what is missing, and leaves nothing behind."""

import sys
from pathlib import Path

import pytest

from sern_core.relay.access import AccessRule
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.types import ClientName
from sern_relay.daemon import RelayDaemon
from sern_relay.fabric import RelayFabric, rules_hash
from sern_runtime.config.relay import load_relay
from sern_tools.keygen_fabric import make_fabric
from sern_tools.ports import free_ports
from tests.support import until

pytest.importorskip("zenoh", reason="zenoh is not installed: pip install 'sern[zenoh]'")

NAMES = ("hub1", "hub2")


def relay(folder: Path, name: str, port: int, fabric_port: int) -> RelayDaemon:
    """The first of NAMES listens, the other connects."""
    at = f"['tls/127.0.0.1:{fabric_port}']"
    where = f"listen: {at}" if name == NAMES[0] else f"peers: {at}"
    (other,) = (each for each in NAMES if each != name)
    path = folder / f"{name}.yaml"
    path.write_text(
        f"relay: {{name: {name}, listen: ['tcp://127.0.0.1:{port}'], insecure: true}}\n"
        f"fabric: {{{where}, relays: [{other}], certificates: .}}\n"
        "http: {listen: null}\n"
    )
    return RelayDaemon(load_relay(path))


def fabric_of(daemon: RelayDaemon) -> RelayFabric:
    assert daemon.transports.fabric is not None
    return daemon.transports.fabric


async def test_two_relays_see_each_other(tmp_path: Path) -> None:
    make_fabric(NAMES, out=tmp_path)
    ports = free_ports(3)
    first, second = (relay(tmp_path, name, port, ports[2]) for name, port in zip(NAMES, ports[:2], strict=True))
    try:
        await first.start()
        await second.start()
        one, other = fabric_of(first), fabric_of(second)
        await until(lambda: one.peers and other.peers)
        assert one.peers[ClientName("hub2")].boot == second.hub.boot
        assert one.peers[ClientName("hub2")].rules == rules_hash(())
        await second.stop()
        await until(lambda: not one.peers)
    finally:
        await second.stop()
        await first.stop()


async def test_what_comes_from_another_relay_is_sent_on_in_the_same_turn(tmp_path: Path) -> None:
    """Else clients waited for it until something else happened here, up to a second."""
    make_fabric(NAMES, out=tmp_path)
    ports = free_ports(3)
    first, second = (relay(tmp_path, name, port, ports[2]) for name, port in zip(NAMES, ports[:2], strict=True))
    try:
        await first.start()
        await second.start()
        one = fabric_of(first)
        await until(lambda: one.peers)
        turns: list[str] = []
        first.hub.after = lambda: turns.append("after")
        one.arrived(ClientName("hub2"), bytes(20))
        assert turns
    finally:
        await second.stop()
        await first.stop()


async def test_without_zenoh_a_relay_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_fabric(NAMES, out=tmp_path)
    ports = free_ports(2)
    daemon = relay(tmp_path, NAMES[0], *ports)
    monkeypatch.setitem(sys.modules, "zenoh", None)
    try:
        with pytest.raises(
            ConfigError, match=r"hub1.yaml:2: fabric: needs the zenoh library: .* install eclipse-zenoh"
        ):
            await daemon.start()
    finally:
        await daemon.stop()


def test_rules_that_differ_have_another_hash() -> None:
    rule = AccessRule("robot1", publish=("/a",))
    assert rules_hash([rule]) == rules_hash([AccessRule("robot1", publish=("/a",))])
    assert len({rules_hash([rule]), rules_hash([]), rules_hash([rule, rule]), rules_hash([AccessRule("robot1")])}) == 4
