"""Free ports: two that look for one at the same time get different ones."""

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from sern_core.vocabulary.errors import SernError
from sern_tools import ports

NAME = f"tests-{os.getpid()}"


@pytest.fixture(autouse=True)
def own_claims(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(ports, "_claims", {})
    yield
    ports.release_claims()


def of_dds(port: int) -> bool:
    return (port - 7400) % 250 < ports.DDS_PORTS


def test_a_claim_holds_in_this_process_and_in_others_until_it_is_released() -> None:
    assert ports.claim(f"{NAME}-one")
    assert not ports.claim(f"{NAME}-one")
    program = f"from sern_tools.ports import claim; print(claim('{NAME}-one'), claim('{NAME}-two'))"
    command = [sys.executable, "-P", "-c", program]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == "False True\n"
    ports.release_claims()
    assert ports.claim(f"{NAME}-one") and ports.claim(f"{NAME}-two"), "claims end with their process"


def test_the_oldest_claims_end_first() -> None:
    assert all(ports.claim(f"{NAME}-{number}", 2) for number in range(3))
    assert ports.claim(f"{NAME}-other"), "claims of another number are others"
    assert ports.claim(f"{NAME}-0", 2) and not ports.claim(f"{NAME}-2", 2)


@pytest.mark.parametrize(
    ("outgoing", "left"),
    [
        ("32768\t60999\n", [range(15_000, 32_000)]),
        ("16000 65535\n", [range(15_000, 16_000)]),
        ("10000 15999", [range(16_000, 32_000)]),
        ("20000 20999", [range(15_000, 20_000), range(21_000, 32_000)]),
        ("1024 65535", [range(15_000, 32_000)]),  # nothing is left: any is better than none
        ("nonsense", [range(15_000, 32_000)]),
    ],
)
def test_ports_that_the_kernel_gives_to_outgoing_connections_are_left_to_it(
    outgoing: str, left: list[range], tmp_path: Path
) -> None:
    said = tmp_path / "ip_local_port_range"
    said.write_text(outgoing)
    assert ports.own_ports(said) == [port for part in left for port in part if not of_dds(port)]


def test_without_word_of_the_kernel_the_usual_ports_are_taken(tmp_path: Path) -> None:
    assert ports.own_ports(tmp_path / "none") == [port for port in range(15_000, 32_000) if not of_dds(port)]


def test_ports_that_dds_takes_without_asking_are_left_to_it() -> None:
    multicast, unicast = (0, 1), (10, 11)
    taken = {7400 + 250 * domain + offset for domain in range(100) for offset in multicast}
    taken |= {
        7400 + 250 * domain + offset + 2 * peer for domain in range(100) for offset in unicast for peer in range(45)
    }
    assert not set(ports.PORTS) & taken
    assert len(ports.PORTS) > 5_000


def test_the_ports_given_here_are_none_that_this_kernel_gives() -> None:
    first, last = map(int, ports.OUTGOING.read_text().split())
    if first <= ports.USUAL.start and last >= ports.USUAL.stop - 1:
        pytest.skip("this kernel leaves no port to others")
    assert not set(ports.PORTS) & set(range(first, last + 1))
    assert ports.free_ports(1)[0] in ports.PORTS


def test_ports_that_are_in_use_or_claimed_are_not_given(monkeypatch: pytest.MonkeyPatch) -> None:
    (first,) = ports.free_ports(1)
    monkeypatch.setattr(ports, "PORTS", range(first, first + 1))
    with pytest.raises(SernError, match="no 1 free ports"):
        ports.free_ports(1)
    ports.release_claims()
    assert ports.free_ports(1) == [first]
    ports.release_claims()
    for kind in (socket.SOCK_STREAM, socket.SOCK_DGRAM):
        with socket.socket(type=kind) as listener:
            listener.bind((ports.HOST, first))
            with pytest.raises(SernError, match="no 1 free ports"):
                ports.free_ports(1)
